"""Supervises the nodes beside the cycle: heartbeats, EMCY, reboots, and the recovery from each.

A node that rebooted, fell silent or left the operational state is configured again by the Configurator,
stepwise in the slack. A passive daemon only observes. Every event is reported once.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from drivelink.canopen.configure import Configurator
from drivelink.canopen.emcy import NMT_STATES, nmt_state, parse_emergency
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.following import MapFollower, PassiveFollower
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.objectcheck import ObjectCheck, ReadBack
from drivelink.cycle.sources import OVERFLOW, LostSource
from drivelink.daemon.buswatch import BusWatch
from drivelink.daemon.jointwatch import OPERATIONAL, JointWatch, WatchedNode, contradiction
from drivelink.daemon.status import EventLog

logger = logging.getLogger(__name__)

_NS = 1_000_000_000
_BOOT_UP, _STOPPED = 0x00, 0x04  # NMT states
_SILENT_NS = _NS // 2  # time without a PDO until the node is configured again
_MUTE_NS = 5 * _NS  # without a heartbeat while frames come, likewise
_RETRY_NS = _NS  # between two attempts
_SOON_NS = _NS // 40  # doubled, up to that, with each attempt that has failed: one SDO abort costs little


class Supervisor:
    """Heartbeats, faults and reconfiguration of all nodes of the loop.

    Args:
        configurator: configures nodes again or, passive, follows another master.
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
        self._joint_events = {one.name: events.of(one.name) for one in loop.loop_joints}
        self._configurator = configurator
        self._check: ObjectCheck | None = None
        self._read_back: ReadBack | None = None
        self.bus = BusWatch(loop, events)  # watches SYNC, the bus and this machine
        self._joints = JointWatch(self.contradiction)
        loop.on_fault = self._report_fault
        self._unread = 0  # frames lost by receive overflow
        self._nodes: dict[int, WatchedNode] = {}
        for loop_joint, mine in layouts.items():
            for layout in mine:
                node = layout.node_id
                self._nodes[node] = WatchedNode(layout, loop_joint, loop.clock())
                loop.listeners[0x700 + node] = self._heartbeat
                loop.listeners[0x080 + node] = self._emergency
        self._follower = self._follow(configurator)
        loop.after_sync.append(self._sync)

    def _follow(self, configurator: Configurator | PassiveConfigurator) -> MapFollower:
        """Follow the mappings, by frames in bus order."""
        loop, nodes = self._loop, self._nodes
        assemblers = {node: watched.assembler for node, watched in nodes.items()}
        layouts = {node: watched.layout for node, watched in nodes.items()}
        if isinstance(configurator, PassiveConfigurator):
            for cob_id in (0, *(base + node for base in (0x580, 0x600) for node in nodes)):
                loop.listeners[cob_id] = self._overhear
            return PassiveFollower(configurator, assemblers, layouts, self._use)
        section, check = configurator.bus, None
        if section.read_back_s:
            samples = {node: watched.loop_joint.pipeline.history.after for node, watched in nodes.items()}
            self._check = check = ObjectCheck(section.sdo_timeout_s, samples)
            self._read_back = ReadBack(configurator.run, section.read_back_s, check)
        for node in nodes:
            loop.listeners[0x580 + node] = self._answer
            loop.listeners[0x600 + node] = self._foreign_request
        follower = MapFollower(configurator, assemblers, layouts, self._use, check)
        loop.on_sent = lambda cob_id, data: follower.feed(
            cob_id, data, loop.clock() / _NS, loop.syncs - loop.cycles
        )
        return follower

    def _overhear(self, cob_id: int, data: bytes) -> None:
        self._follower.feed(cob_id, data, self._loop.clock() / _NS)

    def contradiction(self, loop_joint: LoopJoint) -> dict[str, Any] | None:
        """Return the reading that a second one contradicts, see `jointwatch`; None: none."""
        assembler = loop_joint.pipeline.assembler
        found = contradiction(assembler)
        return self._check.contradiction(assembler) if found is None and self._check is not None else found

    def node_status(self, loop_joint: LoopJoint) -> dict[str, Any]:
        """State of one joint's nodes, for the status key."""
        now, nodes = self._loop.clock(), self._nodes.items()
        return {str(node): one.status(now) for node, one in nodes if one.loop_joint is loop_joint}

    def _of(self, node: int) -> EventLog:
        """Return where events of a node are reported: they are of its joint alone."""
        return self._joint_events[self._nodes[node].loop_joint.name]

    def step(self, now_ns: int) -> None:
        """Advance running configurations."""
        if self._configurator.busy:
            self._proceed(now_ns)
        elif self._read_back is not None:
            self._read_back.step(now_ns / _NS)

    def _sync(self) -> None:
        """At a SYNC, use new mappings; configure nodes anew that say something else by SDO than is in use."""
        self._check_overflow()
        for found in self._follower.sync():
            self._nodes[found.node].attempt_ns = self._loop.clock()
            text = f"{found.text}: it is configured again"
            self._of(found.node).report(text, logging.WARNING, key=f"read back {found.node}")
            self._configurator.start(found.node)

    def _proceed(self, now_ns: int) -> None:
        configurator = self._configurator
        if not isinstance(configurator, Configurator):
            return
        for node, result in configurator.poll(now_ns / _NS):
            watched = self._nodes[node]
            watched.attempt_ns = watched.seen_ns = now_ns
            if isinstance(result, NodeLayout):
                watched.failures = 0
                continue
            watched.failures += 1
            self._of(node).begin(f"configure {node}", f"node {node} cannot be configured: {result}")

    def _use(self, node: int, layout: NodeLayout) -> None:
        """At a SYNC, a layout has come into use."""
        watched = self._nodes[node]
        if layout.tpdos != watched.layout.tpdos:
            self._loop.reroute()
            self._loop.source.narrow(self._loop.receive_ids())
            self._of(node).report(f"node {node} has another mapping now: {_maps(layout)}")
        watched.layout = layout
        if isinstance(self._configurator, PassiveConfigurator):
            return
        self._of(node).end(f"configure {node}")
        if not watched.started:
            self._of(node).report(f"node {node} is configured again and started")
        watched.started = True

    def check(self) -> None:
        """Check for changes since the last call; a few tens of microseconds."""
        if isinstance(self._loop.source, LostSource):
            return  # already reported; silence says nothing about the nodes now
        now = self._loop.clock()
        for node, watched in self._nodes.items():
            watched.check_counters(events := self._of(node), now)
            self._check_frames(node, watched, now)
            watched.check(events, now)
        for loop_joint in self._loop.loop_joints:
            self._joints.check(loop_joint, self._joint_events[loop_joint.name])
        follower = self._follower
        if isinstance(follower, PassiveFollower):
            self._check_maps(follower)
        else:
            for node, refused in follower.refused.items():
                self._of(node).begin(f"configure {node}", f"node {node} cannot be configured: {refused}")
        self.bus.check()

    def _check_overflow(self) -> None:
        unread, before = self._loop.source.errors.get(OVERFLOW, 0), self._unread
        self._unread = unread
        if unread > before and isinstance(self._follower, PassiveFollower):
            self._follower.lose_sight(None, "frames were lost by receive overflow")

    def _check_maps(self, follower: PassiveFollower) -> None:
        doubts = follower.doubts
        for node, watched in self._nodes.items():
            over = f"node {node}: its mapping is known, its frames are used"
            self._of(node).keep(f"mapping {node}", node in doubts, doubts.get(node, ""), over)
            unasked = follower.listener.unasked(node)
            if unasked > watched.unasked:
                watched.unasked = unasked
                text = f"node {node}: {unasked} SDO answers so far belong to no request heard: not used"
                self._of(node).report(text, logging.WARNING, key=f"unasked {node}")

    def _report_fault(self, where: str, error: Exception) -> None:
        logger.debug("%s", where, exc_info=error)
        kind = type(error).__name__
        events = self._joint_events.get(where, self._events)
        events.report(f"{where}: {kind}: {error}", logging.ERROR, key=f"{where}: {kind}")

    def reconfigure_all(self) -> None:
        """Configure all nodes again after a loss of the bus."""
        for node, watched in self._nodes.items():
            assembler = watched.loop_joint.pipeline.assembler
            if isinstance(self._configurator, Configurator):
                assembler.distrust(node)
            watched.begin(assembler.counters[node], self._loop.clock())
            self._configurator.start(node)
        if isinstance(self._follower, PassiveFollower):
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
            self._of(node).end(f"start {node}", f"node {node} sends its frames")
            self._of(node).end(f"configure {node}")  # or somebody else has started it, as it was
        lost = now - watched.seen_ns > _SILENT_NS or node in assembler.untrusted
        lost = lost or (watched.state != OPERATIONAL and now - watched.heartbeat_ns < _NS)
        # Frames without the heartbeat: another device may have been configured in its place. Asked for once.
        mute_ns = watched.heartbeat_ns + _MUTE_NS
        lost = lost or (watched.layout.heartbeat_ms > 0 and now > mute_ns > watched.attempt_ns)
        failures = min(watched.failures, 10)
        pause_ns = min(_RETRY_NS, _SOON_NS << failures) if failures else _RETRY_NS
        if lost and not self._configurator.busy and now - watched.attempt_ns > pause_ns:
            watched.attempt_ns = now
            self._configurator.start(node, stopped=watched.state == _STOPPED)
            if watched.started:
                self._report_unstarted(node, watched)

    def _report_unstarted(self, node: int, watched: WatchedNode) -> None:
        code = watched.loop_joint.pipeline.assembler.faults.get(node)
        why = f" and EMCY 0x{code:04X}: its error may need a reset or a power cycle" if code else ""
        text = f"node {node} is configured and was started, but sends none of its frames; it says "
        self._of(node).begin(f"start {node}", f"{text}{nmt_state(watched.state)}{why}")

    def _heartbeat(self, cob_id: int, data: bytes) -> None:
        if len(data) != 1:
            return
        node = cob_id - 0x700
        watched = self._nodes[node]
        watched.heartbeat_ns = self._loop.clock()
        state = data[0] & 0x7F
        if state == 0:  # every time: it may reboot while being configured
            self._of(node).report(f"node {node} has rebooted", logging.WARNING)
            watched.attempt_ns = watched.heartbeat_ns
            self._configurator.start(node)
            if isinstance(self._follower, PassiveFollower):  # its heartbeat has its default again
                watched.layout = replace(watched.layout, heartbeat_ms=0)
        self._overhear(cob_id, data)
        if state in NMT_STATES:
            watched.state = state

    def _emergency(self, cob_id: int, data: bytes) -> None:
        emergency = parse_emergency(data)
        if emergency is not None and not emergency.is_reset:
            node, code = cob_id - 0x080, emergency.code
            key, source = f"EMCY {node} {code}", f"EMCY {node}"
            self._of(node).report(f"node {node}: {emergency}", logging.WARNING, key, source)

    def _answer(self, cob_id: int, data: bytes) -> None:
        now_ns = self._loop.clock()
        self._follower.feed(cob_id, data, now_ns / _NS)
        if self._configurator.busy:
            self._proceed(now_ns)  # do not decode its frames by the old layout
        elif self._read_back is not None:
            self._read_back.feed(cob_id - 0x580, data, now_ns / _NS)

    def _foreign_request(self, cob_id: int, data: bytes) -> None:
        """Somebody else talks to a node by SDO; our own frames are not heard."""
        self._overhear(cob_id, data)
        if self._read_back is not None:
            self._read_back.quiet(self._loop.clock() / _NS)
        node = cob_id - 0x600
        if written := self._follower.unsettles(node, data):
            text = f"node {node}: somebody else writes its {written}: it is configured again"
            self._of(node).report(text, logging.WARNING)


def _maps(layout: NodeLayout) -> str:
    return ", ".join(
        f"0x{tpdo.cob_id:03X} = " + " ".join(f"{o.index:04X}:{o.subindex:02X}" for o in tpdo.objects)
        for tpdo in layout.tpdos
    )
