"""The deflection of this moment: what a controller wants, without the delay of the regression's filter.

A steady-state Kalman filter with the states [theta, theta', phi, phi', phi'']: the motor moves by its own
equation (eq 5, with the stiffness that has been estimated), the deflection by a random third derivative,
and theta and q = theta + phi are measured. Where encoders are coarse it so leans on the torque balance,
where they are fine on the encoders. Its covariance is iterated at the update rate, not at every tick.

That covariance is a model's: of white noise and of a white third derivative, at a bandwidth with limits. Fine
encoders break it, as their steps are neither. So the innovations of phi are held against it: where their mean
square e² is more than the S = P + R it foresees, the covariance is e²/S times as large (the normalised
innovation squared of Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4), and so is the square of what counts as lost.
"""

from __future__ import annotations

import math

from estimator.covariance import Covariance

__all__ = ["DeflectionFilter"]

_JERK_S = 1.0  # over which the mean squares of phi''' and of the innovations are taken
_JERK_HOLD_S = 30.0  # how long a lively phase is remembered
_LIVELY = 8.0  # the regression's filter hides this much of the square of phi'''
_CORRELATION_S = 0.05  # of the third derivative and of unmodelled torques
_SLOWEST, _FASTEST = 0.5, 10.0  # bandwidth for phi, over that of the regression's filter
_UNSETTLED = 6.0  # time constants of the plain filter until a new start is forgotten
_PLAIN = 3.0  # its bandwidth, over that of the regression's filter
_LOST = 12.0  # standard deviations: so far off, the filter starts anew where the encoders are
_STIFF = 0.3  # sigma T²/B above which the motor's equation is not integrated any more


