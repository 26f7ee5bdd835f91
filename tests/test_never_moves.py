"""Nothing that the daemon puts on the wire can move a drive; and a passive one puts nothing there at all.

What is allowed is written down here once more, from CiA 301 and not from `drivelink.canopen.guard`.
"""

import threading
import time
from contextlib import closing

import pytest
from can.interfaces.virtual import VirtualBus
from daemonkit import Listener, listens, quiet_daemon, rig, running, served, vsa, vsa_text
from zenohkit import until

from drivelink.daemon.service import Daemon
from drivelink.jointfile import parse

NODES = (1, 2, 3)
HARMLESS = {0x1005, 0x1006, 0x1016, 0x1017, 0x1019, *range(0x1800, 0x1C00)}  # SYNC, heartbeat, TPDOs
MOVING = {0x6040, 0x6060, 0x6071, 0x607A, 0x60FF, 0x60B0, 0x60B1, 0x60B2, 0x60C1}  # and whatever is not above


def offence(cob_id, data):
    """What is wrong with a frame of a master that may only listen and configure; nothing if it is right."""
    if cob_id == 0x080:
        return "" if len(data) <= 1 else "SYNC with data"
    if cob_id == 0x000:
        right = len(data) == 2 and data[0] in (0x01, 0x80) and data[1] in NODES
        return "" if right else "NMT other than start and pre-operational of our nodes"
    if cob_id - 0x600 not in NODES:
        return "neither SYNC, NMT nor SDO of our nodes: an RPDO?"
    specifier, index = data[0] >> 5, int.from_bytes(data[1:3], "little")
    if specifier in (2, 3, 4):  # upload, its segments, abort
        return ""
    if specifier == 1 and data[0] & 2 and index in HARMLESS and index not in MOVING:
        return ""
    return f"SDO write to 0x{index:04X}"


# Frames that no simulated device sends: TPDOs, EMCY, SDO answers and heartbeats are theirs.
OURS = {
    0x000,
    0x080,
    *range(0x601, 0x680),
    *(b + node for b in (0x200, 0x300, 0x400, 0x500) for node in NODES),
}


def lives(made):
    """Boot, run, reboots, faults, refusals, a stop by somebody else, and the way back each time."""
    made.run(500)
    first, second, encoder = (made.node(node) for node in NODES)
    made.faults.reboot(first)
    made.run(700)
    made.faults.emergency(second, 0x2310, 0x02)
    made.run(300)
    for node in (first, second, encoder):
        made.faults.reboot(node)
    made.faults.refuse_sdo(second, 0x08000022, 60)
    made.run(2500)
    second.nmt(0x02)
    made.run(1500)
    made.faults.kill(encoder)
    made.run(700)
    made.faults.revive(encoder)
    made.run(1500)
    assert made.status["state"] == "running"


@pytest.mark.parametrize("profile", ["elmo", pytest.param("nanotec", marks=pytest.mark.slow)])
def test_through_boot_run_reboot_and_configuration_no_frame_could_move_a_drive(profile):
    joint = parse(vsa_text() + f'quirks = "{profile}"\n')
    with closing(Listener(joint)) as listener, rig(joint) as made:
        # A second TPDO number could share an identifier with these, and then this test would see nothing.
        tpdos = {t.cob_id for layout in made.daemon.layouts.values() for t in layout.tpdos}
        lives(made)
        sent = [f for f in listener.frames() if f[0] in OURS - tpdos]
        states = {made.status["nodes"][str(node)]["drive_state"] for node in (1, 2)}
    writes = [frame for frame in sent if 0x600 < frame[0] < 0x680 and frame[1][0] >> 5 == 1]
    assert len(writes) > 50  # it was configured, and more than once
    assert states == {"switch on disabled"}  # as the drives boot
    assert [f"{c:03X} {d.hex(' ')}: {offence(c, d)}" for c, d in sent if offence(c, d)] == []


def test_a_passive_daemon_puts_no_frame_on_the_bus_whatever_happens(monkeypatch):
    senders: list[tuple[object, int]] = []
    by_bus = VirtualBus.send

    def bus_send(self, msg, timeout=None):
        senders.append((self, msg.arbitration_id))
        by_bus(self, msg, timeout)

    monkeypatch.setattr(VirtualBus, "send", bus_send)
    joint = vsa(bus="period_s = 0.005")
    bus = 'period_s = 0.005\nsync = "follow"\nconfigure = false'
    guest = vsa(name="guest", channel=joint.bus.channel, bus=bus)
    with served(joint) as network:
        made: list[Daemon] = []
        starting = threading.Thread(target=lambda: made.append(quiet_daemon(guest)))
        starting.start()  # before the master configures, so that it overhears the mapping
        listens(joint, devices=1)
        with running(quiet_daemon(joint)) as master:
            starting.join(60.0)
            (follower,) = made
            with running(follower):
                assert follower.documents()[0]["bus"]["sync"] == "follow"
                loop_joint = follower.loop.loop_joints[0]
                until(lambda: loop_joint.estimates > 100)
                network.nodes[0].reset_node()
                before = loop_joint.pipeline.assembler.counters[1].received
                until(lambda: loop_joint.pipeline.assembler.counters[1].received > before + 40)
                network.power_off(network.nodes[1])
                time.sleep(0.7)
                network.power_on(network.nodes[1])
                before = loop_joint.pipeline.assembler.counters[2].received
                until(lambda: loop_joint.pipeline.assembler.counters[2].received > before + 40)
                assert follower.documents()[0]["bus"]["lost_sends"] == 0
            assert master.is_alive()
    mine = [cob_id for sender, cob_id in senders if sender is follower._port.bus]
    assert mine == []
    assert len({id(sender) for sender, _ in senders}) == 2  # the devices and the master
