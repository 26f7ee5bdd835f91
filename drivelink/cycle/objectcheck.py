"""Holds what nodes say of their objects by SDO against what is in use: units as configured, values as mapped.

It takes SDO frames and SYNCs in the order of the bus, live or from a log, and decides at a SYNC: a replay
comes to the same at the same cycle. Who has asked makes no difference. The daemon asks for one object at a
time, `bus.read_back_s` apart, beside the cycle; while somebody else talks to a node by SDO nothing is asked.
An answer during the configuration may have been somebody else's, a tool may write a unit later, and a frame
of the right length may carry another object than its map says.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count, islice
from typing import Any, NamedTuple

from drivelink._core import Assembler
from drivelink.canopen import Address
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal
from drivelink.canopen.sdo import Pause, Program, Read, SdoSniffer, Session
from drivelink.errors import DriveError
from estimator.sample import Sample

Samples = Callable[[int, int], Sequence[Sample]]
Pick = Callable[[Sample], float]

HISTORY_S = 2.0  # of samples: longer than a transfer and its surroundings; a new estimator starts from them
_AROUND = 20  # cycles before a request and after its answer: a value of these is one of that time
_ROUNDING = 2.0  # counts
_SURE = 3  # answers in a row that contradict what is in use


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A node says something else than what is in use."""

    node: int  # its id
    text: str  # what
    signal: Signal | None  # whose value differs; None: a unit


class _Answer(NamedTuple):
    """What a node has said of an object, and the numbers of the SYNCs before request and answer."""

    address: Address
    data: bytes
    asked: int
    answered: int


@dataclass(slots=True, eq=False)
class _Object:
    """One object of a node, and what it should say: as a unit its value, else what the frames carry."""

    node: int
    address: Address
    unit: int = 0  # its value when the node was configured
    mapped: tuple[MappedObject, Pick] | None = None  # where a sample has it; None: it is a unit
    doubts: int = 0  # answers in a row that contradict
    asked: int = 0  # the turn in which it was asked for last; 0: never

    @property
    def signal(self) -> Signal | None:
        """What its value means; None: it is a unit."""
        return self.mapped[0].signal if self.mapped is not None else None


@dataclass
class _Node:
    """One node; of most nobody asks an object before they are configured or started again."""

    layout: NodeLayout
    timeout_s: float
    assembler: Assembler  # of its joint
    samples: Samples
    motor: int  # from 1 on (0: the link's)
    since: int  # the SYNC since which its frames are read as now
    asked: int = -1  # the SYNC before the present request
    answers: deque[_Answer] = field(default_factory=deque)  # not judged yet
    found: Mismatch | None = None  # the value that is contradicted

    def waits(self, address: Address) -> bool:
        """Return whether an answer of an object is not judged yet."""
        return any(answer.address == address for answer in self.answers)

    @cached_property
    def objects(self) -> Mapping[Address, _Object]:
        """Values, then units."""
        return _objects(self.layout)

    @cached_property
    def sniffer(self) -> SdoSniffer:
        """Follows its transfers."""
        objects = self.objects  # not self: compiled code that holds what holds it would never be freed
        return SdoSniffer(lambda *address: address in objects, self.timeout_s)


def contradicted(
    signal: str, motor: int, text: str, amount: float | None = None, std: float | None = None
) -> dict[str, Any]:
    """Return a contradicted reading in the form of `Estimator.suspicion`."""
    said = {"signal": signal, "motor": motor, "reason": "contradicted", "amount": amount, "std": std}
    return {**said, "explains": True, "text": text}


class RecentSamples:
    """The last samples of a joint."""

    def __init__(self, period_s: float) -> None:
        self._samples: deque[Sample] = deque(maxlen=round(HISTORY_S / period_s))

    def add(self, sample: Sample) -> None:
        """Add the next one."""
        self._samples.append(sample)

    def after(self, sequence: int, most: int) -> list[Sample]:
        """Return the samples after a SYNC, oldest first, at most so many."""
        return list(islice((sample for sample in self._samples if sample.sequence > sequence), most))


