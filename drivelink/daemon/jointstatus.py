"""Makes the document of the status key: one joint, a few times a second."""

import math
import os
import time
from typing import Any

from drivelink.canopen.emcy import emergency_text
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.realtime import RealTime
from drivelink.cycle.sources import LostSource
from drivelink.daemon.jointwatch import LATE_FRAMES, cross_checks, residual_ratio
from drivelink.daemon.status import EventLog
from drivelink.daemon.supervision import Supervisor
from drivelink.jointfile import JointFile
from drivelink.output.numbers import number
from drivelink.version import __version__
from estimator.reasons import why_not_valid
from estimator.sample import ExternalStatus, Status

_MODEL_ALARM, _STALE = int(Status.MODEL_ALARM), int(Status.STALE)
_TIMING_EVERY = 4  # documents between percentiles
_QUALITY = tuple((str(bit.name).lower(), int(bit)) for bit in Status)


class JointStatus:
    """Makes the status documents of one joint.

    Args:
        bus_load: fraction of the bit rate that the configured frames take.
    """

    def __init__(
        self,
        joint: JointFile,
        loop: CycleLoop,
        loop_joint: LoopJoint,
        supervisor: Supervisor,
        events: EventLog,
        bus_load: float,
    ) -> None:
        self._joint = joint
        self._loop = loop
        self._loop_joint = loop_joint
        self._supervisor = supervisor
        self._events = events.of(loop_joint.name)
        self._bus_load = bus_load
        self._started_s = time.monotonic()
        self._before = (self._started_s, 0, time.process_time())
        self._asked = 0
        self._timing: dict[str, Any] = {"latency": {}, "response": {}, "jitter": {}}
        self.real_time: RealTime | None = None

    def refresh_timing(self) -> None:
        """Draw the percentiles anew, where it is time to."""
        self._asked += 1
        if self._asked % _TIMING_EVERY == 1:
            for name, meter in (
                ("latency", self._loop_joint.work),
                ("response", self._loop_joint.response),
                ("jitter", self._loop.lateness),
            ):
                self._timing[name] = meter.recent()

    def begin(self) -> None:
        """Recompute the percentiles with the next document."""
        self._asked = 0

    def document(self, state: str = "") -> dict[str, Any]:
        """Return the state of the joint now.

        Args:
            state: "starting" or "stopped"; default: determined from the loop.
        """
        loop, loop_joint, events = self._loop, self._loop_joint, self._events
        status, estimator = loop_joint.pipeline.status or 0, loop_joint.pipeline.estimator
        now = time.monotonic()
        before_s, before_estimates, before_cpu_s = self._before
        cpu_s, elapsed_s = time.process_time(), max(now - before_s, 1e-9)
        self._before = (now, loop_joint.estimates, cpu_s)
        return {
            "schema": "drivelink.status/1",
            "joint": loop_joint.name,
            "state": state or self._state(),
            "time": time.time(),
            "uptime_s": round(now - self._started_s, 3),
            "version": __version__,
            "pid": os.getpid(),
            "period_s": self._joint.bus.period_s,
            "rate_hz": round((loop_joint.estimates - before_estimates) / elapsed_s, 1),
            "cycles": loop.cycles,
            "estimates": loop_joint.estimates,
            "missed_cycles": loop_joint.pipeline.missed + loop.overruns,
            "overruns": loop.overruns,
            "cpu_fraction": round((cpu_s - before_cpu_s) / elapsed_s, 4),
            **self._timing,
            "real_time": self._real_time(),
            "bus": self._bus(),
            "nodes": self._supervisor.node_status(loop_joint),
            "drive_faults": self._faults(),
            "quality": {name: bool(status & bit) for name, bit in _QUALITY},
            "not_valid": self._not_valid(),
            "transmissions": estimator.parameters(),
            "undeclared": estimator.undeclared(),
            "friction": estimator.friction(),
            "flexibility_torque_std_nm": estimator.flexibility_torque_std_nm,
            "residual_nm": estimator.residual_nm,
            "residual_alarm": self._alarm(),
            "external": self._external(),
            "suspected": self._supervisor.contradiction(loop_joint) or self._suspicion(),
            "cross_checks": cross_checks(loop_joint.pipeline.assembler),
            "conditions": sorted(events.active.values()),
            "events": events.recent(),
        }

    def _state(self) -> str:
        loop, loop_joint = self._loop, self._loop_joint
        status = loop_joint.pipeline.status
        if isinstance(loop.source, LostSource):
            return "bus lost"
        if loop_joint.fault:
            return "fault"
        if loop.silent:
            return "no SYNC"
        if status is None:
            return "waiting for samples" if loop.cycles else "starting"
        return "stale" if status & _STALE else "running"

    def _bus(self) -> dict[str, Any]:
        section, source = self._joint.bus, self._loop.source
        return {
            "interface": section.interface,
            "channel": section.channel,
            "sync": section.sync,
            "load": round(self._bus_load, 4),
            "lost_sends": source.lost_sends,
            "errors": dict(source.errors),
            "foreign_syncs": self._loop.foreign_syncs,
            "late_syncs": self._loop.late_syncs,
            "sync_period_s": self._supervisor.bus.sync_period_s,
            "sync_counter_jumps": self._loop.counter_jumps,
        }

    def _faults(self) -> list[str]:
        return [
            f"node {node}: EMCY 0x{code:04X} ({emergency_text(code)})" if code else f"node {node}: fault"
            for node, code in self._loop_joint.pipeline.assembler.faults.items()
        ]

    def _not_valid(self) -> str | None:
        """Why the last estimate is not valid, in one sentence; None: it is, or there is none."""
        pipeline = self._loop_joint.pipeline
        why = None if pipeline.status is None else why_not_valid(pipeline.status, pipeline.estimator)
        return None if why is None else why[1]

    def _suspicion(self) -> dict[str, Any] | None:
        """Return the reading that the estimator suspects; one that jumps while frames come late is late."""
        found = self._loop_joint.pipeline.estimator.suspicion()
        late = next((text for key, text in self._events.active.items() if key.startswith(LATE_FRAMES)), None)
        if found is None or found["reason"] != "jumped" or late is None:
            return found
        reading = found["text"].partition(":")[0]
        return {**found, "reason": "late", "text": f"{reading}: its frames come late ({late})"}

    def _alarm(self) -> dict[str, Any]:
        monitor = self._loop_joint.pipeline.model_monitor
        active = bool((self._loop_joint.pipeline.status or 0) & _MODEL_ALARM)
        return {"active": active, **(monitor.describe() if monitor is not None else {})}

    def _external(self) -> dict[str, Any] | None:
        """External torque, and whether both sides of the joint agree on the flexibility torque."""
        touch = self._loop_joint.pipeline.external
        if touch is None:
            return None
        consistency = self._loop_joint.pipeline.estimator.consistency
        return {
            "valid": bool(touch.status & ExternalStatus.VALID),
            "contact": bool(touch.status & ExternalStatus.CONTACT),
            "torque_nm": touch.external_torque_nm,
            "torque_std_nm": touch.external_torque_std_nm,
            "link_flexibility_torque_nm": touch.link_flexibility_torque_nm,
            "difference_nm": touch.difference_nm,
            **(consistency._asdict() if consistency is not None else {}),
        }

    def _real_time(self) -> dict[str, bool]:
        obtained = self.real_time
        return {name: getattr(obtained, name, False) for name in ("scheduling", "memory")}

    def summary(self) -> str:
        """Return the run in one line."""
        loop_joint, loop = self._loop_joint, self._loop
        work, jitter = loop_joint.work.total(), loop.lateness.total()
        missed = loop_joint.pipeline.missed + loop.overruns
        text = f"{loop_joint.name}: {loop.cycles} cycles, {missed} missed"
        if work and jitter:
            text += f"; p99 work {work['p99_us']:.0f} µs, SYNC late {jitter['p99_us']:.0f} µs"
        residual = loop_joint.pipeline.estimator.residual_nm
        known = math.isfinite(residual) and residual  # 0: there was no motion to judge it by
        ratio = residual_ratio(loop_joint.pipeline.model_monitor)
        parts = [f"{number(residual, 2)} N·m"] if known else []
        parts += [] if ratio is None else [f"{ratio:.2g} × baseline"]
        return f"{text}; residual {', '.join(parts)}" if parts else text
