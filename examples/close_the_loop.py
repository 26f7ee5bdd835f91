"""The whole loop without hardware: healthy run, fit, a run with undeclared friction, diagnosis.

python examples/close_the_loop.py [FOLDER]

The simulated VSA-II, its CANopen drives and the daemon's own cycle run in this thread, faster than real time.
What is recorded goes through `drivelink.fit` and `drivelink.diagnose`, as a recording of a real joint would.
"""

import argparse
from pathlib import Path

import drivelink
from drivelink import jointfile
from drivelink._core import Tick
from drivelink.canopen.bus import open_bus
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simulate import network_from_joint, world_from_joint
from drivelink.recording.formats import open_sink

JOINT = Path(__file__).parent / "vsa-ii.toml"
FRICTION_NM = 0.004


class Recorder:
    """Take what the daemon would publish, and write the samples to a CSV file."""

    def __init__(self, path: Path) -> None:
        self.file = open_sink(path, jointfile.load(JOINT))

    def put(self, tick: Tick) -> None:
        if tick.sample is not None:
            self.file.sample(tick.sample, tick.stamp_ns)


def record(path: Path, seconds: float, *effects: str, run: int = 0) -> None:
    """Record a joint in which these effects are switched on; each run has a motion and noise of its own."""
    joint = jointfile.load(JOINT)
    excitation = {**joint.sim.excitation, "seed": run}
    sim = joint.sim.model_copy(update={"seed": run, "excitation": excitation})
    joint = joint.model_copy(update={"sim": sim})
    world = world_from_joint(joint, effects=effects)
    path.unlink(missing_ok=True)
    recorder = Recorder(path)
    with open_bus(joint.bus) as bus:
        devices = network_from_joint(joint, bus, world=world).poll
        with Daemon([ServedJoint(joint=joint)], publish=False, real_time=False, devices=devices) as daemon:
            daemon.loop.loop_joints[0].sink = recorder
            daemon.run_lockstep(round(seconds / joint.bus.period_s))
    recorder.file.close()


def main(folder: str) -> None:
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    healthy, suspect, model = out / "healthy.csv", out / "suspect.csv", out / "elbow.toml"
    print("recording a healthy joint, and one with dry friction …", flush=True)
    record(healthy, 10.0)
    record(suspect, 10.0, f"coulomb_friction={FRICTION_NM}")
    fit = drivelink.fit(healthy, joint=JOINT)
    fit.plot().save(out / "fit.png")
    fit.write(model, force=True)
    found = drivelink.diagnose(suspect, joint=model)
    print(found)
    found.report(out)
    found.write(out / "elbow-better.toml", force=True)
    print(f"\nswitched on was coulomb_friction of {FRICTION_NM} N·m; open {out / 'report.html'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", default="close_the_loop")
    main(parser.parse_args().folder)
