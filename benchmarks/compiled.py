"""The compiled core beside the last interpreted commit: replay of raw CAN, lockstep, one tick.

    python benchmarks/compiled.py [--seconds S] [--rounds N] [--interpreted COMMIT] [--json FILE]

The interpreted commit is checked out beside this one, and both run with this environment's libraries. They
take turns, and each round gives one ratio: what the machine does meanwhile concerns both. The recording is a
two-motor VSA at 1 kHz, as candump writes it, made by the simulation in lockstep.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import can

HERE = Path(__file__).parent
INTERPRETED = "2e9acf1"
START_S = 1_700_000_000

LOCKSTEP = """
import sys, time
from importlib import resources
from drivelink import jointfile
from drivelink.canopen.bus import open_bus
from drivelink.cycle.lockstep import run_lockstep
try:
    from drivelink.demo.simulate import network_from_joint, world_from_joint
except ModuleNotFoundError:  # the interpreted commit
    from drivelink.simulate import network_from_joint, world_from_joint

seconds = float(sys.argv[1])
with resources.as_file(resources.files("drivelink") / "joints" / "vsa-ii.toml") as path:
    joint = jointfile.load(path)
with open_bus(joint.bus) as bus:
    network = network_from_joint(joint, bus, world=world_from_joint(joint))
    spent = 0
    polled = network.poll
    class Devices:
        def poll(self):
            global spent
            begin = time.perf_counter_ns()
            handled = polled()
            spent += time.perf_counter_ns() - begin
            return handled
    begin = time.perf_counter_ns()
    run_lockstep(joint, Devices(), None, round(seconds / joint.bus.period_s))
    took = time.perf_counter_ns() - begin
print(seconds / (took * 1e-9), seconds / ((took - spent) * 1e-9))
"""

TICK = """
import sys
sys.path.insert(0, sys.argv[1])
from estimator_tick import ticks
from estimator import EstimatorSettings
found = ticks("vsa-ii", EstimatorSettings(), 20_000)
print(found["p50"], found["p99"])
"""


def record(log: Path, seconds: float) -> None:
    """Write the frames of a run in lockstep, with candump's stamps."""
    from importlib import resources

    from drivelink import jointfile
    from drivelink.canopen.bus import open_bus
    from drivelink.cycle.lockstep import run_lockstep
    from drivelink.demo.simulate import network_from_joint, world_from_joint

    with resources.as_file(resources.files("drivelink") / "joints" / "vsa-ii.toml") as path:
        joint = jointfile.load(path)
    writer = can.CanutilsLogWriter(log)
    with open_bus(joint.bus) as bus, open_bus(joint.bus) as tap:
        network = network_from_joint(joint, bus, world=world_from_joint(joint))

        class Devices:
            cycle = 0

            def poll(self) -> int:
                handled = network.poll()
                while (message := tap.recv(0)) is not None:
                    self.cycle += message.arbitration_id == 0x080
                    message.timestamp = START_S + self.cycle * joint.bus.period_s
                    writer.on_message_received(message)
                return handled

        run_lockstep(joint, Devices(), None, round(seconds / joint.bus.period_s))
    writer.stop()


def run(tree: Path, *arguments: str) -> str:
    """A program of one of the two checkouts."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, cwd=tree, capture_output=True, text=True, check=True
    )
    return done.stdout


def replay(tree: Path, log: Path) -> float:
    """How many times real time."""
    joint = tree / "drivelink" / "joints" / "vsa-ii.toml"
    arguments = ("replay", str(log), "--joint", str(joint))
    printed = run(tree, "-c", "import sys; from drivelink.cli import main; sys.exit(main())", *arguments)
    found = re.search(r"([\d.e+]+) × real time", printed)
    if found is None:
        raise SystemExit(printed)
    return float(found[1])


def measure(seconds: float, rounds: int, interpreted: str) -> dict[str, Any]:
    """Rows of (interpreted, compiled), one a round."""
    root = HERE.parent
    found: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        old, log = Path(scratch) / "interpreted", Path(scratch) / "frames.log"
        subprocess.run(
            ["git", "worktree", "add", "-q", "--detach", str(old), interpreted], cwd=root, check=True
        )
        try:
            record(log, seconds)
            for _ in range(rounds):
                for row, pair in (
                    ("replay", [(replay(tree, log),) for tree in (old, root)]),
                    ("lockstep", [run(tree, "-c", LOCKSTEP, str(seconds)).split() for tree in (old, root)]),
                    (
                        "tick",
                        [run(tree, "-c", TICK, str(tree / "benchmarks")).split() for tree in (old, root)],
                    ),
                ):
                    names = {
                        "replay": ["replay of raw CAN, times real time"],
                        "lockstep": ["lockstep, times real time", "the same without the simulated world"],
                        "tick": ["a tick of the estimator from Python, p50 µs", "the same, p99 µs"],
                    }[row]
                    for name, before, after in zip(names, *pair, strict=True):
                        found.setdefault(name, []).append((float(before), float(after)))
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(old)], cwd=root, check=True)
    return {
        name: {
            "interpreted": statistics.median(before for before, _ in pairs),
            "compiled": statistics.median(after for _, after in pairs),
            "ratio": statistics.median(after / before for before, after in pairs),
        }
        for name, pairs in found.items()
    }


def report(rows: dict[str, Any]) -> str:
    """The table in Markdown."""
    lines = ["| | interpreted | compiled | ratio |", "|---|---|---|---|"]
    for name, row in rows.items():
        lines.append(f"| {name} | {row['interpreted']:.3g} | {row['compiled']:.3g} | {row['ratio']:.3g} |")
    return "\n".join(lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of the recording, and in lockstep")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--interpreted", default=INTERPRETED, metavar="COMMIT")
    parser.add_argument("--json", type=Path, help="also write the numbers there")
    args = parser.parse_args()
    rows = measure(args.seconds, args.rounds, args.interpreted)
    print(report(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
