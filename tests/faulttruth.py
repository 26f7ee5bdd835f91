"""What the devices of a world measured, and whether a sample is that."""

from drivelink.canopen.layout import MappedObject, Signal
from drivelink.daemon.service import Daemon
from estimator.sample import Sample
from sim.world import World


class Truth:
    """What the devices of a world measured at every SYNC, in counts, and a check of samples against it."""

    def __init__(self, world: World, daemon: Daemon) -> None:
        self._world = world
        self._objects = [_mapped(daemon, Signal.MOTOR_POSITION, m) for m in range(world.motors)]
        self._objects.append(_mapped(daemon, Signal.LINK_POSITION))
        self._history: list[tuple[int, ...]] = []
        self._physics: list[tuple[float, float]] = []  # stiffness and torque at the same SYNCs
        self._square, self.torque_rms_nm = 0.0, 0.0
        self._forgotten = 0
        self._inner = world.advance
        self.synced = self.unseen = False
        world.advance = self._advance  # type: ignore[method-assign]

    @property
    def syncs(self) -> int:
        """SYNCs that the devices have seen."""
        return self._forgotten + len(self._history)

    def _advance(self, periods: int = 1) -> None:
        self._inner(periods)
        if not self.synced:
            return
        self.synced = False
        world = self._world
        counts = [world.drive(motor).position_counts for motor in range(world.motors)]
        self._history.append((*counts, world.link_counts()))
        truth = world.truth()
        self._physics.append((truth.stiffness_nm_rad, truth.flexibility_torque_nm))
        self._square += truth.flexibility_torque_nm**2
        self.torque_rms_nm = (self._square / self.syncs) ** 0.5

    def forget(self) -> None:
        """Keep only what a sample under way may still be of."""
        keep = 100
        self._forgotten += max(0, len(self._history) - keep)
        del self._history[:-keep]
        del self._physics[:-keep]

    def physics(self, sync: int) -> tuple[float, float] | None:
        """True stiffness and flexibility torque at a SYNC; None: forgotten."""
        place = sync - self._forgotten
        return self._physics[place] if 0 <= place < len(self._physics) else None

    def measured(self, sample: Sample, sync: int, late: bool) -> bool:
        """Whether all positions of a sample are those of one SYNC (from 0); `late`: or single ones of that before."""
        place = sync - self._forgotten
        if not 0 < place < len(self._history):
            return False
        values = (*sample.motor_position_rad, sample.link_position_rad)
        rows = zip(self._objects, values, self._history[place], self._history[place - 1], strict=True)
        return all(
            (count := round((value + mapped.offset) / mapped.scale)) == now or (late and count == before)
            for mapped, value, now, before in rows
        )


def _mapped(daemon: Daemon, signal: Signal, motor: int | None = None) -> MappedObject:
    layouts = [layout for layout in daemon.layouts.values() if motor is None or layout.motor == motor]
    return next(o for layout in layouts for tpdo in layout.tpdos for o in tpdo.objects if o.signal is signal)
