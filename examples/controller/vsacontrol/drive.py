"""One drive of the controller's own: configured by SDO, enabled (CiA 402) and commanded in torque by RPDO.

What belongs to the daemon is not touched: from here come only one RPDO of each drive and its objects, the
mode, the torque limit and the drive's watch over this master (0x1016, 0x6007). The statusword is read out of
the frames that the daemon had mapped; where that is, is asked by SDO.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from drivelink.jointfile import JointFile
from vsacontrol.sdo import Client, Program, Read, SdoError, Write

__all__ = ["Drive", "PowerState", "Wiring", "wiring_of"]

_CYCLIC_TORQUE = 10  # 0x6060: cyclic synchronous torque mode
_ON_RECEPTION = 255  # transmission type: a safe torque must not wait for a SYNC that may never come
_MAP = (0x6040_0010, 0x6071_0010)
_INVALID = 1 << 31
_RPDO_BASE = (0x200, 0x300, 0x400, 0x500)
_DISABLE_VOLTAGE = 2  # 0x6007, when this master's heartbeat stays away
_NO_NMT_CHANGE = 1  # 0x1029:1, so that the daemon keeps its measurements even then
_RESET_S = 0.1  # from a fault to the first edge of fault reset, and between edges
_MOST_RESETS = 5  # without success; then somebody has to look at the drive
_RETRY_S = 1.0
_STATUS_MASK = 0x6F


class PowerState(IntEnum):
    """States of the drive by bits 0 to 3, 5, 6 of its statusword (CiA 402-2, table 29)."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


