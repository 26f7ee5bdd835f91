"""Layouts of `estimate`, `external` and `sample` on zenoh.

Zenoh's serialization of a tuple of fixed-width numbers is the packed little-endian struct, and that of a
sequence is its length as a LEB128 varint before the elements. So each message is one precompiled struct
here, `z_deserialize` of zenoh-ext in Rust, C, C++, Kotlin and TypeScript, and a plain struct on a
microcontroller. `drivelink/core/src/wire.rs` defines the fields: structs, the `schema` key and the
documentation are made from them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from struct import Struct
from typing import Any, NamedTuple

import numpy as np

from drivelink._core import MESSAGES
from drivelink.errors import ZenohError
from estimator.sample import ExternalStatus, Sample, Status, TransmissionEstimate

MAX_ELEMENTS = 8  # transmissions or motors in one message; below 128 the varint is one byte
_STRUCT_CODES = {"u64": "Q", "u32": "I", "f64": "d"}
_VALID, _PARTIAL = int(Status.VALID), int(Status.PARTIAL)
_JUDGED = _VALID | Status.having("unusable")  # of these bits a usable estimate has VALID only


class Field(NamedTuple):
    """One number: its name with the unit in it, its type (u64, u32, f64), its meaning."""

    name: str
    type: str
    meaning: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A message: fixed fields, then a sequence of equal elements, where it has one."""

    schema: str  # name and version, carried in the zenoh encoding
    head: tuple[Field, ...]  # the fixed fields, from byte 0
    elements: str = ""  # name of the sequence; empty: there is none, nor its length
    element: tuple[Field, ...] = ()  # the fields of one element

    def struct(self, count: int = 0) -> Struct:
        """Return the whole message with `count` elements and the byte that counts them."""
        length = "B" if self.elements else ""
        return Struct("<" + _codes(self.head) + length + _codes(self.element) * count)

    def size(self, count: int = 0) -> int:
        """Return the bytes of a message with `count` elements."""
        return self.struct(count).size

    def dtype(self, count: int = 0) -> np.dtype[np.void]:
        """Return the message as a numpy record: `np.frombuffer(payload, layout.dtype(1))`."""
        head = [(field.name, f"<{_codes((field,))}") for field in self.head]
        if not self.elements:
            return np.dtype(head)
        element = np.dtype([(field.name, f"<{_codes((field,))}") for field in self.element])
        return np.dtype([*head, ("count", "u1"), (self.elements, element, (count,))])

    def describe(self) -> dict[str, Any]:
        """Return the layout as plain data, for the `schema` key."""
        described: dict[str, Any] = {
            "schema": self.schema,
            "encoding": "zenoh/serialized",
            "byte_order": "little-endian",
            "fields": [field._asdict() for field in self.head],
        }
        if self.elements:
            described["sequence"] = {
                "name": self.elements,
                "length": "LEB128 varint (one byte below 128)",
                "fields": [field._asdict() for field in self.element],
            }
        return described


def _codes(fields: tuple[Field, ...]) -> str:
    return "".join(_STRUCT_CODES[field.type] for field in fields)


def _layout(name: str, elements: str = "") -> Layout:
    head, element = ([Field(*field) for field in MESSAGES.get(part, ())] for part in (name, elements))
    return Layout(schema=f"drivelink.{name}/1", head=tuple(head), elements=elements, element=tuple(element))


ESTIMATE = _layout("estimate", "transmissions")
EXTERNAL = _layout("external")
SAMPLE = _layout("sample", "motors")


class EstimateMessage(NamedTuple):
    """A received estimate: an `Estimate` and the UNIX time of its SYNC."""

    sequence: int
    stamp_ns: int
    status: int
    flexibility_torque_nm: float
    stiffness_nm_rad: float
    stiffness_std_nm_rad: float
    transmissions: tuple[TransmissionEstimate, ...]

    @property
    def valid(self) -> bool:
        """Status bit 0: all numbers may be used."""
        return bool(self.status & Status.VALID)

    @property
    def torque_valid(self) -> bool:
        """Status bit 7: the flexibility torque may be used, also where the stiffness may not."""
        return bool(self.status & Status.TORQUE_VALID)

    @property
    def stiffness_valid(self) -> bool:
        """Status bit 15: the stiffness may be used, also where the flexibility torque may not."""
        return bool(self.status & Status.STIFFNESS_VALID)

    @property
    def usable(self) -> bool:
        """Whether a controller may act on this estimate: valid, and neither alarm nor fault."""
        return self.status & _JUDGED == _VALID

    @property
    def observable(self) -> bool:
        """Status bit 1: the motion reveals the stiffness."""
        return bool(self.status & Status.OBSERVABLE)


class ExternalMessage(NamedTuple):
    """A received external torque and its SYNC."""

    sequence: int
    stamp_ns: int
    status: int
    external_torque_nm: float
    external_torque_std_nm: float

    @property
    def valid(self) -> bool:
        """Status bit 0: the numbers may be used."""
        return bool(self.status & ExternalStatus.VALID)

    @property
    def contact(self) -> bool:
        """Status bit 1: something touches the link."""
        return bool(self.status & ExternalStatus.CONTACT)


