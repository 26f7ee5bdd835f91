"""The bytes on zenoh: against zenoh's own serializer (golden vectors), and back."""

import math
import struct
from pathlib import Path

import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh.ext import Float64, UInt32, UInt64, z_deserialize, z_serialize

from drivelink._core import STATUS_BITS, encode_estimate, encode_external, encode_sample
from drivelink.errors import ZenohError
from drivelink.pubsub import wire
from estimator.sample import Estimate, External, Sample, Status, TransmissionEstimate

GOLDEN = Path(__file__).parent / "golden"
NUMBER = st.floats(allow_nan=False)
U64 = st.integers(0, 2**64 - 1)


def vectors(file):
    lines = (GOLDEN / file).read_text(encoding="ascii").splitlines()
    return [
        pytest.param(bytes.fromhex(payload), list(map(number, numbers)), id=name)
        for name, payload, *numbers in map(str.split, lines)
    ]


def number(text):
    return int(text) if text.isdigit() else float(text)


def groups(numbers, size):
    return tuple(tuple(numbers[i : i + size]) for i in range(0, len(numbers), size))


def same(a, b):
    """Equal, NaN and the sign of zero included."""
    return struct.pack(f"<{len(a)}d", *a) == struct.pack(f"<{len(b)}d", *b)


@pytest.mark.parametrize(("payload", "numbers"), vectors("estimate.txt"))
def test_an_estimate_is_the_bytes_that_zenoh_serializes(payload, numbers):
    sequence, stamp_ns, status, *totals = numbers[:6]
    transmissions = tuple(TransmissionEstimate(*group) for group in groups(numbers[7:], 4))
    estimate = Estimate(sequence, status, *totals, transmissions)
    assert encode_estimate(estimate, stamp_ns) == payload

    message = wire.decode_estimate(payload)
    assert message[:3] == (sequence, stamp_ns, status)
    assert same(message[3:6], totals)
    assert same([n for t in message.transmissions for n in t], numbers[7:])
    assert message.valid == bool(status & 1)
    assert message.observable == bool(status & 2)


def refused():
    """(file, bytes of a line, what reads them)."""
    for file, decode in (
        ("refused.txt", wire.decode_estimate),
        ("refused_external.txt", wire.decode_external),
    ):
        for name, payload in map(str.split, (GOLDEN / file).read_text(encoding="ascii").splitlines()):
            yield pytest.param(decode, bytes.fromhex(payload.replace("-", "")), id=f"{file}: {name}")
    yield pytest.param(wire.decode_sample, z_serialize(b"something else").to_bytes(), id="no sample")


@pytest.mark.parametrize(("decode", "payload"), list(refused()))
def test_what_is_none_or_cannot_be_valid_is_refused(decode, payload):
    with pytest.raises(ZenohError, match=rf"^drivelink\.{decode.__name__.removeprefix('decode_')}/1: "):
        decode(payload)


@pytest.mark.parametrize(("payload", "numbers"), vectors("external.txt"))
def test_an_external_torque_is_the_bytes_that_zenoh_serializes(payload, numbers):
    sequence, stamp_ns, status, torque, std = numbers
    external = External(sequence, status, torque, std, math.nan, math.nan)
    assert encode_external(external, stamp_ns) == payload
    message = wire.decode_external(payload)
    assert message[:3] == (sequence, stamp_ns, status)
    assert same(message[3:], [torque, std])
    assert (message.valid, message.contact) == (bool(status & 1), bool(status & 2))
    kind = tuple[UInt64, UInt64, UInt32, Float64, Float64]
    assert same(z_deserialize(kind, zenoh.ZBytes(payload))[3:], [torque, std])


@pytest.mark.parametrize(("payload", "numbers"), vectors("sample.txt"))
def test_a_sample_is_the_bytes_that_zenoh_serializes(payload, numbers):
    sequence, stamp_ns, link, velocity, external = numbers[:5]
    motors = tuple(zip(*groups(numbers[6:], 3), strict=True))
    assert encode_sample(Sample(sequence, *motors, link, velocity, external), stamp_ns) == payload

    sample, stamp = wire.decode_sample(payload)
    assert (sample.sequence, stamp) == (sequence, stamp_ns)
    assert same(sample[4:], [link, velocity, external])
    assert same([n for column in sample[1:4] for n in column], [n for column in motors for n in column])


@given(
    *(U64, U64, st.integers(0, 2**32 - 1), st.tuples(NUMBER, NUMBER, NUMBER)),
    st.lists(st.tuples(NUMBER, NUMBER, NUMBER, NUMBER), max_size=4),
)
def test_any_estimate_can_be_read_by_zenohs_deserializer(sequence, stamp_ns, status, totals, transmissions):
    estimate = Estimate(sequence, status, *totals, tuple(TransmissionEstimate(*t) for t in transmissions))
    payload, one = encode_estimate(estimate, stamp_ns), tuple[Float64, Float64, Float64, Float64]
    kind = tuple[UInt64, UInt64, UInt32, Float64, Float64, Float64, list[one]]
    assert z_deserialize(kind, zenoh.ZBytes(payload)) == (sequence, stamp_ns, status, *totals, transmissions)
    if not status & Status.VALID:  # else the numbers must be such as can be valid
        assert wire.decode_estimate(payload)[:6] == (sequence, stamp_ns, status, *totals)


def test_a_message_says_of_each_number_whether_it_may_be_used():
    names = ("valid", "torque_valid", "stiffness_valid")
    for name in names:
        message = wire.EstimateMessage(1, 0, int(Status[name.upper()]), 0.1, 2.0, 0.1, ())
        assert [other for other in names if getattr(message, other)] == [name]


def test_numpy_reads_the_same_bytes_as_records():
    estimate = Estimate(7, 3, 1.0, 2.0, 3.0, (TransmissionEstimate(4.0, 5.0, 6.0, 7.0),) * 2)
    records = np.frombuffer(encode_estimate(estimate, 9) * 3, wire.ESTIMATE.dtype(2))
    assert records["stiffness_nm_rad"].tolist() == [2.0] * 3
    assert records["transmissions"]["deflection_rad"].shape == (3, 2)
    assert set(records["count"]) == {2}


def test_rust_and_the_examples_have_the_bits_of_status():
    named = {bit.name: int(bit) for bit in Status if bit is not Status.PARTIAL}  # by the publisher
    assert named == STATUS_BITS
    against = [bit.bit_length() - 1 for bit in Status if "unusable" in bit.roles]
    mask = " | ".join(f"1 << {number}" for number in against)
    for example in ("examples/rust/src/lib.rs", "examples/cpp/drivelink_wire.h"):
        assert mask in (GOLDEN.parents[1] / example).read_text(encoding="utf-8")
