"""Descriptions of the encoder profile area of the simulated CiA 406 encoder."""

from __future__ import annotations

from dataclasses import dataclass

from sim.canopen.dictionary import DataType, Item, Object
from sim.canopen.objects import PdoDefault, array, mapping, var

__all__ = ["DEVICE_TYPE", "TPDOS", "EncoderData", "cia406_objects"]

I16, U8, U16, U32 = DataType.INTEGER16, DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32

DEVICE_TYPE = 0x0002_0196  # absolute multi-turn rotary encoder, CiA 406
PROFILE_VERSION = 0x0100_0302  # software 1.0, profile 3.2
SCALING, REVERSED = 0x04, 0x01  # bits of 0x6000

TPDOS = (
    PdoDefault(base=0x180, type=254, mapping=mapping((0x6004, 0, 32))),
    PdoDefault(base=0x280, type=1, mapping=mapping((0x6004, 0, 32))),
    PdoDefault(base=0x380, type=1, enabled=False, mapping=mapping((0x6004, 0, 32), (0x6030, 1, 16))),
    PdoDefault(base=0x480, type=254, enabled=False, mapping=mapping((0x6030, 1, 16))),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class EncoderData:
    """The nameplate of an encoder.

    Attributes:
        counts_per_rev: 0x6501.
        range_counts: where the position rolls over, 2 to 2**32.
    """

    counts_per_rev: int = 262144
    range_counts: int = 1 << 32


def cia406_objects(data: EncoderData) -> list[Object]:
    """Everything from 0x6000 on."""
    turns = min(0xFFFF, max(1, data.range_counts // data.counts_per_rev))
    total = min(0xFFFF_FFFF, data.range_counts)
    return [
        var(0x6000, "Operating parameters", U16, "rw"),
        var(0x6001, "Measuring units per revolution", U32, "rw", data.counts_per_rev),
        var(0x6002, "Total measuring range in measuring units", U32, "rw", total),
        var(0x6003, "Preset value", U32, "rw"),
        var(0x6004, "Position value", U32, "ro", pdo=True),
        array(
            0x6030,
            "Speed value",
            (Item(subindex=1, name="Speed value channel 1", type=I16, access="ro", pdo=True),),
        ),
        var(0x6200, "Cyclic timer", U16, "rw"),
        var(0x6500, "Operating status", U16, "ro", pdo=True),
        var(0x6501, "Single-turn resolution", U32, "ro", data.counts_per_rev),
        var(0x6502, "Number of distinguishable revolutions", U16, "ro", turns),
        var(0x6503, "Alarms", U16, "ro", pdo=True),
        var(0x6504, "Supported alarms", U16, "ro", 0x0001),
        var(0x6505, "Warnings", U16, "ro", pdo=True),
        var(0x6506, "Supported warnings", U16, "ro"),
        var(0x6507, "Profile and software version", U32, "ro", PROFILE_VERSION),
        var(0x6508, "Operating time", U32, "ro", 0xFFFF_FFFF),
        var(0x6509, "Offset value", DataType.INTEGER32, "ro"),
        array(
            0x650A,
            "Module identification",
            tuple(
                Item(subindex=k, name=name, type=DataType.INTEGER32, access="ro")
                for k, name in enumerate(
                    ("Manufacturer offset", "Manufacturer minimum", "Manufacturer maximum"),
                    start=1,
                )
            ),
        ),
        var(0x650B, "Serial number", U32, "ro", 1),
    ]
