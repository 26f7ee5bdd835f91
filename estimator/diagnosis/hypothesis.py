"""A model of the joint as fitted to recordings: what it contains, how simple it is, what it found."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.design_matrix import Extra, Pinned, Slot, Term
from estimator.diagnosis.frame import Corrections, Frame
from estimator.diagnosis.law_parameters import Base
from estimator.diagnosis.regression import Posterior, Regression
from estimator.effects import LIBRARY
from estimator.sample import FloatArray

__all__ = ["Fitted", "Keys"]

Keys = frozenset[tuple[str, int | None]]


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """A fitted hypothesis.

    Attributes:
        terms: its effects.
        base: transmission parameters at the linearisation.
        corrections: of the readings, one a recording.
        slots: meaning of the columns.
        regression: the rows.
        times: autocorrelation times of the residual.
        posterior: of the columns.
        extra: a free curve, where there is one.
        pinned: everyday errors held at a value, by name and motor.
    """

    terms: tuple[Term, ...]
    base: Base
    corrections: tuple[Corrections, ...]
    slots: tuple[Slot, ...]
    regression: Regression
    times: FloatArray
    posterior: Posterior
    extra: Extra | None = None
    pinned: Pinned = field(default_factory=dict)

    def evidence(self, like: Fitted) -> float:
        """Log marginal likelihood, with the error correlation and noise floor of another hypothesis."""
        if like is self:
            return self.posterior.evidence
        regression = replace(self.regression, floor=like.regression.floor)
        return regression.solve(like.times, self.posterior).evidence

    @property
    def keys(self) -> Keys:
        """Its effects and their motors, unordered; a free curve counts as unlisted."""
        own = frozenset(t.candidate.key for t in self.terms)
        return own if self.extra is None else own | {("unlisted", self.extra.motor)}

    @property
    def named(self) -> Keys:
        """The same, and declared numbers and readings that are further off than their priors let believe."""
        off = {(s.name, s.motor) for s, x in self._off() if s.kind == "everyday" and abs(x) > choice("sure")}
        return self.keys | off

    def _off(self) -> Iterator[tuple[Slot, float]]:
        """Every column, and how many of its prior's standard deviations it is off."""
        off = (self.posterior.x - self.regression.mean) / self.regression.std
        return zip(self.slots, off.tolist(), strict=True)

    @property
    def parameters(self) -> int:
        """Number of parameters of its effects and its free curve."""
        return sum(len(t.candidate.kind.parameters) for t in self.terms) + sum(
            slot.kind == "curve" for slot in self.slots
        )

    @property
    def bends(self) -> frozenset[object]:
        """Its curves of a deflection."""
        own = frozenset[object](t.candidate.key for t in self.terms if t.candidate.bends)
        extra = self.extra
        bent = extra is not None and extra.coordinates[0] == "deflection"
        return own | {extra} if bent else own

    @property
    def families(self) -> frozenset[object]:
        """Families of its effects: what laws are for; a free curve is of none."""
        own = frozenset(t.candidate.family for t in self.terms)
        return own if self.extra is None else own | {self.extra}

    def log_prior(self, errors: float, price: float) -> float:
        """Return the logarithm of the prior odds of such a joint, beside one as declared.

        Each declared number and reading is as improbable as it is far off, as an effect too. Each effect
        pays for multiple testing (Scott and Berger, Annals of Statistics 38, 2010), each of its parameters
        half the logarithm of the number of independent errors (Schwarz, Annals of Statistics 6, 1978).
        """
        off = np.array([off for slot, off in self._off() if slot.kind == "everyday" or _is_read(slot)])
        effects = price * len(self.keys) + 0.5 * self.parameters * math.log(max(errors, 1.0))
        return -0.5 * float(off @ off) - effects

    def is_real_beside(self, parent: Fitted) -> bool:
        """Return whether every effect contributes, none at an end of the motion, and no spring is at zero
        that has a stiffness in the parent.
        """
        lost = self._at_zero("base") - parent._at_zero("base")
        widths = zip(self.slots, self.regression.std.tolist(), strict=True)
        ends = any(slot.kind == "shape" and width < 1.0 for slot, width in widths)
        return not lost and not ends and not self._at_zero("term")

    def _at_zero(self, kind: str) -> set[tuple[str, int | None, int]]:
        """Parameters of a kind that their sign constraint holds at its bound."""
        return {
            (slot.name, slot.motor, slot.part)
            for slot, held in zip(self.slots, self.posterior.bound, strict=True)
            if held and slot.kind == kind
        }

    def moved_base(self, frame: Frame) -> Base:
        """Return the transmission parameters as fitted; of a frame of the joint."""
        own = np.array(
            [x for slot, x in zip(self.slots, self.posterior.x, strict=True) if slot.kind == "base"]
        )
        return self.base.moved(frame, own)

    def total(self, kind: str, name: str, motor: int | None, run: int | None = None) -> list[float]:
        """Return the total quantity of some slots, including corrections already applied."""
        return [
            slot.taken + float(x)
            for slot, x in zip(self.slots, self.posterior.x, strict=True)
            if (slot.kind, slot.name, slot.motor) == (kind, name, motor) and slot.run in (None, run)
        ]


def _is_read(slot: Slot) -> bool:
    """Return whether a column is an effect's on a reading, whose prior is not a share of the torque."""
    return slot.kind == "term" and LIBRARY[slot.name].channel != "torque"
