"""Ten minutes at 1 kHz with faults drawn at random: all comes back, nothing is wrong, and nothing grows.

    python benchmarks/soak.py [--seconds 600] [--seed 1] [--lockstep] [--two 0.3] [--recount 0] [--json FILE]

The daemon's own loop in real time on the virtual bus, with the simulated devices in its thread, so that no
other thread of this process makes them late. Faults of the fault script (`tests/faultscript.py`) are played
one after the other, with a calm stretch between them, at the end of which the daemon must be well again.
With --two another one begins during that share of them; with --recount the encoder counts from elsewhere
after that share of reboots. Beside every VALID estimate stands the truth: its values are of its SYNC,
stiffness and torque are right by the rules of the fault matrix. What is not is an episode, told with its
seed; so is a daemon that is not well again, after which another one begins. The slowest recovery is that of
fresh measurements; until something is valid takes longer where a zero was lost, which motion has to show.
With --lockstep time is the number of cycles: the same faults on a machine that has other things to do.
Memory is the resident set after a collection, with the C library's allocator alone, so that what is freed
is seen to be (Python's own keeps it); threads are counted. Both must be flat once the first minute,
in which buffers fill, is over: medians of the first and the last third are compared.

Episodes are written to stderr as they come, and how far it is once a minute. Ctrl-C, SIGTERM and so
`timeout 300 python benchmarks/soak.py …` end it after the fault that is on, with its report.
"""

import argparse
import ctypes
import gc
import logging
import os
import random
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scene

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import onlinekit as kit
from daemonkit import vsa
from faultscript import SCRIPT, Fault
from faultstage import Stage
from faultstages import LockstepStage, RealStage

from estimator.sample import FloatArray, Status
from sim.canopen.drive import PowerState

FILLING_S = 60.0
WAY_BACK_S = 5.0
FLAT_KB = (
    8000.0  # from the first third to the last: the allocator's own unrest; one sample a cycle would be 36 000
)
FLAT_OBJECTS = 2000  # what is made once, at the first fault of a kind; a leak of one a cycle would be 400 000
COUNTS_FROM = (None, 0.1, -0.1, 2.6)  # rad beyond what it was; None: zero
COUNTED = ("cycles", "estimates", "missed_cycles", "overruns")  # of a daemon's document
_ON_ANY_BUS = {
    "mute", "delay", "resize", "repeat", "reverse", "drop_sync", "emergency", "mend", "kill", "revive",
    "reboot", "inject", "ignore_sdo", "refuse_sdo", "impostor", "banish", "foreign_sync", "babble", "quiet",
    "babble_as", "unplug", "plug", "error_frame",
}  # fmt: skip
_libc = ctypes.CDLL(None)


def rss_kb() -> int:
    """Resident memory of this process, without what the allocator merely keeps."""
    gc.collect()
    _libc.malloc_trim(0)
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmRSS:")[2].split()[0])


def measured(stage: Stage) -> tuple[int, int, int]:
    """Memory, threads and objects, without the samples that are kept for the check while this is measured."""
    sink, stage.loop_joint.sink = stage.loop_joint.sink, None
    stage.forget()
    try:
        gc.collect()
        objects = len(gc.get_objects())  # at once: every cycle of the daemon makes some
        return rss_kb(), threading.active_count(), objects
    finally:
        stage.loop_joint.sink = sink


def faults() -> list[Fault]:
    """Those that the virtual bus can have while somebody else serves the devices."""
    return [f for f in SCRIPT if f.where == "both" and {action for _, action, _ in f.steps} <= _ON_ANY_BUS]


class Episode(NamedTuple):
    """Something VALID that is wrong: of which seed, in which cycle, during which faults, and what."""

    seed: int
    cycle: int
    faults: str
    what: str