# The controlword that leads on towards operation enabled.
_ONWARD = {
    PowerState.SWITCH_ON_DISABLED: 0x06,
    PowerState.READY_TO_SWITCH_ON: 0x07,
    PowerState.SWITCHED_ON: 0x0F,
    PowerState.OPERATION_ENABLED: 0x0F,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Wiring:
    """One drive as the joint file says it.

    Attributes:
        node_id: its node id.
        gear_ratio: motor revolutions per joint revolution.
        torque_sign: of its torque against the joint's.
        rpdo: number of the RPDO that is taken.
    """

    node_id: int
    gear_ratio: float
    torque_sign: int
    rpdo: int = 3


def wiring_of(file: JointFile) -> tuple[Wiring, ...]:
    """The drives of a joint file.

    Raises:
        ValueError: a motor has no drive.
    """
    drives = [motor.drive for motor in file.motor]
    if any(drive is None for drive in drives):
        raise ValueError(f"{file.name}: expected [motor.drive] of every motor")
    return tuple(
        Wiring(
            node_id=drive.node_id,
            gear_ratio=drive.gear_ratio,
            torque_sign=drive.torque_direction or drive.direction,
        )
        for drive in drives
        if drive is not None
    )


class Drive:
    """One drive: configured by SDO, enabled by controlwords, commanded by RPDO.

    Attributes:
        state: by its last statusword.
        emergency: EMCY code that has not been reset, or 0.
        configured: its RPDO is ours.
        torque_unit_nm: joint torque of one per mille of rated torque.
        error: why it could not be configured.
    """

    def __init__(
        self,
        wiring: Wiring,
        own_id: int,
        limit_nm: float,
        watch_s: float,
        send: Callable[[int, bytes], None],
    ) -> None:
        self.wiring = wiring
        self.state: PowerState | None = None
        self.emergency = 0
        self.configured = False
        self.torque_unit_nm = math.nan
        self.error = ""
        self._own_id, self._limit_nm, self._send = own_id, limit_nm, send
        self._watch_ms = round(1e3 * watch_s)
        self._sdo = Client(wiring.node_id, send)
        self._rpdo_id = _RPDO_BASE[wiring.rpdo - 1] + wiring.node_id
        self.status_id = 0
        self._status_at = 0
        self._retry_s = 0.0
        self._edge_s = 0.0
        self._edge = False
        self._resets = 0

    @property
    def enabled(self) -> bool:
        """Whether it follows torque commands."""
        return self.configured and self.state is PowerState.OPERATION_ENABLED and not self.emergency

    @property
    def faulted(self) -> bool:
        """Whether it reports a fault."""
        return bool(self.emergency) or self.state in (PowerState.FAULT, PowerState.FAULT_REACTION)

    def forget(self) -> None:
        """It rebooted: its objects have their power-on values."""
        self.configured, self.state, self.status_id, self.emergency = False, None, 0, 0

    def configure(self, now_s: float) -> None:
        """Begin the configuration, if it is due."""
        if self.configured or self._sdo.busy or now_s < self._retry_s:
            return
        self._retry_s = now_s + _RETRY_S
        self._guarded(lambda: self._sdo.start(self._program(), now_s))

    def poll(self, now_s: float) -> None:
        """Let time pass."""
        self._guarded(lambda: self._sdo.poll(now_s))

    def answer(self, data: bytes, now_s: float) -> None:
        """An SDO response of this node."""
        self._guarded(lambda: self._sdo.feed(data, now_s))

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except SdoError as error:
            self.error = str(error)

    def _program(self) -> Program:
        rated_mnm = yield Read(0x6076)
        self.torque_unit_nm = rated_mnm * 1e-6 * self.wiring.gear_ratio
        limit = min(0xFFFF, math.floor(self._limit_nm / self.torque_unit_nm + 1e-6))
        yield from self._rpdo()
        yield Write(0x6072, 0, limit, 2)
        yield Write(0x6071, 0, 0, 2)
        yield Write(0x6060, 0, _CYCLIC_TORQUE, 1)
        yield Write(0x1016, 1, self._own_id << 16 | self._watch_ms, 4)
        for index, subindex, value, size in (
            (0x1029, 1, _NO_NMT_CHANGE, 1),
            (0x6007, 0, _DISABLE_VOLTAGE, 2),
        ):
            try:
                yield Write(index, subindex, value, size)
            except SdoError as error:
                if not error.code:
                    raise  # an abort only says that this drive has no such option
        yield from self._find_statusword()
        self.configured, self.error = True, ""

    def _rpdo(self) -> Program:
        """Map controlword and target torque, unless they are mapped already (or fixed)."""
        communication, mapping = 0x1400 + self.wiring.rpdo - 1, 0x1600 + self.wiring.rpdo - 1
        cob = yield Read(communication, 1)
        kind = yield Read(communication, 2)
        count = yield Read(mapping, 0)
        mapped: tuple[int, ...] = ()
        for k in range(min(count, 8)):
            mapped = (*mapped, (yield Read(mapping, k + 1)))
        if mapped == _MAP and kind == _ON_RECEPTION and not cob & _INVALID:
            self._rpdo_id = cob & 0x7FF
            return
        flags = cob & 1 << 30
        yield Write(communication, 1, _INVALID | flags | self._rpdo_id, 4)
        yield Write(communication, 2, _ON_RECEPTION, 1)
        if mapped != _MAP:
            yield Write(mapping, 0, 0, 1)
            for k, entry in enumerate(_MAP):
                yield Write(mapping, k + 1, entry, 4)
            yield Write(mapping, 0, len(_MAP), 1)
        yield Write(communication, 1, flags | self._rpdo_id, 4)

    def _find_statusword(self) -> Program:
        for number in range(4):
            try:
                cob = yield Read(0x1800 + number, 1)
                kind = yield Read(0x1800 + number, 2)
                count = yield Read(0x1A00 + number, 0)
            except SdoError as error:
                if not error.code:
                    raise
                continue
            bits = 0
            for k in range(count):
                entry = yield Read(0x1A00 + number, k + 1)
                if entry >> 8 == 0x6041_00 and not cob & _INVALID and kind <= 240:
                    self.status_id, self._status_at = cob & 0x7FF, bits // 8
                bits += entry & 0xFF
        if not self.status_id:
            raise SdoError(self.wiring.node_id, 0x6041, 0, 0x0604_0041)

    def take_status(self, data: bytes) -> None:
        """A TPDO that carries the statusword."""
        if len(data) >= self._status_at + 2:
            (word,) = struct.unpack_from("<H", data, self._status_at)
            code = word & _STATUS_MASK
            known = code if code & 0x08 == 0 and code & 0x60 != 0x40 else code & 0x4F
            self.state = PowerState(known) if known in set(PowerState) else None

    def take_emergency(self, data: bytes) -> None:
        """EMCY: code 0 means that the error is gone."""
        if len(data) == 8:
            self.emergency = int.from_bytes(data[:2], "little")

    def command(self, torque_nm: float, now_s: float) -> None:
        """Send controlword and torque; a torque counts only where operation is enabled."""
        word = self._controlword(now_s)
        per_mille = 0
        if self.enabled and math.isfinite(torque_nm):
            bounded = max(-self._limit_nm, min(self._limit_nm, torque_nm))
            per_mille = round(self.wiring.torque_sign * bounded / self.torque_unit_nm)
        self._send(self._rpdo_id, struct.pack("<Hh", word, per_mille))

    def release(self) -> None:
        """Shutdown, with no torque."""
        self._send(self._rpdo_id, struct.pack("<Hh", _ONWARD[PowerState.SWITCH_ON_DISABLED], 0))

    def _controlword(self, now_s: float) -> int:
        if self.state is not PowerState.FAULT:
            if self.enabled:
                self._resets = 0
            self._edge_s, self._edge = now_s, False
            return _ONWARD.get(self.state, 0x00) if self.state is not None else 0x00
        if now_s >= self._edge_s + _RESET_S and self._resets < _MOST_RESETS:
            self._edge_s, self._edge = now_s, not self._edge
            self._resets += self._edge
        return 0x80 if self._edge else 0x00
