"""Supervises the nodes beside the cycle: heartbeats, EMCY, reboots, and the recovery from each.

A node that rebooted, fell silent or left the operational state is configured again by the Configurator,
stepwise in the slack. A passive daemon only observes. Every event is reported once.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from drivelink.canopen.configure import Configurator
from drivelink.canopen.emcy import parse_emergency
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator, is_mapping
from drivelink.canopen.sdo_sniffer import written_object
from drivelink.cycle.following import MapFollower
from drivelink.cycle.framesource import OVERFLOW, LostSource
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.objectcheck import ObjectCheck
from drivelink.daemon.buswatch import BusWatch
from drivelink.daemon.crosschecks import contradiction
from drivelink.daemon.jointwatch import JointWatch
from drivelink.daemon.nodewatch import OPERATIONAL, STATES, WatchedNode
from drivelink.daemon.readback import ReadBack
from drivelink.daemon.status import EventLog
from drivelink.errors import DriveError

logger = logging.getLogger(__name__)

_NS = 1_000_000_000
_BOOT_UP, _STOPPED = 0x00, 0x04  # NMT states
_SILENT_NS = _NS // 2  # time without a PDO until the node is configured again
_RETRY_NS = _NS  # between two attempts
_SOON_NS = _NS // 40  # doubled, up to that, with each attempt that has failed: one SDO abort costs little


class Supervisor:
    """Heartbeats, faults and reconfiguration of all nodes of the loop.

    Args:
        loop: its listeners are set.
        layouts: of each loop_joint's nodes.
        events: the event log.
        configurator: configures nodes again or, passive, follows another master.

    Attributes:
        bus: watches SYNC, the bus and this machine.
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
        self._configurator = configurator
        self._follower: MapFollower | None = None
        self._read_back: ReadBack | None = None
        self.bus = BusWatch(loop, events)
        self._joints = JointWatch(events, self.contradiction)
        loop.on_fault = self._say_fault
        self._unread = 0  # frames lost by receive overflow
        self._due: dict[int, tuple[NodeLayout, int]] = {}  # configured nodes, and the SYNC before their start
        self._nodes: dict[int, WatchedNode] = {}
        for loop_joint, mine in layouts.items():
            loop_joint.pipeline.assembler.supervise()
            for layout in mine:
                self._nodes[layout.node_id] = WatchedNode(layout, loop_joint, loop.clock())
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
        now, nodes = self._loop.clock(), self._nodes.items()
        return {str(node): one.status(now) for node, one in nodes if one.loop_joint is loop_joint}

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
                watched.failures += 1
                self._events.begin(f"configure {node}", f"node {node} cannot be configured: {result}")
                continue
            watched.failures = 0
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
            watched.check_counters(self._events, now)
            self._check_frames(node, watched, now)
            watched.check(self._events, now)
        for loop_joint in self._loop.loop_joints:
            self._joints.check(loop_joint)
        if self._follower is not None:
            unread = self._loop.source.errors.get(OVERFLOW, 0)
            if unread > self._unread:
                self._follower.lose_sight(None, "frames were lost by receive overflow")
            self._unread = unread
            self._check_maps(self._follower)
        self.bus.check()

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
            over = f"node {node}: its mapping is known, its frames are used"
            doubts = follower.doubts
            self._events.keep(f"mapping {node}", node in doubts, doubts.get(node, ""), over)
            watched, unasked = self._nodes[node], follower.unasked(node)
            if unasked > watched.unasked:
                watched.unasked = unasked
                text = f"node {node}: {unasked} SDO answers so far belong to no request heard: not used"
                self._events.say(text, logging.WARNING, key=f"unasked {node}")

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

    def _check_frames(self, node: int, watched: WatchedNode, now: int) -> None:
        assembler = watched.loop_joint.pipeline.assembler
        counters = assembler.counters[node]
        if counters.received + counters.ignored != watched.sent:
            watched.sent = counters.received + counters.ignored
            if watched.state == _BOOT_UP or now - watched.heartbeat_ns > _NS:
                watched.state = OPERATIONAL  # required for PDOs, and no other state is reported
        if counters.received != watched.received:
            watched.received, watched.seen_ns = counters.received, now
            watched.started = False
            self._events.end(f"start {node}", f"node {node} sends its frames")
        lost = now - watched.seen_ns > _SILENT_NS or node in assembler.untrusted
        lost = lost or (watched.state != OPERATIONAL and now - watched.heartbeat_ns < _NS)
        failures = min(watched.failures, 10)
        pause_ns = min(_RETRY_NS, _SOON_NS << failures) if failures else _RETRY_NS
        if lost and not self._configurator.busy and now - watched.attempt_ns > pause_ns:
            watched.attempt_ns = now
            self._configure(node, stopped=watched.state == _STOPPED)
            if watched.started:
                self._say_unstarted(node, watched)

    def _say_unstarted(self, node: int, watched: WatchedNode) -> None:
        code = watched.loop_joint.pipeline.assembler.faults.get(node)
        why = f" and EMCY 0x{code:04X}: its error may need a reset or a power cycle" if code else ""
        self._events.begin(
            f"start {node}",
            f"node {node} is configured and was started, but sends none of its frames; "
            f"it says {watched.state_text}{why}",
        )

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
        if state in STATES:
            watched.state = state

    def _emergency(self, cob_id: int, data: bytes) -> None:
        emergency = parse_emergency(data)
        if emergency is not None and not emergency.is_reset:
            node, code = cob_id - 0x080, emergency.code
            key, source = f"EMCY {node} {code}", f"EMCY {node}"
            self._events.say(f"node {node}: {emergency}", logging.WARNING, key, source)

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
