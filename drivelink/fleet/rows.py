"""What a joint's rows of the table show besides its stiffness: where it is missing, and other parameters."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from estimator.transmissions import RIGID


def usable(row: dict[str, Any]) -> bool:
    """Return whether a row has a usable stiffness."""
    value, std = row["stiffness_middle_nm_rad"], row["stiffness_std_middle_nm_rad"]
    return bool(
        row["status"] == "done" and row["excited"] and value is not None and value > 0.0 and std is not None
    )


def unusable(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the recordings that show no stiffness of a transmission that has one, and why."""
    return [
        {
            "time": iso(row["time"]),
            "recording": row["recording"],
            "transmission": row["transmission"] if row["status"] == "done" else None,
            "reason": _reason(row),
            "report": row["report"] or "",
        }
        for row in rows
        if row["time"] is not None and not usable(row) and row["model"] != RIGID
    ]


def _reason(row: dict[str, Any]) -> str:
    if row["status"] != "done":
        return str(row["error"])
    value = row["stiffness_middle_nm_rad"]
    if row["excited"] and value is not None and value <= 0.0:
        return "the fitted stiffness is not above zero"
    return "its motion does not reveal the stiffness"


def lost(transmissions: list[dict[str, Any]], unusable: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the latest recordings, as far as they show no stiffness where earlier ones do."""
    found = []
    for one in transmissions:
        last = one["series"][-1]["time"]
        found += [
            row for row in unusable
            if row["time"] > last and row["transmission"] in (None, one["transmission"])
        ]  # fmt: skip
    return list({row["recording"]: row for row in found}.values())


def parameters(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the damping, and the parameters of the effects that were found, over the recordings."""
    series: dict[tuple[str, int], list[dict[str, Any]]] = {}

    def add(row: dict[str, Any], name: str, motor: int, value: Any, std: Any) -> None:
        if isinstance(value, int | float) and row["time"] is not None:
            known = std if isinstance(std, int | float) else None
            point = {"time": iso(row["time"]), "value": value, "std": known, "report": row["report"]}
            series.setdefault((name, motor), []).append(point)

    for row in rows:
        motor = int(row["transmission"])
        add(row, "viscous_damping_nm_s_rad", motor, row["viscous_damping_nm_s_rad"], None)
        effects = json.loads(row["details"] or "{}").get("effects", ()) if motor == 1 else ()
        for effect in effects:
            for name, value in effect["parameters"].items():
                std = effect["std"].get(name)
                add(row, f"{effect['name']}.{name}", effect.get("motor", 1), value, std)
    return [
        {"name": name, "motor": motor, "series": points}
        for (name, motor), points in sorted(series.items())
        if len(points) > 1
    ]


def iso(moment: datetime | None) -> str | None:
    """Write a time as in fleet.json."""
    return None if moment is None else moment.astimezone(UTC).isoformat(timespec="seconds")