class ObjectCheck:
    """The objects of all nodes of one bus.

    Args:
        timeout_s: of an SDO transfer.
        samples: by node, its joint's samples after a SYNC, at most so many.
    """

    def __init__(self, timeout_s: float, samples: Mapping[int, Samples]) -> None:
        self._timeout_s = timeout_s
        self._samples = samples
        self._nodes: dict[int, _Node] = {}

    def watch(self, layout: NodeLayout, assembler: Assembler) -> None:
        """Start checking a node that has been configured."""
        node_id, before = layout.node_id, self._nodes.get(layout.node_id)
        node = self._nodes[node_id] = _Node(
            layout=layout,
            timeout_s=self._timeout_s,
            assembler=assembler,
            samples=self._samples[node_id],
            motor=0 if layout.motor is None else layout.motor + 1,
            since=assembler.sequence,
        )
        if before is not None and before.found is not None:
            if before.found.signal in {one.signal for one in node.objects.values()}:
                node.found = before.found
            else:
                assembler.contradict(node_id, False)

    @property
    def objects(self) -> list[_Object]:
        """What can be asked for."""
        return [one for node in self._nodes.values() for one in node.objects.values()]

    def watches(self, one: _Object) -> bool:
        """Return whether its node was not configured again since."""
        return self._nodes[one.node].objects.get(one.address) is one

    def used(self, node: int) -> bool:
        """Return whether the frames of a node are used."""
        return node not in self._nodes[node].assembler.untrusted

    def undecided(self, one: _Object) -> bool:
        """Return whether an answer waits for the cycles that it is compared with."""
        return self._nodes[one.node].waits(one.address)

    def request(self, node_id: int, data: bytes, now_s: float) -> None:
        """Process an SDO frame of a master."""
        if (node := self._nodes.get(node_id)) is not None:
            node.asked = node.assembler.sequence
            node.sniffer.request(data, now_s)

    def response(self, node_id: int, data: bytes, now_s: float) -> None:
        """Process an SDO frame of a node; an object that is read all the time is judged from time to time."""
        node = self._nodes.get(node_id)
        read = node.sniffer.response(data, now_s) if node is not None else None
        if node is not None and read is not None and not node.waits(read[0]):
            node.answers.append(_Answer(*read, node.asked, node.assembler.sequence))

    def sync(self) -> list[Mismatch]:
        """Process a SYNC, after the assemblers; return what has become sure.

        The node's frames are not used until it is configured again.
        """
        found = []
        for node_id, node in self._nodes.items():
            while node.answers and node.assembler.sequence > node.answers[0].answered + _AROUND:
                if (mismatch := _judge(node, node.answers.popleft())) is not None:
                    node.assembler.distrust(node_id)
                    found.append(mismatch)
        return found

    def contradiction(self, assembler: Assembler) -> dict[str, Any] | None:
        """Return what frames of a joint carry else than its nodes say, see `contradicted`; None: nothing."""
        for node in self._nodes.values():
            if node.assembler is assembler and node.found is not None:
                return contradicted(str(node.found.signal), node.motor, node.found.text)
        return None


def _judge(node: _Node, answer: _Answer) -> Mismatch | None:
    one = node.objects[answer.address]
    text: str | None
    if one.address in node.sniffer.disputed:
        text = f"{_name(one)} has two different answers: does another device answer for it?"
    elif one.mapped is not None:
        text = _value_text(node, one, *one.mapped, answer)
    else:
        number = int.from_bytes(answer.data, "little")
        was = f"{_name(one)} was {one.unit} when it was configured"
        text = "" if number == one.unit else f"{was}, it is {number} now"
    if text is None:
        return None
    if not text:
        one.doubts = 0
        if node.found is not None and node.found.signal is one.signal:
            node.found = None
            node.assembler.contradict(one.node, False)
        return None
    one.doubts += 1
    if one.doubts != _SURE or node.found is not None:
        return None
    mismatch = Mismatch(one.node, f"node {one.node}: {text}", one.signal)
    if one.mapped is not None:
        node.found = mismatch
        node.assembler.contradict(one.node, True)
    return mismatch


