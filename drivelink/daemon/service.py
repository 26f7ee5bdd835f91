"""The daemon of one bus, from the first frame to a clean end.

Everything slow or final happens before the loop runs: opening the bus, claiming the names on zenoh,
configuring the nodes. Then one thread runs, and nothing in it raises.
"""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from drivelink._core import JointPipeline
from drivelink.canopen.bus import open_bus
from drivelink.canopen.layout import NodeLayout, roles
from drivelink.cycle import realtime
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.objectcheck import HISTORY_S
from drivelink.cycle.pipeline import Built, build, make_pipeline, rehearse
from drivelink.cycle.sources import open_source
from drivelink.cycle.startup import BusPort, join_bus
from drivelink.daemon.buswatch import BusKeeper
from drivelink.daemon.jointstatus import JointStatus
from drivelink.daemon.reload import Reloader
from drivelink.daemon.status import EventLog
from drivelink.daemon.supervision import Supervisor
from drivelink.errors import UsageError
from drivelink.jointfile import JointFile
from drivelink.loop.feed import FindingFeed, SnapshotFeed
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_session, watch_router
from drivelink.systemd.unit import Watchdog, notify, watchdog_period_s

logger = logging.getLogger("drivelink")

_STATUS_S = 0.25
_CHECK_S = 0.1
_ANSWER_S = 0.05
_FILE_S = 0.2
_FINDING_S = 1.0
_COLLECT_S = 5.0
_CLOSING_S = 2.0  # for subscribers to be told; a service has five to end


@dataclass(frozen=True, slots=True, kw_only=True)
class ServedJoint:
    """A joint the daemon serves."""

    joint: JointFile
    path: Path | None = None  # its path; None: it cannot be reloaded and refers to no other files
    fingerprint: str = ""  # of the text that was read; empty: not known, it is read again
    move: Callable[[JointFile], JointFile] = lambda joint: joint  # to the bus of the command line

    @property
    def folder(self) -> Path:
        """Base of its relative paths."""
        return self.path.parent if self.path else Path()


