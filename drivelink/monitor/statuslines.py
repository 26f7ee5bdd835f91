"""Shows the status and model documents of a joint in words.

`shape` extracts the shown parts and checks their types, so that views get texts and finite numbers from any
document. Terminal, web page and plain lines use its result.
"""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import islice
from textwrap import wrap
from typing import Any, NamedTuple

from rich.text import Text

from drivelink.loop import finding as findings
from drivelink.monitor.braille import gauge
from drivelink.output.numbers import number
from drivelink.plaintext import clean_text, natural
from estimator.transmissions import RIGID

MODEL_ALARM_ADVICE = (
    "the model is not sufficient: do not control on its numbers; record a minute of motion "
    "(drivelink record), then drivelink diagnose names the effect and writes a better joint file"
)
_SHORT_ADVICE = "model alarm: do not control on it; drivelink diagnose says why"
_MOST = 16  # entries of a list that a view shows
_WORDS = 200  # characters of one entry
_GAUGE, _LABEL = 10, 11  # characters
_NO_BASELINE = "no baseline: drivelink fit --write makes one"
_SETTLING = "its filters are settling"
_SPANS = ((86400.0, "days"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))
_SAME_EVENT_S = 2.0  # between an event and its line in the log, at most
_FULL = 2.0  # times its baseline where a gauge is full


class NodeState(NamedTuple):
    """A node of the bus: id, state, whether it is good."""

    id: str
    text: str
    good: bool


class Event(NamedTuple):
    """An event: UNIX time, s; text; count."""

    time_s: float
    text: str
    times: int


class ResidualGauge(NamedTuple):
    """Residual of a torque balance, and its baseline, N·m."""

    name: str
    residual_nm: float
    baseline_nm: float

    @property
    def ratio(self) -> float:
        """Residual over baseline."""
        return self.residual_nm / self.baseline_nm


@dataclass(frozen=True, slots=True, kw_only=True)
class Shown:
    """Shown parts of the documents; empty if missing."""

    state: str = ""  # in a word
    rate: str = ""  # of the cycle; texts
    missed: str = ""
    cpu: str = ""
    load: str = ""
    times: tuple[tuple[str, float], ...] = ()  # (name, 99th percentile, µs)
    nodes: tuple[NodeState, ...] = ()  # of the bus
    wrong: tuple[str, ...] = ()  # faults and conditions that hold now
    not_valid: str = ""  # why the estimate is not valid; empty: it is
    rigid: bool = False  # whether the joint has no stiffness
    alarm: bool = False  # whether the model alarm is on
    location: str = ""  # likely location of the missing effect
    torque_std_nm: float | None = None  # of the flexibility torque, N·m, or None
    residual_nm: float | None = None  # of the whole model, N·m, or None
    no_gauge: str = ""  # why `balances` is empty, where it is
    balances: tuple[ResidualGauge, ...] = ()  # residual and baseline per motor and of the link
    improved: tuple[float, float] | None = None  # relative error before and after diagnose
    events: tuple[Event, ...] = ()  # the last ones, newest first
    recording: str = ""  # where to

    @property
    def ratio(self) -> float | None:
        """The largest residual over its baseline."""
        return max((balance.ratio for balance in self.balances), default=None)

    @property
    def advice(self) -> str:
        """What to do about the model alarm; empty without one."""
        where = f" (likely at the {self.location})" if self.location else ""
        return f"model alarm{where}: {MODEL_ALARM_ADVICE}" if self.alarm else ""

    @property
    def look_here(self) -> str:
        """The advice, and what is wrong, in one line; empty where all is well."""
        wrong = clean_text("; ".join(self.wrong), 2 * _WORDS)
        return " · ".join(text for text in (self.advice, wrong) if text)


def shape(status: Mapping[str, Any], model: Mapping[str, Any] | None = None) -> Shown:
    """Extract the shown parts of a status and a model document, whatever they contain."""
    alarm = _part(status, "residual_alarm")
    transmissions = status.get("transmissions")
    motors = min(len(transmissions), 2) if isinstance(transmissions, list) else 1
    nodes = _part(status, "nodes")
    times = [(name, _number(_part(status, key).get("p99_us"))) for key, name in _TIMES]
    wrong = dict.fromkeys((*_texts(status.get("drive_faults")), *_texts(status.get("conditions"))))
    rate, cpu, load = (_number(v) for v in (status.get("rate_hz"), status.get("cpu_fraction"),
                                            _part(status, "bus").get("load")))  # fmt: skip
    missed, cycles = _number(status.get("missed_cycles")), _number(status.get("cycles"))
    total = f" of {cycles:.0f}" if cycles is not None else ""
    return Shown(
        state=_text(status.get("state")),
        rate=f"{rate:.0f} Hz" if rate is not None else "",
        missed=f"{missed:.0f}{total}" if missed is not None else "",
        cpu=f"{100 * cpu:.0f} %" if cpu is not None else "",
        load=f"{100 * load:.0f} %" if load is not None and status.get("state") != "bus lost" else "",
        times=tuple((name, p99) for name, p99 in times if p99 is not None),
        nodes=tuple(
            _node(name, nodes[name], heard=status.get("state") != "bus lost")
            for name in sorted(islice(nodes, _MOST), key=natural)
        ),
        wrong=_together(wrong),
        not_valid=_text(status.get("not_valid")),
        rigid=_rigid(model or {}),
        alarm=alarm.get("active") is True,
        location=_text(alarm.get("location")),
        torque_std_nm=_number(status.get("flexibility_torque_std_nm")),
        residual_nm=_number(status.get("residual_nm")) or None,  # 0: there was no motion to judge it by
        no_gauge=_SETTLING if alarm.get("watching") is True else _NO_BASELINE,
        balances=_balances(alarm, motors),
        improved=_improved(model or {}),
        events=_events(status.get("events")),
        recording=_text(status.get("recording")),
    )


