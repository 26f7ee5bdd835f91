"""How well one motor's balance (eq 5) explains its torque, under a hypothesis about scales and signs.

With theta = a theta_m, q = c q_m, tau = b tau_m of what was recorded, eq 5 in recorded quantities is

    tau_m = (a/b) (B theta_m'' + D theta_m') + (F_c/b) sgn(a theta_m')
            - f(c q_m - a theta_m)/b + offset + d tau_m'

with the signs that physics requires: the declared inertia B within a factor, and D, the friction F_c and the
slope of f not negative. The transmission is any rising curve; a late link encoder adds q', a late torque
tau', cogging and cables any curve of theta_m but a straight line. All channels pass the same filters. Errors
are relative to the recorded torque, so hypotheses are compared on the same data.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from estimator.choices import choice, whole
from estimator.filters import StateVariableFilter
from estimator.model import Motor
from estimator.priors import PRIORS
from estimator.sample import FloatArray, Record

__all__ = ["Balance", "Fit", "Scales"]

_RIDGE = 1e-6  # of what a column explains: no two terms of a real joint cancel to a millionth


class Scales(NamedTuple):
    """True value over recorded value: of a motor's position and torque, the link's position, and time.

    `inertia` is the same of the declared inertia, infinite: any; `deflection` of the link's angle
    against its motor.
    """

    position: float = 1.0
    torque: float = 1.0
    link: float = 1.0
    time: float = 1.0
    inertia: float = 1.0
    deflection: float = 1.0


class Fit(NamedTuple):
    """The fit of a balance under one hypothesis.

    Attributes:
        errors: (bands,) residual rms over the rms of the whole torque, at least `gate_floor`.
        error: the same of all bands together.
        inertia: the motor's over the declared one, hypothesis' units.
        stiffness_nm_rad: mean slope of the transmission's curve, in the hypothesis' units; 0: rigid.
        deflection: rms of the deflection over that of the link's and motor's motion, hypothesis' units.
    """

    errors: FloatArray
    error: float
    inertia: float
    stiffness_nm_rad: float
    deflection: float


class Balance:
    """One motor's balance, filtered once into bands; hypotheses are fitted to it as they come.

    Args:
        record: the recording.
        index: of the motor.
        motor: as declared.
        lever: index of the motor whose spring has its lever set by this one (serial joints).
    """

    def __init__(self, record: Record, index: int, motor: Motor, lever: int | None = None) -> None:
        self.motor = motor
        self.period_s = record.period_s
        self._theta = _gridded(record, record.motor_position_rad[:, index])
        tau = _gridded(record, record.motor_torque_nm[:, index])
        link = record.link_position_rad
        needed = motor.flexible or lever is not None
        self._q = None if link is None or not needed else _gridded(record, link)
        self._filters = _filters(self._theta)
        self._rows = _rows(record, self._filters[-1].settling_periods)
        _, self._velocity, self._acceleration = self._through(self._theta, 2)
        torque, rate = self._through(tau, 1, held=True)
        self.torque_rms = float(np.std(torque.sum(axis=0)))
        self.arc = float(np.std(_detrended(self._theta)))
        self._unit = self.torque_rms or 1.0
        self._target, self._rate = torque / self._unit, rate / self._unit
        self._position = [self._through(x)[0] for x in _pieces(self._theta)[1:]]
        self._sign = self._through(_sense(self._theta, self._filters[0]))[0]
        self.velocity_gain = self._gain(record, index)
        self._link_rate = None if self._q is None else self._through(self._q, 1)[1]
        self._loads: list[FloatArray] = []
        if lever is not None and self._q is not None:
            phi = self._q - _gridded(record, record.motor_position_rad[:, lever])
            self._loads = [self._through(phi**k)[0] for k in (1, 2)]
        self._springs: dict[float, tuple[list[FloatArray], float]] = {}
        self._factors: dict[float, _Factors] = {}
        self.ratio = self._ratio()
        self._fits: dict[tuple[float, ...], Fit] = {}
        # Score, ratio and coefficients of the best hypothesis.
        self._best: tuple[float, float, FloatArray] = math.inf, 1.0, np.zeros(0)

    def _through(self, x: FloatArray, derivatives: int = 0, *, held: bool = False) -> list[FloatArray]:
        """The signal and its derivatives (per sample) in every band, (bands, rows) each, without means."""
        passed = [f.apply(x, derivatives, held=held) for f in self._filters]
        out = []
        for order in range(derivatives + 1):
            each = [one[order][self._rows] for one in passed]
            bands = [wide - narrow for wide, narrow in pairwise(each)]
            stacked = np.stack([*bands, each[-1]])
            out.append(stacked - stacked.mean(axis=1, keepdims=True))
        return out

    def fit(self, scales: Scales) -> Fit:
        """Fit the balance under a hypothesis."""
        a, b, c, time, inertia, rises = scales
        free = math.isinf(inertia)
        B = (
            self.motor.inertia_kg_m2
            * (1.0 if free else inertia)
            * (a / b)
            / (self.period_s * time) ** 2
            / self._unit
        )
        flexible = self.motor.flexible and self._q is not None
        ratio = a / c if flexible else a
        key = (
            ratio,
            math.copysign(1.0, a * b),
            math.copysign(1.0, rises * c * b) if flexible else 0.0,
            B,
            free,
        )
        if key not in self._fits:
            self._fits[key] = self._solve(a, b, c, rises, B, free)
        fit = self._fits[key]
        return fit._replace(stiffness_nm_rad=fit.stiffness_nm_rad * abs(b / c))

    def _solve(self, a: float, b: float, c: float, rises: float, B: float, any_inertia: bool) -> Fit:
        sense, off = math.copysign(1.0, a * b), math.inf if any_inertia else choice("declared_factor")
        signs = [math.copysign(1.0, B), sense, sense, 0.0]
        flexible = self.motor.flexible and self._q is not None
        ratio = a / c if flexible else a
        if ratio not in self._factors:
            self._factors[ratio] = _factors(self._columns(ratio), self._target)
        factors = self._factors[ratio]
        pieces = slice(len(signs), len(signs) + whole("pieces") + 2)
        slope = deflection = 0.0
        if flexible:
            signs += [-math.copysign(1.0, rises * b * c)] * (whole("pieces") + 2)
        signs += [0.0] * (len(factors.sizes) - len(signs))
        x, left = _bounded(factors, signs, (abs(B) / off, abs(B) * off))
        if flexible:
            steps = -math.copysign(1.0, rises * b * c) * x[pieces]
            slope = float(np.mean(steps[: whole("pieces")]) + np.sum(steps[whole("pieces") :])) * self._unit
            deflection = self._springs[ratio][1]
        errors = np.hypot(left[:-1], choice("gate_floor"))
        score = float(np.sum(np.log(errors)))
        if score < self._best[0]:
            self._best = score, ratio, x
        return Fit(errors, float(left[-1]), float(x[0]) / B, slope, deflection)

    def _columns(self, ratio: float) -> list[FloatArray]:
        """Columns of the balance, (bands, rows) each; `ratio` of q over theta_m, or the position's scale."""
        own = [self._acceleration, self._velocity, self._sign, self._rate]
        if self.motor.flexible and self._q is not None and self._link_rate is not None:
            return [*own, *self._spring(self._q, ratio)[0], self._link_rate, *self._position]
        angle = ratio * self._theta  # gravity of whatever moves with a rigid joint
        return [*own, *(self._through(x)[0] for x in (np.sin(angle), np.cos(angle))), *self._loads]

    def _spring(self, q: FloatArray, ratio: float) -> tuple[list[FloatArray], float]:
        """Basis of a rising curve of q - ratio theta_m, and the deflection's size over the motion's.

        Two more straight lines, for a slightly smaller and a slightly larger ratio, cover scale errors of the
        encoders: any error in between is their sum with positive weights.
        """
        if ratio not in self._springs:
            phi = q - ratio * self._theta
            ramps = [self._through(x)[0] for x in _pieces(phi)]
            other = choice("sure") * PRIORS["encoder_scale"].std
            ends = (ratio * (1.0 - other), ratio * (1.0 + other))
            ramps += [self._through(q - end * self._theta)[0] for end in ends]
            moved = math.hypot(float(q.std()), abs(ratio) * float(self._theta.std()))
            self._springs[ratio] = (ramps, float(phi.std()) / max(moved, 1e-300))
        return self._springs[ratio]

    def _ratio(self) -> float | None:
        """Link over motor position as seen in the torque, which depends on both separately."""
        if self._q is None or not self.motor.flexible or self._link_rate is None:
            return None
        q, theta = (self._through(x)[0] for x in (self._q, self._theta))
        nuisances = (self._acceleration, self._velocity, self._sign, self._rate, self._link_rate)
        factors = _factors([*nuisances, q, theta], self._target)
        x, _ = _bounded(factors, [0.0] * len(factors.sizes))
        return float(-x[-1] / x[-2]) if x[-2] else None

    def _gain(self, record: Record, index: int) -> float | None:
        """The recorded velocity over the position's derivative; None: not recorded, or they do not agree."""
        if record.motor_velocity_rad_s is None:
            return None
        column = record.motor_velocity_rad_s[:, index]
        if np.count_nonzero(np.isfinite(column)) < whole("samples"):
            return None
        v = self._through(_gridded(record, column))[0].ravel()
        rate = self._velocity.ravel() / self.period_s
        both, own, other = float(v @ rate), float(rate @ rate), float(v @ v)
        agree = own > 0.0 and other > 0.0 and both**2 > choice("unexplained") * own * other
        return both / own if agree else None

    def controlled(self) -> FloatArray:
        """Fit a controller that makes the torque from the motor's own reading: PID of any delay, and what
        compensates gravity, any curve of the position.

        No gain but the curve's is negative. Where it leaves no more than the joint does, the torque says what
        the controller does, not what the joint is (closed-loop identification without excitation of its own:
        Ljung, System Identification, 1999, section 13.4).

        Returns:
            (bands,) residual rms over the rms of the whole torque, at least `gate_floor`.
        """
        position, integral = (self._through(x)[0] for x in (self._theta, np.cumsum(self._theta)))
        curve = [position, *self._position]
        factors = _factors([integral, self._velocity, self._rate, *curve], self._target)
        _, left = _bounded(factors, (-1.0, -1.0, 0.0, *[0.0] * len(curve)))
        return np.asarray(np.hypot(left[:-1], choice("gate_floor")))

    @property
    def independent(self) -> FloatArray:
        """(bands,) effective sample size of the best hypothesis' residual.

        n / sum r_k² over all lags, with the autocorrelation r of each band's residual.
        """
        _, ratio, x = self._best
        left = self._target - np.stack(self._columns(ratio), axis=-1) @ x
        return np.array([_independent(one) for one in left])


