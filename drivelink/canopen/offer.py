"""Objects of a node that carry each signal."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivelink.canopen.layout import MappedObject, Signal
from drivelink.notice import Notice, Severity


@dataclass(slots=True, kw_only=True)
class Offer:
    """What a node can give."""

    # for each signal the objects that can give it, best first
    candidates: dict[Signal, tuple[MappedObject, ...]] = field(default_factory=dict)
    # the same for cross-checks: not mapped, but read if the node maps them
    checks: dict[Signal, tuple[MappedObject, ...]] = field(default_factory=dict)
    missing: dict[Signal, str] = field(default_factory=dict)  # for a signal with no candidate, why
    notices: list[Notice] = field(default_factory=list)  # disagreements and remarks

    @property
    def readable(self) -> dict[Signal, tuple[MappedObject, ...]]:
        """All objects for decoding, candidates first."""
        rest = {signal: objects for signal, objects in self.checks.items() if signal not in self.candidates}
        return {**self.candidates, **rest}

    def say(self, severity: Severity, subject: str, text: str, fix: str = "") -> None:
        """Add a remark."""
        self.notices.append(Notice(severity=severity, subject=subject, text=text, fix=fix))
