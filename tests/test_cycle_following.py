"""A passive daemon beside a master that maps, stops, resets and starts the nodes: no sample by a wrong map."""

import time
from collections import deque

import pytest
from canopenkit import INVALID
from fuzzrun import FuzzRun

from drivelink.cycle.sources import OVERFLOW
from drivelink.recording.canframes import FrameLog
from estimator.sample import Status

START, STOP, PRE, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82
PERIOD_NS = 1_000_000
POSITION, TORQUE, STATUSWORD = 0x60640020, 0x60770010, 0x60410010


class Master:
    """Somebody else's master on the bus of a passive daemon: 1 kHz SYNC, SDO and NMT in between."""

    def __init__(self) -> None:
        self.run = FuzzRun(1, passive=True)
        self.log: list[tuple[int, int, bytes]] = []
        self.stamp_ns = 1_800_000_000 * 1_000_000_000
        self.valid: list[tuple[int, dict[str, float]]] = []  # SYNC of the nodes, and that of each value
        self.run.judge.put = self._keep  # type: ignore[method-assign]

    def _keep(self, tick) -> None:
        sample = tick.sample
        if sample is None or not tick.estimate.status & Status.VALID:
            return
        later = self.run.pipeline.assembler.sequence - sample.sequence  # given at the end of its cycle
        self.valid.append((self.run.bus.tick - later, self.run.ticks_of(sample)))

    def syncs(self, count: int) -> None:
        for _ in range(count):
            self.stamp_ns += PERIOD_NS
            self.run.bus.sync(self.stamp_ns)
            self._deliver()
        self.run.supervisor.check()

    def send(self, cob_id: int, data: bytes) -> None:
        bus = self.run.bus
        bus._queue.append((cob_id, data))
        bus._queue.extend(bus._handled(cob_id, data))
        self._deliver()

    def _deliver(self) -> None:
        self.log += [(self.stamp_ns + k, *frame) for k, frame in enumerate(self.run.bus._queue)]
        self.run.loop.receive()

    def nmt(self, command: int, node: int) -> None:
        self.send(0, bytes((command, node)))

    def write(self, node: int, index: int, subindex: int, value: int, size: int) -> None:
        head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([subindex])
        self.send(0x600 + node, head + value.to_bytes(size, "little").ljust(4, b"\0"))

    def read(self, node: int, index: int, subindex: int = 0) -> None:
        self.send(0x600 + node, b"\x40" + index.to_bytes(2, "little") + bytes([subindex]) + bytes(4))

    def map(self, node: int, number: int, *entries: int, syncs: int = 0) -> None:
        """As every master does it, with so many SYNCs after each step."""
        communication, mapping = 0x17FF + number, 0x19FF + number
        cob_id = 0x80 + 0x100 * number + node
        steps = [(communication, 1, INVALID | cob_id, 4), (communication, 2, 1, 1), (mapping, 0, 0, 1)]
        steps += [(mapping, place, entry, 4) for place, entry in enumerate(entries, start=1)]
        steps += [(mapping, 0, len(entries), 1), (communication, 1, cob_id, 4)]
        for step in steps:
            self.write(node, *step)
            self.syncs(syncs)

    @property
    def wrong(self) -> list[tuple[int, dict[str, float]]]:
        return [(tick, ticks) for tick, ticks in self.valid if set(ticks.values()) != {float(tick)}]

    @property
    def conditions(self) -> str:
        return " | ".join(self.run.events.active.values())

    def disable_others(self) -> None:
        """The TPDOs that the configuration before the start has chosen for node 2."""
        for tpdo in self.run.configurator.layouts[2].tpdos:
            self.write(2, 0x17FF + tpdo.number, 1, INVALID | tpdo.cob_id, 4)


def read_scales(master: Master) -> None:
    """What a master reads of the drives, and a passive listener takes the scales from."""
    for node in (1, 2):
        for index, subindex in ((0x608F, 1), (0x608F, 2), (0x6075, 0), (0x6076, 0), (0x60A9, 0)):
            master.read(node, index, subindex)
    for index in (0x6001, 0x6002, 0x6501, 0x6502):
        master.read(3, index)


def mapped(syncs: int = 50) -> Master:
    """Beside a passive listener that hears its configuration from the first frame on."""
    master = Master()
    read_scales(master)
    for node, entries in ((1, (POSITION, TORQUE, STATUSWORD)), (3, (0x60040020,))):
        master.nmt(PRE, node)
        master.map(node, 1, *entries)
        master.nmt(START, node)
    master.nmt(PRE, 2)
    master.disable_others()
    master.map(2, 1, POSITION, TORQUE, STATUSWORD)
    master.nmt(START, 2)
    master.syncs(syncs)
    return master


