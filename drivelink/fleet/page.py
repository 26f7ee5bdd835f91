"""The fleet's report as one self-contained page."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from drivelink.output.units import in_words
from estimator.sample import SIGMA_95

_CHARTS = 400  # joints with a chart, the most urgent first; more would make the page too large
_BROKEN = 200
_REPORT = re.compile(r"diagnoses/(?:[\w.-]*[\w-][\w.-]*/)*report\.html")  # as a run writes it
_BLUE, _ORANGE, _GREY = "#005f9e", "#e0701a", "#999999"
_WIDTH, _LEFT, _RIGHT, _HEIGHT, _ROW = 900.0, 80.0, 10.0, 190.0, 18.0


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
    """Draw the document of `summarise`.

    Args:
        document: fleet.json.
    """
    joints = document["joints"]
    template = Template(Path(__file__).with_name("fleet.html").read_text(encoding="utf-8"))
    return template.substitute(
        headline=html.escape(_headline(joints)),
        about=html.escape(_about(document)),
        joints="".join(_line(joint, k < _CHARTS) for k, joint in enumerate(joints)),
        details="".join(_details(joint) for joint in joints[:_CHARTS]) + _rest(joints),
        broken=_broken(document["broken"]),
        method=html.escape(
            f"{document['method']}. {document['tests']} series tested; false discovery rate "
            f"{document['false_discovery_rate']:g}: of all changes named here, at most this share is "
            f"expected to be chance. Bars are 95 % intervals. drivelink {document['version']}, "
            f"{document['written']}."
        ),
    )


def _headline(joints: Sequence[dict[str, Any]]) -> str:
    changing = sum(joint["state"] == "changing" for joint in joints)
    verb = "changes" if changing == 1 else "change"
    return f"{changing} of {len(joints)} joint{'s' * (len(joints) != 1)} {verb}"


def _about(document: dict[str, Any]) -> str:
    days = f", {document['from'][:10]} to {document['to'][:10]}" if document["from"] else ""
    broken = len(document["broken"])
    return (
        f"{document['recordings']} recordings{days}"
        + (f"; {broken} could not be used" if broken else "")
        + "."
    )


def _line(joint: dict[str, Any], linked: bool) -> str:
    name = html.escape(joint["joint"])
    link = f'<a href="#{name}">{name}</a>' if linked else name
    spark = "".join(_spark(one) for one in joint["transmissions"])
    return (
        f'<tr><th>{link}</th><td><span class="state {joint["state"]}">{joint["state"]}</span></td>'
        f'<td>{html.escape(joint["sentence"])}</td><td class="spark">{spark}</td></tr>\n'
    )


def _spark(one: dict[str, Any]) -> str:
    frame = _frame(one, 2.0, 136.0, 26.0)
    points = ((frame.x(p["time"]), frame.y(p["stiffness_nm_rad"])) for p in one["series"])
    dots = "".join(_dot(x, y, _BLUE, radius=1.3) for x, y in points)
    return f'<svg viewBox="0 0 140 28" width="140" height="28">{_fitted(one, frame)}{dots}</svg>'


def _details(joint: dict[str, Any]) -> str:
    name = html.escape(joint["joint"])
    charts = "".join(_figure(joint, one) for one in joint["transmissions"])
    opened = "" if joint["state"] == "steady" else " open"
    return (
        f'<details id="{name}"{opened}><summary><b>{name}</b>{html.escape(joint["sentence"])}</summary>'
        f"{charts}{_effects(joint)}{_diagnoses(joint)}</details>\n"
    )


def _figure(joint: dict[str, Any], one: dict[str, Any]) -> str:
    frame = _frame(one, _LEFT, _WIDTH - _LEFT - _RIGHT, _HEIGHT)
    rows = joint["effects"]
    height = _HEIGHT + _ROW * len(rows) + 22.0
    parts = [_axes(frame, one, height), _bands(one, frame), _fitted(one, frame), _points(one, frame)]
    parts += [_strip(joint, effect, frame, _HEIGHT + _ROW * (k + 0.8)) for k, effect in enumerate(rows)]
    several = f", transmission {one['transmission']}" if len(joint["transmissions"]) > 1 else ""
    caption = (
        f"Stiffness{several} at a deflection of {one['deflection_rad']:.3g} rad, N·m/rad; scatter "
        f"{100 * one['scatter_relative']:.2g} %, q = {one['q_value']:.2g}. A click opens the diagnosis."
    )
    body = "".join(parts)
    return (
        f'<figure><svg viewBox="0 0 {_WIDTH:g} {height:g}" role="img">{body}</svg>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _frame(one: dict[str, Any], left: float, width: float, height: float) -> _Frame:
    points = one["series"]
    values = [p["stiffness_nm_rad"] for p in points] + [p["fitted_nm_rad"] for p in points]
    low, high = min(values), max(values)
    least = 0.01 * abs(values[0])  # minimum span of the axis: a steady joint looks steady
    if high - low < 2.0 * least:
        low, high = 0.5 * (low + high) - least, 0.5 * (low + high) + least
    pad = 0.12 * (high - low)
    times = [_seconds(p["time"]) for p in points]
    return _Frame(min(times), max(times), low - pad, high + pad, left, width, height)


def _axes(frame: _Frame, one: dict[str, Any], height: float) -> str:
    parts = []
    for value in _ticks(frame.low, frame.high):
        y = frame.y(value)
        parts.append(
            f'<line x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}" stroke="#e4e4e4"/>'
        )
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{value:.6g}</text>')
    points = one["series"]
    first, last = points[0]["time"][:10], points[-1]["time"][:10]
    parts.append(f'<text x="{_LEFT}" y="{height - 5:.1f}">{first}</text>')
    parts.append(f'<text x="{_WIDTH - _RIGHT}" y="{height - 5:.1f}" text-anchor="end">{last}</text>')
    return "".join(parts)


def _ticks(low: float, high: float) -> list[float]:
    """Round values between two, some four to eight of them."""
    power = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step = max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= (high - low) / 4.0)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _bands(one: dict[str, Any], frame: _Frame) -> str:
    """Where each change begins, with its 95 % interval."""
    parts = []
    for change in one["changes"]:
        low, x, high = (frame.x(change[key]) for key in ("since_earliest", "since", "since_latest"))
        box = f'x="{low - 2:.1f}" y="0" width="{high - low + 4:.1f}" height="{frame.height}"'
        line = f'x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{frame.height}" stroke-dasharray="4 3"'
        title = f"<title>{change['kind']} since {change['since'][:10]}</title>"
        parts.append(f'<rect {box} fill="{_ORANGE}" opacity=".13"/>')
        parts.append(f'<line {line} stroke="{_ORANGE}">{title}</line>')
    return "".join(parts)


def _fitted(one: dict[str, Any], frame: _Frame) -> str:
    if not one["changes"]:
        return ""
    line = " ".join(f"{frame.x(p['time']):.1f},{frame.y(p['fitted_nm_rad']):.1f}" for p in one["series"])
    return f'<polyline points="{line}" fill="none" stroke="{_ORANGE}" stroke-width="1.6"/>'


def _points(one: dict[str, Any], frame: _Frame) -> str:
    parts = []
    for p in one["series"]:
        x, reach = frame.x(p["time"]), SIGMA_95 * p["std_nm_rad"]
        y, low, high = (frame.y(p["stiffness_nm_rad"] + d) for d in (0.0, -reach, reach))
        tip = f"{_minute(p['time'])}: {p['stiffness_nm_rad']:.5g} ± {reach:.2g} N·m/rad, {p['verdict']}"
        bar = f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{low:.1f}" y2="{high:.1f}" stroke="{_BLUE}"/>'
        fill = _BLUE if p["verdict"] == "sufficient" else "#ffffff"
        parts.append(_link(p["report"], bar + _dot(x, y, fill, tip, stroke=_BLUE)))
    return "".join(parts)


def _strip(joint: dict[str, Any], effect: dict[str, Any], frame: _Frame, y: float) -> str:
    """One line below the chart: recordings in which an effect was found at a location."""
    colour = _ORANGE if effect["significant"] else _GREY
    parts = [
        f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end">{html.escape(effect["location"])}</text>'
    ]
    for one in joint["diagnoses"]:
        names = [name for name in one["effects"] if name.endswith(f"@{effect['location']}")]
        if names and frame.begin <= _seconds(one["time"]) <= frame.end:
            tip = f"{_minute(one['time'])}: {', '.join(names)}"
            parts.append(_link(one["report"], _dot(frame.x(one["time"]), y, colour, tip)))
    return "".join(parts)


def _dot(x: float, y: float, fill: str, tip: str = "", stroke: str = "none", radius: float = 3.4) -> str:
    title = f"<title>{html.escape(tip)}</title>" if tip else ""
    where = f'cx="{x:.1f}" cy="{y:.1f}" r="{radius}"'
    return f'<circle {where} fill="{fill}" stroke="{stroke}" stroke-width="1.4">{title}</circle>'


def _link(report: str, body: str, tip: str = "") -> str:
    if not _REPORT.fullmatch(report):  # the table is data: no other scheme, host or folder
        return body
    title = f' title="{html.escape(tip)}"' if tip else ""
    return f'<a href="{html.escape(report)}"{title}>{body}</a>'


def _minute(time: str) -> str:
    return time[:16].replace("T", " ")


def _effects(joint: dict[str, Any]) -> str:
    if not joint["effects"]:
        return ""
    heads = ("found", "at", "recordings", "since", "error that it removes", "")
    lines = []
    for effect in joint["effects"]:
        names = html.escape(", ".join(map(in_words, effect["names"])))
        since = effect["since"][:10] + (" (significant)" if effect["significant"] else "")
        count, share = f"{effect['recordings']} of {effect['of']}", f"{effect['error_relative']:.1%}"
        cells = (
            names,
            html.escape(effect["location"]),
            count,
            since,
            share,
            _link(effect["report"], "diagnosis"),
        )
        lines.append(_row("td", cells))
    return f"<table><thead>{_row('th', heads)}</thead><tbody>{''.join(lines)}</tbody></table>"


def _row(tag: str, cells: Iterable[str]) -> str:
    return "<tr>" + "".join(f"<{tag}>{cell}</{tag}>" for cell in cells) + "</tr>"


def _diagnoses(joint: dict[str, Any]) -> str:
    ones = joint["diagnoses"]
    links = ", ".join(_link(one["report"], one["time"][:10], one["sentence"] or "") for one in ones)
    return f"<details><summary>{len(ones)} diagnoses</summary><p>{links}</p></details>" if ones else ""


def _rest(joints: Sequence[dict[str, Any]]) -> str:
    left = len(joints) - _CHARTS
    return f"<p>{left} less urgent joints have no chart here; fleet.json has them.</p>" if left > 0 else ""


def _broken(rows: Iterable[dict[str, Any]]) -> str:
    rows = list(rows)
    if not rows:
        return ""
    lines = "".join(
        _row("td", (html.escape(r["recording"]), html.escape(r["error"]))) for r in rows[:_BROKEN]
    )
    more = f"<p>and {len(rows) - _BROKEN} more, in fleet.json.</p>" if len(rows) > _BROKEN else ""
    return f"<h2>Recordings that could not be used</h2><table><tbody>{lines}</tbody></table>{more}"


def _seconds(time: str) -> float:
    return datetime.fromisoformat(time).timestamp()
