"""Simulated drives and encoders: from set-points to acting torque, from angles to reported values.

A drive works at the motor shaft: joint position times gear ratio, joint torque divided by it. Its torque is
its current times its torque constant, so a reported torque is never better than the reported current.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim.effects.assembly import LinkParts, MotorParts, Reading
from sim.effects.memory import Delayed, Lag, PositionHistory
from sim.errors import SimError, require

RPM_RAD_S = 2.0 * math.pi / 60.0
"""One revolution per minute."""
_BLOCK = 4096


class DriveSignals(NamedTuple):
    """Signals of a drive at one sampling instant, at the motor shaft, with the drive's signs."""

    position_counts: int  # encoder counts since the joint's zero, unbounded (a bus object wraps it)
    velocity_rad_s: float  # actual velocity in steps of the drive's resolution
    current_a: float  # actual current, noise and resolution included
    torque_nm: float  # that current times the torque constant


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveHardware:
    """A drive, its motor's encoder and gear."""

    counts_per_rev: float = 4096.0  # encoder counts per revolution of the motor shaft
    gear_ratio: float = 1.0  # motor revolutions per joint revolution
    torque_constant_nm_a: float = 0.05  # torque at the motor shaft per ampere
    rated_current_a: float = 2.0  # the thousandth of it is the unit of the reported current
    max_current_a: float | None = None  # the drive's limit; None: three times the rated current
    # step of the reported current; None: a thousandth of the rated current
    current_resolution_a: float | None = None
    current_noise_a: float = 0.0  # standard deviation of the reported current (white, one draw a period)
    # step of the reported velocity at the shaft, 1 rpm on most drives
    velocity_resolution_rad_s: float = RPM_RAD_S
    direction: int = 1  # sign of the motor position against the joint's
    # sign of current and torque against the joint's; None: like direction
    torque_direction: int | None = None

    def __post_init__(self) -> None:
        for name in ("counts_per_rev", "gear_ratio", "torque_constant_nm_a", "rated_current_a"):
            require(name, getattr(self, name), positive=True)
        for name in ("max_current_a", "current_resolution_a"):
            if getattr(self, name) is not None:
                require(name, getattr(self, name), positive=True)
        for name in ("current_noise_a", "velocity_resolution_rad_s"):
            require(name, getattr(self, name), positive=False)
        for name in ("direction", "torque_direction"):
            if getattr(self, name) not in (1, -1, None):
                raise SimError(f"{name}: expected 1 or -1, got {getattr(self, name)!r}")

    @property
    def rated_torque_nm(self) -> float:
        """Torque at the motor shaft at rated current."""
        return self.torque_constant_nm_a * self.rated_current_a

    @property
    def limit_a(self) -> float:
        """Current limit of the drive."""
        return 3.0 * self.rated_current_a if self.max_current_a is None else self.max_current_a

    @property
    def current_step_a(self) -> float:
        """Step of the reported current."""
        step = self.current_resolution_a
        return self.rated_current_a / 1000.0 if step is None else step

    @property
    def counts_per_rad(self) -> float:
        """Signed counts per radian of the joint."""
        return self.direction * self.counts_per_rev * self.gear_ratio / (2.0 * math.pi)

    @property
    def joint_torque_per_ampere(self) -> float:
        """Signed torque at the joint per ampere, by the drive's torque constant."""
        sign = self.direction if self.torque_direction is None else self.torque_direction
        return sign * self.torque_constant_nm_a * self.gear_ratio


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkEncoder:
    """The encoder at the link."""

    counts_per_rev: float = 262144.0  # counts per revolution of the joint
    direction: int = 1  # sign against the joint's
    zero_rad: float = 0.0  # joint angle at which it reads zero
    noise_counts: float = 0.0  # standard deviation of its reading before it is rounded

    def __post_init__(self) -> None:
        require("counts_per_rev", self.counts_per_rev, positive=True)
        require("noise_counts", self.noise_counts, positive=False)
        if self.direction not in (1, -1):
            raise SimError(f"direction: expected 1 or -1, got {self.direction!r}")

    @property
    def counts_per_rad(self) -> float:
        """Signed counts per radian of the joint."""
        return self.direction * self.counts_per_rev / (2.0 * math.pi)


