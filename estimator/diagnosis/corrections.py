"""Effects that are errors of a reading: their corrections."""

from __future__ import annotations

from dataclasses import replace

from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.frame import Corrections

__all__ = ["READINGS", "corrected", "read", "restored"]

READINGS = (
    "torque_delay",
    "torque_lag",
    "deflection_offset",
    "encoder_delay",
    "deflection_delay",
    "encoder_scale",
    "encoder_eccentricity",
)


def read(c: Corrections, candidate: Candidate) -> tuple[float, ...]:
    """Return the correction of the readings by an effect."""
    motor = candidate.motor or 0
    return {
        "torque_delay": (c.torque_delay_s[motor],),
        "torque_lag": (c.torque_lag_s[motor],),
        "deflection_offset": (c.offset_rad[motor],),
        "encoder_delay": (c.encoder_delay_s,),
        "deflection_delay": (c.deflection_delay_s,),
        "encoder_scale": (c.encoder_scale,),
        "encoder_eccentricity": (c.encoder_sin_rad, c.encoder_cos_rad),
    }.get(candidate.kind.name, (0.0,) * len(candidate.kind.linear))


def corrected(c: Corrections, name: str, motor: int | None, part: int, more: float) -> Corrections:
    """Return the corrections with an increment for one effect."""

    def put(values: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(v + more if motor in (None, i) else v for i, v in enumerate(values))

    if name == "torque_delay":
        return replace(c, torque_delay_s=put(c.torque_delay_s))
    if name == "torque_lag":
        return replace(c, torque_lag_s=put(c.torque_lag_s))
    if name == "deflection_offset":
        return replace(c, offset_rad=put(c.offset_rad))
    if name == "encoder_delay":
        return replace(c, encoder_delay_s=c.encoder_delay_s + more)
    if name == "deflection_delay":
        return replace(c, deflection_delay_s=c.deflection_delay_s + more)
    if name == "encoder_scale":
        return replace(c, encoder_scale=c.encoder_scale + more)
    if part == 0:
        return replace(c, encoder_sin_rad=c.encoder_sin_rad + more)
    return replace(c, encoder_cos_rad=c.encoder_cos_rad + more)


def restored(c: Corrections, declared: Corrections, candidate: Candidate) -> Corrections:
    """Return the corrections with one effect reset to its declared value."""
    name = candidate.kind.name
    if name not in READINGS:
        return c
    for p, (x, x0) in enumerate(zip(read(c, candidate), read(declared, candidate), strict=True)):
        c = corrected(c, name, candidate.motor, p, x0 - x)
    return c
