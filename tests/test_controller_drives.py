"""The example controller's drives, against the simulated one: what is written, what is left alone; never by accident."""

import itertools
from contextlib import contextmanager

import can
import canopen
import controllerkit  # noqa: F401 - finds the example
import drives
from simkit import StubRig

from drivelink import jointfile
from sim.canopen.drive import Cia402Drive
from sim.canopen.profiles import profile
from sim.network import Network
from sim.sensors import DriveHardware

RATED_MNM = 10  # so one per mille is 0.2 mN·m at the joint
JOINT = """
name = "one"
[[motor]]
inertia_kg_m2 = 0.0005
[motor.transmission]
model = "none"
[motor.drive]
node_id = 5
gear_ratio = 20.0
torque_constant_nm_a = 0.02
direction = -1
"""


class Bench:
    """One drive, a daemon's worth of NMT and SYNC, and the master under test."""

    def __init__(self, quirks: str = "strict") -> None:
        self.now_s = 0.0
        self.sent: list[tuple[int, bytes]] = []
        self.buses = [can.Bus(interface="virtual", channel=f"drives-{id(self)}") for _ in range(2)]
        self.drive = Cia402Drive(
            5, StubRig(DriveHardware(torque_constant_nm_a=RATED_MNM / 2000)), 0, profile(quirks)
        )
        self.network = Network(self.buses[0], [self.drive], StubRig(), clock=lambda: self.now_s)
        self.canopen = canopen.Network(self)
        self.master = self.made()
        self.network.poll()
        self.put(0x000, b"\x01\x05")

    def made(self) -> drives.Master:
        return drives.Master(self.canopen, jointfile.parse(JOINT), 0.1)

    def send(self, message: can.Message) -> None:
        self.sent.append((message.arbitration_id, bytes(message.data)))
        self.buses[1].send(message)
        self.poll()

    def put(self, cob_id: int, data: bytes = b"") -> None:
        self.buses[1].send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
        self.poll()

    def poll(self) -> None:
        self.network.poll()
        while (message := self.buses[1].recv(0)) is not None:
            self.canopen.notify(message.arbitration_id, message.data, message.timestamp)

    def run(self, cycles: int, torque_nm: float = 0.0) -> None:
        for _ in range(cycles):
            self.now_s += 0.001
            self.put(0x080)
            self.master.set_up(self.now_s)
            self.master.command((torque_nm,), self.now_s)

    def number(self, index: int, subindex: int = 0) -> int:
        return self.drive.dictionary.find(index, subindex).number

    def written(self) -> set[int]:
        """Indices of the objects that were written by SDO."""
        frames = (data for cob, data in self.sent if cob == 0x605 and data[0] >> 5 == 1)
        return {int.from_bytes(data[1:3], "little") for data in frames}

    def torques(self) -> list[int]:
        return [int.from_bytes(data[2:4], "little", signed=True) for cob, data in self.sent if cob == 0x405]


@contextmanager
def bench(**options):
    made = Bench(**options)
    try:
        yield made
    finally:
        for bus in made.buses:
            bus.shutdown()


def test_a_drive_is_set_up_enabled_and_commanded_and_only_by_the_controllers_own_objects():
    with bench() as b:
        tpdos = [b.number(0x1800 + n, s) for n in range(4) for s in (1, 2)]
        b.run(100, 0.02)
        assert b.master.states["enabled"]
        assert b.number(0x6061) == 10  # cyclic synchronous torque
        assert b.number(0x6071) == -100  # 0.02 N·m of 0.2 mN·m each, against the joint's sign
        assert b.number(0x1402, 2) == 255
        b.run(1, 5.0)
        assert b.number(0x6071) == -500  # limited here
        assert b.number(0x6072) == 500  # and in the drive
        assert b.written() <= {0x1402, 0x1602, 0x6071, 0x6072, 0x6060, 0x1016, 0x1029, 0x6007}
        assert tpdos == [b.number(0x1800 + n, s) for n in range(4) for s in (1, 2)]
        assert not any(cob in (0x000, 0x080) for cob, _ in b.sent)  # no NMT, no SYNC


def test_mapping_that_is_there_already_is_not_written_and_before_the_set_up_there_is_the_heartbeat_only():
    with bench() as b:
        b.master.command((0.1,), 0.0)
        assert [cob for cob, _ in b.sent] == [0x77E]
        b.run(100)
        b.sent.clear()
        b.master = b.made()
        b.run(100)
        assert b.master.states["enabled"]
        assert not b.written() & {0x1402, 0x1602}


def test_a_fault_ends_the_torque_and_is_reset_by_edges_and_not_for_ever():
    with bench() as b:
        b.run(100, 0.02)
        b.sent.clear()
        b.drive.fault(0x2310)
        b.run(20, 0.02)
        assert b.master.states["faulted"]
        assert not any(b.torques()[2:])
        b.run(400)
        assert b.master.states["enabled"]
        b.sent.clear()
        for _ in range(900):  # it comes back at once
            if b.drive.machine.state.name != "FAULT":
                b.drive.fault(0x2310)
            b.run(1)
        words = [data[0] for cob, data in b.sent if cob == 0x405]
        edges = sum(1 for a, c in itertools.pairwise(words) if c & 0x80 and not a & 0x80)
        assert 1 <= edges <= drives.MOST_RESETS


def test_a_drive_that_does_not_answer_is_one_line(capsys):
    with bench() as b:
        b.network.plugged = False
        b.master.drives[0]._node.sdo.RESPONSE_TIMEOUT = 0.01
        b.run(3)
        assert capsys.readouterr().err == "node 5: No SDO response received\n"
