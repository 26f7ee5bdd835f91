"""The channels of an MCAP recording: JSON with a JSON schema each.

Foxglove and PlotJuggler plot JSON without a plugin. Names are those of the CSV columns; non-finite values are
null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from drivelink.pubsub.wire import EXTERNAL_COLUMNS, EstimateMessage, ExternalMessage
from drivelink.recording.columns import sample_columns, sample_row
from estimator.sample import SIGMA_95, External, ExternalStatus, Sample, Status, TransmissionEstimate

TOPICS = ("sample", "estimate", "external", "status", "model", "joint", "mapping", "can")

_PER_MOTOR = ("flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad", "deflection_rad")
_VALID, _OBSERVABLE = int(Status.VALID), int(Status.OBSERVABLE)
_EXTERNAL_NAMES = ("time_s", *EXTERNAL_COLUMNS[:2], "valid", "contact")


def estimate_columns(motors: int) -> tuple[str, ...]:
    """Names of an estimate's values, in the order of `estimate_row`."""
    return (
        "time_s",
        "flexibility_torque_nm",
        "stiffness_nm_rad",
        "stiffness_std_nm_rad",
        "observable",
        *(f"motor{i}_{name}" for i in range(1, motors + 1) for name in _PER_MOTOR),
    )


def estimate_row(
    time_s: float,
    status: int,
    totals: tuple[float, float, float],
    transmissions: tuple[TransmissionEstimate, ...],
) -> tuple[float, ...]:
    """An estimate as the values of `estimate_columns`."""
    observable = 1 if status & _OBSERVABLE else 0
    return (time_s, *totals, observable, *(value for one in transmissions for value in one))


def external_columns() -> tuple[str, ...]:
    """Names of the further values with declared link dynamics, in the order of `external_row`."""
    return (*EXTERNAL_COLUMNS, "link_flexibility_torque_nm", "flexibility_difference_nm")


def external_row(external: External | None) -> tuple[float, ...]:
    """An external torque as the values of `external_columns`."""
    if external is None:
        return (math.nan, math.nan, 0, 0, math.nan, math.nan)
    _, status, torque, std, link_torque, difference = external
    valid, contact = status & ExternalStatus.VALID, status & ExternalStatus.CONTACT
    return (torque, std, int(bool(valid)), int(bool(contact)), link_torque, difference)


def _band_columns(motors: int) -> tuple[str, ...]:
    """Names of validity and band edges, in the order of `_band_row`."""
    each = ("", *(f"motor{i}_" for i in range(1, motors + 1)))
    return ("valid", *(f"{part}stiffness_{edge}_nm_rad" for part in each for edge in ("low", "high")))


def _band_row(message: EstimateMessage) -> tuple[float, ...]:
    """Validity, and the edges of the 95 % bands of the joint and of each transmission."""
    stiffnesses = [(message.stiffness_nm_rad, message.stiffness_std_nm_rad)]
    stiffnesses += [(one.stiffness_nm_rad, one.stiffness_std_nm_rad) for one in message.transmissions]
    edges = [x + side * SIGMA_95 * std for x, std in stiffnesses for side in (-1.0, 1.0)]
    return (1 if message.status & _VALID else 0, *edges)


def sample_encoder(motors: int, period_s: float) -> Callable[[Sample], bytes]:
    """The function that makes a sample's message."""
    fill = _template(("sequence",), sample_columns(motors))

    def encode(sample: Sample) -> bytes:
        return fill((sample.sequence, *sample_row(sample, period_s)))

    return encode


def estimate_encoder(motors: int, period_s: float) -> Callable[[EstimateMessage], bytes]:
    """The function that makes an estimate's message."""
    fill = _template(("sequence", "status"), (*estimate_columns(motors), *_band_columns(motors)))

    def encode(message: EstimateMessage) -> bytes:
        totals = (message.flexibility_torque_nm, message.stiffness_nm_rad, message.stiffness_std_nm_rad)
        row = estimate_row(message.sequence * period_s, message.status, totals, message.transmissions)
        return fill((message.sequence, message.status, *row, *_band_row(message)))

    return encode


def external_encoder(period_s: float) -> Callable[[ExternalMessage], bytes]:
    """The function that makes an external torque's message."""
    fill = _template(("sequence", "status"), _EXTERNAL_NAMES)

    def encode(message: ExternalMessage) -> bytes:
        torque, std = message.external_torque_nm, message.external_torque_std_nm
        row = (message.sequence * period_s, torque, std, int(message.valid), int(message.contact))
        return fill((message.sequence, message.status, *row))

    return encode


def read_sample(message: Mapping[str, Any], motors: int) -> Sample:
    """The sample of a message, bit for bit; null becomes NaN."""

    def value(name: str) -> float:
        found = message.get(name)
        return math.nan if found is None else float(found)

    numbers = range(1, motors + 1)
    return Sample(
        int(message["sequence"]),
        tuple(value(f"motor{i}_position_rad") for i in numbers),
        tuple(value(f"motor{i}_velocity_rad_s") for i in numbers),
        tuple(value(f"motor{i}_torque_nm") for i in numbers),
        value("link_position_rad"),
        value("link_velocity_rad_s"),
        value("external_torque_nm"),
    )


def message_schema(topic: str, motors: int) -> bytes:
    """The JSON schema of a channel's messages."""
    integer, text = {"type": "integer"}, {"type": "string"}
    properties: dict[str, Any]
    if topic == "sample":
        properties = {"sequence": integer, **_numbers(sample_columns(motors))}
    elif topic == "estimate":
        properties = {
            "sequence": integer,
            "status": integer,
            **_numbers((*estimate_columns(motors), *_band_columns(motors))),
        }
    elif topic == "external":
        properties = {"sequence": integer, "status": integer, **_numbers(_EXTERNAL_NAMES)}
    elif topic == "can":
        properties = {"id": integer, "data": text | {"description": "bytes, two hex digits each"}}
    elif topic == "mapping":
        properties = {"joint": text, "nodes": {"type": "array", "items": {"type": "object"}}}
    elif topic == "joint":
        properties = {"text": text | {"description": "the joint file"}}
    else:
        properties = {}
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"drivelink.{topic}",
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }
    return json.dumps(schema).encode()


def _numbers(names: tuple[str, ...]) -> dict[str, Any]:
    return {name: {"type": ["number", "null"]} for name in names}


def _template(whole: tuple[str, ...], names: tuple[str, ...]) -> Callable[[tuple[float, ...]], bytes]:
    """Template of a JSON object with these names, first integers, then floats in shortest exact form."""
    fields = [f'"{name}":%d' for name in whole] + [f'"{name}":%r' for name in names]
    template = "{" + ",".join(fields) + "}"

    def fill(values: tuple[float, ...]) -> bytes:
        if all(map(math.isfinite, values)):
            return (template % values).encode()
        return (template % tuple(value if math.isfinite(value) else _NULL for value in values)).encode()

    return fill


class _Null:
    """Prints as null."""

    def __repr__(self) -> str:
        return "null"


_NULL = _Null()
