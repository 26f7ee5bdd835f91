"""Supervises the nodes beside the cycle: heartbeats, EMCY, reboots, and the recovery from each.

A node that rebooted, fell silent or left the operational state is configured again by the Configurator,
stepwise in the slack. A passive daemon only observes. Every event is reported once.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from drivelink._core import NodeCounters
from drivelink.canopen.configure import Configurator
from drivelink.canopen.emcy import drive_state, parse_emergency
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator, is_mapping
from drivelink.canopen.sdo_sniffer import written_object
from drivelink.cycle.following import MapFollower
from drivelink.cycle.framesource import OVERFLOW, LostSource
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.objectcheck import ObjectCheck
from drivelink.cycle.pipeline import ResidualMonitor
from drivelink.cycle.syncclock import MEASURED_SYNCS, measure_period
from drivelink.daemon.crosschecks import contradiction
from drivelink.daemon.readback import ReadBack
from drivelink.daemon.status import EventLog
from drivelink.errors import DriveError
from estimator.sample import Status

logger = logging.getLogger(__name__)

_NS = 1_000_000_000
_SILENT_NS = _NS // 2  # time without a PDO until the node is configured again
_RETRY_NS = _NS  # between two attempts
_MANY_SYNCS = 3  # SYNCs beyond the number of periods in a second
_HEARTBEATS_LOST = 3.5  # of them missing: the node is gone
_STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
_OPERATIONAL = 0x05
_STATE_BITS, _ENABLED, _LIMIT = 0x6F, 0x27, 0x0800  # of the statusword (CiA 402-2, 8.4.2)
_BOOT_UP, _STOPPED = 0x00, 0x04
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


_MODEL_ALARM = int(Status.MODEL_ALARM)
_BRIEF = ("impossible", "jumped")  # of single samples, reported by their status bit
_BUNCHED = (
    "some frames are missing, others come several in one cycle and are not used: "
    "this machine or the bus is too slow for the cycle, or another device has its node id"
)
_BUNCH_NS = _NS // 5  # after a missing frame, when several in one cycle may be late ones
_BUNCHES_NS = _NS  # duration until it is reported


class _Watched:
    """The state of one node."""

    __slots__ = (
        "attempt_ns",
        "bunched_ns",
        "counted",
        "enabled",
        "heartbeat_ns",
        "layout",
        "loop_joint",
        "received",
        "seen_ns",
        "sent",
        "started",
        "state",
        "unasked",
    )

    def __init__(self, layout: NodeLayout, loop_joint: LoopJoint, now_ns: int) -> None:
        self.layout = layout
        self.loop_joint = loop_joint
        self.started = False  # since its last frame
        self.enabled = False  # state of its drive at the last check
        self.unasked = 0  # SDO answers without a request, as reported
        self.begin(NodeCounters(), now_ns)

    def begin(self, counters: NodeCounters, now_ns: int) -> None:
        """Start from the present counters."""
        self.state = _OPERATIONAL
        self.seen_ns = self.heartbeat_ns = self.attempt_ns = now_ns
        self.bunched_ns = 0  # start of missing and multiple frames; 0: none
        self.received = counters.received
        self.sent = counters.received + counters.ignored
        self.counted = {name: (getattr(counters, name), -_NS) for name, *_ in _COUNTED}


class Supervisor:
    """Heartbeats, faults and reconfiguration of all nodes of the loop.

    Args:
        loop: its listeners are set.
        layouts: of each loop_joint's nodes.
        events: the event log.
        configurator: configures nodes again or, passive, follows another master.

    Attributes:
        sync_period_s: last measured period of the followed master; None: not yet, or SYNC is produced.
    """

    def __init__(
        self,
        loop: CycleLoop,
        layouts: Mapping[LoopJoint, tuple[NodeLayout, ...]],
        events: EventLog,
        configurator: Configurator | PassiveConfigurator,
    ) -> None:
        self._loop = loop
        self._events = events
        self._alarmed: set[str] = set()  # joints with a model alarm
        self._configurator = configurator
        self._follower: MapFollower | None = None
        self._read_back: ReadBack | None = None
        self._counter_jumps = self._lost_sends = self._clock_steps = 0
        self._bus_offs = self._restarts = self._measured_ns = 0
        self._slow = self._slow_ns = 0
        self._off_period = 0  # consecutive measurements
        self._foreign = deque([(loop.clock(), 0, 0)])  # in the last second: SYNCs not due, periods without
        self.sync_period_s: float | None = None
        loop.on_fault = self._say_fault
        self._due: dict[int, tuple[NodeLayout, int]] = {}  # configured nodes, and the SYNC before their start
        self._nodes: dict[int, _Watched] = {}
        for loop_joint, mine in layouts.items():
            loop_joint.pipeline.assembler.supervise()
            for layout in mine:
                self._nodes[layout.node_id] = _Watched(layout, loop_joint, loop.clock())
                loop.listeners[0x700 + layout.node_id] = self._heartbeat
                loop.listeners[0x080 + layout.node_id] = self._emergency
                loop.listeners[0x580 + layout.node_id] = self._answer
                loop.listeners[0x600 + layout.node_id] = self._foreign_request
        if isinstance(configurator, PassiveConfigurator):
            self._follow(configurator)
        elif configurator.bus.read_back_s:
            section = configurator.bus
            self._read_back = ReadBack(
                configurator.ask, section.read_back_s, ObjectCheck(section.sdo_timeout_s)
            )
            for watched in self._nodes.values():
                self._read_back.watch(watched.layout, watched.loop_joint.pipeline)
            loop.on_sent = self._sent
            loop.after_sync.append(self._check_objects)
        loop.after_sync.append(self._use_configured)

    def _follow(self, configurator: PassiveConfigurator) -> None:
        """Follow another master's mapping: process its frames in bus order."""
        loop, nodes = self._loop, self._nodes
        self._follower = MapFollower(
            configurator,
            {node: watched.loop_joint.pipeline.assembler for node, watched in nodes.items()},
            {node: watched.layout for node, watched in nodes.items()},
            self._listen_anew,
        )
        loop.listeners[0] = self._overhear
        for node in nodes:
            loop.listeners[0x580 + node] = loop.listeners[0x600 + node] = self._overhear
        loop.after_sync.append(self._follower.sync)

    def _overhear(self, cob_id: int, data: bytes) -> None:
        if self._follower is not None:
            self._follower.feed(cob_id, data, self._loop.clock() / _NS)

    @property
    def receive_ids(self) -> tuple[int, ...]:
        """Identifiers it listens to."""
        return tuple(self._loop.listeners)

    def contradiction(self, loop_joint: LoopJoint) -> dict[str, Any] | None:
        """The reading that a second one contradicts, see `crosschecks`; None: none."""
        pipeline = loop_joint.pipeline
        found = contradiction(pipeline.assembler)
        if found is None and self._read_back is not None:
            found = self._read_back.contradiction(pipeline.assembler)
        return found

    def node_status(self, loop_joint: LoopJoint) -> dict[str, Any]:
        """State of one joint's nodes, for the status key."""
        now = self._loop.clock()
        counters = loop_joint.pipeline.assembler.counters
        faults, statuswords = loop_joint.pipeline.assembler.faults, loop_joint.pipeline.assembler.statuswords
        status: dict[str, Any] = {}
        for node, watched in self._nodes.items():
            if watched.loop_joint is not loop_joint:
                continue
            counted = counters[node]
            status[str(node)] = {
                "state": _STATES.get(watched.state, f"0x{watched.state:02X}"),
                "heartbeat_age_s": round((now - watched.heartbeat_ns) / _NS, 3)
                if watched.layout.heartbeat_ms
                else None,
                "drive_state": str(drive_state(statuswords[node])) if node in statuswords else None,
                "internal_limit": node in statuswords and bool(statuswords[node] & _LIMIT),
                "fault": node in faults,
                "emergency": f"0x{faults[node]:04X}" if faults.get(node) else None,
                **counted.as_dict(),
            }
        return status

    def step(self, now_ns: int) -> None:
        """Advance running configurations."""
        if self._configurator.busy and self._follower is None:
            self._proceed(now_ns)
        elif self._read_back is not None:
            self._read_back.step(now_ns / _NS)

    def _check_objects(self) -> None:
        """At a SYNC, configure nodes anew that say something else by SDO than is in use."""
        for found in self._read_back.check.sync() if self._read_back is not None else ():
            self._nodes[found.node].attempt_ns = self._loop.clock()
            text = f"{found.text}: it is configured again"
            self._events.say(text, logging.WARNING, key=f"read back {found.node}")
            self._configure(found.node)

    def _configure(self, node: int, *, stopped: bool = False) -> None:
        """Begin to configure a node."""
        self._due.pop(node, None)
        self._configurator.start(node, stopped=stopped)

    def _proceed(self, now_ns: int) -> None:
        configurator = self._configurator
        for node, result in configurator.poll(now_ns / _NS):
            watched = self._nodes[node]
            watched.attempt_ns = watched.seen_ns = now_ns
            if not isinstance(result, NodeLayout):
                self._events.begin(f"configure {node}", f"node {node} cannot be configured: {result}")
                continue
            self._due[node] = result, self._loop.syncs

    def _use_configured(self) -> None:
        """At a SYNC, use the nodes that were started before it: from here on a log shows it, too."""
        for node, (result, started) in list(self._due.items()):
            if self._loop.cycles <= started:
                continue
            del self._due[node]
            watched = self._nodes[node]
            if result.tpdos != watched.layout.tpdos:
                try:
                    watched.loop_joint.pipeline.assembler.relayout(result)
                except DriveError as error:  # what it has answered cannot be
                    self._events.begin(f"configure {node}", f"node {node} cannot be configured: {error}")
                    continue
                self._loop.reroute()
                self._events.say(f"node {node} has another mapping now: {_maps(result)}")
            watched.layout = result
            if self._read_back is not None:
                self._read_back.watch(result, watched.loop_joint.pipeline)
            self._events.end(f"configure {node}")
            watched.loop_joint.pipeline.assembler.trust(node)
            if not watched.started:
                self._events.say(f"node {node} is configured again and started")
            watched.started = True

    def check(self) -> None:
        """Check for changes since the last call; a few tens of microseconds."""
        if isinstance(self._loop.source, LostSource):
            return  # already reported; silence says nothing about the nodes now
        now = self._loop.clock()
        for node, watched in self._nodes.items():
            self._check_frames(node, watched, now)
            self._check_heartbeat(node, watched, now)
            self._check_faults(node, watched)
            self._check_statusword(node, watched)
        for loop_joint in self._loop.loop_joints:
            self._check_joint(loop_joint)
            self._check_model(loop_joint)
            self._check_contradiction(loop_joint)
            self._check_readings(loop_joint)
        if self._follower is not None:
            self._check_maps(self._follower)
        self._check_bus()

    def _listen_anew(self) -> None:
        self._loop.reroute()
        self._loop.source.narrow(self._loop.receive_ids())

    def _check_maps(self, follower: MapFollower) -> None:
        for node, layout in follower.changed.items():
            watched = self._nodes[node]
            if layout.tpdos != watched.layout.tpdos:
                self._events.say(f"node {node} has another mapping now: {_maps(layout)}")
            watched.layout = layout
        follower.changed.clear()
        for node in self._nodes:
            if node in follower.doubts:
                self._events.begin(f"mapping {node}", follower.doubts[node])
            else:
                self._events.end(f"mapping {node}", f"node {node}: its mapping is known, its frames are used")
            watched, unasked = self._nodes[node], follower.unasked(node)
            if unasked > watched.unasked:
                watched.unasked = unasked
                text = f"node {node}: {unasked} SDO answers so far belong to no request heard: not used"
                self._events.say(text, logging.WARNING, key=f"unasked {node}")

    def _check_joint(self, loop_joint: LoopJoint) -> None:
        if loop_joint.fault:
            self._events.begin(
                f"joint {loop_joint.name}",
                f"{loop_joint.name}: no estimates since {loop_joint.fault}; rewrite its joint file or "
                "restart the daemon",
                logging.ERROR,
            )
        else:
            self._events.end(f"joint {loop_joint.name}", f"{loop_joint.name}: estimates restart")

    def _check_model(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of the model alarm, its amount and what to do."""
        status = loop_joint.pipeline.status
        if status is None:
            return
        alarm = bool(status & _MODEL_ALARM)
        if alarm == (loop_joint.name in self._alarmed):
            return
        monitor = loop_joint.pipeline.model_monitor
        if alarm:
            self._alarmed.add(loop_joint.name)
            self._events.say(
                f"{loop_joint.name}: model alarm{residual_text(monitor)}: do not control on its numbers; "
                "record a minute of motion, then drivelink diagnose names the effect",
                logging.WARNING,
                key=f"{loop_joint.name}: model alarm",
            )
        else:
            self._alarmed.discard(loop_joint.name)
            text = f"{loop_joint.name}: the model alarm is over{residual_text(monitor)}"
            self._events.say(text, key=f"{loop_joint.name}: no model alarm")

    def _check_contradiction(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of a contradiction between readings."""
        key, found = f"contradiction {loop_joint.name}", self.contradiction(loop_joint)
        if found is None:
            self._events.end(key, f"{loop_joint.name}: no reading contradicts another")
        else:
            self._events.begin(key, f"{loop_joint.name}: {found['text']}")

    def _check_readings(self, loop_joint: LoopJoint) -> None:
        """Report begin and end of a suspicion against a reading."""
        suspicion = (
            loop_joint.pipeline.estimator.suspicion() if loop_joint.pipeline.status is not None else None
        )
        key = f"reading {loop_joint.name}"
        if suspicion is None:
            self._events.end(key, f"{loop_joint.name}: no reading is suspected")
        elif suspicion["reason"] not in _BRIEF:
            self._events.begin(key, f"{loop_joint.name}: no valid estimates; suspected: {suspicion['text']}")

    def _say_fault(self, where: str, error: Exception) -> None:
        logger.debug("%s", where, exc_info=error)
        kind = type(error).__name__
        self._events.say(f"{where}: {kind}: {error}", logging.ERROR, key=f"{where}: {kind}")

    def reconfigure_all(self) -> None:
        """Configure all nodes again after a loss of the bus."""
        for node, watched in self._nodes.items():
            assembler = watched.loop_joint.pipeline.assembler
            if isinstance(self._configurator, Configurator):
                assembler.distrust(node)
            watched.begin(assembler.counters[node], self._loop.clock())
            self._configure(node)
        if self._follower is not None:
            self._follower.lose_sight()

    def _check_frames(self, node: int, watched: _Watched, now: int) -> None:
        assembler = watched.loop_joint.pipeline.assembler
        counters = assembler.counters[node]
        for name, least, grows, stopped in _COUNTED:
            count, (before, since_ns) = getattr(counters, name), watched.counted[name]
            if count - before >= least:
                watched.counted[name] = (count, now)
                if name == "conflicting" and now - watched.counted["missing"][1] < _BUNCH_NS:
                    watched.bunched_ns = watched.bunched_ns or now
                    if now - watched.bunched_ns < _BUNCHES_NS:
                        continue  # a second device sends more frames, not fewer
                    grows = _BUNCHED
                self._events.begin(f"{name} {node}", f"node {node}: {grows}")
            elif now - since_ns > _NS:
                watched.counted[name] = (count, now)
                if name == "conflicting":
                    watched.bunched_ns = 0
                self._events.end(f"{name} {node}", f"node {node}: {stopped.format(count)}")
        if counters.received + counters.ignored != watched.sent:
            watched.sent = counters.received + counters.ignored
            if watched.state == _BOOT_UP or now - watched.heartbeat_ns > _NS:
                watched.state = _OPERATIONAL  # required for PDOs, and no other state is reported
        if counters.received != watched.received:
            watched.received, watched.seen_ns = counters.received, now
            watched.started = False
            self._events.end(f"start {node}", f"node {node} sends its frames")
        lost = now - watched.seen_ns > _SILENT_NS or node in assembler.untrusted
        lost = lost or (watched.state != _OPERATIONAL and now - watched.heartbeat_ns < _NS)
        if lost and not self._configurator.busy and now - watched.attempt_ns > _RETRY_NS:
            watched.attempt_ns = now
            self._configure(node, stopped=watched.state == _STOPPED)
            if watched.started:
                self._say_unstarted(node, watched)

    def _say_unstarted(self, node: int, watched: _Watched) -> None:
        state = _STATES.get(watched.state, f"0x{watched.state:02X}")
        code = watched.loop_joint.pipeline.assembler.faults.get(node)
        why = f" and EMCY 0x{code:04X}: its error may need a reset or a power cycle" if code else ""
        self._events.begin(
            f"start {node}",
            f"node {node} is configured and was started, but sends none of its frames; it says {state}{why}",
        )

    def _check_heartbeat(self, node: int, watched: _Watched, now: int) -> None:
        period_ms = watched.layout.heartbeat_ms
        age_ms = (now - watched.heartbeat_ns) / 1e6
        if period_ms and age_ms > max(_HEARTBEATS_LOST * period_ms, 50.0):
            self._events.begin(f"heartbeat {node}", f"node {node}: heartbeat lost")
        else:
            self._events.end(f"heartbeat {node}", f"node {node}: heartbeat is back")

    def _check_faults(self, node: int, watched: _Watched) -> None:
        faulted = node in watched.loop_joint.pipeline.assembler.faults
        if faulted:
            self._events.begin(f"fault {node}", f"node {node} reports a fault")
        else:
            self._events.end(f"fault {node}", f"node {node} reports no fault")

    def _check_statusword(self, node: int, watched: _Watched) -> None:
        """Report when a drive leaves operation enabled, or limits its set-point."""
        statusword = watched.loop_joint.pipeline.assembler.statuswords.get(node)
        if statusword is None:
            return
        enabled = statusword & _STATE_BITS == _ENABLED
        if enabled:
            self._events.end(f"enabled {node}", f"node {node}: operation is enabled again")
        elif watched.enabled:
            state = drive_state(statusword)
            self._events.begin(
                f"enabled {node}", f"node {node} has left operation enabled ({state}): a brake may hold it"
            )
        watched.enabled = enabled
        if statusword & _LIMIT:
            self._events.begin(f"limit {node}", f"node {node}: internal limit active (statusword bit 11)")
        else:
            self._events.end(f"limit {node}", f"node {node}: no internal limit is active")

    def _check_bus(self) -> None:
        loop = self._loop
        self._check_foreign_syncs()
        self._check_period()
        self._check_speed()
        if loop.counter_jumps != self._counter_jumps:
            self._counter_jumps = loop.counter_jumps
            self._events.say(
                f"the SYNC counter jumped, {self._counter_jumps} times so far", key="SYNC counter jumped"
            )
        if loop.clock_steps != self._clock_steps:
            self._clock_steps = loop.clock_steps
            self._events.say(
                f"the system's clock was set by {loop.clock_step_ns / _NS:+.3f} s: stamps follow it, "
                "the cycle does not",
                key="clock set forward" if loop.clock_step_ns > 0 else "clock set back",
            )
        if loop.silent:
            self._events.begin("no sync", "no SYNC on the bus: the estimates are stale", logging.ERROR)
        else:
            self._events.end("no sync", "SYNC is back")
        if loop.source.lost_sends != self._lost_sends:
            self._lost_sends = loop.source.lost_sends
            if self._lost_sends:
                self._events.begin(
                    "full queue", "the transmit queue is full: SYNC is lost; is any node on the bus?"
                )
        else:
            self._events.end("full queue", "the transmit queue drains again")

        self._check_controller()

    def _check_foreign_syncs(self) -> None:
        """Check whether two masters produce SYNC.

        When following, SYNCs that are not due prove nothing: one master produces some if it skips as many
        periods. Two masters produce more SYNCs than periods.
        """
        loop, now = self._loop, self._loop.clock()
        self._foreign.append((now, loop.foreign_syncs, loop.skipped_periods))
        while now - self._foreign[0][0] > _NS:
            self._foreign.popleft()
        _, foreign, skipped = self._foreign[0]
        if loop.produce and loop.foreign_syncs > foreign:
            what = (
                "another master produces SYNC: its cycles are not used; "
                'set bus.sync = "follow", or stop the other one'
            )
        elif (loop.foreign_syncs - foreign) - (loop.skipped_periods - skipped) >= _MANY_SYNCS:
            what = "a second master produces SYNC too: its cycles are not used; stop one of the two"
        else:
            self._events.end("foreign sync", "the other master stopped producing SYNC")
            return
        self._events.begin("foreign sync", what, logging.ERROR)

    def _check_period(self) -> None:
        """Check that the followed master still has the period used by the estimators."""
        loop, now = self._loop, self._loop.clock()
        if loop.produce or now - self._measured_ns < _NS or len(loop.sync_stamps) < MEASURED_SYNCS:
            return
        self._measured_ns = now
        used_s = loop.period_ns / _NS
        measured = measure_period(list(loop.sync_stamps), used_s)
        if measured is None:
            return
        self.sync_period_s = measured.period_s
        self._off_period = 0 if measured.same else self._off_period + 1
        if measured.same:
            self._events.end("period", f"SYNC comes every {used_s * 1e3:g} ms again")
        elif self._off_period > 1:  # once may have been a stall
            self._events.begin(
                "period",
                f"SYNC comes every {measured.period_s * 1e3:.4g} ms now, {used_s * 1e3:g} ms is in use: "
                "cycles are lost or doubled until the master returns to it or the daemon is restarted",
                logging.ERROR,
            )

    def _check_speed(self) -> None:
        """Check that this machine keeps up with the cycle."""
        loop, now = self._loop, self._loop.clock()
        unread = loop.source.errors.get(OVERFLOW, 0)
        total = loop.overruns + loop.behind + unread
        if total > self._slow:
            self._slow, self._slow_ns = total, now
            counted = [
                f"{loop.overruns} cycles left out so far" if loop.overruns else "",
                f"{loop.behind} SYNCs read more than a period late" if loop.behind else "",
                f"{unread} frames lost unread" if unread else "",
            ]
            self._events.begin(
                "too slow",
                f"this machine is too slow for the cycle of {loop.period_ns / 1e6:g} ms: "
                f"{', '.join(filter(None, counted))}; drivelink doctor names the cause",
            )
        elif now - self._slow_ns > _NS:
            self._slow = total  # the count restarts with a reopened bus
            text = f"this machine keeps up with the cycle again; {loop.overruns} cycles were left out"
            self._events.end("too slow", text)

    def _check_controller(self) -> None:
        errors = self._loop.source.errors
        bus_offs, restarts = errors.get("bus-off", 0), errors.get("restarted", 0)
        if bus_offs > self._bus_offs:
            self._events.begin(
                "bus-off",
                "the CAN controller is bus-off: check wiring, termination and bit rate; it stays so unless "
                "restart-ms is set for the interface",
                logging.ERROR,
            )
        if restarts > self._restarts:
            self._events.end("bus-off", "the CAN controller is on the bus again")
        self._bus_offs, self._restarts = bus_offs, restarts

    def _heartbeat(self, cob_id: int, data: bytes) -> None:
        if len(data) != 1:
            return
        node = cob_id - 0x700
        watched = self._nodes[node]
        watched.heartbeat_ns = self._loop.clock()
        state = data[0] & 0x7F
        if state == 0:  # every time: it may reboot while being configured
            self._events.say(f"node {node} has rebooted", logging.WARNING)
            watched.attempt_ns = watched.heartbeat_ns
            self._configure(node)
            if self._follower is not None:  # its heartbeat has its default again
                watched.layout = replace(watched.layout, heartbeat_ms=0)
        self._overhear(cob_id, data)
        if state in _STATES:
            watched.state = state

    def _emergency(self, cob_id: int, data: bytes) -> None:
        emergency = parse_emergency(data)
        if emergency is not None and not emergency.is_reset:
            node, code = cob_id - 0x080, emergency.code
            self._events.say(f"node {node}: {emergency}", logging.WARNING, key=f"EMCY {node} {code}")

    def _sent(self, cob_id: int, data: bytes) -> None:
        if self._read_back is not None and 0x600 < cob_id < 0x680:
            self._read_back.check.request(cob_id - 0x600, data, self._loop.clock() / _NS)

    def _answer(self, cob_id: int, data: bytes) -> None:
        now_ns = self._loop.clock()
        if self._read_back is not None:
            self._read_back.check.response(cob_id - 0x580, data, now_ns / _NS)
            if not self._configurator.busy:
                self._read_back.feed(cob_id, data, now_ns / _NS)
                return
        self._configurator.feed(cob_id, data, now_ns / _NS)
        self._proceed(now_ns)  # do not decode its frames by the old layout

    def _foreign_request(self, cob_id: int, data: bytes) -> None:
        """Somebody else talks to a node by SDO; our own frames are not heard."""
        self._sent(cob_id, data)
        if self._read_back is not None:
            self._read_back.feed(cob_id, data, self._loop.clock() / _NS)
        node, address = cob_id - 0x600, written_object(data)
        if address is not None and is_mapping(address):
            self._nodes[node].loop_joint.pipeline.assembler.distrust(node)
            text = f"node {node}: somebody else writes its mapping: it is configured again"
            self._events.say(text, logging.WARNING)


def _maps(layout: NodeLayout) -> str:
    return ", ".join(
        f"0x{tpdo.cob_id:03X} = " + " ".join(f"{o.index:04X}:{o.subindex:02X}" for o in tpdo.objects)
        for tpdo in layout.tpdos
    )


def residual_text(monitor: ResidualMonitor | None) -> str:
    """The residual against its baseline in words, if known."""
    described = monitor.describe() if monitor is not None else {}
    residuals, baselines = described.get("residual_nm") or (), described.get("floor_nm") or ()
    ratios = [r / b for r, b in zip(residuals, baselines, strict=False) if b > 0.0 and math.isfinite(r)]
    where = f", likely at the {described['location']}" if described.get("location") else ""
    return f": the residual is {max(ratios):.2g} times its baseline{where}" if ratios else ""
