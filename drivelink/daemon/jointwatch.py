"""Watches a joint and its nodes: estimates, cross-checks, frames, heartbeats, faults; each event once."""

import logging
import math
from collections.abc import Callable
from typing import Any

from drivelink._core import Assembler, NodeCounters
from drivelink.canopen.emcy import drive_state, nmt_state
from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.loop import LoopJoint
from drivelink.cycle.objectcheck import contradicted
from drivelink.daemon.status import EventLog
from drivelink.output.numbers import number
from estimator.model_monitor import ModelMonitor
from estimator.sample import Status

_WORDS = {
    "velocity": "velocity (0x606C)",
    "current": "current",
    "second_encoder": "second encoder",
    "following_error": "following error (0x60F4)",
}


def cross_checks(assembler: Assembler) -> list[dict[str, Any]]:
    """Return all checks that the mapping makes possible.

    {"motor": from 1 on, "check": "velocity" | "current" | "second_encoder" | "following_error", "verdict":
    "untested" | "agrees" | "contradicts", "scale": of the second reading against the first, "std": of that}.
    """
    return [
        {"motor": motor, "check": check, "verdict": verdict, "scale": scale, "std": std}
        for motor, check, verdict, scale, std in assembler.checks
    ]


def contradiction(assembler: Assembler) -> dict[str, Any] | None:
    """Return the reading that a cross-check suspects, in the form of `Estimator.suspicion`; None: none.

    If a second check confirms the position, the other reading is wrong; if two contradict it and none
    confirms it, the position is; otherwise it is undecided.
    """
    checks = cross_checks(assembler)
    failing = [check for check in checks if check["verdict"] == "contradicts"]
    if not failing:
        return None
    failed = failing[0]
    motor, check = failed["motor"], failed["check"]
    of_motor = [c for c in checks if c["motor"] == motor and c["check"] != "current"]
    cleared = check != "current" and any(c["verdict"] == "agrees" for c in of_motor)
    against = [c["check"] for c in of_motor if c["verdict"] == "contradicts"]
    if cleared:
        signal, what = f"motor_{check}", f"{_WORDS[check]} of motor {motor}: it contradicts the position, "
        what += "which another reading confirms"
    elif check != "current" and len(against) > 1:
        signal = "motor_position"
        what = f"position of motor {motor}: {' and '.join(_WORDS[c] for c in against)} contradict it"
    else:
        first = "torque" if check == "current" else "position"
        signal = f"motor_{first}_or_{check}"
        what = f"{first} and {_WORDS[check]} of motor {motor} contradict each other"
    return contradicted(signal, motor, what, failed["scale"] - 1.0, failed["std"])


_MODEL_ALARM = int(Status.MODEL_ALARM)
_BRIEF = ("impossible", "jumped")  # of single samples, reported by their status bit


class JointWatch:
    """The state of the joints; every event is reported once.

    Args:
        contradiction: the reading of a joint that a second one contradicts, or None.
    """

    def __init__(self, contradiction: Callable[[LoopJoint], dict[str, Any] | None]) -> None:
        self._contradiction = contradiction
        self._alarmed: set[str] = set()  # joints with a model alarm

    def check(self, loop_joint: LoopJoint, events: EventLog) -> None:
        """Report changes since the last call."""
        name, fault = loop_joint.name, loop_joint.fault
        text = f"{name}: no estimates since {fault}; rewrite its joint file or restart the daemon"
        over = f"{name}: estimates restart"
        events.keep(f"joint {name}", bool(fault), text, over, logging.ERROR)
        self._check_model(loop_joint, events)
        found = self._contradiction(loop_joint)
        text = f"{name}: {found['text']}" if found is not None else ""
        over = f"{name}: no reading contradicts another"
        events.keep(f"contradiction {name}", found is not None, text, over)
        suspicion = (
            loop_joint.pipeline.estimator.suspicion() if loop_joint.pipeline.status is not None else None
        )
        if suspicion is None:
            events.end(f"reading {name}", f"{name}: no reading is suspected")
        elif suspicion["reason"] not in _BRIEF:
            text = f"{name}: no valid estimates; suspected: {suspicion['text']}"
            events.begin(f"reading {name}", text)

    def _check_model(self, loop_joint: LoopJoint, events: EventLog) -> None:
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
            events.report(
                f"{loop_joint.name}: model alarm{residual_text(monitor)}: do not control on its numbers; "
                "record a minute of motion, then drivelink diagnose names the effect",
                logging.WARNING,
                key=f"{loop_joint.name}: model alarm",
            )
        else:
            self._alarmed.discard(loop_joint.name)
            events.report(f"{loop_joint.name}: the model alarm is over")


