"""The fleet's report as one self-contained page."""

import re
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.ticker import MaxNLocator

from drivelink.fleet.summary import LOOK, STATES, parameter_name, spaced
from drivelink.output.document import Block, Document, Grid, Markup, Paragraph, Rows, Section, drawn
from drivelink.output.document import page as draw
from drivelink.output.numbers import ticks_each, with_interval
from drivelink.plaintext import for_page, natural
from estimator.effects import in_words
from estimator.reasons import percent
from estimator.sample import SIGMA_95

_CHARTS = 400  # joints with a chart, the most urgent first; more would make the page too large
_BROKEN = 200
_REPORT = re.compile(r"diagnoses/(?:[\w.-]*[\w-][\w.-]*/)*report\.html")  # as a run writes it
_WIDTH, _LEFT, _RIGHT, _HEIGHT, _ROW = 900.0, 80.0, 10.0, 190.0, 18.0
_SPARK = (220.0, 44.0)
_SORTS = ("urgency", "name", "last recording")


class _Frame(NamedTuple):
    """From time and value to a place on a chart."""

    begin: float
    end: float
    low: float
    high: float
    left: float
    width: float
    height: float

    def x(self, time: str) -> float:
        span = self.end - self.begin
        return self.left + self.width * ((_seconds(time) - self.begin) / span if span else 0.5)

    def y(self, value: float) -> float:
        share = (value - self.low) / (self.high - self.low)
        return self.height * (1.0 - min(max(share, -0.05), 1.05))


def page(document: dict[str, Any]) -> str:
    """Draw the document of `summarise`."""
    joints = document["joints"]
    orders = _orders(joints)
    lines = "".join(_line(one, orders[k], k < _CHARTS) for k, one in enumerate(joints))
    details = "".join(map(_details, joints[:_CHARTS], orders))
    left = len(joints) - _CHARTS
    rest = f"{left} less urgent joints have no chart here; fleet.json has them." if left > 0 else ""
    method = (
        f"{document['method']}. {document['tests']} series tested; false discovery rate "
        f"{document['false_discovery_rate']:g}: of all changes named here, at most this share is "
        f"expected to be chance. Bars are 95 % intervals. drivelink {document['version']}, "
        f"{document['written']}."
    )
    table = f'<table class="all"><tbody class="joints sorted">{lines}</tbody></table>'
    sections = [
        Section("", [Markup(_controls(joints) + table)]),
        Section("Each joint", [Markup(f'<div class="sorted">{details}</div>'), Paragraph(rest)]),
        *_broken(document["broken"]),
        Section("How it was decided", [Paragraph(method, style="method")]),
    ]
    style = Path(__file__).with_name("fleet.css").read_text(encoding="utf-8") + _styles(joints)
    return draw(Document(_headline(joints), _about(document), sections, style))


def _headline(joints: Sequence[dict[str, Any]]) -> str:
    states = Counter(joint["state"] for joint in joints)
    look = [f"{states[state]} {state}" for state in LOOK if states[state]]
    if not look:
        return f"No change in {len(joints)} joint{'s' * (len(joints) != 1)}"
    count = sum(states[state] for state in LOOK)
    need = "needs" if count == 1 else "need"
    return f"{count} of {len(joints)} joint{'s' * (len(joints) != 1)} {need} a look: {', '.join(look)}"


def _orders(joints: Sequence[dict[str, Any]]) -> list[str]:
    """Style of each joint with its place by each way of sorting."""
    names = sorted((joint["joint"] for joint in joints), key=natural)
    lasts = sorted({joint["last"] or "" for joint in joints}, reverse=True)
    return [
        f"--by0:{k};--by1:{names.index(joint['joint'])};--by2:{lasts.index(joint['last'] or '')}"
        for k, joint in enumerate(joints)
    ]


def _controls(joints: Sequence[dict[str, Any]]) -> str:
    """Sort and filter, which work by styles alone."""
    states = Counter(joint["state"] for joint in joints)
    sorts = "".join(
        f'<label><input type="radio" name="by" id="by{k}"{" checked" * (k == 0)}>{name}</label>'
        for k, name in enumerate(_SORTS)
    )
    shows = "".join(
        f'<label><input type="checkbox" id="show-{state}" checked>{states[state]} {state}</label>'
        for state in STATES
        if states[state]
    )
    return "".join(
        f"<fieldset><legend>{legend}</legend>{inputs}</fieldset>"
        for legend, inputs in (("sort by", sorts), ("show", shows))
    )


