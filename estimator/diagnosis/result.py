"""Result of a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from estimator.model import ParameterValue
from estimator.sample import FloatArray

__all__ = [
    "Curve",
    "Diagnosis",
    "Errors",
    "Finding",
    "RecordingErrors",
    "Refitted",
    "Rival",
    "Series",
    "StiffnessCurve",
    "Verdict",
]

Verdict = Literal["effect", "sufficient", "unexplained", "insufficient_excitation"]


class Errors(NamedTuple):
    """Error of the motor torque balance: rms, and relative to the measured torque."""

    before_rms_nm: float
    after_rms_nm: float
    before_relative: float
    after_relative: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One missing effect.

    Attributes:
        name: in the library, or "unlisted".
        location: motor, transmission, link or measurement.
        motor: index of the motor; None at the link.
        parameters: by their names in the joint file.
        std: their standard deviations, if known.
        probability: of this effect against its alternatives.
        alternatives: what may be in its place, the most probable first.
        alternative_probabilities: their probabilities, those of the candidates.
        share: fraction of the declared model's squared error that it explains in addition to the others.
        coordinates: of the curve of an unlisted effect.
    """

    name: str
    location: str
    motor: int | None
    parameters: dict[str, ParameterValue]
    std: dict[str, ParameterValue]
    probability: float = 1.0
    alternatives: tuple[str, ...] = ()
    alternative_probabilities: tuple[float, ...] = ()
    share: float = 0.0
    coordinates: tuple[str, ...] = ()


class Rival(NamedTuple):
    """A candidate with the relative error of a model with it alone, and its probability."""

    name: str
    location: str
    motor: int | None
    error_relative: float
    probability: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """Residual against the coordinate that reveals an effect, and the fitted curve.

    Attributes:
        name: of the effect.
        coordinates: fields of `Coordinates`; a second one where the curve depends on two.
        x: (n,) first coordinate.
        second: (n,) second coordinate.
        residual_nm: (n,) residual without the effect.
        fitted_nm: (n,) the effect.
    """

    name: str
    coordinates: tuple[str, ...]
    x: FloatArray
    residual_nm: FloatArray
    fitted_nm: FloatArray
    second: FloatArray | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Series:
    """Torque over time per row: measured, and residuals before and after."""

    time_s: FloatArray
    torque_nm: FloatArray
    before_nm: FloatArray
    after_nm: FloatArray


@dataclass(frozen=True, slots=True)
class Refitted:
    """One refitted transmission and the motor's inertia and damping beside it, as in the joint file; empty if
    it is rigid or undetermined.
    """

    model: str
    parameters: dict[str, ParameterValue]
    std: dict[str, ParameterValue]
    covariance: tuple[tuple[float, ...], ...] = ()
    motor: dict[str, float] = field(default_factory=dict)


class StiffnessCurve(NamedTuple):
    """Stiffness of one motor's transmission over its deflection, as declared at its best fit, and refitted.

    Attributes:
        motor: its index.
        deflection_rad: (n,).
        before_nm_rad, before_std_nm_rad: (n,) of the declared model, and its standard deviation.
        after_nm_rad, after_std_nm_rad: (n,) with the effects.
    """

    motor: int
    deflection_rad: FloatArray
    before_nm_rad: FloatArray
    before_std_nm_rad: FloatArray
    after_nm_rad: FloatArray
    after_std_nm_rad: FloatArray


class RecordingErrors(NamedTuple):
    """Errors of one recording, fitted and held out (None: never held out)."""

    train: Errors
    validation: Errors | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """The outcome.

    Attributes:
        verdict: what it comes to.
        bandwidth_hz: of the filter that all channels share.
        effects: the missing effects, the most important first.
        train: errors on the training data.
        validation: errors on held-out data.
        floor_nm: per motor, residual rms of the augmented model.
        transmissions: per motor, refitted with the effects.
        alignment: corrected skew and offset between channels; names carry the unit.
        alignment_std: their standard deviations.
        rivals: the candidates' standing, best first.
        curves: one for each effect.
        series: of the first motor, on the training recording.
        advice: motions that would separate the alternatives.
        notes: further remarks, one line each.
        recordings: errors of each recording.
        stiffness: of each flexible transmission, before and after.
        surplus: mean square of the errors on held-out data over that on the fitted data, at least 1.
        smoothing_rad_s: over which declared dry friction changes its sign, where the joint file leaves it
            out and another velocity than the default explains more.
    """

    verdict: Verdict
    bandwidth_hz: float
    effects: tuple[Finding, ...]
    train: Errors
    validation: Errors
    floor_nm: tuple[float, ...]
    transmissions: tuple[Refitted, ...]
    alignment: dict[str, float] = field(default_factory=dict)
    alignment_std: dict[str, float] = field(default_factory=dict)
    rivals: tuple[Rival, ...] = ()
    curves: tuple[Curve, ...] = ()
    series: Series | None = None
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    recordings: tuple[RecordingErrors, ...] = ()
    stiffness: tuple[StiffnessCurve, ...] = ()
    surplus: float = 1.0
    smoothing_rad_s: float | None = None
