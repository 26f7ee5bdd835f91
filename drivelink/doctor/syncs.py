"""Checks SYNC on the bus: producer, period, jitter."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from drivelink.doctor.machine import percentile
from drivelink.doctor.report import Section
from drivelink.jointfile import BusSection
from drivelink.notice import Severity


@dataclass(frozen=True, slots=True, kw_only=True)
class Daemons:
    """Running drivelink daemons of this machine."""

    ours: bool  # whether one of them serves this joint
    others: Sequence[str]  # names of the other joints that are served


def judge_sync(
    section: Section, stamps_s: Sequence[float], bus: BusSection, daemons: Daemons | None = None
) -> None:
    """Check rate and jitter of SYNC.

    Args:
        daemons: running daemons, one of which may produce SYNC.
    """
    if len(stamps_s) < 3:
        if bus.sync == "follow":
            section.say(
                Severity.ERROR, "SYNC", "nobody makes SYNC", 'start the other master, or bus.sync = "produce"'
            )
        else:
            section.ok("SYNC", "not produced yet: drivelink run will produce it")
        return
    gaps = [after - before for before, after in itertools.pairwise(stamps_s)]
    period_s = percentile(gaps, 0.5)
    deviation_us = [abs(gap - period_s) * 1e6 for gap in gaps]
    p99, worst = percentile(deviation_us, 0.99), max(deviation_us)
    section.facts["sync"] = {"period_s": period_s, "jitter_us": {"p99": p99, "max": worst}}
    text = f"every {period_s * 1000:.3f} ms, jitter {p99:.0f} µs (p99), {worst:.0f} µs (max)"
    if bus.sync == "produce":
        _judge_producer(section, text, daemons or Daemons(ours=False, others=()))
    elif "period_s" in bus.model_fields_set and abs(period_s - bus.period_s) > 0.02 * bus.period_s:
        section.say(
            Severity.ERROR,
            "SYNC",
            f"{text}, the joint file says {bus.period_s * 1000:g} ms",
            f"bus.period_s = {round(period_s, 5):g}",
        )
    else:
        section.ok("SYNC", text)


def _judge_producer(section: Section, text: str, daemons: Daemons) -> None:
    """Who produces the SYNC that this joint is to produce."""
    if daemons.ours:
        section.ok("SYNC", f"{text}, produced by the drivelink daemon that runs")
    elif daemons.others:
        section.say(
            Severity.WARNING,
            "SYNC",
            f"{text}: the drivelink daemon of {', '.join(daemons.others)} may make it",
            "joints on one bus go into one command: drivelink run A.toml B.toml; "
            'with another master: bus.sync = "follow"',
        )
    else:
        section.say(
            Severity.WARNING,
            "SYNC",
            f"{text}: another master produces it, no drivelink daemon is alive",
            'bus.sync = "follow", or stop the other master',
        )
