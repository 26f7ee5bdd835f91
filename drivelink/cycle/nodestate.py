"""What the bus says about a node besides its PDOs: NMT commands, boot-up, heartbeat, EMCY (CiA 301, 7.2.8).

Made from frames alone, so that a replayed log comes to the same judgement as the live run.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivelink.cycle.frames import Slot

__all__ = ["NodeCounters", "NodeState"]

_START = 0x01
_RESETS = (0x81, 0x82)  # node, communication
_FAULT_BIT = 0x0008  # of the statusword


@dataclass(slots=True)
class NodeCounters:
    """What became of one node's frames since the start.

    Attributes:
        received: PDOs of this node that were used.
        missing: frames that had not come when the next SYNC came.
        late: of these, frames that came in the cycle after.
        duplicate: frames beyond the one a cycle needs.
        conflicting: of the cycles with such frames, those in which they differed; not used.
        wrong_length: frames that do not carry what is mapped; not used.
        ignored: frames sent after a reboot, before the node was configured and started again.
        reboots: boot-up messages.
        emergencies: EMCY messages that report an error.
    """

    received: int = 0
    missing: int = 0
    late: int = 0
    duplicate: int = 0
    conflicting: int = 0
    wrong_length: int = 0
    ignored: int = 0
    reboots: int = 0
    emergencies: int = 0


class NodeState:
    """One node's standing: whether its frames are believed, and whether it reports a fault.

    A node that was reset may send its default PDOs, which look like ours and mean something else: it is
    not believed before it has been started again.

    Args:
        active: whether we configure the nodes. We start each by its own number when it is configured; a
            start of all nodes is somebody else's, and says nothing of their mapping. In a log, a start by its
            own number is taken for ours. Where somebody else configures them no start tells anything: see
            `MapFollower`.

    Attributes:
        supervised: somebody knows for sure when it is configured, and calls `trust`: no frame tells.
        counters: what became of its frames.
        slots: its TPDOs.
        trusted: whether its PDOs are used.
        statusword: as last heard, or -1.
        faulted: the fault bit of it.
        emergency: code of the last EMCY, 0 after its reset.
        restarted: its position counters may have started anew; for whoever reads it to clear.
    """

    __slots__ = (
        "_active",
        "counters",
        "emergency",
        "faulted",
        "restarted",
        "slots",
        "statusword",
        "supervised",
        "trusted",
    )

    def __init__(self, active: bool) -> None:
        self._active = active
        self.supervised = False
        self.counters = NodeCounters()
        self.slots: list[Slot] = []
        self.trusted = True
        self.statusword = -1
        self.faulted = False
        self.emergency = 0
        self.restarted = False

    def command(self, _cob_id: int, data: bytes) -> None:
        """An NMT command that is addressed to this node, or to all."""
        if data[0] == _START and self._active and not self.supervised and data[1]:
            self.trust()
        elif data[0] in _RESETS:
            self.trusted = False
            self.restarted = True  # it will; its boot-up message may get lost

    def trust(self) -> None:
        """From now on its frames mean what its layout says."""
        self.trusted = True
        for slot in self.slots:
            slot.silent = slot.owed = 0

    def heartbeat(self, _cob_id: int, data: bytes) -> None:
        """Boot-up (state 0) or heartbeat."""
        if len(data) != 1:
            return
        state = data[0] & 0x7F
        if state == 0:
            self.counters.reboots += 1
            self.trusted, self.faulted, self.emergency = False, False, 0
            self.statusword = -1
            self.restarted = True
            for slot in self.slots:
                slot.forget()
            return
        for slot in self.slots:
            if not slot.every:
                slot.silent = 0

    def error(self, _cob_id: int, data: bytes) -> None:
        """EMCY: a fault, until it is reset with code 0 or the statusword leaves its fault state."""
        if len(data) != 8:
            return
        code = data[0] | data[1] << 8
        self.emergency = code if code & 0xFF00 else 0
        self.counters.emergencies += self.emergency != 0

    def take_statusword(self, statusword: int) -> None:
        """The statusword has changed (CiA 402-2, 8.4.2)."""
        self.statusword = statusword
        faulted = bool(statusword & _FAULT_BIT)
        if self.faulted and not faulted:
            self.emergency = 0
        self.faulted = faulted