class Daemon:
    """Serves the joints of one bus: construct, `run`, `close`.

    Args:
        session: an open zenoh session to publish on; None: open one.
        devices: simulated devices in the daemon's thread. They answer immediately, and SYNC advances their
            world; for demonstrations, tests and faster than real time.

    Raises:
        DrivelinkError: why it cannot start, in one line.
    """

    def __init__(
        self,
        joints: Sequence[ServedJoint],
        *,
        publish: bool = True,
        session: zenoh.Session | None = None,
        real_time: bool = True,
        devices: Callable[[], object] | None = None,
    ) -> None:
        _check_agreement(joints)
        self._joints = tuple(joints)
        self._section = joints[0].joint.bus
        self._real_time = real_time
        self._devices = devices
        self._closing = ExitStack()
        self._end_ns: int | None = None
        self._lockstep_ns = time.monotonic_ns()
        self.events = EventLog(logger)  # the event log
        self._stopping, self._another_s = False, 0.0  # the end is asked for; another period of SYNC
        try:
            self._publishers = self._open_publishers(session) if publish else [None] * len(joints)
            self._port = BusPort(open_bus(self._section))
            self._keeper = BusKeeper(self._port, self._section, self.events, devices)
            self._closing.callback(self._keeper.close)
            files, folders = [s.joint for s in joints], [s.folder for s in joints]
            self._configurator = join_bus(self._port, files, folders, idle=devices)
            self._assemble()
        except BaseException:
            self._closing.close()
            raise

    def _assemble(self) -> None:
        """Make everything that knows the period of SYNC: pipelines, loop, and what is beside it."""
        section = self._section = self._configurator.bus  # with the measured period of another master's SYNC
        keep, known = round(HISTORY_S / section.period_s), self._configurator.layouts
        nodes: dict[LoopJoint, tuple[NodeLayout, ...]] = {}
        for served, publisher in zip(self._joints, self._publishers, strict=True):
            mine = tuple(known[role.node_id] for role in roles(served.joint, served.folder))
            pipeline = make_pipeline(self._timed(served.joint), mine, keep=keep)
            nodes[LoopJoint(served.joint.name, pipeline, publisher)] = mine
        self.loop = self._port.loop = CycleLoop(  # the cycle
            open_source(self._port.bus, self._devices),
            tuple(nodes),
            period_s=section.period_s,
            produce=section.sync == "produce",
            counter_overflow=section.sync_counter_overflow,
            world_steps=self._devices is not None,
        )
        self.loop.on_lost = self._keeper.lost
        self._supervisor = Supervisor(self.loop, nodes, self.events, self._configurator)
        self._supervisor.bus.on_period = self._take_period
        self._plan()
        self._status: list[JointStatus] = []
        self._reloaders: list[Reloader] = []
        for served, publisher, (loop_joint, mine) in zip(
            self._joints, self._publishers, nodes.items(), strict=True
        ):
            self._serve(served, publisher, loop_joint, mine)
        self.documents()  # once before: nothing happens for the first time in a cycle
        for status in self._status:
            status.begin()
        self._publish_status("starting")
        self.loop.source.narrow(self.loop.receive_ids())

    def _plan(self) -> None:
        """Plan what is done in the slack for all joints."""
        housekeeping = self.loop.housekeeping
        housekeeping.urgent.append(self._supervisor.step)
        housekeeping.every(0.01, self._check_end)
        housekeeping.every(_CHECK_S, self._supervisor.check)
        housekeeping.every(_CHECK_S, self._check_bus)
        housekeeping.every(_COLLECT_S, lambda: gc.collect(0))
        housekeeping.every(1.0, self.loop.refresh_unix_time)
        if (watchdog_s := watchdog_period_s()) is not None:
            housekeeping.every(watchdog_s, Watchdog(self.loop).check)

    def _serve(
        self,
        served: ServedJoint,
        publisher: JointPublisher | None,
        loop_joint: LoopJoint,
        mine: tuple[NodeLayout, ...],
    ) -> None:
        """Publish a joint's model, plan what is done for it in the slack, and rehearse its cycle."""
        housekeeping, load = self.loop.housekeeping, self._configurator.load().fraction
        joint, supervisor = self._timed(served.joint), self._supervisor
        status = JointStatus(joint, self.loop, loop_joint, supervisor, self.events, load)
        self._status.append(status)

        def publish(joint: JointFile) -> None:
            if publisher is not None:
                publisher.put_joint(self._timed(joint), mine)

        publish(joint)
        if publisher is not None:
            housekeeping.every(_STATUS_S, partial(_put_status, publisher, status))
            housekeeping.every(_ANSWER_S, publisher.answer)
            if (kept := joint.recording.folder) is not None:
                feed = FindingFeed(served.folder / kept, joint.name, publisher.put_finding)
                housekeeping.every(_FINDING_S, feed.check)
                housekeeping.every(_FINDING_S, SnapshotFeed(loop_joint.pipeline, publisher).check)
        if served.path is not None:
            make: Callable[[JointFile], Built] = lambda joint: build(self._timed(joint))  # noqa: E731
            files = served.path, served.joint, served.fingerprint
            reloader = Reloader(
                *files, loop_joint.pipeline, served.move, make, publish, self.events.of(joint.name)
            )
            self._reloaders.append(reloader)
            housekeeping.urgent.append(reloader.step)
            housekeeping.every(_FILE_S, reloader.check)
        rehearse(served.joint)

    def _take_period(self, period_s: float) -> None:
        """The master has another period: begin anew with it, once the loop has ended."""
        self._another_s = period_s
        self.loop.stop()

    def _begin_anew(self) -> None:
        before_s, after_s, self._another_s = self._section.period_s, self._another_s, 0.0
        self._configurator.bus = self._section.model_copy(update={"period_s": after_s})
        self.events.end("period")
        text = f"SYNC comes every {after_s * 1e3:.4g} ms, not {before_s * 1e3:.4g} ms"
        self.events.report(f"{text}: estimates begin anew with it", logging.WARNING)
        present = {reloader.path: reloader.close() for reloader in self._reloaders}
        self._joints = tuple(
            replace(one, **present[one.path]) if one.path in present else one for one in self._joints
        )
        self._assemble()

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pipelines(self) -> tuple[JointPipeline, ...]:
        """Of the joints, in their order."""
        return tuple(loop_joint.pipeline for loop_joint in self.loop.loop_joints)

    @property
    def layouts(self) -> Mapping[int, NodeLayout]:
        """Layouts of the nodes, by node id."""
        return self._configurator.layouts

    def run(self, seconds: float | None = None) -> None:
        """Run until `stop` is called or the time is over.

        Args:
            seconds: of the wall clock; None: without end.
        """
        obtained = realtime.acquire(privileged=self._real_time)
        for line in obtained.lines:
            logger.info("%s", line)
        if seconds is not None:
            self._end_ns = time.monotonic_ns() + round(seconds * 1e9)
        try:
            notify("READY=1", "STATUS=running")
            while True:
                for status in self._status:
                    status.real_time = obtained
                realtime.run(self.loop)
                if self._stopping or not self._another_s:
                    break
                self._begin_anew()
        finally:
            notify("STOPPING=1")
            realtime.release(obtained)

    def run_lockstep(self, cycles: int) -> None:
        """Run so many cycles as fast as possible, with devices in this thread."""
        self.loop.run_lockstep(cycles, self._lockstep_ns)
        self._lockstep_ns += cycles * self.loop.period_ns

    def stop(self) -> None:
        """Make `run` return within a few cycles; callable from any thread or signal handler."""
        self._stopping = True
        self.loop.stop()

    def reload(self) -> None:
        """Reload the joint files, changed or not; callable from any thread or signal handler."""
        for reloader in self._reloaders:
            reloader.request()

    def close(self) -> None:
        """Publish the last status and release everything; may be called twice."""
        if self._closing is not None:
            self._publish_status("stopped")
        self._closing.close()
        self._publishers = []

    def documents(self) -> list[dict[str, Any]]:
        """Return the status document of each joint now."""
        for status in self._status:
            status.refresh_timing()
        return [status.document() for status in self._status]

    def summary(self) -> str:
        """Return the summary of the run, one line per joint."""
        return "\n".join(status.summary() for status in self._status)

    def _open_publishers(self, session: zenoh.Session | None) -> list[JointPublisher | None]:
        if session is None:
            first = self._joints[0]
            session = open_session(first.joint.zenoh, first.folder)
            self._closing.callback(_close_in_time, session)
            text = "the connection to the zenoh router is lost: who is behind it receives nothing"
            tell = partial(self.events.keep, "router", text=text, over="the zenoh router is back")
            self._closing.callback(watch_router(session, tell).undeclare)
        publishers: list[JointPublisher | None] = []
        for served in self._joints:
            publisher = JointPublisher(session, served.joint, express=served is self._joints[-1])
            self._closing.callback(publisher.close)
            publisher.watch_rivals(partial(self._note_rival, served.joint.name))
            publishers.append(publisher)
        return publishers

    def _note_rival(self, name: str, there: bool) -> None:
        text = f"another daemon serves a joint named {name}, too: end or rename one"
        over = f"no other daemon serves a joint named {name} any more"
        self.events.of(name).keep(f"{name} rival", there, text, over)

    def _timed(self, joint: JointFile) -> JointFile:
        """Return a joint file with the measured period of SYNC."""
        return joint.model_copy(update={"bus": self._section})

    def _check_bus(self) -> None:
        if self._keeper.check():
            self._supervisor.reconfigure_all()

    def _publish_status(self, state: str) -> None:
        for publisher, status in zip(self._publishers, self._status, strict=False):
            if publisher is not None:
                publisher.put_status(status.document(state))

    def _check_end(self) -> None:
        if self._end_ns is not None and time.monotonic_ns() >= self._end_ns:
            self.stop()


def _put_status(publisher: JointPublisher, status: JointStatus) -> Generator[None]:
    status.refresh_timing()
    yield
    document = status.document()
    yield
    publisher.put_status(document)


def _check_agreement(joints: Sequence[ServedJoint]) -> None:
    """Check that the joints share one bus and one zenoh session.

    Raises:
        UsageError: duplicate names, or different `bus` or `zenoh` sections.
    """
    first = joints[0]
    names = [served.joint.name for served in joints]
    for served in joints[1:]:
        if names.count(served.joint.name) > 1:
            raise UsageError(f"two joints are named {served.joint.name}: expected names of their own")
        for section in ("bus", "zenoh"):
            if getattr(served.joint, section) != getattr(first.joint, section):
                raise UsageError(
                    f"[{section}] differs between {first.joint.name} and {served.joint.name}: "
                    "joints of one daemon share it; run one daemon for each"
                )


def _close_in_time(session: zenoh.Session) -> None:
    """Close a session, and leave it to the end of the process where that takes long.

    It waits up to ten seconds for connections that never say anything.
    """
    closing = threading.Thread(target=close_session, args=(session,), name="close", daemon=True)
    closing.start()
    closing.join(_CLOSING_S)
