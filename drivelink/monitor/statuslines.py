"""The status message of a joint in words: cycle and timing, nodes, what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.text import Text

from drivelink.monitor.braille import number

__all__ = ["status_lines", "status_text"]


def status_text(status: Mapping[str, Any]) -> str:
    """The cycle in a few plain words; what the message does not say is left out."""
    return " · ".join(part for part in (_cycle(status), _cpu(status)) if part)


def _cpu(status: Mapping[str, Any]) -> str:
    cpu = status.get("cpu_fraction")
    return f"cpu {100 * cpu:.0f} %" if isinstance(cpu, int | float) else ""


def _cycle(status: Mapping[str, Any]) -> str:
    """Rate, missed cycles, and what takes how long; short enough for 80 columns."""
    parts = []
    if isinstance(rate := status.get("rate_hz"), int | float):
        parts.append(f"{rate:.0f} Hz")
    if isinstance(missed := status.get("missed_cycles"), int):
        parts.append(f"missed {missed}")
    times = []
    for key, name in (("latency", "work"), ("response", "answer"), ("jitter", "late")):
        p99 = _of(status, key).get("p99_us")
        if isinstance(p99, int | float):
            times.append(f"{name} {p99:.0f}")
    if times:
        parts.append(f"p99 {', '.join(times)} µs")
    return " · ".join(parts)


def status_lines(status: Mapping[str, Any], width: int) -> list[Text]:
    """At most three lines of so many characters: cycle and timing, nodes, what is wrong."""
    if not status:
        return []
    lines = [_line("cycle", _cycle(status), width), _nodes(status, width), _wrong(status, width)]
    return [line for line in lines if line is not None]


def _line(label: str, text: str, width: int, style: str = "") -> Text | None:
    if not text:
        return None
    line = Text(no_wrap=True)
    line.append(f"{label:<11}", style="dim")
    line.append(text, style=style)
    line.truncate(width, overflow="ellipsis")
    return line


def _nodes(status: Mapping[str, Any], width: int) -> Text | None:
    nodes = _of(status, "nodes")
    if not nodes:
        return None
    line = Text(no_wrap=True)
    line.append(f"{'nodes':<11}", style="dim")
    for name, node in nodes.items():
        state = str(node.get("state", "")) if isinstance(node, Mapping) else str(node)
        fault = isinstance(node, Mapping) and bool(node.get("fault"))
        good = state == "operational" and not fault
        line.append(f"{name} ", style="bold")
        line.append(f"{state}{' FAULT' if fault else ''}  ", style="green" if good else "bold red")
    load = _of(status, "bus").get("load")
    if isinstance(load, int | float):
        line.append(f"bus {100 * load:.0f} %  ", style="dim")
    line.append(_cpu(status), style="dim")
    line.truncate(width, overflow="ellipsis")
    return line


def _wrong(status: Mapping[str, Any], width: int) -> Text | None:
    """What is wrong now; where nothing is, the residual."""
    found = [str(text) for key in ("drive_faults", "conditions") for text in status.get(key) or ()]
    if _of(status, "residual_alarm").get("active"):
        found.append("the model is not sufficient: drivelink diagnose tells why")
    if found:
        return _line("look here", "; ".join(dict.fromkeys(found)), width, "bold red")
    residual = status.get("residual_nm")
    if isinstance(residual, int | float):
        return _line("residual", f"{number(residual, 3)} N·m", width)
    return None


def _of(status: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """A part of the message, empty where it is none."""
    part = status.get(key)
    return part if isinstance(part, Mapping) else {}
