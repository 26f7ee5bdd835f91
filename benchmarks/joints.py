"""Many joints at 1 kHz through one zenoh router: rate, loss and latency as their number grows.

    python benchmarks/joints.py [--joints 1,6,12,24] [--processes 4] [--seconds S] [--direct] [--json]

Processes: a router (a zenoh session with examples/zenoh/router.json5, or `--zenohd PATH`), publishers that
share the joints among them and put one estimate a joint and millisecond, and one subscriber of
`drivelink/*/estimate` that reads them all. `--direct` lets it connect to the publishers themselves.
"""

import argparse
import json
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import zenoh

from drivelink.cycle import realtime
from drivelink.jointfile import parse
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_client, open_session
from estimator.sample import Estimate, TransmissionEstimate

PORT = 17448
ENDPOINT = f"tcp/127.0.0.1:{PORT}"
ROUTER = Path(__file__).parent.parent / "examples" / "zenoh" / "router.json5"
PERIOD_S = 0.001
SETTLE = 200  # cycles at the start, while connections and queues settle
TRANSMISSIONS = (TransmissionEstimate(9.0, 30.0, 1.0, 0.3), TransmissionEstimate(-10.0, 31.0, 1.5, -0.3))


def route(config):
    """The router's process."""
    with zenoh.open(zenoh.Config.from_file(config)):
        print("ready", flush=True)
        signal.pause()


def publish(names, cycles):
    """A publisher's process: all its joints, each cycle."""
    joints = [
        parse(f'name = "{name}"\n[[motor]]\ninertia_kg_m2 = 0.1\n[zenoh]\nendpoint = "{ENDPOINT}"\n')
        for name in names
    ]
    session = open_session(joints[0].zenoh, Path())
    publishers = [JointPublisher(session, joint, express=joint is joints[-1]) for joint in joints]
    print("ready", flush=True)
    sys.stdin.readline()
    obtained = realtime.acquire()
    start = deadline = time.monotonic()
    for sequence in range(cycles):
        deadline += PERIOD_S
        time.sleep(max(0.0, deadline - time.monotonic()))
        estimate = Estimate(sequence, 3, -1.0, 61.0, 1.75, TRANSMISSIONS)
        for publisher in publishers:
            publisher.put_estimate(estimate, time.monotonic_ns())
    elapsed_s = time.monotonic() - start
    realtime.release(obtained)
    time.sleep(0.5)
    close_session(session)
    print(cycles / elapsed_s)


def subscribe(joints, cycles, config):
    """The subscriber's process: sequence, stamp and arrival of every message of every joint."""
    session = open_client(ENDPOINT, config or None)
    subscriber = session.declare_subscriber("drivelink/*/estimate", zenoh.handlers.RingChannel(200_000))
    print("ready", flush=True)
    head = struct.Struct("<QQ").unpack_from
    latencies, ended = defaultdict(list), 0
    deadline = time.monotonic() + cycles * PERIOD_S * 3 + 10
    while ended < joints and time.monotonic() < deadline:
        while (sample := subscriber.try_recv()) is None and time.monotonic() < deadline:
            time.sleep(50e-6)
        if sample is None:
            break
        now_ns = time.monotonic_ns()
        sequence, stamp_ns = head(sample.payload.to_bytes())
        if sequence >= SETTLE:
            latencies[str(sample.key_expr)].append(now_ns - stamp_ns)
        ended += sequence == cycles - 1
    close_session(session)
    each = [np.percentile(np.asarray(values) / 1e3, (50, 99)) for values in latencies.values()]
    print(
        json.dumps(
            {
                "received": sum(map(len, latencies.values())),
                "expected": joints * (cycles - SETTLE),
                "joints_without_loss": sum(len(v) == cycles - SETTLE for v in latencies.values()),
                "p50_us": float(np.median([p50 for p50, _ in each])),
                "p99_us": float(np.median([p99 for _, p99 in each])),
                "worst_joint_p99_us": float(np.max([p99 for _, p99 in each])),
            }
        )
    )


class Process:
    """One of the processes, with the processor time it used."""

    def __init__(self, *args, command=None):
        self.process = subprocess.Popen(
            command or [sys.executable, __file__, *map(str, args)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ready(self):
        assert self.process.stdout.readline() == "ready\n"
        return self

    def cpu_s(self):
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def result(self):
        return self.process.communicate(timeout=120)[0]


def configured(directory, name, text):
    path = Path(directory) / name
    path.write_text(text)
    return path


def measure(joints, args, directory):
    """One row of the table."""
    cycles = SETTLE + round(args.seconds / PERIOD_S)
    router_file = configured(directory, "router.json5", ROUTER.read_text().replace("7447", str(PORT)))
    client = {
        "mode": "client",
        "connect": {"endpoints": [ENDPOINT]},
        "scouting": {"multicast": {"enabled": False}},
    }
    client_file = configured(directory, "client.json5", json.dumps(client))
    command = [args.zenohd, "-c", str(router_file)] if args.zenohd else None
    router = Process("--role", "route", "--config", router_file, command=command)
    try:
        time.sleep(1.0) if args.zenohd else router.ready()
        names = [f"joint{i + 1:02}" for i in range(joints)]
        shares = [share for i in range(args.processes) if (share := names[i :: args.processes])]
        publishers = [
            Process("--role", "publish", "--names", ",".join(s), "--cycles", cycles).ready() for s in shares
        ]
        config = "" if args.direct else client_file
        reader = Process(
            "--role", "subscribe", "--cycles", cycles, "--count", joints, "--config", config
        ).ready()
        time.sleep(1.0)
        before_s = router.cpu_s()
        for publisher in publishers:
            publisher.process.stdin.write("go\n")
            publisher.process.stdin.flush()
        row = {"joints": joints, "processes": len(shares), **json.loads(reader.result())}
        row["router_cpu_percent"] = 100 * (router.cpu_s() - before_s) / (cycles * PERIOD_S)
        row["rate_hz"] = min(float(publisher.result()) for publisher in publishers)
    finally:
        router.process.kill()
        router.process.wait()
    row["lost_percent"] = 100 * (1 - row["received"] / row["expected"])
    return row


def show(row):
    print(
        f"{row['joints']:6} {row['processes']:9} {row['rate_hz']:8.1f} {row['lost_percent']:9.4f} "
        f"{row['joints_without_loss']:8} {row['p50_us']:9.0f} {row['p99_us']:9.0f} "
        f"{row['worst_joint_p99_us']:9.0f} {row['router_cpu_percent']:9.0f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--joints", default="1,6,12,24")
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--direct", action="store_true", help="the subscriber connects to every publisher")
    parser.add_argument("--zenohd", help="path of a zenohd to use as the router")
    parser.add_argument("--json", action="store_true")
    for name in ("--role", "--names", "--config", "--cycles", "--count"):
        parser.add_argument(name, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role == "route":
        route(args.config)
    elif args.role == "publish":
        publish(args.names.split(","), int(args.cycles))
    elif args.role == "subscribe":
        subscribe(int(args.count), int(args.cycles), args.config)
    else:
        if not args.json:
            print("joints processes  rate Hz    lost %  no loss    p50 µs    p99 µs  worst µs  router %")
        with tempfile.TemporaryDirectory() as directory:
            for joints in map(int, args.joints.split(",")):
                row = measure(joints, args, directory)
                print(json.dumps(row)) if args.json else show(row)


if __name__ == "__main__":
    main()
