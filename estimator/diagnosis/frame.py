"""A recording as regression rows: coordinates of every part of the joint, and the balances of its equations.

Two zero-phase filters act on all channels. The light one, G, gives smooth coordinates for nonlinear terms at
a reduced rate; the second, F, has the bandwidth of the diagnosis and gives the rows. The torque of row k acts
from t_k to t_(k+1): its hold, a delay of half a period and sin(x)/x, is part of G.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.choices import choice, least_rows, rate, whole
from estimator.diagnosis.spectral import Band, Spectrum, lowpass
from estimator.effects import Coordinates
from estimator.gate import at_limit
from estimator.model import JointModel, LinkDynamics
from estimator.sample import FloatArray, Record

__all__ = ["Corrections", "Frame", "Signals", "count_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Corrections:
    """Corrections of the readings, applied before anything else.

    Attributes:
        torque_delay_s: per motor, delay of the acting torque after the reported one.
        torque_lag_s: per motor, time constant by which the acting torque lags the reported one, in first
            order; negative: the reported one lags.
        offset_rad: per motor, reading of a zero deflection.
        encoder_delay_s: delay of the link position after the other channels.
        deflection_delay_s: delay of a deflection's sensor, read beside the first motor's position.
        encoder_sin_rad: error of the link reading per sin(q).
        encoder_cos_rad: per cos(q).
        encoder_scale: per q.
    """

    torque_delay_s: tuple[float, ...]
    torque_lag_s: tuple[float, ...]
    offset_rad: tuple[float, ...]
    encoder_delay_s: float = 0.0
    deflection_delay_s: float = 0.0
    encoder_sin_rad: float = 0.0
    encoder_cos_rad: float = 0.0
    encoder_scale: float = 0.0

    @classmethod
    def none(cls, motors: int) -> Corrections:
        """Return no corrections."""
        none = (0.0,) * motors
        return cls(torque_delay_s=none, torque_lag_s=none, offset_rad=none)


class Signals:
    """Spectra of the raw channels, and their noise.

    Args:
        record: the recording; gaps are interpolated and not used as rows.
        bandwidth_hz: of F.

    Attributes:
        resolution_rad: of each motor's deflection: one count of each of its encoders.
        clipped: share of the samples whose torque rests on its limit, which no row is near.
        memo: columns that depend on the motors' motion alone, by effect and shape (`candidates.columns`).
    """

    def __init__(self, record: Record, bandwidth_hz: float) -> None:
        sequence = record.sequence - record.sequence[0]
        self.samples = int(sequence[-1]) + 1
        self.period_s = record.period_s
        self.bandwidth_hz = bandwidth_hz
        unbroken = self.samples == len(sequence)
        grid = np.arange(self.samples)

        def bridged(x: FloatArray) -> FloatArray:
            return x if unbroken else np.interp(grid, sequence, x)

        step = max(1, int(1.0 / (record.period_s * rate() * choice("harmonics") * bandwidth_hz)))
        margin = choice("edge") / bandwidth_hz
        self.light = Band(self.samples, record.period_s, step, margin)
        link = record.link_position_rad
        self.theta = [self.light.transform(bridged(x)) for x in record.motor_position_rad.T]
        self.tau = [self.light.transform(bridged(x)) for x in record.motor_torque_nm.T]
        self.q = None if link is None else self.light.transform(bridged(link))
        self._counts = [count_of(x) for x in record.motor_position_rad.T]
        self._link_count = 0.0 if link is None else count_of(link)
        self.resolution_rad = tuple(count + self._link_count for count in self._counts)
        external = record.external_torque_nm
        self.external = None if external is None else self.light.transform(bridged(external))
        rows_step = max(1, int(1.0 / (self.light.period_s * rate() * bandwidth_hz)))
        self.narrow = Band(self.light.kept, self.light.period_s, rows_step, margin)
        self.response = lowpass(self.narrow.frequency_hz, bandwidth_hz)
        self.clipped = 0.0
        self.keep = self._rows(record, sequence, margin)
        self.memo: dict[tuple[object, ...], FloatArray] = {}
        self._smooth = light_response(self)
        frequency = self.light.frequency_hz * record.period_s
        self._held = self._smooth * np.sinc(frequency) * np.exp(-1j * np.pi * frequency)

    @functools.cached_property
    def motor_paths(self) -> list[tuple[FloatArray, ...]]:
        """Position, velocity and acceleration of each motor on the grid."""
        return [tuple(self.light.apply(x, self._smooth, order) for order in range(3)) for x in self.theta]

    @functools.cached_property
    def external_torque(self) -> FloatArray:
        """tau_k on the grid, zero if not measured."""
        if self.external is None:
            return np.zeros(self.light.kept)
        return self.light.apply(self.external, self._smooth)

    def acting(self, i: int, delay_s: float, lag_s: float) -> tuple[FloatArray, FloatArray]:
        """Return a motor's torque as it acts, and its derivative, on the grid."""
        response = self._held * _lag(self.light.frequency_hz, lag_s) if lag_s else self._held
        torque, rate = (self.light.apply(self.tau[i], response, order, delay_s) for order in range(2))
        return torque, rate

    def link_path(self, corrections: Corrections) -> tuple[FloatArray, ...]:
        """Return the link's position, velocity and acceleration, corrected for the encoder's error."""
        assert self.q is not None
        sensor = corrections.deflection_delay_s
        late = corrections.encoder_delay_s + sensor
        q, rate, acceleration = (self.light.apply(self.q, self._smooth, order, -late) for order in range(3))
        if sensor:
            now = self.motor_paths[0]
            then = (self.light.apply(self.theta[0], self._smooth, order, -sensor) for order in range(3))
            q, rate, acceleration = (
                x + a - b for x, a, b in zip((q, rate, acceleration), now, then, strict=True)
            )
        a, b, scale = corrections.encoder_sin_rad, corrections.encoder_cos_rad, corrections.encoder_scale
        if not (a or b or scale):
            return q, rate, acceleration
        true = q / (1.0 + scale)
        for _ in range(3):
            true = (q - a * np.sin(true) - b * np.cos(true)) / (1.0 + scale)
        slope = 1.0 + scale + a * np.cos(true) - b * np.sin(true)
        bend = -a * np.sin(true) - b * np.cos(true)
        velocity = rate / slope
        return true, velocity, (acceleration - bend * velocity**2) / slope

    def _rows(self, record: Record, sequence: NDArray[np.int64], edge: float) -> NDArray[np.bool_]:
        """Rows so many seconds away from ends and gaps and, if enough are left, from clipped torques."""
        time = np.arange(self.narrow.kept) * self.narrow.period_s
        end = (self.samples - 1) * record.period_s

        def away(spans: NDArray[np.int64]) -> NDArray[np.bool_]:
            first, last = spans.T * record.period_s
            near = np.zeros(len(time) + 1)
            np.add.at(near, np.searchsorted(time, first - edge), 1.0)
            np.add.at(near, np.searchsorted(time, last + edge, side="right"), -1.0)
            return np.asarray(np.cumsum(near[:-1]) == 0.0)

        gaps = np.flatnonzero(np.diff(sequence) > whole("bridged"))
        keep = (time >= edge) & (time <= end - edge) & away(sequence[np.stack([gaps, gaps + 1], axis=1)])
        limits = at_limit(record)
        clear = keep & away(sequence[limits])
        if not len(limits) or np.count_nonzero(clear) < least_rows():
            return keep
        self.clipped = float(np.sum(np.diff(limits) + 1)) / len(record)
        return clear

    @functools.cached_property
    def rounding_rad(self) -> tuple[float, ...]:
        """Rms error of each motor's deflection by rounding, within the bandwidth."""
        link = 0.0 if self.q is None else self._rounded(self.q, self._link_count)
        pairs = zip(self.theta, self._counts, strict=True)
        return tuple(float(np.hypot(self._rounded(x, count), link)) for x, count in pairs)

    def _rounded(self, spectrum: Spectrum, count: float) -> float:
        """Rms that rounding leaves of a reading in the rows, over all places of its counts.

        It is c / sqrt(12) where the reading rests, and averages out where it passes many counts.
        """
        if not count:
            return 0.0
        time, points = np.arange(self.samples) * self.period_s, np.arange(self.light.kept)
        path = np.interp(time, points * self.light.period_s, self.light.apply(spectrum, self._smooth)) / count
        squares = []
        for place in np.arange(whole("groups")) / whole("groups"):
            error = np.floor(path + place) + 0.5 - path - place
            smooth = self.light.apply(self.light.transform(error), self._smooth)
            squares.append(np.mean(self.narrow.filter(smooth, self.response)[self.keep] ** 2))
        return count * float(np.sqrt(np.mean(squares)))

    def noise(self, spectrum: Spectrum, response: NDArray[Any]) -> float:
        """Return the variance of a channel's white noise after a filter; the noise is read
        from the upper end.

        Args:
            spectrum: of the channel.
            response: of the filter at the frequencies of `light`.
        """
        power = np.abs(spectrum[0]) ** 2
        white = float(np.median(power[int(choice("tail") * len(power)) :]) / np.log(2.0))
        return 2.0 * white * float(np.sum(np.abs(response) ** 2)) / self.light.length**2

    def velocity_noise(self, motor: int) -> float:
        """Return the standard deviation of a motor's velocity behind the light filter, rad/s."""
        frequency = self.light.frequency_hz
        response = 2.0 * np.pi * frequency * light_response(self)
        return float(np.sqrt(self.noise(self.theta[motor], response)))

    def position_noise(self, motor: int) -> tuple[float, float, float]:
        """Return the variances of a motor's velocity, acceleration and deflection by the positions' noise
        within the bandwidth, in rad and s.
        """
        read = 0.0 if self.q is None else self._within(self.q, 0)
        position, velocity, acceleration = (self._within(self.theta[motor], order) for order in range(3))
        return velocity, acceleration, position + read

    def row_noise(self, link: LinkDynamics, stiffness: FloatArray) -> float:
        """Return the variance of a row of the link's balance by its positions' noise, (N·m)²."""
        if self.q is None:
            return 0.0
        read = float(np.mean(stiffness**2)) * self.position_noise(0)[2]
        return link.inertia_kg_m2**2 * self._within(self.q, 2) + read

    def _within(self, spectrum: Spectrum, order: int) -> float:
        """Variance of a position's noise within the bandwidth, or of its derivative's."""
        frequency = self.light.frequency_hz
        response = light_response(self) * lowpass(frequency, self.bandwidth_hz)
        return self.noise(spectrum, (2.0 * np.pi * frequency) ** order * response)


