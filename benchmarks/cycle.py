"""What a cycle costs and how late it is: the daemon beside the textbook way and the floor; start and memory.

    python benchmarks/cycle.py [--seconds S] [--rounds N]

A two-motor VSA on the virtual bus. All variants make SYNC at 1 kHz for the same simulated devices, which
answer in the thread that sends and whose CPU time is not counted, and publish in the same zenoh session to a
subscriber in another process. Each round begins with another variant, so that all see the same machine. CPU
is that of the whole process without the devices, over the SYNCs that were made, from the first one of each
round on (locking memory and the collector's last look are of a start). Work is wall-clock time from the last
PDO in hand to the put returned. SYNC is late by what passes from its deadline to the call that sends it.

In lockstep world, devices, frames, cycles and puts of one or several joints take one thread, as fast as it
goes. The baseline of the start is Python with the libraries that any such program imports.
"""

import math
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import scene
from rig import PERIOD_S, Devices, free_endpoint, joint, joint_text, subscriber
from rivals import Floor, Textbook

from drivelink.canopen.layout import bus_load
from drivelink.cycle import realtime
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.jointfile import BusSection, JointFile, parse
from drivelink.pubsub.session import close_session, open_session

RECORDED, TEXTBOOK, FLOOR = "drivelink, with a recorder", Textbook.name, Floor.name
LOCKSTEP = (("robust", 1), ("paper", 1), ("robust", 4), ("robust", 16))  # mode, joints
LIBRARIES = "import canopen, can, numpy, zenoh"
BARE = f"import time; {LIBRARIES}; print(time.monotonic()); print(open('/proc/self/status').read())"
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


class Row:
    """One variant over all rounds."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.cpu_s = self.wall_s = 0.0
        self.syncs = self.complete = 0
        self.spent: dict[str, list[float]] = {}

    def measure(self, devices: Devices, run: Callable[[], None]) -> None:
        """CPU of the process without that of the devices, over the SYNCs that were made."""
        devices.begin()
        start = time.monotonic()
        run()
        self.wall_s += time.monotonic() - start
        syncs, cpu_s = devices.counted()
        self.cpu_s += cpu_s
        self.syncs += syncs

    def keep(self, complete: int, **times: Mapping[str, float]) -> None:
        """Add a round's cycles, and the percentiles of its durations."""
        self.complete += complete
        for what, percentiles in times.items():
            for name in ("p50_us", "p99_us", "p999_us", "max_us"):
                self.spent.setdefault(f"{what}_{name}", []).append(percentiles.get(name, math.nan))

    def result(self) -> dict[str, Any]:
        """Totals; of the percentiles the median over the rounds."""
        return {
            "variant": self.name,
            "syncs": self.syncs,
            "complete": self.complete,
            "cpu_us_per_cycle": 1e6 * self.cpu_s / self.syncs,
            "cpu_of_a_core": self.cpu_s / self.wall_s,
            **{name: statistics.median(values) for name, values in self.spent.items()},
        }


def daemon_round(
    devices: Devices, session: Any, seconds: float, which: JointFile, row: Row, *, real_time: bool = True
) -> None:
    """The daemon as `drivelink run` runs it, supervision, status key and housekeeping included."""
    served = [ServedJoint(joint=which)]
    with Daemon(served, session=session, real_time=real_time, devices=devices.poll) as daemon:
        row.measure(devices, lambda: daemon.run(seconds))
        (loop_joint,) = daemon.loop.loop_joints
        row.keep(loop_joint.estimates, work=loop_joint.work.total(), late=daemon.loop.lateness.total())


def rival_round(
    devices: Devices, seconds: float, rival: Textbook | Floor, row: Row, *, real_time: bool = True
) -> None:
    """A rival, with the same help of the operating system."""
    obtained = realtime.acquire(privileged=real_time)
    row.measure(devices, lambda: rival.run(seconds, devices))
    realtime.release(obtained)
    row.keep(rival.cycles, work=rival.work.total(), late=rival.late.total())
    rival.close()


