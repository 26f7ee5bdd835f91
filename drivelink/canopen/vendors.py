"""Vendor peculiarities that the object dictionary does not show, and units written as numbers (CiA 303-2).

Each line of a vendor is taken from a maker's manual or EDS file; anything uncertain is declared in the joint
file instead (`current_object`, `velocity_rad_s_per_count`, …). Of 0x60A8 and 0x60A9 byte 3 is a signed power
of ten, byte 2 the numerator, byte 1 the denominator.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from drivelink.canopen import Address


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentObject:
    """A vendor object for the motor current."""

    address: Address  # index and subindex
    unit_a: float  # amperes per count
    bits: int = 32  # its length


@dataclass(frozen=True, slots=True, kw_only=True)
class Vendor:
    """One maker."""

    name: str  # as users know it
    current: CurrentObject | None = None  # object of the current, if not 0x6078
    counts_per_rev: Address | None = None  # object with the counts per motor revolution, if not 0x608F
    # objects with numerator and denominator of the gear, if not 0x6091
    gear: tuple[Address, Address] | None = None
    torque_constant: Address | None = None  # object with the torque constant in µN·m/A
    nominal_current: Address | None = None  # object with the nominal current in mA
    rated_torque_micro: bool = False  # whether 0x6076 may be in µN·m
    # what that one is multiplied by: 4 where it counts the pulses of a quadrature encoder
    counts_factor: int = 1
    velocity_rad_s: float | None = None  # rad/s per count of 0x606C, where 0x60A9 does not give it
    # counts per second and count of 0x606C, where 0x60A9 does not give it
    velocity_counts_s: float | None = None
    sensorless: Address | None = None  # object of 0x60E4 that is a sensorless estimate
    # (object, its like): the maker's drives that have this object and not `counts_per_rev` are another
    # generation
    others: tuple[tuple[Address, Vendor], ...] = ()

    def objects(self) -> tuple[Address, ...]:
        """Return vendor objects that are read for units."""
        single = (self.counts_per_rev, self.torque_constant, self.nominal_current)
        own = tuple(address for address in single if address) + (self.gear or ())
        return own + tuple(address for _, other in self.others for address in other.objects())

    def generation(self, reported: Mapping[Address, int]) -> Vendor:
        """Return this vendor's variant for a drive that has reported these objects."""
        if self.counts_per_rev not in reported:
            for marker, other in self.others:
                if marker in reported:
                    return other
        return self


GENERIC = Vendor(name="")

# Firmware specification of EPOS2: 0x6078 in mA, no 0x6075 to 0x6077, 0x2210:01 in pulses, 0x606C in rpm.
_EPOS2 = Vendor(
    name="maxon",
    current=CurrentObject(address=(0x6078, 0), unit_a=1e-3, bits=16),
    counts_per_rev=(0x2210, 1),
    counts_factor=4,
    velocity_rad_s=math.tau / 60,
)

VENDORS = {
    0x000000FB: Vendor(
        name="maxon",
        current=CurrentObject(address=(0x30D1, 2), unit_a=1e-3),
        counts_per_rev=(0x3000, 5),
        gear=((0x3003, 1), (0x3003, 2)),
        torque_constant=(0x3001, 5),
        nominal_current=(0x3001, 1),
        rated_torque_micro=True,
        others=(((0x2210, 1), _EPOS2),),
    ),
    0x0000009A: Vendor(name="Elmo", velocity_counts_s=1.0),
    0x000000AB: Vendor(name="Copley", velocity_counts_s=0.1),
    0x0000026C: Vendor(name="Nanotec", sensorless=(0x60E4, 1)),
    0x000022D2: Vendor(name="Synapticon"),
    0x00000002: Vendor(name="Beckhoff"),
    0x00000082: Vendor(name="Infranor"),
    0x000000BD: Vendor(name="Kollmorgen"),
    0x00000147: Vendor(name="Faulhaber"),
    0x000001A3: Vendor(name="Technosoft"),
}


def vendor_of(vendor_id: int) -> Vendor:
    """Return the vendor of 0x1018:01, or a generic one."""
    return VENDORS.get(vendor_id, GENERIC)


# CiA 303-2, notation of units as numbers: angle and time.
_ANGLES_RAD = {0x10: 1.0, 0x41: math.pi / 180, 0x42: math.pi / 10800, 0x43: math.pi / 648000, 0xB4: math.tau}
_TIMES_S = {0x03: 1.0, 0x47: 60.0, 0x48: 3600.0}
_DIMENSIONLESS, _INCREMENTS = 0x00, 0xB5


def angle_unit_rad(unit: int) -> float | None:
    """Return radians per count of a position in the unit of 0x60A8; None: no angle (increments)."""
    angle = _ANGLES_RAD.get(unit >> 16 & 0xFF)
    return None if angle is None else float(angle * 10.0 ** _signed8(unit >> 24))


def _signed8(byte: int) -> int:
    return (byte & 0xFF) - 0x100 if byte & 0x80 else byte & 0xFF


def velocity_unit_rad_s(unit: int, counts_per_rev: float | None) -> float | None:
    """Return radians per second and count of 0x606C, from 0x60A9.

    Byte 3 is the power of ten, byte 2 the numerator, byte 1 the denominator (CiA 303-2): 0x00B44700 is
    revolutions per minute, 0x00B50300 increments per second.

    Returns:
        The unit, or None where it is none of an angle per time.
    """
    numerator, denominator = unit >> 16 & 0xFF, unit >> 8 & 0xFF
    angle = _ANGLES_RAD.get(numerator)
    if numerator in (_INCREMENTS, _DIMENSIONLESS) and counts_per_rev:
        angle = math.tau / counts_per_rev
    time_s = _TIMES_S.get(denominator)
    if angle is None or time_s is None:
        return None
    return float(angle * 10.0 ** _signed8(unit >> 24) / time_s)
