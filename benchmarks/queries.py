"""What a flood of queries costs the cycle.

    python benchmarks/queries.py [--seconds S] [--rounds N] [--rate R] [--json FILE]

Another process asks for model, status and schema of the joint, so many times a second, and never waits. The
baseline is the same daemon beside the same flood at somebody else: a bare zenoh session with such queryables
that answers nothing. The processors are as busy, and only the daemon's share differs. Rounds alternate. The
cycle's thread is measured by its own CPU time, so another load of the machine is not in it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

from rig import PERIOD_S, Devices, free_endpoint, joint

from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.jointfile import JointFile
from drivelink.pubsub.session import close_session, open_session

FLOOD = """
import sys, time
import zenoh
endpoint, key, rate = sys.argv[1], sys.argv[2], float(sys.argv[3])
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
config.insert_json5("scouting/multicast/enabled", "false")
replies = [0]
def count(reply):
    replies[0] += 1
with zenoh.open(config) as session:
    sent, begin, end = 0, time.monotonic(), time.monotonic() + float(sys.argv[4])
    print("asking", flush=True)
    while (now := time.monotonic()) < end:
        while sent < (now - begin) * rate:
            session.get(f"{key}/{('model', 'status', 'schema')[sent % 3]}", count, timeout=1.0)
            sent += 1
        time.sleep(0.002)
    print(sent, replies[0], flush=True)
"""
ELSEWHERE = """
import sys
import zenoh
config = zenoh.Config()
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    rings = [session.declare_queryable(f"{sys.argv[2]}/{name}", zenoh.handlers.RingChannel(1), complete=True)
             for name in ("model", "status", "schema")]
    print("there", flush=True)
    sys.stdin.read()
"""


def one_round(which: JointFile, key: str, asked: str, rate: float, seconds: float) -> dict[str, float]:
    """The daemon for so long, while the queries go to `asked`."""
    session = open_session(which.zenoh, Path())
    devices = Devices(which)
    try:
        with Daemon([ServedJoint(joint=which)], session=session, devices=devices.poll) as daemon:
            command = [sys.executable, "-c", FLOOD, asked, key, str(rate), str(seconds + 1)]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as flood:
                assert flood.stdout is not None
                flood.stdout.readline()
                thread_s, process_s = time.thread_time(), time.process_time()
                daemon.run(seconds)
                thread_s = time.thread_time() - thread_s - devices.cpu_s
                process_s = time.process_time() - process_s - devices.cpu_s
                sent, replies = map(int, flood.stdout.readline().split())
            loop = daemon.loop
            return {
                "cycles": loop.cycles,
                "left_out": loop.overruns,
                "thread_us_per_cycle": 1e6 * thread_s / loop.cycles,
                "process_us_per_cycle": 1e6 * process_s / loop.cycles,
                "queries": sent,
                "replies": replies,
            }
    finally:
        devices.close()
        close_session(session)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="of one round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--rate", type=float, default=1000.0, help="queries a second")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    endpoint, other = free_endpoint(), free_endpoint()
    which = joint("robust", endpoint)
    key = f"{which.zenoh.prefix}/{which.name}"
    command = [sys.executable, "-c", ELSEWHERE, other, key]
    rows: dict[str, list[dict[str, float]]] = {"asked": [], "beside": []}
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as bare:
        assert bare.stdout is not None
        bare.stdout.readline()
        for _ in range(args.rounds):
            rows["beside"].append(one_round(which, key, other, args.rate, args.seconds))
            rows["asked"].append(one_round(which, key, endpoint, args.rate, args.seconds))
        bare.communicate()
    median = {
        name: {what: statistics.median([row[what] for row in each]) for what in each[0]}
        for name, each in rows.items()
    }
    print("| queries | CPU of the cycle's thread, µs a cycle | of the whole process | cycles left out |")
    print("|---|---|---|---|")
    for name, said in (("beside", "at somebody else"), ("asked", "at the daemon")):
        row = median[name]
        left_out = row["left_out"] / (row["cycles"] + row["left_out"])
        print(
            f"| {row['queries']:.0f} {said}, {row['replies']:.0f} answered "
            f"| {row['thread_us_per_cycle']:.1f} | {row['process_us_per_cycle']:.1f} | {left_out:.2%} |"
        )
    more_us = median["asked"]["thread_us_per_cycle"] - median["beside"]["thread_us_per_cycle"]
    share = more_us * 1e-6 / PERIOD_S
    print(f"\nThe flood takes {share:.2%} of the cycle's time from its thread.")
    if args.json:
        args.json.write_text(json.dumps({"share": share, **median}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