def _pieces(x: FloatArray) -> list[FloatArray]:
    """Hat functions on evenly spaced knots: a basis for curves of x."""
    low, high = np.quantile(x, (0.002, 0.998))
    width = max((high - low) / whole("pieces"), 1e-300)
    unders = [-np.inf, *[0.0] * (whole("pieces") - 1)]
    overs = [*[width] * (whole("pieces") - 1), np.inf]
    return [
        np.clip(x - (low + k * width), under, over)
        for k, (under, over) in enumerate(zip(unders, overs, strict=True))
    ]


def _independent(x: FloatArray) -> float:
    size = 1 << (2 * len(x) - 1).bit_length()
    r = np.fft.irfft(np.abs(np.fft.rfft(x - x.mean(), size)) ** 2)[: max(2, len(x) // 4)]
    r = r / max(r[0], 1e-300)
    return float(len(x) / (2.0 * float(r @ r) - 1.0))


class _Factors(NamedTuple):
    """Columns of a balance and its target, reduced to what least squares needs of them.

    Attributes:
        roots: (bands + 1, k + 1, k + 1) triangular factors of [columns, target], each band and their sum,
            scaled so that norms are rms; not squared, as K and B are nearly parallel.
        sizes: (k,) rms of the columns, by which they are divided.
    """

    roots: FloatArray
    sizes: FloatArray


def _factors(columns: Sequence[FloatArray], target: FloatArray) -> _Factors:
    A = np.stack(columns, axis=-1)
    sizes = np.sqrt(np.mean(A**2, axis=(0, 1)))
    sizes[sizes == 0.0] = 1.0
    joined = np.concatenate((A / sizes, target[..., None]), axis=-1) / math.sqrt(A.shape[1])
    every = np.concatenate((joined, joined.sum(axis=0)[None]))
    return _Factors(np.asarray(np.linalg.qr(every, mode="r")), sizes)


def _bounded(
    factors: _Factors, signs: Sequence[float], first: tuple[float, float] = (0.0, math.inf)
) -> tuple[FloatArray, FloatArray]:
    """Least squares with known signs, each band weighted by its residual.

    Args:
        factors: of the balance.
        signs: (k,) of the coefficients; 0: either.
        first: least and largest size of the first coefficient, if it has a sign.

    Returns:
        (k,) coefficients; (bands + 1,) residual rms of each band and of their sum.
    """
    roots, sizes = factors
    k = len(sizes)
    sense = np.asarray(signs)
    order = np.argsort(np.abs(sense), kind="stable")  # any sign first: eliminated
    free = k - np.count_nonzero(sense)
    turned = np.where(sense[order] < 0.0, -1.0, 1.0)
    ridge = np.hstack((_RIDGE * np.eye(k), np.zeros((k, 1))))
    x = np.zeros(k)
    left = np.linalg.norm(roots[:, :, -1], axis=1)
    for _ in range(whole("rough_steps")):
        weighted = (roots[:-1] / np.hypot(left[:-1], choice("gate_floor"))[:, None, None]).reshape(-1, k + 1)
        R = np.asarray(np.linalg.qr(np.vstack([weighted, ridge])[:, [*order, k]], mode="r"))
        A, b = R[:k, :k] * turned, R[:k, k]
        y = _nonnegative(A[free:, free:], b[free:], *(end * sizes[0] for end in first))
        z = np.linalg.solve(A[:free, :free], b[:free] - A[:free, free:] @ y)
        x[order] = turned * np.concatenate((z, y))
        left = np.linalg.norm(roots @ np.append(-x, 1.0), axis=1)
    return x / sizes, left


def _nonnegative(A: FloatArray, b: FloatArray, least: float, most: float) -> FloatArray:
    """Least squares with coefficients (k,) of at least 0, the first one from `least` to `most`."""
    if not len(b):
        return np.zeros(0)
    y: FloatArray = nnls(A, b - least * A[:, 0])[0]
    y[0] += least
    if y[0] > most:  # the problem is convex
        y = np.append(most, nnls(A[:, 1:], b - most * A[:, 0])[0])
    return y


def _gridded(record: Record, x: FloatArray) -> FloatArray:
    """Bridged by lines over gaps, without its mean."""
    grid = np.arange(record.sequence[0], record.sequence[-1] + 1)
    good = np.isfinite(x)
    return np.asarray(np.interp(grid, record.sequence[good], x[good]))


def _detrended(x: FloatArray) -> FloatArray:
    """The signal without its linear trend: the oscillation within a turning motion."""
    k = np.arange(len(x)) - 0.5 * (len(x) - 1)
    return np.asarray(x - x.mean() - k * (float(k @ x) / max(float(k @ k), 1.0)))


def _rows(record: Record, settling: int) -> NDArray[np.intp]:
    """Rows that are used: without the filter's start and gaps."""
    sequence = record.sequence - record.sequence[0]
    usable = np.ones(int(sequence[-1]) + 1, dtype=bool)
    for k in np.flatnonzero(np.diff(sequence) > whole("bridged")):
        usable[sequence[k] : sequence[k + 1] + 1] = False
    usable[: min(settling, len(usable) // 4)] = False
    rows = np.flatnonzero(usable)
    return rows[:: max(1, len(rows) // whole("gate_rows"))]


def _sense(theta: FloatArray, filter_: StateVariableFilter) -> FloatArray:
    """Direction of the motion: tanh of the velocity over a small share of its largest."""
    velocity = filter_.apply(theta, 1)[1]
    largest = float(np.max(np.abs(velocity))) or 1.0
    return np.asarray(np.tanh(velocity / (choice("smoothing") * largest)))


def _noise(x: FloatArray) -> float:
    """Standard deviation of a position's noise: white, from third differences; or its steps, if larger."""
    steps = np.abs(np.diff(x))
    steps = steps[steps > 1e-9 * max(float(np.ptp(x)), 1e-300)]
    step = float(np.min(steps)) if len(steps) else 0.0
    return max(float(np.sqrt(np.mean(np.diff(x, 3) ** 2) / 20.0)), step / math.sqrt(12.0))


def _filters(theta: FloatArray) -> list[StateVariableFilter]:
    """Filters from the widest one whose upper band has an acceleration above the noise, downwards."""
    noise = _noise(theta)

    def acceleration(w: float) -> tuple[FloatArray, FloatArray]:
        f = StateVariableFilter(2 + whole("falloff"), w, 1.0)
        return f.apply(theta, 2)[2], f.impulse(f.settling_periods)[:, 2]

    w, least = 1.0, 60.0 / len(theta)
    wide, pulse = acceleration(w)
    while w / choice("band_ratio") > least:
        narrow, other = acceleration(w / choice("band_ratio"))
        pulse = np.pad(pulse, (0, len(other) - len(pulse)))
        # Over the rows that are used at most: a jerk at the start says nothing about them.
        acceleration_power = float(np.var((wide - narrow)[max(len(other), len(theta) // 4) :]))
        if noise**2 * float(np.sum((pulse - other) ** 2)) < choice("band_noise") * acceleration_power:
            break
        w, wide, pulse = w / choice("band_ratio"), narrow, other
    widths = [w / choice("band_ratio") ** k for k in range(whole("bands"))]
    return [StateVariableFilter(2 + whole("falloff"), x, 1.0) for x in widths if x > least or x == w]
