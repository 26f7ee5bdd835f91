"""Holds what nodes say of their objects by SDO against what is in use: units as configured, values as mapped.

It takes SDO frames and SYNCs in the order of the bus, live or from a log, and decides at a SYNC: a replay
comes to the same at the same cycle. Who has asked makes no difference. The daemon asks for one object at a
time, `bus.read_back_s` apart, beside the cycle; while somebody else talks to a node by SDO nothing is asked.
An answer during the configuration may have been somebody else's, a tool may write a unit later, and a frame
of the right length may carry another object than its map says.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any

from drivelink._core import Assembler, JointPipeline
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal
from drivelink.canopen.sdo import Session
from drivelink.canopen.sdo_sniffer import SdoSniffer
from drivelink.errors import DriveError
from estimator.sample import Sample

Address = tuple[int, int]
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


@dataclass(frozen=True, slots=True)
class _Answer:
    """What a node has said of an object, and the numbers of the SYNCs before request and answer."""

    address: Address
    data: bytes
    asked: int
    answered: int


@dataclass(slots=True)
class _Node:
    """One node."""

    assembler: Assembler  # of its joint
    samples: Samples
    motor: int  # from 1 on (0: the link's)
    since: int  # the SYNC since which its frames are read as now
    units: Mapping[Address, int]  # as configured
    values: Mapping[Address, tuple[MappedObject, Pick]]  # mapped objects, and where a sample has them
    sniffer: SdoSniffer
    asked: int = -1  # the SYNC before the present request
    answers: deque[_Answer] = field(default_factory=deque)  # not judged yet
    doubts: Counter[Address] = field(default_factory=Counter)  # answers in a row that contradict
    found: Mismatch | None = None  # the value that is contradicted


class RecentSamples:
    """The last samples of a joint."""

    def __init__(self, period_s: float) -> None:
        self._samples: deque[Sample] = deque(maxlen=round(HISTORY_S / period_s))

    def add(self, sample: Sample) -> None:
        """Take the next one."""
        self._samples.append(sample)

    def after(self, sequence: int, most: int) -> list[Sample]:
        """Return the samples after a SYNC, oldest first, at most so many."""
        return list(islice((sample for sample in self._samples if sample.sequence > sequence), most))


class ObjectCheck:
    """The objects of all nodes of one bus."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._nodes: dict[int, _Node] = {}

    def watch(
        self, layout: NodeLayout, units: Mapping[Address, int], assembler: Assembler, samples: Samples
    ) -> None:
        """Begin with a node that has been configured.

        Args:
            samples: the joint's samples after a SYNC, at most so many.
        """
        node_id, before = layout.node_id, self._nodes.get(layout.node_id)
        node = self._nodes[node_id] = _Node(
            assembler=assembler,
            samples=samples,
            motor=0 if layout.motor is None else layout.motor + 1,
            since=assembler.sequence,
            units=units,
            values=_values(layout),
            sniffer=SdoSniffer(
                partial(self._watched, node_id), self._timeout_s, partial(self._take, node_id)
            ),
        )
        if before is not None and before.found is not None:
            if before.found.signal in {mapped.signal for mapped, _ in node.values.values()}:
                node.found = before.found
            else:
                assembler.contradict(node_id, False)

    def objects(self, node: int) -> list[Address]:
        """Return what can be asked of a node: values, then units."""
        return [*self._nodes[node].values, *self._nodes[node].units]

    def request(self, node: int, data: bytes, now_s: float) -> None:
        """Take an SDO frame of a master."""
        if node in self._nodes:
            self._nodes[node].asked = self._nodes[node].assembler.sequence
            self._nodes[node].sniffer.request(data, now_s)

    def response(self, node: int, data: bytes, now_s: float) -> None:
        """Take an SDO frame of a node."""
        if node in self._nodes:
            self._nodes[node].sniffer.response(data, now_s)

    def undecided(self, node: int, address: Address) -> bool:
        """Return whether an answer waits for the cycles that it is compared with."""
        return any(answer.address == address for answer in self._nodes[node].answers)

    def doubts(self, node: int, address: Address) -> int:
        """Count answers in a row that contradict what is in use."""
        return self._nodes[node].doubts[address]

    def sync(self) -> list[Mismatch]:
        """Take a SYNC, after the assemblers; return what has become sure.

        The node's frames are not used until it is configured again.
        """
        found = []
        for node_id, node in self._nodes.items():
            while node.answers and _due(node, node.answers[0]):
                answer = node.answers.popleft()
                mismatch = self._judge(node_id, node, answer)
                if mismatch is not None:
                    node.assembler.distrust(node_id)
                    found.append(mismatch)
        return found

    def contradiction(self, assembler: Assembler) -> tuple[int, Mismatch] | None:
        """Return a motor (0: the link) of a joint whose frames carry something else than it
        says, and what.
        """
        for node in self._nodes.values():
            if node.assembler is assembler and node.found is not None:
                return node.motor, node.found
        return None

    def _watched(self, node: int, index: int, subindex: int) -> bool:
        return (index, subindex) in self._nodes[node].values or (index, subindex) in self._nodes[node].units

    def _take(self, node_id: int, address: Address, data: bytes) -> None:
        node = self._nodes[node_id]
        node.answers.append(_Answer(address, data, node.asked, node.assembler.sequence))

    def _judge(self, node_id: int, node: _Node, answer: _Answer) -> Mismatch | None:
        address = answer.address
        value = node.values.get(address)
        signal = value[0].signal if value is not None else None
        text: str | None
        if address in node.sniffer.disputed:
            text = f"{_name(address)} has two different answers: does another device answer for it?"
        elif value is not None:
            text = _value_text(node, value, answer)
        else:
            text = _unit_text(node.units[address], answer)
        if text is None:
            return None
        if not text:
            del node.doubts[address]
            if value is not None and node.found is not None and node.found.signal is signal:
                node.found = None
                node.assembler.contradict(node_id, False)
            return None
        node.doubts[address] += 1
        if node.doubts[address] != _SURE or node.found is not None:
            return None
        mismatch = Mismatch(node_id, f"node {node_id}: {text}", signal)
        if value is not None:
            node.found = mismatch
            node.assembler.contradict(node_id, True)
        return mismatch


