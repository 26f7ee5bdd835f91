"""Metadata of a raw recording: the mapping of its nodes, also as a DBC database, and the joint file.

An MCAP file carries both; other formats get a file beside them: `r.log` has `r.log.mapping.json`.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from drivelink import jointfile
from drivelink.canopen.layout import (
    MappedObject,
    NodeLayout,
    Signal,
    TpdoLayout,
    layout_document,
    layout_from,
)
from drivelink.errors import RecordingError, UsageError, raised_as
from drivelink.files import read_regular
from drivelink.jointfile import JointFile, JointText, ZenohSection
from drivelink.recording.canlog import CAN_SUFFIXES
from drivelink.recording.mcapfile import read_messages

_SCHEMA = "drivelink.mapping/1"
MAX_BYTES = 1 << 20  # of such a document


def side_file(path: Path) -> Path:
    """Return the mapping file beside a raw CAN log."""
    return path.with_name(path.name + ".mapping.json")


def mapping_document(
    joint: str, layouts: Iterable[NodeLayout], text: str = "", *, daemon: bool = False
) -> dict[str, Any]:
    """Return the mapping document of a recording of frames.

    Args:
        daemon: whether the layouts come from a daemon rather than a file.
    """
    nodes = [layout_document(layout) for layout in layouts]
    about = {"schema": _SCHEMA, "joint": joint, "source": "daemon" if daemon else "file", "nodes": nodes}
    return about | {"text": text}


def layouts_from(data: bytes, joint: str, *, daemon: bool = False) -> list[NodeLayout]:
    """Return the layouts in a mapping or model document; none if it belongs to another joint.

    Args:
        daemon: only what a daemon said.

    Raises:
        ValueError: malformed.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES >> 10} KiB, got {len(data) >> 10} KiB")
    try:
        document = json.loads(data)
        if document.get("joint") != joint or (daemon and document.get("source") == "file"):
            return []
        return [layout_from(node) for node in document.get("nodes") or ()]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def recorded_layouts(path: Path, joint: str, *, daemon: bool, begun: bool = False) -> Sequence[NodeLayout]:
    """Return the first layouts of a joint's nodes in a recording, or ().

    Args:
        daemon: only from a daemon, whose layouts are those on the bus.
        begun: only those with which the recording began, not those of a daemon that started later.

    Raises:
        RecordingError: the mapping is damaged.
    """
    with raised_as(RecordingError, f"{path}: its mapping cannot be read", ValueError):
        for data in _carried(path, {"mapping"} if begun else {"mapping", "model"}):
            if layouts := layouts_from(data, joint, daemon=daemon):
                return layouts
    return ()


def joint_of(path: Path, named: Path | None) -> JointText:
    """Return the given joint file, or the one in the recording.

    Raises:
        JointFileError: it is wrong.
        RecordingError: the recording does not exist or is damaged.
        UsageError: none is given or carried.
    """
    if named is not None:
        return jointfile.load_text(named)
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    carried = next(_carried(path, {"joint"}), None)
    if carried is None:
        raise UsageError(f"{path}: expected joint=FILE, the joint file that it was recorded with")
    try:
        if len(carried) > MAX_BYTES:
            raise ValueError(f"expected at most {MAX_BYTES >> 10} KiB, got {len(carried) >> 10} KiB")
        text = str(json.loads(carried)["text"])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise RecordingError(f"{path}: the joint file in it cannot be read: {error}") from error
    name = f"{path}: joint file in it"
    return JointText(joint=contained(jointfile.parse(text, name)), text=text, folder=path.parent, name=name)


def contained(joint: JointFile) -> JointFile:
    """Return a recording's joint file without what names something outside: data sheets, endpoints."""
    motors = [
        motor.model_copy(update={"drive": motor.drive and motor.drive.model_copy(update={"eds": None})})
        for motor in joint.motor
    ]
    encoder = joint.link.encoder and joint.link.encoder.model_copy(update={"eds": None})
    link = joint.link.model_copy(update={"encoder": encoder})
    zenoh = ZenohSection(prefix=joint.zenoh.prefix)
    return joint.model_copy(update={"motor": tuple(motors), "link": link, "zenoh": zenoh})


def _carried(path: Path, topics: set[str]) -> Iterator[bytes]:
    """Yield the documents of these topics in an MCAP file, or what is beside a log."""
    if path.suffix.lower() == ".mcap":
        yield from (message.data for message in read_messages(path, frozenset(topics)))
    elif path.suffix.lower() in CAN_SUFFIXES:
        side = side_file(path)
        with raised_as(RecordingError, f"{side}: cannot be read"), suppress(FileNotFoundError):
            yield read_regular(side, MAX_BYTES)


_POSITIONS = (
    Signal.MOTOR_POSITION, Signal.LINK_POSITION, Signal.SECOND_POSITION, Signal.FOLLOWING_ERROR,
    Signal.POSITION_DEMAND,
)  # fmt: skip
_VELOCITIES = Signal.MOTOR_VELOCITY, Signal.LINK_VELOCITY, Signal.VELOCITY_CHECK
_UNITS = dict.fromkeys(_POSITIONS, "rad") | dict.fromkeys(_VELOCITIES, "rad/s") | {Signal.MOTOR_TORQUE: "Nm"}


def dbc_text(joint: str, layouts: Iterable[NodeLayout]) -> str:
    """Describe every TPDO of a joint's nodes, in SI at the joint side.

    Raises:
        UsageError: cantools is not installed.
    """
    try:
        from cantools.database import Database, Message
        from cantools.database.can import Node
    except ImportError as error:
        raise UsageError("needs cantools: pip install 'drivelink-vsa[dbc]'") from error
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
        conversion = BaseConversion.factory(scale=mapped.scale, offset=0.0 - mapped.offset)
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
