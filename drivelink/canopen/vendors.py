"""What makers do in their own way, where the object dictionary does not tell it.

Each line is taken from a maker's manual or data sheet file; what is not known for sure is not here, and
is said in the joint file instead (`current_object`, `velocity_rad_s_per_count`, …).
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["GENERIC", "VENDORS", "CurrentObject", "Vendor", "vendor_of"]

Address = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentObject:
    """A vendor object for the motor current.

    Attributes:
        address: index and subindex.
        unit_a: amperes per count.
    """

    address: Address
    unit_a: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Vendor:
    """One maker.

    Attributes:
        name: as users know it.
        current: where the current is, if not at 0x6078.
        counts_per_rev: object with the counts per motor revolution, if not at 0x608F.
        gear: objects with numerator and denominator of the gear, if not at 0x6091.
        torque_constant: object with the torque constant in µN·m/A.
        nominal_current: object with the nominal current in mA.
        rated_torque_micro: whether 0x6076 may be in µN·m.
        velocity_counts_s: counts per second and count of 0x606C, where 0x60A9 does not tell.
        sensorless: object of 0x60E4 that is computed and no encoder.
        toggling_statusword_bits: bits of 0x6041 that change by themselves.
    """

    name: str
    current: CurrentObject | None = None
    counts_per_rev: Address | None = None
    gear: tuple[Address, Address] | None = None
    torque_constant: Address | None = None
    nominal_current: Address | None = None
    rated_torque_micro: bool = False
    velocity_counts_s: float | None = None
    sensorless: Address | None = None
    toggling_statusword_bits: int = 0

    def objects(self) -> tuple[Address, ...]:
        """Vendor objects that are read for units."""
        single = (self.counts_per_rev, self.torque_constant, self.nominal_current)
        return tuple(address for address in single if address) + (self.gear or ())


GENERIC = Vendor(name="")

VENDORS = {
    0x000000FB: Vendor(
        name="maxon",
        current=CurrentObject(address=(0x30D1, 2), unit_a=1e-3),
        counts_per_rev=(0x3000, 5),
        gear=((0x3003, 1), (0x3003, 2)),
        torque_constant=(0x3001, 5),
        nominal_current=(0x3001, 1),
        rated_torque_micro=True,
    ),
    0x0000009A: Vendor(name="Elmo", velocity_counts_s=1.0),
    0x000000AB: Vendor(name="Copley", velocity_counts_s=0.1),
    0x0000026C: Vendor(name="Nanotec", sensorless=(0x60E4, 1)),
    0x000022D2: Vendor(name="Synapticon"),
    0x00000002: Vendor(name="Beckhoff", toggling_statusword_bits=1 << 10),
    0x00000082: Vendor(name="Infranor"),
    0x000000BD: Vendor(name="Kollmorgen"),
    0x00000147: Vendor(name="Faulhaber"),
    0x000001A3: Vendor(name="Technosoft"),
}


def vendor_of(vendor_id: int) -> Vendor:
    """The maker of 0x1018:01, or a generic one."""
    return VENDORS.get(vendor_id, GENERIC)
