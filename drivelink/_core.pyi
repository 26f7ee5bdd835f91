# Attributes are read only, but for `SdoTransfers.changes`.
from collections.abc import Callable, Sequence
from typing import Any

from drivelink.canopen.layout import NodeLayout
from drivelink.recording.canlog import LoggedFrame
from estimator.model_monitor import ModelMonitor
from estimator.online import Estimator
from estimator.sample import Estimate, External, Sample

LATE: int
LATEST: float
MESSAGES: dict[str, list[tuple[str, str, str]]]
STATUS_BITS: dict[str, int]
SYNC_COB_ID: int
__version__: str

def encode_estimate(estimate: Estimate, stamp_ns: int) -> bytes:
    """The bytes of `<prefix>/<joint>/estimate`; see `drivelink.pubsub.wire.ESTIMATE`.

    Args:
        estimate: of at most 8 transmissions.
        stamp_ns: UNIX time of its SYNC.
    """

def encode_external(external: External, stamp_ns: int) -> bytes:
    """The bytes of `<prefix>/<joint>/external`; see `drivelink.pubsub.wire.EXTERNAL`.

    Args:
        external: of one cycle.
        stamp_ns: UNIX time of its SYNC.
    """

def encode_sample(sample: Sample, stamp_ns: int) -> bytes:
    """The bytes of `<prefix>/<joint>/sample`; see `drivelink.pubsub.wire.SAMPLE`.

    Args:
        sample: of at most 2 motors.
        stamp_ns: UNIX time of its SYNC.
    """

def json_frame(data: bytes) -> tuple[int, bytes]:
    """Identifier and bytes of a message of `/can`.

    Raises:
        ValueError: it is none.
    """

class JsonNumbers:
    """Reads some numbers of messages, which are flat JSON objects.

    Args:
        names: of their fields.
    """

    def __init__(self, names: Sequence[str]) -> None: ...
    def __call__(self, data: bytes) -> tuple[float | None, ...]:
        """The numbers in the order of their names; NaN for null, None for a field that is not there.

        Raises:
            ValueError: it is no flat JSON object, or such a field has another value.
        """

class NodeCounters:
    """What became of one node's frames since the start."""

    received: int  # PDOs of this node that were used
    missing: int  # frames that had not come when the next SYNC came
    late: int  # of these, frames that came in the cycle after
    duplicate: int  # frames beyond the one a cycle needs
    conflicting: int  # of the cycles with such frames, those in which they differed; not used
    wrong_length: int  # frames that do not carry what is mapped; not used
    ignored: int  # frames sent after a reboot, before the node was configured and started again
    reboots: int  # boot-up messages
    emergencies: int  # EMCY messages that report an error

    def as_dict(self) -> dict[str, int]:
        """All of them, by name."""

class Assembler:
    """Makes the samples of one joint from the frames of its nodes (CiA 301, 7.2.2 and 7.2.5).

    Frames after SYNC k and before SYNC k+1 belong to sample k, which is given out with the last frame it
    needs. A frame that does not come leaves a gap: counted by node, never filled with an older value. What
    comes after a missing frame may be the missing one, late: for a while such cycles are judged only at their
    end, and are flagged. No clock is read: the same frames in the same order give the same samples, live or
    from a log.

    Args:
        layouts: the joint's nodes, as configured or as declared.
        motors: how many motors the joint has.
        active: whether we configure the nodes. Then a node that rebooted is believed again when it is
            started again; else `trust` alone makes it so.
        hold_periods: how long the last value of a TPDO that is not sent on SYNC may be used while nothing
            at all is heard of its node; and how long one that is sent on SYNC may fail before a node that we
            configure is not believed any more, since it may have lost its mapping meanwhile.
        period_s: communication cycle.

    Raises:
        DriveError: two frames with one identifier, or a motor without position or torque.
    """

    sequence: int  # number of the current SYNC, from 0; -1 before the first
    missed: int  # number of the cycle the last SYNC closed without a sample, or -1 if it had one
    flags: int  # service bits of `Status` that hold for the sample just given, or the cycle just missed
    cob_ids: tuple[int, ...]  # identifiers that concern this joint, SYNC aside
    counters: dict[int, NodeCounters]  # by node id, as they are now
    faults: dict[int, int]  # nodes that report a fault, with the EMCY error code (0: by statusword only)
    statuswords: dict[int, int]  # of the drives, as last heard, by node id
    untrusted: tuple[int, ...]  # nodes that rebooted or were silent for long, and have not been started again
    # two readings of one quantity, where both are mapped: (motor from 1 on, "velocity", "current",
    # "second_encoder" or "following_error", "untested", "agrees" or "contradicts", scale of the second
    # reading against the first, its standard deviation)
    checks: list[tuple[int, str, str, float, float]]
    has_link: bool  # whether any frame carries the link position
    complete: bool  # whether this cycle has given its sample: nothing more is expected before the next SYNC

    def __init__(
        self,
        layouts: Sequence[NodeLayout],
        motors: int,
        *,
        active: bool = True,
        hold_periods: int = 250,
        period_s: float = 0.001,
    ) -> None: ...
    def feed(self, cob_id: int, data: bytes, jump: int = 1) -> Sample | None:
        """Take one frame in the order of the bus, SYNC included; the sample that it completes, if it does.

        Args:
            cob_id: identifier of the frame.
            data: its bytes.
            jump: for a SYNC, whole periods since the one before; 0: one that was not due; `LATE`: one whose
                period is over.
        """

    def supervise(self) -> None:
        """From now on `trust` alone makes a node believed again: somebody else may start it too."""

    def distrust(self, node_id: int) -> None:
        """Do not use what a node sends until it is started again."""

    def trust(self, node_id: int) -> None:
        """A node has been configured and started."""

    def contradict(self, node_id: int, contradicted: bool) -> None:
        """A node says by SDO what its frames do not: no estimate is valid; or it does no longer."""

    def relayout(self, layout: NodeLayout) -> None:
        """A node has been configured differently: from now on its frames are read by this layout.

        Raises:
            DriveError: as in the constructor; then everything is as it was.
        """

