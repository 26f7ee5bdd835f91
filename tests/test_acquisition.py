"""Frames in, one sample per SYNC out: gaps, late and doubled frames, rolled-over counters, reboots."""

import random

import pytest
from canlayouts import COUNT_RAD, LINK_RAD, VSA, drive, link, pdo, vsa_cycle

from drivelink._core import LATE, Assembler
from drivelink.canopen.layout import NodeLayout, TpdoLayout
from drivelink.errors import DriveError
from estimator.sample import Sample, Status

SYNC = 0x080


def run(assembler: Assembler, frames: list[tuple[int, bytes]]) -> list[Sample]:
    return [sample for frame in frames if (sample := assembler.feed(*frame)) is not None]


def test_a_late_frame_is_counted_late_and_not_taken_for_the_next_cycles():
    assembler = Assembler(VSA, 2)
    late = vsa_cycle(0)[2]
    run(assembler, [(SYNC, b""), *vsa_cycle(0)[:2], (SYNC, b""), late])
    assert not run(assembler, vsa_cycle(1))  # somebody else's, if it comes again
    samples = run(assembler, [(SYNC, b"")])
    assert [(s.sequence, s.link_position_rad) for s in samples] == [(1, LINK_RAD)]
    assert assembler.counters[3].late == 1
    assert assembler.flags & Status.BUS_FAULT
    assert [s.sequence for s in run(assembler, vsa_cycle(2))] == [2]
    assert assembler.flags == 0


def test_frames_of_several_cycles_that_come_late_together_are_no_conflict():
    assembler = Assembler(VSA, 2)
    for k in range(3):
        run(assembler, [(SYNC, b""), *vsa_cycle(k)[:2]])
    late = [(0x183, link(100 * k)) for k in range(4)]
    (sample,) = run(assembler, [(SYNC, b""), *vsa_cycle(3)[:2], *late, (SYNC, b"")])
    (prompt,) = run(Assembler(VSA, 2), [(SYNC, b""), *vsa_cycle(3)[:2], late[3]])
    assert (sample.sequence, sample.link_position_rad) == (3, prompt.link_position_rad)
    assert assembler.flags & Status.BUS_FAULT
    assert (assembler.counters[3].late, assembler.counters[3].conflicting) == (3, 0)
    assert [s.sequence for s in run(assembler, vsa_cycle(4))] == [4]
    assert assembler.flags == 0


def test_while_late_frames_are_still_to_come_none_is_believed_without_a_flag():
    assembler = Assembler(VSA, 2)
    run(assembler, [(SYNC, b""), *vsa_cycle(0)[:2], (SYNC, b""), *vsa_cycle(1)[:2]])
    # Two are owed; one of them comes late and alone, so what follows may be one cycle late as well.
    run(assembler, [(SYNC, b""), *vsa_cycle(2)[:2], vsa_cycle(0)[2], vsa_cycle(1)[2]])
    assert assembler.counters[3].late == 1
    run(assembler, [(SYNC, b"")])
    assert assembler.flags & Status.BUS_FAULT
    (sample,) = run(assembler, [*vsa_cycle(3)[:2], vsa_cycle(2)[2], vsa_cycle(3)[2], (SYNC, b"")])
    assert sample.sequence == 3
    assert assembler.counters[3].late == 2
    assert assembler.flags & Status.BUS_FAULT
    assert [s.sequence for s in run(assembler, vsa_cycle(4))] == [4]
    assert assembler.flags == 0


@pytest.mark.parametrize("lost", [1, 5])
def test_who_repeats_himself_after_lost_frames_is_not_a_node_that_is_late(lost):
    """After SYNCs that the nodes did not see, somebody sends the same twice with the identifier of one."""
    assembler, foreign = Assembler(VSA, 2), (0x183, link(70_000))
    run(assembler, [(SYNC, b""), *vsa_cycle(0)])
    run(assembler, [(SYNC, b"")] * lost)
    given = [s for k in range(6, 60) for s in run(assembler, [(SYNC, b""), *vsa_cycle(k), foreign, foreign])]
    assert all(s.link_position_rad < 100 * LINK_RAD for s in given)
    assert assembler.counters[3].conflicting > 0


def test_a_node_that_was_configured_again_owes_nothing():
    assembler = Assembler(VSA, 2)
    for k in range(5):
        run(assembler, [(SYNC, b""), *vsa_cycle(k)[:2]])
    assembler.trust(3)
    given = [run(assembler, [(SYNC, b""), *vsa_cycle(k), (0x183, link(70_000))]) for k in range(6, 20)]
    assert assembler.counters[3].late == 1  # the sample of that cycle is flagged, and the last one
    assert not any(given[2:])
    told = [assembler.flags for k in range(20, 50) if run(assembler, [(SYNC, b""), *vsa_cycle(k)])]
    # Two answered: the one that is left may count from elsewhere.
    assert [bool(flags & Status.NODE_RESTARTED) for flags in told[:3]] == [True, False, False]