class DeflectionFilter:
    """See the module. The joint feeds it every tick, and `tune`s it at every update.

    Args:
        inertia: B. damping: D.
        bandwidth_rad_s: of the regression's filter.
        period_s: T.
        dt_s: time between two updates.

    Attributes:
        unsettled: periods until the last start is forgotten; zero or less: it is.
    """

    def __init__(
        self, inertia: float, damping: float, bandwidth_rad_s: float, period_s: float, dt_s: float
    ) -> None:
        self._B, self._D, self._w, self._T = inertia, damping, bandwidth_rad_s, period_s
        self._average = min(1.0, dt_s / _JERK_S)
        self._average_tick = min(1.0, period_s / _JERK_S)
        self._fade = math.exp(-dt_s / _JERK_HOLD_S)
        # Before anything is known: both positions through g-h-k filters.
        p = math.exp(-_PLAIN * bandwidth_rad_s * period_s)
        g, h = 1.0 - p**3, 1.5 * (1.0 - p) ** 2 * (1.0 + p) / period_s
        self._plain_theta = [g, h, 0.0, 0.0, 0.0]
        self._plain_phi = [0.0, 0.0, g, h, (1.0 - p) ** 3 / period_s**2]
        self._settling = math.ceil(_UNSETTLED / (_PLAIN * bandwidth_rad_s * period_s))
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._jerk = self._peak = 0.0
        self._P: Covariance | None = None
        self._modelled = False  # whether the motor's equation is of use
        self._gain_theta, self._gain_phi = self._plain_theta, self._plain_phi
        self._band_square = math.inf
        self._surprise_square = 0.0  # mean square of the innovations of phi …
        self._inconsistent = 1.0  # … over what the covariance foresees of it, where it is more
        self._pull = 0.0  # what half a period of phi' adds to the motor's mean acceleration
        self._motor_square = self._link_square = self._counted = 0.0
        self.restart(0.0, 0.0)

    def restart(self, theta: float, phi: float) -> None:
        """At rest here, as far as one knows: until the rates have been found, plain filters."""
        self._x = (theta, 0.0, phi, 0.0, 0.0)
        self.unsettled = self._settling

    def at(self, ahead_s: float) -> float:
        """Phi, a little ahead of the last sample."""
        return self._x[2] + ahead_s * (self._x[3] + 0.5 * ahead_s * self._x[4])

    @property
    def link_rate(self) -> float:
        """Velocity of the link at the last sample, rad/s."""
        return self._x[1] + self._x[3]

    @property
    def variance(self) -> float:
        """Variance of phi: the filter's, or that of as many counts as pass while it averages.

        A quantised position errs alike until the next count, so in a memory 1/w there are 1 + rate/(w count)
        independent errors that average out.
        """
        return 0.0 if self._P is None else max(self._inconsistent * self._P.phi_phi, self._counted)

    def update(self, theta: float, phi: float, torque: float) -> None:
        """One period later: measured theta and phi, and the torque that acted, tau + tau_e - x, N·m."""
        T = self._T
        x0, x1, x2, x3, x4 = self._x
        plain = self.unsettled > 0
        a = 0.0 if plain or not self._modelled else (torque - self._D * x1) / self._B + self._pull * x3
        x0 += T * (x1 + 0.5 * T * a)
        x1 += T * a
        x2 += T * (x3 + 0.5 * T * x4)
        x3 += T * x4
        e, f = theta - x0, phi - x2
        if plain:
            self.unsettled -= 1
            g, h = self._plain_theta, self._plain_phi
        elif self.unsettled > -self._settling:  # what the plain filters lag by is no surprise
            self.unsettled -= 1
            g, h = self._gain_theta, self._gain_phi
        else:
            square = f * f
            if not square < self._band_square:
                # Just lost, however far, for as long as a new start takes: one jump tells little of the
                # filter, one after the other does.
                self._surprise(self._band_square, self._settling)
                self.restart(theta, phi)
                return
            self._surprise(square, 1)
            g, h = self._gain_theta, self._gain_phi
        self._x = (
            x0 + g[0] * e + h[0] * f,
            x1 + g[1] * e + h[1] * f,
            x2 + g[2] * e + h[2] * f,
            x3 + g[3] * e + h[3] * f,
            x4 + g[4] * e + h[4] * f,
        )

    def _surprise(self, square: float, periods: int) -> None:
        """Average the square of an innovation that stands for so many periods."""
        self._surprise_square += min(1.0, periods * self._average_tick) * (square - self._surprise_square)

    def adopt(self, inertia: float, damping: float) -> None:
        """B and D as they have turned out to be."""
        self._B, self._D = inertia, damping

    def tune(
        self, jerk: float, motor_noise: float, link_noise: float, stiffness: float, unmodelled_nm: float
    ) -> None:
        """One step towards the steady-state gains.

        Args:
            jerk: phi''' of the regression's filter.
            motor_noise: variance of theta.
            link_noise: variance of q.
            stiffness: sigma; 0 where it is not known yet.
            unmodelled_nm: rms of what the motor's equation leaves unexplained; inf: it is not used at all.
        """
        T, w = self._T, self._w
        self._jerk += self._average * (_LIVELY * jerk * jerk - self._jerk)
        self._peak = max(self._fade * self._peak, self._jerk)
        noise = motor_noise + link_noise
        if not (noise > 0.0 and self._peak > 0.0 and unmodelled_nm < math.inf):
            return
        density = noise * T
        natural = (max(self._jerk, 0.1 * self._peak) * _CORRELATION_S / density) ** (1.0 / 6.0)
        natural = min(max(natural, _SLOWEST * w), _FASTEST * w)
        self._count_steps(motor_noise, link_noise, natural)
        c = max(stiffness, 0.0) / self._B
        drift = (unmodelled_nm / self._B) ** 2 * _CORRELATION_S
        if not (c * T * T < _STIFF and drift < noise * w**4 * 1e6):
            c, drift = 0.0, noise * w**4
        self._modelled = c > 0.0
        self._pull = 0.5 * c * T
        P = self._P
        if P is None:
            P = Covariance.diagonal(noise, noise * w**2, noise, noise * w**2, noise * w**4)
        damped = 1.0 - T * self._D / self._B
        P = P.move(T, c * T, damped, drift * T, density * natural**6 * T)
        gains = P.gains(motor_noise, noise)
        if gains is None:
            self._P = None
            return
        self._gain_theta, self._gain_phi = gains
        self._P = P.measure(*gains)
        foreseen = P.phi_phi + noise
        self._inconsistent = max(1.0, self._surprise_square / foreseen)
        self._band_square = _LOST**2 * self._inconsistent * foreseen

    def _count_steps(self, motor_noise: float, link_noise: float, memory_rad_s: float) -> None:
        """The variance of phi that quantisation leaves, were all noise quantisation."""
        rate, deflecting = self._x[1], self._x[3]
        self._motor_square += self._average * (rate * rate - self._motor_square)
        self._link_square += self._average * ((rate + deflecting) ** 2 - self._link_square)
        counted = 0.0
        for noise, square in ((motor_noise, self._motor_square), (link_noise, self._link_square)):
            if noise > 0.0:
                counted += noise / (1.0 + math.sqrt(square / (12.0 * noise)) / memory_rad_s)
        self._counted = counted
