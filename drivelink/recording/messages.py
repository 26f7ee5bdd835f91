"""The channels of an MCAP recording: JSON with a JSON schema each.

Foxglove and PlotJuggler plot JSON without a plugin. Names are those of the CSV columns; non-finite values are
null.
"""

import json
import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from drivelink.output.numbers import Units, bare_name
from drivelink.pubsub.wire import EXTERNAL_COLUMNS, EstimateMessage, ExternalMessage
from drivelink.recording.columns import sample_columns, sample_row
from estimator.sample import SIGMA_95, Estimate, External, ExternalStatus, Sample, Status

TOPICS = ("sample", "estimate", "external", "status", "model", "joint", "mapping", "can", "log")
SCHEMA_NAMES = {"log": "foxglove.Log"}  # others are drivelink.<topic>

_PER_MOTOR = ("flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad", "deflection_rad")
_VALID, _OBSERVABLE = int(Status.VALID), int(Status.OBSERVABLE)
_EXTERNAL_NAMES = ("time_s", *EXTERNAL_COLUMNS[:2])
_WARNING = 3  # level of foxglove.Log
_JSON = ("false", "true")


def estimate_columns(motors: int) -> tuple[str, ...]:
    """Return the names of an estimate's values, in the order of `estimate_row`."""
    each = (f"motor{i}_{name}" for i in range(1, motors + 1) for name in _PER_MOTOR)
    return ("time_s", *_PER_MOTOR[:3], "observable", *each)


def estimate_row(time_s: float, estimate: Estimate) -> tuple[float, ...]:
    """Return an estimate as the values of `estimate_columns`."""
    _, status, *totals, transmissions = estimate
    observable = 1 if status & _OBSERVABLE else 0
    return (time_s, *totals, observable, *(value for one in transmissions for value in one))


def external_columns() -> tuple[str, ...]:
    """Return the names of the further values with declared link dynamics, in the order of `external_row`."""
    return (*EXTERNAL_COLUMNS, "link_flexibility_torque_nm", "flexibility_difference_nm")


def external_row(external: External | None) -> tuple[float, ...]:
    """Return an external torque as the values of `external_columns`."""
    if external is None:
        return (math.nan, math.nan, 0, 0, math.nan, math.nan)
    _, status, torque, std, link_torque, difference = external
    valid, contact = status & ExternalStatus.VALID, status & ExternalStatus.CONTACT
    return (torque, std, int(bool(valid)), int(bool(contact)), link_torque, difference)


def _band_columns(motors: int) -> tuple[str, ...]:
    """Names of band edges, in the order of `_band_row`."""
    each = ("", *(f"motor{i}_" for i in range(1, motors + 1)))
    return tuple(f"{part}stiffness_{edge}_nm_rad" for part in each for edge in ("low", "high"))


def _band_row(message: EstimateMessage) -> tuple[float, ...]:
    """Return the edges of the 95 % bands of the joint and of each transmission."""
    stiffnesses = [(message.stiffness_nm_rad, message.stiffness_std_nm_rad)]
    stiffnesses += [(one.stiffness_nm_rad, one.stiffness_std_nm_rad) for one in message.transmissions]
    return tuple(x + side * SIGMA_95 * std for x, std in stiffnesses for side in (-1.0, 1.0))


def _estimate_names(motors: int) -> tuple[str, ...]:
    """Numbers of an estimate's message: `observable` is a boolean there."""
    return (*(name for name in estimate_columns(motors) if name != "observable"), *_band_columns(motors))


class Encoders:
    """Makes the messages of a joint's samples, estimates and external torques."""

    def __init__(self, motors: int, period_s: float) -> None:
        self._period_s = period_s
        self._sample = _template(("sequence",), sample_columns(motors))
        self._estimate = _template(("sequence", "status", "valid", "observable"), _estimate_names(motors))
        self._external = _template(("sequence", "status", "valid", "contact"), _EXTERNAL_NAMES)

    def sample(self, sample: Sample) -> bytes:
        """Return a sample's message."""
        return self._sample((sample.sequence,), sample_row(sample, self._period_s))

    def estimate(self, message: EstimateMessage) -> bytes:
        """Return an estimate's message."""
        sequence, _, status, *totals, transmissions = message
        each = (value for one in transmissions for value in one)
        flags = _JSON[bool(status & _VALID)], _JSON[bool(status & _OBSERVABLE)]
        row = (sequence * self._period_s, *totals, *each, *_band_row(message))
        return self._estimate((sequence, status, *flags), row)

    def external(self, message: ExternalMessage) -> bytes:
        """Return an external torque's message."""
        sequence, _, status, torque, std = message
        flags = _JSON[message.valid], _JSON[message.contact]
        return self._external((sequence, status, *flags), (sequence * self._period_s, torque, std))


