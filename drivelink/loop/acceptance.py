"""Accepts what a finding proposes: the difference, the new joint file, the old one kept, and the way back.

Nothing here is done by itself: a person asks for it, by `drivelink accept` or in the web view.
"""

import difflib
import math
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from drivelink.errors import JointFileError, RecordingError, UsageError
from drivelink.files import read_regular, write_whole
from drivelink.jointfile import (
    MAX_BYTES,
    JointFile,
    JointText,
    fingerprint,
    load,
    load_text,
    without_check,
    write_model,
)
from drivelink.loop import finding
from drivelink.loop.finding import folder_of, proposal_file
from drivelink.plaintext import clean_text

PATIENCE_S = 60.0  # for the residual to fall
_QUIET_SECONDS = 5  # of residual within its limit
_STAMP = "%Y%m%dT%H%M%SZ"


class Proposal(NamedTuple):
    """What may be accepted."""

    source: JointText  # the joint file in use
    recording: Path  # the diagnosed one
    finding: dict[str, Any]  # of it
    proposed: JointText  # the joint file with the finding

    def difference(self) -> str:
        """Return what changes in the joint file as a unified diff; baseline and origin follow."""
        before, after = (_model_lines(text.text) for text in (self.source, self.proposed))
        name = Path(self.source.name).name
        return "\n".join(difflib.unified_diff(before, after, name, f"{name}, proposed", lineterm="", n=1))

    def lines(self) -> list[str]:
        """Return what a person sees before accepting, line by line."""
        found, error = self.finding, self.finding.get("error") or {}
        lines = [str(found["sentence"]), f"from {self.recording.name}"]
        lines += [f"  {text}" for text in found.get("parameters") or ()]
        if all(isinstance(error.get(key), float) for key in ("before_rms_nm", "after_rms_nm")):
            fall = f"{error['before_rms_nm']:.4g} N·m before, {error['after_rms_nm']:.4g} N·m after"
            lines.append(f"error of the torque on held-out data: {fall}")
        lines += [f"  {text}" for text in (found.get("report") or {}).get("advice") or ()]
        return [clean_text(line) for line in [*lines, *self.difference().split("\n")]]


def proposal(path: Path) -> Proposal:
    """Return the newest finding of a joint whose diagnosis is over, if a joint file is proposed by it.

    Raises:
        JointFileError: the joint file, or the proposed one, is wrong.
        RecordingError: nothing is proposed, or for another joint file than this one is now.
    """
    source = load_text(path)
    folder, joint = folder_of(source), source.joint.name
    newest = finding.newest(folder, joint, finished=True) or finding.newest(folder, joint)
    if newest is None:
        raise RecordingError(
            f"{folder}: no finding about {joint} yet: the next alarm or `drivelink keep` makes one"
        )
    recording, found = newest
    if found["state"] != finding.PROPOSED:
        state = found["state"]
        said = f"nothing to accept{'' if state == finding.NOTHING else f', {state}'}: {found['sentence']}"
        if state == finding.ACCEPTED:
            said = f"accepted already; drivelink accept {path} --undo puts the old joint file back"
        raise RecordingError(f"{recording.name}: {said}")
    if found.get("joint_file") != fingerprint(source.text):
        raise RecordingError(
            f"{path}: has changed since {recording.name} was kept: expected the same joint file; "
            f"drivelink keep {path} makes a finding about this one"
        )
    return Proposal(source, recording, found, load_text(proposal_file(recording)))


def accept(offer: Proposal) -> Path:
    """Replace the joint file in use by the proposed one.

    Returns:
        Where the old one is kept.

    Raises:
        JointFileError: it cannot be written, or has changed meanwhile; the old one is in place.
    """
    path, now = _place(offer.source), datetime.now(UTC)
    old = _keep(offer.source, f"{now:{_STAMP}}")
    about = {"before": old.name, "recording": offer.recording.name}
    accepted = {"time": now.isoformat(timespec="seconds")} | about
    write_model(offer.proposed, path, {"provenance": {"accepted": accepted}}, force=True)
    with suppress(RecordingError):  # of a full disk: the joint file says it, too
        finding.write(offer.recording, {**offer.finding, "state": finding.ACCEPTED, "accepted": accepted})
    return old


def undo(path: Path) -> Path:
    """Restore the joint file that was in use before the last acceptance; the accepted one is kept, too.

    Returns:
        Where it was kept.

    Raises:
        JointFileError: one of both files is wrong, or the place cannot be written.
        UsageError: nothing was accepted.
    """
    source = load_text(path)
    accepted = source.joint.provenance.get("accepted")
    if not isinstance(accepted, dict) or not isinstance(accepted.get("before"), str):
        raise UsageError(f"{path}: --undo: nothing was accepted into this joint file")
    old = load_text(path.with_name(Path(accepted["before"]).name))
    _keep(source, f"{datetime.now(UTC):{_STAMP}}-undone")
    _copy(_place(old), _place(source), force=True)
    recording = folder_of(old) / Path(str(accepted.get("recording"))).name
    if (found := finding.read(recording)) is not None:
        with suppress(RecordingError):
            finding.write(recording, {**found, "state": finding.UNDONE})
    return Path(old.name)


