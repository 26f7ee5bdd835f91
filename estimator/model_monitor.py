"""Tests on line whether the model is still sufficient: its residual against the baseline of its fit.

Test and arithmetic are in `estimator/core/src/model_monitor.rs`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from estimator import _core
from estimator.errors import EstimatorError
from estimator.model import JointModel, require, require_finite
from estimator.ranges import require_in_range
from estimator.sample import Estimate, Record, Sample
from estimator.settings import EstimatorSettings

_SETTINGS = EstimatorSettings()
_LEAST_SECONDS = 2  # that a standard deviation takes
_NOTHING = 1e-12  # N·m: keeps the logarithm of a second without residual or torque finite


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualBaseline:
    """Residual of a sufficient model in each balance, from the seconds of a healthy recording."""

    # (motors, then the link where its dynamics are known) usual rms of a second
    residual_nm: tuple[float, ...]
    # rms of each balance's torque in these seconds; the limit rises with the torque
    torque_nm: tuple[float, ...]
    log_std: tuple[float, ...]  # standard deviation of the logarithm of a second's mean square
    seconds: int  # number of seconds

    def __post_init__(self) -> None:
        sizes = {len(self.residual_nm), len(self.torque_nm), len(self.log_std)}
        require(len(sizes) == 1, "baseline: expected as many residuals as torques and standard deviations")
        require(self.seconds >= _LEAST_SECONDS, f"seconds: expected {_LEAST_SECONDS} or more")
        require_in_range("seconds", self.seconds)
        for residual, torque, std in zip(self.residual_nm, self.torque_nm, self.log_std, strict=True):
            require_finite(0.0, strict=True, residual_nm=residual, torque_nm=torque)
            require_finite(0.0, log_std=std)

    def as_dict(self) -> dict[str, Any]:
        """Return the baseline as plain values for the joint file."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ResidualBaseline | None:
        """Read the baseline from a joint file; None if it is absent or not usable."""
        try:
            return cls(
                residual_nm=tuple(float(x) for x in values["residual_nm"]),
                torque_nm=tuple(float(x) for x in values["torque_nm"]),
                log_std=tuple(float(x) for x in values["log_std"]),
                seconds=int(values["seconds"]),
            )
        except (KeyError, TypeError, ValueError, OverflowError, EstimatorError):
            return None


def can_monitor(model: JointModel) -> bool:
    """Return whether every transmission's torque is known from the model alone."""
    return all(m.transmission.model == "none" or m.transmission.parameters for m in model.motors)


class Second(NamedTuple):
    """Residual and torque of each balance over one second, N·m, and the sequence number at its end."""

    sequence: int
    residual_nm: tuple[float, ...]
    torque_nm: tuple[float, ...]


def seconds_of(record: Record, model: JointModel) -> list[Second]:
    """Measure the residual of a model second by second, as the daemon does.

    Args:
        model: as written, transmission parameters included; nothing is fitted.
    """
    monitor, made = ModelMonitor(model, record.period_s, None), []
    before = 0
    for sample in record.samples():
        monitor.core.step(sample)
        if monitor.core.seconds > before:
            before = monitor.core.seconds
            made.append(Second(sample.sequence, monitor.residual_nm, monitor.torque_nm))
    return made


def measure_baseline(
    record: Record | Sequence[Record], model: JointModel, surplus: float = 1.0
) -> ResidualBaseline:
    """Measure the baseline of a model on recordings that it explains.

    Args:
        record: of one or several runs.
        model: fitted to them.
        surplus: mean square of its errors on other data over that on these.

    Raises:
        EstimatorError: they have less than two whole seconds after the filters have settled.
    """
    records = [record] if isinstance(record, Record) else record
    seconds = [second for one in records for second in seconds_of(one, model)]
    residuals, torques = [s.residual_nm for s in seconds], [s.torque_nm for s in seconds]
    require(len(residuals) >= _LEAST_SECONDS, "baseline: expected a recording of more than 3 s")
    residual, torque = np.maximum(residuals, _NOTHING), np.maximum(torques, _NOTHING)
    usual = np.sqrt(np.mean(torque**2, axis=0))
    logarithm = 2.0 * np.log(residual / np.maximum(torque / usual, 1.0))
    return ResidualBaseline(
        residual_nm=tuple((math.sqrt(surplus) * np.exp(0.5 * np.mean(logarithm, axis=0))).tolist()),
        torque_nm=tuple(usual.tolist()),
        log_std=tuple(np.std(logarithm, axis=0, ddof=1).tolist()),
        seconds=len(residuals),
    )


def expecting(model: JointModel, baseline: ResidualBaseline | None) -> JointModel:
    """Return a model whose motors know what its fit has left of their torques."""
    if baseline is None or len(baseline.residual_nm) < len(model.motors):
        return model
    rms = zip(model.motors, baseline.residual_nm, baseline.torque_nm, strict=False)
    return replace(
        model, motors=tuple(replace(motor, fit_rms_nm=(left, torque)) for motor, left, torque in rms)
    )


class ModelMonitor:
    """Raises the model alarm and locates the missing effect.

    Args:
        model: as declared, transmission parameters included.
        period_s: of the samples.
        baseline: residual of the model at its fit; None: only measure.
        false_alarms_per_hour: that a sufficient model may raise.

    Raises:
        EstimatorError: the model contradicts itself.
    """

    def __init__(
        self,
        model: JointModel,
        period_s: float,
        baseline: ResidualBaseline | None,
        false_alarms_per_hour: float = _SETTINGS.false_alarms_per_hour,
    ) -> None:
        arguments = None
        if baseline is not None:
            arguments = (baseline.residual_nm, baseline.torque_nm, baseline.log_std, baseline.seconds)
        self.core = _core.ModelMonitor(model, period_s, arguments, false_alarms_per_hour)
        self.baseline = baseline if self.core.monitoring else None

    def step(self, sample: Sample, estimate: Estimate, residual_nm: float) -> bool:
        """Take one measured sample; the monitor uses the declared model, not the adapted one.

        Returns:
            Whether the alarm is on.
        """
        return self.core.step(sample)

    def reset(self) -> None:
        """Forget everything but the model and its baseline."""
        self.core.reset()

    @property
    def residual_nm(self) -> tuple[float, ...]:
        """Rms of each balance over the last whole second; nan before the first."""
        return self.core.residual_nm

    @property
    def torque_nm(self) -> tuple[float, ...]:
        """Rms of each balance's torque over the same second."""
        return self.core.torque_nm

    @property
    def settled(self) -> bool:
        """Whether the filters have settled."""
        return not math.isnan(self.residual_nm[0])

    def location(self) -> str:
        """Return the likely location of the effect that the model lacks."""
        return self.core.location()

    def describe(self) -> dict[str, Any]:
        """Return the residual and baseline per balance, their ratio and its limit, the location."""
        found: dict[str, Any] = {"watching": self.baseline is not None}
        if self.settled:
            found["residual_nm"] = list(self.residual_nm)
        if self.baseline is None:
            return found
        found["floor_nm"] = list(self.baseline.residual_nm)
        ratio, limit = self.core.ratio
        if math.isfinite(ratio) and math.isfinite(limit):
            found |= {"ratio": ratio, "limit": limit}
        if self.core.alarm:
            found["location"] = self.location()
        return found
