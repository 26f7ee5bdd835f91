"""Watches one node: its counted frames, heartbeat, faults and statusword; every event is reported once."""

from __future__ import annotations

from typing import Any

from drivelink._core import Assembler, NodeCounters
from drivelink.canopen.emcy import drive_state
from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.loop import LoopJoint
from drivelink.daemon.status import EventLog

_NS = 1_000_000_000
_HEARTBEATS_LOST = 3.5  # of them missing: the node is gone
STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
OPERATIONAL = 0x05
_STATE_BITS, _ENABLED, _LIMIT = 0x6F, 0x27, 0x0800  # of the statusword (CiA 402-2, 8.4.2)
_COUNTED = (  # counter of a node; its smallest reported increase, message then, and message when it stops
    ("missing", 1, "frames are missing", "frames arrive again, {} were missing so far"),
    (
        "wrong_length",
        1,
        "frames of the wrong length are not used",
        "frames have the right length again, {} were wrong so far",
    ),
    (
        "conflicting",
        3,  # a single one may be a late frame
        "different frames in one cycle are not used: does another device have its node ID or identifiers?",
        "one frame per cycle again, {} cycles had several so far",
    ),
)


_BUNCHED = (
    "some frames are missing, others come several in one cycle and are not used: "
    "this machine or the bus is too slow for the cycle, or another device has its node id"
)
_BUNCH_NS = _NS // 5  # after a missing frame, when several in one cycle may be late ones
_BUNCHES_NS = _NS  # duration until it is reported


class WatchedNode:
    """The state of one node."""

    def __init__(self, layout: NodeLayout, loop_joint: LoopJoint, now_ns: int) -> None:
        self.layout = layout
        self.loop_joint = loop_joint
        self.started = False  # since its last frame
        self.enabled = False  # state of its drive at the last check
        self.failures = 0  # attempts to configure it since the last success
        self.unasked = 0  # SDO answers without a request, as reported
        self.begin(NodeCounters(), now_ns)

    def begin(self, counters: NodeCounters, now_ns: int) -> None:
        """Start from the present counters."""
        self.state = OPERATIONAL
        self.seen_ns = self.heartbeat_ns = self.attempt_ns = now_ns
        self.bunched_ns = 0  # start of missing and multiple frames; 0: none
        self.received = counters.received
        self.sent = counters.received + counters.ignored
        self.counted = {name: (getattr(counters, name), -_NS) for name, *_ in _COUNTED}

    @property
    def assembler(self) -> Assembler:
        """Of its joint."""
        return self.loop_joint.pipeline.assembler

    @property
    def state_text(self) -> str:
        """Its NMT state in words."""
        return STATES.get(self.state, f"0x{self.state:02X}")

    def status(self, now: int) -> dict[str, Any]:
        """Return its part of the status document, at a time in ns."""
        node, assembler = self.layout.node_id, self.assembler
        word, faults = assembler.statuswords.get(node), assembler.faults
        age_s = round((now - self.heartbeat_ns) / _NS, 3)
        return {
            "state": self.state_text,
            "heartbeat_age_s": age_s if self.layout.heartbeat_ms else None,
            "drive_state": drive_state(word) if word is not None else None,
            "internal_limit": word is not None and bool(word & _LIMIT),
            "fault": node in faults,
            "emergency": f"0x{faults[node]:04X}" if faults.get(node) else None,
            **assembler.counters[node].as_dict(),
        }

    def check_counters(self, events: EventLog, now: int) -> None:
        """Report missing, wrong and conflicting frames since the last call, at a time in ns."""
        node, counters = self.layout.node_id, self.assembler.counters[self.layout.node_id]
        for name, least, grows, stopped in _COUNTED:
            count, (before, since_ns) = getattr(counters, name), self.counted[name]
            if count - before >= least:
                self.counted[name] = (count, now)
                if name == "conflicting" and now - self.counted["missing"][1] < _BUNCH_NS:
                    self.bunched_ns = self.bunched_ns or now
                    if now - self.bunched_ns < _BUNCHES_NS:
                        continue  # a second device sends more frames, not fewer
                    grows = _BUNCHED
                events.begin(f"{name} {node}", f"node {node}: {grows}")
            elif now - since_ns > _NS:
                self.counted[name] = (count, now)
                if name == "conflicting":
                    self.bunched_ns = 0
                events.end(f"{name} {node}", f"node {node}: {stopped.format(count)}")

    def check(self, events: EventLog, now: int) -> None:
        """Report changes of heartbeat, fault and statusword since the last call, at a time in ns."""
        self._check_heartbeat(events, now)
        self._check_faults(events)
        self._check_statusword(events)

    def _check_heartbeat(self, events: EventLog, now: int) -> None:
        node = self.layout.node_id
        period_ms = self.layout.heartbeat_ms
        age_ms = (now - self.heartbeat_ns) / 1e6
        lost = bool(period_ms) and age_ms > max(_HEARTBEATS_LOST * period_ms, 50.0)
        events.keep(
            f"heartbeat {node}", lost, f"node {node}: heartbeat lost", f"node {node}: heartbeat is back"
        )

    def _check_faults(self, events: EventLog) -> None:
        node = self.layout.node_id
        faulted = node in self.assembler.faults
        text = f"node {node} reports a fault"
        events.keep(f"fault {node}", faulted, text, f"node {node} reports no fault")

    def _check_statusword(self, events: EventLog) -> None:
        """Report when a drive leaves operation enabled, or limits its set-point."""
        node = self.layout.node_id
        statusword = self.assembler.statuswords.get(node)
        if statusword is None:
            return
        enabled = statusword & _STATE_BITS == _ENABLED
        if enabled:
            events.end(f"enabled {node}", f"node {node}: operation is enabled again")
        elif self.enabled:
            state = drive_state(statusword)
            events.begin(
                f"enabled {node}", f"node {node} has left operation enabled ({state}): a brake may hold it"
            )
        self.enabled = enabled
        text = f"node {node}: internal limit active (statusword bit 11)"
        over = f"node {node}: no internal limit is active"
        events.keep(f"limit {node}", bool(statusword & _LIMIT), text, over)
