"""The one way to get an estimator that runs tick by tick, in either mode."""

from __future__ import annotations

from typing import Any, Protocol

from estimator.model import JointModel, require_finite
from estimator.paper import PaperEstimator
from estimator.robust import RobustEstimator
from estimator.sample import Estimate, Sample
from estimator.settings import EstimatorSettings

__all__ = ["Estimator", "make_estimator"]


class Estimator(Protocol):
    """What both modes offer."""

    @property
    def residual_nm(self) -> float:
        """What the model left unexplained of the torque balance at the last sample; nan: unknown."""

    def step(self, sample: Sample) -> Estimate:
        """The estimate at this sample. Never raises, whatever floats the sample holds.

        `sample.sequence` counts periods: a jump by more than one is a gap of whole periods.
        """

    def distrust(self) -> None:
        """The next sample may not be of its moment: use it, but learn nothing from it."""

    def reset(self) -> None:
        """Forget everything that was learned."""

    def parameters(self) -> list[dict[str, Any]]:
        """Current {"model", "parameters", "std"} of each transmission, names as in the joint file."""


def make_estimator(model: JointModel, settings: EstimatorSettings, period_s: float) -> Estimator:
    """The estimator that the settings ask for.

    Raises:
        EstimatorError: the model names a transmission that does not exist, or contradicts itself.
    """
    require_finite(0.0, strict=True, period_s=period_s)
    if settings.mode == "paper":
        return PaperEstimator(model, settings, period_s)
    return RobustEstimator(model, settings, period_s)
