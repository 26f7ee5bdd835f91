"""Computes the bus load of a cycle before the start.

A standard frame with n data bytes takes at most 47 + 8 n + ⌊(33 + 8 n) / 4⌋ bits, interframe space and
worst-case stuffing included: 55 for a SYNC, 135 for eight bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from drivelink.canopen.layout import NodeLayout, TpdoLayout
from drivelink.errors import BusError
from drivelink.jointfile import BusSection

CAPACITY = 1.0  # of the bit rate, worst-case stuffing
COMFORTABLE = 0.7  # above it, event-driven frames of others begin to delay the cycle


def frame_bits(data_bytes: int) -> int:
    """Return bits on the wire of a standard frame, worst case."""
    return 47 + 8 * data_bytes + (33 + 8 * data_bytes) // 4


@dataclass(frozen=True, slots=True, kw_only=True)
class BusLoad:
    """Load of the cycle on the bus."""

    bits_per_s: float  # worst case
    bitrate: int  # bit/s of the bus
    frames_per_s: float  # of them

    @property
    def fraction(self) -> float:
        """Of the bit rate."""
        return self.bits_per_s / self.bitrate


def _tpdo_rate_hz(tpdo: TpdoLayout, sync_hz: float) -> float:
    if 1 <= tpdo.transmission_type <= 240:
        return sync_hz / tpdo.transmission_type
    # On change: a measured value changes in every control cycle, so only the inhibit time bounds it.
    return min(sync_hz, 1 / tpdo.inhibit_s) if tpdo.inhibit_s > 0 else sync_hz


def bus_load(layouts: Iterable[NodeLayout], bus: BusSection) -> BusLoad:
    """Load of SYNC, all enabled TPDOs and heartbeats of all nodes on a bus."""
    sync_hz = 1 / bus.period_s
    frames = [(sync_hz, frame_bits(1 if bus.sync_counter_overflow else 0))]
    for layout in layouts:
        frames += [
            (_tpdo_rate_hz(tpdo, sync_hz), frame_bits(tpdo.length))
            for tpdo in layout.tpdos + layout.other_tpdos
        ]
        if layout.heartbeat_ms:
            frames.append((1000 / layout.heartbeat_ms, frame_bits(1)))
    return BusLoad(
        bits_per_s=sum(rate * bits for rate, bits in frames),
        bitrate=bus.bitrate,
        frames_per_s=sum(rate for rate, _ in frames),
    )


def check_capacity(load: BusLoad, period_s: float) -> None:
    """Check that the bus can carry the load.

    Raises:
        BusError: more bits per second than the bit rate.
    """
    if load.fraction > CAPACITY:
        raise BusError(
            f"bus load would be {load.fraction:.0%}: {load.frames_per_s:.0f} frames/s need up to "
            f"{load.bits_per_s / 1000:.0f} kbit/s of {load.bitrate / 1000:.0f} kbit/s; a period of "
            f"{period_s * load.fraction / COMFORTABLE * 1000:.2g} ms (bus.period_s) or fewer drives would fit"
        )
