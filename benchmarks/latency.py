"""Publisher to subscriber, two processes: drivelink beside bare zenoh with the same bytes, in one run.

    python benchmarks/latency.py [--cycles N] [--period-s T] [--json]

Blocks of half a second alternate between `JointPublisher.put_estimate` → `drivelink.subscribe().wait()` and
`Publisher.put` → `Subscriber.recv()`, in the same sessions, so that both see the same machine. A stamp is
taken before encoding (drivelink) or before the put (bare), and again when the value is in the reader's hands.
The publisher runs as the daemon's loop does: SCHED_FIFO and locked memory where the system allows.
"""

import argparse
import json
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import zenoh

import drivelink
from drivelink._core import encode_estimate
from drivelink.cycle import realtime
from drivelink.jointfile import parse
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_client, open_session
from estimator.sample import Estimate, TransmissionEstimate

ENDPOINT = "tcp/127.0.0.1:17447"
BARE_KEY = "bare/estimate"
BLOCK = 500  # cycles
SETTLE = 20  # first cycles of a block, left out for both
PERCENTILES = (50, 90, 99, 99.9)
QUALITY = {
    "encoding": zenoh.Encoding.ZENOH_SERIALIZED,
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}
JOINT = f"""
name = "latency"
arrangement = "antagonistic"
motor = [{{ inertia_kg_m2 = 0.1 }}, {{ inertia_kg_m2 = 0.1 }}]
[zenoh]
endpoint = "{ENDPOINT}"
"""


def make_estimate(sequence):
    transmissions = (TransmissionEstimate(9.0, 30.0, 1.0, 0.3), TransmissionEstimate(-10.0, 31.0, 1.5, -0.3))
    return Estimate(sequence, 3, -1.0, 61.0, 1.75, transmissions)


def blocks(cycles):
    """(first sequence, past the last, whether bare), alternating."""
    return [(first, first + BLOCK, bool(first // BLOCK % 2)) for first in range(0, cycles, BLOCK)]


def read(cycles):
    """The subscriber's process: latencies in ns of both kinds, and what was lost, as JSON."""
    session = open_client(ENDPOINT)
    bare = session.declare_subscriber(BARE_KEY, zenoh.handlers.RingChannel(1024))
    latencies = {False: [], True: []}
    with drivelink.subscribe("latency", session=session) as joint:
        while joint.model is None:
            time.sleep(0.01)
        print("ready", flush=True)
        stream = joint.cycles(timeout_s=1.0)
        for first, end, is_bare in blocks(cycles):
            sequence = -1
            while sequence < end - 1:
                if is_bare:
                    payload = bare.recv().payload.to_bytes()
                    now_ns = time.monotonic_ns()
                    sequence, stamp_ns = struct.unpack_from("<QQ", payload)
                else:
                    message = next(stream)
                    now_ns = time.monotonic_ns()
                    sequence, stamp_ns = message[:2]
                if sequence >= first + SETTLE:
                    latencies[is_bare].append(now_ns - stamp_ns)
    close_session(session)
    print(json.dumps({"drivelink": latencies[False], "bare": latencies[True]}))


def write(cycles, period_s):
    """The publisher's process: costs of encode + put in ns of both kinds, and the reader's result."""
    joint = parse(JOINT)
    session = open_session(joint.zenoh, Path())
    publisher = JointPublisher(session, joint)
    bare = session.declare_publisher(BARE_KEY, **QUALITY)
    tail = encode_estimate(make_estimate(0), 0)[16:]
    pack = struct.Struct("<QQ").pack
    costs = {"drivelink": [], "bare": []}
    reader = subprocess.Popen(
        [sys.executable, __file__, "--read", "--cycles", str(cycles)], stdout=subprocess.PIPE, text=True
    )
    assert reader.stdout.readline() == "ready\n"
    time.sleep(0.2)
    obtained = realtime.acquire()  # as the daemon's loop does
    deadline = time.monotonic()
    for first, end, is_bare in blocks(cycles):
        for sequence in range(first, end):
            estimate = make_estimate(sequence)
            deadline += period_s
            time.sleep(max(0.0, deadline - time.monotonic()))
            stamp_ns = time.monotonic_ns()
            if is_bare:
                bare.put(pack(sequence, stamp_ns) + tail)
            else:
                publisher.put_estimate(estimate, stamp_ns)
            costs["bare" if is_bare else "drivelink"].append(time.monotonic_ns() - stamp_ns)
    realtime.release(obtained)
    result = json.loads(reader.communicate(timeout=30)[0])
    close_session(session)
    return costs, result


def summarise(costs, latencies, cycles):
    expected = cycles // 2 - cycles // 2 // BLOCK * SETTLE
    summary = {}
    for kind in ("drivelink", "bare"):
        summary[kind] = {
            "latency_us": percentiles(latencies[kind]),
            "put_us": percentiles(costs[kind]),
            "lost": expected - len(latencies[kind]),
        }
    for what in ("latency_us", "put_us"):
        pair = summary["drivelink"][what], summary["bare"][what]
        summary[f"ratio_{what[:-3]}"] = {p: round(pair[0][p] / pair[1][p], 3) for p in pair[0]}
    return summary


def percentiles(nanoseconds):
    values = np.percentile(np.asarray(nanoseconds) / 1e3, PERCENTILES)
    return {f"p{p:g}": round(float(value), 1) for p, value in zip(PERCENTILES, values, strict=True)}


def show(summary):
    names = [f"p{p:g}" for p in PERCENTILES]
    print(f"{'µs':24}" + "".join(f"{name:>9}" for name in names) + "     lost")
    for what in ("latency_us", "put_us"):
        for kind in ("drivelink", "bare"):
            row = summary[kind]
            lost = f"{row['lost']:9}" if what == "latency_us" else ""
            title = f"{kind} {'latency' if what == 'latency_us' else 'encode + put'}"
            print(f"{title:24}" + "".join(f"{row[what][name]:9.1f}" for name in names) + lost)
        ratio = summary[f"ratio_{what[:-3]}"]
        print(f"{'  ratio':24}" + "".join(f"{ratio[name]:8.2f}×" for name in names))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=40_000, help="rounded to whole pairs of blocks")
    parser.add_argument("--period-s", type=float, default=0.001)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--read", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    cycles = max(1, args.cycles // (2 * BLOCK)) * 2 * BLOCK
    if args.read:
        read(cycles)
        return
    summary = summarise(*write(cycles, args.period_s), cycles)
    if args.json:
        print(json.dumps(summary))
    else:
        show(summary)


if __name__ == "__main__":
    main()