_TIMES = (("latency", "work"), ("response", "answer"), ("jitter", "late"))


def _part(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return a mapping in a document; empty if it is not one."""
    part = document.get(key)
    return part if isinstance(part, Mapping) else {}


def _number(value: Any) -> float | None:
    """Return a finite number of a document, which holds no other ones."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _text(value: Any) -> str:
    return clean_text(value, _WORDS) if isinstance(value, str) else ""


def _texts(value: Any) -> list[str]:
    return [_text(item) for item in value[:_MOST] if _text(item)] if isinstance(value, list) else []


def _together(remarks: Iterable[str]) -> tuple[str, ...]:
    """Say once what is the same of several nodes."""
    nodes: dict[str, list[str]] = {}
    for remark in remarks:
        node, _, said = remark.partition(": ")
        whose = node.removeprefix("node ")
        nodes.setdefault(said if whose.isdecimal() else remark, []).append(whose)
    return tuple(
        f"node{'s' * (len(whose) > 1)} {', '.join(whose)}: {said}" if whose[0].isdecimal() else said
        for said, whose in ((said, sorted(each, key=natural)) for said, each in nodes.items())
    )


def _node(name: str, node: Any, *, heard: bool) -> NodeState:
    """Return one entry of `nodes`; what was true while the bus was there says nothing without it."""
    if not heard:
        return NodeState(_text(name), "not heard", False)
    if not isinstance(node, Mapping):
        return NodeState(_text(name), _text(node), False)
    state, fault = _text(node.get("state")), bool(node.get("fault"))
    emergency = _text(node.get("emergency"))
    text = f"{state}{' FAULT' if fault else ''}{f' EMCY {emergency}' if emergency else ''}"
    return NodeState(_text(name), text, state == "operational" and not fault)


def _events(value: Any) -> tuple[Event, ...]:
    events = []
    for event in reversed(value[-_MOST:]) if isinstance(value, list) else ():
        time_s = _number(event.get("time")) if isinstance(event, Mapping) else None
        if time_s is not None and 0.0 <= time_s < 1e11:
            events.append(Event(time_s, _text(event.get("text")), int(_number(event.get("count")) or 1)))
    return tuple(events)


def _balances(alarm: Mapping[str, Any], motors: int) -> tuple[ResidualGauge, ...]:
    """Residual and baseline of each motor's and the link's balance, if both are known."""
    residuals, baselines = alarm.get("residual_nm"), alarm.get("floor_nm")
    if not isinstance(residuals, list) or not isinstance(baselines, list):
        return ()
    pairs = [(_number(r), _number(b)) for r, b in zip(residuals[:3], baselines[:3], strict=False)]
    names = ["motor"] if motors == 1 else [f"motor {i + 1}" for i in range(motors)]
    return tuple(
        ResidualGauge(name, residual, baseline)
        for name, (residual, baseline) in zip([*names, "link"], pairs, strict=False)
        if residual is not None and baseline is not None and residual >= 0.0 and baseline > 0.0
    )


def _rigid(model: Mapping[str, Any]) -> bool:
    motors = model.get("motors")
    motor = motors[0] if isinstance(motors, list) and motors else None
    return isinstance(motor, Mapping) and _part(motor, "transmission").get("model") == RIGID


def _improved(model: Mapping[str, Any]) -> tuple[float, float] | None:
    """Relative torque error before and after diagnose, from the model's provenance."""
    found = _part(_part(model, "provenance"), "diagnosis")
    before, after = _number(found.get("error_before_relative")), _number(found.get("error_after_relative"))
    return None if before is None or after is None else (before, after)


def status_text(
    status: Mapping[str, Any],
    model: Mapping[str, Any] | None = None,
    finding: Mapping[str, Any] | None = None,
) -> str:
    """Return cycle, residual, advice, conditions and finding as text, as far as documents contain them."""
    shown = shape(status, model)
    why = f"not valid: {shown.not_valid}" if shown.not_valid else ""
    found = finding_text(finding or {}, shown)
    found = found and f"finding: {found}"
    parts = (_cycle(shown), _cpu(shown), _residual(shown), why, shown.look_here, found)
    return " · ".join(part for part in parts if part)


def finding_text(finding: Mapping[str, Any], shown: Shown) -> str:
    """Return a finding in words after its age; empty without one."""
    found = _text(findings.line(finding))
    return f"{aged}: {found}" if found and (aged := finding_age(finding, shown)) else found


def finding_age(finding: Mapping[str, Any], shown: Shown) -> str:
    """Return how long ago the event of a finding was, and whether the present alarm is another one."""
    event_s = findings.event_s(finding)
    if event_s is None:
        return ""
    ago_s = max(0.0, time.time() - event_s)
    size, unit = next((one for one in _SPANS if ago_s >= 2.0 * one[0]), _SPANS[-1])
    begun = (event.time_s for event in shown.events if ": model alarm" in event.text)
    earlier = shown.alarm and event_s + _SAME_EVENT_S < next(begun, 0.0)
    return f"{ago_s / size:.0f} {unit} ago{', an earlier event' if earlier else ''}"


def external_doubt(status: Mapping[str, Any] | None, valid: bool) -> str:
    """Return why an external torque that is not valid is not, where the estimate is `valid` or not."""
    if valid:
        return _SETTLING
    return shape(status or {}).not_valid or "the estimate is not valid"


def _cpu(shown: Shown) -> str:
    return f"cpu {shown.cpu}" if shown.cpu else ""


def _cycle(shown: Shown) -> str:
    """Rate, missed cycles and durations, in at most 80 columns."""
    times = ", ".join(f"{name} {p99:.0f}" for name, p99 in shown.times)
    missed = f"missed {shown.missed.split(' ')[0]}" if shown.missed else ""
    return " · ".join(part for part in (shown.rate, missed, f"p99 {times} µs" if times else "") if part)


def _residual(shown: Shown) -> str:
    """Return the residual in words, with the improvement by diagnose."""
    if shown.ratio is not None:
        text = f"residual {number(shown.ratio, 2)} × baseline"
    elif shown.residual_nm is not None:
        text = f"residual {number(shown.residual_nm, 3)} N·m"
    else:
        return ""
    if shown.improved is not None:
        before, after = shown.improved
        text += f" ({100 * before:.1f} % before its effects, {100 * after:.1f} % after)"
    return text


def status_lines(
    status: Mapping[str, Any],
    width: int,
    model: Mapping[str, Any] | None = None,
    finding: Mapping[str, Any] | None = None,
    most: int | None = None,
) -> list[Text]:
    """Return cycle, nodes and residual; why not valid, advice, problems and the finding in two lines each.

    Args:
        most: number of lines that there is room for; where more are left out, the last one ends with "…".
    """
    if not status:
        return []
    shown = shape(status, model)
    advice = shown.advice if len(shown.advice) + _LABEL <= width else _SHORT_ADVICE
    rows: list[tuple[str, list[tuple[str, str]]]] = [
        ("cycle", [(_cycle(shown), "")]),
        ("nodes", _nodes(shown)),
        ("residual", _gauges(shown, width - _LABEL)),
        ("not valid", [(shown.not_valid, "red")]),
        ("look here", [(advice if shown.alarm else "", "bold red")]),
        ("look here", [("; ".join(shown.wrong), "bold red")]),
        ("finding", [(finding_text(finding or {}, shown), "bold")]),
    ]
    lines = []
    for label, parts in rows:
        if len(parts) == 1:
            text, style = parts[0]
            halves = wrap(text, max(width - _LABEL, 8), max_lines=2, placeholder=" …")
            parts = [("\n".ljust(_LABEL + 1).join(halves), style)]
        if any(text for text, _ in parts):
            whole = Text.assemble((f"{label:<{_LABEL}}", "dim"), *parts, no_wrap=True)
            for line in whole.split("\n"):
                line.truncate(width, overflow="ellipsis")
                lines.append(line)
    if most and lines[most:]:
        lines[most - 1].truncate(width - 2)
        lines[most - 1].append(" …")
    return lines[:most]


def _nodes(shown: Shown) -> list[tuple[str, str]]:
    parts = []
    for node in shown.nodes:
        parts += [(f"{node.id} ", "bold"), (f"{node.text}  ", "green" if node.good else "bold red")]
    if parts:
        parts += [(f"bus {shown.load}  " if shown.load else "", "dim"), (_cpu(shown), "dim")]
    return parts


def _gauges(shown: Shown, width: int) -> list[tuple[str, str]]:
    """Gauges of each residual, half full at the baseline; shorter, without their unit, where it is narrow."""
    if not shown.balances:
        return [(_residual(shown).removeprefix("residual "), "")]
    parts: list[tuple[str, str]] = []
    for bar, unit in ((_GAUGE, "of the baseline  "), (_GAUGE // 2, "")):
        parts = []
        for balance in shown.balances:
            style = "bold red" if shown.alarm and balance.ratio == shown.ratio else "green"
            parts += [(f"{balance.name} " if len(shown.balances) > 1 else "", "dim")]
            parts += [(gauge(balance.ratio, _FULL, bar), style), (f" {number(balance.ratio, 2)} ×  ", "")]
        parts.append((unit, "dim"))
        if sum(len(text) for text, _ in parts) <= width:
            break
    if shown.improved is not None:
        before, after = (100 * part for part in shown.improved)
        parts.append((f"effects: {before:.1f} → {after:.1f} %", "dim"))
    return parts
