"""Effects in the measurement of positions. A reading is the true angle plus its error."""

from __future__ import annotations

import math

from sim.effects.assembly import Assembly, Definition, EffectParameter, Values
from sim.effects.common import not_negative, wave


def _eccentricity(a: Assembly, m: int, p: Values) -> None:
    height, phase = wave(p["sin_rad"], p["cos_rad"], 1.0)
    a.link.readings.append(lambda q: q + height * math.sin(q + phase))


def _encoder_delay(a: Assembly, m: int, p: Values) -> None:
    a.link.reading_delay_s += not_negative(p, "delay_s")


def _encoder_scale(a: Assembly, m: int, p: Values) -> None:
    scale = 1.0 + p["relative_error"]
    a.link.readings.append(lambda q: q * scale)


def _deflection_offset(a: Assembly, m: int, p: Values) -> None:
    offset = p["offset_rad"]
    if len(a.motors) == 1:
        a.link.readings.append(lambda q: q + offset)
    else:
        a.motors[m].readings.append(lambda theta: theta - offset)


DEFINITIONS = (
    Definition(
        name="deflection_offset",
        location="measurement",
        meaning="constant offset of the link encoder, or with two motors of that motor's encoder",
        parameters=(EffectParameter("offset_rad", "deflection that is read where there is none"),),
        apply=_deflection_offset,
    ),
    Definition(
        name="encoder_eccentricity",
        location="measurement",
        meaning="the link encoder's disc is off centre",
        parameters=(
            EffectParameter("sin_rad", "error of the reading, sine of q"),
            EffectParameter("cos_rad", "error of the reading, cosine of q", 0.0),
        ),
        apply=_eccentricity,
    ),
    Definition(
        name="encoder_delay",
        location="measurement",
        meaning="the link position is older than the rest",
        parameters=(EffectParameter("delay_s", "by this time"),),
        apply=_encoder_delay,
    ),
    Definition(
        name="encoder_scale",
        location="measurement",
        meaning="the link encoder's scale is wrong",
        parameters=(EffectParameter("relative_error", "share by which it reads too much"),),
        apply=_encoder_scale,
    ),
)
