"""The end of a demo: truth beside estimate, and the daemon's timing."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from drivelink.demo.comparison import Comparison
from drivelink.demo.rig import RunSummary
from drivelink.output.digits import number, value_and_interval
from estimator.sample import SIGMA_95, Status


def closing_table(
    case: str, comparison: Comparison, summary: RunSummary, received: int, period_s: float
) -> RenderableType:
    """Return the last pair of truth and estimate, the errors of the whole run, and the cycle's figures."""
    errors = comparison.errors()
    table = Table(title=f"{case}: truth beside estimate", title_justify="left")
    for heading in ("", "truth", "estimate", "95 %", "rms error"):
        table.add_column(heading, justify="left" if not heading else "right", no_wrap=True)
    if comparison.latest is not None:
        estimate, truth = comparison.latest
        value, half = value_and_interval(estimate.stiffness_nm_rad, SIGMA_95 * estimate.stiffness_std_nm_rad)
        table.add_row(
            "stiffness / N·m/rad",
            number(truth.stiffness_nm_rad, 5),
            value,
            f"± {half}" if half else "",
            _percent(errors.stiffness),
        )
        table.add_row(
            "flexibility torque / N·m",
            number(truth.flexibility_torque_nm),
            number(estimate.flexibility_torque_nm),
            "",
            _percent(errors.flexibility_torque),
        )
    lines = [
        f"{summary.cycles} cycles, {summary.missed_cycles} missed, {received} estimates received over zenoh",
        f"a cycle's work p99 {summary.work_p99_us:.0f} µs, SYNC late by p99 {summary.lateness_p99_us:.0f} µs",
    ]
    if errors.cycles:
        over = f"rms error: over all {errors.cycles} valid cycles ({errors.cycles * period_s:.1f} s), "
        lines.insert(0, f"{over}relative to the truth's rms")
        held = f"the 95 % interval held the truth in {_percent(errors.covered)}"
        lines.append(f"{held} of {errors.cycles} valid cycles")
    else:
        lines.insert(0, "no valid cycle, so no error: an estimate is valid after some seconds of motion")
    if comparison.latest is not None:
        valid = comparison.latest[0].status & Status.VALID
        doubt = "" if valid else ", which is not valid"
        lines.insert(0, f"truth, estimate and its 95 % interval: of the last cycle{doubt}")
    return Group(table, *map(Text, lines))


def as_json(case: str, comparison: Comparison, summary: RunSummary, received: int) -> dict[str, Any]:
    """Return the same as a JSON object; missing numbers are null."""
    errors = comparison.errors()
    return {
        "case": case,
        "cycles": summary.cycles,
        "missed_cycles": summary.missed_cycles,
        "received": received,
        "valid_cycles": errors.cycles,
        "stiffness_error_relative": _number(errors.stiffness),
        "flexibility_torque_error_relative": _number(errors.flexibility_torque),
        "stiffness_interval_coverage": _number(errors.covered),
        "work_p99_us": summary.work_p99_us,
        "lateness_p99_us": summary.lateness_p99_us,
    }


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %" if math.isfinite(value) else "–"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
