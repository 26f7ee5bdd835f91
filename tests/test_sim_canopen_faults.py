"""Faults: each does to the wire what its name says, and no more."""

from collections.abc import Callable
from contextlib import contextmanager

import pytest
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


def position(frame):
    return int.from_bytes(bytes.fromhex(frame[4:])[:4], "little", signed=True)


BOTH, SECOND = ["281", "282"], ["282"]
ASK, ANSWER = "601 40 00 10 00 00 00 00 00", ["581"]
REFUSED, ABORT = "601 40 64 60 00 00 00 00 00", ["581 80 64 60 00 22 00 00 08"]
Said = list[tuple[str, list[str]]]
# What is done to the first of two drives, then what is said on the bus (a SYNC is 080) and what is heard.
FAULTS: dict[str, tuple[Callable[[Faults, Cia402Drive], object], Said]] = {
    "none": (lambda f, d: None, [("080", BOTH)] * 3),
    "a reboot": (lambda f, d: f.at(2, lambda: f.reboot(d)), [("080", BOTH), ("080", ["701", "282"])]),
    "muted for two cycles": (lambda f, d: f.mute(d, 2, cycles=2), [("080", SECOND)] * 2 + [("080", BOTH)]),
    "the opposite order": (lambda f, d: f.reverse(), [("080", ["282", "281"])]),
    "dropped SYNCs": (lambda f, d: f.drop_sync(2), [("080", []), ("080", []), ("080", BOTH)]),
    "an unanswered SDO request": (lambda f, d: f.ignore_sdo(d, 1), [(ASK, []), (ASK, ANSWER)]),
    "a refused one": (lambda f, d: f.refuse_sdo(d, 0x08000022, 1), [(REFUSED, ABORT), (REFUSED, ANSWER)]),
    "no cable": (lambda f, d: f.unplug(), [("080", [])]),
    "and back": (lambda f, d: (f.unplug(), f.plug()), [("080", BOTH)]),
    "one node id twice": (lambda f, d: f.impostor(Cia402Drive(1, StubRig(), 0)), [(ASK, ANSWER * 2)]),
    "babble": (lambda f, d: f.babble(0x1AA, b"\xff" * 8, per_cycle=3), [("080", ["1AA"] * 3 + BOTH)]),
    "babble that ends": (
        lambda f, d: (f.babble(0x1AA, b"\xff" * 8, per_cycle=3), f.babble(0x1AA, per_cycle=0)),
        [("080", BOTH)],
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_does_what_its_name_says_and_no_more(name):
    do, said = FAULTS[name]
    with operational() as (wire, faults, first, _):
        do(faults, first)
        wire.heard()
        for text, expected in said:
            frames = wire.say(text)
            assert [f if len(e) > 3 else f[:3] for f, e in zip(frames, expected, strict=True)] == expected


def test_a_killed_drive_is_silent_and_boots_when_its_supply_returns():
    with operational() as (wire, faults, first, _):
        faults.kill(first)
        assert ids(wire.say("080")) == SECOND
        assert wire.say(ASK) == wire.say("000 82 01") == []
        faults.revive(first)
        assert wire.heard() == ["701 00"]
        assert ids(wire.say("080")) == SECOND
        assert wire.read(1, 0x1800, 1) == 0x40000181  # power-on mapping


def test_a_tpdo_that_is_late_of_wrong_length_or_comes_twice():
    with operational() as (wire, faults, first, second):
        faults.delay(first, 2)
        assert ids(wire.say("080")) == ["282"]
        late, own, other = wire.say("080")
        assert ids([late, own, other]) == ["281", "281", "282"]
        assert (position(late), position(own)) == (100, 200)  # the old values, after the next SYNC
        faults.resize(first, 2, 5)
        faults.repeat(second, 2)
        frames = wire.say("080")
        assert ids(frames) == ["281", "282", "282"] and frames[1] == frames[2]
        assert [len(frame.split()) for frame in (frames[0], wire.say("080")[0])] == [1 + 5, 1 + 8]


def test_an_emergency_brings_the_fault_state_until_a_rising_edge_of_bit_7():
    with operational() as (wire, faults, first, _):
        wire.say("201 80 00")  # so that bit 7 has been 1 all the time
        faults.emergency(first, 0x2310, 0x02, b"\x07")
        assert wire.heard() == ["081 10 23 03 07 00 00 00 00"]
        wire.say("080")
        assert wire.say("080")[0].endswith("18 02")
        assert wire.read(1, 0x603F) == 0x2310
        assert wire.say("201 80 00") == wire.say("201 00 00") == []
        assert wire.say("201 80 00") == ["081 00 00 00 00 00 00 00 00"]
        assert wire.say("080")[0].endswith("50 02")


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
