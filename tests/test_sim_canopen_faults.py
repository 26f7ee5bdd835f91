"""Faults: each does to the wire what its name says, and no more."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from simkit import StubRig, Wire, wired

from sim.canopen.drive import Cia402Drive
from sim.faults import Faults


@contextmanager
def operational() -> Iterator[tuple[Wire, Faults, Cia402Drive, Cia402Drive]]:
    """Two drives that answer each SYNC with TPDO2 alone."""
    rig = StubRig()
    first, second = Cia402Drive(1, rig, 0), Cia402Drive(2, rig, 1)
    with wired(first, second, rig=rig) as wire:
        wire.power_on()
        for node in (1, 2):
            wire.write(node, 0x1800, 1, 0xC0000180 + node, 4)
        wire.say("000 01 00")
        yield wire, Faults(wire.network), first, second


def ids(frames: list[str]) -> list[str]:
    return [frame[:3] for frame in frames]


def position(frame: str) -> int:
    return int.from_bytes(bytes.fromhex(frame[4:])[:4], "little", signed=True)


def test_without_a_fault_both_answer_every_sync() -> None:
    with operational() as (wire, _, _, _):
        for cycle in range(1, 20):
            frames = wire.say("080")
            assert ids(frames) == ["281", "282"]
            assert position(frames[0]) == 100 * cycle


def test_a_killed_drive_is_silent_and_boots_when_its_supply_returns() -> None:
    with operational() as (wire, faults, first, _):
        faults.kill(first)
        assert ids(wire.say("080")) == ["282"]
        assert wire.say("601 40 00 10 00 00 00 00 00") == []
        assert wire.say("000 82 01") == []
        faults.revive(first)
        assert wire.heard() == ["701 00"]
        assert ids(wire.say("080")) == ["282"]
        assert wire.read(1, 0x1800, 1) == 0x40000181  # power-on mapping


def test_a_drive_that_reboots_loses_its_configuration_and_says_so() -> None:
    with operational() as (wire, faults, first, _):
        faults.at(wire.network.syncs + 2, lambda: faults.reboot(first))
        assert ids(wire.say("080")) == ["281", "282"]
        assert ids(wire.say("080")) == ["701", "282"]


def test_a_muted_tpdo_leaves_out_exactly_so_many_cycles() -> None:
    with operational() as (wire, faults, first, _):
        faults.mute(first, 2, cycles=2)
        assert [ids(wire.say("080")) for _ in range(3)] == [["282"], ["282"], ["281", "282"]]


def test_a_late_tpdo_comes_after_the_next_sync_with_the_old_values() -> None:
    with operational() as (wire, faults, first, _):
        faults.delay(first, 2)
        assert ids(wire.say("080")) == ["282"]
        late, own, other = wire.say("080")
        assert ids([late, own, other]) == ["281", "281", "282"]
        assert (position(late), position(own)) == (100, 200)


def test_a_tpdo_of_wrong_length_and_one_that_comes_twice() -> None:
    with operational() as (wire, faults, first, second):
        faults.resize(first, 2, 5)
        faults.repeat(second, 2)
        frames = wire.say("080")
        assert ids(frames) == ["281", "282", "282"]
        assert len(frames[0].split()) == 1 + 5
        assert frames[1] == frames[2]
        assert len(wire.say("080")[0].split()) == 1 + 8


def test_devices_that_answer_in_the_opposite_order() -> None:
    with operational() as (wire, faults, _, _):
        faults.reverse()
        assert ids(wire.say("080")) == ["282", "281"]


def test_a_dropped_sync_is_seen_by_no_device() -> None:
    with operational() as (wire, faults, _, _):
        faults.drop_sync(2)
        assert [wire.say("080"), wire.say("080")] == [[], []]
        assert position(wire.say("080")[0]) == 100


def test_a_babbling_node_is_heard_with_every_sync_until_it_is_silenced() -> None:
    with operational() as (wire, faults, _, _):
        faults.babble(0x1AA, b"\xff" * 8, per_cycle=3)
        assert ids(wire.say("080")) == ["1AA"] * 3 + ["281", "282"]
        faults.babble(0x1AA, per_cycle=0)
        assert ids(wire.say("080")) == ["281", "282"]


def test_two_devices_with_one_node_id_both_answer() -> None:
    with operational() as (wire, faults, _, _):
        faults.impostor(Cia402Drive(1, StubRig(), 0))
        assert wire.heard() == ["701 00"]
        assert ids(wire.say("601 40 00 10 00 00 00 00 00")) == ["581", "581"]


def test_an_unanswered_sdo_request() -> None:
    with operational() as (wire, faults, first, _):
        faults.ignore_sdo(first, 1)
        assert wire.say("601 40 00 10 00 00 00 00 00") == []
        assert ids(wire.say("601 40 00 10 00 00 00 00 00")) == ["581"]


def test_an_emergency_brings_the_fault_state_until_a_rising_edge_of_bit_7() -> None:
    with operational() as (wire, faults, first, _):
        faults.emergency(first, 0x2310, 0x02, b"\x07")
        assert wire.heard() == ["081 10 23 03 07 00 00 00 00"]
        wire.say("080")
        assert wire.say("080")[0].endswith("18 02")
        assert wire.read(1, 0x603F) == 0x2310
        for word in ("80", "80"):
            heard = wire.say(f"201 {word} 00")
            assert heard == (["081 00 00 00 00 00 00 00 00"] if word == "80" and heard else [])
        assert wire.say("080")[0].endswith("50 02")


def test_a_fault_reset_needs_the_edge_and_not_the_level() -> None:
    with operational() as (wire, faults, first, _):
        wire.say("201 80 00")
        faults.emergency(first, 0x4310)
        wire.say("080")
        wire.say("201 80 00")  # bit 7 has been 1 all the time
        assert wire.say("080")[-2].endswith("18 02")
        wire.say("201 00 00")
        wire.say("201 80 00")
        assert wire.say("080")[-2].endswith("50 02")


def test_a_watched_node_that_falls_silent_ends_the_operation_of_its_watcher() -> None:
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


def test_a_refused_request_is_aborted_with_the_given_code_and_the_next_one_answered() -> None:
    with operational() as (wire, faults, first, _):
        faults.refuse_sdo(first, 0x08000022, 1)
        assert wire.say("601 40 64 60 00 00 00 00 00") == ["581 80 64 60 00 22 00 00 08"]
        assert wire.say("601 40 64 60 00 00 00 00 00")[0].startswith("581 43 64 60 00")


def test_a_cable_that_is_out_carries_nothing_either_way() -> None:
    with operational() as (wire, faults, _, _):
        faults.unplug()
        assert wire.say("080") == []
        faults.plug()
        assert ids(wire.say("080")) == ["281", "282"]
