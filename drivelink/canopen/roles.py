"""The nodes of a joint and their roles: drives and link encoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivelink.errors import BusError, JointFileError
from drivelink.jointfile import DriveSection, EncoderSection, JointFile, TpdoSection


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
    encoder = joint.link.encoder
    encoder_node = _encoder_node(joint)
    found: list[Role] = []
    for number, motor in enumerate(joint.motor):
        drive = motor.drive
        if drive is None:
            raise JointFileError(
                f"{joint.name}: motor[{number + 1}].drive: expected this table, it is missing: "
                "no bus without it"
            )
        mine = encoder if encoder is not None and encoder_node == drive.node_id else None
        eds = drive.eds or (mine.eds if mine else None)
        found.append(
            Role(
                node_id=drive.node_id,
                motor=number,
                drive=drive,
                encoder=mine,
                key=f"motor[{number + 1}].drive",
                eds=base_dir / eds if eds else None,
                tpdo=drive.tpdo + (mine.tpdo if mine else ()),
            )
        )
    if encoder is not None and encoder_node is not None and all(role.encoder is None for role in found):
        found.append(
            Role(
                node_id=encoder_node,
                motor=None,
                drive=None,
                encoder=encoder,
                key="link.encoder",
                eds=base_dir / encoder.eds if encoder.eds else None,
                tpdo=encoder.tpdo,
            )
        )
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


def _encoder_node(joint: JointFile) -> int | None:
    encoder = joint.link.encoder
    if encoder is None:
        return None
    if encoder.node_id is not None:
        return encoder.node_id
    first = joint.motor[0].drive
    return first.node_id if first else None


def object_address(text: str, key: str) -> tuple[int, int]:
    """Return the index and subindex of "0x60E4:01".

    Raises:
        JointFileError: the text has another form.
    """
    index, _, subindex = text.partition(":")
    try:
        address = int(index, 16), int(subindex or "0", 16)
    except ValueError:
        address = (0, 0)
    if not (0x1000 <= address[0] <= 0xFFFF and 0 <= address[1] <= 0xFF):
        raise JointFileError(f'{key}: expected an object like "0x60E4:01", got "{text}"')
    return address
