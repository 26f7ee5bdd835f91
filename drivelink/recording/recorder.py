"""Records a daemon and a bus in a separate process.

It only subscribes and receives. Data wait in zenoh's and the kernel's queues; drops are counted.
"""

import json
import logging
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import can
import zenoh

from drivelink.canopen.bus import open_bus
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.sources import BusLostError, FrameSource, LostSource, open_source
from drivelink.errors import BusError, ZenohError
from drivelink.jointfile import JointFile
from drivelink.pubsub.feed import DECODERS, DaemonIdentity, follow_document, source_of, waiting
from drivelink.recording.canlog import LoggedFrame
from drivelink.recording.cycles import FrameSamples
from drivelink.recording.limits import MAX_BLOCK_BYTES, MAX_UNREAD
from drivelink.recording.mapping import layouts_from
from drivelink.recording.sinks import Sink
from estimator.sample import Sample

_LOG = logging.getLogger("drivelink.recording")
_BUS_LOG = logging.getLogger("drivelink.recording.bus")  # what a daemon on the same bus says, too

# Messages of a key that wait; a snapshot has some megabytes.
_DEPTHS = dict.fromkeys(("sample", "estimate", "external"), MAX_UNREAD) | {"snapshot": 2}
_FLUSH_S = 1.0
_POLL_S = 0.005
_AT_ONCE = 1000  # messages of a key, or frames, until the file has its turn
_REST_S = 5.0  # for what still waits at the end
_REOPEN_S = 0.5
_ANSWER_S = 1.0  # of a daemon
_STALE_S = 1.0  # after which another session may take over without a liveliness token


class FirstSource:
    """Passes the samples of one source, the first of daemon and bus."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._source: object = None

    def sample(self, source: object, sample: Sample, stamp_ns: int) -> None:
        """Store a sample of a source."""
        if self._source is None:
            self._source = source
        if source is self._source:
            self._sink.sample(sample, stamp_ns)


class ZenohTap:
    """Receives the messages of one daemon of a joint.

    Args:
        session: an open session; it stays open.
    """

    def __init__(
        self, session: zenoh.Session, joint: JointFile, sink: Sink, gate: FirstSource | None = None
    ) -> None:
        self._sink = sink
        self._gate = gate or FirstSource(sink)
        self.missed = dict.fromkeys(("sample", "estimate"), 0)  # cycles without one
        self._impossible = 0
        self._sequence: dict[str, int] = {}
        self._motors = len(joint.motor)
        self._identity = DaemonIdentity()
        self._heard_s = -math.inf
        self._silent_s = 0.0  # of the silences that are over
        key = f"{joint.zenoh.prefix}/{joint.name}"
        ring = zenoh.handlers.RingChannel
        self._streams: list[tuple[str, Any]] = [
            (name, session.declare_subscriber(f"{key}/{name}", ring(depth)))
            for name, depth in _DEPTHS.items()
            if name in sink.wants
        ]
        for name in ("status", "model") if "document" in sink.wants else ():
            self._streams.append((name, follow_document(session, f"{key}/{name}", 16)))

        # In zenoh's thread (indirect=False), which never keeps the process from ending.
        heard = zenoh.handlers.Callback(self._identity.heard, indirect=False)
        tokens: Any = session.liveliness().declare_subscriber(f"{key}/alive/**", heard, history=True)
        self._tokens = tokens

    @property
    def refused(self) -> int:
        """Messages of other sessions, or invalid ones, which are not recorded."""
        return self._identity.refused + self._impossible

    @property
    def silent_s(self) -> float:
        """For how long nothing came of a daemon that had been heard."""
        return self._silent_s + self._silence(time.monotonic())

    def _silence(self, now_s: float) -> float:
        silence_s = now_s - self._heard_s
        return silence_s if _STALE_S < silence_s < math.inf else 0.0

    def poll(self) -> bool:
        """Store what has come, but not all at once; return whether there is more."""
        now_s, more = time.monotonic(), False
        for name, subscriber in self._streams:
            for number, sample in enumerate(waiting(subscriber, _AT_ONCE), 1):
                more = more or number == _AT_ONCE
                if not self._identity.accepts(source_of(sample), now_s - self._heard_s > _STALE_S):
                    continue
                self._silent_s += self._silence(now_s)
                self._heard_s = now_s
                try:
                    self._take(name, sample)
                except ZenohError:
                    self._impossible += 1
        return more

    def finish(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Stop listening."""
        for subscriber in (self._tokens, *(subscriber for _, subscriber in self._streams)):
            subscriber.undeclare()

    def _take(self, name: str, sample: zenoh.Sample) -> None:
        """Store a message.

        Raises:
            ZenohError: it is malformed, or of another joint.
        """
        payload = sample.payload.to_bytes()
        if name == "snapshot":
            if not 8 < len(payload) <= MAX_BLOCK_BYTES:
                raise ZenohError(f"expected a snapshot of at most {MAX_BLOCK_BYTES >> 20} MiB")
            self._sink.snapshot(payload[8:])
            return
        message = DECODERS[name](payload)
        if name == "sample":
            self._count(name, message.sample.sequence, len(message.sample.motor_position_rad))
            self._gate.sample(self, *message)
        elif name == "estimate":
            self._count(name, message.sequence, len(message.transmissions))
            self._sink.estimate(message)
        elif name == "external":
            self._sink.external(message)
        else:
            self._sink.document(name, json.dumps(message).encode(), time.time_ns())

    def _count(self, kind: str, sequence: int, motors: int) -> None:
        """Count the cycles since the last one of its kind; refuse one of another number of motors."""
        if motors != self._motors:
            raise ZenohError(f"expected {self._motors} motors, got {motors}")
        self.missed[kind] += max(0, sequence - self._sequence.get(kind, sequence) - 1)
        self._sequence[kind] = sequence


