"""Which effects are missing: forward selection of groups, refined, cross-validated, swapped and pruned."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize

from estimator.diagnosis.base import Base, start, with_flexibility
from estimator.diagnosis.candidates import Candidate, columns, grid, least_periods, members
from estimator.diagnosis.frame import Corrections, Frame
from estimator.diagnosis.known import declared_torque
from estimator.diagnosis.regression import Fit, Rows
from estimator.effects.memory import STOP_EXPONENT
from estimator.sample import FloatArray

Extra = Callable[[Frame], FloatArray]

__all__ = ["Selection", "Term", "Tracer"]

_STEPS = 12  # of Gauss-Newton, at most
_TRIED = 8  # candidates that are refined in each round
_RESOLVED = 3.0  # least Stribeck velocity over the smoothing
_STIFFEST = 20.0  # exponent of a law of friction
_SMOOTHEST = 0.08  # of the rms velocity: a sign smoothed more than this is no sign


@dataclass(frozen=True, slots=True)
class Term:
    """A chosen effect with its nonlinear parameters."""

    candidate: Candidate
    values: dict[str, float]

    @property
    def width(self) -> int:
        """Number of its linear parameters."""
        return len(self.candidate.kind.linear)

    @property
    def complexity(self) -> int:
        """Number of free parameters; a law counts as one parameter more."""
        free = [
            p for p in self.candidate.kind.nonlinear if p not in ("smoothing_rad_s", "side", "power", "shape")
        ]
        return self.width + len(free)


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """A model: base and terms, fitted."""

    terms: tuple[Term, ...]
    fit: Fit
    design: FloatArray = field(repr=False)

    @property
    def error(self) -> float:
        """Cross-validated squared error, in units of the expected noise."""
        return self.fit.error


class Tracer:
    """Holds the recording's frame and tries models on it.

    Args:
        frame: the recording.
        rows: its rows and their weights.
        smoothing_rad_s: velocity below which a sign cannot be told from noise.
        base: the base model; None: its best fit.
        within: location and motor of the only place where effects are looked for; None: anywhere.
    """

    def __init__(
        self,
        frame: Frame,
        rows: Rows,
        smoothing_rad_s: float,
        base: Base | None = None,
        within: tuple[str, int | None] | None = None,
    ) -> None:
        self.rows = rows
        self.within = within
        self.smoothing_rad_s = smoothing_rad_s
        self._columns: dict[tuple[str, int | None, tuple[tuple[str, float], ...]], FloatArray] = {}
        self.base = self._fitted(frame, start(frame)) if base is None else base
        self.frame = with_flexibility(frame, self.base)
        self.base_design = self.rows.weighted(self.base.design(self.frame))
        self.target = self.rows.weighted(self.balance())

    def balance(self) -> FloatArray:
        """What the base model at its parameters leaves of the balances, all rows, stacked."""
        return np.asarray(self.frame.target() - declared_torque(self.frame) - self.base.torque(self.frame))

    def at(self, corrections: Corrections, base: Base | None = None) -> Tracer:
        """The same with other corrections of the readings, about a given base model or its best fit."""
        frame = Frame.make(self.frame.model, self.frame.signals, corrections)
        return Tracer(frame, self.rows, self.smoothing_rad_s, base, self.within)

    def only(self, location: str, motor: int | None, encoder_delay_s: float) -> Tracer:
        """The same with effects looked for at one place only, the link's reading later by so much."""
        late = self.frame.corrections.encoder_delay_s + encoder_delay_s
        frame, base = self.frame, self.base
        if encoder_delay_s:
            corrections = replace(frame.corrections, encoder_delay_s=late)
            frame = Frame.make(frame.model, frame.signals, corrections)
        return Tracer(
            frame, self.rows, self.smoothing_rad_s, None if encoder_delay_s else base, (location, motor)
        )

    def moved(self, selection: Selection) -> Base:
        """The base model with the parameters it has beside a selection's terms."""
        return self.base.moved(self.frame, selection.fit.coefficients[: self.base_design.shape[1]])

    def _fitted(self, frame: Frame, base: Base) -> Base:
        for _ in range(_STEPS):
            frame = with_flexibility(frame, base)
            design = self.rows.weighted(base.design(frame))
            target = self.rows.weighted(frame.target() - declared_torque(frame) - base.torque(frame))
            moved = base.moved(frame, self.rows.fit(design, target).coefficients)
            change = np.abs(np.concatenate(moved.alpha) - np.concatenate(base.alpha))
            base = moved
            if np.all(change <= 1e-7 * np.abs(np.concatenate(base.alpha))):
                break
        return base

    def columns(self, candidate: Candidate, values: dict[str, float]) -> FloatArray:
        """Weighted training columns of a candidate."""
        return self.rows.weighted(columns(self.frame, candidate, values))

    def evaluate(self, terms: tuple[Term, ...]) -> Selection:
        """Fit base and terms."""
        design = np.column_stack([self.base_design, *(self.columns(t.candidate, t.values) for t in terms)])
        return Selection(terms, self.rows.fit(design, self.target), design)

    def left(self, selection: Selection, extra: Extra | None = None, on: Frame | None = None) -> FloatArray:
        """What a fitted model leaves of the balances, all rows, stacked.

        Args:
            selection: the model.
            extra: gives the columns behind those of base and terms, where the model has more.
            on: another recording's frame, its readings corrected like this one's.
        """
        frame = self.frame if on is None else with_flexibility(on, self.base)
        made = [columns(frame, t.candidate, t.values) for t in selection.terms]
        if extra is not None:
            made.append(extra(frame))
        design = np.column_stack([self.base.design(frame), *made])
        balance = frame.target() - declared_torque(frame) - self.base.torque(frame)
        return np.asarray(balance - design @ selection.fit.coefficients)

    def screen(self, current: Selection, count: int = _TRIED) -> list[Term]:
        """The candidates that explain most of what is left, best grid point each, best first."""
        q, residual = _projector(current.design, self.target)
        scored = []
        for candidate in members(self.frame, self.within):
            best: tuple[float, dict[str, float]] = (0.0, {})
            for values in grid(self.frame, candidate, self.smoothing_rad_s):
                gain = _gain(q, residual, self._cached(candidate, values))
                if gain > best[0]:
                    best = (gain, values)
            if best[0] > 0.0:
                scored.append((best[0], Term(candidate, dict(best[1]))))
        scored.sort(key=lambda pair: -pair[0])
        return [term for _, term in scored[:count]]

    def _cached(self, candidate: Candidate, values: dict[str, float]) -> FloatArray:
        key = (*candidate.key, tuple(values.items()))
        if key not in self._columns:
            self._columns[key] = self.columns(candidate, values).astype(np.float32)
        return self._columns[key]

    def refine(self, current: Selection, term: Term, law: bool = False) -> Term:
        """Nonlinear parameters of a term beside a model, off the grid; those of its law where asked for."""
        stop = term.values.get("exponent", 1.0) >= STOP_EXPONENT
        fixed = ("side", "power") if law and not stop else ("side", "power", "exponent", "shape")
        free = [name for name in term.values if name not in fixed]
        if not free:
            return term
        q, residual = _projector(current.design, self.target)
        start_at = np.array([term.values[name] for name in free])
        scale = np.where(start_at == 0.0, 1.0, np.abs(start_at))
        velocity = self.frame.motors[term.candidate.motor or 0].velocity
        most = max(_SMOOTHEST * float(np.sqrt(np.mean(velocity**2))), self.smoothing_rad_s)
        waves = "periods_per_rev" in free
        least = least_periods(self.frame.motors[term.candidate.motor or 0].position) if waves else 0.0
        reach = 0.02 if waves or "position_rad" in free else 0.3

        def loss(x: FloatArray) -> float:
            values = {**term.values, **dict(zip(free, (start_at + scale * x).tolist(), strict=True))}
            if any(values[name] <= 0.0 for name in free if name != "position_rad"):
                return 0.0
            if values.get("periods_per_rev", np.inf) < least:
                return 0.0
            if values.get("shape", 1.0) > 1.0 or not 1.0 <= values.get("exponent", 1.0) <= _STIFFEST:
                return 0.0
            smooth = values.get("smoothing_rad_s", 0.0)
            if smooth > most or values.get("stribeck_velocity_rad_s", np.inf) < _RESOLVED * smooth:
                return 0.0
            return -_gain(q, residual, self.columns(term.candidate, values))

        n = len(free)
        simplex = np.vstack((np.zeros(n), reach * np.eye(n)))
        if "shape" in free and term.values["shape"] >= 1.0:
            simplex[1 + free.index("shape"), free.index("shape")] = -reach
        most_tries = (15 if law else 40) * n
        found = minimize(
            loss,
            np.zeros(n),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": most_tries, "xatol": 2e-4, "fatol": 0.0},
        )
        values = {**term.values, **dict(zip(free, (start_at + scale * found.x).tolist(), strict=True))}
        return replace(term, values=values)


def _projector(design: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    if not design.shape[1]:
        return np.zeros((len(target), 0)), target
    q, _ = np.linalg.qr(design)
    return q, target - q @ (q.T @ target)


def _gain(q: FloatArray, residual: FloatArray, block: FloatArray) -> float:
    """Squared error that columns explain of a residual, beside the columns of q."""
    free = block - q @ (q.T @ block)
    norm = np.linalg.norm(block, axis=0)
    kept = np.linalg.norm(free, axis=0) > 1e-4 * norm
    if not np.any(kept):
        return 0.0
    free = free[:, kept]
    gram = free.T @ free
    side = free.T @ residual
    try:
        return float(side @ np.linalg.solve(gram + 1e-10 * np.diag(np.diag(gram)), side))
    except np.linalg.LinAlgError:
        return 0.0
