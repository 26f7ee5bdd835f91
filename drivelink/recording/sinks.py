"""Writers of recordings with one interface, one class per family of formats.

A sink buffers in memory; `flush`, called once a second, writes whole blocks to disk.
"""

import io
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
from mcap.writer import CompressionType, IndexType, Writer

from drivelink.errors import RecordingError, raised_as
from drivelink.files import NewFile, check_target, write_whole
from drivelink.jointfile import JointFile
from drivelink.pubsub.wire import EstimateMessage, ExternalMessage
from drivelink.recording.canlog import CAN_FORMATS
from drivelink.recording.columns import sample_columns, sample_row
from drivelink.recording.mapping import side_file
from drivelink.recording.mcapfile import SNAPSHOT
from drivelink.recording.messages import (
    SCHEMA_NAMES,
    TOPICS,
    Encoders,
    events_of,
    log_message,
    message_schema,
)
from drivelink.version import __version__
from estimator.sample import Sample


class SafeFile(io.BufferedIOBase):
    """Binary file for writers: whole blocks reach the disk, or none of a block.

    `write` buffers bytes; `flush` writes them as one block; `sync` also syncs to disk. The first `sync` gives
    the file its name. If the disk is full, the file is truncated to the last whole block, so that it ends
    between two records.

    Args:
        force: replace an existing file, at the first `sync`.

    Raises:
        RecordingError: it cannot be opened or, later, written.
    """

    def __init__(self, path: Path, *, force: bool = False) -> None:
        super().__init__()
        self._path = path
        self.name = str(path)  # the path
        self._pending = bytearray()
        self._place: int | None = None  # position of a write before the end
        self._size = 0
        with raised_as(RecordingError, f"{path}: cannot be written"):
            self._file = NewFile(path, force=force)

    def writable(self) -> bool:
        """Return always."""
        return True

    def seekable(self) -> bool:
        """Return always True: a header may be rewritten at the end."""
        return True

    def tell(self) -> int:
        """Return the position of the next byte."""
        return self._size + len(self._pending) if self._place is None else self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position, after writing pending bytes."""
        self.flush()
        end = whence == os.SEEK_END
        self._place = None if end else offset
        return self.tell()

    def write(self, data: bytes) -> int:  # type: ignore[override]
        """Write bytes; at the end of the file they are buffered until `flush`."""
        if self._place is None:
            self._pending += data
        else:
            self._put(bytes(data), self._place)
            self._place += len(data)
        return len(data)

    def flush(self) -> None:
        """Write all pending bytes as one block."""
        if self._file.fd < 0 or not self._pending:
            return
        self._put(bytes(self._pending), None)
        self._size += len(self._pending)
        self._pending.clear()

    def sync(self) -> None:
        """Flush, and sync file and name to disk."""
        self.flush()
        try:
            self._file.place()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Flush and close; after a write error only close."""
        if self._file.fd < 0:
            return
        try:
            self.sync()
        finally:
            self._file.close()
            super().close()

    def abandon(self) -> None:
        """Close without writing pending bytes; remove a file that was never synced."""
        self._pending.clear()
        self._file.close()
        super().close()

    def _put(self, data: bytes, place: int | None) -> None:
        """Write bytes at a place, or at the end."""
        fd, done = self._file.fd, 0
        try:
            while done < len(data):
                rest = data[done:]
                done += os.write(fd, rest) if place is None else os.pwrite(fd, rest, place + done)
        except OSError as error:
            self._pending.clear()
            if place is None:
                with suppress(OSError):  # of a pipe
                    os.ftruncate(fd, self._size)
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> RecordingError:
        whole = self._size and self._file.placed
        kept = "it holds everything up to the last second" if whole else "nothing was written"
        return RecordingError(f"{self._path}: cannot be written any further: {error.strerror}; {kept}")


