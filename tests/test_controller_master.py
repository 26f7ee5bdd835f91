"""The controller's CANopen master, against the simulated drive: what it writes, and what it leaves alone."""

import itertools
from contextlib import contextmanager

import can
import controllerkit  # noqa: F401 - finds the example's package
import pytest
from simkit import StubRig
from vsacontrol.drive import PowerState, Wiring
from vsacontrol.master import Master
from vsacontrol.sdo import Client, Read, SdoError, Write

from sim.canopen.drive import Cia402Drive, DriveData
from sim.canopen.profiles import profile
from sim.network import Network

WIRING = Wiring(node_id=5, gear_ratio=20.0, torque_sign=-1)
RATED_MNM = 10  # so one per mille is 0.2 mN·m at the joint


class Bench:
    """One drive, a daemon's worth of NMT and SYNC, and the master under test."""

    def __init__(self, quirks: str = "strict", wiring: Wiring = WIRING) -> None:
        self.now_s = 0.0
        self.sent: list[tuple[int, bytes]] = []
        channel = f"controller-master-{id(self)}"
        self.buses = [can.Bus(interface="virtual", channel=channel) for _ in range(2)]
        data = DriveData(rated_torque_mnm=RATED_MNM)
        self.drive = Cia402Drive(5, StubRig(), 0, data, profile(quirks))
        self.network = Network(self.buses[0], [self.drive], StubRig(), clock=lambda: self.now_s)
        self.master = Master([wiring], self._send, limit_nm=0.1)
        self.network.poll()
        self.put(0x000, b"\x01\x05")

    def _send(self, cob_id: int, data: bytes) -> None:
        self.sent.append((cob_id, data))
        self.put(cob_id, data)

    def put(self, cob_id: int, data: bytes = b"") -> None:
        self.buses[1].send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def run(self, cycles: int, torque_nm: float = 0.0) -> None:
        for _ in range(cycles):
            self.now_s += 0.001
            self.put(0x080)
            self.network.poll()
            while (message := self.buses[1].recv(0)) is not None:
                self.master.feed(message.arbitration_id, bytes(message.data), self.now_s)
            self.master.poll(self.now_s, may_configure=True)
            self.master.command((torque_nm,), self.now_s)

    def number(self, index: int, subindex: int = 0) -> int:
        return self.drive.dictionary.find(index, subindex).number


@contextmanager
def bench(*args, **options):
    made = Bench(*args, **options)
    try:
        yield made
    finally:
        for bus in made.buses:
            bus.shutdown()


def test_a_drive_is_configured_enabled_and_commanded_in_torque_mode():
    with bench() as b:
        b.run(100, 0.02)
        assert b.drive.machine.state.name == PowerState.OPERATION_ENABLED.name
        assert b.master.enabled
        assert b.number(0x6061) == 10  # cyclic synchronous torque
        assert b.number(0x6071) == -100  # 0.02 N·m of 0.2 mN·m each, against the joint's sign
        assert b.number(0x1402, 2) == 255


def test_torque_is_limited_here_and_in_the_drive():
    with bench() as b:
        b.run(100, 5.0)
        assert b.number(0x6071) == -500
        assert b.number(0x6072) == 500


def test_only_objects_of_the_controller_are_written():
    with bench() as b:
        tpdos = [b.number(0x1800 + n, s) for n in range(4) for s in (1, 2)]
        b.run(100)
        downloads = {
            int.from_bytes(data[1:3], "little") for cob, data in b.sent if cob == 0x605 and data[0] >> 5 == 1
        }
        assert downloads <= {0x1402, 0x1602, 0x6071, 0x6072, 0x6060, 0x1016, 0x1029, 0x6007}
        assert tpdos == [b.number(0x1800 + n, s) for n in range(4) for s in (1, 2)]
        assert not any(cob in (0x000, 0x080) for cob, _ in b.sent)  # no NMT, no SYNC


def test_without_leave_of_the_daemon_nothing_is_asked():
    with bench() as b:
        b.master.poll(0.0, may_configure=False)
        assert [cob for cob, _ in b.sent] == [0x77E]  # its heartbeat


def test_a_fault_is_reset_by_edges_and_not_for_ever():
    with bench() as b:
        b.run(100)
        b.drive.fault(0x2310)
        b.run(3)
        assert b.master.faulted
        assert not b.master.enabled
        b.run(400)
        assert b.master.enabled
        b.sent.clear()
        for _ in range(900):  # it comes back at once
            if b.drive.machine.state.name != "FAULT":
                b.drive.fault(0x2310)
            b.run(1)
        words = [data[0] for cob, data in b.sent if cob == 0x405]
        edges = sum(1 for a, c in itertools.pairwise(words) if c & 0x80 and not a & 0x80)
        assert 1 <= edges <= 5


def test_torque_is_never_sent_to_a_drive_that_is_not_enabled():
    with bench() as b:
        b.run(100, 0.02)
        b.sent.clear()
        b.drive.fault(0x2310)
        b.run(20, 0.02)
        torques = [int.from_bytes(data[2:4], "little", signed=True) for cob, data in b.sent if cob == 0x405]
        assert torques[2:] == [0] * (len(torques) - 2)


def test_a_reboot_is_noticed_and_everything_done_again():
    with bench() as b:
        b.run(100, 0.02)
        b.drive.reset_node()
        b.run(2)
        assert not b.master.enabled
        b.put(0x000, b"\x01\x05")
        b.run(1200, 0.02)
        assert b.master.enabled
        assert b.number(0x6071) == -100


def test_a_dead_master_is_noticed_by_the_drive():
    with bench() as b:
        b.run(100, 0.02)
        for _ in range(150):
            b.now_s += 0.001
            b.put(0x080)
            b.network.poll()
        assert b.drive.machine.state.name == "SWITCH_ON_DISABLED"
        assert b.number(0x6074) == 0


def test_sdo_retries_and_then_says_what_did_not_answer():
    sent: list[bytes] = []
    client = Client(7, lambda _cob, data: sent.append(data))

    def program():
        yield Read(0x6076)

    client.start(program(), 0.0)
    for k in range(1, 3):
        client.poll(0.31 * k)
    with pytest.raises(SdoError, match="node 7, object 0x6076:00: no answer"):
        client.poll(1.0)
    assert sent == [bytes.fromhex("4076600000000000")] * 3
    assert not client.busy


def test_sdo_transfers_byte_for_byte():
    sent: list[bytes] = []
    got: list[int] = []
    client = Client(7, lambda _cob, data: sent.append(data))

    def program():
        got.append((yield Read(0x6077)))
        yield Write(0x6071, 0, -2, 2)

    client.start(program(), 0.0)
    client.feed(bytes.fromhex("4378600011223344"), 0.0)  # the answer to somebody else's question
    client.feed(bytes.fromhex("4B77600034120000"), 0.0)
    assert got == [0x1234]
    client.feed(bytes.fromhex("6071600000000000"), 0.0)
    assert sent == [bytes.fromhex("4077600000000000"), bytes.fromhex("2B716000FEFF0000")]
    assert not client.busy


def test_mapping_that_is_there_already_is_not_written():
    with bench() as b:
        b.run(100)
        b.sent.clear()
        again = Master([WIRING], b._send, limit_nm=0.1)
        b.master = again
        b.run(100)
        written = {data[1] | data[2] << 8 for cob, data in b.sent if cob == 0x605 and data[0] >> 5 == 1}
        assert not written & {0x1402, 0x1602}
        assert again.enabled
