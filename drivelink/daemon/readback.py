"""Asks running nodes by SDO for what is in use: units as configured, values as their frames carry them.

An answer during the configuration may have been somebody else's, a tool may write a unit later, and a frame
of the right length may carry another object than its map says. One object at a time, `bus.read_back_s`
apart, beside the cycle; while somebody else talks to a node by SDO nothing is asked. What the answers say is
judged by `drivelink.cycle.objectcheck`.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivelink._core import Assembler, JointPipeline
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.sdo import Session
from drivelink.cycle.objectcheck import ObjectCheck
from drivelink.errors import DriveError

Address = tuple[int, int]
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
    """The questions to all nodes of one bus, in turn.

    Args:
        ask: begins to read an object of a node.
    """

    def __init__(self, ask: Ask, period_s: float, check: ObjectCheck) -> None:
        self._ask = ask
        self._period_s = period_s
        self.check = check  # as given
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
        """Return what is contradicted of one joint, as `crosschecks.contradiction` gives it;
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
