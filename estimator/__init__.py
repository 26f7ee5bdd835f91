"""Estimates flexibility torque and stiffness from motor signals: pure mathematics.

Arrays and numbers in, results out. No clock, file or socket. Equation numbers are those of
"Residual-based Stiffness Estimation in Robots with Flexible Transmissions".
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimator.batch import TransmissionFit, fit
    from estimator.errors import EstimatorError
    from estimator.model import Effect, JointModel, LinkDynamics, Motor, Transmission
    from estimator.online import Estimator, make_estimator
    from estimator.sample import (
        Estimate,
        External,
        ExternalStatus,
        Record,
        Sample,
        Status,
        TransmissionEstimate,
    )
    from estimator.settings import EstimatorSettings
    from estimator.transmissions import MODELS, register, register_table

__all__ = [
    "MODELS",
    "Effect",
    "Estimate",
    "Estimator",
    "EstimatorError",
    "EstimatorSettings",
    "External",
    "ExternalStatus",
    "JointModel",
    "LinkDynamics",
    "Motor",
    "Record",
    "Sample",
    "Status",
    "Transmission",
    "TransmissionEstimate",
    "TransmissionFit",
    "fit",
    "make_estimator",
    "register",
    "register_table",
]

_PLACES = {
    "batch": ("TransmissionFit", "fit"),
    "errors": ("EstimatorError",),
    "model": ("Effect", "JointModel", "LinkDynamics", "Motor", "Transmission"),
    "online": ("Estimator", "make_estimator"),
    "sample": (
        "Estimate",
        "External",
        "ExternalStatus",
        "Record",
        "Sample",
        "Status",
        "TransmissionEstimate",
    ),
    "settings": ("EstimatorSettings",),
    "transmissions": ("MODELS", "register", "register_table"),
}
_LAZY = {name: f"estimator.{module}" for module, names in _PLACES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import public names on first use: a subscriber that needs a type does not load scipy."""
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])
