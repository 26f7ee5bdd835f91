"""Summarises each joint from the table: trend, changes, new effects, urgency."""

from __future__ import annotations

import json
from collections import Counter
from datetime import UTC, datetime
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import false_discovery_control

from drivelink import __version__
from drivelink.fleet.analysis import stiffness_at
from drivelink.fleet.changes import (
    LEAST,
    Appearance,
    SeriesChange,
    SeriesTest,
    appearance,
    changes,
    iso,
    lost,
    parameters,
    series_test,
    unusable,
    usable,
)
from drivelink.output.numbers import in_words, with_interval
from estimator.sample import SIGMA_95, FloatArray
from estimator.transmissions import MODELS

SCHEMA = "drivelink.fleet/1"
_METHOD = (
    "sup-F test against steps and ramps with Bonferroni's bound, robust to any one recording left out; "
    "Fisher's exact test for effects; Benjamini-Hochberg over all series of the fleet"
)
COLUMNS = [
    "joint", "transmission", "status", "error", "verdict", "sentence", "effects", "report",
    "model", "parameters", "covariance", "excited", "error_before_relative", "error_after_relative",
    "deflection_middle_rad", "stiffness_middle_nm_rad", "stiffness_std_middle_nm_rad",
    "viscous_damping_nm_s_rad", "details",
]  # fmt: skip

_SHOWN = ("recording", "verdict", "effects", "sentence", "report")  # of a diagnosis
_DAY_S = 86400.0
_NO_PLACE = {"sufficient", "insufficient_excitation"}


class _Series(NamedTuple):
    """Stiffness of one transmission over its usable recordings."""

    transmission: int
    deflection_rad: float
    rows: list[dict[str, Any]]
    time_s: FloatArray
    value: FloatArray
    std: FloatArray
    test: SeriesTest


class _Place(NamedTuple):
    """Findings of one joint at one location, e.g. "motor1": times and effects."""

    place: str
    rows: list[dict[str, Any]]
    names: list[str]
    test: Appearance


def summarise(rows: list[dict[str, Any]], false_discovery_rate: float) -> dict[str, Any]:
    """Return the document of fleet.json and the page.

    Args:
        rows: of the table, in order of time, with at least `COLUMNS`, `recording` and `time`.
        false_discovery_rate: expected share of false ones among the changes called significant.

    Returns:
        JSON values only; the most urgent joints first.
    """
    rows = [row for row in rows if row["time"] is not None or row["status"] != "done"]
    ordered = sorted((row for row in rows if row["joint"]), key=lambda row: str(row["joint"]))
    joints = {name: list(group) for name, group in groupby(ordered, key=lambda row: str(row["joint"]))}
    series = {name: _series(one) for name, one in joints.items()}
    places = {name: _places(one) for name, one in joints.items()}
    p = [s.test.p_value for name in joints for s in series[name]]
    p += [place.test.p_value for name in joints for place in places[name]]
    found = false_discovery_control(p).tolist() if p else []
    level = false_discovery_rate * sum(q <= false_discovery_rate for q in found) / max(len(p), 1)
    q = iter(found)
    transmissions = {
        name: [_transmission(s, next(q), false_discovery_rate, level) for s in series[name]]
        for name in joints
    }
    effects = {
        name: [_effect(place, next(q), false_discovery_rate) for place in places[name]] for name in joints
    }
    documents = [_joint(n, one, transmissions[n], effects[n]) for n, one in joints.items()]
    documents.sort(key=lambda d: (-d["urgency"], d["joint"]))
    times = [row["time"] for row in rows if row["time"] is not None]
    broken = [row for row in rows if row["status"] != "done"]
    return {
        "schema": SCHEMA,
        "version": __version__,
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "false_discovery_rate": false_discovery_rate,
        "method": _METHOD,
        "tests": len(p),
        "level": level,
        "recordings": len({row["recording"] for row in rows}),
        "from": iso(min(times)) if times else None,
        "to": iso(max(times)) if times else None,
        "joints": documents,
        "broken": [
            {**{key: row[key] for key in ("recording", "joint", "error")}, "time": iso(row["time"])}
            for row in broken
        ],
    }


def _series(rows: list[dict[str, Any]]) -> list[_Series]:
    made = []
    able = [row for row in rows if usable(row)]
    for number in sorted({int(row["transmission"]) for row in able}):
        own = [row for row in able if row["transmission"] == number]
        phi = float(np.median([row["deflection_middle_rad"] for row in own]))
        values = np.array([_stiffness(row, phi) for row in own])
        time_s = np.array([row["time"].timestamp() for row in own])
        value, std = values[:, 0], values[:, 1]
        made.append(_Series(number, phi, own, time_s, value, std, series_test(time_s, value, std)))
    return made


