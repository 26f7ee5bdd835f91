"""Foreign peers on a real SocketCAN, at rates that an emulated kernel carries."""

import time

import can
import canopen
import pytest

from drivelink._core import SYNC_COB_ID
from drivelink.canopen.bus import interface_is_up, open_bus
from drivelink.cycle.framesource import OVERFLOW
from drivelink.cycle.socketcan import SocketCanSource
from drivelink.cycle.syncclock import SyncClock, measure_period
from drivelink.jointfile import BusSection

CHANNEL = "vcan0"
pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not interface_is_up(CHANNEL), reason="no SocketCAN interface vcan0 here"),
]
SECTION = BusSection(interface="socketcan", channel=CHANNEL)


@pytest.mark.parametrize("period_s", [0.01, 0.004])
def test_python_canopens_sync_is_one_master_and_its_period_is_measured(period_s: float) -> None:
    bus = open_bus(SECTION)
    network = canopen.Network(bus=can.Bus(interface="socketcan", channel=CHANNEL))
    network.connect()
    source, stamps = SocketCanSource(bus), []
    try:
        network.sync.start(period_s)
        end_s = time.monotonic() + 20.0
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


def test_frames_that_the_kernel_dropped_because_nobody_read_them_are_counted() -> None:
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
            other.send(can.Message(arbitration_id=0x181, is_extended_id=False))  # tells with itself
            source.wait(1.0)
            read += len(source.take())
        assert 0 < read < 201
        assert source.errors[OVERFLOW] == 201 - read
    finally:
        bus.shutdown()
