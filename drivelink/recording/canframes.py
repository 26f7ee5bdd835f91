"""Converts raw CAN recordings to cycles: mapping, SYNC, samples.

The frames go through the assembler of live frames. Their mapping is known from the joint file or the SDO
configuration in the recording.
"""

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

from drivelink._core import SYNC_COB_ID, json_frame
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.syncclock import measure_period
from drivelink.errors import DriveError, RecordingError, raised_as
from drivelink.jointfile import JointFile
from drivelink.recording.canlog import CAN_SUFFIXES, NO_STAMP, LoggedFrame, in_order, logged, read_frames
from drivelink.recording.columns import record_of_samples
from drivelink.recording.cycles import (
    OF_MAPS,
    OF_SDO,
    Assembly,
    Cycle,
    numbered_ahead,
    numbered_at_once,
    seconds,
)
from drivelink.recording.grid import report_gaps
from drivelink.recording.limits import most_records
from drivelink.recording.mapping import recorded_layouts, side_file
from drivelink.recording.mcapfile import read_messages
from estimator.errors import EstimatorError
from estimator.ranges import require_in_range
from estimator.sample import Record

_LOG = logging.getLogger("drivelink.recording")

_QUIET_SYNCS = 500  # without a change, the configuration has ended
_MOST_HELD = 1 << 18  # frames among them: more than a bus of 127 nodes sends
_WITHOUT_SYNC = 100_000  # frames: half a minute of a bus whose master does not run
_FEW_MAPPINGS = 2500  # changes of what a node sends that any file may have: to configure one makes dozens
_RECORDS_OF_A_MAPPING = 128  # of the file, for each further one: it costs as much as so many of them
_PEEK = 20_000  # messages that show whether an MCAP file has samples


def is_frame_log(path: Path, frames: bool | None = None) -> bool:
    """Return whether to read a recording as raw frames.

    Args:
        frames: the user's choice for a file with both; None: frames if there are no samples.
    """
    suffix = path.suffix.lower()
    if suffix in CAN_SUFFIXES:
        return True
    if suffix != ".mcap" or not path.exists():
        return False
    if frames is not None:
        return frames
    messages = islice(read_messages(path, frozenset({"sample", "can"})), _PEEK)
    return {message.topic.rsplit("/", 1)[-1] for message in messages} == {"can"}


