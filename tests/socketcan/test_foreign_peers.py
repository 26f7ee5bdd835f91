"""Foreign peers on a real SocketCAN, at rates that an emulated kernel carries."""

import time
from contextlib import contextmanager
from pathlib import Path

import can
import canopen
import pytest
from canopenkit import configure
from zenohkit import LIMIT_S, until

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.bus import interface_is_up, open_bus
from drivelink.canopen.layout import Signal
from drivelink.cycle.sources import OVERFLOW, SocketCanSource
from drivelink.cycle.syncclock import SyncClock, measure_period
from drivelink.jointfile import BusSection, parse

CHANNEL = "vcan0"
pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not interface_is_up(CHANNEL), reason="no SocketCAN interface vcan0 here"),
]
SECTION = BusSection(interface="socketcan", channel=CHANNEL)
SHEET = Path(__file__).parents[2] / "sim/eds/cia402-drive.eds"
SYNCS = 200
JOINT = """
name = "wrist"
[[motor]]
inertia_kg_m2 = 0.05
[motor.transmission]
model = "none"
[motor.drive]
node_id = 5
counts_per_rev = 4096
rated_torque_nm = 1.0
[bus]
interface = "socketcan"
channel = "vcan0"
period_s = 0.01
sdo_timeout_s = 0.5
"""


@pytest.mark.parametrize("period_s", [0.01, 0.004])
def test_python_canopens_sync_is_one_master_and_its_period_is_measured(period_s):
    bus = open_bus(SECTION)
    network = canopen.Network(bus=can.Bus(interface="socketcan", channel=CHANNEL))
    network.connect()
    source, stamps = SocketCanSource(bus), []
    try:
        network.sync.start(period_s)
        end_s = time.monotonic() + LIMIT_S
        while len(stamps) < 300 and time.monotonic() < end_s:
            source.wait(0.1)
            stamps += [frame.stamp_ns for frame in source.take() if frame.cob_id == SYNC_COB_ID]
    finally:
        network.sync.stop()
        network.disconnect()
        bus.shutdown()
    measured = measure_period(stamps[:64], 0.001)
    assert measured is not None and not measured.same
    assert measured.period_s == pytest.approx(period_s, rel=0.1)  # the kernel's own timer is 4 % slow there
    clock = SyncClock(measured.period_s)
    jumps = [clock.jump(stamp_ns) for stamp_ns in stamps]
    # The kernel's timer goes on from where it was late: time without SYNC is a gap, and no SYNC is one too many.
    assert (
        jumps.count(0) - sum(jump - 1 for jump in jumps if jump > 1) < 3
    )  # one master, as the daemon counts


def test_frames_that_the_kernel_dropped_because_nobody_read_them_are_counted():
    bus = open_bus(SECTION)
    bus.socket.setsockopt(1, 8, 4096)  # SOL_SOCKET, SO_RCVBUF: a few frames
    source = SocketCanSource(bus)
    try:
        with can.Bus(interface="socketcan", channel=CHANNEL) as other:
            for k in range(200):
                other.send(
                    can.Message(arbitration_id=0x181, data=k.to_bytes(8, "little"), is_extended_id=False)
                )
            read = len(source.take())
            other.send(can.Message(arbitration_id=0x181, is_extended_id=False))  # collides with itself
            source.wait(LIMIT_S)
            read += len(source.take())
        assert 0 < read < 201
        assert source.errors[OVERFLOW] == 201 - read
    finally:
        bus.shutdown()


@contextmanager
def slave():
    """A slave of another make: python-canopen's `LocalNode` with a drive's sheet, in its own thread."""
    network = canopen.Network(bus=can.Bus(interface="socketcan", channel=CHANNEL))
    network.connect()
    try:
        yield network, network.create_node(5, str(SHEET))
    finally:
        network.disconnect()


def answer_syncs(network, node):
    """Send every enabled TPDO at each SYNC: position 1000 + k, torque -k at the kth, packed by python-canopen."""
    node.tpdo.read()
    count = [0]

    def answer(_cob_id, _data, _stamp):
        for tpdo in (tpdo for tpdo in node.tpdo.values() if tpdo.enabled and tpdo.trans_type == 1):
            for variable in tpdo.map:
                if variable.index == 0x6064:
                    variable.raw = 1000 + count[0]
                elif variable.index == 0x6077:
                    variable.raw = -count[0]
            tpdo.transmit()
        count[0] += 1

    network.subscribe(SYNC_COB_ID, answer)


def test_another_makers_slave_is_configured_and_what_it_sends_is_decoded():
    with slave() as (network, node):
        bus = open_bus(SECTION)
        try:
            (layout,) = configure(bus, parse(JOINT))
            answer_syncs(network, node)
            assembler, decoded = Assembler((layout,), 1), []
            source = SocketCanSource(bus)

            def sampled(count):
                """Whether the slave has answered so many SYNCs."""
                frames = [frame for frame in source.take() if frame.cob_id != SYNC_COB_ID]
                decoded.extend(filter(None, [assembler.feed(frame.cob_id, frame.data) for frame in frames]))
                return len(decoded) == count

            for sync in range(1, SYNCS + 1):
                source.send(SYNC_COB_ID, b"")
                assembler.feed(SYNC_COB_ID, b"")
                until(lambda count=sync: sampled(count))
        finally:
            bus.shutdown()
    objects = {o.signal: o for tpdo in layout.tpdos for o in tpdo.objects}
    position, torque = objects[Signal.MOTOR_POSITION].scale, objects[Signal.MOTOR_TORQUE].scale
    for sample in decoded:
        k = round(sample.motor_position_rad[0] / position) - 1000
        assert sample.motor_torque_nm[0] == pytest.approx(-k * torque)
        assert k == sample.sequence
