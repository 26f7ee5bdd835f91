"""Simulated drives and encoders: from set-points to acting torque, from angles to reported values."""

from __future__ import annotations

from collections.abc import Iterator

from sim.effects.assembly import LinkParts, MotorParts, Reading
from sim.effects.memory import Delayed, Lag, PositionHistory
from sim.sensors import DriveHardware, DriveSignals, LinkEncoder


class Amplifier:
    """A drive's current loop and its sampled signals.

    It reports the commanded current; effects change the acting torque.
    """

    def __init__(self, drive: DriveHardware, period_s: float, substeps: int, noise: Iterator[float]) -> None:
        """Switch the drive on."""
        self.drive = drive
        self.schedule = [0.0] * substeps
        self._substeps, self._period_s, self._noise = substeps, period_s, noise
        self._current_a, self._theta, self._velocity = 0.0, 0.0, 0.0
        self._filtered: float | None = None
        self.fit(MotorParts())

    def fit(self, parts: MotorParts) -> None:
        """Add effects, from the next period on."""
        self._path, self._readings = tuple(parts.torque_path), tuple(parts.readings)
        delay = parts.torque_delay_s
        self._delay = Delayed(delay, self._period_s, self._substeps) if delay > 0.0 else None
        lag, step_s = parts.torque_lag_s, self._period_s / self._substeps
        self._acting = Lag(lag, step_s) if lag > 0.0 else None
        self._reported = Lag(-lag, self._period_s) if lag < 0.0 else None

    def latch(self, current_a: float, time_s: float, theta: float, velocity: float) -> None:
        """Start a period with this set-point, and sample.

        Args:
            theta: motor position at the joint, rad.
            velocity: motor velocity at the joint, rad/s.
        """
        drive = self.drive
        limit, step = drive.limit_a, drive.current_step_a
        current_a = min(max(current_a, -limit), limit)
        torque = current_a * drive.joint_torque_per_ampere
        for acting in self._path:
            torque = acting(torque, time_s, theta)
        self.schedule = [torque] * self._substeps if self._delay is None else self._delay.schedule(torque)
        if self._acting is not None:
            self.schedule = [self._acting.passed(each) for each in self.schedule]
        if self._reported is not None:
            current_a = self._reported.passed(current_a)
        self._current_a = step * round((current_a + next(self._noise)) / step)
        self._theta, self._velocity = theta, velocity
        if drive.velocity_filter_s > 0.0:
            before = velocity if self._filtered is None else self._filtered
            share = self._period_s / (self._period_s + drive.velocity_filter_s)
            self._filtered = self._velocity = before + share * (velocity - before)

    def signals(self) -> DriveSignals:
        """Return the sampled signals."""
        drive, theta = self.drive, self._theta
        for read in self._readings:
            theta = read(theta)
        shaft = self._velocity * drive.gear_ratio * drive.direction
        resolution = drive.velocity_resolution_rad_s
        return DriveSignals(
            round(theta * drive.counts_per_rad),
            resolution * round(shaft / resolution) if resolution else shaft,
            self._current_a,
            self._current_a * drive.torque_constant_nm_a,
        )


class LinkScale:
    """The link encoder's disc and its sampled reading."""

    def __init__(self, encoder: LinkEncoder, noise: Iterator[float]) -> None:
        """Switch the encoder on."""
        self.counts = 0  # the reading
        # receives every plant step of the link if the reading lags; else None
        self.history: PositionHistory | None = None
        # receives every plant step of the deflection if its sensor lags; else None
        self.deflection: PositionHistory | None = None
        self._encoder, self._noise = encoder, noise
        self._readings: tuple[Reading, ...] = ()

    def fit(self, parts: LinkParts, step_s: float, position: float, theta: float) -> None:
        """Add effects, with an integration step of step_s, link and first motor at these angles (rad)."""
        delay, late = parts.reading_delay_s, parts.deflection_delay_s
        self._readings = tuple(parts.readings)
        self.history = PositionHistory(delay, step_s, position) if delay > 0.0 else None
        self.deflection = PositionHistory(late, step_s, position - theta) if late > 0.0 else None

    def sample(self, position: float, theta: float) -> None:
        """Sample at these positions of link and first motor (rad)."""
        if self.history is not None:
            position = self.history.position()
        if self.deflection is not None:
            position = theta + self.deflection.position()
        for read in self._readings:
            position = read(position)
        encoder = self._encoder
        self.counts = round((position - encoder.zero_rad) * encoder.counts_per_rad + next(self._noise))
