"""The drives of a joint as this controller uses them: set up by SDO, enabled (CiA 402), torque by one RPDO.

The daemon owns the bus (NMT, SYNC, TPDOs). From here come RPDO3 of each drive with its objects, mode and
torque limit, and a heartbeat by which a drive notices that this process is gone (0x1016, 0x6007).
"""

import math
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress

import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoError

from drivelink.jointfile import JointFile

OWN_NODE_ID = 0x7E
RPDO = 3
MAPPING = (0x6040_0010, 0x6071_0010)  # controlword, target torque
ON_RECEPTION = 255  # a torque of zero must not wait for a SYNC that may never come
RESET_S, MOST_RESETS = 0.1, 5  # between edges of fault reset; after so many somebody has to look at the drive
# By statusword & 0x6F (CiA 402-2): the controlword that leads on towards operation enabled.
ENABLED, FAULT, FAULT_REACTION = 0x27, 0x08, 0x0F
ONWARD = {0x40: 0x06, 0x21: 0x07, 0x23: 0x0F, ENABLED: 0x0F}


class Drive:
    """One drive: `ready` once it is set up, `state` of its last statusword, `fault_code` of its last EMCY."""

    def __init__(
        self, network: canopen.Network, joint: JointFile, motor: int, limit_nm: float, watch_s: float
    ):
        drive = joint.motor[motor].drive
        if drive is None:
            raise SystemExit(f"{joint.name}: expected [motor.drive] of every motor")
        self.network, self.node_id, self.limit_nm = network, drive.node_id, limit_nm
        self._gear, self._sign = drive.gear_ratio, drive.torque_direction or drive.direction
        self._watch_ms = round(1e3 * watch_s)
        self._node = network.add_node(self.node_id, canopen.ObjectDictionary())
        self._node.emcy.add_callback(lambda error: setattr(self, "fault_code", error.code))
        self._node.nmt.add_heartbeat_callback(lambda state: self.forget() if state == 0 else None)
        self.cob_id, self._status_at, self.unit_nm = 0x100 + 0x100 * RPDO + self.node_id, 0, math.nan
        self._edge_s, self._edge, self._resets = 0.0, False, 0
        self.forget()

    def forget(self) -> None:
        """Begin anew: the drive has rebooted."""
        self.ready, self.state, self.fault_code = False, None, 0

    @property
    def enabled(self) -> bool:
        """Whether it follows torque commands."""
        return self.ready and self.state == ENABLED and not self.fault_code

    @property
    def faulted(self) -> bool:
        """Whether it reports a fault."""
        return bool(self.fault_code) or self.state in (FAULT, FAULT_REACTION)

    def set_up(self) -> None:
        """Write what this controller needs of the drive; raises SdoError."""
        self.unit_nm = self._read(0x6076) * 1e-6 * self._gear  # of one per mille, at the joint
        self._map()
        self._write(0x6072, 0, "<H", min(0xFFFF, math.floor(self.limit_nm / self.unit_nm + 1e-6)))
        self._write(0x6071, 0, "<h", 0)
        self._write(0x6060, 0, "<b", 10)  # cyclic synchronous torque
        self._write(0x1016, 1, "<I", OWN_NODE_ID << 16 | self._watch_ms)
        for index, subindex, code, value in ((0x1029, 1, "<B", 1), (0x6007, 0, "<h", 2)):
            with suppress(SdoAbortedError):  # where there is the option: measure on, but disable voltage
                self._write(index, subindex, code, value)
        self._find_statusword()
        self.ready = True

    def _map(self) -> None:
        """Map controlword and target torque, unless they are mapped already (or fixed)."""
        communication, mapping = 0x1400 + RPDO - 1, 0x1600 + RPDO - 1
        cob = self._read(communication, 1)
        mapped = tuple(self._read(mapping, k + 1) for k in range(min(8, self._read(mapping))))
        if mapped == MAPPING and self._read(communication, 2) == ON_RECEPTION and not cob >> 31:
            self.cob_id = cob & 0x7FF
            return
        self._write(communication, 1, "<I", 1 << 31 | cob & 1 << 30 | self.cob_id)
        self._write(communication, 2, "<B", ON_RECEPTION)
        if mapped != MAPPING:
            self._write(mapping, 0, "<B", 0)
            for k, entry in enumerate(MAPPING):
                self._write(mapping, k + 1, "<I", entry)
            self._write(mapping, 0, "<B", len(MAPPING))
        self._write(communication, 1, "<I", cob & 1 << 30 | self.cob_id)

    def _find_statusword(self) -> None:
        """Learn in which of the daemon's TPDOs, sent with SYNC, the statusword is."""
        for number in range(4):
            try:
                cob, kind = self._read(0x1800 + number, 1), self._read(0x1800 + number, 2)
                entries = [self._read(0x1A00 + number, k + 1) for k in range(self._read(0x1A00 + number))]
            except SdoAbortedError:
                continue
            for k, entry in enumerate(entries):
                if entry >> 8 == 0x604100 and not cob >> 31 and kind <= 240:
                    self._status_at = sum(before & 0xFF for before in entries[:k]) // 8
                    self.network.subscribe(cob & 0x7FF, self._take_status)
                    return
        raise SdoError(f"node {self.node_id}: no TPDO carries the statusword (0x6041)")

    def _take_status(self, cob_id: int, data: bytearray, stamp_s: float) -> None:
        if len(data) >= self._status_at + 2:
            word = struct.unpack_from("<H", data, self._status_at)[0]
            self.state = word & (0x4F if word & 0x40 or word & 0x08 else 0x6F)

    def _read(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self._node.sdo.upload(index, subindex), "little")

    def _write(self, index: int, subindex: int, code: str, value: int) -> None:
        self._node.sdo.download(index, subindex, struct.pack(code, value))

    def command(self, torque_nm: float, now_s: float) -> None:
        """Send controlword and torque; a torque only where operation is enabled."""
        if not self.ready:
            return
        per_mille = 0
        if self.enabled and math.isfinite(torque_nm):
            bounded = max(-self.limit_nm, min(self.limit_nm, torque_nm))
            per_mille = round(self._sign * bounded / self.unit_nm)
        self.network.send_message(self.cob_id, struct.pack("<Hh", self._controlword(now_s), per_mille))

    def _controlword(self, now_s: float) -> int:
        if self.state != FAULT:
            self._resets = 0 if self.enabled else self._resets
            self._edge_s, self._edge = now_s, False
            return ONWARD.get(self.state, 0) if self.state is not None else 0
        if now_s >= self._edge_s + RESET_S and self._resets < MOST_RESETS:
            self._edge_s, self._edge = now_s, not self._edge
            self._resets += self._edge
        return 0x80 if self._edge else 0


