"""Write the golden byte vectors that the tests of every language read.

The bytes come from zenoh's own serializer, not from drivelink's structs. One line a vector: name, bytes in
hexadecimal, then the numbers they stand for, in the order of the wire, the length of the sequence included.
`refused.txt` has names and bytes of what is no estimate, or is called valid and cannot be, and
`refused_external.txt` the same of external torques.

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
    "antagonistic": (123_456, 1_795_000_000_123_456_789, 3, -0.75, 61.0, 1.5,
                     [(9.25, 30.5, 1.0, 0.3), (-10.0, 30.5, 1.125, -0.328125)]),
    "held": (2, 2_000_000, 0x00000404, 1e-300, 5e-324, math.inf, [(1e-300, 5e-324, math.inf, -0.0)]),
    "torque_only": (4, 4_000_000, 0x2001, 2.5, math.nan, math.nan, [(2.5, math.nan, math.nan, math.nan)]),
    "invalid": (3, 3_000_000, 0, math.nan, math.nan, math.nan, [(math.nan, math.nan, math.nan, 0.125)]),
    "extremes": (MAX_U64, MAX_U64, 2**32 - 1, -1.7976931348623157e308, 0.1, 1 / 3, [(0.1, 0.2, 0.3, 0.4)] * 3),
}  # fmt: skip
# What a client must not take: bytes that are no estimate, and numbers that cannot be called valid.
_WHOLE = (1, 2, 3, 12.5, 812.25, 4.0, [(12.5, 812.25, 4.0, 0.0153)])
_HEAD = bytes(44)
REFUSED = {
    "empty": b"",
    "cut_in_the_head": _HEAD[:-1],
    "without_a_length": _HEAD,
    "length_without_elements": _HEAD + b"\x01",
    "length_of_2_to_the_28": _HEAD + b"\xff\xff\xff\x7f" + b"\x00",
    "length_of_2_to_the_63": _HEAD + b"\xff" * 8 + b"\x7f",
    "length_that_does_not_end": _HEAD + b"\xff" * 5,
    "length_of_2_in_two_bytes": _HEAD + b"\x82\x00" + bytes(64),
    "nine_transmissions": _HEAD + b"\x09" + bytes(9 * 32),
    "one_byte_more": _HEAD + b"\x01" + bytes(33),
}
WRONG = {  # place in the message, numbers that it cannot have while it is called valid
    "torque": ((3, None), (math.nan, math.inf, -math.inf)),
    "stiffness": ((4, None), (math.nan, math.inf, -1.0)),
    "std": ((5, None), (math.nan, math.inf, -1e-9)),
    "own_torque": ((6, 0), (math.nan, -math.inf)),
    "own_stiffness": ((6, 1), (math.nan, math.inf, -1.0)),
    "own_std": ((6, 2), (math.nan, -math.inf)),
    "deflection": ((6, 3), (math.nan, math.inf)),
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
EXTERNALS = {
    "push": (123_456, 1_795_000_000_123_456_789, 3, -0.75, 0.015625),
    "free": (1, 1_700_000_000_000_000_000, 1, 0.1, 1 / 3),
    "nothing": (0, 0, 0, math.nan, math.nan),
    "settling": (2, 2_000_000, 0, 5e-324, math.inf),
    "extremes": (MAX_U64, MAX_U64, 2**32 - 1, -1.7976931348623157e308, 0.0),
}
REFUSED_EXTERNALS = {
    "empty": b"",
    "one_byte_less": bytes(35),
    "one_byte_more": bytes(37),
    "an_estimate": _HEAD + b"\x00",
}
WRONG_EXTERNALS = {
    "valid_with_torque_of_nan": (1, 2, 1, math.nan, 1.0),
    "valid_with_torque_of_inf": (1, 2, 1, -math.inf, 1.0),
    "valid_with_std_of_nan": (1, 2, 3, 1.0, math.nan),
    "valid_with_std_of_inf": (1, 2, 1, 1.0, math.inf),
    "valid_with_std_of_-1": (1, 2, 1, 1.0, -1.0),
    "contact_and_not_valid": (1, 2, 2, 1.0, 1.0),
}


KINDS = {  # of the numbers of a message before its list
    "estimate": (UInt64, UInt64, UInt32, *[Float64] * 3),
    "sample": (UInt64, UInt64, *[Float64] * 3),
    "external": (UInt64, UInt64, UInt32, *[Float64] * 2),
}


def serialized(kind, values):
    """The bytes of a message; what follows the numbers is a list of tuples."""
    head = tuple(make(value) for make, value in zip(KINDS[kind], values, strict=False))
    return bytes(
        z_serialize((*head, *([tuple(map(Float64, one)) for one in rest] for rest in values[len(head) :])))
    )


def line(name, kind, values):
    head, lists = values[: len(KINDS[kind])], values[len(KINDS[kind]) :]
    numbers = [*head, *(number for one in lists for number in (len(one), *(x for each in one for x in each)))]
    return " ".join([name, serialized(kind, values).hex(), *map(repr, numbers)]) + "\n"


def refused():
    """Name and bytes of everything that a client must refuse."""
    yield from REFUSED.items()
    for what, ((place, inner), numbers) in WRONG.items():
        for number in numbers:
            values = list(_WHOLE)
            if inner is None:
                values[place] = number
            else:
                values[place] = [tuple(number if i == inner else v for i, v in enumerate(_WHOLE[place][0]))]
            yield f"valid_with_{what}_of_{number:g}", serialized("estimate", values)
    partial = (4, 4, 0x2001, 2.5, math.inf, math.nan, [])
    yield "valid_and_partial_with_stiffness_of_inf", serialized("estimate", partial)


def main():
    """Write the files."""
    for kind, vectors in (("estimate", ESTIMATES), ("sample", SAMPLES), ("external", EXTERNALS)):
        text = "".join(line(name, kind, values) for name, values in vectors.items())
        (HERE / f"{kind}.txt").write_text(text, encoding="ascii")
    wrong = {name: serialized("external", values) for name, values in WRONG_EXTERNALS.items()}
    for file, vectors in (("refused", dict(refused())), ("refused_external", REFUSED_EXTERNALS | wrong)):
        # "-" stands for no bytes
        text = "".join(f"{name} {payload.hex() or '-'}\n" for name, payload in vectors.items())
        (HERE / f"{file}.txt").write_text(text, encoding="ascii")


if __name__ == "__main__":
    main()