def _value_text(node: _Node, one: _Object, mapped: MappedObject, pick: Pick, answer: _Answer) -> str | None:
    """Return what an answer contradicts; empty: nothing; None: there is too little to be compared."""
    data, size, before = answer.data, (mapped.bits + 7) // 8, max(answer.asked - _AROUND - 1, node.since)
    samples = node.samples(before, answer.answered + _AROUND - before)
    places = [(pick(sample) + mapped.offset) / mapped.scale for sample in samples]
    places = [place for place in places if math.isfinite(place)]
    if len(data) < size or len(places) < _AROUND:
        return None
    low, high = min(places), max(places)
    count = int.from_bytes(data[:size], "little", signed=mapped.signed)
    off = count - 0.5 * (low + high)
    if mapped.wraps:
        off = math.remainder(off, mapped.modulus or 2**mapped.bits)
    if abs(off) <= 1.5 * (high - low) + _ROUNDING:
        return ""
    return f"its frames carry {low:.0f} to {high:.0f} as {_name(one)}, by SDO it is {count}"


def _name(one: _Object) -> str:
    return f"0x{one.address[0]:04X}:{one.address[1]:02X}"


def _objects(layout: NodeLayout) -> dict[Address, _Object]:
    """Return what a sample has of a node's frames, and the units that it was configured by."""
    motor, node = layout.motor or 0, layout.node_id
    picks: dict[Signal, Pick] = {
        Signal.MOTOR_POSITION: lambda sample: sample.motor_position_rad[motor],
        Signal.MOTOR_TORQUE: lambda sample: sample.motor_torque_nm[motor],
        Signal.MOTOR_VELOCITY: lambda sample: sample.motor_velocity_rad_s[motor],
        Signal.LINK_POSITION: lambda sample: sample.link_position_rad,
    }
    carried = [mapped for tpdo in layout.tpdos for mapped in tpdo.objects if mapped.signal in picks]
    values = {one.address: _Object(node, one.address, mapped=(one, picks[one.signal])) for one in carried}
    units = {address: _Object(node, address, unit) for address, unit in layout.reported}
    return values | {address: one for address, one in units.items() if address not in values}


_FIRST_S = 0.05  # between two questions to a node that has just been configured, or that is doubted
_CLOSELY = 3  # questions for one doubted object that follow each other so
_FOREIGN_S = 10.0  # of silence after an answer to somebody else's request
_VALUE_BYTES = 8


class ReadBack:
    """Asks all nodes of one bus for their objects: new ones first, then values and units by turns.

    Args:
        run: makes the session of a program, whose requests are not repeated.
    """

    def __init__(
        self, run: Callable[[Program[None]], Session[None]], period_s: float, check: ObjectCheck
    ) -> None:
        self._period_s, self._check = period_s, check
        self._now_s = self._quiet_s = 0.0
        self._session = run(self._questions())

    def quiet(self, now_s: float) -> None:
        """Ask nothing for a while: somebody else talks to a node."""
        self._quiet_s = now_s + _FOREIGN_S

    def feed(self, node: int, data: bytes, now_s: float) -> None:
        """Process an SDO frame of a node."""
        if self._session.asks != node:
            self.quiet(now_s)
        else:
            self._session.feed(0x580 + node, data, now_s)

    def step(self, now_s: float) -> None:
        """Ask for what is due."""
        self._now_s = now_s
        self._session.poll(now_s)

    def _questions(self) -> Program[None]:
        wait_s, units = 0.0, False
        for turn in count(1):
            yield from self._wait(wait_s)
            objects = self._check.objects
            one = next((one for one in objects if not one.asked), None)
            if one is None:
                units = not units
                kind = (one for one in objects if (one.mapped is None) == units)
                one = min(kind, key=lambda one: one.asked, default=None)
            if one is not None:
                yield from self._confirm(one)
                one.asked = turn
            # Soon, where a configuration has still to be confirmed.
            wait_s = self._period_s if all(one.asked for one in self._check.objects) else _FIRST_S

    def _confirm(self, one: _Object) -> Program[None]:
        """Ask for an object until its answers are no doubt, or its node is configured again."""
        for times in count(1):
            if not self._check.used(one.node):
                return
            try:
                answer = yield Read(one.node, *one.address, most=_VALUE_BYTES)
            except DriveError:  # it is busy, or has no such object any more: that says nothing
                return
            while self._check.undecided(one):
                yield Pause(0.0)
            if not answer or not one.doubts or not self._check.watches(one):
                return
            yield from self._wait(_FIRST_S if times < _CLOSELY else self._period_s)

    def _wait(self, seconds: float) -> Program[None]:
        yield Pause(seconds)
        while self._now_s < self._quiet_s:
            yield Pause(self._quiet_s - self._now_s)
