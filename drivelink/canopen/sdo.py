"""SDO client as a state machine (CiA 301, 7.2.4) that never blocks, so it can run beside the loop.

A *program* is a generator that yields requests (`Read`, `Write`, `Nmt`, `Pause`) and gets their answers;
`Session` runs one program on a bus that the loop reads: frames come in by `feed`, time by `poll`. The same
program serves the configuration before the start and that of a drive that rebooted in a run, without a second
thread or reader of the bus; canopen's client blocks its caller until the answer.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Generic, TypeVar

from canopen.sdo.exceptions import SdoAbortedError

from drivelink._core import SdoTransfers
from drivelink.canopen import Address
from drivelink.canopen.guard import check_frame
from drivelink.errors import DriveError

T = TypeVar("T")
Send = Callable[[int, bytes], None]

_TOGGLE_ERROR = 0x05030000
_TIMED_OUT = 0x05040000
_WRONG_LENGTH, _TOO_LONG, _TOO_SHORT = 0x06070010, 0x06070012, 0x06070013
_NUMBER_BYTES = 8  # of the longest integer (CiA 301, table 44)
_TEXT_BYTES = 256  # the longest object read here is a device name
_TRANSFER_TIMEOUTS = 4  # limit of a whole transfer, in timeouts


def abort_text(code: int) -> str:
    """Return an abort code with its meaning (CiA 301, table 22)."""
    text = SdoAbortedError.CODES.get(code)
    return f"0x{code:08X}" + (f" ({text})" if text else "")


class Unsized(bytes):
    """The four bytes of an answer without size indication."""


@dataclass(frozen=True, slots=True)
class Read:
    """Upload of one object; the answer has at most `most` bytes."""

    node: int
    index: int
    subindex: int = 0
    most: int = _TEXT_BYTES


@dataclass(frozen=True, slots=True)
class Write:
    """Expedited download of an unsigned value; the answer is empty."""

    node: int
    index: int
    subindex: int
    value: int
    size: int


@dataclass(frozen=True, slots=True)
class Nmt:
    """NMT command to one node."""

    node: int
    command: int


@dataclass(frozen=True, slots=True)
class Pause:
    """Wait for so many seconds."""

    seconds: float


Request = Read | Write | Nmt | Pause
Program = Generator[Request, bytes, T]


def _name(request: Read | Write) -> str:
    return f"0x{request.index:04X}:{request.subindex:02X}"


class SdoAbort(DriveError):  # noqa: N818 - the protocol's own word
    """The drive refused a transfer."""

    def __init__(self, request: Read | Write, code: int) -> None:
        what = "writing" if isinstance(request, Write) else "reading"
        super().__init__(f"node {request.node} refused {what} {_name(request)}: SDO abort {abort_text(code)}")
        self.index = request.index  # object
        self.subindex = request.subindex  # of it
        self.code = code  # abort code


class SdoBreach(SdoAbort):
    """The drive violated the protocol; the client aborted the transfer."""

    def __init__(self, request: Read | Write, code: int, what: str) -> None:
        super().__init__(request, code)
        text = f"node {request.node} answers {_name(request)} against the protocol: {what}"
        self.args = (f"{text}; SDO abort {abort_text(code)}",)


class SdoTimeout(DriveError):  # noqa: N818 - as above
    """The drive did not answer."""

    def __init__(self, request: Read | Write, timeout_s: float, attempts: int, *, begun: bool) -> None:
        does, what = ("end its answer", "no end") if begun else ("answer", "no answer")
        super().__init__(
            f"node {request.node} does not {does}: SDO {_name(request)}, {what} within {timeout_s:g} s, "
            f"the last {attempts} time{'s' if attempts > 1 else ''} it was asked"
        )
        self.index = request.index  # object it was asked for


def read_number(node: int, index: int, subindex: int) -> Program[int]:
    """Return an object as an unsigned number.

    Raises:
        SdoAbort: the node refuses, or answers with too many bytes.
    """
    return int.from_bytes((yield Read(node, index, subindex, _NUMBER_BYTES)), "little")


_Transfer = Generator[bytes, bytes, bytes]
"""Yields the frames to send, empty where there is none yet; gets those of the server; returns the object."""


def _answer(request: Read | Write, frame: bytes, command: int, *, named: bool = True) -> _Transfer:
    """Send a frame, and return the answer with that command; others are late, or for another master.

    Args:
        named: whether the answer names the object.

    Raises:
        SdoAbort: the server aborted.
    """
    data = yield frame
    while True:
        if len(data) == 8:
            ours = data[1] | data[2] << 8 == request.index and data[3] == request.subindex
            if data[0] >> 5 == 4 and (ours or not any(data[1:4])):  # some abort without naming the object
                raise SdoAbort(request, int.from_bytes(data[4:8], "little"))
            if data[0] >> 5 == command and (ours or not named):
                return data
        data = yield b""


def _transfer(request: Read | Write) -> _Transfer:
    """One upload or download.

    Raises:
        SdoAbort: the server aborted.
        SdoBreach: a protocol error, or another number of bytes than declared.
    """
    object_ = request.index.to_bytes(2, "little") + bytes([request.subindex])
    if isinstance(request, Write):
        value = request.value.to_bytes(request.size, "little").ljust(4, b"\0")
        yield from _answer(request, bytes([0x23 | (4 - request.size) << 2]) + object_ + value, 3)
        return b""
    head = yield from _answer(request, b"\x40" + object_ + bytes(4), 2)
    if head[0] & 0x02:
        unused = (head[0] >> 2) & 3
        return head[4 : 8 - unused] if head[0] & 0x01 else Unsized(head[4:8])
    declared = int.from_bytes(head[4:8], "little") if head[0] & 0x01 else None
    most = request.most if declared is None else declared
    if most > request.most:
        raise SdoBreach(request, _TOO_LONG, f"{declared} bytes, expected {request.most} at most")
    content, toggle, last = b"", 0, False
    while not last:
        data = yield from _answer(request, bytes([0x60 | toggle << 4]) + bytes(7), 0, named=False)
        if (data[0] >> 4) & 1 != toggle:
            raise SdoBreach(request, _TOGGLE_ERROR, "a segment out of turn")
        part, last = data[1 : 8 - ((data[0] >> 1) & 7)], bool(data[0] & 0x01)
        content += part
        toggle ^= 1
        if len(content) > most:
            raise SdoBreach(request, _TOO_LONG, f"more than {most} bytes")
        if not (part or last):
            raise SdoBreach(request, _WRONG_LENGTH, "a segment without data that is not the last")
    if declared is not None and len(content) < declared:
        raise SdoBreach(request, _TOO_SHORT, f"{len(content)} bytes after declaring {declared}")
    return content


class Session(Generic[T]):
    """Runs one program; never blocks.

    Args:
        send: puts a frame (identifier, data) on the bus.
        timeout_s: for each answer; four times as long for a whole transfer.
        retries: further attempts after a timeout.
    """

    def __init__(self, program: Program[T], send: Send, *, timeout_s: float = 0.5, retries: int = 1) -> None:
        self._program = program
        self._send = send
        self._timeout_s = timeout_s
        self._retries = retries
        self._asked: tuple[Read | Write, _Transfer] | None = None  # what is waited for
        self._begun = False  # whether the server has begun to answer
        self._deadline_s = self._end_s = -float("inf")
        self._attempts = 0
        self._started = False
        self.done = False
        self._result: T | None = None
        self._error: Exception | None = None

    @property
    def asks(self) -> int | None:
        """The node whose answer it waits for, or None."""
        return self._asked[0].node if self._asked is not None else None

    @property
    def result(self) -> T:
        """What the program returned.

        Raises:
            DriveError: the program failed.
        """
        if self._error is not None:
            raise self._error
        if not self.done:
            raise RuntimeError("the session is not done")
        return self._result  # type: ignore[return-value]

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Process a frame of the bus; frames of other transfers are ignored."""
        if self._asked is None or cob_id != 0x580 + self._asked[0].node:
            return
        request, transfer = self._asked
        try:
            following = transfer.send(bytes(data))
        except StopIteration as stop:
            self._advance(now_s, stop.value)
        except SdoAbort as abort:
            if isinstance(abort, SdoBreach):
                self._abort(request, abort.code)
            self._advance(now_s, abort)
        else:
            if following:
                self._begun = True
                self._put(0x600 + request.node, following)
                self._deadline_s = min(now_s + self._timeout_s, self._end_s)

    def poll(self, now_s: float) -> bool:
        """Start or advance the program; return whether it has ended."""
        if not self._started:
            self._started = True
            self._advance(now_s, None)
        if self.done or now_s < self._deadline_s:
            return self.done
        if self._asked is None:
            self._advance(now_s, b"")
            return self.done
        request, _ = self._asked
        self._abort(request, _TIMED_OUT)
        if self._attempts <= self._retries:
            self._begin(request, now_s)
        else:
            waited_s = self._timeout_s * (_TRANSFER_TIMEOUTS if self._begun else 1)
            self._advance(now_s, SdoTimeout(request, waited_s, self._attempts, begun=self._begun))
        return self.done

    def _advance(self, now_s: float, answer: bytes | Exception | None) -> None:
        """Pass an answer to the program and execute its requests up to the next wait."""
        self._asked = None
        try:
            while True:
                if isinstance(answer, Exception):
                    request = self._program.throw(answer)
                else:
                    request = self._program.send(answer)  # type: ignore[arg-type]
                if isinstance(request, Nmt):
                    self._put(0, bytes([request.command, request.node]))
                    answer = b""
                    continue
                if isinstance(request, Pause):
                    self._deadline_s = now_s + request.seconds
                    return
                self._attempts = 0
                self._begin(request, now_s)
                return
        except StopIteration as stop:
            self.done, self._result = True, stop.value
        except DriveError as error:
            self.done, self._error = True, error

    def _begin(self, request: Read | Write, now_s: float) -> None:
        transfer = _transfer(request)
        self._asked, self._begun = (request, transfer), False
        self._attempts += 1
        self._deadline_s = now_s + self._timeout_s
        self._end_s = now_s + _TRANSFER_TIMEOUTS * self._timeout_s
        self._put(0x600 + request.node, next(transfer))

    def _abort(self, request: Read | Write, code: int) -> None:
        frame = b"\x80" + request.index.to_bytes(2, "little") + bytes([request.subindex])
        self._put(0x600 + request.node, frame + code.to_bytes(4, "little"))

    def _put(self, cob_id: int, data: bytes) -> None:
        check_frame(cob_id, data)
        self._send(cob_id, data)