def _stiffness(row: dict[str, Any], phi: float) -> tuple[float, float]:
    """Stiffness at the joint's common deflection; as recorded for an unknown model."""
    if row["model"] not in MODELS:
        return row["stiffness_middle_nm_rad"], row["stiffness_std_middle_nm_rad"]
    return stiffness_at(row["model"], json.loads(row["parameters"]), row["covariance"], phi)


def _places(rows: list[dict[str, Any]]) -> list[_Place]:
    """Test the findings at each location, in total and per effect."""
    once = [row for row in rows if row["status"] == "done" and row["transmission"] == 1]
    able = [row for row in once if row["verdict"] != "insufficient_excitation"]
    found = Counter(name for row in able for name in row["effects"])
    made = []
    for place in sorted({name.partition("@")[2] for name in found}):
        names = sorted((n for n in found if n.partition("@")[2] == place), key=lambda n: -found[n])
        groups = [set(names)] + ([{name} for name in names] if len(names) > 1 else [])
        tests = [
            appearance(np.array([bool(group & set(row["effects"])) for row in able])) for group in groups
        ]
        best = min(range(len(groups)), key=lambda k: tests[k].p_value)
        test = tests[best]._replace(p_value=min(1.0, tests[best].p_value * len(groups)))
        shown = sorted(groups[best], key=lambda n: -found[n])
        made.append(_Place(place, able, [n.partition("@")[0] for n in shown], test))
    return made


def _transmission(series: _Series, q: float, rate: float, level: float) -> dict[str, Any]:
    significant = q <= rate
    found = changes(series.time_s, series.value, series.std, level) if significant else []
    change = sum((one.shape for one in found), np.zeros(len(series.value)))
    base = float(np.median(series.value - change))  # the level before any change
    fitted = base + change
    return {
        "transmission": series.transmission,
        "deflection_rad": series.deflection_rad,
        "p_value": series.test.p_value,
        "q_value": q,
        "significant": significant,
        "stiffness_nm_rad": float(fitted[-1]),
        "scatter_relative": series.test.scatter / base,
        "changes": [_changed(series, one, base) for one in found],
        "series": [
            {
                "time": iso(row["time"]),
                "stiffness_nm_rad": float(value),
                "std_nm_rad": float(std),
                "fitted_nm_rad": float(level_),
                "verdict": row["verdict"],
                "recording": row["recording"],
                "report": row["report"],
            }
            for row, value, std, level_ in zip(series.rows, series.value, series.std, fitted, strict=True)
        ],
    }


def _changed(series: _Series, change: SeriesChange, base: float) -> dict[str, Any]:
    days = (series.time_s[-1] - series.time_s[change.first]) / _DAY_S
    document = {
        "kind": change.kind,
        "since": iso(series.rows[change.first]["time"]),
        "since_earliest": iso(series.rows[change.earliest]["time"]),
        "since_latest": iso(series.rows[change.latest]["time"]),
        "amount_nm_rad": change.amount,
        "amount_std_nm_rad": change.amount_std,
        "amount_relative": change.amount / base,
        "amount_std_relative": change.amount_std / base,
    }
    if change.kind == "drift" and days > 0.0:
        document["per_30_days_relative"] = change.amount / base / days * 30.0
    return document


def _effect(place: _Place, q: float, rate: float) -> dict[str, Any]:
    names = set(place.names)
    seen = [
        row
        for row in place.rows
        if names & {n.partition("@")[0] for n in row["effects"] if n.endswith(f"@{place.place}")}
    ]
    before, after = (
        float(np.median([row[f"error_{when}_relative"] for row in seen])) for when in ("before", "after")
    )
    return {
        "location": place.place,
        "names": place.names,
        "p_value": place.test.p_value,
        "q_value": q,
        "significant": q <= rate,
        "since": iso(place.rows[place.test.first]["time"]) if q <= rate else iso(seen[0]["time"]),
        "share_before": place.test.rate_before,
        "share_after": place.test.rate_after,
        "recordings": len(seen),
        "of": len(place.rows),
        "in_the_last": seen[-1] is place.rows[-1],
        "error_before_relative": before,
        "error_after_relative": after,
        "report": seen[-1]["report"],
    }


