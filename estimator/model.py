"""The declared model of a joint: the known terms of eqs 4-7.

Frozen dataclasses, validated at construction; they know no file format.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np

from estimator.errors import EstimatorError
from estimator.priors import PRIORS
from estimator.ranges import range_of, require_in_range
from estimator.reasons import counted

HIGHEST_ORDER = 9  # of a polynomial in the joint file: what the compiled core has room for

Arrangement = Literal["single", "antagonistic", "serial"]
ParameterValue = float | tuple[float, ...]

# Read by validators of these classes from a file: no key may be unknown, no text stands for a number.
_STRICT: dict[str, Any] = {"extra": "forbid", "strict": True}


def require(condition: bool, what: str) -> None:
    """Raise EstimatorError(what) unless the condition holds."""
    if not condition:
        raise EstimatorError(what)


def require_finite(minimum: float, strict: bool = False, **values: float) -> None:
    """Require each named value to be finite and >= minimum (> minimum where strict)."""
    for name, value in values.items():
        bound = f"> {minimum:g}" if strict else f">= {minimum:g}"
        inside = value > minimum if strict else value >= minimum
        require(math.isfinite(value) and inside, f"{name}: expected a finite number {bound}, got {value!r}")


def require_declared(minimum: float, strict: bool = False, **values: float) -> None:
    """Require each declared value as `require_finite` does, and within the range of its unit."""
    require_finite(minimum, strict, **values)
    for name, value in values.items():
        require_in_range(name, value, positive=strict and minimum == 0.0)


def require_parameters(parameters: Mapping[str, ParameterValue]) -> None:
    """Require parameters within their ranges, and not too many numbers in one."""
    most = int(range_of("elements").most)
    for name, value in parameters.items():
        numbers = value if isinstance(value, tuple) else (value,)
        require(
            len(numbers) <= most,
            f"{name}: expected at most {most} numbers, got {len(numbers)}",
        )
        for number in numbers:
            require_in_range(name, number)


def require_covariance(rows: Sequence[Sequence[float]], size: int) -> None:
    """Require a covariance of so many parameters: square, symmetric, no variance or eigenvalue below zero."""
    expected = f"covariance: expected {size} rows of {size} numbers, one for each of the parameters"
    require(size > 0 and len(rows) == size and all(len(row) == size for row in rows), expected)
    for number in (x for row in rows for x in row):
        require_in_range("covariance", number)
    matrix = np.array(rows)
    require(
        bool(np.all(np.diag(matrix) >= 0.0)), "covariance: expected variances of 0 or more on its diagonal"
    )
    rounded = range_of("correlation").least
    std = np.sqrt(np.diag(matrix))
    shares = matrix / np.maximum(np.outer(std, std), 1e-200)
    symmetric = bool(np.allclose(shares, shares.T, atol=rounded))
    require(
        symmetric and float(np.min(np.linalg.eigvalsh(shares))) >= -rounded,
        "covariance: expected a symmetric matrix without negative eigenvalues",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Effect:
    """One physical effect the model has been given, by its name in `estimator.effects.LIBRARY`.

    Attributes:
        name: the effect's name in the library, e.g. "coulomb_friction".
        parameters: its parameters, by names that carry their unit, e.g. {"torque_nm": 0.25}.
        std: standard deviations of those that were fitted, by the same names.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _STRICT

    name: str
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    std: Mapping[str, ParameterValue] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_parameters(self.parameters)
        require_parameters(self.std)
        for name, value in self.std.items():
            require(name in self.parameters, f"std.{name}: expected the name of one of the parameters")
            expected, got = np.size(self.parameters[name]), np.size(value)
            require(
                got == expected,
                f"std.{name}: expected {counted(expected, 'number')} as in parameters, got {got}",
            )
            require(bool(np.all(np.asarray(value) >= 0.0)), f"std.{name}: expected 0 or more, got {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Transmission:
    """The flexibility torque's model f(phi, alpha), eq 17.

    Attributes:
        model: its name in `estimator.transmissions.MODELS`, or "none" for a rigid transmission.
        order: p of eq 24 for polynomials; None: chosen from the data. In robust mode evidence may
            add powers.
        parameters: alpha, if known or fitted; empty: estimated without prior.
        covariance: (n, n) of alpha, as `fit` and `diagnose` write it, in the units of the parameters: the
            coefficients in order, or k_nm_rad and then the shape; None: not known.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _STRICT

    model: str = "polynomial"
    order: int | None = None
    parameters: Mapping[str, ParameterValue] = field(default_factory=dict)
    covariance: tuple[tuple[float, ...], ...] | None = None

    def __post_init__(self) -> None:
        require(
            self.order is None or 1 <= self.order <= HIGHEST_ORDER,
            f"order: expected 1 to {HIGHEST_ORDER}, got {self.order}",
        )
        require_parameters(self.parameters)
        if self.covariance is not None:
            require_covariance(self.covariance, sum(np.size(value) for value in self.parameters.values()))


@dataclass(frozen=True, slots=True, kw_only=True)
class Motor:
    """The motor side of one transmission, eq 5 or 7, reflected to the joint.

    Attributes:
        inertia_kg_m2: B > 0.
        viscous_damping_nm_s_rad: D_theta >= 0.
        transmission: the model of tau_e(phi).
        effects: declared effects of the motor, the transmission or the measurement.
        gear_ratio: motor revolutions per joint revolution, if known: everything else is at the joint side;
            the gate tests for recordings that are not.
        inertia_std_relative: relative standard deviation of B; None: that of `estimator.priors`.
        viscous_damping_std_nm_s_rad: standard deviation of D_theta, likewise.
        fit_rms_nm: rms of what the model leaves of the motor's torque in the recording that it is fitted to,
            and rms of that torque; None: no recording.
    """

    inertia_kg_m2: float
    viscous_damping_nm_s_rad: float = 0.0
    transmission: Transmission = field(default_factory=Transmission)
    effects: tuple[Effect, ...] = ()
    gear_ratio: float | None = None
    inertia_std_relative: float | None = None
    viscous_damping_std_nm_s_rad: float | None = None
    fit_rms_nm: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_declared(0.0, strict=True, inertia_kg_m2=self.inertia_kg_m2)
        require_declared(0.0, viscous_damping_nm_s_rad=self.viscous_damping_nm_s_rad)
        if self.inertia_std_relative is not None:
            require_declared(0.0, strict=True, inertia_std_relative=self.inertia_std_relative)
        if self.viscous_damping_std_nm_s_rad is not None:
            require_declared(0.0, viscous_damping_std_nm_s_rad=self.viscous_damping_std_nm_s_rad)

    @property
    def flexible(self) -> bool:
        """Whether its transmission deflects."""
        return self.transmission.model != "none"

    @property
    def zero_std_rad(self) -> float:
        """Standard deviation of the zero between the encoders, where it has been fitted; else 0."""
        zeros = (one.std.get("offset_rad", 0.0) for one in self.effects if one.name == "deflection_offset")
        return float(np.linalg.norm([np.linalg.norm(std) for std in zeros]))


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkDynamics:
    """The link side, eq 4 or 6, with g(q) = gravity_nm * sin(q + gravity_phase_rad).

    Attributes:
        inertia_kg_m2: M > 0.
        viscous_damping_nm_s_rad: D_q >= 0.
        gravity_nm: amplitude of the gravity torque.
        gravity_phase_rad: where gravity vanishes, as an angle added to q.
        inertia_std_kg_m2: standard deviation of M; None: 10 % of it.
        viscous_damping_std_nm_s_rad: of D_q; None: 20 % of it.
        gravity_std_nm: of the gravity torque, in amount and direction alike; None: 10 % of its amplitude.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _STRICT

    inertia_kg_m2: float
    viscous_damping_nm_s_rad: float = 0.0
    gravity_nm: float = 0.0
    gravity_phase_rad: float = 0.0
    inertia_std_kg_m2: float | None = None
    viscous_damping_std_nm_s_rad: float | None = None
    gravity_std_nm: float | None = None

    def __post_init__(self) -> None:
        require_declared(0.0, strict=True, inertia_kg_m2=self.inertia_kg_m2)
        require_declared(0.0, viscous_damping_nm_s_rad=self.viscous_damping_nm_s_rad)
        require_declared(-math.inf, gravity_nm=self.gravity_nm, gravity_phase_rad=self.gravity_phase_rad)
        for name in ("inertia_std_kg_m2", "viscous_damping_std_nm_s_rad", "gravity_std_nm"):
            std = getattr(self, name)
            if std is not None:
                require_declared(0.0, **{name: std})

    @property
    def std(self) -> tuple[float, float, float]:
        """Standard deviations of M (kg·m²), D_q (N·m·s/rad), gravity (N·m): as declared, or by the priors."""
        declared = (self.inertia_std_kg_m2, self.viscous_damping_std_nm_s_rad, self.gravity_std_nm)
        values = (self.inertia_kg_m2, self.viscous_damping_nm_s_rad, abs(self.gravity_nm))
        shares = (PRIORS[name].std for name in ("link_inertia", "link_viscous_damping", "gravity"))
        inertia, damping, gravity = (
            share * value if std is None else std
            for std, share, value in zip(declared, shares, values, strict=True)
        )
        return inertia, damping, gravity


@dataclass(frozen=True, slots=True, kw_only=True)
class JointModel:
    """A joint as the estimator knows it.

    Attributes:
        arrangement: how the transmissions act on the link (eqs 9, 11 for "antagonistic").
        motors: one motor, or two for a variable-stiffness joint.
        link: the link dynamics, if known; needed for the external residual (eq 12).
        link_effects: effects located at the link or in its encoder.
        period_s: declared sampling period, if any; the gate compares recordings with it.
    """

    arrangement: Arrangement
    motors: tuple[Motor, ...]
    link: LinkDynamics | None = None
    link_effects: tuple[Effect, ...] = ()
    period_s: float | None = None

    def __post_init__(self) -> None:
        expected = 1 if self.arrangement == "single" else 2
        require(
            len(self.motors) == expected,
            f'arrangement = "{self.arrangement}": expected {counted(expected, "motor")}, '
            f"got {len(self.motors)}",
        )

    @property
    def has_deflection(self) -> bool:
        """Whether any transmission is flexible, so that a link position is needed."""
        return any(motor.flexible for motor in self.motors)