_DOWNLOAD, _BLOCK_DOWNLOAD = 1, 6  # commands of the client


class SdoSniffer(SdoTransfers):
    """Reads another master's transfers with one node from the traffic (CiA 301, 7.2.4.3).

    An answer is used only if it belongs to a request that was heard: of the same object, in order, within the
    time-out. Every other one is counted and ignored. Where two different answers follow one request, or a
    download is given up before its answer, the object's value is not known: it is disputed until it is
    transferred again. A download counts once the node has confirmed it. The object of a block download is
    disputed: its bytes are not followed.
    """

    def forget(self, lost: Callable[[Address], bool]) -> None:
        """Handle a restart of the node: forget written values and those that `lost` selects."""
        self.drop_transfer()
        for address in [a for a in self.values if a in self.written or lost(a)]:
            del self.values[address]
        self.written.clear()
        self.disputed.difference_update([address for address in self.disputed if lost(address)])
        self.changes += 1


def is_mapping(address: Address) -> bool:
    """Return whether an object is a parameter of a TPDO (CiA 301, 7.5.2.37 and 38)."""
    return 0x1800 <= address[0] <= 0x1BFF


def written_object(data: bytes) -> Address | None:
    """Return the object that a frame of the master begins to write."""
    begins = data and (data[0] >> 5 == _DOWNLOAD or data[0] & 0xE1 == _BLOCK_DOWNLOAD << 5)
    if not begins or len(data) > 8:
        return None
    data = data.ljust(8, b"\0")  # some masters send fewer
    return data[1] | data[2] << 8, data[3]
