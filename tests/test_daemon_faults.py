"""What a bus does to a daemon, cycle by cycle; what each fault of a list ends in is in test_fault_script."""

from collections.abc import Iterator
from itertools import pairwise

import pytest
from daemonkit import DaemonRig, Listener, rig, vsa

from estimator.sample import Estimate, Status

ENOUGH = 1500  # cycles of 2 ms; every way back takes less
SOON = 100


def back(made: DaemonRig, cycles: int = 2 * ENOUGH) -> None:
    """Run on until the last estimate of some is valid."""
    assert any(valid(made.run(SOON))[-1] for _ in range(cycles // SOON))


def valid(estimates: list[Estimate]) -> list[bool]:
    return [bool(estimate.status & Status.VALID) for estimate in estimates]


@pytest.fixture(scope="module")
def settled() -> Iterator[DaemonRig]:
    """Past the estimator's start, for one fault after the other."""
    with rig(vsa(bus="period_s = 0.002")) as one:
        yield one


@pytest.fixture
def made(settled: DaemonRig) -> DaemonRig:
    back(settled)
    settled.forget()
    assert settled.status["state"] == "running"
    return settled


def test_every_cycle_has_an_estimate_in_order_and_a_counter_on_sync_is_made_where_it_is_asked_for():
    with rig(vsa(bus="sync_counter_overflow = 10")) as made:
        seen: list[bytes] = []
        inner = made.network.sync_filter
        made.network.sync_filter = lambda data: (seen.append(data), inner(data))[1]
        estimates = made.run(500)
        assert [data[0] for data in seen] == [k % 10 + 1 for k in range(500)]
        assert [estimate.sequence for estimate in estimates] == list(range(500))
        stamps = [stamp for _, stamp in made.collector.estimates]
        assert {b - a for a, b in pairwise(stamps)} == {1_000_000}
        status = made.status
        assert (status["estimates"], status["missed_cycles"]) == (500, 0)
        assert set(status["nodes"]) == {"1", "2", "3"}
        assert made.events == []


def test_cycles_lost_by_a_slow_machine_are_said_in_words_once():
    with rig() as made:
        made.run(50)
        made.daemon.loop.overruns += 3  # as the pacing counts them
        made.run(100)
        slow = "this machine does not keep up with the cycle of 1 ms (drivelink doctor says why): cycles left out so far: 3"
        assert slow in made.events
        made.run(2000)
        assert "this machine keeps up with the cycle again; cycles left out: 3" in made.events


def test_a_drive_that_takes_the_start_and_does_not_run_is_said_once(made):
    node = made.node(2)
    take = node.nmt
    node.nmt = lambda command: None if command == 0x01 else take(command)
    made.faults.reboot(node)
    assert not any(valid(made.run(ENOUGH))[2:])
    said = [text for text in made.events if "was started, but sends none of its frames" in text]
    assert said == [
        "node 2 is configured and was started, but sends none of its frames; it says pre-operational"
    ]
    node.nmt = take
    back(made)
    made.run(SOON)
    assert made.status["state"] == "running"
    assert made.status["conditions"] == []


def test_a_node_that_could_not_be_configured_and_goes_on_as_it_was_is_no_lasting_problem(made):
    heartbeat = made.node(2).heartbeat
    heartbeat._period.value = 0
    heartbeat.restart()
    made.faults.refuse_sdo(made.node(2), 0x08000022, 10_000)
    made.run(4000 + ENOUGH)
    made.faults.refuse_sdo(made.node(2), 0x08000022, 0)
    assert any("node 2 cannot be configured" in text for text in made.events)
    assert made.run(1)[0].status & Status.VALID
    assert not any("cannot be configured" in text for text in made.status["conditions"])
    made.faults.reboot(made.node(2))
    back(made)


@pytest.mark.parametrize("able", [True, False])
def test_a_node_that_goes_on_without_its_heartbeat_is_configured_again_once(made, able, monkeypatch):
    """As one in whose place another device with its number was configured."""
    heartbeat = made.node(2).heartbeat
    heartbeat._period.value = 0
    heartbeat.restart()
    if not able:
        monkeypatch.setattr(heartbeat._period, "changed", lambda: None)
    made.run(2 * ENOUGH if able else 4000 + ENOUGH)
    said = [text for text in made.events if text.startswith("node 2")]
    assert sum("is configured again" in text for text in said) == 1
    assert (said[-1] == "node 2: heartbeat is back") == able
    assert made.run(1)[0].status & Status.VALID


def test_a_second_reboot_begins_the_configuration_anew_and_what_goes_wrong_in_it_is_that_nodes_own(
    made, monkeypatch
):
    made.run(1000)  # enough is learned to hold blocks after a reboot against
    before = made.status["nodes"]["2"]["reboots"]
    made.faults.reboot(made.node(2))
    for _ in range(3):
        made.run(8)
        assert made.daemon.pipelines[0].assembler.untrusted == (2,)
        made.faults.reboot(made.node(2))
    back(made)
    assert made.status["nodes"]["2"]["reboots"] == before + 4

    def broken(*_: object, **__: object) -> None:
        raise OverflowError("int too large to convert to float")

    monkeypatch.setattr("drivelink.canopen.node.offer", broken)
    made.faults.reboot(made.node(1))
    assert len(made.run(750)) >= 749  # a cycle that lacks a frame is concluded with the next SYNC
    said = "node 1 cannot be configured: node 1: OverflowError in its configuration: int too large"
    assert said in " ".join(made.events)
    monkeypatch.undo()
    back(made)  # and until motion has shown its zero


def bunches(made: DaemonRig, listener: Listener, count: int) -> list[str]:
    """One frame of node 2 is missing, and two more than one come afterwards; what is said of that."""
    before = made.status["nodes"]["2"]["conflicting"]
    number, cob_id = made.tpdo(2)
    for k in range(count):
        made.faults.mute(made.node(2), number)
        made.run(2)
        listener.send(cob_id, bytes([k % 100] * 8))
        listener.send(cob_id, bytes([k % 100 + 101] * 8))
        made.run(8)
    assert made.status["nodes"]["2"]["conflicting"] >= before + count / 2
    return [event for event in made.events if "used" in event]


def test_frames_in_bunches_are_no_second_device_and_stopped_nodes_are_woken_before_they_are_asked(made):
    listener = Listener(made.joint)
    assert bunches(made, listener, 10) == []
    made.run(750)
    assert not [event for event in made.events if "used" in event]
    (said,) = bunches(made, listener, 75)  # 1.5 s of it
    assert said.startswith("node 2: some frames are missing, others come several in one cycle")
    made.run(750)
    assert not made.status["conditions"]
    # Nodes that somebody stopped are woken before they are asked.
    listener.send(0x000, b"\x02\x00")
    back = next(k for k, e in enumerate(made.run(1500)[50:]) if not e.status & Status.STALE)
    listener.close()
    # Silence of half a second, and no SDO timeout (0.2 s each time) for any of the three.
    assert back < 400


@pytest.mark.parametrize("segment_bytes", [7, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, 1))])
def test_a_drive_that_answers_sdo_without_end_harms_itself_only(made, segment_bytes):
    missing = made.status["nodes"]["1"]["missing"]
    made.faults.endless_sdo(made.node(2), segment_bytes)
    made.faults.reboot(made.node(2))
    made.run(3000)
    cannot = [text for text in made.events if text.startswith("node 2 cannot be configured: ")]
    assert cannot
    assert len(made.run(100)) == 100  # the loop goes on, and says that these are stale
    assert made.status["nodes"]["1"]["missing"] == missing
    made.faults.endless_sdo(made.node(2), -1)
    back(made)


def test_a_reading_that_jumps_while_its_frames_come_late_is_late_and_else_it_jumps():
    with rig() as made:
        made.run(2500)
        node = made.node(1)
        for late in (False, True):
            if late:
                made.faults.delay(node, made.tpdo(1)[0], 1)
                made.run(100)
            made.faults.misread(node, lambda s: s._replace(position_counts=s.position_counts + 10**5))
            made.run(3)
            suspected = made.status["suspected"]
            assert (suspected["signal"], suspected["motor"]) == ("motor_position", 1)
            assert suspected["reason"] == ("late" if late else "jumped"), suspected
            assert ("its frames come late (node 1: frames are missing)" in suspected["text"]) is late
            made.faults.misread(node, lambda s: s)
            made.run(2500)
