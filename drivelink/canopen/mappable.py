"""Objects of a node that carry each signal, with all data to map and decode them."""

from __future__ import annotations

from dataclasses import dataclass, field

from drivelink.canopen.layout import MappedObject, Signal
from drivelink.notice import Notice

Address = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class MappableObject:
    """An object that carries a signal, with all data to decode it."""

    signal: Signal
    address: Address
    bits: int
    signed: bool
    scale: float
    wraps: bool = False
    offset: float = 0.0
    modulus: int = 0

    def mapped(self, bits: int | None = None) -> MappedObject:
        """The object as part of a TPDO."""
        return MappedObject(
            signal=self.signal,
            index=self.address[0],
            subindex=self.address[1],
            bits=self.bits if bits is None else bits,
            signed=self.signed,
            scale=self.scale,
            wraps=self.wraps,
            offset=self.offset,
            modulus=self.modulus,
        )


@dataclass(slots=True, kw_only=True)
class Offer:
    """What a node can give.

    Attributes:
        candidates: for each signal the objects that can give it, best first.
        checks: the same for cross-checks: not mapped, but read if the node maps them.
        missing: for a signal with no candidate, why.
        notices: disagreements and remarks.
    """

    candidates: dict[Signal, tuple[MappableObject, ...]] = field(default_factory=dict)
    checks: dict[Signal, tuple[MappableObject, ...]] = field(default_factory=dict)
    missing: dict[Signal, str] = field(default_factory=dict)
    notices: list[Notice] = field(default_factory=list)

    @property
    def readable(self) -> dict[Signal, tuple[MappableObject, ...]]:
        """All objects for decoding, candidates first."""
        rest = {signal: objects for signal, objects in self.checks.items() if signal not in self.candidates}
        return {**self.candidates, **rest}
