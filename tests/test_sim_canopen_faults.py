"""Faults of devices, as a master sees them; what each fault of `sim.faults` does is seen in test_fault_script."""

from contextlib import contextmanager

from simkit import StubRig, wired

from sim.canopen.drive import Cia402Drive
from sim.faults import Faults


@contextmanager
def operational():
    """Two drives that answer each SYNC with TPDO2 alone."""
    rig = StubRig()
    first, second = Cia402Drive(1, rig, 0), Cia402Drive(2, rig, 1)
    with wired(first, second, rig=rig) as wire:
        wire.power_on()
        for node in (1, 2):
            wire.write(node, 0x1800, 1, 0xC0000180 + node, 4)
        wire.say("000 01 00")
        yield wire, Faults(wire.network), first, second


def ids(frames):
    return [frame[:3] for frame in frames]


SECOND = ["282"]
ASK = "601 40 00 10 00 00 00 00 00"


def test_a_killed_drive_is_silent_and_boots_when_its_supply_returns():
    with operational() as (wire, faults, first, _):
        faults.at(1, lambda: faults.kill(first))
        assert ids(wire.say("080")) == SECOND
        assert wire.say(ASK) == wire.say("000 82 01") == []
        faults.revive(first)
        assert wire.heard() == ["701 00"]
        assert ids(wire.say("080")) == SECOND
        assert wire.read(1, 0x1800, 1) == 0x40000181  # power-on mapping


def test_a_watched_node_that_falls_silent_ends_the_operation_of_its_watcher():
    with operational() as (wire, faults, _first, second):
        wire.write(2, 0x1017, 0, 50, 2)
        wire.write(1, 0x1016, 1, 2 << 16 | 120, 4)
        wire.write(1, 0x6060, 0, 10, 1)
        for word in ("06", "0F"):
            wire.say(f"201 {word} 00")
        wire.say("080")
        assert wire.read(1, 0x6041) & 0x6F == 0x27
        wire.wait(0.3)
        assert wire.read(1, 0x6041) & 0x6F == 0x27  # heartbeats of a sibling on the same bus count
        faults.kill(second)
        assert "081 30 81 11 02 00 00 00 00" in wire.wait(0.3)  # EMCY 0x8130, node 2
        assert ids(wire.say("080")) == []  # pre-operational (0x1029)
        assert wire.read(1, 0x6041) & 0x4F in (0x0F, 0x08)  # 0x6007 = 1: fault
        faults.revive(second)
        assert any(frame.startswith("081 00 00") for frame in wire.wait(0.1))  # the boot-up was heard
