"""The configuration against a slave of another make: python-canopen's `LocalNode` with makers' sheets."""

import time
from pathlib import Path

import can
import canopen
import pytest
from canopenkit import configure, joint_text
from test_canopen_eds import REAL, STATED, needs_real

from drivelink.canopen.layout import Signal
from drivelink.jointfile import parse

OURS = Path(__file__).parents[1] / "sim/eds/cia402-drive.eds"
# python-canopen cannot load these (encoding, duplicate key); Kollmorgen's and Faulhaber's maps are fixed,
# which a LocalNode does not know.
UNFIT = ("faulhaber", "infranor", "kollmorgen")


def configured(path, channel):
    network = canopen.Network(bus=can.Bus(interface="virtual", channel=channel))
    network.connect()
    node = network.create_node(5, str(path))
    try:
        with can.Bus(interface="virtual", channel=channel) as bus:
            text = joint_text(drive=STATED).replace("sdo_timeout_s = 0.02", "sdo_timeout_s = 0.5")
            (layout,) = configure(bus, parse(text))
        end_s = time.monotonic() + 5.0
        while node.nmt.state != "OPERATIONAL" and time.monotonic() < end_s:
            time.sleep(0.005)  # its own thread handles the NMT command
        maps = {}
        for number in (frame.number for frame in layout.tpdos):
            node.tpdo[number].read()
            maps[number] = [(variable.index, variable.subindex) for variable in node.tpdo[number].map]
        return layout, maps, node.nmt.state
    finally:
        network.disconnect()


@pytest.mark.parametrize(
    "path",
    [OURS, *(pytest.param(path, marks=needs_real) for path in REAL if not path.name.startswith(UNFIT))],
    ids=lambda path: path.name,
)
def test_another_makers_slave_ends_with_the_map_that_is_decoded(path, request):
    layout, maps, state = configured(path, request.node.name)
    given = {mapped.signal for frame in layout.tpdos for mapped in frame.objects}
    assert {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD} <= given
    for frame in layout.tpdos:
        assert maps[frame.number] == [(mapped.index, mapped.subindex) for mapped in frame.objects]
    assert state == "OPERATIONAL"