def residual_text(monitor: ModelMonitor | None) -> str:
    """Return the residual against its baseline in words, if known."""
    location = monitor.describe().get("location") if monitor is not None else None
    ratio = residual_ratio(monitor)
    where = f", likely at the {location}" if location else ""
    return "" if ratio is None else f": the residual is {number(ratio, 2)} times its baseline{where}"


def residual_ratio(monitor: ModelMonitor | None) -> float | None:
    """Return the largest residual over its baseline, if known."""
    described = monitor.describe() if monitor is not None else {}
    residuals, baselines = described.get("residual_nm") or (), described.get("floor_nm") or ()
    ratios = [r / b for r, b in zip(residuals, baselines, strict=False) if b > 0.0 and math.isfinite(r)]
    return max(ratios, default=None)


_NS = 1_000_000_000
_HEARTBEATS_LOST = 3.5  # of them missing: the node is gone
OPERATIONAL = 0x05
_STATE_BITS, _ENABLED, _LIMIT = 0x6F, 0x27, 0x0800  # of the statusword (CiA 402-2, 8.4.2)
_CONFLICTS = (
    "different frames in one cycle are not used: does another device have its node ID or identifiers?"
)
_COUNTED = (  # counter of a node; its smallest reported increase, and the message: its end is not worth one
    ("missing", 1, "frames are missing"),
    ("wrong_length", 1, "frames of the wrong length are not used"),
    ("conflicting", 3, _CONFLICTS),  # a single one may be a late frame
)


# What conditions begin with whose readings may be older ones.
LATE_FRAMES = ("missing ", "conflicting ", "too slow")
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
        self.missed_ns = -_NS  # when a frame was last missing
        self.received = counters.received
        self.sent = counters.received + counters.ignored
        self.counted = {name: (getattr(counters, name), -_NS) for name, *_ in _COUNTED}

    @property
    def assembler(self) -> Assembler:
        """Of its joint."""
        return self.loop_joint.pipeline.assembler

    def status(self, now: int) -> dict[str, Any]:
        """Return its part of the status document, at a time in ns."""
        node, assembler = self.layout.node_id, self.assembler
        word, faults = assembler.statuswords.get(node), assembler.faults
        age_s = round((now - self.heartbeat_ns) / _NS, 3)
        return {
            "state": nmt_state(self.state),
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
        for name, least, grows in _COUNTED:
            count, (before, since_ns) = getattr(counters, name), self.counted[name]
            if count - before >= least:
                self.counted[name] = (count, now)
                self.missed_ns = now if name == "missing" else self.missed_ns
                if name == "conflicting" and now - self.missed_ns < _BUNCH_NS:
                    self.bunched_ns = self.bunched_ns or now
                    if now - self.bunched_ns < _BUNCHES_NS:
                        continue  # a second device sends more frames, not fewer
                    grows = _BUNCHED
                events.begin(f"{name} {node}", f"node {node}: {grows}")
            elif now - since_ns > _NS:
                self.counted[name] = (count, now)
                if name == "conflicting":
                    self.bunched_ns = 0
                events.end(f"{name} {node}")

    def check(self, events: EventLog, now: int) -> None:
        """Report changes of heartbeat, fault and statusword since the last call, at a time in ns."""
        node, period_ms = self.layout.node_id, self.layout.heartbeat_ms
        age_ms, text = (now - self.heartbeat_ns) / 1e6, f"node {node}: heartbeat"
        lost = bool(period_ms) and age_ms > max(_HEARTBEATS_LOST * period_ms, 50.0)
        events.keep(f"heartbeat {node}", lost, f"{text} lost", f"{text} is back")
        faulted, text = node in self.assembler.faults, f"node {node} reports"
        events.keep(f"fault {node}", faulted, f"{text} a fault", f"{text} no fault")
        self._check_statusword(events)

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
            text = f"node {node} has left operation enabled ({drive_state(statusword)}): a brake may hold it"
            events.begin(f"enabled {node}", text)
        self.enabled = enabled
        text = f"node {node}: internal limit active (statusword bit 11)"
        over = f"node {node}: no internal limit is active"
        events.keep(f"limit {node}", bool(statusword & _LIMIT), text, over)
