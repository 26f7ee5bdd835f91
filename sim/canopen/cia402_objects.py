"""Descriptions of the drive profile area of the simulated CiA 402 drive (CiA 402-2, -3; torque modes)."""

from __future__ import annotations

from dataclasses import dataclass

from sim.canopen.dictionary import DataType, Item, Object
from sim.canopen.objects import PdoDefault, array, mapping, record, var

__all__ = ["DEVICE_TYPE", "RPDOS", "TPDOS", "DriveData", "cia402_objects"]

I8, I16, I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32

DEVICE_TYPE = 0x0002_0192  # servo drive, CiA 402
_TORQUE_MODES = 1 << 3 | 1 << 9  # 0x6502: profile torque, cyclic synchronous torque

TPDOS = (
    PdoDefault(base=0x180, type=255, mapping=mapping((0x6041, 0, 16)), inhibit=10),
    PdoDefault(base=0x280, type=1, mapping=mapping((0x6064, 0, 32), (0x6077, 0, 16), (0x6041, 0, 16))),
    PdoDefault(base=0x380, type=1, enabled=False, mapping=mapping((0x6041, 0, 16), (0x6064, 0, 32))),
    PdoDefault(base=0x480, type=1, enabled=False, mapping=mapping((0x60E4, 1, 32), (0x606C, 0, 32))),
)
RPDOS = (
    PdoDefault(base=0x200, type=255, mapping=mapping((0x6040, 0, 16))),
    PdoDefault(base=0x300, type=255, mapping=mapping((0x6040, 0, 16), (0x6060, 0, 8))),
    PdoDefault(base=0x400, type=1, mapping=mapping((0x6040, 0, 16), (0x6071, 0, 16))),
    PdoDefault(base=0x500, type=1, enabled=False, mapping=mapping((0x6071, 0, 16))),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveData:
    """The nameplate of one drive with its motor, encoders and gear.

    Attributes:
        rated_current_ma: 0x6075.
        rated_torque_mnm: 0x6076, at the motor shaft.
        max_current_per_mille: 0x6073.
        counts_per_rev: 0x608F:1, per motor revolution.
        gear: 0x6091: motor revolutions per shaft revolutions.
        link_counts_per_rev: 0x60E6:1, of the second encoder; None: it is not wired.
        velocity_unit: 0x60A9; 0x00B44700 is rpm, the topmost byte a signed power of ten.
    """

    rated_current_ma: int = 2000
    rated_torque_mnm: int = 100
    max_current_per_mille: int = 3000
    counts_per_rev: int = 4096
    gear: tuple[int, int] = (1, 1)
    link_counts_per_rev: int | None = None
    velocity_unit: int = 0xFDB4_4700


def cia402_objects(data: DriveData, second_encoder: int = 1) -> list[Object]:
    """Everything from 0x6000 on.

    Args:
        data: the nameplate.
        second_encoder: sub-index of the link encoder in 0x60E4; sensors below it don't exist.
    """
    return [*_control(), *_measured(), *_torque(data), *_scales(data), *_second_encoder(data, second_encoder)]


def _control() -> list[Object]:
    return [
        var(0x6007, "Abort connection option code", I16, "rw", 1, low=0, high=3),
        var(0x603F, "Error code", U16, "ro", pdo=True),
        var(0x6040, "Controlword", U16, "rww", pdo=True),
        var(0x6041, "Statusword", U16, "ro", pdo=True),
        var(0x605A, "Quick stop option code", I16, "rw", 2, low=0, high=8),
        var(0x605B, "Shutdown option code", I16, "rw", 0, low=0, high=1),
        var(0x605C, "Disable operation option code", I16, "rw", 1, low=0, high=1),
        var(0x605D, "Halt option code", I16, "rw", 1, low=1, high=4),
        var(0x605E, "Fault reaction option code", I16, "rw", 2, low=0, high=4),
        var(0x6060, "Modes of operation", I8, "rww", pdo=True),
        var(0x6061, "Modes of operation display", I8, "ro", pdo=True),
        var(0x6402, "Motor type", U16, "rw", 0x000A),
        var(0x6502, "Supported drive modes", U32, "ro", _TORQUE_MODES, pdo=True),
        var(0x60FD, "Digital inputs", U32, "ro", pdo=True),
    ]


def _measured() -> list[Object]:
    return [
        var(0x6063, "Position actual internal value", I32, "ro", pdo=True),
        var(0x6064, "Position actual value", I32, "ro", pdo=True),
        var(0x6069, "Velocity sensor actual value", I32, "ro", pdo=True),
        var(0x606C, "Velocity actual value", I32, "ro", pdo=True),
        var(0x6077, "Torque actual value", I16, "ro", pdo=True),
        var(0x6078, "Current actual value", I16, "ro", pdo=True),
        var(0x6079, "DC link circuit voltage", U32, "ro", 48_000, pdo=True),
    ]


def _torque(data: DriveData) -> list[Object]:
    return [
        var(0x6071, "Target torque", I16, "rww", pdo=True),
        var(0x6072, "Max torque", U16, "rw", 3000, pdo=True),
        var(0x6073, "Max current", U16, "rw", data.max_current_per_mille),
        var(0x6074, "Torque demand", I16, "ro", pdo=True),
        var(0x6075, "Motor rated current", U32, "ro", data.rated_current_ma),
        var(0x6076, "Motor rated torque", U32, "ro", data.rated_torque_mnm),
        var(0x6087, "Torque slope", U32, "rw", 10_000, pdo=True),
        var(0x6088, "Torque profile type", I16, "rw", 0, low=0, high=0),
        var(0x60B2, "Torque offset", I16, "rww", pdo=True),
    ]


def _scales(data: DriveData) -> list[Object]:
    def ratio(index: int, name: str, parts: tuple[str, str], values: tuple[int, int]) -> Object:
        items = (
            Item(subindex=k, name=part, type=U32, access="ro", default=value)
            for k, (part, value) in enumerate(zip(parts, values, strict=True), start=1)
        )
        return record(index, name, tuple(items))

    counts, gear = data.counts_per_rev, data.gear
    return [
        var(0x607E, "Polarity", U8, "rw"),
        ratio(
            0x608F, "Position encoder resolution", ("Encoder increments", "Motor revolutions"), (counts, 1)
        ),
        ratio(0x6091, "Gear ratio", ("Motor revolutions", "Shaft revolutions"), gear),
        ratio(0x6092, "Feed constant", ("Feed", "Shaft revolutions"), (counts * gear[0] // gear[1], 1)),
        var(0x60A8, "SI unit position", U32, "ro", 0x00B5_0000),
        var(0x60A9, "SI unit velocity", U32, "rw", data.velocity_unit),
    ]


def _second_encoder(data: DriveData, subindex: int) -> list[Object]:
    counts = data.link_counts_per_rev or 0

    def sensors(index: int, name: str, type_: DataType, default: int, pdo: bool) -> Object:
        items = (
            Item(
                subindex=k,
                name=f"{name}, sensor {k}",
                type=type_,
                access="ro",
                default=default if k == subindex else 0,
                pdo=pdo,
            )
            for k in range(1, subindex + 1)
        )
        return array(index, name, tuple(items))

    return [
        sensors(0x60E4, "Additional position actual value", I32, 0, True),
        sensors(0x60E5, "Additional velocity actual value", I32, 0, True),
        sensors(0x60E6, "Additional encoder resolution - increments", U32, counts, False),
        sensors(0x60EB, "Additional encoder resolution - motor revolutions", U32, 1, False),
    ]
