"""The joint's PDOs as a DBC database by cantools: `pip install drivelink-vsa[dbc]`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout
from drivelink.errors import UsageError

_UNITS = {
    Signal.MOTOR_POSITION: "rad",
    Signal.MOTOR_VELOCITY: "rad/s",
    Signal.MOTOR_TORQUE: "Nm",
    Signal.LINK_POSITION: "rad",
    Signal.LINK_VELOCITY: "rad/s",
    Signal.VELOCITY_CHECK: "rad/s",
    Signal.SECOND_POSITION: "rad",
    Signal.FOLLOWING_ERROR: "rad",
    Signal.POSITION_DEMAND: "rad",
}


def dbc_text(joint: str, layouts: Iterable[NodeLayout]) -> str:
    """Describe every TPDO of a joint's nodes, in SI at the joint side.

    Raises:
        UsageError: cantools is not installed.
    """
    try:
        from cantools.database import Database, Message
        from cantools.database.can import Node
    except ImportError as error:
        raise UsageError("dbc needs cantools: pip install 'drivelink-vsa[dbc]'") from error
    layouts = list(layouts)
    messages = [
        Message(
            frame_id=tpdo.cob_id,
            name=f"node{layout.node_id}_{tpdo.cob_id:03X}",
            length=tpdo.length,
            signals=_signals(tpdo, layout),
            senders=[f"node{layout.node_id}"],
            is_fd=tpdo.length > 8,
        )
        for layout in layouts
        for tpdo in (*layout.tpdos, *layout.other_tpdos)
    ]
    nodes = [Node(f"node{layout.node_id}", comment=f"of the joint {joint}") for layout in layouts]
    text: str = Database(messages=messages, nodes=nodes).as_dbc_string()
    return text


def _signals(tpdo: TpdoLayout, layout: NodeLayout) -> list[Any]:
    from cantools.database import Signal as DbcSignal
    from cantools.database.conversion import BaseConversion

    signals: list[Any] = []
    start = 0
    for mapped in tpdo.objects:
        conversion = BaseConversion.factory(scale=mapped.scale, offset=-mapped.offset)
        signals.append(
            DbcSignal(
                _name(mapped, layout),
                start,
                mapped.bits,
                is_signed=mapped.signed,
                conversion=conversion,
                unit=_UNITS.get(mapped.signal),
                comment=f"object 0x{mapped.index:04X}:{mapped.subindex:02X}",
            )
        )
        start += mapped.bits
    return signals


def _name(mapped: MappedObject, layout: NodeLayout) -> str:
    if mapped.signal is Signal.OTHER:
        return f"object_{mapped.index:04X}_{mapped.subindex:02X}"
    of_motor = mapped.signal.value.removeprefix("motor_")
    motor = "link" if layout.motor is None else f"motor{layout.motor + 1}"
    return mapped.signal.value if mapped.signal.value.startswith("link_") else f"{motor}_{of_motor}"
