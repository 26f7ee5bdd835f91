"""Raw CAN recordings as cycles: which mapping the frames have, where SYNC is, and the samples they make.

The frames go through the assembler that live frames go through. What they carry is known from the joint
file, or from the SDO configuration that is in the recording itself.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain, islice, pairwise
from pathlib import Path
from statistics import median

import numpy as np

from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.acquisition import SYNC_COB_ID, Assembler
from drivelink.cycle.chain import make_assembler
from drivelink.cycle.following import MapFollower
from drivelink.errors import DriveError, RecordingError
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import CAN_SUFFIXES, NO_STAMP, Frame, read_frames
from drivelink.recording.cycles import Cycle
from drivelink.recording.grid import report_gaps
from drivelink.recording.mapping import recorded_layouts
from drivelink.recording.mcapfile import read_messages
from drivelink.recording.syncnumbers import numbered_ahead, numbered_at_once
from estimator.sample import FloatArray, Record

__all__ = ["FrameLog", "is_frame_log", "read_frame_record"]

_LOG = logging.getLogger("drivelink.recording")

_SDO = range(0x581, 0x680)
_OF_MAPS = frozenset({0, *_SDO, *range(0x701, 0x780)})  # NMT, SDO, boot-up
_QUIET_SYNCS = 500  # without a change of the configuration: it is over
_PERIOD_TOLERANCE = 0.03
_PEEK = 20_000  # messages that tell whether an MCAP file has samples


def is_frame_log(path: Path, frames: bool | None = None) -> bool:
    """Whether a recording is to be read as raw frames.

    Args:
        path: the recording.
        frames: what the user asked for, of a file that may hold both; None: frames if there are no samples.
    """
    suffix = path.suffix.lower()
    if suffix in CAN_SUFFIXES:
        return True
    if suffix != ".mcap" or not path.exists():
        return False
    if frames is not None:
        return frames
    kinds = {
        message.topic.rsplit("/", 1)[-1]
        for message in islice(read_messages(path, frozenset({"sample", "can"})), _PEEK)
    }
    return kinds == {"can"}


class FrameLog:
    """A raw CAN recording of a joint.

    Args:
        path: the recording.
        joint: the joint.
        base_dir: folder of the joint file, where its EDS files are looked for.
        channel: of a recording with several.

    Attributes:
        period_s: the communication cycle, as the SYNCs in it tell.

    Raises:
        RecordingError: no SYNC or no frames in it, or the mapping of a node is not known or lacks something.
    """

    def __init__(self, path: Path, joint: JointFile, base_dir: Path, channel: str | None = None) -> None:
        self._path = path

        def frames() -> Iterator[Frame]:
            mcap = path.suffix.lower() == ".mcap"
            return _mcap_frames(path) if mcap else read_frames(path, channel, joint.bus.channel)

        self._frames = frames()
        self._follow = joint.bus.sync == "follow"
        self._passive = not joint.bus.configure
        self._listener = PassiveConfigurator([joint], [base_dir])
        self._head: list[Frame] = []  # after the configuration, read already
        syncs, overheard = self._learn_configuration()
        declared = not self._listener.busy
        if not overheard and (known := recorded_layouts(path, joint.name, daemon=declared)):
            self._listener = PassiveConfigurator([joint], [base_dir])
            self._listener.adopt(known)  # the recording began when the nodes were configured already
            self._head, self._frames = [], frames()
        self._check_complete()
        self.period_s = self._period(syncs, joint.bus.period_s)
        timed = joint.model_copy(update={"bus": joint.bus.model_copy(update={"period_s": self.period_s})})
        try:
            self._assembler = make_assembler(timed, tuple(self._listener.layouts.values()))
        except DriveError as error:
            raise RecordingError(f"{path}: {error}") from error

    def cycles(self) -> Iterator[Cycle]:
        """The cycles that the frames make; once."""
        assembler = self._assembler
        follower = self._follower() if self._passive else None
        numbered = numbered_at_once if self._follow else numbered_ahead
        stamp_now = stamp_before = 0
        for (stamp_ns, can_id, data, _), jump in numbered(chain(self._head, self._frames), self.period_s):
            was = assembler.sequence
            sample = assembler.feed(can_id, data, jump)
            if can_id == SYNC_COB_ID and jump:
                stamp_before, stamp_now = stamp_now, stamp_ns
            if follower is not None and (can_id in _OF_MAPS or can_id == SYNC_COB_ID):
                follower.feed(can_id, data)
            elif can_id in _SDO:
                self._relayout(can_id, data, assembler)
            if sample is not None:
                stamp_ns = stamp_before if assembler.sequence != was else stamp_now
                yield Cycle(sample.sequence, stamp_ns, sample, assembler.flags)
            elif assembler.missed >= 0:
                missed, assembler.missed = assembler.missed, -1
                yield Cycle(missed, stamp_before, None, assembler.flags)

    def _follower(self) -> MapFollower:
        """Somebody else maps the nodes: the maps are followed as the daemon follows them."""
        layouts = self._listener.layouts
        return MapFollower(self._listener, dict.fromkeys(layouts, self._assembler), layouts)

    def _learn_configuration(self) -> tuple[list[int], bool]:
        """Listen to the SDO transfers until the mapping is known and at rest.

        Where somebody else maps the nodes it is enough that it is known: it may change at any time, and what
        follows is heard in its turn.

        Returns:
            Stamps of the SYNCs till then, and whether a node's mapping was overheard.
        """
        listener, head = self._listener, self._head
        syncs: list[int] = []
        quiet, overheard = 0, False
        for frame in self._frames:
            stamp_ns, can_id, data, _ = frame
            if not listener.busy:
                head.append(frame)
            if can_id == SYNC_COB_ID:
                syncs.append(stamp_ns)
                quiet += 1
                if quiet > _QUIET_SYNCS and not listener.busy:
                    break
            elif can_id in (_OF_MAPS if self._passive else _SDO) and (listener.busy or not self._passive):
                listener.feed(can_id, data, 0.0)
                if listener.poll(0.0):
                    head.clear()
                    quiet, overheard = 0, True
        return syncs[-2 * _QUIET_SYNCS :], overheard and not listener.busy

    def _check_complete(self) -> None:
        """Raise where the mapping of a node is not known."""
        if self._listener.busy:
            reason = next(iter(self._listener.missing.values()))
            raise RecordingError(f"{self._path}: {reason} (nor is it configured by SDO in the recording)")

    def _period(self, syncs: list[int], configured_s: float) -> float:
        """The period that the recorded SYNCs have: the configured one, where they agree."""
        if len(syncs) < 3:
            raise RecordingError(
                f"{self._path}: expected SYNC frames (0x080) to tell the time of a sample, got {len(syncs)}"
            )
        if syncs[0] == NO_STAMP:
            return configured_s
        steps_s = sorted((b - a) * 1e-9 for a, b in pairwise(syncs))
        measured_s = median(steps_s)
        # A master that is often late leaves SYNCs out: then the shorter steps tell.
        short_s = steps_s[len(steps_s) // 10]
        if measured_s <= 0 or any(
            abs(s / configured_s - 1) <= _PERIOD_TOLERANCE for s in (measured_s, short_s)
        ):
            return configured_s
        rounded = float(f"{measured_s:.2g}")
        period_s = rounded if abs(rounded / measured_s - 1) <= _PERIOD_TOLERANCE else measured_s
        _LOG.warning(
            "%s: SYNC comes every %.4g s, not every %.4g s as bus.period_s says: taken as it comes",
            self._path,
            period_s,
            configured_s,
        )
        return period_s

    def _relayout(self, can_id: int, data: bytes, assembler: Assembler) -> None:
        """A node is given another mapping in the middle of the recording."""
        self._listener.feed(can_id, data, 0.0)
        for _, layout in self._listener.poll(0.0):
            if isinstance(layout, NodeLayout):
                with suppress(DriveError):  # what cannot be the daemon has not taken either
                    assembler.relayout(layout)


def read_frame_record(path: Path, joint: JointFile | None, base_dir: Path, channel: str | None) -> Record:
    """Read the samples of a raw CAN recording.

    Raises:
        RecordingError: no joint file, or the frames make no samples.
    """
    if joint is None:
        raise RecordingError(f"{path}: a raw CAN recording needs the joint file that says what is in it")
    log = FrameLog(path, joint, base_dir, channel)
    samples = [cycle.sample for cycle in log.cycles() if cycle.sample is not None]
    if len(samples) < 3:
        raise RecordingError(f"{path}: expected at least 3 complete samples, got {len(samples)}")
    sequence = np.array([sample.sequence for sample in samples], dtype=np.int64)
    report_gaps(sequence, log.period_s, str(path))

    def optional(values: list[float]) -> FloatArray | None:
        column = np.array(values, dtype=np.float64)
        return column if np.any(np.isfinite(column)) else None

    velocity = np.array([sample.motor_velocity_rad_s for sample in samples], dtype=np.float64)
    return Record(
        period_s=log.period_s,
        sequence=sequence,
        motor_position_rad=np.array([sample.motor_position_rad for sample in samples], dtype=np.float64),
        motor_torque_nm=np.array([sample.motor_torque_nm for sample in samples], dtype=np.float64),
        motor_velocity_rad_s=velocity if np.any(np.isfinite(velocity)) else None,
        link_position_rad=optional([sample.link_position_rad for sample in samples]),
        link_velocity_rad_s=optional([sample.link_velocity_rad_s for sample in samples]),
    )


def _mcap_frames(path: Path) -> Iterator[Frame]:
    for message in read_messages(path, frozenset({"can"})):
        try:
            fields = json.loads(message.data)
            can_id, data = int(fields["id"]), bytes.fromhex(fields["data"])
            if not 0 <= can_id <= 0x7FF or len(data) > 64:
                raise ValueError("expected an 11-bit identifier and at most 64 bytes")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            reason = f"{message.topic[:80]} is no frame of drivelink: {error}"
            raise RecordingError(f"{path}: {reason}") from error
        yield Frame(message.log_time_ns, can_id, data, "")