def _due(node: _Node, answer: _Answer) -> bool:
    return node.assembler.sequence > answer.answered + _AROUND


def _unit_text(configured: int, answer: _Answer) -> str:
    """What an answer contradicts; empty: nothing."""
    number = int.from_bytes(answer.data, "little")
    if number == configured:
        return ""
    return f"{_name(answer.address)} was {configured} when it was configured, it is {number} now"


def _value_text(node: _Node, value: tuple[MappedObject, Pick], answer: _Answer) -> str | None:
    """What an answer contradicts; empty: nothing; None: there is too little to be compared."""
    (mapped, pick), data = value, answer.data
    size, before = (mapped.bits + 7) // 8, max(answer.asked - _AROUND - 1, node.since)
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
    return f"its frames carry {low:.0f} to {high:.0f} as {_name(answer.address)}, by SDO it is {count}"


def _name(address: Address) -> str:
    return f"0x{address[0]:04X}:{address[1]:02X}"


def _values(layout: NodeLayout) -> dict[Address, tuple[MappedObject, Pick]]:
    """What a sample has of a node's frames."""
    motor = layout.motor or 0
    picks: dict[Signal, Pick] = {
        Signal.MOTOR_POSITION: lambda sample: sample.motor_position_rad[motor],
        Signal.MOTOR_TORQUE: lambda sample: sample.motor_torque_nm[motor],
        Signal.MOTOR_VELOCITY: lambda sample: sample.motor_velocity_rad_s[motor],
        Signal.LINK_POSITION: lambda sample: sample.link_position_rad,
    }
    mapped = [mapped for tpdo in layout.tpdos for mapped in tpdo.objects if mapped.signal in picks]
    return {one.address: (one, picks[one.signal]) for one in mapped}


