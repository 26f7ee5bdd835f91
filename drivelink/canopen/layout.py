"""The nodes of a joint: roles, which frame carries which signal at what scale, and the load on the bus.

`NodeLayout` is the only interface between configuration (active or passive) and acquisition. A standard frame
with n data bytes takes at most 47 + 8 n + ⌊(33 + 8 n) / 4⌋ bits, interframe space and worst-case stuffing
included: 55 for a SYNC, 135 for eight bytes.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, TypeAdapter

from drivelink.errors import BusError, JointFileError
from drivelink.jointfile import BusSection, DriveSection, EncoderSection, JointFile, TpdoSection
from drivelink.notice import Findings, Notice


@dataclass(frozen=True, slots=True, kw_only=True)
class Role:
    """One node of a joint."""

    node_id: int  # 1 to 127
    motor: int | None  # index of the motor it drives, or None
    drive: DriveSection | None  # its section of the joint file, or None
    encoder: EncoderSection | None  # the link encoder, if connected to this node
    key: str  # its key in the joint file, for messages
    eds: Path | None  # its EDS or DCF file, if the joint file names one
    tpdo: tuple[TpdoSection, ...]  # its mapping, if the joint file declares it

    @property
    def subject(self) -> str:
        """For notices and messages."""
        return f"node {self.node_id}"


def roles(joint: JointFile, base_dir: Path = Path()) -> tuple[Role, ...]:
    """Return the nodes of a joint, motors first.

    Args:
        base_dir: its folder; EDS paths are relative to it.

    Raises:
        JointFileError: a motor has no drive.
    """
    encoder, found = joint.link.encoder, list[Role]()
    encoder_node = None if encoder is None else encoder.node_id
    if encoder is not None and encoder_node is None and joint.motor[0].drive is not None:
        encoder_node = joint.motor[0].drive.node_id

    def add(node: int, motor: int | None, drive: DriveSection | None, key: str) -> None:
        mine = encoder if node == encoder_node else None
        eds = (drive and drive.eds) or (mine and mine.eds)
        found.append(
            Role(
                node_id=node,
                motor=motor,
                drive=drive,
                encoder=mine,
                key=key,
                eds=base_dir / eds if eds else None,
                tpdo=(drive.tpdo if drive else ()) + (mine.tpdo if mine else ()),
            )
        )

    for number, motor in enumerate(joint.motor):
        if motor.drive is None:
            expected = "expected this table, it is missing: no bus without it"
            raise JointFileError(f"{joint.name}: motor[{number + 1}].drive: {expected}")
        add(motor.drive.node_id, number, motor.drive, f"motor[{number + 1}].drive")
    if encoder_node is not None and all(role.encoder is None for role in found):
        add(encoder_node, None, None, "link.encoder")
    return tuple(found)


def roles_by_node(joints: Sequence[JointFile], base_dirs: Sequence[Path] | None) -> dict[int, Role]:
    """Return the nodes of all joints on one bus by node id, in the order of the joint files.

    Args:
        base_dirs: their folders; None: the current one.

    Raises:
        BusError: two joints claim one node.
    """
    found: dict[int, Role] = {}
    for joint, folder in zip(joints, base_dirs or [Path()] * len(joints), strict=True):
        for role in roles(joint, folder):
            if role.node_id in found:
                raise BusError(f"node {role.node_id} is claimed by two joints on one bus")
            found[role.node_id] = role
    return found


def object_address(text: str, key: str) -> tuple[int, int]:
    """Return the index and subindex of "0x60E4:01".

    Raises:
        JointFileError: the text has another form.
    """
    index, _, subindex = text.partition(":")
    with suppress(ValueError):
        address = int(index, 16), int(subindex or "0", 16)
        if 0x1000 <= address[0] <= 0xFFFF and 0 <= address[1] <= 0xFF:
            return address
    raise JointFileError(f'{key}: expected an object like "0x60E4:01", got "{text}"')


class Signal(StrEnum):
    """Meaning of a mapped object for the joint, the most important first.

    Position and torque are at the beginning: they must belong to the same instant.
    """

    MOTOR_POSITION = "motor_position"
    MOTOR_TORQUE = "motor_torque"
    STATUSWORD = "statusword"
    LINK_POSITION = "link_position"
    LINK_VELOCITY = "link_velocity"
    MOTOR_VELOCITY = "motor_velocity"
    TORQUE_CHECK = "torque_check"  # current beside torque, or torque beside current; for cross-checks only
    VELOCITY_CHECK = "velocity_check"  # the motor's; so are the following
    SECOND_POSITION = "second_position"  # the motor's, by another encoder
    FOLLOWING_ERROR = "following_error"
    POSITION_DEMAND = "position_demand"
    OTHER = "other"  # mapped by the drive, not used by us


def _nonzero(scale: float) -> float:
    if scale == 0.0:
        raise ValueError("expected a scale, got 0")
    return scale


# What the layout in a recording may hold: `layout_from` checks it.
_Motor = Annotated[int, Field(ge=0, le=1)]
_Byte = Annotated[int, Field(ge=0, le=0xFF)]
_Scale = Annotated[float, Field(allow_inf_nan=False), AfterValidator(_nonzero)]


@dataclass(frozen=True, slots=True, kw_only=True)
class MappedObject:
    """One object in a TPDO, or one that a node could send in one."""

    signal: Signal  # what it means
    index: int  # object index
    subindex: int  # object subindex
    bits: Annotated[int, Field(ge=0, le=64)]  # its length in the frame
    signed: bool  # whether two's complement
    # SI units at the joint side per count, direction and gear included (1 for the statusword)
    scale: _Scale = 1.0
    wraps: bool = False  # whether the counter rolls over at its length (absolute or incremental position)
    offset: float = 0.0  # SI units, subtracted after scaling (0 but for the link encoder's zero)
    # counts after which it rolls over, where that is less than its length allows (the measuring range of an
    # absolute encoder, 0x6002 of CiA 406); 0: at its length
    modulus: Annotated[int, Field(ge=0, le=1 << 64)] = 0

    @property
    def address(self) -> tuple[int, int]:
        """Index and subindex."""
        return self.index, self.subindex


@dataclass(frozen=True, slots=True, kw_only=True)
class TpdoLayout:
    """One TPDO: its identifier and the objects in it, in order from bit 0."""

    cob_id: Annotated[int, Field(ge=0, le=0x7FF)]  # identifier of the frame
    objects: tuple[MappedObject, ...]  # what is in it
    transmission_type: _Byte = 1  # 1 to 240: every so many SYNCs; 254, 255: event-driven
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
    motor: _Motor | None  # index of the motor that this drive belongs to; None: only an encoder
    tpdos: tuple[TpdoLayout, ...]  # its frames that carry signals of the joint
    other_tpdos: tuple[TpdoLayout, ...] = ()  # enabled frames of this node that are not used but load the bus
    heartbeat_ms: int = 0  # period of the heartbeat the node produces, as read back; 0: none, or not known
    # (vendor, product code, revision, serial number) of 0x1018; 0 where not reported
    identity: tuple[int, int, int, int] = (0, 0, 0, 0)
    # unit objects with their unsigned values, as read while it was configured, or as heard
    reported: tuple[tuple[tuple[int, int], int], ...] = field(default=(), compare=False)
    notices: tuple[Notice, ...] = ()  # findings of its configuration


def layout_document(layout: NodeLayout) -> dict[str, Any]:
    """Return a layout as plain values, for the model document; without unit objects and notices."""
    document = asdict(layout)
    del document["reported"], document["notices"]
    return document


_LAYOUT = TypeAdapter(NodeLayout)


def layout_from(document: Any) -> NodeLayout:
    """Return a layout from its plain values.

    Raises:
        ValueError: they are none.
    """
    return _LAYOUT.validate_python(document)


@dataclass(slots=True, kw_only=True)
class Offer(Findings):
    """What a node can give; disagreements and remarks on it."""

    # for each signal the objects that can give it, best first
    candidates: dict[Signal, tuple[MappedObject, ...]] = field(default_factory=dict)
    # the same for cross-checks: not mapped, but read if the node maps them
    checks: dict[Signal, tuple[MappedObject, ...]] = field(default_factory=dict)
    missing: dict[Signal, str] = field(default_factory=dict)  # for a signal with no candidate, why

    @property
    def readable(self) -> dict[Signal, tuple[MappedObject, ...]]:
        """All objects for decoding, candidates first."""
        rest = {signal: objects for signal, objects in self.checks.items() if signal not in self.candidates}
        return {**self.candidates, **rest}


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
    bits_per_s, frames_per_s = sum(rate * bits for rate, bits in frames), sum(rate for rate, _ in frames)
    return BusLoad(bits_per_s=bits_per_s, bitrate=bus.bitrate, frames_per_s=frames_per_s)


def check_capacity(load: BusLoad, period_s: float) -> None:
    """Check that the bus can carry the load.

    Raises:
        BusError: more bits per second than the bit rate.
    """
    if load.fraction > CAPACITY:
        raise BusError(
            f"bus load would be {100.0 * load.fraction:.0f} %: {load.frames_per_s:.0f} frames/s need up to "
            f"{load.bits_per_s / 1000:.0f} kbit/s of {load.bitrate / 1000:.0f} kbit/s; a period of "
            f"{period_s * load.fraction / COMFORTABLE * 1000:.2g} ms (bus.period_s) or fewer drives would fit"
        )