def noise(seed: tuple[int, ...], std: float) -> Iterator[float]:
    """Yield white Gaussian noise from a seed without end; zeros for std 0."""
    if std == 0.0:
        while True:
            yield 0.0
    generator = np.random.default_rng(seed)
    while True:
        yield from (std * generator.standard_normal(_BLOCK)).tolist()


class Amplifier:
    """A drive's current loop and its sampled signals.

    It reports the commanded current; effects change the acting torque.
    """

    def __init__(self, drive: DriveHardware, period_s: float, substeps: int, noise: Iterator[float]) -> None:
        """Switch the drive on."""
        self.drive = drive
        self.schedule = [0.0] * substeps
        self._substeps, self._period_s, self._noise = substeps, period_s, noise
        self._current_a, self._theta, self._velocity = 0.0, 0.0, 0.0
        self.fit(MotorParts())

    def fit(self, parts: MotorParts) -> None:
        """Add effects, from the next period on."""
        self._path, self._readings = tuple(parts.torque_path), tuple(parts.readings)
        delay = parts.torque_delay_s
        self._delay = Delayed(delay, self._period_s, self._substeps) if delay > 0.0 else None
        lag, step_s = parts.torque_lag_s, self._period_s / self._substeps
        self._acting = Lag(lag, step_s) if lag > 0.0 else None
        self._reported = Lag(-lag, self._period_s) if lag < 0.0 else None

    def latch(self, current_a: float, time_s: float, theta: float, velocity: float) -> None:
        """Start a period with this set-point, and sample.

        Args:
            theta: motor position at the joint, rad.
            velocity: motor velocity at the joint, rad/s.
        """
        drive = self.drive
        limit, step = drive.limit_a, drive.current_step_a
        current_a = min(max(current_a, -limit), limit)
        torque = current_a * drive.joint_torque_per_ampere
        for acting in self._path:
            torque = acting(torque, time_s, theta)
        self.schedule = [torque] * self._substeps if self._delay is None else self._delay.schedule(torque)
        if self._acting is not None:
            self.schedule = [self._acting.passed(each) for each in self.schedule]
        if self._reported is not None:
            current_a = self._reported.passed(current_a)
        self._current_a = step * round((current_a + next(self._noise)) / step)
        self._theta, self._velocity = theta, velocity

    def signals(self) -> DriveSignals:
        """Return the sampled signals."""
        drive, theta = self.drive, self._theta
        for read in self._readings:
            theta = read(theta)
        shaft = self._velocity * drive.gear_ratio * drive.direction
        resolution = drive.velocity_resolution_rad_s
        return DriveSignals(
            round(theta * drive.counts_per_rad),
            resolution * round(shaft / resolution) if resolution else shaft,
            self._current_a,
            self._current_a * drive.torque_constant_nm_a,
        )


class LinkScale:
    """The link encoder's disc and its sampled reading."""

    def __init__(self, encoder: LinkEncoder, noise: Iterator[float]) -> None:
        """Switch the encoder on."""
        self.counts = 0  # the reading
        # receives every plant step of the link if the reading lags; else None
        self.history: PositionHistory | None = None
        # receives every plant step of the deflection if its sensor lags; else None
        self.deflection: PositionHistory | None = None
        self._encoder, self._noise = encoder, noise
        self._readings: tuple[Reading, ...] = ()

    def fit(self, parts: LinkParts, step_s: float, position: float, theta: float) -> None:
        """Add effects, with an integration step of step_s, link and first motor at these angles (rad)."""
        delay, late = parts.reading_delay_s, parts.deflection_delay_s
        self._readings = tuple(parts.readings)
        self.history = PositionHistory(delay, step_s, position) if delay > 0.0 else None
        self.deflection = PositionHistory(late, step_s, position - theta) if late > 0.0 else None

    def sample(self, position: float, theta: float) -> None:
        """Sample at these positions of link and first motor (rad)."""
        if self.history is not None:
            position = self.history.position()
        if self.deflection is not None:
            position = theta + self.deflection.position()
        for read in self._readings:
            position = read(position)
        encoder = self._encoder
        self.counts = round((position - encoder.zero_rad) * encoder.counts_per_rad + next(self._noise))
