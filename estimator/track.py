"""One flexible transmission on line: what its channels carry, when its equation is trusted, what it says."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np

from estimator.bank import FilterBank
from estimator.declared import Elastic
from estimator.flexibility import Polynomial, TransmissionModel
from estimator.model import Motor, ParameterValue
from estimator.regression import UNSEEN, Regression, Signals
from estimator.sample import FloatArray, TransmissionEstimate
from estimator.settings import EstimatorSettings
from estimator.transmissions import UNKNOWN, transmission_model

__all__ = ["Track"]

_MEMORY_S = 20.0  # of the regression; a sudden change is for the alarm to find
_LOCAL_MEMORY_S = 2.0  # of the black box, whose model holds only locally
_START_ORDER = 3  # polynomial that an unknown curve starts from
_ALARM_UPDATES = 3  # over which innovations are averaged
_ALARM_SIGMA = 6.0
_ALARM_SHARE = 0.004  # of the torque: no smaller change is called one
_FLUSH_DELAYS = 1.6  # filter delays until what was before a change has left the filters
_FOLLOW_S = 0.6  # after an alarm, in which the change is still being followed
_STEP = 0.3  # how much a stiffness may change at an alarm, relative
_SETTLED_S = 1.0  # of updates, before there is an alarm or an invalid curve
_ORDER_S = 5.0  # of updates between looks at the polynomial's highest powers
_OFTEN_S = 0.5  # of updates between two looks at what rounding has done, and at the priors
_DUE_S = 0.1  # of updates between two looks at a nonlinear model's linearisation
_ORDER_SIGMA = 3.0
_OFF_TANGENT = 0.3  # standard deviations that a nonlinear model's curve leaves its tangent by, at most
_DELAY_S = 0.5  # of updates between two alignments of late channels
_DELAY_PERIODS = 0.05  # no smaller delay is worth one
_VALID = 0.25  # relative standard deviation of the stiffness up to which it is of use
_DRIFT = 1e-4  # relative growth of the standard deviation per second held
_RESTED_S = 0.05  # without motion: from then on the interval grows
_WIDEST = 0.02  # … up to this
_ASTRAY_S = 1.0  # of updates with parameters that cannot be, after which it starts anew
_EXPLAINED_S = 0.3  # over which the curve is held against the balance
_SURPRISING = 3.0  # standard deviations, on average over that: the balance is not explained any more
_TWICE = 2.0  # times that: the most that one innovation counts, and what it counts during a flush
_FIRST_S = 0.12  # of updates that are not held against a curve which has only begun
_VARIES_S = 2.0  # over which the balance's variance is taken: a constant torque tells no stiffness …
_VARIED_S = 30.0  # … and how long a lively phase is remembered
_UNEXPLAINED = 0.04  # share of that variance that the curve may miss
_UNEXPLAINED_LOCAL = 0.5  # … for the black box, which sees the derivative of both
_QUIET = 0.25  # of the liveliest variance: the least that misses are held against
_NO_CURVE = 1.5  # times the largest torque: an innovation that no change of the stiffness explains …
_NO_CURVE_S = 0.5  # … unless it lasts
_BEYOND = 1.5  # times the largest deflection behind the filter: no more is known of the curve
_INERTIA_OFF = 0.4  # of the declared inertia: farther off, the declared motor is not this one
_DRIVING = 0.05  # of the largest torque: no damping drives its motor by more
_EDGE = 0.98  # of where a model ends
_FLOOR = 1e-5  # noise below this share of the torque is not believed


class Track:
    """Estimation of one transmission; the joint feeds it channels and asks for its estimate.

    Args:
        motor: its declared model.
        settings: bandwidth and method.
        period_s: T.
        dt_s: time between two updates.
    """

    def __init__(self, motor: Motor, settings: EstimatorSettings, period_s: float, dt_s: float) -> None:
        target = transmission_model(motor.transmission)
        self._motor, self._T, self._dt = motor, period_s, dt_s
        self._settled, self._order, self._delay, self._astray, self._few, self._often, self._soon = (
            max(1, round(duration / dt_s))
            for duration in (_SETTLED_S, _ORDER_S, _DELAY_S, _ASTRAY_S, _FIRST_S, _OFTEN_S, _DUE_S)
        )
        self._black_box = settings.method == "bbe" or target is None
        self._target = None if self._black_box else target
        self._bandwidth = settings.bandwidth_rad_s
        self._choose_order = not self._black_box and motor.transmission.order is None
        self._slots = 2 if self._black_box else self._count(motor)
        self._elastic = Elastic(motor)
        if self.shaped:  # now, and not in the running loop: it brings scipy.optimize
            from estimator.handover import polynomial_to_model

            self._to_model = polynomial_to_model
        self.channels = self._slots + 1  # the last one carries phi², or dg/dphi of a nonlinear model
        self.reset()

    @staticmethod
    def _count(motor: Motor) -> int:
        model = transmission_model(motor.transmission)
        assert model is not None
        if model.linear is None:
            known = len(model.alpha(motor.transmission.parameters)) if motor.transmission.parameters else 0
            declared = motor.transmission.order or known
            return declared + 1 if declared else _START_ORDER
        return 1 if not model.shape_names else max(_START_ORDER, 1 + len(model.shape_names))

    def reset(self) -> None:
        """Forget everything."""
        transmission = self._motor.transmission
        known = None
        if self._target is not None and transmission.parameters:
            known = self._target.alpha(transmission.parameters)
        start = self._target
        if start is None or (start.shape_names and known is None):
            start = Polynomial()
        self._basis: TransmissionModel = start
        size = self._slots if isinstance(start, Polynomial) else 1 + len(start.shape_names)
        self.shape: tuple[float, ...] = tuple(known[1:]) if known is not None and start.shape_names else ()
        memory = _LOCAL_MEMORY_S if self._black_box else _MEMORY_S
        self.regression = Regression(
            start,
            known,
            size,
            self._motor.inertia_kg_m2,
            self._motor.viscous_damping_nm_s_rad,
            self._T,
            1.0 + self._dt / memory,
            self._black_box,
            cut_off=self._target is not None
            and self._target.linear is None  # as many powers as one likes, so one more can be left out
            and bool(transmission.order or transmission.parameters),
        )
        self._alpha: list[float] = []
        self._known = known
        self._updates = 0
        self._accounts = 0
        self._order_at = self._order
        self._taken: tuple[FloatArray, float] | None = None
        self._delay_at = 0
        self._pending: tuple[FloatArray, float, float, bool, bool, float] | None = None
        self._surprise = 1.0  # mean square of the innovations over what is foreseen of it
        self._mean = self._varies = self._varied = self._missed_square = 0.0
        self._missing = self._strange = 0
        self._contradicted = False  # whether the data want another motor than the declared one
        self._reach = 0.0
        # Of the last innovations: their squares, and what variance was foreseen for them besides the noise.
        self._window: deque[tuple[float, float]] = deque(maxlen=_ALARM_UPDATES)
        self._recent = 0.0
        self._flush = 0.0
        self._follow = 0.0
        self._impossible = 0
        self._held_s = 0.0
        self.changed = False
        self.excited = False
        self.misfit_nm = math.nan
        self._trusted = False  # whether the curve has been good enough to read torques off it
        self._shift = self._late_s = self._offset_nm = 0.0  # what the link encoder is off and late by
        self.deflection_variance = 0.0
        self.acting_nm = 0.0  # flexibility torque (less offset) that moved the motor over the last period
        self.stiffness = 0.0
        self.unmodelled_nm = math.inf
        self.inertia = self._motor.inertia_kg_m2
        self.damping = self._motor.viscous_damping_nm_s_rad
        self._lead_torque, self._lead_rate = math.nan, 0.0
        self._std = math.nan

    @property
    def shaped(self) -> bool:
        """Whether the transmission's model has parameters that enter nonlinearly."""
        return self._target is not None and bool(self._target.shape_names)

    @property
    def due(self) -> bool:
        """Whether to look at the nonlinear model's linearisation now."""
        return self._updates > 0 and self._updates % self._soon == 0 and self.excited

    # -- channels ----------------------------------------------------------------------------------

    def along(self, phi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(torque, stiffness) at deflections as they are measured, (n,); zeros before anything is known."""
        if self._alpha:
            model, alpha, phi = self._basis, self._alpha, phi + self._shift
        elif self._known is not None and self._target is not None:
            model, alpha = self._target, self._known.tolist()
        else:
            return np.zeros_like(phi), np.zeros_like(phi)
        return model.torque(phi, alpha), model.stiffness(phi, alpha)

    def columns(self, phi: FloatArray) -> FloatArray:
        """What this track's basis channels take in at deflections (n,): (n, channels)."""
        out = np.zeros((len(phi), self.channels))
        if isinstance(self._basis, Polynomial):
            square = phi * phi
            power = phi
            for h in range(self._slots):
                out[:, h] = power
                power = power * square
            out[:, -1] = square
        else:
            alpha = (1.0, *self.shape)
            out[:, : len(alpha)], out[:, -1] = self._basis.tangent(phi, alpha)
        return out

    # -- one update --------------------------------------------------------------------------------

    def update(self, signals: Signals, excited: bool, usable: bool, late_s: float, noise_rad: float) -> None:
        """Take in the filtered signals of one update, which are late_s old."""
        regression = self.regression
        self.excited = excited
        regression.resolution_rad = noise_rad
        B, D = self._motor.inertia_kg_m2, self._motor.viscous_damping_nm_s_rad
        motor, torque = signals.motor, signals.torque
        balance = B * motor[2] + D * motor[1] + signals.effects[0] - torque[0]
        self._lead_rate = B * motor[3] + D * motor[2] + signals.effects[1] - torque[1]
        self._lead_torque = balance + late_s * self._lead_rate
        if regression.filter is None:
            if usable:
                regression.observe_scale(signals)
            if not (usable and excited):
                return
            regression.start()
        kalman = regression.filter
        assert kalman is not None
        h, y = regression.equation(signals)
        innovation = kalman.innovation(h, y)
        if usable and self._is_no_curve(innovation):
            self._flush = max(self._flush, _FLUSH_DELAYS * late_s)
            return
        if usable and regression.observe_scale(signals):
            h, y = regression.equation(signals)
            innovation = kalman.innovation(h, y)
        self.misfit_nm = innovation * regression.torque_unit
        self._held_s += self._dt
        self._pending = (h, y, innovation, usable, usable and excited, late_s)

    def _is_no_curve(self, innovation: float) -> bool:
        """Whether something hit the channels that was no motion of this joint."""
        settled = self._updates >= self._settled and self._strange * self._dt <= _NO_CURVE_S
        if not settled or abs(innovation) < _NO_CURVE:
            self._strange = 0
            return False
        self._strange += 1
        return True

    def learn(self) -> None:
        """Second part of an update: the alarm and the noise."""
        kalman = self.regression.filter
        if self._pending is None or kalman is None:
            return
        h, y, innovation, usable, telling, late_s = self._pending
        self._pending = None
        if usable and self._updates >= self._few:
            self._hold_against(y, innovation, telling)
        spread = kalman.spread(h)
        self._watch(innovation, spread, kalman.noise, usable, late_s)
        if usable and self._updates >= self._settled:
            self._compare(innovation, kalman.noise + spread)
        if telling and self._flush <= 0.0:
            self._held_s = 0.0
            if self._follow <= 0.0 and not self.suspicious:
                kalman.learn_noise(innovation, spread)
            self._taken = h, innovation
        kalman.remember(innovation, spread)

    def correct(self) -> None:
        """Third part: the parameters."""
        if self._taken is None or self.regression.filter is None:
            return
        self.regression.filter.update(*self._taken, _FLOOR**2)
        self._taken = None
        self._updates += 1

    def prepare(self) -> None:
        """Fourth part: what the last equation does to the covariance that is published."""
        if self.regression.filter is not None:
            self.regression.filter.prepare()

    def account(self) -> None:
        """Fifth part: that covariance, and what is decided now and then."""
        kalman = self.regression.filter
        if kalman is None:
            return
        kalman.account()
        if not kalman.finite:
            self._impossible = self._astray + 1
            return
        kalman.keep_bounded()
        self._impossible = self._impossible + 1 if self._is_impossible() else 0
        self._accounts += 1
        turn = self._accounts % self._often
        if turn == 0:
            kalman.keep_regular()
        elif turn == 1:
            self.regression.relax()
        elif self._choose_order and self._updates >= self._order_at:
            self._order_at = self._updates + self._order
            self._draw_higher_orders()

    @property
    def astray(self) -> bool:
        """Whether the estimate has long been where it cannot be: no way back by small steps."""
        return self._impossible > self._astray or self._missing > self._astray

    def _hold_against(self, y: float, missed: float, telling: bool) -> None:
        """Does the curve explain the balance at all? What does not is never called valid."""
        gain = min(1.0, self._dt / _EXPLAINED_S)
        slow = min(1.0, self._dt / _VARIES_S)
        self._mean += slow * (y - self._mean)
        self._varies += slow * ((y - self._mean) ** 2 - self._varies)
        self._varied = max(self._varied * (1.0 - self._dt / _VARIED_S), self._varies)
        self._missed_square += gain * (missed * missed - self._missed_square)
        if self.explains:
            self._missing = 0
        elif telling and self._follow <= 0.0:
            self._missing += 1

    def _compare(self, innovation: float, foreseen: float) -> None:
        """The normalised innovation squared, averaged."""
        most = (_TWICE * _SURPRISING) ** 2
        square = most if self._flush > 0.0 else innovation * innovation / (foreseen + _ALARM_SHARE**2)
        self._surprise += min(1.0, self._dt / _EXPLAINED_S) * (min(square, most) - self._surprise)

    @property
    def suspicious(self) -> bool:
        """Whether the balance is not explained within its own interval.

        That interval is the one of good times: the noise is not learned from what is suspicious.
        """
        return self._surprise > _SURPRISING**2

    @property
    def explains(self) -> bool:
        """Whether the curve leaves only a part of the balance unexplained."""
        share = _UNEXPLAINED_LOCAL if self._black_box else _UNEXPLAINED
        return self._missed_square <= share * max(self._varies, _QUIET * self._varied)

    def _is_impossible(self) -> bool:
        if isinstance(self._basis, Polynomial):
            return False
        k, *shape = self.regression.alpha.tolist()
        return bool(k <= 0.0) or self._basis.reach(shape) < 0.5 * self.regression.deflection_unit

    def publish(self, phi: float, link_rate: float) -> None:
        """Last part of an update: what the ticks until the next one say, and how sure it is."""
        if self.regression.filter is None:
            return
        self._publishable()
        self._std = self._stiffness_std(phi + self._shift + self._late_s * link_rate, link_rate)
        self._reach = _BEYOND * self.regression.deflection_peak
        if not isinstance(self._basis, Polynomial):
            self._reach = min(self._reach, _EDGE * self._basis.reach(self.regression.alpha[1:].tolist()))
        if self._contradicted or self.suspicious or not self.explains:
            self._reach = 0.0

    def _watch(self, innovation: float, spread: float, noise: float, usable: bool, late_s: float) -> None:
        """The innovation alarm, and what follows it: flush the filters, open up, follow."""
        self._follow = max(0.0, self._follow - self._dt)
        if not usable:
            self._window.clear()
            return
        if self._flush > 0.0:
            self._flush -= self._dt
            if self._flush <= 0.0:
                self.regression.open_up(_STEP)
                self._window.clear()
            return
        self._window.append((innovation * innovation, spread))
        if self._updates < self._settled or len(self._window) < _ALARM_UPDATES:
            self.changed = False
            return
        mean = sum(square for square, _ in self._window) / _ALARM_UPDATES
        foreseen = noise + sum(variance for _, variance in self._window) / _ALARM_UPDATES
        if mean > _ALARM_SIGMA**2 * foreseen + _ALARM_SHARE**2:
            self._flush = _FLUSH_DELAYS * late_s if self._follow <= 0.0 else 0.5 * late_s
            self._follow = _FOLLOW_S
        self.changed = self._follow > 0.0

    def _draw_higher_orders(self) -> None:
        """Draw the highest powers towards zero, down to the first one that the data want.

        As far as a prior does that is as wide as the power is large or uncertain: what is not significant may
        still be there, and matters most at large deflections. In the filter's memory it is drawn a few times.
        """
        kalman = self.regression.filter
        assert kalman is not None
        for h in range(self.regression.size - 1, 0, -1):
            square = kalman.x[h] ** 2 / max(kalman.Sigma[h, h], 1e-300)
            if square > _ORDER_SIGMA**2:
                break
            kalman.draw(h, max(float(square), 1.0) * _MEMORY_S / _ORDER_S)

    def _publishable(self) -> None:
        regression = self.regression
        values, n = regression.values(), regression.size
        self._alpha = values[:n]
        inertia, damping, coulomb, self._offset_nm, self._late_s, self._shift = values[n:]
        damping += self._motor.viscous_damping_nm_s_rad
        self._contradicted = (
            abs(inertia) > _INERTIA_OFF * self._motor.inertia_kg_m2
            or damping * regression.rate_unit < -_DRIVING * regression.torque_unit
        )
        if not self._contradicted:
            self.inertia = inertia + self._motor.inertia_kg_m2
            self.damping = max(damping, 0.0)
        assert regression.filter is not None
        noise = math.sqrt(regression.filter.noise) * regression.torque_unit
        self.unmodelled_nm = math.hypot(noise, coulomb)

    def take_delay(self) -> float:
        """How many periods later than assumed the link is, where that has become clear; else 0."""
        regression = self.regression
        if self._black_box or self._updates - self._delay_at < self._delay:
            return 0.0
        late, std = regression.delay()
        if abs(late) < _DELAY_PERIODS or abs(late) < 3.0 * std:
            return 0.0
        self._delay_at = self._updates
        return late

    def reopen_shift(self) -> None:
        """An encoder has moved its zero: the deflection's offset is not what it was to the last digit."""
        self.regression.reopen_shift()

    def relearn(self) -> None:
        """What was learned came from channels that were not aligned."""
        self.reset()

    def shift_delay(self, periods: float) -> None:
        """The channels have been aligned by so much more."""
        self.regression.shift_delay(periods)
        self._late_s -= periods * self._T

    def hand_over(self, phi_past: FloatArray, bank: FilterBank, first: int, responses: FloatArray) -> None:
        """Go over from the polynomial to the nonlinear model, or linearise that anew, when it is due.

        Args:
            phi_past: deflections of the last ticks, oldest first.
            bank: the filters.
            first: this track's first basis channel.
            responses: see FilterBank.remember.
        """
        target, regression = self._target, self.regression
        if target is None or not target.shape_names or regression.filter is None:
            return
        if self._basis is not target:
            adopted = self._to_model(
                target, regression.alpha, regression.covariance, regression.deflection_unit
            )
            if adopted is None:
                return
            self._basis = target
            regression.adopt(*adopted, target)
        else:
            if not regression.off_tangent(_OFF_TANGENT):
                return
            regression.relinearise()
        assert regression.alpha0 is not None
        self.shape = tuple(regression.alpha0[1:].tolist())
        columns, slope = target.tangent(phi_past, (1.0, *self.shape))
        bank.replace(first, columns, responses)
        bank.replace(first + self._slots, slope[:, None], responses)
        self._publishable()

    # -- what it says ------------------------------------------------------------------------------

    def estimate(self, phi: float, aligned: float, link_rate: float) -> tuple[TransmissionEstimate, bool]:
        """The estimate at a deflection, and whether it is of use.

        Args:
            phi: of this moment, as the encoders have it.
            aligned: of the last moment that all channels have told of.
            link_rate: of the link, rad/s.
        """
        alpha, lead = self._alpha, self._lead_torque
        self._lead_torque = lead + self._T * self._lead_rate  # until the next update
        if not alpha:
            if self._known is None or self._target is None:
                return TransmissionEstimate(lead, math.nan, math.nan, phi), False
            torque, stiffness = self._target.at(phi, self._known.tolist())
            if self._elastic.active:
                extra, slope = self._elastic.at(phi)
                torque, stiffness = torque + extra, stiffness + slope
            return TransmissionEstimate(torque, stiffness, math.nan, phi), False
        off = self._shift + self._late_s * link_rate
        ahead = phi != aligned
        phi += off
        torque, stiffness = self._basis.at(phi, alpha)
        acted = self._basis.at(aligned + off, alpha)[0] if ahead else torque
        self.acting_nm = acted - self._offset_nm
        more = 0.0
        if self._elastic.active:
            more, slope = self._elastic.at(phi)
            torque, stiffness = torque + more, stiffness + slope
        std = self._std
        if self._held_s > _RESTED_S:
            std = math.hypot(std, min(_DRIFT * self._held_s, _WIDEST) * stiffness)
        valid = 0.0 < std < _VALID * stiffness and -self._reach < phi < self._reach
        if valid and not self._black_box:
            self._trusted = True
        elif not self._reach:
            self._trusted = False
        self.stiffness = stiffness if self._trusted else 0.0
        if not self._trusted:
            self.acting_nm, torque = lead, lead + more
        return TransmissionEstimate(torque, stiffness, std, phi), valid

    def _stiffness_std(self, phi: float, link_rate: float) -> float:
        """From the covariance of alpha and of the deflection that sigma is read off at."""
        by_alpha, slope = self._basis.stiffness_slopes(phi, self._alpha)
        variance = self.regression.variance(by_alpha, slope * link_rate, slope)
        variance += slope * slope * self.deflection_variance
        return math.sqrt(max(variance, 0.0))

    def parameters(self) -> dict[str, Any]:
        """{"model", "parameters", "std"}, names as in the joint file."""
        if self._black_box or not self._alpha:
            return {"model": UNKNOWN if self._black_box else self._basis.name, "parameters": {}, "std": {}}
        std = UNSEEN * np.sqrt(np.maximum(np.diag(self.regression.covariance), 0.0))
        values: dict[str, ParameterValue] = self._basis.parameters(self._alpha)
        return {"model": self._basis.name, "parameters": values, "std": self._basis.parameters(std)}
