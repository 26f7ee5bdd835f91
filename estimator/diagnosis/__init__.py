"""Traces a residual to a physical effect: locate, select, judge."""

from estimator.diagnosis.excitation import advice_for
from estimator.diagnosis.result import (
    Curve,
    Diagnosis,
    Errors,
    Finding,
    RecordingErrors,
    Refitted,
    Rival,
    Series,
    StiffnessCurve,
    Verdict,
)
from estimator.diagnosis.workflow import diagnose

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
    "advice_for",
    "diagnose",
]
