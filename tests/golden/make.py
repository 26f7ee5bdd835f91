"""Write the golden byte vectors that the tests of every language read.

The bytes come from zenoh's own serializer, not from drivelink's structs. One line a vector: name, bytes in
hexadecimal, then the numbers they stand for, in the order of the wire, the length of the sequence included.

    python tests/golden/make.py
"""

import math
from pathlib import Path

from zenoh.ext import Float64, UInt32, UInt64, z_serialize

HERE = Path(__file__).parent
MAX_U64 = 2**64 - 1

ESTIMATES = {
    "rigid": (0, 0, 0, 0.0, 0.0, 0.0, []),
    "single": (1, 1_700_000_000_000_000_000, 3, 12.5, 812.25, 4.0, [(12.5, 812.25, 4.0, 0.0153)]),
    "antagonistic": (
        123_456,
        1_795_000_000_123_456_789,
        3,
        -0.75,
        61.0,
        1.5,
        [(9.25, 30.5, 1.0, 0.3), (-10.0, 30.5, 1.125, -0.328125)],
    ),
    "held": (2, 2_000_000, 0x00000405, 1e-300, 5e-324, math.inf, [(1e-300, 5e-324, math.inf, -0.0)]),
    "invalid": (3, 3_000_000, 0, math.nan, math.nan, math.nan, [(math.nan, math.nan, math.nan, 0.125)]),
    "extremes": (
        MAX_U64,
        MAX_U64,
        2**32 - 1,
        -1.7976931348623157e308,
        0.1,
        1 / 3,
        [(0.1, 0.2, 0.3, 0.4)] * 3,
    ),
}
SAMPLES = {
    "single": (1, 1_700_000_000_000_000_000, 0.5, math.nan, math.nan, [(0.4847, math.nan, 12.0)]),
    "antagonistic": (
        2,
        1_700_000_000_001_000_000,
        0.5,
        0.01,
        -3.0,
        [(0.2, 1.5, 9.0), (0.828125, -2.0, -8.0)],
    ),
    "rigid": (3, 5, math.nan, math.nan, math.nan, [(1.0, 2.0, 3.0)]),
}


def estimate(sequence, stamp_ns, status, torque, stiffness, std, transmissions):
    head = (
        UInt64(sequence),
        UInt64(stamp_ns),
        UInt32(status),
        Float64(torque),
        Float64(stiffness),
        Float64(std),
    )
    return z_serialize((*head, [tuple(map(Float64, numbers)) for numbers in transmissions]))


def sample(sequence, stamp_ns, link, velocity, external, motors):
    head = (UInt64(sequence), UInt64(stamp_ns), Float64(link), Float64(velocity), Float64(external))
    return z_serialize((*head, [tuple(map(Float64, numbers)) for numbers in motors]))


def line(name, payload, values):
    *head, elements = values
    numbers = [*head, len(elements), *(number for element in elements for number in element)]
    return " ".join([name, bytes(payload).hex(), *map(repr, numbers)]) + "\n"


def main():
    for file, serialize, vectors in (("estimate.txt", estimate, ESTIMATES), ("sample.txt", sample, SAMPLES)):
        text = "".join(line(name, serialize(*values), values) for name, values in vectors.items())
        (HERE / file).write_text(text, encoding="ascii")


if __name__ == "__main__":
    main()
