"""Summarises each joint from the table: trend, changes, new effects, urgency."""

from collections import Counter
from datetime import UTC, datetime
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import false_discovery_control

from drivelink import __version__
from drivelink.fleet.changes import LEAST, Appearance, appearance, iso, lost, unusable
from drivelink.fleet.trends import Series, others, parameter, stiffnesses, transmission
from drivelink.output.numbers import bare_name, with_interval
from drivelink.plaintext import natural
from estimator.effects import in_words
from estimator.sample import SIGMA_95
from estimator.transmissions import RIGID

SCHEMA = "drivelink.fleet/1"
_METHOD = (
    "sup-F test against steps and ramps with Bonferroni's bound, robust to any one recording left out; "
    "Fisher's exact test for effects; Benjamini-Hochberg over all series of the fleet"
)
COLUMNS = [
    "joint", "transmission", "status", "error", "verdict", "sentence", "effects", "report",
    "axis", "model", "parameters", "covariance", "excited", "error_before_relative", "error_after_relative",
    "deflection_middle_rad", "stiffness_middle_nm_rad", "stiffness_std_middle_nm_rad",
    "viscous_damping_nm_s_rad", "viscous_damping_std_nm_s_rad", "deflection_offset_rad",
    "deflection_offset_std_rad", "inertia_kg_m2", "inertia_std_kg_m2", "details",
]  # fmt: skip

_SHOWN = ("recording", "verdict", "effects", "sentence", "report")  # of a diagnosis
_Judged = dict[str, list[dict[str, Any]]]  # "transmissions", "parameters" and "effects" of a joint
_NO_PLACE = {"sufficient", "insufficient_excitation"}


class _Place(NamedTuple):
    """Findings of one joint at one location, e.g. "motor1": times and effects."""

    place: str
    rows: list[dict[str, Any]]
    names: list[str]  # all, the most frequent first
    best: list[str]  # those that the test is of
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
    series = {name: stiffnesses(one) for name, one in joints.items()}
    further = {name: others(one) for name, one in joints.items()}
    places = {name: _places(one) for name, one in joints.items()}
    every = [one for of in (series, further, places) for ones in of.values() for one in ones]
    p = {id(one): one.test.p_value for one in every if one.test is not None}
    found = false_discovery_control([*p.values()]).tolist() if p else []
    level = false_discovery_rate * sum(q <= false_discovery_rate for q in found) / max(len(p), 1)
    q_of = dict(zip(p, found, strict=True))

    def judged(one: Series | _Place) -> tuple[float, float]:
        """Return its q, and the level at which changes are looked for; 0: there is none."""
        q = q_of.get(id(one), 1.0)
        return q, level if q <= false_discovery_rate else 0.0

    documents = [
        _joint(name, one, {
            "transmissions": [transmission(s, *judged(s)) for s in series[name]],
            "parameters": [parameter(s, *judged(s)) for s in further[name]],
            "effects": [_effect(place, *judged(place)) for place in places[name]],
        })
        for name, one in joints.items()
    ]  # fmt: skip
    documents.sort(key=lambda d: (-d["urgency"], natural(d["joint"])))
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
        every, shown = (
            [n.partition("@")[0] for n in sorted(group, key=lambda n: -found[n])]
            for group in (groups[0], groups[best])
        )
        made.append(_Place(place, able, every, shown, test))
    return made


def _effect(place: _Place, q: float, level: float) -> dict[str, Any]:
    shown = place.best if level else place.names
    named = {f"{name}@{place.place}" for name in shown}
    seen = [row for row in place.rows if named & set(row["effects"])]
    before, after = (
        float(np.median([row[f"error_{when}_relative"] for row in seen])) for when in ("before", "after")
    )
    return {
        "location": place.place,
        "names": shown,
        "p_value": place.test.p_value,
        "q_value": q,
        "significant": bool(level),
        "since": iso((place.rows[place.test.first] if level else seen[0])["time"]),
        "share_before": place.test.rate_before,
        "share_after": place.test.rate_after,
        "recordings": len(seen),
        "of": len(place.rows),
        "in_the_last": seen[-1] is place.rows[-1],
        "error_before_relative": before,
        "error_after_relative": after,
        "report": seen[-1]["report"],
    }


def _joint(name: str, rows: list[dict[str, Any]], judged: _Judged) -> dict[str, Any]:
    done = [row for row in rows if row["status"] == "done"]
    broken = [row for row in rows if row["status"] != "done"]
    last = done[-1] if done else None
    shown = {(p["report"], t["transmission"]) for t in judged["transmissions"] for p in t["series"]}
    without = unusable(rows, shown)
    gone = lost(judged["transmissions"], without)
    state, size = _state(judged, rows, last, gone)
    return {
        "joint": name,
        "state": state,
        "urgency": STATES[state] + min(size, 0.999),
        "sentence": _sentence(state, judged, rows, gone),
        "recordings": len({row["recording"] for row in rows}),
        "broken": len(broken),
        "last": iso(rows[-1]["time"]),
        "verdict": last["verdict"] if last else None,
        **judged,
        "unusable": without,
        "diagnoses": [
            {**{key: row[key] for key in _SHOWN}, "time": iso(row["time"])}
            for row in done
            if row["transmission"] == 1
        ],
    }


STATES = {"lost": 5.0, "changing": 4.0, "finding": 3.0, "unread": 2.0, "undecided": 1.0, "steady": 0.0}
LOOK = ("lost", "changing", "finding", "unread")  # those that need a look


