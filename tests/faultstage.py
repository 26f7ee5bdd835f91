"""Where the fault script is played: a daemon, its devices, a third party on the bus, and the truth.

Besides what the script expects, every VALID sample is compared with `Truth`: all its values are those of one
and the same SYNC, and that is the latest.
"""

from __future__ import annotations

import inspect
import logging
import re
import threading
from collections.abc import Callable
from functools import partial, reduce
from itertools import pairwise
from operator import or_
from typing import Any

import can
from daemonkit import Collector
from faultscript import Fault
from faulttruth import Truth

from drivelink._core import Tick
from drivelink.daemon.service import Daemon
from drivelink.demo.simulate import network_from_joint, nodes_from_joint, world_from_joint
from drivelink.jointfile import JointFile
from estimator.sample import Status
from sim.canopen.node import Node
from sim.faults import Faults
from sim.sensors import DriveSignals

_PATIENCE_S = 30.0  # of the stage's own time; every way back takes less


class Sink(Collector):
    """Keeps everything, and with each sample the SYNC that its values must be of."""

    def __init__(self, stage: Stage) -> None:
        super().__init__()
        self._stage = stage
        self.due: list[int] = []

    def forget(self) -> None:
        self.estimates, self.samples, self.payloads, self.due = [], [], [], []

    def put(self, tick: Tick) -> None:
        super().put(tick)
        if tick.sample is None:
            return
        current = tick.sample.sequence == self._stage.loop_joint.pipeline.assembler.sequence
        truth = self._stage.truth
        self.due.append(truth.syncs - (1 if current or truth.unseen else 2))


