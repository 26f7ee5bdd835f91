"""The daemon as a process: jitter with and without real-time scheduling, a recorder beside it, start, memory.

    python benchmarks/service.py [--seconds S] [--rounds N]

Rounds alternate, so that all variants see the same machine. The baseline of jitter is a bare loop that does
nothing but sleep until the same deadlines, with the same scheduling; that of the start is Python with the
libraries that any such program imports.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import scene
import zenoh
from rig import PERIOD_S, Devices, free_endpoint, joint, joint_text

from drivelink._core import LatencyHistogram
from drivelink.cycle import realtime
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.jointfile import JointFile
from drivelink.pubsub.session import close_session, open_session

LIBRARIES = "import canopen, can, numpy, zenoh"
START = """
import re, sys, time
from pathlib import Path
def mb():
    return int(re.search(r"VmRSS:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024
from rig import Devices, joint
from drivelink.daemon.service import Daemon, ServedJoint
imported = time.monotonic()
which = joint("robust", sys.argv[1])
devices = Devices(which)
with Daemon([ServedJoint(joint=which)], devices=devices.poll) as daemon:
    ready = time.monotonic()
    while daemon.loop.loop_joints[0].estimates == 0:
        daemon.run_lockstep(1)
    first = time.monotonic()
    memory = [mb()]
    for _ in range(2):
        daemon.run_lockstep(10_000)
        memory.append(mb())
devices.close()
print(imported, ready, first, *memory)
"""
BARE = f"import time; {LIBRARIES}; print(time.monotonic()); print(open('/proc/self/status').read())"


def bare_round(seconds: float, real_time: bool) -> dict[str, float]:
    """How late a loop wakes that has nothing to do."""
    obtained = realtime.acquire(privileged=real_time)
    meter, alarm, clock = LatencyHistogram(), realtime.Alarm(), time.monotonic_ns
    period = round(PERIOD_S * 1e9)
    deadline = clock() + period
    left_out, end = 0, deadline + round(seconds * 1e9)
    while deadline < end:
        alarm.sleep_until(deadline)
        late = clock() - deadline
        if late > 0.4 * period:  # the daemon leaves such a SYNC out, too
            left_out += 1
        else:
            meter.add(late)
        deadline += period
    realtime.release(obtained)
    late_by = {f"late_{name}": value for name, value in meter.total().items()}
    return {**late_by, "left_out": left_out, "cycles": round(seconds / PERIOD_S) - left_out}


def daemon_round(
    which: JointFile, session: zenoh.Session, seconds: float, real_time: bool
) -> dict[str, float]:
    """The daemon, and how late its SYNC and long its work."""
    devices = Devices(which)
    try:
        with Daemon(
            [ServedJoint(joint=which)], session=session, real_time=real_time, devices=devices.poll
        ) as daemon:
            cpu_s = time.process_time()
            daemon.run(seconds)
            cpu_s = time.process_time() - cpu_s - devices.cpu_s
            loop = daemon.loop
            (loop_joint,) = loop.loop_joints
            return {
                **{f"late_{name}": value for name, value in loop.lateness.total().items()},
                **{f"work_{name}": value for name, value in loop_joint.work.total().items()},
                "cpu_us_per_cycle": 1e6 * cpu_s / loop.cycles,
                "left_out": loop.overruns,
                "cycles": loop.cycles,
            }
    finally:
        devices.close()


def recorded_round(which: JointFile, text: str, session: zenoh.Session, seconds: float) -> dict[str, float]:
    """The same while `drivelink record` writes everything into a file."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "bench.toml", Path(folder) / "out.mcap"
        path.write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "drivelink", "record", str(path), "--source", "daemon"]
        recorder = subprocess.Popen(
            [*command, "--out", str(out), "--seconds", str(seconds + 3)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(2.5)  # until it listens
        row = daemon_round(which, session, seconds, True)
        recorder.wait(timeout=60)
        return {**row, "file_mb": out.stat().st_size / 1e6 if out.exists() else 0.0}


def rounds(seconds: float, count: int) -> dict[str, dict[str, float]]:
    """All variants, alternating; the median over the rounds of every number."""
    endpoint = free_endpoint()
    which, text = joint("robust", endpoint), joint_text("robust", endpoint)
    session = open_session(which.zenoh, Path())
    seen: dict[str, list[dict[str, float]]] = {}
    for _ in range(count):
        for name, real_time in (("real-time scheduling", True), ("ordinary scheduling", False)):
            seen.setdefault(f"bare loop, {name}", []).append(bare_round(seconds, real_time))
            seen.setdefault(f"drivelink, {name}", []).append(daemon_round(which, session, seconds, real_time))
        seen.setdefault("drivelink, with a recorder", []).append(
            recorded_round(which, text, session, seconds)
        )
    close_session(session)
    return {
        name: {key: statistics.median([row[key] for row in rows]) for key in rows[0]}
        for name, rows in seen.items()
    }


def starts(count: int) -> dict[str, float]:
    """Seconds from the process's start, and memory in MB."""
    seen: list[dict[str, float]] = []
    here = Path(__file__).parent
    for _ in range(count):
        begin = time.monotonic()
        bare = subprocess.run(
            [sys.executable, "-c", BARE], capture_output=True, text=True, check=True, cwd=here
        )
        imported, *_ = bare.stdout.split()
        kib = bare.stdout.partition("VmRSS:")[2].split()[0]
        row = {"libraries_s": float(imported) - begin, "libraries_mb": int(kib) / 1024}
        begin = time.monotonic()
        command = [sys.executable, "-c", START, free_endpoint()]
        ours = subprocess.run(command, capture_output=True, text=True, check=True, cwd=here)
        imported, ready, first, *memory = map(float, ours.stdout.split())
        row |= {
            "imported_s": imported - begin,
            "configured_s": ready - begin,
            "first_estimate_s": first - begin,
        }
        row |= dict(zip(("started_mb", "after_10_s_mb", "after_20_s_mb"), memory, strict=True))
        seen.append(row)
    return {key: statistics.median([row[key] for row in seen]) for key in seen[0]}


def rows(args: Any) -> Iterator[scene.Row]:
    """One row a variant of the jitter, then of the start, then of memory."""
    variants = rounds(args.seconds, args.rounds)
    for name, row in variants.items():
        base = variants[f"bare loop, {'ordinary' if 'ordinary' in name else 'real-time'} scheduling"]
        of_bare = row["late_p99_us"] / base["late_p99_us"]
        empty = dict.fromkeys(("work_p50_us", "work_p99_us", "cpu_us_per_cycle"))
        yield {"variant": name, **empty, **row, "of_bare": of_bare, "syncs": row["cycles"] + row["left_out"]}


def started(found: list[scene.Row]) -> str:
    """What a recorder costs; the second table: start and memory."""
    by_name = {row["variant"]: row for row in found}
    off, on = by_name["drivelink, real-time scheduling"], by_name["drivelink, with a recorder"]
    lines = [
        f"A recorder beside the daemon: CPU a cycle {on['cpu_us_per_cycle'] / off['cpu_us_per_cycle']:.2f}×, "
        f"work p99 {on['work_p99_us'] / off['work_p99_us']:.2f}× of the daemon alone.\n"
    ]
    start, said = starts(3), []
    for key, what in (
        ("libraries_s", f"Python and `{LIBRARIES}`"),
        ("imported_s", "drivelink and its simulated devices imported"),
        ("configured_s", "names claimed, nodes configured by SDO: ready"),
        ("first_estimate_s", "first estimate published"),
        ("libraries_mb", "memory of the libraries"),
        ("started_mb", "at the first estimate, simulation included"),
        ("after_10_s_mb", "after 10 s of cycles"),
        ("after_20_s_mb", "after 20 s of cycles"),
    ):
        unit = key.rpartition("_")[2]
        value = f"{start[key]:.2f} s" if unit == "s" else f"{start[key]:.0f} MB"
        said.append({"what": what, "value": value, "ratio": start[key] / start[f"libraries_{unit}"]})
    columns = {"start and memory": "{what}", "": "{value}", "of the libraries alone": "{ratio:.1f}×"}
    scene.table(columns, said, lines.append)
    return "\n".join(lines)


if __name__ == "__main__":
    late = " / ".join(f"{{late_{p}_us:.0f}}" for p in ("p50", "p99", "p999", "max"))
    scene.main(
        __doc__,
        rows,
        {
            "at 1 kHz": "{variant}",
            "SYNC late p50 / p99 / p99.9 / max µs": late,
            "of bare loop (p99)": "{of_bare:.1f}×",
            "work p50 / p99 µs": "{work_p50_us:.0f} / {work_p99_us:.0f}",
            "CPU a cycle µs": "{cpu_us_per_cycle:.0f}",
            "SYNCs left out": "{left_out:.0f} of {syncs:.0f}",
        },
        scene.Option("--seconds", 5.0, "of each round"),
        scene.Option("--rounds", 3),
        after=started,
    )
