"""A black box's folder: recordings, beside each its finding (a JSON document) and the proposed joint file."""

import json
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from drivelink.errors import DrivelinkError, JointFileError, RecordingError, raised_as
from drivelink.files import read_regular, write_whole
from drivelink.jointfile import JointText
from drivelink.pubsub.feed import MAX_BYTES, decode_document

_STAMP = "%Y%m%dT%H%M%SZ"
_NAME = re.compile(r"-(\d{8}T\d{6}Z)-([a-z-]+)\.(mcap|part)")
DOUBTS = ("asked", "model alarm", "suspected signal", "change")  # causes that a model may explain
UNFINISHED = ".part"  # ending of a recording that is being written


def recording_name(joint: str, cause: str, wall: datetime) -> str:
    """Return the name of a recording, e.g. `elbow-20260105T081500Z-model-alarm.mcap`."""
    return f"{joint}-{wall:{_STAMP}}-{cause.replace(' ', '-')}.mcap"


def kept(folder: Path, joint: str, ending: str = ".mcap") -> list[Path]:
    """Return the recordings of a joint's black box, oldest first.

    Args:
        ending: of finished ones, or `UNFINISHED`.

    Raises:
        OSError: the folder cannot be read.
    """
    found = (path for path in folder.iterdir() if path.suffix == ending and path.name.startswith(joint))
    own = (path for path in found if _time_of(_NAME.fullmatch(path.name, len(joint))) is not None)
    return sorted(path for path in own if path.is_file())


def _time_of(match: re.Match[str] | None) -> datetime | None:
    """Return the time in a name; None: it is no time, or none of ours."""
    try:
        return None if match is None else datetime.strptime(match[1], _STAMP).replace(tzinfo=UTC)
    except ValueError:
        return None


class Event(NamedTuple):
    """What led to a recording: of which joint, when, and the cause."""

    joint: str
    time: datetime
    cause: str


def event_of(recording: Path) -> Event:
    """Return the event of a recording, by its name.

    Raises:
        RecordingError: it is no recording of a black box.
    """
    match = _NAME.search(recording.name)
    time = _time_of(match)
    if match is None or time is None:
        raise RecordingError(f"{recording}: expected a recording of a black box, JOINT-TIME-CAUSE.mcap")
    return Event(recording.name[: match.start()], time, match[2].replace("-", " "))


def finding_file(recording: Path) -> Path:
    """Return where the finding of a recording lies."""
    return recording.with_suffix(".finding.json")


def page_file(recording: Path) -> Path:
    """Return where the page of a recording's diagnosis lies."""
    return recording.with_suffix(".html")


def proposal_file(recording: Path) -> Path:
    """Return where the joint file lies that the finding proposes."""
    return recording.with_suffix(".toml")


def folder_of(text: JointText) -> Path:
    """Return the folder of a joint's black box.

    Raises:
        JointFileError: the joint file declares none.
    """
    folder = text.joint.recording.folder
    if folder is None:
        raise JointFileError(f"{text.name}: recording.folder: expected the folder of the black box, got none")
    return text.folder / folder


def wish_of(text: JointText) -> Path:
    """Return the file that asks the black box of a joint to keep the last minute; it renames it to `taken`.

    Raises:
        JointFileError: the joint file declares no folder.
    """
    return folder_of(text) / f"{text.joint.name}.keep"


def taken(wish: Path) -> Path:
    """Return the file of the last wish that was taken, into which the box writes what became of it.

    That is the recording's name, or why there is none. Blanks fill it before: even a full disk has that room.
    """
    return wish.with_suffix(".keeping")


def drop_oldest(folder: Path, joint: str, keep_mib: float) -> None:
    """Remove the oldest recordings of a joint's black box, and what lies beside them, beyond its budget.

    The newest always stays.
    """
    recordings = kept(folder, joint)
    sizes = [path.stat().st_size for path in recordings]
    for index, path in enumerate(recordings[:-1]):
        if sum(sizes[index:]) <= keep_mib * 2**20:
            break
        for part in (path, finding_file(path), proposal_file(path), page_file(path)):
            part.unlink(missing_ok=True)