Ask = Callable[[int, Address], Session[bytes]]

_FIRST_S = 0.05  # between two questions to a node that has just been configured, or that is doubted
_CLOSELY = 3  # questions for one doubted object that follow each other so
_FOREIGN_S = 10.0  # of silence after an answer to somebody else's request


@dataclass(frozen=True, slots=True)
class _Question:
    """One object of a node."""

    node: int
    address: Address
    is_unit: bool


class ReadBack:
    """The questions to all nodes of one bus, in turn."""

    def __init__(self, ask: Ask, period_s: float, check: ObjectCheck) -> None:
        self._ask = ask
        self._period_s = period_s
        self.check = check
        self._assemblers: dict[int, Assembler] = {}
        self._first: deque[_Question] = deque()  # new, or in doubt: not by turns
        self._values: deque[_Question] = deque()
        self._units: deque[_Question] = deque()
        self._turns = itertools.cycle((self._values, self._units))
        self._pending: tuple[_Question, Session[bytes]] | None = None
        self._asked = 0  # questions for the present object
        self._due_s = self._quiet_s = 0.0

    def watch(self, layout: NodeLayout, pipeline: JointPipeline) -> None:
        """A node has been configured: ask it first."""
        node, units = layout.node_id, dict(layout.reported)
        self._forget(node)
        self._assemblers[node] = pipeline.assembler
        self.check.watch(layout, units, pipeline.assembler, pipeline.history.after)
        objects = self.check.objects(node)
        self._first.extend(_Question(node, address, address in units) for address in objects)

    def _forget(self, node: int) -> None:
        for questions in (self._first, self._values, self._units):
            kept = [question for question in questions if question.node != node]
            questions.clear()
            questions.extend(kept)
        if self._pending is not None and self._pending[0].node == node:
            self._pending = None
        self._asked = 0

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take an SDO frame of a node, or of somebody else who asks it."""
        if self._pending is None or self._pending[1].done or cob_id != 0x580 + self._pending[0].node:
            self._quiet_s = now_s + _FOREIGN_S
            return
        self._pending[1].feed(cob_id, data, now_s)

    def step(self, now_s: float) -> None:
        """Let time pass."""
        if self._pending is None:
            if now_s >= max(self._due_s, self._quiet_s):
                self._begin(now_s)
            return
        question, session = self._pending
        if not session.poll(now_s) or self.check.undecided(question.node, question.address):
            return
        try:
            answered = bool(session.result)
        except DriveError:  # it is busy, or has no such object any more: that says nothing
            answered = False
        if not answered or not self.check.doubts(question.node, question.address):
            self._move_on(question, now_s)
            return
        self._pending = None
        self._due_s = now_s + (_FIRST_S if self._asked < _CLOSELY else self._period_s)

    def contradiction(self, assembler: Assembler) -> dict[str, Any] | None:
        """Return what is contradicted of one joint, as `jointwatch.contradiction` gives it;
        None: nothing.
        """
        contradicted = self.check.contradiction(assembler)
        if contradicted is None:
            return None
        motor, found = contradicted
        return {
            "signal": str(found.signal),
            "motor": motor,
            "reason": "contradicted",
            "amount": None,
            "std": None,
            "explains": True,
            "text": found.text,
        }

    def _begin(self, now_s: float) -> None:
        if not self._first:
            turn = next(self._turns)
            if not turn:
                return
            self._first.append(turn.popleft())
        question = self._first[0]
        if question.node in self._assemblers[question.node].untrusted:
            self._move_on(question, now_s)
            return
        session = self._ask(question.node, question.address)
        self._pending = question, session
        self._asked += 1
        session.poll(now_s)

    def _move_on(self, question: _Question, now_s: float) -> None:
        """The next question: soon, where a configuration has still to be confirmed."""
        self._pending, self._asked = None, 0
        self._first.popleft()
        (self._units if question.is_unit else self._values).append(question)
        self._due_s = now_s + (_FIRST_S if self._first else self._period_s)
