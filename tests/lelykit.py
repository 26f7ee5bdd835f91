"""A slave of lely-core, an independent CANopen stack in C, on a bus in memory: its library, called by ctypes.

`DRIVELINK_LELY_CO` names a shared library that has liblely-co with can, util and libc in it (or liblely-co as
installed); where there is none, what it answered once is in `tests/transcripts/lely_*.txt`.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
from functools import cache
from pathlib import Path

_RESET_NODE = 0x81


class _Frame(ctypes.Structure):
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("flags", ctypes.c_uint8),
        ("len", ctypes.c_uint8),
        ("data", ctypes.c_uint8 * 64),
    )


class _Time(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


_Send = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.POINTER(_Frame), ctypes.c_void_p)
_POINTERS = ("can_net_create", "co_dev_create_from_dcf_file", "co_nmt_create")
_OF_POINTERS = {
    "can_net_set_send_func": (_Send, ctypes.c_void_p),
    "can_net_set_time": (ctypes.POINTER(_Time),),
    "can_net_recv": (ctypes.POINTER(_Frame),),
    "co_dev_set_id": (ctypes.c_uint8,),
    "co_dev_set_val_i16": (ctypes.c_uint16, ctypes.c_uint8, ctypes.c_int16),
    "co_dev_set_val_i32": (ctypes.c_uint16, ctypes.c_uint8, ctypes.c_int32),
    "co_nmt_cs_ind": (ctypes.c_uint8,),
}


@cache
def library() -> ctypes.CDLL | None:
    """The stack, if it is here."""
    path = os.environ.get("DRIVELINK_LELY_CO") or ctypes.util.find_library("lely-co")
    if not path:
        return None
    lely = ctypes.CDLL(path)
    for name in _POINTERS:
        getattr(lely, name).restype = ctypes.c_void_p
    lely.co_dev_create_from_dcf_file.argtypes = [ctypes.c_char_p]
    lely.co_nmt_create.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    for name, types in _OF_POINTERS.items():
        getattr(lely, name).argtypes = [ctypes.c_void_p, *types]
    return lely


class LelySlave:
    """One node, as `canopenkit.Wire` wants it: frames in, frames out. It lives as long as the process.

    Args:
        node: its node id.
        sheet: its EDS file.
    """

    def __init__(self, node: int, sheet: Path) -> None:
        lely = library()
        assert lely is not None
        self._lely = lely
        self._out: list[tuple[int, bytes]] = []
        self._kept = _Send(self._take)  # what C calls must not be collected
        self._net = lely.can_net_create()
        self._time_s = 0.0
        self.pass_time(0.0)
        lely.can_net_set_send_func(self._net, self._kept, None)
        self._device = lely.co_dev_create_from_dcf_file(str(sheet).encode())
        assert self._device, f"lely-core cannot read {sheet.name}"
        lely.co_dev_set_id(self._device, node)
        self._nmt = lely.co_nmt_create(self._net, self._device)
        lely.co_nmt_cs_ind(self._nmt, _RESET_NODE)
        self.booted = self._answers()

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """A frame in, and what the node answers."""
        frame = _Frame(cob_id, 0, len(data), (ctypes.c_uint8 * 64)(*data))
        self._lely.can_net_recv(self._net, ctypes.byref(frame))
        self.pass_time(0.001)
        return self._answers()

    def pass_time(self, seconds: float) -> None:
        """Let the node's clock go on."""
        self._time_s += seconds
        now = _Time(int(self._time_s), round(self._time_s % 1.0 * 1e9))
        self._lely.can_net_set_time(self._net, ctypes.byref(now))

    def put(self, index: int, value: int, bits: int) -> None:
        """Another value of an object, as an application would measure it."""
        set_value = self._lely.co_dev_set_val_i32 if bits == 32 else self._lely.co_dev_set_val_i16
        set_value(self._device, index, 0, value)

    def _take(self, frame: ctypes._Pointer[_Frame], _: object) -> int:
        one = frame.contents
        self._out.append((one.id, bytes(one.data[: one.len])))
        return 0

    def _answers(self) -> list[tuple[int, bytes]]:
        out, self._out = self._out, []
        return out