def _styles(joints: Sequence[dict[str, Any]]) -> str:
    rules = [f"body:has(#by{k}:checked) .sorted > * {{ order: var(--by{k}); }}" for k in range(len(_SORTS))]
    rules += [
        f"body:has(#show-{state}:not(:checked)) .is-{state} {{ display: none; }}"
        for state in sorted({joint["state"] for joint in joints})
    ]
    return "\n".join(rules)


def _about(document: dict[str, Any]) -> str:
    days = f", {document['from'][:10]} to {document['to'][:10]}" if document["from"] else ""
    broken = len(document["broken"])
    unused = f"; {broken} could not be used" if broken else ""
    return f"{document['recordings']} recordings{days}{unused}."


def _line(joint: dict[str, Any], order: str, linked: bool) -> str:
    name, state = for_page(joint["joint"]), joint["state"]
    link = f'<a href="#{name}">{name}</a>' if linked else name
    spark = "".join(_spark(joint, one) for one in joint["transmissions"])
    return (
        f'<tr class="is-{state}" style="{order}"><th>{link}</th>'
        f'<td><span class="state {state}">{state}</span></td>'
        f'<td>{for_page(joint["sentence"])}</td><td class="spark">{spark}</td></tr>\n'
    )


def _spark(joint: dict[str, Any], one: dict[str, Any]) -> str:
    width, height = _SPARK
    frame = _frame(joint, one, 4.0, width - 8.0, height - 4.0)
    places = [(frame.x(p["time"]), frame.y(p["stiffness_nm_rad"])) for p in one["series"]]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    last = _dot(*places[-1], "dot full", radius=3.2)
    missing = _missing(joint, one, frame, linked=False)
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}" role="img">'
        f'{_fitted(one, frame)}<polyline class="curve" points="{line}"/>{last}{missing}</svg>'
    )


def _details(joint: dict[str, Any], order: str) -> str:
    name = for_page(joint["joint"])
    charts = "".join(_figure(joint, one) for one in joint["transmissions"])
    others = "".join(_small(joint, one) for one in joint["parameters"])
    opened = " open" if joint["state"] in LOOK else ""
    return (
        f'<details id="{name}" class="joint is-{joint["state"]}" style="{order}"{opened}>'
        f"<summary><b>{name}</b>{for_page(joint['sentence'])}</summary>"
        f'{charts}<div class="small">{others}</div>{drawn(_effects(joint))}{_diagnoses(joint)}</details>\n'
    )


def _small(joint: dict[str, Any], one: dict[str, Any]) -> str:
    """Chart of one other parameter over time."""
    series = [
        {"time": p["time"], "stiffness_nm_rad": p["value"], "fitted_nm_rad": p["fitted"],
         "std_nm_rad": p["std"] or 0.0, "report": p["report"], "verdict": ""}
        for p in one["series"]
    ]  # fmt: skip
    shown = {"series": series, "changes": one["changes"], "unit": one["unit"]}
    frame = _frame(joint, shown, _LEFT, 0.5 * _WIDTH - _LEFT - _RIGHT, 110.0)
    body = _axes(frame, 132.0) + _bands(shown, frame) + _fitted(shown, frame) + _points(shown, frame)
    words = [parameter_name(one["name"]), one["unit"]]
    if len(joint["transmissions"]) > 1:
        words.append(f"motor {one['motor']}")
    return (
        f'<figure><svg viewBox="0 0 {0.5 * _WIDTH:g} 132" role="img">{body}</svg>'
        f"<figcaption>{for_page(', '.join(filter(None, words)))}</figcaption></figure>"
    )


def _figure(joint: dict[str, Any], one: dict[str, Any]) -> str:
    charts = _chart(joint, one, _WIDTH, "wide") + _chart(joint, one, 0.5 * _WIDTH, "narrow")
    several = f" of motor {one['transmission']}" if len(joint["transmissions"]) > 1 else ""
    caption = (
        f"Stiffness{several} at a deflection of {one['deflection_rad']:.3g} "
        f"{one['deflection_unit']}, {one['unit']}; scatter {100 * one['scatter_relative']:.2g} %"
        + (f", a change from a false discovery rate of {one['q_value']:.2g} on" if one["significant"] else "")
        + ". A cross at the bottom is a "
        "recording that shows no stiffness, a hollow dot a model that was not sufficient, a dot below the "
        "axis an effect that was found at that place. A click opens the diagnosis."
    )
    return f'<figure class="large">{charts}<figcaption>{for_page(caption)}</figcaption></figure>'


