"""Analyses a recording on a worker, by the functions of `drivelink fit` and `drivelink diagnose`.

The only module of the fleet that calls the estimator.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from drivelink.jointfile import JointFile, plain_parameters
from drivelink.jointfile.apply_diagnosis import diagnosed_model
from drivelink.output import report, sentences
from drivelink.output.comparison import simulated
from estimator.batch import TransmissionFit
from estimator.diagnosis import Diagnosis, diagnose
from estimator.identify import identify
from estimator.sample import FloatArray, Record
from estimator.transmissions import MODELS, RIGID

# Deflections at which every row states the stiffness: zero, and quantiles of the recording.
NAMED = {"zero": None, "middle": 0.5, "high": 0.95}


class Analysis(NamedTuple):
    """Result of a recording."""

    joint: dict[str, Any]  # columns of the table that all its rows share
    transmissions: list[dict[str, Any]]  # further columns of each transmission's row
    report_json: str  # the diagnosis for programs
    report_html: str  # the diagnosis for people


def analyse(
    record: Record, joint: JointFile, validation: Record | None, title: report.Title, remarks: Sequence[str]
) -> Analysis:
    """Fit and diagnose one record.

    Args:
        validation: a recording that takes no part in fit and selection; None: blocks are held out.

    Raises:
        EstimatorError: the recording cannot be fitted.
    """
    model = joint.model()
    outcome = diagnose(record, model, validation=validation)
    outcome = replace(outcome, notes=(*remarks, *outcome.notes))
    judged = record if validation is None else validation
    runs = simulated(judged, declared=model, found=diagnosed_model(joint, outcome))
    document = report.as_json(outcome, runs, title.validation or title.recording)
    shared = {
        "verdict": outcome.verdict,
        "sentence": sentences.sentence(outcome),
        "effects": _names(outcome),
        "details": json.dumps({key: document[key] for key in ("effects", "alignment", "notes")}),
        **{f"error_{name}": value for name, value in outcome.validation._asdict().items()},
        "duration_s": float((record.sequence[-1] - record.sequence[0]) * record.period_s),
        "samples": len(record),
        "period_s": record.period_s,
    }
    each = [_row(number, one) for number, one in enumerate(identify(record, model).fits, start=1)]
    return Analysis(shared, each, json.dumps(document, indent=2) + "\n", report.html_page(outcome, title))


def _names(outcome: Diagnosis) -> list[str]:
    """Each finding as NAME@LOCATION, with the motor's number if there are two."""
    several = len(outcome.transmissions) > 1
    return [
        f"{one.name}@{one.location}{one.motor + 1 if several and one.motor is not None else ''}"
        for one in outcome.effects
    ]


def _row(number: int, one: TransmissionFit) -> dict[str, Any]:
    """Columns of a transmission; rad, N·m, N·m/rad; None where not finite."""
    rigid = one.model == RIGID
    deflection = np.abs(one.deflection_rad)
    row: dict[str, Any] = {
        "transmission": number,
        "model": one.model,
        "parameters": json.dumps(plain_parameters(one.parameters)),
        "parameters_std": json.dumps(plain_parameters(one.std)),
        "covariance": one.covariance.ravel().tolist(),
        "deflection_rms_rad": math.nan if rigid else float(np.sqrt(np.mean(deflection**2))),
        "torque_rms_nm": one.torque_rms_nm,
        "excited": one.excited,
        "inertia_kg_m2": one.inertia_kg_m2,
        "inertia_std_kg_m2": one.nuisance_std["inertia"],
        "viscous_damping_nm_s_rad": one.viscous_damping_nm_s_rad,
        "viscous_damping_std_nm_s_rad": one.nuisance_std["damping"],
        "deflection_offset_rad": math.nan if rigid else one.deflection_offset_rad,
        "deflection_offset_std_rad": one.nuisance_std["shift"],
        "fit_error_relative": math.nan if rigid else one.error_rms_nm / one.torque_rms_nm,
    }
    for name, share in NAMED.items() if one.excited else ():
        phi = 0.0 if share is None else float(np.quantile(deflection, share))
        row[f"deflection_{name}_rad"] = phi
        row[f"stiffness_{name}_nm_rad"], row[f"stiffness_std_{name}_nm_rad"] = _stiffness(
            one.model, one.alpha, one.covariance, phi
        )
    if one.excited:  # a late reading of a spring's end looks like damping, and the motion seldom tells which
        late = row["stiffness_middle_nm_rad"] * one.link_delay_s
        row["viscous_damping_std_nm_s_rad"] = math.hypot(one.nuisance_std["damping"], late)
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def stiffness_at(
    model: str, parameters: dict[str, Any], covariance: list[float], deflection_rad: float
) -> tuple[float, float]:
    """Return stiffness and standard deviation of a transmission of the table at a deflection; N·m/rad."""
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in parameters.items()}
    alpha = MODELS[model].alpha(values)
    return _stiffness(model, alpha, np.reshape(covariance, (alpha.size, alpha.size)), deflection_rad)


def _stiffness(model: str, alpha: FloatArray, covariance: FloatArray, phi: float) -> tuple[float, float]:
    """sigma(phi) = f'(phi, alpha), and sqrt(g C gᵀ) with its gradient g by alpha."""
    law, at = MODELS[model], np.array([phi])
    gradient = law.stiffness_jacobian(at, alpha)[0]
    variance = float(gradient @ covariance @ gradient)
    return float(law.stiffness(at, alpha)[0]), math.sqrt(max(variance, 0.0))