def recorded_round(devices: Devices, session: Any, seconds: float, text: str, row: Row) -> None:
    """The daemon while `drivelink record` writes everything into a file."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "bench.toml", Path(folder) / "out.mcap"
        path.write_text(text, encoding="utf-8")
        command = [sys.executable, "-m", "drivelink", "record", path, "--source", "daemon", "--out", out]
        recorder = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not out.exists() and recorder.poll() is None:  # until it listens
            time.sleep(0.1)
        daemon_round(devices, session, seconds, parse(text), row)
        recorder.send_signal(signal.SIGINT)
        recorder.wait(timeout=60)


def rows(args: Any) -> Iterator[scene.Row]:
    """One row a variant, measured round by round; each round begins with another one."""
    endpoint, seconds = free_endpoint(), args.seconds
    robust, paper = joint("robust", endpoint), joint("paper", endpoint)
    session = open_session(robust.zenoh, Path())
    reader, devices = subscriber(endpoint), Devices(robust)
    with Daemon([ServedJoint(joint=robust)], session=session, devices=devices.poll) as daemon:
        layouts = dict(daemon.layouts)
    run, rival = partial(daemon_round, devices, session, seconds), partial(rival_round, devices, seconds)
    variants: dict[str, Callable[[Row], None]] = {
        "drivelink, robust": partial(run, robust),
        "drivelink, paper": partial(run, paper),
        RECORDED: partial(recorded_round, devices, session, seconds, joint_text("robust", endpoint)),
        TEXTBOOK: lambda row: rival(Textbook(paper, devices.network.nodes, layouts, session), row),
        FLOOR: lambda row: rival(Floor(paper, layouts, session), row),
        "drivelink, ordinary scheduling": partial(run, robust, real_time=False),
        "floor, ordinary scheduling": lambda row: rival(Floor(paper, layouts, session), row, real_time=False),
    }
    made = {name: Row(name) for name in variants}
    try:
        for first in range(args.rounds):
            order = list(variants)[first:] + list(variants)[:first]
            for name in order:
                variants[name](made[name])
    finally:
        devices.close()
        close_session(session)
        reader.communicate(b"")
    results = [row.result() for row in made.values()]
    cost = {row["variant"]: row["cpu_us_per_cycle"] for row in results}
    load = bus_load(layouts.values(), BusSection(period_s=PERIOD_S)).fraction
    for row in results:
        own = row["cpu_us_per_cycle"]
        compared = {"cpu_against_textbook": own / cost[TEXTBOOK], "cpu_against_floor": own / cost[FLOOR]}
        yield row | compared | {"bus_load_1_mbit": load}


def lockstep(mode: str, joints: int, seconds: float) -> scene.Row:
    """So many joints in lockstep; CPU without that of the devices."""
    endpoint = free_endpoint()
    served = [joint(mode, endpoint, index) for index in range(joints)]
    session, devices = open_session(served[0].zenoh, Path()), Devices(*served)
    daemons = [ServedJoint(joint=which) for which in served]
    with Daemon(daemons, session=session, real_time=False, devices=devices.poll) as daemon:
        devices.begin()
        start = time.perf_counter()
        daemon.run_lockstep(round(seconds / PERIOD_S))
        elapsed = time.perf_counter() - start
        syncs, cpu_s = devices.counted()
    devices.close()
    close_session(session)
    return {
        "mode": f"{mode}, {joints} joint{'s' if joints > 1 else ''}",
        "joints": joints,
        "cpu_us_per_cycle": 1e6 * cpu_s / syncs,
        "faster_than_real_time": seconds / elapsed,
    }


def starts(count: int) -> dict[str, float]:
    """Seconds from the process's start, and memory in MB; the median of so many."""
    seen: list[dict[str, float]] = []
    options = {"capture_output": True, "text": True, "check": True, "cwd": Path(__file__).parent}
    for _ in range(count):
        begin = time.monotonic()
        bare = subprocess.run([sys.executable, "-c", BARE], **options)
        kib = bare.stdout.partition("VmRSS:")[2].split()[0]
        row = {"libraries_s": float(bare.stdout.split()[0]) - begin, "libraries_mb": int(kib) / 1024}
        begin = time.monotonic()
        ours = subprocess.run([sys.executable, "-c", START, free_endpoint()], **options)
        *reached, started, after_10, after_20 = map(float, ours.stdout.split())
        names = ("imported_s", "configured_s", "first_estimate_s")
        row |= {name: at - begin for name, at in zip(names, reached, strict=True)}
        seen.append(row | {"started_mb": started, "after_10_s_mb": after_10, "after_20_s_mb": after_20})
    return {key: statistics.median([row[key] for row in seen]) for key in seen[0]}


def after(found: list[scene.Row]) -> str:
    """The recorder's cost, the bus, several joints, the start."""
    cost = {row["variant"]: row["cpu_us_per_cycle"] for row in found}
    load = found[0]["bus_load_1_mbit"]
    lines = [
        f"CPU a cycle with a recorder: {cost[RECORDED] / cost['drivelink, robust']:.2f}× of that without. "
        f"Frames of this joint take {load:.0%} of 1 Mbit/s: the bus ends at {1e3 / load:.0f} Hz.\n"
    ]
    columns = {
        "lockstep": "{mode}",
        "CPU a cycle / µs": "{cpu_us_per_cycle:.0f}",
        "faster than real time": "{faster_than_real_time:.1f}×",
    }
    several = scene.table(columns, (lockstep(*case, 4.0) for case in LOCKSTEP), lines.append)
    one, many = several[0], several[-1]
    each = (many["cpu_us_per_cycle"] - one["cpu_us_per_cycle"]) / (many["joints"] - one["joints"])
    lines.append(f"\nA further VSA joint takes {each:.0f} µs of a core in each cycle.\n")
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
            "CPU a cycle / µs": "{cpu_us_per_cycle:.0f}",
            "of a core": "{cpu_of_a_core:.1%}",
            "of textbook": "{cpu_against_textbook:.2f}×",
            "of floor": "{cpu_against_floor:.2f}×",
            "work p50 / p99 / p99.9 µs": "{work_p50_us:.0f} / {work_p99_us:.0f} / {work_p999_us:.0f}",
            "SYNC late p50 / p99 / p99.9 / max µs": late,
            "cycles complete": "{complete} of {syncs}",
        },
        scene.Option("--seconds", 5.0, "of each round"),
        scene.Option("--rounds", 3),
        after=after,
    )
