"""Do the 95 % intervals on line hold the truth, also after minutes? The demo's joints, in lockstep.

    python benchmarks/intervals.py [--case vsa-ii] [--seconds 60] [--json]

A row for each ten seconds: share of the cycles that were valid, share of those whose interval held the true
stiffness, RMSE of the stiffness relative to the truth, and the median of the relative standard deviation.
"""

import argparse
import json
import logging
from importlib import resources

import numpy as np

from drivelink import jointfile
from drivelink.cycle.loop import ObjectSink
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint, world_from_joint
from estimator.sample import Estimate, Sample, Status

WINDOW_S = 10


class Beside(ObjectSink):
    """A sink that keeps each estimate with what was true at its SYNC."""

    def __init__(self, world):
        self.world = world
        self.rows = []

    def put_estimate(self, estimate: Estimate, stamp_ns: int) -> None:
        valid = bool(estimate.status & int(Status.VALID))
        truth = self.world.truth().stiffness_nm_rad
        self.rows.append((valid, estimate.stiffness_nm_rad, estimate.stiffness_std_nm_rad, truth))

    def put_sample(self, sample: Sample, stamp_ns: int) -> None:
        pass


def measure(case, seconds):
    """The rows of one case."""
    with resources.as_file(resources.files("drivelink") / "joints" / f"{case}.toml") as path:
        joint = jointfile.load(path)
    world, bus = world_from_joint(joint), open_sim_bus(joint.bus)
    network = network_from_joint(joint, bus, world=world)
    served, rows = [ServedJoint(joint=joint)], []
    with bus, Daemon(served, publish=False, devices=network.poll, real_time=False) as daemon:
        (loop_joint,) = daemon.loop.loop_joints
        for begin in range(0, seconds, WINDOW_S):
            loop_joint.sink = sink = Beside(world)
            daemon.run_lockstep(round(WINDOW_S / joint.bus.period_s))
            valid, estimated, std, truth = np.array(sink.rows).T
            estimated, std, truth = (values[valid > 0] for values in (estimated, std, truth))
            rows.append(
                {
                    "from_s": begin,
                    "valid": float(np.mean(valid)),
                    "coverage": float(np.mean(np.abs(estimated - truth) < 1.96 * std)),
                    "rmse_relative": float(np.sqrt(np.mean((estimated / truth - 1.0) ** 2))),
                    "std_relative": float(np.median(std / estimated)),
                }
            )
    return rows


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", choices=("constant", "quadratic", "vsa-ii"), default="vsa-ii")
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    rows = measure(args.case, args.seconds)
    if args.json:
        print(json.dumps(rows))
        return
    print("from s   valid  covered   RMSE %    std %")
    for row in rows:
        print(
            f"{row['from_s']:6d} {row['valid']:7.3f} {row['coverage']:8.3f} "
            f"{100 * row['rmse_relative']:8.3f} {100 * row['std_relative']:8.3f}"
        )


if __name__ == "__main__":
    main()