def test_samples_after_a_lost_frame_stay_flagged_until_it_cannot_be_a_late_one():
    assembler = Assembler(VSA, 2)
    run(assembler, [(SYNC, b""), *vsa_cycle(0)[:2]])
    flagged = 0
    for k in range(1, 300):
        run(assembler, [(SYNC, b""), *vsa_cycle(k)])
        flagged += bool(assembler.flags & Status.BUS_FAULT)
    assert 90 <= flagged <= 110  # _DOUBT_CYCLES = 100
    assert assembler.complete


def test_a_forged_reading_does_not_leave_the_counter_a_turn_off():
    rng = random.Random(2)
    assembler = Assembler((drive(1, 0),), 1)
    for k in range(2000):
        assembler.feed(SYNC, b"")
        if k % 3 == 0:
            assembler.feed(0x701, b"\x00")  # as if it had rebooted: the forged reading is the first
            assembler.feed(0x000, b"\x01\x01")
        assembler.feed(0x181, pdo(rng.randint(-(2**31), 2**31 - 1)))
        assembler.feed(SYNC, b"")
        assembler.feed(0x181, pdo(1000 + k))
        sample = assembler.feed(SYNC, b"")
        assert sample is None or sample.motor_position_rad[0] == (1000 + k) * COUNT_RAD


@pytest.mark.parametrize(("silent", "lost"), [(10, False), (11, True)])
def test_a_node_that_was_not_heard_for_a_while_may_count_from_elsewhere(silent, lost):
    assembler = Assembler(VSA, 2, active=False, hold_periods=10)
    run(assembler, [(SYNC, b""), *vsa_cycle(0)])
    assert not assembler.flags & Status.NODE_RESTARTED  # the first sample is none after a silence
    run(assembler, [(SYNC, b"")] * silent)
    found = []
    for k in range(3):
        run(assembler, [(SYNC, b""), *vsa_cycle(k)])
        found.append(bool(assembler.flags & Status.NODE_RESTARTED))
    assert any(found) == lost and sum(found) <= 1


@pytest.mark.parametrize("tpdos", [(TpdoLayout(cob_id=0x183, transmission_type=1, objects=()),), ()])
def test_a_layout_that_cannot_be_is_refused_in_a_line_and_changes_nothing(tpdos):
    assembler = Assembler(VSA, 2)
    with pytest.raises(DriveError):  # another node's identifier; nothing that carries the motor's position
        assembler.relayout(NodeLayout(node_id=2, motor=1, tpdos=tpdos))
    (sample,) = run(assembler, [(SYNC, b""), *vsa_cycle(7)])
    assert sample.motor_position_rad == (7 * COUNT_RAD, -7 * COUNT_RAD)
    assert sample.link_position_rad == 7 * LINK_RAD
    with pytest.raises(DriveError, match="motor 2: no TPDO carries its position"):
        Assembler((drive(1, 0),), 2)
    with pytest.raises(DriveError, match="COB-ID 0x181 is used by two"):
        Assembler((drive(1, 0), drive(1, 1)), 2)


def test_every_second_sync_gives_every_second_sample():
    assembler = Assembler((drive(1, 0, transmission_type=2), drive(2, 1)), 2)
    given = []
    for k in range(20):
        frames = [(SYNC, b""), (0x182, pdo(k))] + ([(0x181, pdo(k))] if k % 2 == 0 else [])
        given += [s.sequence for s in run(assembler, frames)]
        assert assembler.missed == -1
    assert given == list(range(0, 20, 2))


def test_an_event_driven_value_is_held_while_its_node_is_alive_and_no_longer():
    assembler = Assembler((drive(1, 0, transmission_type=255), drive(2, 1)), 2, hold_periods=10)
    assembler.feed(SYNC, b"")
    assembler.feed(0x181, pdo(42))
    given = []
    for k in range(40):
        if k < 20 and k % 5 == 0:
            assembler.feed(0x701, b"\x05")
        given += [s.sequence for s in run(assembler, [(SYNC, b""), (0x182, pdo(k))])]
    assert given[0] == 1
    assert given[-1] in range(24, 28)  # last heartbeat before cycle 16, then ten periods


def test_all_event_driven_nodes_give_the_sample_at_the_end_of_the_cycle():
    assembler = Assembler((drive(1, 0, transmission_type=255),), 1)
    run(assembler, [(SYNC, b""), (0x181, pdo(1)), (0x181, pdo(2))])
    sample = assembler.feed(SYNC, b"")
    assert sample is not None
    assert (sample.sequence, sample.motor_position_rad[0]) == (0, 2 * COUNT_RAD)
    assert assembler.counters[1].duplicate == 0


def test_the_answers_to_a_late_sync_are_of_no_sample_and_spoil_none():
    assembler = Assembler(VSA, 2)
    frames = [(SYNC, b""), *vsa_cycle(1)]
    assert len(run(assembler, frames)) == 1
    for jump, samples in ((2, 1), (LATE, 0), (1, 1), (1, 1)):
        found = [assembler.feed(SYNC, b"", jump), *(assembler.feed(*frame) for frame in vsa_cycle(2))]
        assert sum(sample is not None for sample in found) == samples
        assert assembler.flags == 0
    assert assembler.sequence == 4
