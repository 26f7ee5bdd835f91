"""What a diagnosis says."""

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
        std: their standard deviations, where they are known.
        probability: that it is this effect and not another one.
        alternatives: effects that may stand in its place, the likeliest first.
        alternative_probabilities: of each of them.
        share: of the squared error of the declared model that it explains beside the others.
        coordinates: of an unlisted effect, what its curve depends on.
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
    """Where a candidate stood: the error that it alone would leave, relative to the measured torque."""

    name: str
    location: str
    motor: int | None
    error_relative: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Curve:
    """Residual against the coordinate that reveals an effect, and the fitted curve.

    Attributes:
        name: of the effect.
        coordinates: fields of `Coordinates`; a second one where the curve depends on two.
        x: (n,) first coordinate.
        second: (n,) second coordinate.
        residual_nm: (n,) what is left without the effect.
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
    """Torque over time: measured, and what the model leaves of it before and after; per row."""

    time_s: FloatArray
    torque_nm: FloatArray
    before_nm: FloatArray
    after_nm: FloatArray


class Refitted(NamedTuple):
    """One transmission as refitted; empty where it is rigid or the data do not reveal its stiffness."""

    model: str
    parameters: dict[str, ParameterValue]
    std: dict[str, ParameterValue]


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
    """Errors of one recording: where it was fitted, and where it took no part (None: it always did)."""

    train: Errors
    validation: Errors | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Diagnosis:
    """The outcome.

    Attributes:
        verdict: what it comes to.
        bandwidth_hz: of the filter that all channels share.
        effects: the missing effects, the one that explains most first.
        train: errors on the training data.
        validation: errors on data that took no part.
        floor_nm: per motor, rms of what the augmented model leaves of the torque balance.
        transmissions: per motor, refitted with the effects.
        alignment: skew and offset between channels that were taken out; names carry the unit.
        rivals: the candidates' standing, best first.
        curves: one for each effect.
        series: of the first motor, on the training recording.
        advice: which motion would distinguish what could not be distinguished.
        notes: what else is to be said, a line each.
        recordings: errors of each recording.
        stiffness: of each flexible transmission, before and after.
    """

    verdict: Verdict
    bandwidth_hz: float
    effects: tuple[Finding, ...]
    train: Errors
    validation: Errors
    floor_nm: tuple[float, ...]
    transmissions: tuple[Refitted, ...]
    alignment: dict[str, float] = field(default_factory=dict)
    rivals: tuple[Rival, ...] = ()
    curves: tuple[Curve, ...] = ()
    series: Series | None = None
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    recordings: tuple[RecordingErrors, ...] = ()
    stiffness: tuple[StiffnessCurve, ...] = ()