@pytest.mark.parametrize("syncs", [0, 1, 3])
@pytest.mark.parametrize("stopped_by", [PRE, STOP], ids=["pre-operational", "stopped"])
def test_a_map_that_changes_holds_from_its_sync_on(syncs, stopped_by):
    master = Master()
    read_scales(master)
    master.syncs(50)
    assert [tick for tick, _ in master.valid] == list(range(1, 51))
    master.nmt(stopped_by, 2)
    master.syncs(syncs)
    master.nmt(PRE, 2)
    master.disable_others()
    master.map(2, 1, TORQUE, STATUSWORD, POSITION, syncs=syncs)  # of the same length, in another order
    before = len(master.valid)
    assert before == 50
    master.nmt(START, 2)
    first = master.run.bus.tick + 1
    master.syncs(50)
    # After missing frames a sample is given at the end of its cycle: the last one has not come yet.
    assert [tick for tick, _ in master.valid[50:]][:49] == list(range(first, first + 49))
    assert master.wrong == []
    assert "node 2 has another mapping now" in " ".join(e["text"] for e in master.run.events.recent())


@pytest.mark.parametrize("reset", [RESET_NODE, RESET_COMMUNICATION])
@pytest.mark.parametrize("everybody", [False, True], ids=["one", "all"])
def test_after_a_reset_without_a_new_map_nothing_is_valid_and_one_line_says_what_would_settle_it(
    reset, everybody
):
    master = Master()
    master.syncs(50)
    master.nmt(reset, 0 if everybody else 1)  # its default map has identifier and length of ours, and starts
    master.nmt(START, 0)
    master.syncs(1500)
    assert len(master.valid) == 50
    assert master.wrong == []
    said = "node 1 (motor[1].drive): it has restarted, and its mapping was neither written nor read since"
    assert said in master.conditions
    assert "[[motor.drive.tpdo]] with default = true" in master.conditions


def overflow(master: Master) -> None:
    master.run.loop.source.errors[OVERFLOW] = 3
    master.run.supervisor._sync()


def another_answer(master: Master) -> None:
    """Unasked it changes nothing; beside the node's own it disputes the rated torque."""
    layout, valid = master.run.configurator.layouts[1], len(master.valid)
    lie = b"\x43\x76\x60\x00" + (7 * 800).to_bytes(4, "little")
    master.send(0x581, lie)
    master.syncs(50)
    assert len(master.valid) == valid + 50 and master.run.configurator.layouts[1] == layout
    assert "node 1: 1 SDO answers so far belong to no request" in master.run.events.recent()[-1]["text"]
    master.read(1, 0x6076)
    master.send(0x581, lie)


ENDS = {
    "another answer": (another_answer, "0x6076:00 has two different answers"),
    "block": (lambda m: m.send(0x601, b"\xc2\x00\x1a\x01" + (4).to_bytes(4, "little")), "0x1A00:01"),
    "overflow": (overflow, "frames were lost by receive overflow"),
    "boot-up": (lambda m: m.run.bus.nodes[0].reset() or m.send(0x701, b"\x00"), "it has restarted"),
}


@pytest.mark.parametrize("event", ENDS)
def test_a_block_download_to_the_mapping_lost_frames_and_a_boot_up_end_validity(event):
    happens, said = ENDS[event]
    master = mapped()
    happens(master)
    valid = len(master.valid)
    assert valid
    master.syncs(100)
    assert len(master.valid) == valid
    assert said in master.conditions


def test_a_node_that_was_not_heard_for_a_while_may_have_restarted():
    master = mapped()
    assert master.valid
    bus = master.run.bus
    for _ in range(700):
        master.stamp_ns += PERIOD_NS
        bus.sync(master.stamp_ns)
        bus._queue = deque(frame for frame in bus._queue if frame[0] & 0x7F != 1)
        master.run.loop.receive()
    valid = len(master.valid)
    master.syncs(200)
    assert len(master.valid) == valid
    assert "no frame of it was heard for 0.5 s" in master.conditions
    master.nmt(PRE, 1)
    master.map(1, 1, POSITION, TORQUE, STATUSWORD)
    master.nmt(START, 1)
    master.syncs(200)
    assert len(master.valid) > valid + 100 and not master.wrong


@pytest.mark.parametrize(("silent_s", "beats", "believed"), [(0.6, 1, 0), (3.0, 0, 0), (3.0, 30, 400)])
def test_while_nobody_is_heard_at_all_a_node_may_have_been_mapped_anew(
    silent_s, beats, believed, monkeypatch
):
    """A heartbeat tells that it was not; but one may be as old as the last SYNC."""
    master, clock, passed = mapped(), time.monotonic_ns, [0]
    monkeypatch.setattr(time, "monotonic_ns", lambda: clock() + passed[0])
    valid = len(master.valid)
    for node in (1, 2, 3) * beats:
        master.send(0x700 + node, b"\x05")
    passed[0] = round(silent_s * 1e9)
    master.stamp_ns += passed[0]
    if not believed:
        unheard = {(0x1A00, 1): TORQUE, (0x1A00, 2): STATUSWORD, (0x1A00, 3): POSITION}
        master.run.bus.nodes[1].put(unheard)
    master.syncs(400)
    assert not master.wrong and len(master.valid) - valid == believed
    assert ("no frame of it was heard for 0.5 s" in master.conditions) == (not believed)


