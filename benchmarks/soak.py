"""Ten minutes at 1 kHz with faults drawn at random: everything comes back, and nothing grows.

    python benchmarks/soak.py [--seconds 600] [--seed 1] [--lockstep] [--json FILE]

The daemon's own loop in real time on the virtual bus, with the simulated devices in its thread, so that no
other thread of this process makes them late. Faults of the fault script (`tests/faultscript.py`) are played
one after the other, with a calm stretch between them, at the end of which the daemon must be well again.
With --lockstep time is the number of cycles: the same faults on a machine that has other things to do.
Memory is the resident set after a collection, with the C library's allocator alone, so that what is freed is
seen to be (Python's own keeps it); threads are counted. Both must be flat once the first minute, in which
buffers fill, is over: medians of the first and the last third are compared.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import logging
import os
import random
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from daemonkit import vsa
from faultscript import SCRIPT, Fault
from faultstage import Stage
from faultstages import LockstepStage, RealStage

from estimator.sample import FloatArray

FILLING_S = 60.0
WAY_BACK_S = 5.0
FLAT_KB = (
    8000.0  # from the first third to the last: the allocator's own unrest; one sample a cycle would be 36 000
)
FLAT_OBJECTS = 2000  # what is made once, at the first fault of a kind; a leak of one a cycle would be 400 000
_ON_ANY_BUS = {
    *("mute", "delay", "resize", "repeat", "reverse", "drop_sync", "emergency", "mend", "kill", "revive"),
    *("reboot", "send", "ignore_sdo", "refuse_sdo", "impostor", "banish", "foreign_sync", "babble", "quiet"),
    *("babble_as", "unplug", "plug", "error_frame"),
}


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


class Soak:
    """One run.

    Args:
        seconds: how long.
        seed: of the order of the faults.
        lockstep: time is the number of cycles.
    """

    def __init__(self, seconds: float, seed: int, lockstep: bool) -> None:
        self._lockstep = lockstep
        self._draw = random.Random(seed)
        self._seconds = seconds
        self.played: Counter[str] = Counter()
        self.rows: list[tuple[float, int, int, int]] = []
        self.slowest = (0.0, "")
        self.said = 0

    def run(self) -> dict[str, Any]:
        """Play faults until the time is over; what was counted."""
        stage = LockstepStage(vsa(), setattr) if self._lockstep else RealStage(vsa(), together=True)
        start = self._time_s(stage)
        try:
            stage.settle()
            while self._time_s(stage) - start < self._seconds:
                self._one(stage)
                self.rows.append((self._time_s(stage) - start, *measured(stage)))
            return self._summary(stage, self._time_s(stage) - start)
        finally:
            stage.close()

    def _time_s(self, stage: Stage) -> float:
        return stage.daemon.loop.cycles * stage.joint.bus.period_s if self._lockstep else time.monotonic()

    def _one(self, stage: Stage) -> None:
        fault = self._draw.choice(faults())
        stage.start(fault)
        stage.run(fault.seconds)
        ended = self._time_s(stage)
        stage.settle()
        self.slowest = max(self.slowest, (self._time_s(stage) - ended, fault.name))
        self.said += len(stage.said.lines)
        wrong = stage.wrong_samples()
        if wrong:
            raise AssertionError(f"{fault.name}: {wrong}")
        self.played[fault.name] += 1
        stage.run(self._draw.uniform(0.0, 1.0))
        stage.forget()

    def _summary(self, stage: Stage, seconds: float) -> dict[str, Any]:
        document = stage.document()
        late = [row for row in self.rows if row[0] > min(FILLING_S, seconds / 3)]
        _, memory, threads, objects = (np.array(column, dtype=float) for column in zip(*late, strict=True))
        return {
            "seconds": round(seconds, 1),
            "cycles": document["cycles"],
            "estimates": document["estimates"],
            "missed_cycles": document["missed_cycles"],
            "overruns": document["overruns"],
            "faults": sum(self.played.values()),
            "kinds": dict(self.played),
            "samples_checked": stage.checked,
            "slowest_recovery_s": round(self.slowest[0], 2),
            "slowest_recovery_of": self.slowest[1],
            "rss_kb": _thirds(memory),
            "objects": _thirds(objects),
            "threads": sorted({int(count) for count in threads}),
            "log_lines": self.said,
        }


def _thirds(values: FloatArray) -> list[int]:
    """Medians of the first and the last third."""
    parts = np.array_split(values, 3)
    return [int(np.median(parts[k])) for k in (0, -1)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lockstep", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    logging.getLogger("drivelink").setLevel(logging.CRITICAL)
    sys.setswitchinterval(0.0005)  # the bookkeeping here must not hold the daemon's thread up for long
    result = Soak(options.seconds, options.seed, options.lockstep).run()
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))
    memory, objects = result["rss_kb"], result["objects"]
    flat = memory[1] < memory[0] + FLAT_KB and objects[1] < objects[0] + FLAT_OBJECTS
    flat = flat and len(result["threads"]) == 1
    if result["slowest_recovery_s"] >= WAY_BACK_S:
        sys.exit(f"{result['slowest_recovery_of']}: {result['slowest_recovery_s']} s until all was well")
    sys.exit(0 if flat else "memory or threads are not flat")


if __name__ == "__main__":
    if os.environ.get("PYTHONMALLOC") != "malloc":
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, "PYTHONMALLOC": "malloc"})
    main()
