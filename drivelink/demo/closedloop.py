"""`drivelink demo --case friction|…`: the simulated joint changes undeclared, and the loop closes on it.

Three processes: the simulated joint with its daemon, the black box with its diagnoses, and this one, which
watches and, asked or with `--yes`, accepts.
"""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.text import Text

from drivelink.demo.rig import Change, Changed, RunSummary
from drivelink.demo.watching import DemoRun
from drivelink.jointfile import JointFile
from drivelink.loop import finding
from drivelink.loop.acceptance import Proposal, Trial, accept, proposal
from drivelink.output.document import Grid, Paragraph, Rows, Section
from drivelink.output.numbers import number, value_and_interval
from drivelink.pubsub.client import Subscription
from estimator.reasons import percent
from estimator.sample import SIGMA_95, Status

AFTER_S = 10.0
_MISSING = {  # of each step, where the time is over before it
    "alarm": "there was no model alarm",
    "recorded": "nothing was kept",
    "found": "the diagnosis has not ended",
    "accepted": "nobody accepted",
    "fallen": "the residual has not fallen",
}
STEPS = tuple(_MISSING)
_LINES = 13  # of the live view, below what is said
_AFTERGLOW_S = 3.0  # of the healthy view at the end


class LoopCase(NamedTuple):
    """What happens to the joint."""

    text: str  # in words
    effects: tuple[str, ...]  # as `sim --effect` takes them
    parameters: Mapping[str, float]  # as `[sim] parameters`
    truth: Mapping[str, float]  # the numbers that a diagnosis should find, by their names in it

    @property
    def change(self) -> Change:
        """For the rig."""
        return Change(AFTER_S, self.effects, self.parameters)


def _effect(text: str, name: str, parameter: str, value: float) -> LoopCase:
    return LoopCase(text, (f"{name}={value!r}",), {}, {f"{name}.{parameter}": value})


def _softer(share: float) -> LoopCase:
    """Both coefficients of the elbow's spring fall by this share."""
    truth = {f"coefficients_nm_rad[{k}]": (1.0 - share) * value for k, value in ((1, 120.0), (2, 400.0))}
    parameters = {f"motor1_coefficient{k}_nm_rad": value for k, value in enumerate(truth.values(), 1)}
    return LoopCase(f"the stiffness falls by {percent(share, 0)}", (), parameters, truth)


CASES: Mapping[str, LoopCase] = {
    "friction": _effect("Coulomb friction of 0.6 N·m appears", "coulomb_friction", "torque_nm", 0.6),
    "backlash": _effect("5 mrad of play on either side appear", "backlash", "half_gap_rad", 0.005),
    "stiffness": _softer(0.1),
    "torque-constant": _effect(
        "the torque per ampere rises by 10 %", "torque_constant", "relative_error", 0.1
    ),
}


class ClosedLoop(DemoRun):
    """Follows the loop from the change to the fallen residual."""

    def __init__(
        self,
        joint: JointFile,
        path: Path,
        case: LoopCase,
        console: Console,
        *,
        live: bool,
        yes: bool,
        limit_s: float,
    ) -> None:
        super().__init__(joint, console, live=live, height=_LINES)
        # UNIX time of each step: changed, alarm, recorded, found, accepted, fallen
        self.times: dict[str, float] = {}
        self.offer: Proposal | None = None  # what was proposed, or None
        self.trial: Trial | None = None  # the residual after it, or None
        self.over = False  # it has ended the rig itself
        self._path, self._case, self._yes = path, case, yes
        self._limit_s = self._end_s = time.monotonic() + limit_s
        self._asking = False

    def follow(self, rig: Any, subscription: Subscription) -> bool:
        """See `DemoRun.follow`."""
        self._stop: Callable[[], None] = rig.stop
        return super().follow(rig, subscription)

    def _other(self, message: Any) -> None:
        if isinstance(message, Changed):
            self._note("changed", f"{self._case.text}; nobody tells the daemon", message.stamp_ns * 1e-9)

    def _take(self, subscription: Subscription) -> None:
        super()._take(subscription)
        self._view.finding = subscription.finding or {}
        self._view.model = subscription.model or {}
        newest = subscription.latest()
        if "changed" in self.times and newest is not None and newest.status & Status.MODEL_ALARM:
            self._note("alarm", "model alarm: the residual has left its baseline", newest.stamp_ns * 1e-9)
        self._read(subscription.finding or {})
        if self._asking:
            self._answer()
        if self.trial is not None and self.trial.fallen is None:
            fallen = self.trial.update(subscription.status or {}, subscription.model or {}, time.monotonic())
            if fallen is not None:
                self._note("fallen" if fallen else "not fallen", self.trial.sentence())
                self._end_s = min(self._end_s, time.monotonic() + _AFTERGLOW_S)
        if time.monotonic() >= self._end_s:
            missing = next((text for step, text in _MISSING.items() if step not in self.times), "")
            if missing and self._end_s == self._limit_s:
                self._say(f"the time is over (--seconds): {missing}")
            self._end_s, self.over = math.inf, True
            self._stop()

    def _read(self, found: Mapping[str, Any]) -> None:
        """What the daemon publishes of the diagnosis."""
        state = found.get("state")
        if state is None or "found" in self.times:
            return
        self._note("recorded", f"kept as {found.get('recording')}; diagnosed at idle priority")
        if state == finding.PROPOSED:
            self.offer = proposal(self._path)
            self._note("found", "finding:")
            for line in self.offer.lines():
                self._say(f"  {line}", {"+": "green", "-": "red"}.get(line[:1], ""))
            self._asking = not self._yes
            if self._yes:
                self._accept()
            elif not self._keys.there:
                self._say("not accepted: run it in a terminal, or with --yes")
                self._asking, self._end_s = False, time.monotonic()
            else:
                self._view.footer = "accept? y / n"
                self._say("accept? y / n")
        elif state != finding.DIAGNOSING:
            self._note("found", f"nothing to accept: {found.get('sentence')}")
            self._end_s = time.monotonic()

    def _answer(self) -> None:
        for key in self._pressed:
            if key in "yY" and self._asking:
                self._asking = False
                self._accept()
            elif key in "nN" and self._asking:
                self._say("not accepted")
                self._asking, self._end_s = False, time.monotonic()

    def _accept(self) -> None:
        assert self.offer is not None  # there is one when it is asked for
        old = accept(self.offer)
        self._view.footer = "Ctrl-C ends"
        self._note("accepted", f"accepted: the joint file is written, the old one kept as {old.name}")
        self.trial = Trial(self._path, time.monotonic())

    def _note(self, step: str, text: str, unix_s: float | None = None) -> None:
        """Report a step once, with its time since the change."""
        if step in self.times:
            return
        self.times[step] = time.time() if unix_s is None else unix_s
        since_s = self.times[step] - self.times.get("changed", self.times[step])
        self._say(f"{since_s:6.1f} s  {text}", "bold")

    def _say(self, line: str, style: str = "") -> None:
        self._console.print(Text(line, style=style), soft_wrap=not self._console.is_terminal)


