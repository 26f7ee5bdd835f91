"""A client for expedited SDO transfers that never waits (CiA 301, 7.2.4.3.3 and 7.2.4.3.6).

A program is a generator that yields `Read` and `Write` and gets the value back (an abort is raised into
it), as in drivelink's own client. That one is built not to write what moves a drive; this one is for that.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

__all__ = ["Client", "Program", "Read", "SdoError", "Write"]

_TIMEOUT_S = 0.3
_ATTEMPTS = 3

Send = Callable[[int, bytes], None]


class SdoError(Exception):
    """An object was refused, or nobody answered; `code` is the abort code, 0 for a timeout."""

    def __init__(self, node: int, index: int, subindex: int, code: int) -> None:
        what = f"SDO abort 0x{code:08X}" if code else "no answer"
        super().__init__(f"node {node}, object 0x{index:04X}:{subindex:02X}: {what}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Read:
    """Upload of at most four bytes; the answer is an unsigned number."""

    index: int
    subindex: int = 0


@dataclass(frozen=True, slots=True)
class Write:
    """Download of `size` bytes."""

    index: int
    subindex: int
    value: int
    size: int


Program = Generator[Read | Write, int, None]


class Client:
    """Runs one program after the other on one node's default SDO channel.

    Args:
        node: node id.
        send: puts a frame (identifier, data) on the bus.
    """

    def __init__(self, node: int, send: Send) -> None:
        self._node = node
        self._send = send
        self._program: Program | None = None
        self._request: Read | Write | None = None
        self._deadline_s = 0.0
        self._attempts = 0

    @property
    def busy(self) -> bool:
        """Whether a program is under way."""
        return self._program is not None

    def start(self, program: Program, now_s: float) -> None:
        """Begin a program; one that is under way is given up."""
        self._program = program
        self._advance(lambda: next(program), now_s)

    def feed(self, data: bytes, now_s: float) -> None:
        """Take a frame 0x580 + node.

        Raises:
            SdoError: the program does not handle an abort.
        """
        request, program = self._request, self._program
        if request is None or program is None or len(data) != 8:
            return
        if data[1] | data[2] << 8 != request.index or data[3] != request.subindex:
            return  # the answer to another master
        command, value = data[0] >> 5, int.from_bytes(data[4:8], "little")
        if command == 4:
            error = SdoError(self._node, request.index, request.subindex, value)
            self._advance(lambda: program.throw(error), now_s)
        elif isinstance(request, Write) and command == 3:
            self._advance(lambda: program.send(0), now_s)
        elif isinstance(request, Read) and command == 2 and data[0] & 0x02:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 0x01 else 4
            self._advance(lambda: program.send(value & (1 << 8 * size) - 1), now_s)

    def poll(self, now_s: float) -> None:
        """Let time pass.

        Raises:
            SdoError: nobody answers.
        """
        request, program = self._request, self._program
        if request is None or program is None or now_s < self._deadline_s:
            return
        if self._attempts < _ATTEMPTS:
            self._ask(request, now_s)
            return
        error = SdoError(self._node, request.index, request.subindex, 0)
        self._advance(lambda: program.throw(error), now_s)

    def _advance(self, step: Callable[[], Read | Write], now_s: float) -> None:
        try:
            self._request = step()
        except StopIteration:
            self._program = self._request = None
            return
        except SdoError:
            self._program = self._request = None
            raise
        self._attempts = 0
        self._ask(self._request, now_s)

    def _ask(self, request: Read | Write, now_s: float) -> None:
        self._attempts += 1
        self._deadline_s = now_s + _TIMEOUT_S
        head = request.index.to_bytes(2, "little") + bytes([request.subindex])
        if isinstance(request, Read):
            data = b"\x40" + head + bytes(4)
        else:
            value = request.value & (1 << 8 * request.size) - 1
            data = bytes([0x23 | (4 - request.size) << 2]) + head + value.to_bytes(4, "little")
        self._send(0x600 + self._node, data)