class BusTap:
    """Receives the frames of a bus, and makes samples of them without a daemon; a lost bus is opened again.

    Args:
        bus: an open bus; `close` closes it.
        base_dir: folder of the joint file; None: make no samples.
        layouts: of its nodes, if reported by a daemon.
    """

    def __init__(
        self,
        bus: can.BusABC,
        joint: JointFile,
        sink: Sink,
        base_dir: Path | None,
        gate: FirstSource | None = None,
        layouts: Sequence[NodeLayout] = (),
    ) -> None:
        self._gate = gate or FirstSource(sink)
        self._bus, self._section = bus, joint.bus
        self._source: FrameSource = open_source(bus)
        self._sink = sink
        self._reopen_s = 0.0  # when to try next, while the bus is lost
        self._samples: FrameSamples | None = None
        if base_dir is not None:
            listener = PassiveConfigurator([joint], [base_dir])
            listener.adopt(layouts)
            self._samples = FrameSamples(joint, listener)
        self._period_s = joint.bus.period_s  # as said last

    @property
    def missing(self) -> str:
        """Why no samples can be made."""
        return self._samples.missing if self._samples is not None else ""

    def poll(self) -> bool:
        """Store the frames that have come, but not all at once; return whether there are more."""
        most = _AT_ONCE
        if isinstance(self._source, LostSource):
            self._reopen()
        try:
            while most > 0 and self._source.wait(0.0):
                for cob_id, data, stamp_ns in self._source.receive():
                    most -= 1
                    self._sink.frame(stamp_ns, cob_id, data)
                    if self._samples is not None:
                        self._put_samples(self._samples.feed(LoggedFrame(stamp_ns, cob_id, data, "")))
        except BusLostError as error:
            text = "%s: the bus is lost: %s: no frames until it is back"
            _BUS_LOG.error(text, self._section.channel, error)
            self._source = LostSource()
        return most <= 0

    def _reopen(self) -> None:
        if time.monotonic() < self._reopen_s:
            return
        self._reopen_s = time.monotonic() + _REOPEN_S
        self.close()
        with suppress(BusError):
            self._bus = open_bus(self._section)
            self._source = open_source(self._bus)
            _BUS_LOG.warning("%s: the bus is back", self._section.channel)

    def close(self) -> None:
        """Close the bus."""
        with suppress(can.CanError, OSError):
            self._bus.shutdown()

    def finish(self) -> None:
        """Store the samples waiting for later SYNCs."""
        if self._samples is not None:
            self._put_samples(self._samples.rest())

    def _put_samples(self, samples: list[tuple[Sample, int]]) -> None:
        period_s = self._samples.period_s if samples and self._samples is not None else self._period_s
        if period_s != self._period_s:
            _LOG.warning("SYNC comes every %.4g ms: samples are numbered by that", period_s * 1e3)
            self._period_s = period_s
        for sample, stamp_ns in samples:
            self._gate.sample(self, sample, stamp_ns)


class Recorder:
    """Polls its taps and flushes the sink once a second.

    Args:
        sink: the recording; closed at the end.
    """

    def __init__(self, sink: Sink, taps: list[ZenohTap | BusTap]) -> None:
        self.sink = sink
        self.taps = taps

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.sink.close()
        else:
            self.sink.abandon()

    def run(self, stop: Callable[[], bool], tick: Callable[[], None] = lambda: None) -> None:
        """Record until `stop` returns True; call `tick` after each flush.

        Raises:
            RecordingError: the disk is full; the file is readable.
        """
        flush_at = time.monotonic() + _FLUSH_S
        while not stop():
            for tap in self.taps:
                tap.poll()
            now = time.monotonic()
            if now >= flush_at:
                flush_at = max(flush_at + _FLUSH_S, now)
                self.sink.flush()
                tick()
            time.sleep(_POLL_S)
        end_s = time.monotonic() + _REST_S
        while sum(tap.poll() for tap in self.taps) and time.monotonic() < end_s:
            pass
        for tap in self.taps:
            tap.finish()


def daemon_layouts(
    session: zenoh.Session, joint: JointFile, say: Callable[[str], object]
) -> Sequence[NodeLayout]:
    """Return the mapping of the joint's nodes by its running daemon; () if unknown.

    Only the one session with the joint's liveliness token is trusted; none of several.
    """
    key = f"{joint.zenoh.prefix}/{joint.name}"
    tokens = session.liveliness().get(f"{key}/alive/*", timeout=_ANSWER_S)
    daemons = {str(reply.ok.key_expr).rpartition("/")[2] for reply in tokens if reply.ok}
    if len(daemons) > 1:
        say(f"{len(daemons)} sessions say that they serve {joint.name}: none is asked for the mapping")
        return ()
    for reply in session.get(f"{key}/model", timeout=_ANSWER_S):
        source = str(reply.replier_id.zid) if reply.replier_id else ""
        if reply.ok and source in daemons:
            with suppress(ValueError, ZenohError):
                document = DECODERS["model"](reply.ok.payload.to_bytes())
                return layouts_from(json.dumps(document).encode(), joint.name)
    return ()
