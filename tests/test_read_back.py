"""Units and values of running nodes asked for again by SDO: a lie is found, health costs nothing."""

import itertools
import struct
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from daemonkit import Listener, rig, vsa

from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout
from drivelink.cycle.objectcheck import ObjectCheck
from drivelink.recording.canframes import FrameLog
from estimator.sample import Status

OFTEN, ROUND = "read_back_s = 0.02\nperiod_s = 0.002", 1000  # cycles: a round of all objects then, and more
CONFIRMED = 2500  # cycles: every object of three nodes has been asked for once


def forge(made, node, address, number, times):
    """Somebody else answers for this object, before the node does."""
    server = made.node(node).sdo
    left, inner = [times], server.send_response

    def send(data):
        if left[0] and data[0] & 0xE0 == 0x40 and struct.unpack_from("<HB", data, 1) == address:
            left[0] -= 1
            inner(data[:4] + number.to_bytes(4, "little"))
        inner(data)

    server.send_response = send


@contextmanager
def carrying(made, node, change):
    """Meanwhile the node's first frame carries something else."""
    tpdo = made.node(node).tpdos[made.tpdo(node)[0]]
    inner = tpdo.emit
    tpdo.emit = lambda can_id, data: inner(can_id, change(data))
    yield
    tpdo.emit = inner


def scales(made, node):
    return {o.signal: o.scale for tpdo in made.daemon.layouts[node].tpdos for o in tpdo.objects}


def uploads(made):
    found, source = [], made.daemon.loop.source
    inner = source.send
    source.send = lambda cob_id, data: (cob_id >= 0x600 and found.append((cob_id, data)), inner(cob_id, data))
    return found


def test_in_health_units_and_values_are_confirmed_and_nothing_is_said():
    with rig() as made:
        sent = uploads(made)
        estimates = made.run(CONFIRMED)
        assert not any(e.status & Status.CONTRADICTED for e in estimates)
        asked = {(cob_id - 0x600, *struct.unpack_from("<HB", data, 1)) for cob_id, data in sent}
        assert {(1, 0x6064, 0), (2, 0x6077, 0), (1, 0x6076, 0), (3, 0x6004, 0), (3, 0x6501, 0)} <= asked
        assert made.events == []
        before = len(sent)
        made.run(3000)
        assert len(sent) - before <= 2  # then one in two seconds


def test_nothing_is_asked_while_somebody_else_talks_to_a_node_or_where_it_is_not_wanted():
    with rig(vsa(bus=OFTEN)) as made:
        made.run(ROUND)
        sent, other = uploads(made), Listener(made.joint)
        other.send(0x602, bytes.fromhex("4000100000000000"))
        made.run(1250)
        other.close()
        assert len(sent) <= 1  # what was under way
    with rig(vsa(bus="read_back_s = 0")) as made:
        sent = uploads(made)
        made.run(CONFIRMED)
        assert not sent


@pytest.mark.parametrize("reboots", [True, False])
def test_one_forged_answer_changes_no_unit_and_is_not_taken_for_the_nodes_own(reboots):
    with rig(vsa(bus=OFTEN)) as made:
        made.run(ROUND)
        before = scales(made, 2)
        forge(made, 2, (0x6076, 0), 5000, times=1)
        if reboots:
            made.faults.reboot(made.node(2))
        made.run(ROUND)
        assert scales(made, 2) == before
        assert not any("cannot be configured" in text or "0x6076" in text for text in made.events)


def test_a_node_that_says_other_units_time_after_time_is_not_used():
    with rig() as made:
        made.run(200)
        entry, answers = made.node(2).dictionary.find(0x6076, 0), itertools.count(1000)
        right = entry.value

        def drift():
            entry.value = next(answers)

        entry.refresh = drift
        made.faults.reboot(made.node(2))
        estimates = made.run(3000)
        (line,) = {text for text in made.events if "cannot be configured" in text}
        assert "0x6076:00 was" in line
        assert "does another device answer for it?" in line
        assert not any(e.status & Status.VALID for e in estimates[-1000:])
        entry.refresh, entry.value = None, right
        assert any(e.status & Status.VALID for _ in range(8) for e in made.run(1000))


