"""The work of one cycle: a two-motor VSA on the virtual bus, beside the textbook way and the floor.

    python benchmarks/cycle.py [--seconds S] [--rounds N]

All variants make SYNC at 1 kHz for the same simulated devices, which answer in the thread that sends and
whose CPU time is not counted, and publish in the same zenoh session to a subscriber in another process.
Rounds alternate between them, so that all see the same machine. CPU is that of the whole process without
the devices, over the SYNCs that were made, from the first one of each round on (locking memory and the
collector's last look are of a start): SYNC, reception, estimation, publication, zenoh's own threads, and the
threads that each variant brings with it. Work is wall-clock time from the last PDO in hand to the
put returned.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import scene
import zenoh
from rig import PERIOD_S, Devices, free_endpoint, joint, subscriber
from rivals import Floor, Textbook

from drivelink.canopen.layout import NodeLayout, bus_load
from drivelink.cycle import realtime
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint
from drivelink.jointfile import BusSection, JointFile
from drivelink.pubsub.session import close_session, open_session


class Row:
    """One variant over all rounds."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.cpu_s = self.wall_s = 0.0
        self.syncs = self.complete = 0
        self.work: list[dict[str, float]] = []

    def measure(self, devices: Devices, run: Callable[[], None]) -> None:
        """CPU of the process without that of the devices, over the SYNCs that were made."""
        devices.begin()
        start = time.monotonic()
        run()
        self.wall_s += time.monotonic() - start
        syncs, cpu_s = devices.counted()
        self.cpu_s += cpu_s
        self.syncs += syncs

    def result(self) -> dict[str, Any]:
        """Totals; of the percentiles the median over the rounds."""

        def middle(name: str) -> float:
            return statistics.median(work[name] for work in self.work)

        return {
            "variant": self.name,
            "syncs": self.syncs,
            "complete": self.complete,
            "cpu_us_per_cycle": 1e6 * self.cpu_s / self.syncs,
            "cpu_of_a_core": self.cpu_s / self.wall_s,
            "work_p50_us": middle("p50_us"),
            "work_p99_us": middle("p99_us"),
            "work_p999_us": middle("p999_us"),
        }


def daemon_round(
    row: Row, which: JointFile, devices: Devices, session: zenoh.Session, seconds: float
) -> Mapping[int, NodeLayout]:
    """The daemon as `drivelink run` runs it, supervision, status key and housekeeping included."""
    with Daemon([ServedJoint(joint=which)], session=session, devices=devices.poll) as daemon:
        row.measure(devices, lambda: daemon.run(seconds))
        (loop_joint,) = daemon.loop.loop_joints
        row.complete += loop_joint.estimates
        row.work.append(loop_joint.work.total())
        return dict(daemon.layouts)


def rival_round(row: Row, rival: Textbook | Floor, devices: Devices, seconds: float) -> None:
    """A rival, with the same help of the operating system."""
    obtained = realtime.acquire()
    row.measure(devices, lambda: rival.run(seconds, devices))
    realtime.release(obtained)
    row.complete += rival.cycles
    row.work.append(rival.work.total())
    rival.close()


def compare(seconds: float, rounds: int) -> list[dict[str, Any]]:
    """All variants, round by round."""
    endpoint = free_endpoint()
    robust, paper = joint("robust", endpoint), joint("paper", endpoint)
    session = open_session(robust.zenoh, Path())
    reader = subscriber(endpoint)
    rows = [Row("drivelink, robust"), Row("drivelink, paper"), Row(Textbook.name), Row(Floor.name)]
    devices = Devices(robust)
    try:
        for _ in range(rounds):
            layouts = daemon_round(rows[0], robust, devices, session, seconds)
            daemon_round(rows[1], paper, devices, session, seconds)
            rival_round(rows[2], Textbook(paper, devices.nodes, layouts, session), devices, seconds)
            rival_round(rows[3], Floor(paper, layouts, session), devices, seconds)
    finally:
        devices.close()
        close_session(session)
        reader.communicate(b"")
    load = bus_load(layouts.values(), BusSection(period_s=PERIOD_S))
    results = [row.result() for row in rows]
    for result in results:
        result["bus_load_1_mbit"] = load.fraction
        for name, baseline in (("textbook", results[2]), ("floor", results[3])):
            result[f"cpu_against_{name}"] = result["cpu_us_per_cycle"] / baseline["cpu_us_per_cycle"]
    return results


def lockstep(mode: str, seconds: float) -> dict[str, Any]:
    """World, devices, frames, cycle and puts in one thread, as fast as it goes."""
    which = joint(mode, free_endpoint())
    session = open_session(which.zenoh, Path())
    bus = open_sim_bus(which.bus)
    network = network_from_joint(which, bus)
    served = [ServedJoint(joint=which)]
    with Daemon(served, session=session, real_time=False, devices=network.poll) as daemon:
        start, cpu_s = time.perf_counter(), time.process_time()
        daemon.run_lockstep(round(seconds / PERIOD_S))
        elapsed, cpu_s = time.perf_counter() - start, time.process_time() - cpu_s
        work = daemon.loop.loop_joints[0].work.total()
    bus.shutdown()
    close_session(session)
    return {
        "mode": mode,
        "simulated_s": seconds,
        "took_s": elapsed,
        "cpu_s": cpu_s,
        "faster_than_real_time": seconds / elapsed,
        **{f"work_{key}": value for key, value in work.items()},
    }


def rows(args: Any) -> Iterator[scene.Row]:
    """One row a variant."""
    return iter(compare(args.seconds, args.rounds))


def flat_out(found: list[scene.Row]) -> str:
    """The second table, and the load of the bus."""
    columns = {
        "lockstep": "{mode}",
        "10 s of VSA-II took": "{took_s:.2f} s",
        "CPU": "{cpu_s:.2f} s",
        "faster than real time": "{faster_than_real_time:.1f}×",
        "work p50 / p99 µs": "{work_p50_us:.0f} / {work_p99_us:.0f}",
    }
    lines: list[str] = []
    scene.table(columns, (lockstep(mode, 10.0) for mode in ("robust", "paper")), lines.append)
    load = found[0]["bus_load_1_mbit"]
    lines += ["", f"Frames of this joint take {load:.0%} of 1 Mbit/s: the bus ends at {1e3 / load:.0f} Hz."]
    return "\n".join(lines)


if __name__ == "__main__":
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
            "cycles complete": "{complete} of {syncs}",
        },
        scene.Option("--seconds", 5.0, "of each round"),
        scene.Option("--rounds", 3),
        after=flat_out,
    )