def _chart(joint: dict[str, Any], one: dict[str, Any], width: float, name: str) -> str:
    """Chart of the stiffness over time, for a screen or for a phone."""
    frame = _frame(joint, one, _LEFT, width - _LEFT - _RIGHT, _HEIGHT)
    rows = joint["effects"]
    height = _HEIGHT + _ROW * len(rows) + 22.0
    parts = [_axes(frame, height), _bands(one, frame), _fitted(one, frame), _points(one, frame)]
    parts.append(_missing(joint, one, frame))
    parts += [_strip(joint, effect, frame, _HEIGHT + _ROW * (k + 0.8)) for k, effect in enumerate(rows)]
    return f'<svg class="{name}" viewBox="0 0 {width:g} {height:g}" role="img">{"".join(parts)}</svg>'


def _missing(joint: dict[str, Any], one: dict[str, Any], frame: _Frame, *, linked: bool = True) -> str:
    """Return a cross for each recording that shows no stiffness of this transmission."""
    parts = []
    for row in joint["unusable"]:
        if row["transmission"] not in (None, one["transmission"]):
            continue
        x, y, r = frame.x(row["time"]), frame.height - 6.0, 3.5
        title = f"<title>{for_page(_minute(row['time']) + ': ' + row['reason'])}</title>" if linked else ""
        cross = f"M{x - r:.1f} {y - r:.1f}l{2 * r} {2 * r}m0 {-2 * r}l{-2 * r} {2 * r}"
        mark = f'<path class="cross" d="{cross}">{title}</path>'
        parts.append(_link(row["report"], mark) if linked else mark)
    return "".join(parts)


def _frame(joint: dict[str, Any], one: dict[str, Any], left: float, width: float, height: float) -> _Frame:
    """Return the range of the values, and the time of all recordings of the joint, usable or not."""
    points = one["series"]
    values = [p["fitted_nm_rad"] for p in points]
    values += [p["stiffness_nm_rad"] + d * p["std_nm_rad"] for p in points for d in (-SIGMA_95, SIGMA_95)]
    low, high = min(values), max(values)
    # Minimum span of the axis: a steady joint looks steady.
    least = 0.01 * abs(points[0]["stiffness_nm_rad"]) or 1e-9
    if high - low < 2.0 * least:
        low, high = 0.5 * (low + high) - least, 0.5 * (low + high) + least
    pad = 0.12 * (high - low)
    times = [_seconds(p["time"]) for p in (*points, *joint["unusable"], *joint["diagnoses"])]
    return _Frame(min(times), max(times), low - pad, high + pad, left, width, height)


