"""The finding: what was found in a kept recording, as one JSON document beside it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivelink.errors import DrivelinkError, RecordingError
from drivelink.files import read_regular, write_whole
from drivelink.loop.folder import event_of, finding_file, kept
from drivelink.pubsub.feed import MAX_BYTES, decode_document

SCHEMA = "drivelink.finding/1"
DIAGNOSING = "diagnosing"
PROPOSED = "proposed"  # a joint file lies beside it, and a person may accept it
NOTHING = "nothing"  # to accept: the model is sufficient, or the motion too poor
FAILED = "failed"
ACCEPTED = "accepted"
UNDONE = "undone"


def fingerprint(text: str) -> str:
    """Return what says of two joint files whether they are the same."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def begun(recording: Path, state: str, sentence: str) -> dict[str, Any]:
    """Return what every finding says; all of it, where the diagnosis is under way or failed."""
    joint, time, cause = event_of(recording)
    about = {"schema": SCHEMA, "joint": joint, "recording": recording.name, "cause": cause}
    return about | {"time": time.isoformat(), "state": state, "sentence": sentence}


def write(recording: Path, finding: Mapping[str, Any]) -> None:
    """Put a finding beside its recording.

    Raises:
        RecordingError: it cannot be written.
    """
    path = finding_file(recording)
    try:
        write_whole(path, json.dumps(finding, indent=1, allow_nan=False) + "\n", force=True)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from error


def read(recording: Path) -> dict[str, Any] | None:
    """Return the finding beside a recording, with safe values; None: there is none, or it cannot be read."""
    try:
        found = decode_document(read_regular(finding_file(recording), MAX_BYTES))
    except (OSError, DrivelinkError):
        return None
    return found if found.get("schema") == SCHEMA else None


def newest(folder: Path, joint: str) -> tuple[Path, dict[str, Any]] | None:
    """Return the newest recording of a joint with a finding, and that; None: there is none."""
    try:
        recordings = kept(folder, joint)
    except OSError:
        return None
    for recording in reversed(recordings):
        found = read(recording)
        if found is not None:
            return recording, found
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