class _Said(logging.Handler):
    """Everything that the daemon logs."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.lines: list[str] = []
        self.emit = lambda record: self.lines.append(record.getMessage())


class Stage:
    """A daemon, its devices, and what can be done to them; the actions of the script are its methods."""

    daemon: Daemon
    exact = False  # whether every cycle is a matter of the script alone
    of_the_machine: frozenset[str] = frozenset()  # conditions that say how slow it is, not how well we are
    patience_s = _PATIENCE_S
    late_syncs = 2  # that the devices may have seen before a sample is out

    def __init__(self, joint: JointFile, bus: can.BusABC) -> None:
        self.joint = joint
        self.world = world_from_joint(joint)
        self.bus = bus
        self.network = network_from_joint(joint, self.bus, world=self.world)
        self.faults = Faults(self.network)
        self.said = _Said()
        self.checked = 0  # VALID samples that were compared with the truth
        self._impostor: Node | None = None
        self._injector: can.BusABC | None = None
        self._due: dict[int, list[Callable[[], None]]] = {}
        self._held: dict[str, str] = {}
        self._planning = threading.Lock()

    def _begin(self) -> None:
        logger = logging.getLogger("drivelink")
        self._level = logger.level
        logger.setLevel(logging.INFO)
        logger.addHandler(self.said)
        (self.loop_joint,) = self.daemon.loop.loop_joints
        self.truth = Truth(self.world, self.daemon)
        self.loop_joint.sink = self.collector = Sink(self)
        inner = self.network.sync_filter
        assert inner is not None

        def sync(data: bytes) -> bool:
            self.truth.synced = inner(data)
            self.truth.unseen = not self.truth.synced
            return self.truth.synced

        self.network.sync_filter = sync

    def close(self) -> None:
        logger = logging.getLogger("drivelink")
        logger.removeHandler(self.said)
        logger.setLevel(self._level)
        self.daemon.close()
        if self._injector is not None:
            self._injector.shutdown()
        self.bus.shutdown()

    # Time, as each stage has it

    def run(self, seconds: float) -> None:
        raise NotImplementedError

    def schedule(self, seconds: float, action: Callable[[], None]) -> None:
        """Have an action taken at the SYNC that is so many seconds away."""
        cycle = self.daemon.loop.cycles + round(seconds / self.joint.bus.period_s)
        with self._planning:
            self._due.setdefault(cycle, []).append(action)

    def act(self) -> None:
        if not self._due:
            return
        with self._planning:
            cycles = sorted(cycle for cycle in self._due if cycle <= self.daemon.loop.cycles)
            actions = [action for cycle in cycles for action in self._due.pop(cycle)]
        for action in actions:
            action()

    # Play

    @property
    def well(self) -> bool:
        """Whether everything is as if nothing had ever been."""
        pipeline, bad = self.loop_joint.pipeline, Status.BUS_FAULT | Status.STALE | Status.DRIVE_FAULT
        return (
            pipeline.estimate is not None
            and pipeline.estimate.status & (bad | Status.VALID) == Status.VALID
            and pipeline.sample is not None
            and not self.daemon.events.active.keys() - self.of_the_machine
            and self.document()["state"] == "running"
        )

    def document(self) -> dict[str, Any]:
        return self.daemon.documents()[0]

    def settle(self, also: Callable[[], bool] = lambda: True) -> None:
        """Until everything is well, and something else is true."""
        for _ in range(int(self.patience_s / 0.25)):
            self.run(0.25)
            if self.well and also():
                return
        document, told = self.document(), ("state", "not_valid", "conditions", "quality", "nodes")
        raise AssertionError(f"not well again: { {key: document[key] for key in told} }")

    def forget(self) -> None:
        self.daemon.events._window.lines = 0  # as in the usual hours between two faults
        self.daemon.events._said.clear()  # what was said for the fault before must not count as said
        self.collector.forget()
        self.truth.forget()
        self.said.lines.clear()
        try:
            while self._injector is not None and self._injector.recv(0.0) is not None:
                pass  # it hears everything, and nobody else reads it
        except can.CanError:  # its interface was away
            self._injector = None

    def start(self, fault: Fault) -> None:
        for seconds, action, arguments in fault.steps:
            self.schedule(seconds, partial(self.do, action, *arguments))

    def do(self, action: str, *arguments: Any) -> None:
        """An action of the script: a method of this class, or of `Faults` with a node (and its TPDO) by node id."""
        own = getattr(self, action, None)
        if own is not None:
            own(*arguments)
            return
        what = getattr(self.faults, action)
        names = [*inspect.signature(what).parameters]
        if names[:1] == ["node"]:
            node_id, *arguments = arguments
            tpdo = [self.daemon.layouts[node_id].tpdos[0].number] if "tpdo" in names else []
            arguments = [self.node(node_id), *tpdo, *arguments]
        what(*arguments)

    def play(self, fault: Fault) -> None:
        """Replay one fault and hold the daemon to what the script expects."""
        self.forget()
        before = self._counters()
        self._held = self.daemon.events.active
        self.start(fault)
        states = self._watch(fault.seconds)
        self.settle(lambda: self.exact or all(self._said(pattern) for pattern in fault.says))
        self._check_flags(fault)
        assert not self.wrong_samples(), f"{fault.name}: {self.wrong_samples()}"
        self._check_words(fault)
        if fault.state:
            assert fault.state in states, f"{fault.name}: the status only said {states}"
        after = self._counters()
        for (node, name), count in fault.counts.items():
            what = f"{fault.name}: {name} of node {node}"
            self.compare(what, after[node][name] - before[node][name], count)

    def compare(self, what: str, found: int, expected: int) -> None:
        assert found >= 1, what

    def _watch(self, seconds: float) -> set[str]:
        states = set()
        for _ in range(round(seconds / 0.1)):
            self.run(0.1)
            states.add(self.document()["state"])
        return states

    def _counters(self) -> dict[int, dict[str, int]]:
        counters = self.loop_joint.pipeline.assembler.counters
        return {node: count.as_dict() for node, count in counters.items()}

    def _check_flags(self, fault: Fault) -> None:
        statuses = [(estimate.sequence, Status(estimate.status)) for estimate, _ in self.collector.estimates]
        seen = reduce(or_, (status for _, status in statuses), Status(0))
        stale = sum(Status.STALE in status for _, status in statuses)
        assert not any(Status.STALE | Status.VALID in status for _, status in statuses), fault.name
        assert fault.flags & ~seen == 0, f"{fault.name}: flags {seen!r}, expected {Status(fault.flags)!r}"
        known = self.exact and fault.gaps is not None
        assert not known or bool(stale) == fault.gaps, f"{fault.name}: {stale} stale estimates"
        sequences = [sequence for sequence, status in statuses if Status.STALE not in status]
        assert all(a < b for a, b in pairwise(sequences)), fault.name
        if fault.valid_throughout and self.exact:
            assert all(Status.VALID in status for _, status in statuses), fault.name

    def wrong_samples(self) -> str:
        """The first VALID sample with a value of another SYNC than its own, or nothing.

        Where frames were late, and it says so, values of the SYNC before are right.
        """
        collector = self.collector
        flags = {estimate.sequence: Status(estimate.status) for estimate, _ in list(collector.estimates)}
        for (sample, _), due in zip(list(collector.samples), list(collector.due), strict=False):
            status = flags.get(sample.sequence, Status(0))
            late = Status.BUS_FAULT in status
            if Status.VALID not in status or (late and not self.exact):
                continue  # how late frames are in real time is not a matter of the script
            self.checked += 1
            possible = range(due - self.late_syncs, due + 1)
            if not any(self.truth.measured(sample, sync, late) for sync in possible):
                return f"sample {sample.sequence} is not of its SYNC: {status!r}"
        return ""

    def _said(self, pattern: str) -> list[str]:
        """Lines that were said; in real time also what held before, and therefore is not said again."""
        held = [] if self.exact else list(self._held.values())
        return [line for line in self.said.lines + held if re.search(pattern, line)]

    def _check_words(self, fault: Fault) -> None:
        for pattern in fault.says:
            lines = self._said(pattern)
            # In real time a slow machine may bring the same thing about again, but not time after time.
            assert len(lines) == 1 or (not self.exact and 1 <= len(lines) <= 3), (
                f"{fault.name}: {pattern!r} was said {len(lines)} times: {self.said.lines}"
            )
        once = len(self.said.lines) == len(set(self.said.lines))
        assert once or not self.exact, f"{fault.name}: {self.said.lines}"  # in real time it may come again
        reported = [event["text"] for event in self.document()["events"]]
        for line in self.said.lines[-8:]:
            assert line in reported, f"{fault.name}: {line!r} is in the log and not in the status"

    # Actions

    def node(self, node_id: int) -> Node:
        return next(node for node in self.network.nodes if node.node_id == node_id)

    def mend(self, node: int) -> None:
        self.inject(0x200 + node, b"\x80\x00")  # whoever has control resets the fault; we never do
        self.inject(0x200 + node, b"\x00\x00")

    def recount(self, node: int, rad: float | None) -> None:
        """From now on the motor encoder of a drive counts from elsewhere: by so much more, or (None) from zero."""
        motor, drive = node - 1, self.world.drives[node - 1]
        now = self.world.drive(motor).position_counts
        moved = -now if rad is None else round(rad * abs(drive.counts_per_rad))
        read = self.world.drive

        def drive_of(which: int) -> DriveSignals:
            signals = read(which)
            if which != motor:
                return signals
            return signals._replace(position_counts=signals.position_counts + moved)

        self.world.drive = drive_of  # type: ignore[method-assign]

    def impostor(self, node_id: int) -> None:
        """A second device with the node id of a drive, in a world of its own."""
        other = world_from_joint(self.joint, seed=99)
        other.advance(500)
        self._impostor = next(n for n in nodes_from_joint(self.joint, other) if n.node_id == node_id)
        self.faults.impostor(self._impostor)

    def banish(self) -> None:
        assert self._impostor is not None
        self.faults.kill(self._impostor)
        self.network.nodes.remove(self._impostor)

    def foreign_sync(self, count: int) -> None:
        for k in range(count):
            self.schedule(0.005 * k, lambda: self.inject(0x080, b""))

    def babble_as(self, node_id: int, per_cycle: int) -> None:
        """Frames with the identifier of a drive, after its own."""
        node, cob_id = self.node(node_id), self.daemon.layouts[node_id].tpdos[0].cob_id
        inner = node.transmit

        def transmit() -> None:
            inner()
            for _ in range(per_cycle):
                self.network.send(cob_id, bytes(8))

        node.transmit = transmit  # type: ignore[method-assign]

    def quiet(self) -> None:
        self.faults.babble(0, b"", 0)
        for node in self.network.nodes:
            vars(node).pop("transmit", None)

    def inject(self, cob_id: int, data: bytes) -> None:
        self.injector.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    @property
    def injector(self) -> can.BusABC:
        if self._injector is None:
            section = self.joint.bus
            self._injector = can.Bus(interface=section.interface, channel=section.channel)
        return self._injector

    def error_frame(self, kind: int) -> None:
        self.injector.send(
            can.Message(arbitration_id=kind, data=bytes(8), is_error_frame=True, is_extended_id=False)
        )