def test_a_unit_that_changes_in_the_run_has_the_node_configured_anew():
    with rig(vsa(bus=OFTEN)) as made:
        made.run(ROUND)
        before = scales(made, 1)[Signal.MOTOR_TORQUE]
        entry = made.node(1).dictionary.find(0x6076, 0)
        for factor in (2, 4):
            made.daemon.events._said.clear()
            entry.value = 2 * entry.value
            made.run(2 * ROUND)  # more than a round of all objects
            said = [text for text in made.events if "0x6076:00 was" in text]
            assert len(said) == factor // 2
            assert said[-1].startswith("node 1: ") and said[-1].endswith(" now: it is configured again")
            assert scales(made, 1)[Signal.MOTOR_TORQUE] == pytest.approx(factor * before)


def test_from_the_frame_on_that_writes_a_unit_nothing_is_valid_until_it_has_been_read():
    with rig() as made:
        assert made.run(1000)[-1].status & Status.VALID
        other = Listener(made.joint)
        other.send(0x602, bytes.fromhex("2f7e6000c0000000"))  # polarity: positions change their sign
        assert not any(e.status & Status.VALID for e in made.run(100))
        other.close()
        assert made.events[0] == "node 2: somebody else writes its units: it is configured again"


def test_a_frame_that_carries_another_object_than_is_mapped_is_contradicted_until_it_does():
    with rig(vsa(bus=OFTEN)) as made:
        made.run(ROUND)
        other = itertools.count(123_456, 7)
        with carrying(made, 1, lambda data: struct.pack("<i", next(other)) + data[4:]):
            made.run(ROUND)
            assert any("as 0x6064:00, by SDO it is" in text for text in made.events)
            last = made.run(500)
            assert all(e.status & Status.CONTRADICTED and not e.status & Status.VALID for e in last)
            suspected = made.status["suspected"]
        assert (suspected["signal"], suspected["motor"]) == ("motor_position", 1)
        assert suspected["reason"] == "contradicted"
        end = made.run(ROUND)
        assert not end[-1].status & Status.CONTRADICTED


def test_a_log_in_which_a_unit_changes_gives_the_samples_of_the_run(tmp_path):
    joint, path = vsa(bus=OFTEN), tmp_path / "run.log"
    listener = Listener(joint)
    with rig(joint) as made, path.open("w") as log:
        for k in range(2250):
            if k == 750:
                entry = made.node(1).dictionary.find(0x6076, 0)
                entry.value = 2 * entry.value
            made.run(1)
            log.writelines(
                f"({1 + k * 2e-3:.6f}) vcan0 {i:03X}#{data.hex()}\n" for i, data in listener.frames()
            )
        assert any("0x6076:00 was" in text for text in made.events)
        live = [sample for sample, _ in made.collector.samples]
    listener.close()
    replayed = [
        cycle.sample for cycle in FrameLog(path, joint, tmp_path).cycles() if cycle.sample is not None
    ]
    assert str(replayed) == str(live)  # where a value is not known it is NaN


def test_of_an_object_that_is_read_all_the_time_one_answer_waits_to_be_judged():
    """Each was compared with forty samples: two thirds of a log's cost, and in a run somebody else's choice."""
    judged = []
    assembler = SimpleNamespace(sequence=0, contradict=lambda *_: None)
    mapped = MappedObject(signal=Signal.MOTOR_POSITION, index=0x6064, subindex=0, bits=32, signed=True)
    layout = NodeLayout(node_id=1, motor=0, tpdos=(TpdoLayout(cob_id=0x181, objects=(mapped,)),))
    check = ObjectCheck(0.5, {1: lambda *window: judged.append(window) or []})
    check.watch(layout, assembler)
    for k in range(1000):
        assembler.sequence = k
        check.request(1, bytes.fromhex("4064600000000000"), 1e-3 * k)
        check.response(1, bytes.fromhex("4364600000000000"), 1e-3 * k)
        check.sync()
    assert 40 < len(judged) < 60
