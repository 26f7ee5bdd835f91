"""Finds the nodes on the bus by SDO uploads and listening.

Every node id is asked for its device type (0x1000, mandatory in CiA 301), all at once; nodes that answer, or
send heartbeat or boot-up, are found.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import can

from drivelink._core import SYNC_COB_ID
from drivelink.canopen.bus import FrameBus, OutOfTime, frames, received_ns, run_program, sender
from drivelink.canopen.emcy import nmt_state
from drivelink.canopen.guard import check_frame
from drivelink.canopen.pdo import read_identity, read_optional
from drivelink.canopen.sdo import Program, Read, SdoAbort
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection
from drivelink.plaintext import clean_text

ASKED_S = 20.0  # for all nodes of a bus; slow adapters take 5 s for one
_ANSWER_S = 0.3  # for the slowest node
_LONGEST_NAME = 80  # characters of a device's name that are shown
_GAP_S = 0.001  # between two requests: 127 of them must not fill a transmit queue
_PROFILES = {301: "CiA 301", 401: "CiA 401 (I/O)", 402: "CiA 402 (drive)", 406: "CiA 406 (encoder)"}


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundNode:
    """A node found on the bus."""

    node_id: int  # 1 to 127
    device_type: int | None  # 0x1000; 0: no value, None: no SDO answer
    identity: tuple[int, int, int, int] = (0, 0, 0, 0)  # 0x1018
    name: str = ""  # 0x1008

    @property
    def profile(self) -> str:
        """The device profile in words."""
        if self.device_type is None:
            return "does not answer SDO"
        number = self.device_type & 0xFFFF
        return _PROFILES.get(number, f"CiA {number}" if number else "no standard profile")


@dataclass(slots=True)
class Traffic:
    """Frames received in an interval."""

    seconds: float = 0.0  # how long
    sync_s: list[float] = field(default_factory=list)  # stamps of SYNC frames
    counts: dict[int, int] = field(default_factory=dict)  # frames by identifier
    heartbeats: dict[int, str] = field(default_factory=dict)  # last NMT state by node
    error_frames: int = 0  # seen
    last: dict[int, bytes] = field(default_factory=dict)  # last data by identifier

    def add(self, message: can.Message) -> None:
        """Count one frame."""
        if message.is_error_frame:
            self.error_frames += 1
            return
        if message.is_extended_id or message.is_remote_frame:
            return
        cob_id, data = message.arbitration_id, bytes(message.data)
        self.counts[cob_id] = self.counts.get(cob_id, 0) + 1
        self.last[cob_id] = data
        if cob_id == SYNC_COB_ID:
            self.sync_s.append(received_ns(message) * 1e-9)
        elif 0x701 <= cob_id <= 0x77F and len(data) == 1:
            self.heartbeats[cob_id - 0x700] = nmt_state(data[0] & 0x7F)


def listen(bus: FrameBus, seconds: float, on_frame: Callable[[can.Message], None] | None = None) -> Traffic:
    """Listen for a while; sends nothing."""
    traffic = Traffic(seconds=seconds)
    for message in frames(bus, seconds):
        if message is not None:
            traffic.add(message)
            if on_frame is not None:
                on_frame(message)
    return traffic


def scan(bus: FrameBus, node_ids: Iterable[int] = range(1, 128)) -> tuple[list[int], Traffic]:
    """Ask node ids for their device type.

    Returns:
        Ids of the nodes that answered or were heard, and the traffic meanwhile.
    """
    send = sender(bus)
    traffic = Traffic()
    started_s = time.monotonic()
    question = bytes([0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0])
    for node in node_ids:
        check_frame(0x600 + node, question)
        send(0x600 + node, question)
        listen(bus, _GAP_S, traffic.add)
    listen(bus, _ANSWER_S, traffic.add)
    traffic.seconds = time.monotonic() - started_s
    answered = {cob_id - 0x580 for cob_id in traffic.counts if 0x581 <= cob_id <= 0x5FF}
    return sorted(answered | set(traffic.heartbeats)), traffic


def shares(parts: int) -> Iterator[float]:
    """Yield when each of so many nodes has to be asked, s (monotonic): what one leaves, the others have."""
    end_s = time.monotonic() + ASKED_S
    for left in range(parts, 0, -1):
        now_s = time.monotonic()
        yield now_s + (end_s - now_s) / left


def identify(bus: FrameBus, section: BusSection, node_id: int, end_s: float) -> FoundNode:
    """Read identity and name of a node.

    Raises:
        OutOfTime: it could not be asked to the end by then.
    """
    try:
        return run_program(_identify(node_id), bus, section, end_s=end_s)
    except OutOfTime:
        raise
    except DriveError:
        return FoundNode(node_id=node_id, device_type=None)


def identify_all(
    bus: FrameBus, section: BusSection, node_ids: Sequence[int], end_s: float
) -> tuple[list[FoundNode], list[int]]:
    """Read identity and name of nodes; return them, and those that the time did not suffice for."""
    found: list[FoundNode] = []
    with suppress(OutOfTime):
        found.extend(identify(bus, section, node, end_s) for node in node_ids)
    return found, list(node_ids[len(found) :])


def _identify(node: int) -> Program[FoundNode]:
    device_type = (yield from read_optional(node, 0x1000, 0)) or 0
    identity = yield from read_identity(node)
    try:
        name = yield Read(node, 0x1008, 0)
    except SdoAbort:
        name = b""
    shown = clean_text(name.rstrip(b"\0 ").decode("latin-1"), _LONGEST_NAME)
    return FoundNode(node_id=node, device_type=device_type, identity=identity, name=shown)