class FrameLog:
    """A raw CAN recording of a joint.

    Args:
        base_dir: folder of the joint file, base of its EDS files.

    Raises:
        RecordingError: no SYNC or no frames, or the mapping of a node is unknown or incomplete.
    """

    def __init__(self, path: Path, joint: JointFile, base_dir: Path, channel: str | None = None) -> None:
        self._path = path
        size = path.stat().st_size if path.is_file() else 0
        self._most_judged = _FEW_MAPPINGS + most_records(size) // _RECORDS_OF_A_MAPPING

        def frames() -> Iterator[LoggedFrame]:
            if path.suffix.lower() == ".mcap":
                return in_order(_mcap_frames(path), path)
            return read_frames(path, channel, joint.bus.channel)

        self._frames = frames()
        self._follow = joint.bus.sync == "follow"
        self._passive = not joint.bus.configure
        self._judged = 0  # changes of what its nodes send
        self._listener = PassiveConfigurator([joint], [base_dir], self._count_mapping)
        self._head: list[LoggedFrame] = []  # after the configuration, read already
        syncs, heard, before = self._learn_configuration()
        declared = not self._listener.busy
        known: Sequence[NodeLayout] = ()
        if before or not heard:
            known = recorded_layouts(path, joint.name, daemon=declared, begun=heard)
        if known:
            self._listener = PassiveConfigurator([joint], [base_dir], self._count_mapping)
            self._listener.adopt(known)  # the nodes were configured before the recording began
            self._head, self._frames = [], frames()
        self._check_complete()
        self.period_s = self._period(syncs, joint.bus.period_s)  # the communication cycle, from its SYNCs
        with raised_as(RecordingError, str(path), DriveError):
            self._assembly = Assembly(joint.timed(self.period_s), self._listener)

    def cycles(self) -> Iterator[Cycle]:
        """Yield the cycles of the frames; to be iterated once.

        Raises:
            RecordingError: the recording is damaged, or contains no sample.
        """
        assembly, heard, samples = self._assembly, set[int](), False
        numbered = numbered_at_once if self._follow else numbered_ahead
        for frames, jump in numbered(chain(self._head, self._frames), self.period_s):
            if not samples:
                heard.update(frame[1] for frame in frames)
            for cycle in assembly.cycles(frames, jump):
                samples = samples or cycle.sample is not None
                yield cycle
        doubts = list(assembly.follower.doubts.values())
        if not samples:
            why = f": {doubts[0]}" if doubts else self._absent(heard)
            raise RecordingError(f"{self._path}: no complete sample in it{why}")
        for doubt in doubts:
            _LOG.warning("%s: at its end, %s", self._path, doubt)

    def _count_mapping(self) -> None:
        self._judged += 1
        if self._judged > self._most_judged:
            raise RecordingError(
                f"{self._path}: expected at most {self._most_judged} changes of what its nodes send, got more"
            )

    def _absent(self, heard: set[int]) -> str:
        """Frames of the mapping that are missing."""
        absent = ", ".join(
            f"0x{tpdo.cob_id:03X} of node {layout.node_id}"
            for layout in self._listener.layouts.values()
            for tpdo in layout.tpdos
            if tpdo.cob_id not in heard
        )
        why = "(another node id, channel or mapping?)"
        return f": expected frames {absent}, got none {why}" if absent else ""

    def _learn_configuration(self) -> tuple[list[int], bool, bool]:
        """Read the SDO transfers until the mapping is known and unchanged for a while.

        With another master it is enough that it is known: later changes are followed.

        Returns:
            Stamps of the SYNCs until then, whether the traffic contained a node's mapping, and whether there
            were SYNCs before: then it is that of a node that has restarted.
        """
        listener, head = self._listener, self._head
        syncs: deque[int] = deque(maxlen=2 * _QUIET_SYNCS)
        quiet, heard, before, without = 0, False, False, 0
        for frame in self._frames:
            stamp_ns, can_id, data, _ = frame
            without += 1
            if without > _WITHOUT_SYNC and not (syncs and listener.busy):
                break
            if not listener.busy:
                head.append(frame)
                if len(head) > _MOST_HELD:
                    break
            if can_id == SYNC_COB_ID:
                syncs.append(stamp_ns)
                without = 0
                quiet += 1
                if quiet > _QUIET_SYNCS and not listener.busy:
                    break
            elif can_id in (OF_MAPS if self._passive else OF_SDO) and (listener.busy or not self._passive):
                now_s = seconds(stamp_ns, len(syncs), listener.bus.period_s)
                if not listener.feed(can_id, data, now_s):
                    continue
                if listener.poll(now_s):
                    head.clear()
                    quiet, heard, before = 0, True, before or (not heard and bool(syncs))
        return list(syncs), heard and not listener.busy, before

    def _check_complete(self) -> None:
        """Raise if the mapping of a node is unknown."""
        if self._listener.busy:
            reason = next(iter(self._listener.missing.values()))
            raise RecordingError(
                f"{self._path}: {reason} (nor is it configured by SDO in the recording, nor is "
                f"there a {side_file(self._path).name} beside it)"
            )

    def _period(self, syncs: list[int], configured_s: float) -> float:
        """Return the period of the recorded SYNCs; the configured one if they agree."""
        if len(syncs) < 3:
            raise RecordingError(
                f"{self._path}: expected SYNC frames (0x080), which give the time of a sample, got "
                f"{len(syncs)}: record the whole bus, no filter set, while its master sends SYNC"
            )
        if syncs[0] == NO_STAMP:
            return configured_s
        measured = measure_period([stamp for stamp in syncs if stamp != NO_STAMP], configured_s)
        if measured is None or measured.same:
            return configured_s
        try:
            require_in_range("period_s", measured.period_s, positive=True)
        except EstimatorError as error:
            raise RecordingError(f"{self._path}: of its SYNCs, {error}") from error
        text = "%s: SYNC comes every %.4g s, not every %.4g s as bus.period_s says: taken as it comes"
        _LOG.warning(text, self._path, measured.period_s, configured_s)
        return measured.period_s


def read_frame_record(path: Path, joint: JointFile | None, base_dir: Path, channel: str | None) -> Record:
    """Read the samples of a raw CAN recording.

    Raises:
        RecordingError: no joint file, or no samples.
    """
    if joint is None:
        raise RecordingError(f"{path}: a raw CAN recording needs the joint file that says what is in it")
    log = FrameLog(path, joint, base_dir, channel)
    samples = (cycle.sample for cycle in log.cycles() if cycle.sample is not None)
    record = record_of_samples(samples, len(joint.motor), log.period_s, str(path))
    report_gaps(record.sequence, log.period_s, str(path))
    return record


def _mcap_frames(path: Path) -> Iterator[LoggedFrame]:
    message = None
    for message in read_messages(path, frozenset({"can"})):
        try:
            yield logged((message.log_time_ns, *json_frame(message.data), ""))
        except ValueError as error:
            raise RecordingError(f"{path}: {message.topic[:80]} is no frame of drivelink: {error}") from error
    if message is None:
        raise RecordingError(f"{path}: no raw CAN in it, samples alone")
