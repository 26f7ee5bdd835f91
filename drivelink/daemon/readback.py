"""Asks running nodes by SDO for what is in use: units as configured, values as their frames carry them.

An answer during the configuration may have been somebody else's, a tool may write a unit later, and a frame
of the right length may carry another object than its map says. One object at a time, `bus.read_back_s`
apart, beside the cycle; while somebody else talks to a node by SDO nothing is asked.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from drivelink._core import JointPipeline
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal
from drivelink.canopen.sdo import Session
from drivelink.errors import DriveError
from estimator.sample import Sample

__all__ = ["Ask", "Mismatch", "ReadBack"]

Address = tuple[int, int]
Ask = Callable[[int, Address], Session[bytes]]

_FIRST_S = 0.05  # between two questions to a node that has just been configured, or that is doubted
_AROUND = 20  # cycles before a request and after its answer: a value of these is one of that time
_ROUNDING = 2.0  # counts
_SURE = 3  # answers in a row that contradict what is in use
_FOREIGN_S = 10.0  # of silence after an answer to somebody else's request


@dataclass(frozen=True, slots=True)
class Mismatch:
    """A node says something else than what is in use: which node, what, and the signal, if it is mapped."""

    node: int
    text: str
    signal: Signal | None


@dataclass(frozen=True, slots=True)
class _Question:
    """One object: a unit with its number, or a mapped object and where a sample has it."""

    node: int
    address: Address
    number: int = 0
    mapped: MappedObject | None = None
    pick: Callable[[Sample], float] | None = None

    @property
    def name(self) -> str:
        return f"0x{self.address[0]:04X}:{self.address[1]:02X}"

    @property
    def signal(self) -> Signal | None:
        return self.mapped.signal if self.mapped is not None else None


@dataclass(frozen=True, slots=True)
class _Watched:
    """A node's joint; its motor, from 1 on (0: the link's); since which SYNC its frames are read as now."""

    pipeline: JointPipeline
    motor: int
    since: int


@dataclass(slots=True)
class _Pending:
    """A question under way: its SDO transfer, then the cycles after its answer."""

    question: _Question
    session: Session[bytes]
    asked: int  # number of the SYNC
    answered: int = -1
    data: bytes = b""


class ReadBack:
    """The questions to all nodes of one bus, in turn.

    Args:
        ask: begins to read an object of a node.
        period_s: between two questions.
    """

    def __init__(self, ask: Ask, period_s: float) -> None:
        self._ask = ask
        self._period_s = period_s
        self._nodes: dict[int, _Watched] = {}
        self._first: deque[_Question] = deque()  # new, or in doubt: not by turns
        self._values: deque[_Question] = deque()
        self._units: deque[_Question] = deque()
        self._turns = itertools.cycle((self._values, self._units))
        self._doubts: Counter[tuple[int, Address]] = Counter()  # answers in a row against what is in use
        self._pending: _Pending | None = None
        self._due_s = self._quiet_s = 0.0
        self._contradicted: dict[int, Mismatch] = {}  # nodes whose frames carry something else than is mapped

    def watch(self, layout: NodeLayout, pipeline: JointPipeline) -> None:
        """A node has been configured: ask it first."""
        node, motor = layout.node_id, 0 if layout.motor is None else layout.motor + 1
        self._forget(node)
        self._nodes[node] = _Watched(pipeline, motor, pipeline.assembler.sequence)
        values = list(_values(layout))
        units = [_Question(node, address, number) for address, number in layout.reported]
        self._first.extend(values + units)
        found = self._contradicted.get(node)
        if found is not None and found.signal not in {question.signal for question in values}:
            self._clear(node)

    def _forget(self, node: int) -> None:
        for questions in (self._first, self._values, self._units):
            kept = [question for question in questions if question.node != node]
            questions.clear()
            questions.extend(kept)
        for key in [key for key in self._doubts if key[0] == node]:
            del self._doubts[key]
        if self._pending is not None and self._pending.question.node == node:
            self._pending = None

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take an SDO frame of a node, or of somebody else who asks it."""
        pending = self._pending
        if pending is None or pending.answered >= 0 or cob_id != 0x580 + pending.question.node:
            self._quiet_s = now_s + _FOREIGN_S
            return
        pending.session.feed(cob_id, data, now_s)

    def step(self, now_s: float) -> Mismatch | None:
        """Let time pass; what has been found, when it is sure."""
        pending = self._pending
        if pending is None:
            if now_s >= max(self._due_s, self._quiet_s):
                self._begin(now_s)
            return None
        sequence = self._nodes[pending.question.node].pipeline.assembler.sequence
        if pending.answered < 0:
            if not pending.session.poll(now_s):
                return None
            try:
                pending.data = pending.session.result
            except DriveError:  # it is busy, or has no such object any more: that says nothing
                self._move_on(pending.question, now_s)
                return None
            pending.answered = sequence
        if pending.question.mapped is not None and sequence < pending.answered + _AROUND:
            return None
        return self._conclude(pending.question, self._against(pending), now_s)

    def contradiction(self, pipeline: JointPipeline) -> dict[str, Any] | None:
        """What is contradicted of one joint, as `crosschecks.contradiction` gives it; None: nothing."""
        for node, found in self._contradicted.items():
            if self._nodes[node].pipeline is pipeline:
                return {
                    "signal": str(found.signal),
                    "motor": self._nodes[node].motor,
                    "reason": "contradicted",
                    "amount": None,
                    "std": None,
                    "explains": True,
                    "text": found.text,
                }
        return None

    def _begin(self, now_s: float) -> None:
        if not self._first:
            turn = next(self._turns)
            if not turn:
                return
            self._first.append(turn.popleft())
        question = self._first[0]
        assembler = self._nodes[question.node].pipeline.assembler
        if question.node in assembler.untrusted:
            self._move_on(question, now_s)
            return
        session = self._ask(question.node, question.address)
        self._pending = _Pending(question, session, assembler.sequence)
        session.poll(now_s)

    def _move_on(self, question: _Question, now_s: float) -> None:
        """The next question: soon, where a configuration has still to be confirmed."""
        self._pending = None
        self._first.popleft()
        (self._units if question.mapped is None else self._values).append(question)
        self._due_s = now_s + (_FIRST_S if self._first else self._period_s)

    def _conclude(self, question: _Question, against: str, now_s: float) -> Mismatch | None:
        node, key = question.node, (question.node, question.address)
        signal = question.signal
        found = self._contradicted.get(node)
        if not against:
            del self._doubts[key]
            if found is not None and found.signal is signal:
                self._clear(node)
            self._move_on(question, now_s)
            return None
        self._pending = None
        self._doubts[key] += 1
        self._due_s = now_s + (_FIRST_S if self._doubts[key] < _SURE else self._period_s)
        if self._doubts[key] != _SURE or found is not None:
            return None
        finding = Mismatch(node, f"node {node}: {against}", signal)
        if signal is not None:
            self._contradicted[node] = finding
            self._nodes[node].pipeline.assembler.contradict(node, True)
        return finding

    def _clear(self, node: int) -> None:
        del self._contradicted[node]
        self._nodes[node].pipeline.assembler.contradict(node, False)

    def _against(self, pending: _Pending) -> str:
        """What an answer contradicts; empty: nothing."""
        question, data = pending.question, pending.data
        if question.mapped is None or question.pick is None:
            number = int.from_bytes(data, "little")
            if number == question.number:
                return ""
            return f"{question.name} was {question.number} when it was configured, it is {number} now"
        mapped, pick = question.mapped, question.pick
        size, node = (mapped.bits + 7) // 8, self._nodes[question.node]
        before = max(pending.asked - _AROUND - 1, node.since)
        samples = node.pipeline.history.after(before, pending.answered + _AROUND - before)
        places = [(pick(sample) + mapped.offset) / mapped.scale for sample in samples]
        places = [place for place in places if math.isfinite(place)]
        if len(data) < size or len(places) < _AROUND:
            return ""  # too little to be compared
        low, high = min(places), max(places)
        count = int.from_bytes(data[:size], "little", signed=mapped.signed)
        off = count - 0.5 * (low + high)
        if mapped.wraps:
            off = math.remainder(off, mapped.modulus or 2**mapped.bits)
        if abs(off) <= 1.5 * (high - low) + _ROUNDING:
            return ""
        return f"its frames carry {low:.0f} to {high:.0f} as {question.name}, by SDO it is {count}"


def _values(layout: NodeLayout) -> Iterator[_Question]:
    """What a sample has of a node's frames."""
    motor = layout.motor or 0
    picks: dict[Signal, Callable[[Sample], float]] = {
        Signal.MOTOR_POSITION: lambda sample: sample.motor_position_rad[motor],
        Signal.MOTOR_TORQUE: lambda sample: sample.motor_torque_nm[motor],
        Signal.MOTOR_VELOCITY: lambda sample: sample.motor_velocity_rad_s[motor],
        Signal.LINK_POSITION: lambda sample: sample.link_position_rad,
    }
    for tpdo in layout.tpdos:
        for mapped in tpdo.objects:
            if mapped.signal in picks:
                address = (mapped.index, mapped.subindex)
                yield _Question(layout.node_id, address, mapped=mapped, pick=picks[mapped.signal])