class McapMessage:
    """One message of an MCAP file."""

    topic: str  # its channel's
    log_time_ns: int  # its time
    data: bytes  # its content

class BlfFrames:
    """The frames in the containers of a BLF file.

    Args:
        start_ns: UNIX time of the stamp zero.
    """

    def __init__(self, start_ns: int) -> None: ...
    def take(self, container: bytes) -> BlfFrames:
        """Go on with another container, unpacked; its begin may be the rest of an object."""

    def __iter__(self) -> BlfFrames: ...
    def __next__(self) -> tuple[int, int, bytes, str] | None:
        """Return stamp in ns, identifier, data and channel; None: no data frame with a short identifier.

        Raises:
            ValueError: the rest is damaged.
        """

class McapMessages:
    """The messages among the records of an MCAP file, up to a damaged one or a stamp beyond 63 bits.

    Args:
        topics: last parts of the topics of interest (`sample` for `/elbow/sample`); None: all.
    """

    # records up to here; a sample or an estimate counts twice, as no joint at rest has them in less than
    # twice the bytes of a frame
    count: int
    stamp_ns: int  # of the last message
    broken: bool  # whether a record was damaged

    def __init__(self, topics: frozenset[str] | None) -> None: ...
    def take(self, records: bytes, most: int) -> McapMessages:
        """Go on with further records, and end where there are more than `most` in all."""

    def __iter__(self) -> McapMessages: ...
    def __next__(self) -> McapMessage: ...

class SdoTransfers:
    """Follows the SDO channel of one node; see `drivelink.canopen.sdo.SdoSniffer`.

    Args:
        interesting: whether to keep the value of an object (index, subindex).
    """

    changes: int  # number of new, changed, forgotten and disputed values
    values: dict[tuple[int, int], int]  # confirmed unsigned values by (index, subindex)
    written: set[tuple[int, int]]  # those of them that were written, not read
    # objects with two different answers to one request, or a download that was given up
    disputed: set[tuple[int, int]]
    unasked: int  # answers that belong to no request
    pending: tuple[int, int] | None  # the object being written, not yet confirmed
    is_mapping: bool  # whether that is a parameter of a TPDO

    def __init__(self, interesting: Callable[[int, int], bool], timeout_s: float) -> None: ...
    def drop_transfer(self) -> None:
        """Forget the present transfer."""

    def request(self, data: bytes, now_s: float) -> None:
        """Process a frame of the master, 0x600 + node."""

    def response(self, data: bytes, now_s: float) -> tuple[tuple[int, int], bytes] | None:
        """Process a frame of the node, 0x580 + node; return the object of interest that it ends to read."""

class SyncNumbering:
    """Numbers the SYNCs of a stream once enough others have followed.

    Args:
        measure: called with the stamps of the first SYNCs and the period; returns the period to be used.
    """

    period_s: float  # in use

    def __init__(
        self, period_s: float, measure: Callable[[Sequence[int], float], float] | None = None
    ) -> None: ...
    def push(self, frame: LoggedFrame) -> tuple[Sequence[LoggedFrame], int] | None:
        """Process a frame; return what is decided now, see `Numbered`."""

    def pop(self) -> tuple[Sequence[LoggedFrame], int] | None:
        """Return the first of what waits, after the end of the stream; None: nothing."""

class LatencyHistogram:
    """A distribution of durations: counts per microsecond up to 5 ms, and the maximum."""

    count: int  # durations since the start

    def add(self, duration_ns: int) -> None:
        """Count one duration."""

    def total(self) -> dict[str, float]:
        """Since the start: p50_us, p90_us, p99_us, p999_us, max_us; empty before the first duration."""

    def recent(self) -> dict[str, float]:
        """The same since the last call; empty where nothing was counted."""

