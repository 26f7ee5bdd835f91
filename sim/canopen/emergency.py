"""Emergency producer: 0x1001, 0x1003, 0x1014, 0x1015 (CiA 301, 7.2.7)."""

from __future__ import annotations

import struct
from collections.abc import Callable

from sim.canopen.aborts import Abort, SdoAbortedError
from sim.canopen.dictionary import Dictionary
from sim.canopen.pdo import COB_INVALID
from sim.canopen.timers import Timers

_HISTORY = 8
_GENERIC = 0x01


class Emergency:
    """Active and past errors of one device, and the message when they change.

    Args:
        dictionary: holds 0x1001, 0x1003, 0x1014.
        timers: for the inhibit time.
        send: puts (identifier, data) on the bus.
    """

    def __init__(self, dictionary: Dictionary, timers: Timers, send: Callable[[int, bytes], None]) -> None:
        self._timers = timers
        self._send = send
        self._register = dictionary.find(0x1001, 0)
        self._cob = dictionary.find(0x1014, 0)
        self._inhibit = dictionary.optional(0x1015)
        self._count = dictionary.find(0x1003, 0)
        self._fields = [dictionary.find(0x1003, k) for k in range(1, _HISTORY + 1)]
        self._active: dict[int, int] = {}
        self._queue: list[bytes] = []
        self._inhibited = False
        self._count.check = self._check_clear
        self._count.changed = self._clear_history
        for number, entry in enumerate(self._fields, start=1):
            entry.refresh = self._reader(number)

    @property
    def active(self) -> bool:
        """Whether any error is."""
        return bool(self._active)

    def reset(self) -> None:
        """Forget all errors."""
        self._active.clear()
        self._queue.clear()
        self._inhibited = False
        self._register.value = 0
        self._clear_history()

    def raise_error(self, code: int, register: int = 0, vendor: bytes = b"") -> None:
        """Set an error; its message is sent once until it is cleared."""
        if code in self._active:
            return
        self._active[code] = register | _GENERIC
        self._update()
        for older, newer in zip(self._fields[:0:-1], self._fields[-2::-1], strict=True):
            older.value = newer.value
        self._fields[0].value = code | int.from_bytes(vendor[:2].ljust(2, b"\0"), "little") << 16
        self._count.value = min(self._count.number + 1, _HISTORY)
        self._emit(code, vendor)

    def clear_error(self, code: int) -> None:
        """Clear an error; after the last one the message "error reset" is sent."""
        if self._active.pop(code, None) is not None:
            self._update()
            self._emit(0, struct.pack("<H", code) if self._active else b"")

    def _update(self) -> None:
        register = 0
        for bits in self._active.values():
            register |= bits
        self._register.value = register

    def _emit(self, code: int, vendor: bytes) -> None:
        if not self._cob.number & COB_INVALID:
            self._queue.append(struct.pack("<HB5s", code, self._register.number, vendor))
            self._flush()

    def _flush(self) -> None:
        while self._queue and not self._inhibited:
            self._send(self._cob.number & 0x7FF, self._queue.pop(0))
            if self._inhibit.number:
                self._inhibited = True
                self._timers.after(self._inhibit.number * 1e-4, self._release)

    def _release(self) -> None:
        self._inhibited = False
        self._flush()

    def _check_clear(self, value: int) -> None:
        if value:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _clear_history(self) -> None:
        self._count.value = 0
        for entry in self._fields:
            entry.value = 0

    def _reader(self, number: int) -> Callable[[], None]:
        def refresh() -> None:
            if number > self._count.number:
                raise SdoAbortedError(Abort.NO_DATA)

        return refresh
