"""Analyses a recording on a worker, by the functions of `drivelink fit` and `drivelink diagnose`.

The only module of the fleet that calls the estimator.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from drivelink.jointfile import JointFile, plain_parameters
from drivelink.output import report
from estimator.batch import TransmissionFit
from estimator.diagnosis import Diagnosis, diagnose
from estimator.identify import identify
from estimator.sample import FloatArray, Record
from estimator.transmissions import MODELS, RIGID

# Deflections at which every row states the stiffness: zero, and quantiles of the recording.
NAMED = {"zero": None, "middle": 0.5, "high": 0.95}


class TransmissionRow(NamedTuple):
    """Result for one transmission; the fields are columns of the table.

    Attributes:
        transmission: its number, from 1.
        model: its model; "none" is rigid and has no stiffness.
        parameters: JSON of alpha by the names of the joint file.
        parameters_std: JSON, likewise.
        covariance: of alpha, row by row.
        named: (deflection, stiffness, standard deviation) for each of `NAMED`; rad, N·m/rad.
        deflection_rms_rad: excitation.
        torque_rms_nm: excitation.
        excited: whether the motion reveals the stiffness.
        inertia_kg_m2: B as refitted.
        viscous_damping_nm_s_rad: D as refitted.
        fit_error_relative: residual of the fit over the flexibility torque.
    """

    transmission: int
    model: str
    parameters: str
    parameters_std: str
    covariance: list[float]
    named: dict[str, tuple[float, float, float]]
    deflection_rms_rad: float
    torque_rms_nm: float
    excited: bool
    inertia_kg_m2: float
    viscous_damping_nm_s_rad: float
    fit_error_relative: float


class Analysis(NamedTuple):
    """Result of a recording: per transmission, and of the joint."""

    transmissions: list[TransmissionRow]
    verdict: str
    sentence: str
    effects: list[str]
    details: str
    before_rms_nm: float
    after_rms_nm: float
    before_relative: float
    after_relative: float
    report_json: str
    report_html: str


def analyse(
    record: Record,
    joint: JointFile,
    validation: Record | None,
    title: report.Title,
    remarks: Sequence[str],
) -> Analysis:
    """Fit and diagnose one record.

    Args:
        record: the recording, or a part of it.
        joint: the joint's last accepted model.
        validation: a recording that takes no part in fit and selection; None: blocks are held out.
        title: of the report.
        remarks: of the gate, for the report.

    Raises:
        EstimatorError: the recording cannot be fitted.
    """
    model = joint.model()
    outcome = diagnose(record, model, validation=validation)
    outcome = replace(outcome, notes=(*remarks, *outcome.notes))
    fits = identify(record, model).fits
    document = report.as_json(outcome)
    errors = outcome.validation
    return Analysis(
        transmissions=[_row(number, one) for number, one in enumerate(fits, start=1)],
        verdict=outcome.verdict,
        sentence=report.sentence(outcome),
        effects=_names(outcome),
        details=json.dumps({key: document[key] for key in ("effects", "alignment", "notes")}),
        before_rms_nm=errors.before_rms_nm,
        after_rms_nm=errors.after_rms_nm,
        before_relative=errors.before_relative,
        after_relative=errors.after_relative,
        report_json=json.dumps(document, indent=2) + "\n",
        report_html=report.html_page(outcome, title),
    )


def _names(outcome: Diagnosis) -> list[str]:
    """Each finding as NAME@LOCATION, with the motor's number if there are two."""
    several = len(outcome.transmissions) > 1
    return [
        f"{one.name}@{one.location}{one.motor + 1 if several and one.motor is not None else ''}"
        for one in outcome.effects
    ]


def _row(number: int, one: TransmissionFit) -> TransmissionRow:
    rigid = one.model == RIGID
    deflection = np.abs(one.deflection_rad)
    return TransmissionRow(
        transmission=number,
        model=one.model,
        parameters=json.dumps(plain_parameters(one.parameters)),
        parameters_std=json.dumps(plain_parameters(one.std)),
        covariance=one.covariance.ravel().tolist(),
        named={name: _named(one, deflection, share) for name, share in NAMED.items()} if one.excited else {},
        deflection_rms_rad=math.nan if rigid else float(np.sqrt(np.mean(deflection**2))),
        torque_rms_nm=one.torque_rms_nm,
        excited=one.excited,
        inertia_kg_m2=one.inertia_kg_m2,
        viscous_damping_nm_s_rad=one.viscous_damping_nm_s_rad,
        fit_error_relative=math.nan if rigid else one.error_rms_nm / one.torque_rms_nm,
    )


def _named(one: TransmissionFit, deflection: FloatArray, share: float | None) -> tuple[float, float, float]:
    phi = 0.0 if share is None else float(np.quantile(deflection, share))
    return (phi, *_stiffness(one.model, one.alpha, one.covariance, phi))


def stiffness_at(
    model: str, parameters: dict[str, Any], covariance: list[float], deflection_rad: float
) -> tuple[float, float]:
    """Stiffness of a transmission of the table at any deflection, and its standard deviation; N·m/rad."""
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in parameters.items()}
    alpha = MODELS[model].alpha(values)
    return _stiffness(model, alpha, np.reshape(covariance, (alpha.size, alpha.size)), deflection_rad)


def _stiffness(model: str, alpha: FloatArray, covariance: FloatArray, phi: float) -> tuple[float, float]:
    """sigma(phi) = f'(phi, alpha), and sqrt(g C gᵀ) with its gradient g by alpha."""
    law, at = MODELS[model], np.array([phi])
    gradient = law.stiffness_jacobian(at, alpha)[0]
    variance = float(gradient @ covariance @ gradient)
    return float(law.stiffness(at, alpha)[0]), math.sqrt(max(variance, 0.0))
