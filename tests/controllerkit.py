"""What the controller's tests share: drives, daemon and the example's controller in one thread, one period a SYNC."""

import itertools
import math
import sys
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import can
import canopen
from daemonkit import quiet_daemon

EXAMPLE = Path(__file__).parent.parent / "examples" / "controller"
if str(EXAMPLE) not in sys.path:
    sys.path.insert(0, str(EXAMPLE))

from controller import Controller, Cycle, Settings  # noqa: E402
from drives import Master  # noqa: E402

from drivelink import jointfile  # noqa: E402
from drivelink.demo.simbus import open_sim_bus  # noqa: E402
from drivelink.demo.simulate import nodes_from_joint, world_from_joint  # noqa: E402
from drivelink.pubsub.wire import decode_estimate, decode_external, decode_sample  # noqa: E402
from sim.faults import Faults  # noqa: E402
from sim.network import Network  # noqa: E402

QUICK = Settings(identify_s=1.5, way_s=0.8, rest_s=0.2)
SAFE_WITHIN_S = 0.020
_channels = itertools.count()


def declared_text() -> str:
    """The example's joint with its springs declared: these tests are about faults, and identification takes time."""
    text = (EXAMPLE / "joint.toml").read_text(encoding="utf-8")
    known = 'model = "vsa-ii"\nparameters = { k_nm_rad = 0.5, c = 1.75 }'
    return text.replace('model = "vsa-ii"', known)


class Rig:
    """A joint in lockstep."""

    def __init__(self, settings: Settings = QUICK, channel: str | None = None, text: str = "") -> None:
        joint = jointfile.parse(text or declared_text())
        where = {"interface": "socketcan" if channel else "virtual", "options": {}}
        bus = joint.bus.model_copy(update={**where, "channel": channel or f"vsa-{next(_channels)}"})
        self.joint = joint.model_copy(update={"bus": bus})
        self.now_s = self.last_estimate_s = 0.0
        self.sent: list[tuple[int, bytes]] = []
        self.commands: list[tuple[float, int, int]] = []
        self.events: list[tuple[str, str, float]] = []
        self.cut, self.external, self._estimates, self._samples, self._count = False, None, [], [], 0
        self.world = world_from_joint(self.joint)
        self._buses = [
            open_sim_bus(bus),
            can.Bus(interface=bus.interface, channel=bus.channel, ignore_config=True),
        ]
        nodes = nodes_from_joint(self.joint, self.world)
        self.network = Network(self._buses[0], nodes, self.world, clock=lambda: self.now_s)
        self.faults = Faults(self.network)
        self.controller = Controller(self.joint, settings, lambda *event: self.events.append(event))
        self.canopen = canopen.Network(self)  # `send` and `shutdown` of a bus are those of this class
        self.master = Master(self.canopen, self.joint, settings.torque_nm)
        self.start_daemon()

    def start_daemon(self) -> None:
        self.daemon = quiet_daemon(self.joint, devices=self.network.poll)
        self.daemon.loop.loop_joints[0].sink = self

    def kill_daemon(self) -> None:
        """No SYNC and no estimate from now on, and nobody says goodbye."""
        if self.daemon is not None:
            self.daemon.close()
        self.daemon = None

    def close(self) -> None:
        self.kill_daemon()
        for bus in self._buses:
            bus.shutdown()

    def put(self, tick) -> None:
        self._estimates.append(decode_estimate(tick.estimate_payload))
        if tick.external_payload is not None:
            self.external = decode_external(tick.external_payload)
        if tick.sample_payload is not None:
            self._samples.append(decode_sample(tick.sample_payload).sample)

    def send(self, message: can.Message) -> None:
        """The controller's frames; devices answer at once, so that its SDO transfers need no waiting."""
        self.sent.append((message.arbitration_id, bytes(message.data)))
        if 0x200 < message.arbitration_id <= 0x57F:
            torque = int.from_bytes(message.data[2:4], "little", signed=True)
            self.commands.append((self.now_s, message.arbitration_id, torque))
        self._buses[1].send(message)
        self.network.poll()
        self._receive()

    def _receive(self) -> None:
        while (message := self._buses[1].recv(0)) is not None:
            self.canopen.notify(message.arbitration_id, message.data, message.timestamp)

    def step(self) -> None:
        """One period: SYNC if there is a daemon, and what the controller makes of it."""
        self.now_s += self.joint.bus.period_s
        if self.daemon is not None:
            self.daemon.run_lockstep(1)
        else:  # a drive's control loop goes on by its own clock
            for node in self.network.nodes:
                node.on_control(1)
            self.world.advance(1)
            self.network.poll()
        self._receive()
        estimates, self._estimates, samples, self._samples = self._estimates, [], self._samples, []
        cycle = None
        if estimates and not self.cut:
            self.last_estimate_s = self.now_s
            if self._count % 250 == 0:
                self.controller.set_springs(self.daemon.documents()[0]["transmissions"])
            self._count += 1
            if samples:
                cycle = Cycle(estimates[-1], samples[-1], self.external)
        torques = self.controller.step(self.now_s, cycle, **self.master.states)
        self.master.command(torques, self.now_s)
        if self.now_s - self.last_estimate_s < 0.01 and torques == (0.0, 0.0):
            self.master.set_up(self.now_s)

    def run(self, seconds: float, phase: str | None = None) -> bool:
        """So much bus time, or until the controller is in that phase; whether it is."""
        for _ in range(round(seconds / self.joint.bus.period_s)):
            self.step()
            if self.controller.phase == phase:
                return True
        return False


@contextmanager
def running(seconds: float = 0.5, channel: str | None = None, **settings):
    """A rig on its way between its targets for so long."""
    with closing(Rig(replace(QUICK, **settings), channel)) as rig:
        assert rig.run(12.0, "run"), rig.events
        rig.run(seconds)
        assert rig.controller.phase == "run", rig.events
        yield rig


def torque_ended(rig, since_s: float) -> float:
    """Seconds from `since_s` to the frame that took the torque from the last drive, for good; inf: none did."""
    ends = []
    for cob_id in {cob_id for _, cob_id, _ in rig.commands}:
        frames = [(time_s, per_mille) for time_s, cob, per_mille in rig.commands if cob == cob_id]
        last = max(k for k, (_, per_mille) in enumerate(frames) if per_mille)
        ends.append(frames[last + 1][0] - since_s if last + 1 < len(frames) else math.inf)
    return max(ends)


def goes_safe(rig, since_s: float) -> str:
    """Assert that it does, in time, and stays there; the reason."""
    rig.run(0.1)
    assert rig.controller.phase == "safe"
    assert torque_ended(rig, since_s) <= SAFE_WITHIN_S
    demands = [node.dictionary.find(0x6074, 0).number for node in rig.network.nodes[:2]]
    assert demands == [0, 0]
    return rig.events[-1][1]


def recovers(rig, seconds: float) -> list[str]:
    """Assert that it goes to its targets again; the phases on the way."""
    before = len(rig.events)
    assert rig.run(seconds, "run"), rig.events
    return [phase for phase, _, _ in rig.events[before:]]
