"""What each stage of a cycle costs as joints are added, and how many joints one core carries.

    python benchmarks/stages.py [--cycles N] [--joints N]

Recorded frames of the simulated devices are laid into the queues of virtual buses; then the daemon's own
parts take them, at 1 kHz in one thread with real-time scheduling where the system allows, and publish to a
subscriber in another process. CPU of the thread, by stage; CPU of the whole process a cycle, with zenoh's
threads and the sleeping, without the laying of frames. The floor receives, unpacks and puts the same bytes.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import can
import scene
import zenoh
from rig import PERIOD_S, free_endpoint, joint, subscriber
from rivals import Floor

from drivelink._core import SYNC_COB_ID, encode_estimate, encode_sample
from drivelink.canopen.layout import NodeLayout
from drivelink.cycle import realtime
from drivelink.cycle.pipeline import make_pipeline
from drivelink.cycle.sources import open_source
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint
from drivelink.jointfile import JointFile
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_session

STAGES = ("receive", "decode", "estimate", "encode", "put")
CASES = ((1, 1), (1, 2), (2, 2), (4, 2), (8, 2), (16, 2))  # joints, motors of each
SETTLE = 500  # cycles at the start that are not counted

Cycles = list[list[can.Message]]


def frames_of(which: JointFile, cycles: int) -> tuple[Cycles, dict[int, NodeLayout]]:
    """The PDOs of so many cycles, and how they are laid out."""
    bus = open_sim_bus(which.bus)
    network = network_from_joint(which, bus)
    recorder = can.Bus(interface="virtual", channel=which.bus.channel, preserve_timestamps=True)
    recorded: Cycles = []
    with Daemon([ServedJoint(joint=which)], publish=False, real_time=False, devices=network.poll) as daemon:
        layouts = dict(daemon.layouts)
        while recorder.recv(0):
            pass
        for _ in range(cycles):
            daemon.run_lockstep(1)
            frames = iter(partial(recorder.recv, 0), None)
            recorded.append([frame for frame in frames if 0x180 < frame.arbitration_id < 0x580])  # PDOs
    recorder.shutdown()
    bus.shutdown()
    return recorded, layouts


class Clocked:
    """One joint's part of the daemon, stage by stage."""

    def __init__(
        self, index: int, motors: int, layouts: dict[int, NodeLayout], session: zenoh.Session
    ) -> None:
        which = joint("robust", free_endpoint(), motors=motors)
        self.bus = can.Bus(interface="virtual", channel=f"stage-{index}")
        self._source = open_source(self.bus)
        self._pipeline = make_pipeline(which, tuple(layouts.values()))
        named = joint("robust", free_endpoint(), index=index, motors=motors)
        self.publisher = JointPublisher(session, named)

    def work(self, spent: list[int]) -> None:
        """One cycle; adds the CPU time of each stage, ns."""
        clock, pipeline = time.thread_time_ns, self._pipeline
        begin = clock()
        frames = self._source.take()
        received = clock()
        pipeline.assembler.feed(SYNC_COB_ID, b"")
        samples = [pipeline.assembler.feed(cob_id, data) for cob_id, data, _ in frames]
        sample = samples[-1]
        assert sample is not None
        decoded = clock()
        estimate = pipeline.estimator.step(sample)
        estimated = clock()
        payloads = encode_estimate(estimate, 0), encode_sample(sample, 0)
        encoded = clock()
        self.publisher._estimate.put(payloads[0])
        self.publisher._sample.put(payloads[1])
        put = clock() - encoded
        for stage, ns in enumerate(
            (received - begin, decoded - received, estimated - decoded, encoded - estimated, put)
        ):
            spent[stage] += ns


class Bare:
    """The floor's part for one joint, with the same interface."""

    def __init__(
        self, index: int, motors: int, layouts: dict[int, NodeLayout], session: zenoh.Session
    ) -> None:
        self.bus = can.Bus(interface="virtual", channel=f"floor-{index}")
        self._source = open_source(self.bus)
        self.publisher = Floor(joint("paper", free_endpoint(), motors=motors), layouts, session)

    def work(self, spent: list[int]) -> None:
        """One cycle."""
        begin = time.thread_time_ns()
        self.publisher.take(self._source)
        received = time.thread_time_ns()
        self.publisher.put()
        spent[0] += received - begin
        spent[4] += time.thread_time_ns() - received


