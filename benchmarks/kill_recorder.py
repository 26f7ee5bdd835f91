"""Kills recorders at random moments and reads what they leave: `python benchmarks/kill_recorder.py`.

Each recorder is a process of its own that records a stream at 1 kHz in real time, flushing once a second as
`drivelink record` does, until SIGKILL. What is on the disk must be readable, without holes, and reach to the
last second. Ends with status 1 if one of them is not.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from drivelink.errors import DrivelinkError
from drivelink.jointfile import parse
from drivelink.recording import read
from drivelink.recording.canlog import read_frames
from drivelink.recording.formats import open_sink
from drivelink.recording.recorder import Recorder
from drivelink.recording.sinks import Sink
from estimator.sample import Sample

TEXT = 'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.1\n[motor.transmission]\nmodel = "none"\n'
SUFFIXES = (".mcap", ".csv", ".log", ".blf", ".asc", ".trc")
SHORTEST_S, LONGEST_S = 1.5, 4.0
AT_ONCE = 6
ALLOWED_S = 1.5  # a second between two flushes, and half of one for a disk that is waited for


class Stream:
    """Sample and frame number k, k milliseconds after the beginning."""

    missed = 0

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._begin_s = time.time()
        self._next = 0

    def poll(self) -> None:
        """Give the sink everything that is due."""
        due = int((time.time() - self._begin_s) * 1e3)
        for k in range(self._next, due):
            stamp_ns = round(self._begin_s * 1e9) + k * 1_000_000
            self._sink.sample(Sample(k, (1e-3 * k,), (0.0,), (1.0,), 0.0), stamp_ns)
            self._sink.frame(stamp_ns, 0x181, struct.pack("<Q", k))
        self._next = max(self._next, due)

    def finish(self) -> None:
        """Nothing waits here."""


def record(path: Path) -> None:
    """The recorder: until it is killed."""
    sink = open_sink(path, parse(TEXT), TEXT)
    stream = Stream(sink)
    print(json.dumps(stream._begin_s), flush=True)
    with Recorder(sink, [stream]) as recorder:  # type: ignore[list-item]
        recorder.run(lambda: False)


def numbers(path: Path) -> list[int]:
    """Which numbers a recording holds."""
    if path.suffix in (".mcap", ".csv"):
        return [int(k) for k in read(path, parse(TEXT)).sequence]
    return [struct.unpack("<Q", frame.data)[0] for frame in read_frames(path)]


def killed(path: Path, after_s: float) -> dict[str, float | str]:
    """One recorder, started and killed; what it left."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--record", str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    begin_s = float(process.stdout.readline())
    time.sleep(max(0.0, begin_s + after_s - time.time()))
    process.send_signal(signal.SIGKILL)
    end_s = time.time()
    process.communicate()
    try:
        found = numbers(path)
    except (DrivelinkError, LookupError, ValueError, OSError, EOFError, struct.error) as error:
        return {"format": path.suffix, "error": f"{type(error).__name__}: {error}"}
    if found != list(range(found[0], found[0] + len(found))) or found[0] != 0:
        return {"format": path.suffix, "error": "a hole"}
    return {"format": path.suffix, "lost_s": end_s - begin_s - 1e-3 * (found[-1] + 1)}


def main() -> int:
    """Kill as many as asked for; print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=18)
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.record is not None:
        record(args.record)

    rng = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(AT_ONCE) as pool:
        jobs = [
            pool.submit(
                killed, Path(folder, f"r{k}{SUFFIXES[k % len(SUFFIXES)]}"), rng.uniform(SHORTEST_S, LONGEST_S)
            )
            for k in range(args.kills)
        ]
        results = [job.result() for job in jobs]
    broken = [result for result in results if "error" in result]
    lost = sorted(float(result["lost_s"]) for result in results if "lost_s" in result)
    document = {
        "kills": len(results),
        "readable": len(lost),
        "lost_s_median": lost[len(lost) // 2] if lost else None,
        "lost_s_most": lost[-1] if lost else None,
        "broken": broken,
    }
    if args.json:
        print(json.dumps(document))
    else:
        print(f"{len(lost)} of {len(results)} recordings readable, without holes")
        if lost:
            print(f"lost: median {document['lost_s_median']:.2f} s, most {lost[-1]:.2f} s")
        for result in broken:
            print(f"{result['format']}: {result['error']}")
    return 1 if broken or (lost and lost[-1] > ALLOWED_S) else 0


if __name__ == "__main__":
    sys.exit(main())