class Sink:
    """A recording being written; each format ignores kinds that it cannot store."""

    # the kinds it stores: "sample", "estimate", "external", "document", "frame", "snapshot"
    wants: frozenset[str] = frozenset()

    def __init__(self, path: Path, *, force: bool = False) -> None:
        self._file = SafeFile(path, force=force)
        self.counts: dict[str, int] = dict.fromkeys(sorted(self.wants), 0)  # number of items of each kind

    def sample(self, sample: Sample, stamp_ns: int) -> None:
        """Store what was measured at one SYNC."""

    def estimate(self, message: EstimateMessage) -> None:
        """Store one estimate."""

    def external(self, message: ExternalMessage) -> None:
        """Store one external torque."""

    def document(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """Store a JSON document: status, model."""

    def frame(self, stamp_ns: int, cob_id: int, data: bytes) -> None:
        """Store one CAN frame."""

    def snapshot(self, state: bytes) -> None:
        """Store the state of the estimator after the newest samples, see `JointPipeline.snapshot`."""

    def mapping(self, document: dict[str, Any], stamp_ns: int) -> None:
        """Store the mapping document, see `drivelink.recording.mapping`."""

    def flush(self) -> None:
        """Write everything to the disk."""
        self._file.sync()

    def close(self) -> None:
        """Write the end of the file and close it."""
        self._file.close()

    def abandon(self) -> None:
        """Close it without writing more."""
        self._file.abandon()


class CsvSink(Sink):
    """Samples as CSV, numbers in their shortest exact text."""

    wants = frozenset({"sample"})

    def __init__(self, path: Path, joint: JointFile, _: str = "", *, force: bool = False) -> None:
        super().__init__(path, force=force)
        self._period_s = joint.bus.period_s
        columns = sample_columns(len(joint.motor))
        self._line = ",".join(["%r"] * len(columns)) + "\n"
        self._file.write((",".join(columns) + "\n").encode())

    def sample(self, sample: Sample, stamp_ns: int) -> None:
        """Store what was measured at one SYNC."""
        self.counts["sample"] += 1
        self._file.write((self._line % sample_row(sample, self._period_s)).encode())


class MessageSink(Sink):
    """Makes a message of each item, for whatever takes messages on topics."""

    wants = frozenset({"sample", "estimate", "external", "document", "frame"})

    def set_up(self, joint: JointFile) -> None:
        """Make the encoders of a joint."""
        self._encode = Encoders(len(joint.motor), joint.bus.period_s)
        self._name, self._logged_s = joint.name, 0.0  # time of the last event that was written

    def _put(self, topic: str, stamp_ns: int, data: bytes) -> None:
        raise NotImplementedError

    def sample(self, sample: Sample, stamp_ns: int) -> None:
        """Store what was measured at one SYNC."""
        self._put("sample", stamp_ns, self._encode.sample(sample))
        self.counts["sample"] += 1

    def estimate(self, message: EstimateMessage) -> None:
        """Store one estimate."""
        self._put("estimate", message.stamp_ns, self._encode.estimate(message))
        self.counts["estimate"] += 1

    def external(self, message: ExternalMessage) -> None:
        """Store one external torque."""
        self._put("external", message.stamp_ns, self._encode.external(message))
        self.counts["external"] += 1

    def document(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """Store a JSON document: status, model. The events of a status are log messages, too."""
        self._put(name, stamp_ns, payload)
        self.counts["document"] += 1
        for time_s, text in events_of(payload) if name == "status" else ():
            if time_s > self._logged_s:
                self._logged_s = time_s
                self._put("log", stamp_ns, log_message(self._name, time_s, text))

    def frame(self, stamp_ns: int, cob_id: int, data: bytes) -> None:
        """Store one CAN frame."""
        self._put("can", stamp_ns, f'{{"id":{cob_id},"data":"{data.hex()}"}}'.encode())
        self.counts["frame"] += 1

    def mapping(self, document: dict[str, Any], stamp_ns: int) -> None:
        """Store what makes samples of the frames."""
        fields = {key: value for key, value in document.items() if key != "text"}
        self._put("mapping", stamp_ns, json.dumps(fields).encode())  # the joint file has a separate channel


class McapSink(MessageSink):
    """Everything, as MCAP with one JSON channel `/<joint>/<topic>` for each of `TOPICS`."""

    def __init__(self, path: Path, joint: JointFile, joint_text: str = "", *, force: bool = False) -> None:
        super().__init__(path, force=force)
        self.set_up(joint)
        motors, period_s = len(joint.motor), joint.bus.period_s
        self._writer: Any = Writer(  # of its methods, some are not annotated
            self._file,  # type: ignore[arg-type]
            chunk_size=4 << 20,
            compression=CompressionType.ZSTD,
            index_types=IndexType.CHUNK | IndexType.METADATA,
        )
        self._writer.start(library=f"drivelink/{__version__}")
        about = {"joint": joint.name, "motors": str(motors), "period_s": repr(period_s)}
        self._writer.add_metadata("drivelink", about | {"version": __version__})
        self._channels = {}
        for topic in TOPICS:
            name = SCHEMA_NAMES.get(topic, f"drivelink.{topic}")
            schema = self._writer.register_schema(name, "jsonschema", message_schema(topic, motors))
            self._channels[topic] = self._writer.register_channel(f"/{joint.name}/{topic}", "json", schema)
        self._joint = json.dumps({"text": joint_text}).encode() if joint_text else b""

    def note(self, name: str, fields: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, dict(fields))

    def snapshot(self, state: bytes) -> None:
        """Attach the state from which a replay of this recording goes on."""
        self._writer.add_attachment(0, 0, SNAPSHOT, "application/octet-stream", state)

    def flush(self) -> None:
        """Write everything to disk as one chunk."""
        self._writer.flush()
        super().flush()

    def close(self) -> None:
        """Write the index and close."""
        self._writer.finish()
        super().close()

    def _put(self, topic: str, stamp_ns: int, data: bytes) -> None:
        if self._joint:
            joint, self._joint = self._joint, b""
            self._put("joint", stamp_ns, joint)
        self._writer.add_message(self._channels[topic], stamp_ns, data, stamp_ns)


class CanSink(Sink):
    """Raw frames in one of `CAN_FORMATS`; the mapping beside them."""

    wants = frozenset({"frame"})

    def __init__(self, path: Path, joint: JointFile, _: str = "", *, force: bool = False) -> None:
        side = side_file(path)
        check_target(side, force=force)
        super().__init__(path, force=force)
        self._side, self._force, self._beside = side, force, ""
        suffix = path.suffix.lower()
        kind, self._text = CAN_FORMATS[suffix], None
        if kind.text:
            self._text = io.TextIOWrapper(self._file, encoding="ascii", newline="\n", write_through=True)
        self._writer = kind.writer(self._text or self._file)
        # Formats with numbered channels have no names.
        self._channel: str | int = joint.bus.channel.replace(" ", "_") if suffix == ".log" else 0

    def frame(self, stamp_ns: int, cob_id: int, data: bytes) -> None:
        """Store one CAN frame."""
        message = can.Message(
            timestamp=stamp_ns * 1e-9,
            arbitration_id=cob_id,
            data=data,
            is_extended_id=False,
            is_fd=len(data) > 8,
            channel=self._channel,
        )
        self._writer.on_message_received(message)
        self.counts["frame"] += 1

    def mapping(self, document: dict[str, Any], stamp_ns: int) -> None:
        """Store the content of the mapping file."""
        self._beside = json.dumps(document, indent=1) + "\n"

    def flush(self) -> None:
        """Write everything to the disk."""
        if self._text is not None:
            self._text.flush()
        else:
            self._writer.end_container()
        super().flush()
        self._write_beside()

    def close(self) -> None:
        """Write the end of the file and close it."""
        self._writer.stop()
        super().close()
        self._write_beside()

    def _write_beside(self) -> None:
        text, self._beside = self._beside, ""
        if text:
            with raised_as(RecordingError, f"{self._side}: cannot be written"):
                write_whole(self._side, text, force=self._force)