def wrong_value(stage: Stage) -> str:
    """The first VALID estimate that is wrong by the rules of the fault matrix, or nothing."""
    estimates = {one.sequence: one for one, _ in stage.collector.estimates if one.status & Status.VALID}
    for (sample, _), due in zip(stage.collector.samples, stage.collector.due, strict=False):
        estimate, truth = estimates.get(sample.sequence), stage.truth.physics(due)
        if estimate is None or truth is None:
            continue
        k, std = estimate.stiffness_nm_rad, estimate.stiffness_std_nm_rad
        if not abs(k - truth[0]) <= max(kit.WRONG_RELATIVE * abs(truth[0]), kit.WRONG_STD * std):
            return f"stiffness {k:.4g} ± {std:.2g} N·m/rad, true {truth[0]:.4g}"
        torque = estimate.flexibility_torque_nm
        if not abs(torque - truth[1]) <= kit.WRONG_TORQUE * stage.truth.torque_rms_nm:
            return f"torque {torque:.4g} N·m, true {truth[1]:.4g}"
    return ""


class Soak:
    """One run.

    Args:
        options: of the command line.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._draw = random.Random(options.seed)
        self.played: Counter[str] = Counter()
        self.counted: Counter[str] = Counter()
        self.rows: list[tuple[float, int, int, int]] = []
        self.wrong: list[Episode] = []
        self.slowest = {"recovery": (0.0, ""), "valid": (0.0, "")}
        self.said = 0
        self._stopped, self._next_s = False, 0.0

    def stop(self, *_: object) -> None:
        """End after the fault that is on."""
        self._stopped = True

    def run(self) -> dict[str, Any]:
        """Play faults until the time is over; what was counted."""
        lockstep, done, over = self._options.lockstep, 0.0, False
        while True:  # with another daemon after one that has not become well again
            stage = LockstepStage(vsa(), setattr) if lockstep else RealStage(vsa(), together=True)
            start, well = self._time_s(stage) - done, True
            try:
                stage.settle()
                while well and not over:
                    well = self._one(stage)
                    done = self._time_s(stage) - start
                    over = self._stopped or done >= self._options.seconds
                    self.rows.append((done, *measured(stage)))
                    self._tell(done)
                document = stage.document()
                self.counted.update({key: document[key] for key in COUNTED}, samples_checked=stage.checked)
                if over:
                    return self._summary(done)
            finally:
                stage.close()

    def _tell(self, done: float) -> None:
        """Write how far it is, once a minute."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + 60.0
        counts = f"{sum(self.played.values())} faults, {len(self.wrong)} wrong episodes"
        print(f"seed {self._options.seed}: {done:.0f} s, {counts}", file=sys.stderr, flush=True)

    def _time_s(self, stage: Stage) -> float:
        in_cycles = self._options.lockstep
        return stage.daemon.loop.cycles * stage.joint.bus.period_s if in_cycles else time.monotonic()

    def _one(self, stage: Stage) -> bool:
        """Play a fault; whether all was well afterwards."""
        played = self._begin(stage)
        names = " + ".join(fault.name for fault in played)
        ended = self._time_s(stage)
        lost = ""
        while _stale(stage) and self._time_s(stage) < ended + stage.patience_s:
            stage.run(0.05)
        self._note("recovery", self._time_s(stage) - ended, names)
        try:
            stage.settle()
        except AssertionError as error:
            lost = str(error)
        self._note("valid", self._time_s(stage) - ended, names)
        stage.run(self._draw.uniform(0.0, 1.0))
        self.said += len(stage.said.lines)
        for what in filter(None, (stage.wrong_samples(), wrong_value(stage), lost)):
            self.wrong.append(Episode(self._options.seed, stage.daemon.loop.cycles, names, what))
            print(*self.wrong[-1], sep="; ", file=sys.stderr, flush=True)
        self.played.update(fault.name for fault in played)
        stage.forget()
        return not lost

    def _note(self, what: str, seconds: float, names: str) -> None:
        self.slowest[what] = max(self.slowest[what], (round(seconds, 2), names))

    def _begin(self, stage: Stage) -> list[Fault]:
        """Let one fault take its course, and perhaps another one that begins meanwhile."""
        played = [self._draw.choice(faults())]
        self._start(stage, played[0])
        wait = 0.0
        if self._draw.random() < self._options.two:
            wait = self._draw.uniform(0.0, played[0].seconds)
            stage.run(wait)
            played.append(self._draw.choice([fault for fault in faults() if fault not in played]))
            self._start(stage, played[1])
        stage.run(max(played[0].seconds - wait, played[-1].seconds))
        for _ in range(20):  # the other fault may have swallowed the reset of a drive
            if len(played) == 1 or stage.node(2).machine.state is not PowerState.FAULT:  # heard of or not
                break
            stage.mend(2)
            stage.run(0.5)
        return played

    def _start(self, stage: Stage, fault: Fault) -> None:
        stage.start(fault)
        for seconds, action, arguments in fault.steps:
            if action in ("reboot", "revive") and self._draw.random() < self._options.recount:
                stage.schedule(seconds, partial(stage.recount, arguments[0], self._draw.choice(COUNTS_FROM)))

    def _summary(self, seconds: float) -> dict[str, Any]:
        late = [row for row in self.rows if row[0] > min(FILLING_S, seconds / 3)]
        _, memory, threads, objects = (np.array(column, dtype=float) for column in zip(*late, strict=True))
        return {
            "seconds": round(seconds, 1),
            **self.counted,
            "faults": sum(self.played.values()),
            "kinds": dict(self.played),
            "wrong_episodes": [episode._asdict() for episode in self.wrong],
            "slowest_recovery_s": self.slowest["recovery"][0],
            "slowest_recovery_of": self.slowest["recovery"][1],
            "slowest_valid_s": self.slowest["valid"][0],
            "slowest_valid_of": self.slowest["valid"][1],
            "rss_kb": _thirds(memory),
            "objects": _thirds(objects),
            "threads": sorted({int(count) for count in threads}),
            "log_lines": self.said,
        }


