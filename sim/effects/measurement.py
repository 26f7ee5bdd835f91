"""Effects in the measurement of positions. A reading is the true angle plus its error."""

from __future__ import annotations

import math
from functools import partial

from sim.effects.assembly import LISTED, Assembly, Values, define
from sim.effects.common import not_negative, wave

_effect = partial(define, LISTED, "measurement")


@_effect(
    "deflection_offset",
    "constant offset of the link encoder, or with two motors of that motor's encoder",
    offset_rad="deflection that is read where there is none",
)
def _deflection_offset(a: Assembly, m: int, p: Values) -> None:
    offset = p["offset_rad"]
    if len(a.motors) == 1:
        a.link.readings.append(lambda q: q + offset)
    else:
        a.motors[m].readings.append(lambda theta: theta - offset)


@_effect(
    "encoder_eccentricity",
    "the link encoder's disc is off centre",
    sin_rad="error of the reading, sine of q",
    cos_rad=("error of the reading, cosine of q", 0.0),
)
def _eccentricity(a: Assembly, m: int, p: Values) -> None:
    height, phase = wave(p["sin_rad"], p["cos_rad"], 1.0)
    a.link.readings.append(lambda q: q + height * math.sin(q + phase))


@_effect("encoder_delay", "the link position is older than the rest", delay_s="by this time")
def _encoder_delay(a: Assembly, m: int, p: Values) -> None:
    a.link.reading_delay_s += not_negative(p, "delay_s")


@_effect(
    "deflection_delay",
    "the deflection's sensor (strain gauges) is older than the rest",
    delay_s="by this time",
)
def _deflection_delay(a: Assembly, m: int, p: Values) -> None:
    a.link.deflection_delay_s += not_negative(p, "delay_s")


@_effect(
    "encoder_scale", "the link encoder's scale is wrong", relative_error="share by which it reads too much"
)
def _encoder_scale(a: Assembly, m: int, p: Values) -> None:
    scale = 1.0 + p["relative_error"]
    a.link.readings.append(lambda q: q * scale)
