"""The controller's own CANopen master role: all drives of the joint, and its heartbeat.

It shares the bus with the daemon, which configures the TPDOs, starts the nodes and makes SYNC.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from vsacontrol.drive import Drive, Wiring

__all__ = ["Master"]

_HEARTBEAT_S = 0.02


class Master:
    """All drives of the joint.

    Args:
        drives: as wired.
        send: puts a frame (identifier, data) on the bus.
        limit_nm: largest torque, joint side; also set in the drive (0x6072).
        watch_s: after which a drive that does not hear this master's heartbeat switches off.
        node_id: of this master, for its heartbeat.
    """

    def __init__(
        self,
        drives: Sequence[Wiring],
        send: Callable[[int, bytes], None],
        *,
        limit_nm: float,
        watch_s: float = 0.1,
        node_id: int = 0x7E,
    ) -> None:
        self._send = send
        self._node_id = node_id
        self._beat_s = -math.inf
        self.drives = tuple(Drive(wiring, node_id, limit_nm, watch_s, send) for wiring in drives)
        self._by_node = {drive.wiring.node_id: drive for drive in self.drives}

    @property
    def enabled(self) -> bool:
        """Whether every drive follows torque commands."""
        return all(drive.enabled for drive in self.drives)

    @property
    def status_ids(self) -> tuple[int, ...]:
        """Identifiers of the frames that carry statuswords."""
        return tuple(drive.status_id for drive in self.drives)

    @property
    def faulted(self) -> bool:
        """Whether any drive reports a fault."""
        return any(drive.faulted for drive in self.drives)

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take a frame of the bus."""
        for drive in self.drives:
            if cob_id == drive.status_id:
                drive.take_status(data)
        node = self._by_node.get(cob_id & 0x7F)
        if node is None:
            return
        if cob_id & 0x780 == 0x580:
            node.answer(data, now_s)
        elif cob_id & 0x780 == 0x080:
            node.take_emergency(data)
        elif cob_id & 0x780 == 0x700 and data[:1] == b"\0":
            node.forget()

    def poll(self, now_s: float, *, may_configure: bool) -> None:
        """Heartbeat, and what is to be configured.

        Args:
            now_s: monotonic time.
            may_configure: the daemon is done with the nodes: estimates come in.
        """
        if now_s >= self._beat_s + _HEARTBEAT_S:
            self._beat_s = now_s
            self._send(0x700 + self._node_id, b"\x05")
        for drive in self.drives:
            if may_configure:
                drive.configure(now_s)
            drive.poll(now_s)

    def release(self) -> None:
        """Switch the drives' power stages off (transition 8, shutdown)."""
        for drive in self.drives:
            if drive.configured:
                drive.release()

    def command(self, torques_nm: Sequence[float], now_s: float) -> None:
        """Send every drive its controlword and torque."""
        for drive, torque in zip(self.drives, torques_nm, strict=True):
            if drive.configured:
                drive.command(torque, now_s)
