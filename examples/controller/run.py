"""The controller as a process: estimates over zenoh, torque over CAN.

    drivelink sim examples/controller/joint.toml &      # or real drives
    drivelink run examples/controller/joint.toml &      # the daemon
    python examples/controller/run.py examples/controller/joint.toml

Each change of phase is one line of JSON on stdout. Ctrl-C takes the torque away and ends it.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path

from vsacontrol.controller import Controller
from vsacontrol.laws import ControlLaw, Decoupler, Regulator
from vsacontrol.phases import Reaction, Settings
from vsacontrol.plant import joint_of
from vsacontrol.process import Process
from vsacontrol.references import WAYPOINTS, Reference

from drivelink import jointfile
from drivelink.cycle import realtime


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    default = Settings()
    parser.add_argument("joint", type=Path, metavar="JOINT")
    parser.add_argument("--law", choices=[*WAYPOINTS], default="decoupling")
    parser.add_argument("--seconds", type=float, help="end after so long; else the last target is held")
    parser.add_argument("--deadline", type=float, default=default.deadline_s, help="dead-man, s")
    parser.add_argument("--identify", type=float, default=default.identify_s, help="identification, s")
    parser.add_argument("--torque", type=float, default=default.torque_nm, help="limit, N·m at the joint")
    parser.add_argument(
        "--reaction", type=Reaction, choices=[*Reaction], default=default.reaction, help="to a contact"
    )
    return parser.parse_args()


def main() -> None:
    args = arguments()
    file = jointfile.load(args.joint)
    joint = joint_of(file)
    law: ControlLaw = Decoupler(joint=joint) if args.law == "decoupling" else Regulator(joint=joint)
    settings = Settings(
        deadline_s=args.deadline, identify_s=args.identify, torque_nm=args.torque, reaction=args.reaction
    )
    reference = Reference(WAYPOINTS[args.law])
    controller = Controller(joint, law, reference, file.bus.period_s, settings=settings)
    process = Process(file, args.joint.parent, controller, settings=settings, report=sys.stdout)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: process.stop())
    obtained = realtime.acquire()
    for line in obtained.lines:
        print(line, file=sys.stderr)
    end_s = time.monotonic() + (args.seconds or float("inf"))
    process.run(lambda: time.monotonic() >= end_s)


if __name__ == "__main__":
    main()
