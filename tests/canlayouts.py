"""Layouts and frames for the tests of the loop: a VSA of two drives and a CiA 406 encoder."""

import struct
from typing import Any

from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout

COUNT_RAD = 1e-4
TORQUE_NM = 1e-3
LINK_RAD = 2e-4


def mapped(signal: Signal, index: int, *, bits: int = 32, signed: bool = True, **more: Any) -> MappedObject:
    """One mapped object, of 32 signed bits if nothing else is said."""
    return MappedObject(signal=signal, index=index, subindex=0, bits=bits, signed=signed, **more)


def drive(node_id: int, motor: int | None, transmission_type: int = 1) -> NodeLayout:
    """A drive whose one TPDO carries 0x6064 (32), 0x6077 (16), 0x6041 (16): eight bytes."""
    position = mapped(Signal.MOTOR_POSITION, 0x6064, scale=COUNT_RAD, wraps=True)
    torque = mapped(Signal.MOTOR_TORQUE, 0x6077, bits=16, scale=TORQUE_NM)
    status = mapped(Signal.STATUSWORD, 0x6041, bits=16, signed=False)
    cob_id, objects = 0x180 + node_id, (position, torque, status)
    tpdo = TpdoLayout(cob_id=cob_id, transmission_type=transmission_type, objects=objects)
    return NodeLayout(node_id=node_id, motor=motor, tpdos=(tpdo,))


def encoder(node_id: int) -> NodeLayout:
    """A CiA 406 encoder node: 0x6004."""
    position = mapped(Signal.LINK_POSITION, 0x6004, signed=False, scale=LINK_RAD, wraps=True)
    return NodeLayout(
        node_id=node_id, motor=None, tpdos=(TpdoLayout(cob_id=0x180 + node_id, objects=(position,)),)
    )


VSA = (drive(1, 0), drive(2, 1), encoder(3))


def pdo(position: int, torque: int = 0, statusword: int = 0x0237) -> bytes:
    """The eight bytes of `drive`."""
    return struct.pack("<ihH", position, torque, statusword)


def link(position: int) -> bytes:
    """The four bytes of `encoder`."""
    return struct.pack("<I", position)


def vsa_cycle(count: int) -> list[tuple[int, bytes]]:
    """The frames that answer one SYNC; every value identifies the cycle."""
    return [(0x181, pdo(count, count)), (0x182, pdo(-count, -count)), (0x183, link(count))]