def paced(parts: list[Clocked] | list[Bare], recorded: Cycles) -> dict[str, Any]:
    """All joints at 1 kHz: CPU by stage and in all, and cycles that took longer than a period."""
    alarm, clock = realtime.Alarm(), time.monotonic_ns
    period = round(PERIOD_S * 1e9)
    stages: list[list[int]] = []
    late, laying_s, cpu_s = 0, 0.0, 0.0
    obtained = realtime.acquire()
    deadline = clock() + period
    for k, messages in enumerate(recorded):
        if k == SETTLE:
            cpu_s, laying_s, late = time.process_time(), 0.0, 0
        start = time.thread_time()
        for part in parts:
            for message in messages:
                part.bus.queue.put(message)
        laying_s += time.thread_time() - start
        alarm.sleep_until(deadline)
        spent = [0] * len(STAGES)
        for part in parts:
            part.work(spent)
        stages.append(spent)
        late += clock() > deadline + period
        deadline = max(deadline + period, clock())
    cpu_s = time.process_time() - cpu_s - laying_s
    realtime.release(obtained)
    cycles = len(recorded) - SETTLE
    columns = zip(*stages[SETTLE:], strict=True)
    totals = sorted(map(sum, stages[SETTLE:]))
    return {
        **{name: statistics.median(column) / 1e3 for name, column in zip(STAGES, columns, strict=True)},
        "work_p50_us": statistics.median(totals) / 1e3,
        "work_p99_us": totals[int(0.99 * cycles)] / 1e3,
        "process_us_per_cycle": 1e6 * cpu_s / cycles,
        "over_a_period": late,
        "cycles": cycles,
    }


def measure(cycles: int, most: int) -> Iterator[scene.Row]:
    """One row a number of joints, up to `most`."""
    recordings = {
        motors: frames_of(joint("robust", free_endpoint(), motors=motors), cycles) for motors in (1, 2)
    }
    for joints, motors in (case for case in CASES if case[0] <= most):
        endpoint = free_endpoint()
        session = open_session(joint("robust", endpoint).zenoh, Path())
        reader = subscriber(endpoint)
        recorded, layouts = recordings[motors]
        parts = [Clocked(index, motors, layouts, session) for index in range(joints)]
        row = {"joints": joints, "motors": joints * motors, **paced(parts, recorded)}
        bare = [Bare(index, motors, layouts, session) for index in range(joints)]
        row["floor"] = paced(bare, recorded)
        row["of_floor"] = row["process_us_per_cycle"] / row["floor"]["process_us_per_cycle"]
        for part in (*parts, *bare):
            part.publisher.close()
            part.bus.shutdown()
        close_session(session)
        reader.communicate(b"")
        yield row


def rows(args: Any) -> Iterator[scene.Row]:
    """One row a number of joints."""
    return measure(args.cycles, args.joints)


def carried(found: list[scene.Row]) -> str:
    """VSA joints that one core carries at 1 kHz, from what the last ones added cost."""
    one, many = (next(r for r in found if (r["joints"], r["motors"]) == at) for at in ((1, 2), (4, 8)))
    each = (many["process_us_per_cycle"] - one["process_us_per_cycle"]) / (many["joints"] - one["joints"])
    most = 1 + (1e6 * PERIOD_S - one["process_us_per_cycle"]) / each
    return f"CPU in µs. At 1 kHz one core carries {most:.1f} VSA joints (process, computed)."


COLUMNS = {
    "joints": "{joints}",
    "motors": "{motors}",
    **{name: f"{{{name}:.0f}}" for name in STAGES},
    "work p50 / p99": "{work_p50_us:.0f} / {work_p99_us:.0f}",
    "process a cycle": "{process_us_per_cycle:.0f}",
    "of floor": "{of_floor:.1f}×",
    "over 1 ms": "{over_a_period} of {cycles}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--cycles", 5000),
        scene.Option("--joints", 16, "at most (at least 4)"),
        after=carried,
    )
