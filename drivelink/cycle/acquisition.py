"""Frames in, one Sample per SYNC out (CiA 301, 7.2.2 and 7.2.5).

Frames after SYNC k and before SYNC k+1 belong to sample k. The sample is given out with the last frame it
needs. A frame that does not come leaves a gap: counted by node, never filled with an older value. What
comes after a missing frame may be the missing one, late: for a while such cycles are judged only at their
end, where a second frame shows the first to have been late, and are flagged.

No clock is read here: the same frames in the same order give the same samples, live or from a log. How
many periods have passed since the last SYNC is told by whoever has its stamp, by way of `SyncClock`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.frames import Slot, signal_targets
from drivelink.cycle.nodestate import NodeCounters, NodeState
from drivelink.errors import DriveError
from estimator.sample import Sample, Status

__all__ = ["SYNC_COB_ID", "Assembler"]

SYNC_COB_ID = 0x080
_DRIVE_FAULT = int(Status.DRIVE_FAULT)
_BUS_FAULT = int(Status.BUS_FAULT)
_UNTIMED = int(Status.UNTIMED)
_NODE_RESTARTED = int(Status.NODE_RESTARTED)
_CONFLICT_CYCLES = 20  # for which two different frames in one cycle discredit their sender
_MOST_OWED = 10  # frames that may come late in one go, after a stall of somebody
_DOUBT_CYCLES = 100  # after a missing frame or a SYNC too many: what comes may be one period late


class Assembler:
    """Makes the samples of one joint from the frames of its nodes.

    Args:
        layouts: the joint's nodes, as configured or as declared.
        motors: how many motors the joint has.
        active: whether we configure the nodes. Then a node that rebooted is believed again when it is
            started again; else `trust` alone makes it so.
        sync_cob_id: identifier of SYNC.
        hold_periods: how long the last value of a TPDO that is not sent on SYNC may be used while nothing
            at all is heard of its node; and how long one that is sent on SYNC may fail before a node that we
            configure is not believed any more, since it may have lost its mapping meanwhile.

    Attributes:
        sequence: number of the current SYNC, from 0; -1 before the first.
        missed: number of the cycle the last SYNC closed without a sample, or -1 if it had one.
        flags: service bits of `Status` that hold for the sample just given, or the cycle just missed.
        extra_syncs: SYNCs that were not due: another master makes them, or a frame is repeated.

    Raises:
        DriveError: two frames with one identifier, or a motor without position or torque.
    """

    def __init__(
        self,
        layouts: Sequence[NodeLayout],
        motors: int,
        *,
        active: bool = True,
        sync_cob_id: int = SYNC_COB_ID,
        hold_periods: int = 250,
    ) -> None:
        self._motors = motors
        self._active = active
        self._sync_cob_id = sync_cob_id
        self._hold_periods = hold_periods
        self._values = [math.nan] * (3 * motors + 2)
        self._nodes: dict[int, NodeState] = {}
        self._slots: dict[int, Slot] = {}
        self._handlers: dict[int, Callable[[int, bytes], None]] = {0: self._command}
        for layout in layouts:
            self._add(layout)
        self._arrange()
        self._open = self._spoiled = self._cycle_fault = self._restart = False
        self._faulted = 0
        self.sequence = self.missed = -1
        self.flags = 0
        self._untimed = 0  # cycles for which SYNCs of another master discredit the samples
        self.extra_syncs = 0

    @property
    def cob_ids(self) -> tuple[int, ...]:
        """Identifiers that concern this joint, SYNC aside."""
        return (*self._slots, *self._handlers)

    @property
    def counters(self) -> dict[int, NodeCounters]:
        """By node id."""
        return {node_id: node.counters for node_id, node in self._nodes.items()}

    @property
    def faults(self) -> dict[int, int]:
        """Nodes that report a fault, with the EMCY error code (0: by statusword only)."""
        return {n: node.emergency for n, node in self._nodes.items() if node.faulted or node.emergency}

    @property
    def statuswords(self) -> dict[int, int]:
        """Of the drives, as last heard, by node id."""
        return {n: node.statusword for n, node in self._nodes.items() if node.statusword >= 0}

    @property
    def untrusted(self) -> tuple[int, ...]:
        """Nodes that rebooted or were silent for long, and have not been started again."""
        return tuple(node_id for node_id, node in self._nodes.items() if not node.trusted)

    @property
    def has_link(self) -> bool:
        """Whether any frame carries the link position."""
        return any(field.target == 3 * self._motors for slot in self._needed for _place, field in slot.fields)

    @property
    def complete(self) -> bool:
        """Whether this cycle has given its sample: nothing more is expected before the next SYNC."""
        return not self._open

    def missing_nodes(self) -> tuple[int, ...]:
        """Nodes that the current cycle still waits for."""
        return tuple(dict.fromkeys(slot.node_id for slot in self._timed if not slot.arrived))

    def feed(self, cob_id: int, data: bytes, jump: int = 1) -> Sample | None:
        """Take one frame in the order of the bus, SYNC included.

        Args:
            cob_id: identifier of the frame.
            data: its bytes.
            jump: for a SYNC, whole periods since the one before; 0: one that was not due.

        Returns:
            The sample that this frame completes, if it does.
        """
        slot = self._slots.get(cob_id)
        if slot is not None:
            return self._pdo(slot, data)
        if cob_id == self._sync_cob_id:
            return self.sync(jump)
        handler = self._handlers.get(cob_id)
        if handler is not None:
            handler(cob_id, data)
            self._note_news()
        return None

    def sync(self, jump: int = 1) -> Sample | None:
        """A SYNC: close the cycle and open the next one; returns the sample if it was only now certain."""
        if jump <= 0:
            self.extra_syncs += 1
            self._spoiled = True  # what comes now answers that SYNC, or ours: nobody can tell
            self._untimed = _DOUBT_CYCLES
            for slot in self._timed:
                slot.suspect = _DOUBT_CYCLES  # nor of those that come after ours
            return None
        sample = self._close(jump)
        if self._untimed:
            self._untimed -= 1
        self.sequence += jump
        self._open = True
        self._spoiled = self._cycle_fault = False
        for slot in self._slots.values():
            slot.arrived = False
        self._awaited = len(self._timed)
        return sample

    def _close(self, jump: int) -> Sample | None:
        was_open, self._open = self._open, False
        self.missed = -1
        for slot in self._needed:
            if not slot.arrived:
                self._note_silence(slot, jump)
        if not was_open:
            return None
        if self._usable():
            for slot in self._timed:
                if slot.suspect:
                    slot.suspect -= 1
                    slot.owed = slot.owed if slot.suspect else 0
                    self._cycle_fault = True
            return self._sample()
        if self._note_missing() or self._spoiled or all(slot.arrived for slot in self._timed):
            self.missed = self.sequence
            self.flags = _BUS_FAULT | self._faulted
        return None

    def _note_silence(self, slot: Slot, periods: int) -> None:
        slot.silent += periods
        if self._active and slot.every and slot.silent > self._hold_periods:
            self._nodes[slot.node_id].trusted = False  # nobody knows what it has lived through

    def _note_missing(self) -> bool:
        """Count what has not come though it was due; whether there is any."""
        missing = False
        for slot in self._timed:
            if not slot.arrived and slot.silent >= slot.every:
                self._nodes[slot.node_id].counters.missing += 1
                slot.suspect = _DOUBT_CYCLES
                slot.owed = min(slot.owed + 1, _MOST_OWED)
                missing = True
            elif self._spoiled:
                slot.suspect = _DOUBT_CYCLES
        return missing

    def _certain(self) -> bool:
        """Whether no frame of this cycle can be that of an earlier one."""
        return not any(slot.suspect for slot in self._timed)

    def _usable(self) -> bool:
        """Whether everything a sample needs is there, and nothing speaks against it."""
        if self._spoiled:
            return False
        for slot in self._timed:
            if not slot.arrived or slot.conflict:
                return False
        for slot in self._held:
            if not slot.heard or slot.silent > self._hold_periods or not self._nodes[slot.node_id].trusted:
                return False
        return True

    def _pdo(self, slot: Slot, data: bytes) -> Sample | None:
        node = self._nodes[slot.node_id]
        if not slot.length <= len(data) <= slot.longest:
            node.counters.wrong_length += 1
            self._cycle_fault = True
            return None
        if not node.trusted:
            node.counters.ignored += 1
            return None
        if self.sequence < 0:
            return None
        if slot.arrived and slot.every:
            if not self._repeated(slot, node, data):
                return None
        elif slot.conflict:
            slot.conflict -= 1
        self._decode(slot, node, data)
        if not slot.arrived and slot.every and slot.needed:
            self._awaited -= 1
        slot.arrived = slot.heard = True
        slot.silent = 0
        node.counters.received += 1
        if self._awaited > 0:  # what follows would say no, but take longer
            return None
        if self._open and self._timed and slot.needed and self._usable() and self._certain():
            return self._sample()
        return None

    def _repeated(self, slot: Slot, node: NodeState, data: bytes) -> bool:
        """Whether a further frame in one cycle is the one that belongs to it."""
        if slot.suspect and data == slot.data:  # the same once more settles nothing
            node.counters.duplicate += 1
            return False
        if slot.suspect and not slot.conflict:  # the first was a late one of a cycle before
            slot.owed = max(slot.owed - 1, 0)
            if not slot.owed:
                slot.suspect = 0
            node.counters.late += 1
            self._cycle_fault = True
            return True
        node.counters.duplicate += 1
        if data != slot.data and not self._spoiled:  # two nodes answer, or somebody babbles: believe neither
            slot.conflict = _CONFLICT_CYCLES
            self._spoiled = True
            node.counters.conflicting += 1
        return False

    def _decode(self, slot: Slot, node: NodeState, data: bytes) -> None:
        counts = slot.decode(data)
        slot.data = data
        values = self._values
        for place, field in slot.fields:
            values[field.target] = field.take(counts[place])
        if slot.statusword >= 0:
            statusword = counts[slot.statusword]
            if statusword != node.statusword:
                node.take_statusword(statusword)
                self._note_news()

    def _sample(self) -> Sample:
        values, m = self._values, self._motors
        self._open = False
        flags = self._faulted
        if self._cycle_fault:
            flags |= _BUS_FAULT
        if self._untimed:
            flags |= _UNTIMED
        if self._restart:
            flags |= _NODE_RESTARTED
            self._restart = False
        self.flags = flags
        return Sample(
            self.sequence,
            tuple(values[:m]),
            tuple(values[m : 2 * m]),
            tuple(values[2 * m : 3 * m]),
            values[3 * m],
            values[3 * m + 1],
        )

    def supervise(self) -> None:
        """From now on `trust` alone makes a node believed again: somebody else may start it too."""
        for node in self._nodes.values():
            node.supervised = True

    def distrust(self, node_id: int) -> None:
        """Do not use what a node sends until it is started again."""
        self._nodes[node_id].trusted = False

    def trust(self, node_id: int) -> None:
        """A node has been configured and started."""
        self._nodes[node_id].trust()

    def relayout(self, layout: NodeLayout) -> None:
        """A node has been configured differently: from now on its frames are read by this layout.

        Raises:
            DriveError: as in the constructor; then everything is as it was.
        """
        slots, node = dict(self._slots), self._nodes[layout.node_id]
        before = list(node.slots)
        for slot in before:
            del self._slots[slot.cob_id]
        try:
            self._add(layout)
            self._arrange()
        except DriveError:
            self._slots, node.slots[:] = slots, before
            self._arrange()
            raise
        self._restart = True  # what is decoded anew may jump

    def _command(self, cob_id: int, data: bytes) -> None:
        if len(data) != 2:
            return
        for node_id, node in self._nodes.items():
            if data[1] in (0, node_id):
                node.command(cob_id, data)

    def _note_news(self) -> None:
        self._faulted = _DRIVE_FAULT if self.faults else 0
        for node in self._nodes.values():
            self._restart |= node.restarted
            node.restarted = False

    def _add(self, layout: NodeLayout) -> None:
        targets = signal_targets(layout.motor, self._motors)
        node = self._nodes.setdefault(layout.node_id, NodeState(self._active))
        node.slots.clear()
        self._handlers[0x700 + layout.node_id] = node.heartbeat
        self._handlers[0x080 + layout.node_id] = node.error
        for tpdo in layout.tpdos:
            if tpdo.cob_id in self._slots:
                raise DriveError(f"node {layout.node_id}: COB-ID 0x{tpdo.cob_id:03X} is used by two TPDOs")
            slot = self._slots[tpdo.cob_id] = Slot(layout, tpdo, targets)
            node.slots.append(slot)

    def _arrange(self) -> None:
        self._needed = [slot for slot in self._slots.values() if slot.needed]
        self._timed = [slot for slot in self._needed if slot.every]
        self._held = [slot for slot in self._needed if not slot.every]
        self._awaited = sum(not slot.arrived for slot in self._timed)
        found = {field.target for slot in self._needed for _place, field in slot.fields}
        for motor in range(self._motors):
            for target, what in ((motor, "position"), (2 * self._motors + motor, "torque")):
                if target not in found:
                    raise DriveError(f"motor {motor + 1}: no TPDO carries its {what}")
