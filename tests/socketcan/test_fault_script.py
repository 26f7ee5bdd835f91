"""The fault script on a real SocketCAN: daemon, devices and a third party on vcan1, in real time."""

from contextlib import closing

import pytest
from daemonkit import vsa
from faultscript import SCRIPT
from faultstages import RealStage

from drivelink.canopen.bus import interface_is_up

CHANNEL = "vcan1"
pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not interface_is_up(CHANNEL), reason=f"no SocketCAN interface {CHANNEL} here"),
]


@pytest.fixture(scope="module")
def stage():
    with closing(RealStage(vsa(channel=CHANNEL, bus='interface = "socketcan"\nperiod_s = 0.01'))) as made:
        made.settle()
        yield made


@pytest.mark.parametrize("fault", [f for f in SCRIPT if f.where != "lockstep"], ids=lambda fault: fault.name)
def test_each_fault_is_flagged_said_once_and_survived_without_a_restart(stage, fault):
    stage.settle()
    stage.play(fault)