def events_of(status: bytes) -> list[tuple[float, str]]:
    """Return UNIX time in s and text of the events of a status document, whatever it contains."""
    document = json.loads(status)
    events = document.get("events") if isinstance(document, dict) else None
    return [
        (float(event["time"]), event["text"])
        for event in (events if isinstance(events, list) else ())
        if isinstance(event, dict)
        and isinstance(event.get("time"), int | float)
        and 0.0 <= event["time"] < 1e11
        and isinstance(event.get("text"), str)
    ]


def log_message(joint: str, time_s: float, text: str) -> bytes:
    """Return an event of the daemon as foxglove.Log."""
    seconds, nanoseconds = divmod(round(time_s * 1e9), 10**9)
    stamp = {"sec": seconds, "nsec": nanoseconds}
    fields = {"timestamp": stamp, "level": _WARNING, "message": text, "name": joint, "file": "", "line": 0}
    return json.dumps(fields).encode()


@cache
def measured_names(motors: int) -> tuple[str, ...]:
    """Return what a sample's message may hold, in order: positions, velocities, torques, then of the link."""
    kinds = ("position_rad", "velocity_rad_s", "torque_nm")
    of_motors = (f"motor{i}_{kind}" for kind in kinds for i in range(1, motors + 1))
    return (*of_motors, "link_position_rad", "link_velocity_rad_s", "external_torque_nm")


_INTEGER, _TEXT, _FLAG = {"type": "integer"}, {"type": "string"}, {"type": "boolean"}
_STATUS_BITS = _INTEGER | {"description": "status bits"}
_USABLE = _FLAG | {"description": "the numbers may be used"}
_PROPERTIES: Mapping[str, dict[str, Any]] = {  # but for numbers with units
    "sample": {"sequence": _INTEGER},
    "estimate": {
        "sequence": _INTEGER, "status": _STATUS_BITS, "valid": _USABLE,
        "observable": _FLAG | {"description": "the motion reveals the stiffness"},
    },
    "external": {
        "sequence": _INTEGER, "status": _STATUS_BITS, "valid": _USABLE,
        "contact": _FLAG | {"description": "something touches the link"},
    },
    "log": {
        "timestamp": {"type": "object", "properties": {"sec": _INTEGER, "nsec": _INTEGER}},
        "level": _INTEGER, "message": _TEXT, "name": _TEXT, "file": _TEXT, "line": _INTEGER,
    },
    "can": {"id": _INTEGER, "data": _TEXT | {"description": "bytes, two hex digits each"}},
    "mapping": {"joint": _TEXT, "nodes": {"type": "array", "items": {"type": "object"}}},
    "joint": {"text": _TEXT | {"description": "the joint file"}},
}  # fmt: skip


def message_schema(topic: str, motors: int) -> bytes:
    """Return the JSON schema of a channel's messages."""
    names: Mapping[str, tuple[str, ...]] = {
        "sample": sample_columns(motors),
        "estimate": _estimate_names(motors),
        "external": _EXTERNAL_NAMES,
    }
    properties = _PROPERTIES.get(topic, {}) | _numbers(names.get(topic, ()))
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": SCHEMA_NAMES.get(topic, f"drivelink.{topic}"),
        "type": "object",
        "properties": properties,
        "required": list(properties),
    }
    return json.dumps(schema).encode()


def _numbers(names: tuple[str, ...]) -> dict[str, Any]:
    """Each number with what it is and its unit."""
    units = Units(linear=False)
    return {
        name: {
            "type": ["number", "null"],
            "description": f"{bare_name(name)}, {units.of(name)}",
            "unit": units.of(name),
        }
        for name in names
    }


def _template(
    head: tuple[str, ...], names: tuple[str, ...]
) -> Callable[[tuple[int | str, ...], tuple[float, ...]], bytes]:
    """Template of a JSON object: integers and booleans as JSON, then floats in shortest exact form."""
    fields = [f'"{name}":%s' for name in head] + [f'"{name}":%r' for name in names]
    template = "{" + ",".join(fields) + "}"

    def fill(head: tuple[int | str, ...], values: tuple[float, ...]) -> bytes:
        if all(map(math.isfinite, values)):
            return (template % (*head, *values)).encode()
        shown = (value if math.isfinite(value) else _NULL for value in values)
        return (template % (*head, *shown)).encode()

    return fill


class _Null:
    """Prints as null."""

    def __repr__(self) -> str:
        return "null"


_NULL = _Null()
