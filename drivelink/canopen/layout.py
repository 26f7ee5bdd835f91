"""The configured PDOs: which frame carries which signal, at what scale.

The only interface between configuration (active or passive) and acquisition.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from drivelink.notice import Notice


class Signal(StrEnum):
    """Meaning of a mapped object for the joint."""

    MOTOR_POSITION = "motor_position"
    MOTOR_VELOCITY = "motor_velocity"
    MOTOR_TORQUE = "motor_torque"
    STATUSWORD = "statusword"
    LINK_POSITION = "link_position"
    LINK_VELOCITY = "link_velocity"
    VELOCITY_CHECK = "velocity_check"  # the motor's, for cross-checks only; so are the following
    TORQUE_CHECK = "torque_check"  # current beside torque, or torque beside current
    SECOND_POSITION = "second_position"  # the motor's, by another encoder
    FOLLOWING_ERROR = "following_error"
    POSITION_DEMAND = "position_demand"
    OTHER = "other"  # mapped by the drive, not used by us


@dataclass(frozen=True, slots=True, kw_only=True)
class MappedObject:
    """One object in a TPDO, or one that a node could send in one."""

    signal: Signal  # what it means
    index: int  # object index
    subindex: int  # object subindex
    bits: int  # its length in the frame
    signed: bool  # whether two's complement
    # SI units at the joint side per count, direction and gear included (1 for the statusword)
    scale: float = 1.0
    wraps: bool = False  # whether the counter rolls over at its length (absolute or incremental position)
    offset: float = 0.0  # SI units, subtracted after scaling (0 but for the link encoder's zero)
    # counts after which it rolls over, where that is less than its length allows (the measuring range of an
    # absolute encoder, 0x6002 of CiA 406); 0: at its length
    modulus: int = 0

    @property
    def address(self) -> tuple[int, int]:
        """Index and subindex."""
        return self.index, self.subindex


@dataclass(frozen=True, slots=True, kw_only=True)
class TpdoLayout:
    """One TPDO: its identifier and the objects in it, in order from bit 0."""

    cob_id: int  # identifier of the frame
    objects: tuple[MappedObject, ...]  # what is in it
    transmission_type: int = 1  # 1 to 240: every so many SYNCs; 254, 255: event-driven
    number: int = 0  # 1 for 0x1800/0x1A00 and so on; 0: unknown (passive)
    inhibit_s: float = 0.0  # shortest time between two frames with types 254 and 255; 0: none, or not known

    @property
    def length(self) -> int:
        """Bytes of the frame."""
        return (sum(mapped.bits for mapped in self.objects) + 7) // 8


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeLayout:
    """One node of a joint."""

    node_id: int  # 1 to 127
    motor: int | None  # index of the motor this drive belongs to, or None for a node that is only an encoder
    tpdos: tuple[TpdoLayout, ...]  # its frames that carry signals of the joint
    other_tpdos: tuple[TpdoLayout, ...] = ()  # enabled frames of this node that are not used but load the bus
    heartbeat_ms: int = 0  # period of the heartbeat the node produces, as read back; 0: none, or not known
    # (vendor, product code, revision, serial number) of 0x1018; 0 where not reported
    identity: tuple[int, int, int, int] = (0, 0, 0, 0)
    # unit objects with their unsigned values, as read while it was configured
    reported: tuple[tuple[tuple[int, int], int], ...] = ()
    notices: tuple[Notice, ...] = ()  # findings of its configuration


def layout_document(layout: NodeLayout) -> dict[str, Any]:
    """Return a layout as plain values, for the model document; without unit objects and notices."""
    document = asdict(layout)
    del document["reported"], document["notices"]
    return document


def layout_from(document: Mapping[str, Any]) -> NodeLayout:
    """Return a layout from its plain values.

    Raises:
        ValueError, KeyError, TypeError: they are none.
    """
    vendor, product, revision, serial = document["identity"]
    return NodeLayout(
        node_id=document["node_id"],
        motor=document["motor"],
        heartbeat_ms=document["heartbeat_ms"],
        identity=(vendor, product, revision, serial),
        tpdos=tuple(_tpdo_from(tpdo) for tpdo in document["tpdos"]),
        other_tpdos=tuple(_tpdo_from(tpdo) for tpdo in document["other_tpdos"]),
    )


def _tpdo_from(document: Mapping[str, Any]) -> TpdoLayout:
    objects = tuple(
        MappedObject(**{**each, "signal": Signal(each["signal"])}) for each in document["objects"]
    )
    return TpdoLayout(**{**document, "objects": objects})