def _model_lines(text: str) -> list[str]:
    """Return a joint file without [provenance], where that is all that follows it."""
    lines = without_check(text).splitlines()
    begins = [k for k, line in enumerate(lines) if line.startswith("[")]
    others = [k for k in begins if not lines[k].lstrip("[").startswith("provenance")]
    last = next((k for k in begins if k > others[-1]), len(lines)) if others else 0
    return lines[:last]


def _place(source: JointText) -> Path:
    if source.path is None:
        raise JointFileError(f"{source.name}: expected a file")
    return source.path


def _keep(source: JointText, mark: str) -> Path:
    """Copy a joint file to a name with that mark, if it is still the one that was read."""
    path = _place(source)
    if load_text(path).text != source.text:
        raise JointFileError(f"{path}: has changed meanwhile: nothing is written")
    old = path.with_name(f"{path.stem}-{mark}{path.suffix}")
    _copy(path, old, force=False)
    return old


def _copy(path: Path, target: Path, *, force: bool) -> None:
    try:
        write_whole(target, read_regular(path, MAX_BYTES), force=force)
    except OSError as error:
        raise JointFileError(f"{error.filename}: cannot be copied: {error.strerror}") from error


def accepted_at(joint: JointFile | Mapping[str, Any]) -> str:
    """Return the time at which a joint file or model document was accepted; empty: it was not."""
    provenance = joint.provenance if isinstance(joint, JointFile) else joint.get("provenance")
    accepted = provenance.get("accepted") if isinstance(provenance, Mapping) else None
    return str(accepted.get("time")) if isinstance(accepted, Mapping) else ""


class Trial:
    """Whether the residual falls to its baseline once the daemon has the joint file that was written.

    Args:
        undone: it is the old one again: whether the daemon has it is all there is to see.
    """

    def __init__(self, path: Path, now_s: float, *, undone: bool = False) -> None:
        self.in_use = False  # the daemon has the joint file
        # residual over baseline of each balance in the newest second, or empty
        self.ratios: tuple[float, ...] = ()
        self.fallen: bool | None = None  # True: it has; False: not within a minute; None: not decided yet
        self._accepted, self._end_s = accepted_at(load(path)), now_s + PATIENCE_S
        self._undone = undone
        self._quiet = self._moved = 0
        self._last: object = None

    @property
    def over(self) -> bool:
        """Whether nothing more is to come."""
        return self.fallen is not None or (self._undone and self.in_use)

    def update(self, status: Mapping[str, Any], model: Mapping[str, Any], now_s: float) -> bool | None:
        """Process what the daemon says now; return `fallen`."""
        if self.over:
            return self.fallen
        if not self.in_use and model and accepted_at(model) == self._accepted:
            self.in_use = True
            self._last = _residuals(status)  # of the model before
        if self.over:
            return self.fallen
        if self.in_use:
            self._judge(status)
        if self._quiet >= _QUIET_SECONDS or now_s >= self._end_s:
            self.fallen = self._quiet >= _QUIET_SECONDS
        return self.fallen

    def _judge(self, status: Mapping[str, Any]) -> None:
        """Count seconds of motion without a break whose residual the model's own test allows."""
        residuals = _residuals(status)
        if residuals is None or residuals == self._last:
            return
        self._last = residuals
        alarm, quality = status["residual_alarm"], status.get("quality")
        self.ratios = tuple(r / b for r, b in zip(residuals, alarm["floor_nm"], strict=False))
        if isinstance(quality, Mapping) and not (quality.get("observable") or quality.get("model_alarm")):
            return  # standing still: its residual says nothing
        self._moved += 1
        within = not alarm.get("active") and alarm.get("ratio", math.inf) <= alarm.get("limit", 0.0)
        self._quiet = self._quiet + 1 if within else 0

    def sentence(self) -> str:
        """Return what has come of it so far."""
        level = f"{max(self.ratios):.2g} × its baseline" if self.ratios else "not measured yet"
        if self.fallen:
            return (
                f"the residual has fallen: for {_QUIET_SECONDS} s of motion the new model's own test has "
                f"allowed it, {level} in the last one"
            )
        if not self.in_use:
            if self.fallen is None:
                return "waiting for the daemon to take the joint file"
            return "no daemon has taken the joint file within a minute: it is in use from its next start on"
        if self._undone:
            return "the daemon has the old joint file in use again"
        if self.fallen is None:
            return f"the residual is {level}"
        if not self._moved:
            return "the joint has not moved enough within a minute to tell whether the residual has fallen"
        return f"the residual has not fallen within a minute: it is {level}"


def _residuals(status: Mapping[str, Any]) -> list[float] | None:
    """Residual of each balance, if both it and its baseline are known."""
    alarm = status.get("residual_alarm")
    if not isinstance(alarm, Mapping):
        return None
    found = [alarm.get("residual_nm"), alarm.get("floor_nm")]
    for values in found:
        if not isinstance(values, list) or not all(isinstance(v, float | int) and v > 0.0 for v in values):
            return None
    return found[0]
