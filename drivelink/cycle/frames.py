"""One TPDO from bytes to SI values: precompiled, no names looked up, nothing allocated that can be kept.

A frame is decoded when it arrives. Positions that roll over are unwrapped here, so that everything
behind sees angles without seams.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout

__all__ = ["Field", "Slot", "make_decoder", "signal_targets"]

Decoder = Callable[[bytes], tuple[int, ...]]

_CODES = {8: "b", 16: "h", 32: "i", 64: "q"}
_FD_LENGTHS = (8, 12, 16, 20, 24, 32, 48, 64)  # ISO 11898-1: data lengths of CAN FD beyond 8 bytes


def make_decoder(objects: tuple[MappedObject, ...]) -> Decoder:
    """The function that takes a frame's bytes and gives the mapped integers in order (CiA 301, 7.4.8.2).

    Objects of 8, 16, 32 and 64 bits are unpacked by one struct; other lengths bit by bit, bit 0 first.
    """
    if all(mapped.bits in _CODES for mapped in objects):
        codes = [_CODES[o.bits] if o.signed else _CODES[o.bits].upper() for o in objects]
        return struct.Struct("<" + "".join(codes)).unpack_from
    places = []
    shift = 0
    for mapped in objects:
        places.append((shift, (1 << mapped.bits) - 1, 1 << (mapped.bits - 1) if mapped.signed else 0))
        shift += mapped.bits

    def decode(data: bytes) -> tuple[int, ...]:
        whole = int.from_bytes(data, "little")
        # (x ^ sign) - sign extends the sign of a two's complement x; sign = 0 leaves it unsigned.
        return tuple([((whole >> at & mask) ^ sign) - sign for at, mask, sign in places])

    return decode


def signal_targets(motor: int | None, motors: int) -> dict[Signal, int]:
    """Where each signal of a node goes in the list of a joint's values.

    Args:
        motor: index of the motor it drives, or None.
        motors: of the joint: m positions, m velocities, m torques, then the link's position and velocity.
    """
    targets = {Signal.LINK_POSITION: 3 * motors, Signal.LINK_VELOCITY: 3 * motors + 1}
    if motor is not None:
        targets[Signal.MOTOR_POSITION] = motor
        targets[Signal.MOTOR_VELOCITY] = motors + motor
        targets[Signal.MOTOR_TORQUE] = 2 * motors + motor
    return targets


class Field:
    """One mapped object on its way into the sample: counts to SI, rolled-over counters straightened.

    Attributes:
        target: where in the list of values it goes.
    """

    __slots__ = ("_half", "_last", "_longest", "_offset", "_range", "_scale", "_total", "target")

    def __init__(self, mapped: MappedObject, target: int) -> None:
        self.target = target
        self._scale = mapped.scale
        self._offset = mapped.offset
        self._range = (mapped.modulus or 1 << mapped.bits) if mapped.wraps else 0
        self._half = self._range // 2
        self._longest = self._range // (4 if self._range >= 1 << 24 else 1)
        self._last: int | None = None
        self._total = 0

    def take(self, count: int) -> float:
        """The value in SI units of one reading, in counts.

        A counter that rolls over is followed by the shorter way round: exact as long as it moves by less
        than half its range between two readings, be there a gap or not. The first reading is taken as the
        one nearest zero: an unsigned absolute encoder a little below its zero is not a turn away from it.
        So is one that no motion explains: a counter of 24 bits or more does not move by a quarter of its
        range from one reading to the next.
        """
        if self._range:
            if self._last is None:
                self._total = (count + self._half) % self._range - self._half
            else:
                step = (count - self._last + self._half) % self._range - self._half
                if -self._longest <= step <= self._longest:
                    self._total += step
                else:
                    self._total = (count + self._half) % self._range - self._half
            self._last = count
            count = self._total
        return count * self._scale - self._offset

    def forget(self) -> None:
        """Take the next reading as it is: the counter may have started anew."""
        self._last = None


class Slot:
    """One TPDO of one node, with what has become of it in this cycle.

    Attributes:
        node_id: whose it is.
        cob_id: identifier of its frames.
        decode: bytes to integers.
        fields: (place among the integers, field) for the objects that go into the sample.
        statusword: place of 0x6041 among the integers, or -1.
        every: SYNCs from one frame to the next; 0: the drive sends when it pleases, the value is held.
        needed: whether a sample is incomplete without it.
        arrived: in this cycle.
        heard: since the start, or since the node rebooted.
        suspect: cycles for which, after a missing frame, the one that comes may be the late one.
        owed: frames that were missing and have not come late: so many may still be on their way.
        silent: periods since the last one.
        conflict: cycles for which two different frames in one cycle still discredit it.
        data: bytes of the last one.
    """

    __slots__ = (
        "arrived",
        "cob_id",
        "conflict",
        "data",
        "decode",
        "every",
        "fields",
        "heard",
        "length",
        "longest",
        "needed",
        "node_id",
        "owed",
        "silent",
        "statusword",
        "suspect",
    )

    def __init__(self, node: NodeLayout, tpdo: TpdoLayout, targets: Mapping[Signal, int]) -> None:
        self.node_id = node.node_id
        self.cob_id = tpdo.cob_id
        self.decode = make_decoder(tpdo.objects)
        self.fields = tuple(
            (place, Field(mapped, targets[mapped.signal]))
            for place, mapped in enumerate(tpdo.objects)
            if mapped.signal in targets
        )
        words = [place for place, mapped in enumerate(tpdo.objects) if mapped.signal is Signal.STATUSWORD]
        self.statusword = words[0] if words else -1
        self.every = tpdo.transmission_type if 1 <= tpdo.transmission_type <= 240 else 0
        self.needed = bool(self.fields)
        self.length = tpdo.length
        # More than eight bytes travel in the next CAN FD length, padded.
        padded = [length for length in _FD_LENGTHS if length >= self.length]
        self.longest = padded[0] if self.length > 8 and padded else self.length
        self.data = b""
        self.forget()

    def forget(self) -> None:
        """Start anew: nothing has been heard, no counter is known."""
        self.arrived = self.heard = False
        self.silent = self.conflict = self.suspect = self.owed = 0
        for _place, field in self.fields:
            field.forget()
