"""A minute at 1 kHz on the virtual bus: which cycles are missed, and whose fault it is.

    python benchmarks/endurance.py [--seconds S] [--json FILE]

Four loops take turns, a few seconds each: the daemon with the simulated devices in a thread of their own,
the daemon with the devices in its own thread, a bare loop that does nothing but sleep until the same
deadlines with the same scheduling, and one that adds integers for as long as the daemon works. A period
that is left out is put down to own work where the thread's CPU time since the last SYNC filled the period,
to the machine where the loop was ready in time and was not woken. A virtual machine may book time that its
host takes as CPU time of the thread: the additions, a fixed amount of work, are the control for that. Own
work that they do not show is the daemon's. A cycle without a sample is the devices' where their frames were
not there before the next SYNC.
"""

from __future__ import annotations

import argparse
import json
import threading
import time
from pathlib import Path
from typing import Any

from rig import PERIOD_S, free_endpoint, joint

from drivelink._core import LatencyHistogram
from drivelink.cycle import pacing, realtime
from drivelink.cycle.realtime import Alarm
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint
from drivelink.jointfile import JointFile
from drivelink.pubsub.session import close_session, open_session

BLOCK_S = 5.0
WORK_US = 120  # of arithmetic in each cycle of the third loop: about what the daemon and its devices take
PERIOD_NS = round(PERIOD_S * 1e9)
LATEST_NS = round(0.4 * PERIOD_NS)  # a SYNC that would be later than this is left out


class Witness(Alarm):
    """An alarm that notes why a deadline was not kept."""

    own = others = 0

    def __init__(self) -> None:
        super().__init__()
        self._before_ns = time.thread_time_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """See Alarm."""
        worked_ns = time.thread_time_ns() - self._before_ns
        super().sleep_until(deadline_ns)
        late_ns = time.monotonic_ns() - deadline_ns
        if late_ns > LATEST_NS:
            periods = 1 + (late_ns - LATEST_NS) // PERIOD_NS
            if worked_ns > PERIOD_NS:
                Witness.own += periods
            else:
                Witness.others += periods
        self._before_ns = time.thread_time_ns()


def total() -> dict[str, Any]:
    """A row of zeros."""
    return {"due": 0, "left_out_own": 0, "left_out_machine": 0, "without_sample": 0, "worst_late_us": 0.0}


def additions() -> int:
    """How many of them take `WORK_US`, by the quickest of some trials."""
    many, spent_ns = 2_000, []
    for _ in range(200):
        before_ns = time.thread_time_ns()
        sum(range(many))
        spent_ns.append(time.thread_time_ns() - before_ns)
    return round(many * WORK_US * 1000 / min(spent_ns))


def bare_block(row: dict[str, Any], seconds: float, work: int = 0) -> None:
    """Nothing but sleeping, and so many additions a cycle."""
    obtained = realtime.acquire()
    alarm, meter = Witness(), LatencyHistogram()
    deadline = time.monotonic_ns() + PERIOD_NS
    end = deadline + round(seconds * 1e9)
    Witness.own = Witness.others = 0
    while deadline < end:
        alarm.sleep_until(deadline)
        late = time.monotonic_ns() - deadline
        if late > LATEST_NS:
            deadline += (1 + (late - LATEST_NS) // PERIOD_NS) * PERIOD_NS
            continue
        meter.add(late)
        sum(range(work))
        deadline += PERIOD_NS
    realtime.release(obtained)
    add(row, round(seconds / PERIOD_S), meter, 0)


def daemon_block(row: dict[str, Any], which: JointFile, seconds: float, own_thread: bool) -> None:
    """The daemon, with its devices in a thread of their own or in its own."""
    bus = open_sim_bus(which.bus)
    network = network_from_joint(which, bus)
    stop = threading.Event()

    def serve() -> None:
        obtained = realtime.acquire()  # a real drive is not late because a PC is busy
        network.serve(stop)
        realtime.release(obtained)

    thread = threading.Thread(target=serve, name="devices") if own_thread else None
    if thread:
        thread.start()
    session = open_session(which.zenoh, Path())
    try:
        with Daemon(
            [ServedJoint(joint=which)], session=session, devices=None if thread else network.poll
        ) as daemon:
            Witness.own = Witness.others = 0
            daemon.run(seconds)
            loop = daemon.loop
            (loop_joint,) = loop.loop_joints
            add(row, loop.cycles + loop.overruns, loop.lateness, loop_joint.pipeline.missed)
    finally:
        stop.set()
        if thread:
            thread.join()
        bus.shutdown()
        close_session(session)


def add(row: dict[str, Any], due: int, lateness: LatencyHistogram, missed: int) -> None:
    """Count a block."""
    row["due"] += due
    row["left_out_own"] += Witness.own
    row["left_out_machine"] += Witness.others
    row["without_sample"] += missed
    row["worst_late_us"] = max(row["worst_late_us"], lateness.maximum_us)


def measure(seconds: float) -> dict[str, dict[str, Any]]:
    """All three, block by block."""
    which = joint("robust", free_endpoint())
    rows = {
        "bare loop, only sleeping": total(),
        f"bare loop, {WORK_US} µs of additions": total(),
        "drivelink, devices in its own thread": total(),
        "drivelink, devices in another thread": total(),
    }
    bare, adding, polled, threaded = rows.values()
    work = additions()
    block = min(BLOCK_S, seconds)
    alarm, pacing.Alarm = pacing.Alarm, Witness  # type: ignore[misc]
    try:
        for _ in range(max(1, round(seconds / block))):
            bare_block(bare, block)
            bare_block(adding, block, work)
            daemon_block(polled, which, block, own_thread=False)
            daemon_block(threaded, which, block, own_thread=True)
    finally:
        pacing.Alarm = alarm  # type: ignore[misc]
    return rows


def report(rows: dict[str, dict[str, Any]]) -> str:
    """The table in Markdown."""
    lines = [
        "| 1 kHz | SYNCs due | left out: own work too long | left out: not woken in time | of bare loop "
        "| no sample: frames late | latest SYNC µs |",
        "|---|---|---|---|---|---|---|",
    ]
    base = rows["bare loop, only sleeping"]["left_out_machine"]
    for name, row in rows.items():
        ratio = f"{row['left_out_machine'] / base:.1f}×" if base else "-"
        lines.append(
            f"| {name} | {row['due']} | {row['left_out_own']} | {row['left_out_machine']} | {ratio} "
            f"| {row['without_sample']} | {row['worst_late_us']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of the four")
    parser.add_argument("--json", type=Path, help="also write the numbers there")
    args = parser.parse_args()
    rows = measure(args.seconds)
    print(report(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
