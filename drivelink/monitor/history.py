"""Data of a live view: the last seconds, decimated, and stiffness over deflection, live and by the model.

Fed with every estimate (a few microseconds each), read a few times a second.
"""

import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from estimator.errors import EstimatorError
from estimator.sample import Sample, Status
from estimator.transmissions import MODELS

_BINS = 160
_SECONDS, _KEPT = 12.0, 600  # of the history, and its points
_NEAR = 8  # neighbouring points on either side for the outlier test
_GAP_S = 0.25  # without a moment: a gap in the curves
_OUTDATED = 2.5  # times the usual one there


class TruePoint(NamedTuple):
    """True state of a simulated joint at one SYNC."""

    sequence: int
    flexibility_torque_nm: float
    stiffness_nm_rad: float


class Moment(NamedTuple):
    """One instant of the history; NaN where there is no truth."""

    time_s: float
    torque_nm: float
    stiffness_nm_rad: float
    std_nm_rad: float
    true_torque_nm: float
    true_stiffness_nm_rad: float
    torque_valid: bool
    stiffness_valid: bool


class Touch(NamedTuple):
    """External torque at one instant."""

    time_s: float
    torque_nm: float
    std_nm: float
    valid: bool
    contact: bool


class GrowingCurve:
    """Stiffness over deflection: the latest value in each bin.

    Bins are as wide as needed to have at most `_BINS` occupied: an outlier takes one bin and does not coarsen
    the others.
    """

    def __init__(self) -> None:
        self._width = 0.0  # of a bin; 0: no value yet
        self._places: dict[int, tuple[float, float, float]] = {}

    def add(self, deflection_rad: float, stiffness_nm_rad: float, std_nm_rad: float) -> None:
        """Enter one estimate, if finite."""
        if not (math.isfinite(deflection_rad) and math.isfinite(stiffness_nm_rad)):
            return
        if self._width == 0.0:
            self._width = max(abs(deflection_rad), 1e-9) / _BINS
        place = deflection_rad / self._width
        if not math.isfinite(place):
            return
        self._places[math.floor(place)] = (deflection_rad, stiffness_nm_rad, std_nm_rad)
        while len(self._places) > _BINS:
            self._width *= 2.0
            self._places = {place // 2: point for place, point in self._places.items()}

    @property
    def reach_rad(self) -> float:
        """Largest deflection of its points; 0 without one."""
        return max((abs(point[0]) for point in self._places.values()), default=0.0)

    def points(self) -> list[tuple[float, float, float]]:
        """Return the (deflection, stiffness, standard deviation), by deflection.

        Omits outdated values: one from before the estimator knew the curve has a much larger standard
        deviation than its neighbours.
        """
        points = [point for _, point in sorted(self._places.items())]
        stds = [std for _, _, std in points]
        kept = []
        for k, point in enumerate(points):
            near = sorted(stds[max(0, k - _NEAR) : k + _NEAR + 1])
            if not point[2] > _OUTDATED * near[len(near) // 2]:
                kept.append(point)
        return kept


class JointHistory:
    """The last seconds of a joint and its curve."""

    def __init__(self) -> None:
        self.seconds = _SECONDS
        self.moments: deque[Moment] = deque(maxlen=_KEPT)  # thinned estimates, oldest first
        # stiffness over deflection of each transmission, where it is usable
        self.curves: tuple[GrowingCurve, ...] = ()
        # the same since the estimate stopped being usable; empty while it is
        self.doubtful: tuple[GrowingCurve, ...] = ()
        # (time of the newest estimate, s; largest residual over its baseline)
        self.residuals: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        # thinned external torques, oldest first; empty without link dynamics
        self.touches: deque[Touch] = deque(maxlen=_KEPT)
        self.touch: Touch | None = None  # the newest one
        # thinned (time, s; sample), oldest first; empty while nobody asks for them
        self.signals: deque[tuple[float, Sample]] = deque(maxlen=_KEPT)
        self.latest: EstimateMessage | None = None  # the newest estimate
        self._apart_s = _SECONDS / _KEPT

    def add(self, estimate: EstimateMessage, time_s: float, truth: TruePoint | None = None) -> None:
        """Enter one estimate; `time_s` is the time of its SYNC, with any origin."""
        if self.latest is not None and len(self.latest.transmissions) != len(estimate.transmissions):
            self.moments.clear()  # another joint has taken the name
            self.doubtful = ()
        self.latest = estimate
        last_s = self.moments[-1].time_s if self.moments else math.nan
        if not self._is_due(self.moments, time_s):
            return
        if time_s < last_s:  # the daemon restarted
            self.residuals.clear()
            self.touches.clear()
        elif time_s - last_s > max(_GAP_S, 3.0 * self._apart_s):
            self._break_off(last_s + self._apart_s)
        self.moments.append(
            Moment(
                time_s,
                estimate.flexibility_torque_nm,
                estimate.stiffness_nm_rad,
                estimate.stiffness_std_nm_rad,
                truth.flexibility_torque_nm if truth else math.nan,
                truth.stiffness_nm_rad if truth else math.nan,
                bool(estimate.status & (Status.VALID | Status.TORQUE_VALID)),
                bool(estimate.status & (Status.VALID | Status.STIFFNESS_VALID)),
            )
        )
        if len(self.curves) != len(estimate.transmissions):
            self.curves = self._new_curves(estimate)
        usable = self.moments[-1].stiffness_valid and bool(estimate.status & Status.OBSERVABLE)
        if usable:
            self.doubtful = ()
        elif not self.doubtful:
            self.doubtful = self._new_curves(estimate)
        for curve, one in zip(self.curves if usable else self.doubtful, estimate.transmissions, strict=True):
            curve.add(one.deflection_rad, one.stiffness_nm_rad, one.stiffness_std_nm_rad)

    def _break_off(self, time_s: float) -> None:
        """Nothing came for a while: no curve over time goes on across that."""
        nan = math.nan
        self.moments.append(Moment(time_s, *(nan,) * 5, False, False))
        if self.touches:
            self.touches.append(Touch(time_s, nan, nan, False, False))
        if self.residuals:
            self.residuals.append((time_s, nan))
        if self.signals:
            lost = (nan,) * len(self.signals[-1][1].motor_position_rad)
            self.signals.append((time_s, Sample(0, lost, lost, lost)))

    @staticmethod
    def _new_curves(estimate: EstimateMessage) -> tuple[GrowingCurve, ...]:
        return tuple(GrowingCurve() for _ in estimate.transmissions)

    def add_external(self, message: ExternalMessage, time_s: float) -> None:
        """Enter one external torque; a contact is never thinned out."""
        self.touch = Touch(
            time_s, message.external_torque_nm, message.external_torque_std_nm, message.valid, message.contact
        )
        begins = self.touch.contact and not (self.touches and self.touches[-1].contact)
        if self._is_due(self.touches, time_s) or begins:
            self.touches.append(self.touch)

    def add_sample(self, sample: Sample, time_s: float) -> None:
        """Enter what was measured at one SYNC."""
        if self._is_due(self.signals, time_s):
            self.signals.append((time_s, sample))

    def _is_due(self, kept: deque[Any], time_s: float) -> bool:
        """Return whether a time is one to be kept; what is later is of a daemon before this one."""
        since = time_s - kept[-1][0] if kept else math.inf
        if since < 0.0:
            kept.clear()
        return since < 0.0 or since >= 0.999 * self._apart_s

    def add_residual(self, ratio: float) -> None:
        """Enter the present residual over its baseline."""
        if self.moments and math.isfinite(ratio):
            self.residuals.append((self.moments[-1].time_s, ratio))

    @property
    def largest_torque_nm(self) -> float:
        """Largest flexibility torque of the window, which says how many digits a small one has."""
        known = [abs(m.torque_nm) for m in self.window() if math.isfinite(m.torque_nm)]
        return max(known, default=math.nan)

    @property
    def largest_deflection_rad(self) -> float:
        """Largest deflection that was seen."""
        return max((curve.reach_rad for curve in (*self.curves, *self.doubtful)), default=math.nan)

    def window(self) -> list[Moment]:
        """Return the moments within `seconds` of the last one."""
        if not self.moments:
            return []
        since = self.moments[-1].time_s - self.seconds
        return [moment for moment in self.moments if moment.time_s >= since]


_POINTS = 60


def model_curves(
    model: Mapping[str, Any], curves: list[list[tuple[float, float, float]]]
) -> list[list[tuple[float, float]]]:
    """Return the stiffness of each transmission by the model in use, over the deflections seen so far.

    Args:
        curves: (deflection, stiffness, standard deviation) of each transmission, by deflection.

    Returns:
        (deflection, stiffness) of each, rad, N·m/rad; empty where its parameters are not known.
    """
    motors = model.get("motors")
    known = motors if isinstance(motors, list) else ()
    return [_curve(motor, points) for motor, points in zip(known, curves, strict=False)]


def _curve(motor: Any, points: list[tuple[float, float, float]]) -> list[tuple[float, float]]:
    # The document comes from the network: whatever cannot be evaluated is not drawn.
    with suppress(EstimatorError, KeyError, TypeError, ValueError, AttributeError, OverflowError):
        transmission = motor["transmission"]
        parameters = {
            k: tuple(v) if isinstance(v, list) else v for k, v in transmission["parameters"].items()
        }
        if points and parameters:
            law = MODELS[transmission["model"]]
            phi = np.linspace(points[0][0], points[-1][0], _POINTS)
            values = law.stiffness(phi, law.alpha(parameters))
            if np.all(np.isfinite(values)):
                return list(zip(phi.tolist(), values.tolist(), strict=True))
    return []