def _unrevealed(judged: _Judged, last: dict[str, Any]) -> bool:
    """Return whether the motion shows neither a stiffness nor what could be missing."""
    unknown = not judged["transmissions"] and last["model"] != RIGID
    return unknown or bool(last["verdict"] == "insufficient_excitation")


def _fewest(judged: _Judged, rows: list[dict[str, Any]]) -> int:
    """Return the length of the shortest series that a change was looked for in."""
    done = sum(row["status"] == "done" for row in rows)
    return min((len(one["series"]) for one in judged["transmissions"]), default=done)


def _state(
    judged: _Judged, rows: list[dict[str, Any]], last: dict[str, Any] | None, gone: list[dict[str, Any]]
) -> tuple[str, float]:
    """Urgency of a joint, and relative size of the change to sort by."""
    moved = [abs(c["amount_relative"]) for t in judged["transmissions"] for c in t["changes"]]
    moved += [c["share"] for one in judged["parameters"] for c in one["changes"]]
    new = [e for e in judged["effects"] if e["significant"]]
    moved += [abs(e["error_before_relative"] - e["error_after_relative"]) for e in new]
    if gone:
        return "lost", 0.1 * len(gone)
    if moved:
        return "changing", max(moved)
    if last is None:
        return "unread", 0.0
    if last["verdict"] not in _NO_PLACE:
        return "finding", abs(last["error_before_relative"] - last["error_after_relative"])
    if _unrevealed(judged, last) or _fewest(judged, rows) < LEAST:
        return "undecided", 0.0
    return "steady", 0.0


def _sentence(state: str, judged: _Judged, rows: list[dict[str, Any]], gone: list[dict[str, Any]]) -> str:
    """Summary of a joint in words."""
    said = []
    last = next((row for row in reversed(rows) if row["status"] == "done"), None)
    several = any(row["transmission"] == 2 for row in rows)
    for one in (*judged["transmissions"], *judged["parameters"]):
        of = f" of motor {one.get('transmission') or one['motor']}" if several else ""
        for change in one["changes"]:
            what, much = _moved(one, change)
            verb, since = ("stepped", "on") if change["kind"] == "step" else ("has drifted", "since")
            said.append(f"{what[0].upper()}{what[1:]}{of} {verb} by {much} {since} {change['since'][:10]}.")
    for effect in judged["effects"]:
        if effect["significant"]:
            names = " or ".join(map(in_words, effect["names"][:2]))
            said.append(f"New at the {spaced(effect['location'])} since {effect['since'][:10]}: {names}.")
    if gone:
        which = "recording shows" if len(gone) == 1 else f"{len(gone)} recordings show"
        since = gone[0]["time"][:10]
        said.insert(0, f"The last {which} no stiffness, from {since} on: {gone[-1]['reason']}.")
        if state == "lost" and last is not None and last["verdict"] not in _NO_PLACE:
            before = "" if last is rows[-1] else "The last one that could be used says: "
            said.append(f"{before}{last['sentence']}")
    if said:
        return " ".join(said)
    if state == "unread":
        return f"No recording could be used: {rows[-1]['error']}"
    if state == "finding":
        return _found([row for row in rows if row["status"] == "done"])
    if state == "undecided":
        if last is not None and _unrevealed(judged, last):
            return "The motion does not reveal the stiffness or what could be missing: record a richer one."
        return f"Too few recordings to judge a change: {_fewest(judged, rows)}, of {LEAST} or more."
    if judged["effects"]:
        return f"Steady in the last recording; before it {_earlier(judged['effects'])}."
    return "Steady."


def _earlier(effects: list[dict[str, Any]]) -> str:
    """What recordings before a sufficient one lacked, significant or not."""
    return ", ".join(
        f"{' or '.join(map(in_words, one['names'][:2]))} ({spaced(one['location'])}) was missing in "
        f"{one['recordings']} of {one['of']}"
        for one in effects
    )


def _found(rows: list[dict[str, Any]]) -> str:
    """What the last recording says, and since when the ones before it have said the same."""
    last = rows[-1]
    agreeing = {}
    for row in reversed(rows):
        if row is not last and not set(row["effects"] or ()) & set(last["effects"] or ()):
            break
        agreeing[row["recording"], row["time"]] = row["time"]
    if len(agreeing) < 2:
        return f"No significant change, but the last recording says: {last['sentence']}"
    every = len({(row["recording"], row["time"]) for row in rows})
    since = f"{iso(min(agreeing.values()))}"[:10]
    return f"The last {len(agreeing)} of {every} recordings, since {since}, agree: {last['sentence']}"


def _moved(one: dict[str, Any], change: dict[str, Any]) -> tuple[str, str]:
    """Return what has changed, and by how much."""
    if "causes" in change:
        amount, half, unit = 100.0 * change["amount_relative"], 100.0 * change["amount_std_relative"], "%"
        scale = {"torque_scale": "the torque's scale"}
        what = " or ".join(scale.get(cause) or in_words(cause) for cause in change["causes"])
    else:
        amount, half, unit = change["amount"], change["amount_std"], one["unit"]
        what = parameter_name(one["name"])
    return what, f"{'+' * (amount > 0.0)}{with_interval(amount, SIGMA_95 * half, unit)}"


def parameter_name(name: str) -> str:
    """Return a parameter as a chart is titled: backlash: half gap."""
    effect, _, parameter = name.rpartition(".")
    return ": ".join(filter(None, (in_words(effect), bare_name(parameter))))


def spaced(place: str) -> str:
    """Return a place as it stands in a sentence: motor 1."""
    return place.rstrip("12") + (f" {place[-1]}" if place[-1] in "12" else "")