def count_of(reading: FloatArray) -> float:
    """Return the resolution of a reading (n,), from its steps."""
    steps = np.abs(np.diff(reading))
    return float(np.quantile(steps[steps > 0.0], 0.01)) if np.any(steps > 0.0) else 0.0


def _lag(frequency_hz: FloatArray, time_constant_s: float) -> NDArray[Any]:
    """1 / (1 + s T), or its inverse where T is negative."""
    lag = 1.0 + 2j * np.pi * frequency_hz * abs(time_constant_s)
    return lag if time_constant_s < 0.0 else 1.0 / lag


def light_response(signals: Signals) -> FloatArray:
    """Return the response of G."""
    return lowpass(
        signals.light.frequency_hz, min(choice("harmonics") * signals.bandwidth_hz, 0.45 / signals.period_s)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Coordinates on the grid and the equations' balances as rows.

    Attributes:
        model: the joint as declared.
        signals: its source.
        corrections: applied to the readings.
        motors: coordinates per motor; flexibility torque and stiffness are filled in by the base fit.
        external: tau_k on the grid, zero if not measured.
        linked: whether it has the link's equation.
        flexible: per motor, whether it has a deflection.
        memo: its columns, by effect and shape (`candidates.columns`).
    """

    model: JointModel
    signals: Signals
    corrections: Corrections
    motors: tuple[Coordinates, ...]
    external: FloatArray
    linked: bool
    flexible: tuple[bool, ...]
    equations: int = field(init=False)
    memo: dict[tuple[object, ...], FloatArray] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "equations", len(self.motors) + int(self.linked))

    @classmethod
    def make(cls, model: JointModel, signals: Signals, corrections: Corrections) -> Frame:
        """Make the coordinates from the spectra of the corrected readings."""
        zero = np.zeros(signals.light.kept)
        time = np.arange(signals.light.kept) * signals.light.period_s
        flexible = tuple(m.transmission.model != "none" and signals.q is not None for m in model.motors)
        paths = signals.motor_paths
        link = signals.link_path(corrections) if any(flexible) else paths[0]
        motors = []
        for i, (theta, velocity, acceleration) in enumerate(paths):
            torque, rate = signals.acting(i, corrections.torque_delay_s[i], corrections.torque_lag_s[i])
            motors.append(
                Coordinates(
                    position=theta,
                    velocity=velocity,
                    acceleration=acceleration,
                    deflection=link[0] - theta - corrections.offset_rad[i] if flexible[i] else zero,
                    deflection_rate=link[1] - velocity if flexible[i] else zero,
                    flexibility_torque=zero,
                    stiffness=zero,
                    torque=torque,
                    torque_rate=rate,
                    link_position=link[0],
                    link_velocity=link[1],
                    link_acceleration=link[2],
                    time=time,
                )
            )
        linked = model.link is not None and flexible[0]
        return cls(model, signals, corrections, tuple(motors), signals.external_torque, linked, flexible)

    @property
    def rows(self) -> int:
        """Number of rows of one equation."""
        return int(np.count_nonzero(self.signals.keep))

    @property
    def rows_step(self) -> int:
        """Points of the grid in one row."""
        return round(self.signals.narrow.period_s / self.signals.light.period_s)

    @property
    def carried(self) -> bool:
        """Whether the link moves with the first motor, which then has the dynamics of both."""
        return not self.flexible[0]

    @property
    def pulls(self) -> tuple[bool, ...]:
        """Per motor, whether its transmission acts on the link (eqs 4, 9)."""
        second = self.model.arrangement == "antagonistic"
        return tuple(self.flexible[i] and (i == 0 or second) for i in range(len(self.motors)))

    def project(self, x: FloatArray) -> FloatArray:
        """Return f, decimation and choice of rows, for arrays (..., n) on the grid."""
        return self.signals.narrow.filter(x, self.signals.response)[..., self.signals.keep]

    def stack(self, parts: Sequence[FloatArray | None]) -> FloatArray:
        """Return the columns (..., n) of the stacked regression from their parts in each
        equation; None is zero.
        """
        like = next(part for part in parts if part is not None)
        return np.concatenate([np.zeros_like(like) if part is None else part for part in parts], axis=-1)

    def column(
        self, motor: int | None, on_motor: FloatArray | None, on_link: FloatArray | None
    ) -> FloatArray:
        """Return stacked, filtered columns of arrays (..., n) on the grid in one motor's and
        the link's equation.
        """
        given = on_link if on_motor is None else on_motor
        assert given is not None
        one = self.project(given)
        parts = [np.zeros_like(one)] * self.equations
        if motor is not None and on_motor is not None:
            parts[motor] = one
        if self.linked and on_link is not None:
            parts[-1] = one if on_link is given else self.project(on_link)
        return np.concatenate(parts, axis=-1)

    def link_balance(self, link: LinkDynamics) -> FloatArray:
        """Return tau_k - M q" - D_q q' - g(q) on the grid, which is tau_e by eq 4."""
        c = self.motors[0]
        gravity = link.gravity_nm * np.sin(c.link_position + link.gravity_phase_rad)
        own = link.inertia_kg_m2 * c.link_acceleration + link.viscous_damping_nm_s_rad * c.link_velocity
        return np.asarray(self.external - own - gravity)

    def motor_balance(self, i: int) -> FloatArray:
        """Return B theta" + D theta' - tau on the grid, which is tau_e by eq 5."""
        motor, link, c = self.model.motors[i], self.model.link, self.motors[i]
        own = motor.inertia_kg_m2 * c.acceleration + motor.viscous_damping_nm_s_rad * c.velocity
        if link is not None and self.carried and i == 0:
            own = own - self.link_balance(link)
        return np.asarray(own - c.torque)

    def target(self) -> FloatArray:
        """Return the stacked balances as rows."""
        parts: list[FloatArray | None] = [
            self.project(self.motor_balance(i)) for i in range(len(self.motors))
        ]
        if self.linked and self.model.link is not None:
            parts.append(self.project(self.link_balance(self.model.link)))
        return self.stack(parts)
