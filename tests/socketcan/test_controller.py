"""The controller in the loop on SocketCAN, in lockstep: frames through the kernel, time by the SYNC."""

import controllerkit as kit
import pytest

from drivelink.canopen.bus import interface_is_up

CHANNEL = "vcan0"
pytestmark = [
    pytest.mark.socketcan,
    pytest.mark.skipif(not interface_is_up(CHANNEL), reason=f"no SocketCAN interface {CHANNEL} here"),
]


@pytest.mark.timeout(400)
def test_each_fault_ends_in_safe_torque_within_20_ms_and_the_controller_comes_back():
    with kit.running(0.2, CHANNEL) as rig:
        rig.faults.emergency(rig.network.nodes[1], 0x2310)
        assert kit.goes_safe(rig, rig.now_s) == "a drive reports a fault"
        kit.recovers(rig, 4.0)

        rig.cut = True
        assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
        rig.cut = False
        kit.recovers(rig, 4.0)

        rig.kill_daemon()
        assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
        rig.start_daemon()
        kit.recovers(rig, 8.0)