EXTERNAL_COLUMNS = (*ExternalMessage._fields[3:], "external_valid", "contact")
"""Names of an `ExternalMessage`'s values among others."""


class SampleMessage(NamedTuple):
    """A received sample and the UNIX time of its SYNC."""

    sample: Sample
    stamp_ns: int


_ESTIMATES = tuple(ESTIMATE.struct(count) for count in range(MAX_ELEMENTS + 1))
_SAMPLES = tuple(SAMPLE.struct(count) for count in range(MAX_ELEMENTS + 1))
_ESTIMATE_COUNTS = {layout.size: count for count, layout in enumerate(_ESTIMATES)}
_SAMPLE_COUNTS = {layout.size: count for count, layout in enumerate(_SAMPLES)}
_ESTIMATE_HEAD = ESTIMATE.struct(0)
_TRANSMISSION = Struct("<" + _codes(ESTIMATE.element))
_EXTERNAL = EXTERNAL.struct()
_SAMPLE_HEAD = len(SAMPLE.head)
_make_message = EstimateMessage._make
_make_transmission = TransmissionEstimate._make


def decode_estimate(payload: bytes) -> EstimateMessage:
    """Read the bytes of `<prefix>/<joint>/estimate`.

    Raises:
        ZenohError: malformed, or valid with an impossible number: not finite, or a negative stiffness or
            standard deviation. NaN is accepted with PARTIAL.
    """
    count = _count(payload, _ESTIMATE_COUNTS, ESTIMATE)
    *head, stated = _ESTIMATE_HEAD.unpack_from(payload)
    _require_count(stated, count, ESTIMATE)
    elements = tuple(map(_make_transmission, _TRANSMISSION.iter_unpack(payload[_ESTIMATE_HEAD.size :])))
    message = _make_message((*head, elements))
    if message.status & _VALID and not _usable(message):
        raise ZenohError(f"{ESTIMATE.schema}: valid, but a value is impossible (not finite, negative)")
    return message


def _usable(message: EstimateMessage) -> bool:
    """Return whether all numbers are possible: finite, stiffness and standard deviation not negative."""
    _, _, status, torque, stiffness, std, transmissions = message
    partial = bool(status & _PARTIAL)
    for own_torque, own_stiffness, own_std, deflection in ((torque, stiffness, std, 0.0), *transmissions):
        if not (
            math.isfinite(own_torque)
            and _magnitude(own_stiffness, partial)
            and _magnitude(own_std, partial)
            and (math.isfinite(deflection) or (partial and deflection != deflection))
        ):
            return False
    return True


def _magnitude(number: float, partial: bool) -> bool:
    """Return whether it is finite and not negative, or an allowed NaN."""
    return 0.0 <= number < math.inf or (partial and number != number)


def decode_external(payload: bytes) -> ExternalMessage:
    """Read the bytes of `<prefix>/<joint>/external`.

    Raises:
        ZenohError: malformed; valid with a non-finite number or negative standard deviation; or contact
            without valid.
    """
    if len(payload) != _EXTERNAL.size:
        raise ZenohError(f"{EXTERNAL.schema}: expected {_EXTERNAL.size} bytes, got {len(payload)}")
    message = ExternalMessage._make(_EXTERNAL.unpack(payload))
    if message.valid:
        torque, std = message.external_torque_nm, message.external_torque_std_nm
        if not (math.isfinite(torque) and 0.0 <= std < math.inf):
            raise ZenohError(f"{EXTERNAL.schema}: valid, but a value is impossible (not finite, negative)")
    elif message.contact:
        raise ZenohError(f"{EXTERNAL.schema}: says contact, but is not valid")
    return message


def decode_sample(payload: bytes) -> SampleMessage:
    """Read the bytes of `<prefix>/<joint>/sample`.

    Raises:
        ZenohError: malformed.
    """
    count = _count(payload, _SAMPLE_COUNTS, SAMPLE)
    values = _SAMPLES[count].unpack(payload)
    _require_count(values[_SAMPLE_HEAD], count, SAMPLE)
    sequence, stamp_ns, link, link_velocity, external = values[:_SAMPLE_HEAD]
    motors = values[_SAMPLE_HEAD + 1 :]
    sample = Sample(sequence, motors[0::3], motors[1::3], motors[2::3], link, link_velocity, external)
    return SampleMessage(sample, stamp_ns)


def _count(payload: bytes, counts: Mapping[int, int], layout: Layout) -> int:
    count = counts.get(len(payload))
    if count is None:
        expected = ", ".join(str(size) for size in list(counts)[:3])
        raise ZenohError(f"{layout.schema}: expected {expected}, … bytes, got {len(payload)}")
    return count


def _require_count(stated: int, count: int, layout: Layout) -> None:
    if stated != count:
        says = f"expected {count} {layout.elements} by its length, it says {stated}"
        raise ZenohError(f"{layout.schema}: {says}")
