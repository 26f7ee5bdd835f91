"""Finds the joint of a recording, and the joint's last accepted model."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from drivelink import jointfile
from drivelink.canopen.eds import MAX_BYTES
from drivelink.errors import DrivelinkError, RecordingError, UsageError, raised_as
from drivelink.files import read_regular
from drivelink.fleet.storage import FleetError
from drivelink.jointfile import JointFile
from drivelink.recording.mapping import contained, joint_of


@dataclass(frozen=True, slots=True)
class Joint:
    """A joint file as it travels to the workers."""

    name: str  # of the joint
    text: str  # of the joint file
    where: str  # path of the file, for messages
    eds: tuple[tuple[str, bytes], ...] = ()  # the EDS and DCF files it refers to: (name, content) each
    carried: bool = False  # from a recording, whose joint file refers to nothing

    @property
    def file(self) -> JointFile:
        """The joint file, validated."""
        joint = _parsed(self.text, self.where)
        return contained(joint) if self.carried else joint

    @property
    def digest(self) -> str:
        """Names this version of the model."""
        return jointfile.fingerprint(self.text)

    @contextmanager
    def base_dir(self) -> Iterator[Path]:
        """Provide a folder with the files that the joint file refers to."""
        if not self.eds:
            yield Path(self.where).parent
            return
        with tempfile.TemporaryDirectory(prefix="drivelink-eds-") as folder:
            for name, content in self.eds:
                path = Path(folder) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            yield Path(folder)


@lru_cache(maxsize=256)
def _parsed(text: str, where: str) -> JointFile:
    return jointfile.parse(text, where)


@dataclass(frozen=True, slots=True)
class Joints:
    """The joints of a fleet, by name."""

    by_name: dict[str, Joint]

    @classmethod
    def load(cls, folder: Path) -> Joints:
        """Read a folder of joint files, subfolders included.

        Of several files for one joint the last accepted one counts, by the `[provenance]` of `fit --write`
        and `diagnose --write`.

        Raises:
            FleetError: no such folder, no joint file, or two of one joint without an order.
            JointFileError: a joint file is wrong.
        """
        paths = [folder] if folder.is_file() else sorted(folder.rglob("*.toml"))
        if not paths:
            raise FleetError(f"{folder}: expected joint files (*.toml) in this folder, found none")
        best: dict[str, tuple[str, Joint]] = {}
        for path in paths:
            given = jointfile.load_text(path)
            joint = given.joint
            written = _written(joint.provenance)
            one = Joint(joint.name, given.text, str(path), _eds(joint, path.parent))
            if joint.name in best and best[joint.name][0] == written:
                there = f"joint {joint.name} is in {best[joint.name][1].where} too"
                newer = "[provenance] of fit --write or diagnose --write that says which is newer"
                raise FleetError(f"{path}: {there}; expected one file, or {newer}")
            if joint.name not in best or written > best[joint.name][0]:
                best[joint.name] = (written, one)
        return cls({name: one for name, (_, one) in best.items()})

    def of(self, path: Path, url: str) -> Joint:
        """Return the joint of a recording.

        Raises:
            RecordingError: it carries no joint file, and its name contains none or several of the joints.
        """
        if (carried := carried_joint(path)) is not None:
            return self.by_name.get(carried.name, carried)
        return self.named(url)

    def named(self, url: str) -> Joint:
        """Return the joint whose name is in an address: in the file's name, else in that of a folder above.

        Raises:
            RecordingError: none, or several.
        """
        for part in reversed(re.split(r"[/\\]", unquote(url))):
            matches = [name for name in self.by_name if _stands_in(name, part)]
            longest = [a for a in matches if not any(a != b and _stands_in(a, b) for b in matches)]
            if len(longest) > 1:
                raise RecordingError(f"{url}: its name fits several joints: {', '.join(sorted(longest))}")
            if longest:
                return self.by_name[longest[0]]
        known = ", ".join(sorted(self.by_name)[:8]) + (", …" if len(self.by_name) > 8 else "")
        raise RecordingError(f"{url}: expected the name of a joint in the file's name or folder ({known})")


def carried_joint(path: Path) -> Joint | None:
    """Return the joint file that a recording carries, if any.

    Raises:
        RecordingError: the carried file cannot be read.
        JointFileError: the carried file is wrong.
    """
    try:
        carried = joint_of(path, None)
    except UsageError:
        return None
    return Joint(carried.joint.name, carried.text, str(carried.folder / "joint.toml"), carried=True)


def _stands_in(name: str, text: str) -> bool:
    """Return whether a text contains a name as whole words."""
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", text) is not None


def _written(provenance: dict[str, Any]) -> str:
    """Time at which fit or diagnose wrote the file, or ""."""
    stamps = [entry.get("written") for entry in provenance.values() if isinstance(entry, dict)]
    return max((str(stamp) for stamp in stamps if stamp), default="")


def _eds(joint: JointFile, base: Path) -> tuple[tuple[str, bytes], ...]:
    devices = (*(motor.drive for motor in joint.motor), joint.link.encoder)
    found = []
    for name in sorted({device.eds for device in devices if device and device.eds}):
        if Path(name).is_absolute() or ".." in Path(name).parts:
            continue  # only paths below the joint file can be recreated elsewhere
        with raised_as(DrivelinkError, f"{base / name}: cannot be read"):
            found.append((name, read_regular(base / name, MAX_BYTES)))
    return tuple(found)
