"""Several joints in the terminal, one line each."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich.table import Table
from rich.text import Text

from drivelink.monitor.braille import sparkline
from drivelink.monitor.view import ESTIMATE, JointView, half_interval
from drivelink.output.digits import number, value_and_interval


def joints_table(views: Mapping[str, JointView], width: int) -> Table:
    """Return several joints, one line each; columns that do not fit are omitted."""
    sparks = width - 100
    columns = [("joint", 10), ("stiffness / N·m/rad", 19), ("torque / N·m", 12)]
    if width >= 80:
        columns.append(("deflection / rad", 16))
    table = Table(expand=True, box=None, pad_edge=False)
    for heading, least in columns:
        table.add_column(heading, no_wrap=True, min_width=least)
    if sparks >= 8:
        table.add_column("last seconds", no_wrap=True, min_width=sparks)
    table.add_column("state", ratio=1, overflow="fold", min_width=12)
    for name, view in sorted(views.items()):
        estimate = view.history.latest
        ink = ESTIMATE if view.live else "dim"
        cells = [Text(name, style="bold")]
        if estimate is None:
            cells += [Text("–")] * (len(table.columns) - 2) + [Text(view.state or "–")]
        else:
            deflection = " ".join(number(one.deflection_rad, 3) for one in estimate.transmissions)
            value, half = value_and_interval(estimate.stiffness_nm_rad, half_interval(estimate))
            cells.append(Text.assemble((value, ink), f" ± {half}" if half else ""))
            cells.append(Text(number(estimate.flexibility_torque_nm)))
            cells += [Text(deflection)] if width >= 80 else []
            if sparks >= 8:
                series = [m.stiffness_nm_rad if m.valid else math.nan for m in view.history.window()]
                cells.append(Text(sparkline(series, sparks), style=ink))
            worst = [(label, style) for label, style in view.flags if style != "green"]
            cells.append(Text(*worst[0]) if worst else Text(view.state or "valid", style="green"))
        table.add_row(*cells)
    return table