class Tick:
    """What is published of one cycle."""

    sequence: int  # number of its SYNC
    status: int  # bits of `Status`
    stamp_ns: int  # UNIX time of its SYNC
    current: bool  # whether it is the cycle of the last SYNC
    fresh: bool  # whether it has a sample; else the last estimate is carried on
    estimate: Estimate  # as an object
    external: External | None  # likewise; None where nothing is declared of the link
    sample: Sample | None  # likewise; None where it is not fresh
    estimate_payload: bytes  # the bytes of `<prefix>/<joint>/estimate`
    external_payload: bytes | None  # the bytes of `<prefix>/<joint>/external`; None where there is none
    sample_payload: bytes | None  # the bytes of `<prefix>/<joint>/sample`; None where it is not fresh

    def flagged(self, status: int) -> Tick:
        """The same with these status bits set too."""

    def stamped(self, stamp_ns: int) -> Tick:
        """The same at another time."""

class History:
    """The last samples of a joint, for a new estimator to start from; any thread may read them."""

    def __len__(self) -> int: ...
    def after(self, sequence: int, most: int | None = None) -> list[Sample]:
        """The samples that came after one of that number, the oldest `most` of them."""

    def behind(self, sequence: int) -> int:
        """How many came after one of that number."""

class JointPipeline:
    """One joint from frames to the bytes for zenoh: assembler, estimator, monitor. No clock, no bus, no key.

    What the service knows of the estimate's quality is added to its status: drive faults, missing frames, and
    estimates carried on without fresh measurements. It is fed by one thread; others may look at it.

    Args:
        assembler: makes the samples.
        estimator: steps once a sample.
        model_monitor: raises the model alarm, if there is one.
        keep: how many of the last samples are kept, for a new estimator to start from.
    """

    assembler: Assembler  # as given
    estimator: Estimator  # the one in use
    model_monitor: ModelMonitor | None  # likewise
    history: History  # the last samples
    estimate: Estimate | None  # the last one, None before the first
    status: int | None  # its bits of `Status`, likewise
    external: External | None  # likewise; None too where nothing is declared of the link
    sample: Sample | None  # what the last estimate was made from; None where it was carried on
    missed: int  # cycles that gave no sample
    complete: bool  # as of the assembler

    def __init__(
        self,
        assembler: Assembler,
        estimator: Estimator,
        model_monitor: ModelMonitor | None = None,
        *,
        keep: int = 0,
    ) -> None: ...
    def feed(
        self, cob_id: int, data: bytes, jump: int = 1, stamp_ns: int = 0, late_ns: int = 0
    ) -> Tick | None:
        """Take one frame (see `Assembler.feed`); what is published of the cycle that it ends, if it does.

        A cycle that is closed without a sample gives the last estimate again, under its own sequence
        number, stale and not valid.

        Args:
            cob_id: identifier of the frame.
            data: its bytes.
            jump: for a SYNC, whole periods since the one before; 0: one that was not due; `LATE`: one whose
                period is over.
            stamp_ns: for a SYNC that was due, its UNIX time.
            late_ns: by how much it was sent later than that; widens the interval of the external torque.

        Raises:
            Exception: whatever an estimator in Python raises.
        """

    def snapshot(self) -> tuple[int, bytes] | None:
        """The state of estimator and monitor, for `restore`; holds the interpreter's lock while it is copied.

        Returns:
            Number of the last sample in it, and its bytes. None: the last cycle had no sample, or part of it
            is Python.
        """

    def restore(self, snapshot: bytes) -> int:
        """Take the state that a pipeline of the same joint file had; it goes on from there bit for bit.

        Returns:
            Number of the last sample in it.

        Raises:
            ValueError: the bytes are of another version or kind of joint, or no snapshot.
        """

    def step(self, sample: Sample, flags: int = 0, stamp_ns: int = 0, late_ns: int = 0) -> Tick:
        """Take one sample as it was recorded.

        Args:
            sample: of the cycle.
            flags: service bits of `Status` that hold for it.
            stamp_ns: UNIX time of its SYNC.
            late_ns: as in `feed`.
        """

    def carry_on(self, sequence: int, flags: int = 0, stamp_ns: int | None = None) -> Tick | None:
        """The last estimate under a new number: stale, not valid; None where there never was one.

        Args:
            sequence: of the cycle.
            flags: service bits of `Status` that hold for it.
            stamp_ns: UNIX time of its SYNC; None: from the SYNCs fed.
        """

    def warm(self, estimator: Any, sequence: int, most: int | None = None) -> int:
        """Step a new estimator through the kept samples after one of that number.

        A compiled one is stepped without the interpreter's lock.

        Args:
            estimator: not the one in use.
            sequence: of the last sample that it has seen.
            most: number of steps; None: all.

        Returns:
            The number of the last sample that it has seen now.
        """

    def exchange(self, estimator: Any, model_monitor: ModelMonitor | None) -> None:
        """Put another estimator in place between two cycles."""