SCHEMA = "drivelink.finding/1"
DIAGNOSING = "diagnosing"
PROPOSED = "proposed"  # a joint file lies beside it, and a person may accept it
NOTHING = "nothing"  # to accept: the model is sufficient, or the motion too poor
FAILED = "failed"
ACCEPTED = "accepted"
UNDONE = "undone"


def begun(recording: Path, state: str, sentence: str) -> dict[str, Any]:
    """Return what every finding says; all of it, where the diagnosis is under way or failed."""
    joint, time, cause = event_of(recording)
    about = {"schema": SCHEMA, "joint": joint, "recording": recording.name, "cause": cause}
    return about | {"time": time.isoformat(), "state": state, "sentence": sentence}


def write(recording: Path, finding: Mapping[str, Any]) -> None:
    """Write a finding beside its recording.

    Raises:
        RecordingError: it cannot be written.
    """
    put(finding_file(recording), json.dumps(finding, indent=1, allow_nan=False) + "\n")


def put(path: Path, text: str) -> None:
    """Write a text that lies beside a recording.

    Raises:
        RecordingError: it cannot be written.
    """
    with raised_as(RecordingError, f"{path}: cannot be written"):
        write_whole(path, text, force=True)


def read(recording: Path) -> dict[str, Any] | None:
    """Return the finding beside a recording, with safe values; None: there is none, or it cannot be read."""
    try:
        found = decode_document(read_regular(finding_file(recording), MAX_BYTES))
    except (OSError, DrivelinkError):
        return None
    kinds = {"state": str, "sentence": str, "error": dict, "report": dict, "parameters": list}
    whole = all(isinstance(found.get(name) or kind(), kind) for name, kind in kinds.items())
    advice = found["report"].get("advice") if whole and found.get("report") else None
    said = found.get("state") and found.get("sentence") and isinstance(advice or [], list)
    return found if found.get("schema") == SCHEMA and whole and said else None


def open_own(path: str, flags: int) -> int:
    """Open a file of the folder for writing, as `opener`: no link that somebody has put there, no pipe.

    Raises:
        OSError: it is one of them, or cannot be opened.
    """
    return os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)


def newest(folder: Path, joint: str, *, finished: bool = False) -> tuple[Path, dict[str, Any]] | None:
    """Return the newest recording of a joint with a finding, and that; None: there is none.

    Args:
        finished: only of those whose diagnosis is over.
    """
    try:
        recordings = kept(folder, joint)
    except OSError:
        return None
    for recording in reversed(recordings):
        found = read(recording)
        if found is not None and not (finished and found["state"] == DIAGNOSING):
            return recording, found
    return None


def foremost(folder: Path, joint: str) -> dict[str, Any]:
    """Return the finding that a view shows; empty without one.

    A proposal stands until the next diagnosis is over: what a person may accept does not vanish meanwhile.
    """
    over = newest(folder, joint, finished=True)
    shown = over if over is not None and over[1]["state"] == PROPOSED else newest(folder, joint)
    return {} if shown is None else shown[1]


def event_s(finding: Mapping[str, Any]) -> float | None:
    """Return the UNIX time of a finding's event, s; None: it says none."""
    try:
        return datetime.fromisoformat(str(finding.get("time"))).timestamp()
    except (ValueError, OverflowError, OSError):
        return None


def line(finding: Mapping[str, Any]) -> str:
    """Return a finding in one short line for a view; empty without one."""
    state, sentence = finding.get("state"), finding.get("sentence")
    if not isinstance(sentence, str) or not isinstance(state, str):
        return ""
    summary = finding.get("summary")
    text = summary if isinstance(summary, str) else sentence
    if state == PROPOSED:
        return f"{text}: drivelink accept shows the joint file that has it"
    return text if state in (DIAGNOSING, NOTHING, FAILED) else f"{text}: {state}"