def _stale(stage: Stage) -> bool:
    """Whether the newest estimate is without fresh measurements."""
    estimate = stage.loop_joint.pipeline.estimate
    return estimate is None or bool(estimate.status & Status.STALE)


def _thirds(values: FloatArray) -> list[int]:
    """Medians of the first and the last third, of one value at least each."""
    third = max(1, len(values) // 3)
    return [int(np.median(part)) for part in (values[:third], values[-third:])]


def rows(args: argparse.Namespace) -> Iterator[scene.Row]:
    logging.getLogger("drivelink").setLevel(logging.CRITICAL)
    sys.setswitchinterval(0.0005)  # the bookkeeping here must not hold the daemon's thread up for long
    soak = Soak(args)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, soak.stop)
    yield soak.run()


def verdict(kept: list[scene.Row]) -> str:
    """Exit with what is wrong with the row; nothing: all is well."""
    (result,) = kept
    memory, objects = result["rss_kb"], result["objects"]
    flat = memory[1] < memory[0] + FLAT_KB and objects[1] < objects[0] + FLAT_OBJECTS
    if result["wrong_episodes"]:
        sys.exit(f"{len(result['wrong_episodes'])} wrong episodes")
    if result["slowest_recovery_s"] >= WAY_BACK_S:
        sys.exit(f"{result['slowest_recovery_of']}: {result['slowest_recovery_s']} s until it measured again")
    if not flat or len(result["threads"]) != 1:
        sys.exit("memory or threads are not flat")
    return ""


COLUMNS = {
    "seconds": "{seconds:.0f}",
    "cycles": "{cycles}",
    "faults": "{faults}",
    "samples checked": "{samples_checked}",
    "wrong episodes": "{wrong_episodes}",
    "slowest recovery": "{slowest_recovery_s:.1f} s: {slowest_recovery_of}",
    "slowest until valid": "{slowest_valid_s:.1f} s: {slowest_valid_of}",
    "memory in thirds / kB": "{rss_kb[0]} → {rss_kb[1]}",
    "objects": "{objects[0]} → {objects[1]}",
    "threads": "{threads}",
    "log lines": "{log_lines}",
}

if __name__ == "__main__":
    if os.environ.get("PYTHONMALLOC") != "malloc":
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "PYTHONMALLOC": "malloc"})
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--seconds", 600.0),
        scene.Option("--seed", 1),
        scene.Option("--lockstep", False),
        scene.Option("--two", 0.3, "share of faults beside which another begins"),
        scene.Option("--recount", 0.0, "share of reboots after which counts differ"),
        after=verdict,
    )