def _axes(frame: _Frame, height: float) -> str:
    parts = []
    right = frame.left + frame.width
    ticks = MaxNLocator(8 if frame.height > 150.0 else 4, steps=[1, 2, 5, 10])
    first, second, *_ = ticks.tick_values(frame.low, frame.high)
    for value, text in ticks_each(frame.low, frame.high, second - first):
        y = frame.y(value)
        parts.append(f'<line class="grid" x1="{frame.left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{frame.left - 8}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    begin, end = (datetime.fromtimestamp(t, UTC).date() for t in (frame.begin, frame.end))
    parts.append(f'<text x="{frame.left}" y="{height - 5:.1f}">{begin}</text>')
    parts.append(f'<text x="{right}" y="{height - 5:.1f}" text-anchor="end">{end}</text>')
    return "".join(parts)


def _bands(one: dict[str, Any], frame: _Frame) -> str:
    """Where each change begins, with its 95 % interval."""
    parts = []
    for change in one["changes"]:
        low, x, high = (frame.x(change[key]) for key in ("since_earliest", "since", "since_latest"))
        box = f'x="{low - 2:.1f}" y="0" width="{high - low + 4:.1f}" height="{frame.height}"'
        line = f'x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{frame.height}" stroke-dasharray="4 3"'
        title = f"<title>{change['kind']} since {change['since'][:10]}</title>"
        parts.append(f'<rect class="when" {box}/><line class="fit" {line}>{title}</line>')
    return "".join(parts)


def _fitted(one: dict[str, Any], frame: _Frame) -> str:
    if not one["changes"]:
        return ""
    line = " ".join(f"{frame.x(p['time']):.1f},{frame.y(p['fitted_nm_rad']):.1f}" for p in one["series"])
    return f'<polyline class="fit" points="{line}"/>'


def _points(one: dict[str, Any], frame: _Frame) -> str:
    parts = []
    for p in one["series"]:
        x, reach = frame.x(p["time"]), SIGMA_95 * p["std_nm_rad"]
        y, low, high = (frame.y(p["stiffness_nm_rad"] + d) for d in (0.0, -reach, reach))
        value = with_interval(p["stiffness_nm_rad"], reach, one["unit"])
        tip = ", ".join(filter(None, (f"{_minute(p['time'])}: {value}", p["verdict"])))
        bar = f'<line class="bar" x1="{x:.1f}" x2="{x:.1f}" y1="{low:.1f}" y2="{high:.1f}"/>'
        kind = "dot full" if p["verdict"] in ("sufficient", "") else "dot"
        parts.append(_link(p["report"], bar + _dot(x, y, kind, tip)))
    return "".join(parts)


def _strip(joint: dict[str, Any], effect: dict[str, Any], frame: _Frame, y: float) -> str:
    """Return one line below the chart: recordings in which an effect was found at a location."""
    kind = "found new" if effect["significant"] else "found"
    place = for_page(spaced(effect["location"]))
    parts = [f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{place}</text>']
    for one in joint["diagnoses"]:
        if names := [name for name in one["effects"] if name.endswith(f"@{effect['location']}")]:
            tip = f"{_minute(one['time'])}: {', '.join(names)}"
            parts.append(_link(one["report"], _dot(frame.x(one["time"]), y, kind, tip)))
    return "".join(parts)


def _dot(x: float, y: float, kind: str, tip: str = "", radius: float = 3.4) -> str:
    title = f"<title>{for_page(tip)}</title>" if tip else ""
    where = f'cx="{x:.1f}" cy="{y:.1f}" r="{radius}"'
    return f'<circle class="{kind}" {where}>{title}</circle>'


def _link(report: str, body: str, tip: str = "") -> str:
    if not _REPORT.fullmatch(report):  # the table is data: no other scheme, host or folder
        return body
    title = f' title="{for_page(tip)}"' if tip else ""
    return f'<a href="{for_page(report)}"{title}>{body}</a>'


def _minute(time: str) -> str:
    return time[:16].replace("T", " ")


def _effects(joint: dict[str, Any]) -> list[Grid]:
    rows: Rows = []
    for effect in joint["effects"]:
        before, after = (percent(effect[f"error_{when}_relative"], 2) for when in ("before", "after"))
        rows.append(
            (
                ", ".join(map(in_words, effect["names"])),
                spaced(effect["location"]),
                f"{effect['recordings']} of {effect['of']} recordings",
                f"since {effect['since'][:10]}" + (" (significant)" if effect["significant"] else ""),
                f"{before} → {after} of the torque (median)",
                Markup(_link(effect["report"], "diagnosis")),
            )
        )
    return [Grid(("found", "at", "in", "", "error without → with it", ""), rows)] if rows else []


def _diagnoses(joint: dict[str, Any]) -> str:
    ones = joint["diagnoses"]
    links = ", ".join(_link(one["report"], one["time"][:10], one["sentence"] or "") for one in ones)
    return f"<details><summary>{len(ones)} diagnoses</summary><p>{links}</p></details>" if ones else ""


def _broken(broken: Sequence[dict[str, Any]]) -> list[Section]:
    rows: Rows = [(row["recording"], row["error"]) for row in broken[:_BROKEN]]
    blocks: list[Block] = [Grid(("recording", "why it could not be used"), rows)]
    if len(broken) > _BROKEN:
        blocks.append(Paragraph(f"and {len(broken) - _BROKEN} more, in fleet.json."))
    return [Section("Recordings that could not be used", blocks)] if rows else []


def _seconds(time: str) -> float:
    return datetime.fromisoformat(time).timestamp()