def _joint(
    name: str, rows: list[dict[str, Any]], transmissions: list[dict[str, Any]], effects: list[dict[str, Any]]
) -> dict[str, Any]:
    done = [row for row in rows if row["status"] == "done"]
    broken = [row for row in rows if row["status"] != "done"]
    last = done[-1] if done else None
    without = unusable(rows)
    gone = lost(transmissions, without)
    state, size = _state(transmissions, effects, last, gone)
    return {
        "joint": name,
        "state": state,
        "urgency": STATES[state] + min(size, 0.999),
        "sentence": _sentence(state, transmissions, effects, rows, gone),
        "recordings": len({row["recording"] for row in rows}),
        "broken": len(broken),
        "last": iso(rows[-1]["time"]),
        "verdict": last["verdict"] if last else None,
        "transmissions": transmissions,
        "unusable": without,
        "parameters": parameters(done),
        "effects": effects,
        "diagnoses": [
            {**{key: row[key] for key in _SHOWN}, "time": iso(row["time"])}
            for row in done
            if row["transmission"] == 1
        ],
    }


STATES = {"changing": 5.0, "lost": 4.0, "finding": 3.0, "unread": 2.0, "undecided": 1.0, "steady": 0.0}
LOOK = ("changing", "lost", "finding", "unread")  # those that need a look


def _state(
    transmissions: list[dict[str, Any]],
    effects: list[dict[str, Any]],
    last: dict[str, Any] | None,
    gone: list[dict[str, Any]],
) -> tuple[str, float]:
    """Urgency of a joint, and relative size of the change to sort by."""
    moved = [abs(c["amount_relative"]) for t in transmissions for c in t["changes"]]
    appeared = [
        abs(e["error_before_relative"] - e["error_after_relative"]) for e in effects if e["significant"]
    ]
    if moved or appeared:
        return "changing", max(moved + appeared)
    if gone:
        return "lost", 0.1 * len(gone)
    if last is None:
        return "unread", 0.0
    if last["verdict"] not in _NO_PLACE:
        return "finding", abs(last["error_before_relative"] - last["error_after_relative"])
    if not transmissions or last["verdict"] == "insufficient_excitation":
        return "undecided", 0.0
    return "steady", 0.0


def _sentence(
    state: str,
    transmissions: list[dict[str, Any]],
    effects: list[dict[str, Any]],
    rows: list[dict[str, Any]],
    gone: list[dict[str, Any]],
) -> str:
    """Summary of a joint in words."""
    said = []
    several = len(transmissions) > 1
    for one in transmissions:
        of = f"Stiffness of motor {one['transmission']}" if several else "Stiffness"
        for change in one["changes"]:
            amount, std = 100.0 * change["amount_relative"], 100.0 * change["amount_std_relative"]
            much = f"{'+' * (amount > 0.0)}{with_interval(amount, SIGMA_95 * std)} %"
            verb, since = ("stepped", "on") if change["kind"] == "step" else ("has drifted", "since")
            said.append(f"{of} {verb} by {much} {since} {change['since'][:10]}.")
    for effect in effects:
        if effect["significant"]:
            names = " or ".join(map(in_words, effect["names"][:2]))
            said.append(f"New at the {spaced(effect['location'])} since {effect['since'][:10]}: {names}.")
    if gone:
        which = "recording shows" if len(gone) == 1 else f"{len(gone)} recordings show"
        said.insert(
            0, f"The last {which} no stiffness, from {gone[0]['time'][:10]} on: {gone[-1]['reason']}."
        )
        if state == "lost" and rows[-1]["status"] == "done" and rows[-1]["verdict"] not in _NO_PLACE:
            said.append(str(rows[-1]["sentence"]))
    if said:
        return " ".join(said)
    if state == "unread":
        return f"No recording could be used: {rows[-1]['error']}"
    if state == "finding":
        last = [row for row in rows if row["status"] == "done"][-1]
        return f"No significant change, but the last recording says: {last['sentence']}"
    if state == "undecided":
        return "The motion does not reveal the stiffness or what could be missing: record a richer one."
    fewest = min(len(one["series"]) for one in transmissions)
    if fewest < LEAST:
        return f"Too few recordings with a stiffness to judge a change: {fewest}, of {LEAST} or more."
    return "Steady."


def spaced(place: str) -> str:
    """Return a place as it stands in a sentence: motor 1."""
    return place.rstrip("12") + (f" {place[-1]}" if place[-1] in "12" else "")
