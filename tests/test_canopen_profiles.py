"""The configuration against the simulated drives, each with its maker's habits, in lockstep."""

import math

import can
import pytest
from canopenkit import configure, joint_text

from drivelink.canopen.guard import check_frame
from drivelink.canopen.layout import Signal
from drivelink.demo.simulate import network_from_joint
from drivelink.errors import DriveError
from drivelink.jointfile import parse
from sim.canopen.profiles import PROFILES

TEXT = joint_text(
    drive="counts_per_rev = 8192\ngear_ratio = 20.0\ntorque_constant_nm_a = 0.05\nrated_current_a = 4.0",
    link='[link.encoder]\nsource = "cia406"\nnode_id = 9\n[link.dynamics]\ninertia_kg_m2 = 0.2',
    bus="",
).replace("sdo_timeout_s = 0.02", "sdo_timeout_s = 0.2")
TEXT = TEXT.replace(
    "[motor.drive]",
    '[motor.transmission]\nmodel = "linear"\nparameters = { k_nm_rad = 100.0 }\n[motor.drive]',
)


class Watched:
    """A virtual bus that writes down what the master sends, and refuses what it must never send."""

    def __init__(self, bus):
        self.inner = bus
        self.recv = bus.recv
        self.sent = []

    def send(self, msg, timeout=None):
        check_frame(msg.arbitration_id, bytes(msg.data))
        self.sent.append((msg.arbitration_id, bytes(msg.data)))
        self.inner.send(msg, timeout)


@pytest.fixture
def rig(request):
    joint = parse(TEXT)
    with (
        can.Bus(interface="virtual", channel=request.node.name) as ours,
        can.Bus(interface="virtual", channel=request.node.name) as theirs,
    ):

        def build(quirks):
            return Watched(ours), joint, network_from_joint(joint, theirs, quirks=quirks)

        yield build


@pytest.mark.parametrize("quirks", PROFILES)
def test_every_makers_drive_is_configured_and_its_frames_decode(rig, quirks):
    bus, joint, network = rig(quirks)
    drive, encoder = configure(bus, joint, idle=network.poll)
    mapped = {mapped.signal: mapped for frame in drive.tpdos for mapped in frame.objects}
    assert {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD} <= set(mapped)
    assert mapped[Signal.MOTOR_POSITION].scale == pytest.approx(math.tau / (8192 * 20))
    assert encoder.tpdos[0].objects[0].signal is Signal.LINK_POSITION
    while bus.recv(0.0) is not None:
        pass
    lengths = {}
    for _ in range(2):  # what is asked for once a period may come with the second one
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        network.poll()
        while (message := bus.recv(0.0)) is not None:
            lengths[message.arbitration_id] = len(message.data)
    for frame in drive.tpdos + encoder.tpdos:
        assert lengths[frame.cob_id] == frame.length


@pytest.mark.parametrize(
    ("quirks", "old", "new", "said"),
    [
        ("copley", 'source = "cia406"\nnode_id = 9', "counts_per_rev = 4096",
         r"node 5 \(motor\[1\]\.drive\) gives no link_position: it has no 0x60E4:01"),
        ("epos4", "counts_per_rev = 8192\n", "", "counts_per_rev"),
    ],
)  # fmt: skip
def test_a_drive_that_lacks_something_says_what(rig, quirks, old, new, said):
    bus, _, network = rig(quirks)
    with pytest.raises(DriveError, match=said):
        configure(bus, parse(TEXT.replace(old, new)), idle=network.poll)