def found_values(report: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return every parameter of a diagnosis with its standard deviation, by its name."""
    tables = [(f"{one['name']}.", one) for one in report.get("effects", ())]
    tables += [("", one) for one in report.get("transmissions", ())]
    values: dict[str, tuple[float, float]] = {}
    for prefix, one in tables:
        for name, value in one["parameters"].items():
            std = one["std"].get(name)
            if isinstance(value, list):
                values |= {f"{name}[{k}]": pair for k, pair in enumerate(zip(value, std, strict=True), 1)}
            else:
                values[f"{prefix}{name}"] = (value, math.nan if std is None else std)
    return values


def result(name: str, run: ClosedLoop, summary: RunSummary) -> dict[str, Any]:
    """Return a run as a JSON object; missing numbers are null."""
    times, begin = run.times, run.times.get("changed")
    about = {"case": name, "cycles": summary.cycles, "missed_cycles": summary.missed_cycles}
    document: dict[str, Any] = about | {
        f"{step}_s": round(times[step] - begin, 3) if begin and step in times else None for step in STEPS
    }
    offered = run.offer.finding if run.offer is not None else {}
    values = found_values(offered.get("report") or {})
    document["parameters"] = {
        key: {"truth": truth, **dict(zip(("found", "std"), values.get(key, (None, None)), strict=True))}
        for key, truth in CASES[name].truth.items()
    }
    document |= {key: offered.get(key) for key in ("sentence", "error")}
    document["residual_ratio"] = max(run.trial.ratios) if run.trial is not None and run.trial.ratios else None
    return document


def closing(document: Mapping[str, Any]) -> Section:
    """Return the end of a run: truth beside what was found, errors, times."""
    rows: Rows = []
    for key, one in document["parameters"].items():
        found, half = ("–", "") if one["found"] is None else value_and_interval(
            one["found"], SIGMA_95 * one["std"]
        )  # fmt: skip
        rows.append((key, number(one["truth"]), found, f"± {half}" if half else ""))
    lines = []
    if (error := document["error"]) is not None:
        before, after = (f"{number(error[f'{when}_rms_nm'], 3)} N·m" for when in ("before", "after"))
        shares = (f"{percent(error[f'{when}_relative'], 2)} {when}" for when in ("before", "after"))
        relative = ", ".join(shares)
        lines.append(f"error of the motor torque on held-out data: {relative} ({before}, {after})")
    if document["residual_ratio"] is not None:
        lines.append(f"residual after the acceptance: {number(document['residual_ratio'], 2)} × its baseline")
    times = {step: document[f"{step}_s"] for step in STEPS}
    steps = [f"{step} {time_s:.1f} s" for step, time_s in times.items() if time_s is not None]
    lines.append(f"after the change: {', '.join(steps) or 'nothing'}")
    lines.append(f"{document['cycles']} cycles, {document['missed_cycles']} missed")
    grid = Grid(("", "truth", "found", "95 %"), rows)
    return Section(f"{document['case']}: truth beside finding", [grid, *map(Paragraph, lines)])