class Master:
    """All drives of a joint, and the heartbeat, which comes from the loop: one that hangs is noticed."""

    def __init__(self, network: canopen.Network, joint: JointFile, limit_nm: float, watch_s: float = 0.1):
        self.network = network
        self.drives = [Drive(network, joint, i, limit_nm, watch_s) for i in range(len(joint.motor))]
        self._beat_s = self._try_s = -math.inf

    @property
    def states(self) -> dict[str, bool]:
        """Whether all drives follow torque commands, and whether any reports a fault."""
        enabled, faulted = all(d.enabled for d in self.drives), any(d.faulted for d in self.drives)
        return {"enabled": enabled, "faulted": faulted}

    def set_up(self, now_s: float) -> None:
        """Set up one drive that is not ready, at most one try in a second; blocks for its SDO transfers."""
        todo = [drive for drive in self.drives if not drive.ready]
        if todo and now_s >= self._try_s:
            try:
                todo[0].set_up()
            except SdoError as error:
                self._try_s = now_s + 1.0
                print(f"node {todo[0].node_id}: {error}", file=sys.stderr, flush=True)

    def command(self, torques_nm: Sequence[float], now_s: float) -> None:
        """Send the heartbeat when it is due, and every drive its controlword and torque."""
        if now_s >= self._beat_s + 0.02:
            self._beat_s = now_s
            self.network.send_message(0x700 + OWN_NODE_ID, b"\x05")
        for drive, torque in zip(self.drives, torques_nm, strict=True):
            drive.command(torque, now_s)

    def release(self) -> None:
        """Take the torque away and switch the power stages off (shutdown)."""
        for drive in self.drives:
            if drive.ready:
                self.network.send_message(drive.cob_id, struct.pack("<Hh", 0x06, 0))