def test_after_a_reset_a_map_that_is_read_back_is_believed():
    master = Master()
    read_scales(master)
    master.syncs(50)
    layout = master.run.configurator.layouts[2]
    master.nmt(RESET_NODE, 2)
    (tpdo,) = layout.tpdos
    entries = [o.index << 16 | o.subindex << 8 | o.bits for o in tpdo.objects]
    number = (tpdo.cob_id - 0x82) // 0x100
    stored = {(0x19FF + number, place): entry for place, entry in enumerate([len(entries), *entries])}
    communication = {(0x17FF + number, 1): tpdo.cob_id, (0x17FF + number, 2): 1}
    master.run.bus.nodes[1].put(stored | communication)  # it comes back with the map it has stored
    master.nmt(START, 2)
    master.syncs(50)
    assert len(master.valid) == 50
    for subindex in (1, 2):
        master.read(2, 0x17FF + number, subindex)
    for place in range(1, len(entries) + 1):
        master.read(2, 0x19FF + number, place)
    master.read(2, 0x19FF + number, 0)
    first = master.run.bus.tick + 1
    master.syncs(50)
    # After missing frames a sample is given at the end of its cycle: the last one has not come yet.
    assert [tick for tick, _ in master.valid[50:]][:49] == list(range(first, first + 49))
    assert master.wrong == []
    assert "mapping" not in master.conditions


def test_a_map_rewritten_while_the_node_sends_is_never_half_believed():
    master = Master()
    master.syncs(20)
    (tpdo,) = master.run.configurator.layouts[2].tpdos
    mapping = 0x19FF + (tpdo.cob_id - 0x82) // 0x100
    for place, entry in ((1, TORQUE), (2, STATUSWORD), (3, POSITION)):
        master.run.bus.nodes[1].put({(mapping, place): entry})  # a lenient node takes it at once
        head = b"\x23" + mapping.to_bytes(2, "little") + bytes([place])
        bus = master.run.bus
        bus._queue.append((0x602, head + entry.to_bytes(4, "little")))
        master.syncs(1)
        bus._queue.append((0x582, b"\x60" + head[1:] + bytes(4)))
        master.syncs(1)
    master.syncs(20)
    assert master.wrong == []


def test_a_log_gives_the_samples_of_the_live_run(tmp_path):
    master = mapped(0)
    begun = len(master.valid)
    master.syncs(100)
    master.nmt(PRE, 2)
    master.map(2, 1, TORQUE, STATUSWORD, POSITION, syncs=1)
    master.nmt(START, 2)
    master.syncs(50)
    master.nmt(RESET_NODE, 1)
    master.nmt(START, 1)
    master.syncs(50)
    master.nmt(PRE, 1)
    master.map(1, 1, POSITION, STATUSWORD, TORQUE)
    master.nmt(START, 1)
    master.syncs(600)
    assert master.wrong == []
    path = tmp_path / "passive.log"
    lines = (
        f"({stamp_ns / 1e9:.6f}) vcan0 {cob_id:03X}#{data.hex()}\n" for stamp_ns, cob_id, data in master.log
    )
    path.write_text("".join(lines))
    log = FrameLog(path, master.run.joint, tmp_path)
    replayed = [master.run.ticks_of(cycle.sample) for cycle in log.cycles() if cycle.sample is not None]
    assert replayed == [ticks for _, ticks in master.valid[begun:]]
    assert len(replayed) > 700


def test_a_node_without_heartbeat_after_its_reset_is_operational_when_it_sends(monkeypatch):
    master = Master()
    run = master.run
    monkeypatch.setattr(run.loop, "clock", lambda: master.stamp_ns)
    read_scales(master)
    master.write(2, 0x1017, 0, 50, 2)
    master.syncs(500)  # of the adopted layout's heartbeat nothing is heard
    master.nmt(RESET_NODE, 2)
    for node in run.bus.nodes:
        answer = node.answer
        monkeypatch.setattr(node, "answer", lambda tick, a=answer: [f for f in a(tick) if f[0] < 0x700])
    assert run.supervisor.node_status(run.loop.loop_joints[0])["2"]["state"] == "boot-up"
    master.syncs(100)
    master.map(2, 1, POSITION, TORQUE, STATUSWORD)
    master.nmt(START, 2)
    for _ in range(20):
        master.syncs(100)
    status = run.supervisor.node_status(run.loop.loop_joints[0])["2"]
    assert (status["state"], status["heartbeat_age_s"]) == ("operational", None)
    assert "node 2: heartbeat lost" not in master.conditions
