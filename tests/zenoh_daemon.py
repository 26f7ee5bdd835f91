"""A daemon without a bus, for tests: python zenoh_daemon.py NAME ENDPOINT [MORE_TOML] [HOW]; 200 estimates a second.

HOW: "raise" ends with an uncaught exception after a few estimates.
"""

import sys
import time
from pathlib import Path

from zenohkit import Cycle, make_estimate, make_external, make_joint, make_sample

from drivelink.errors import DrivelinkError
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import open_session


def main(name: str, endpoint: str, more: str = "", how: str = "") -> None:
    joint = make_joint(name, endpoint, more)
    session = open_session(joint.zenoh, Path())
    publisher = JointPublisher(session, joint, lossless=True)
    print("ready", flush=True)
    sequence = 0
    while True:
        sequence += 1
        now_ns = time.time_ns()
        external = make_external(sequence, 3 if sequence % 400 >= 200 else 1)
        publisher.put(Cycle(make_estimate(sequence), make_sample(sequence), external, now_ns))
        if sequence % 50 == 1:
            publisher.put_status({"state": "running", "cycles": sequence, "residual_nm": 0.003})
        if how == "raise" and sequence == 20:
            raise RuntimeError("uncaught")
        time.sleep(0.005)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except DrivelinkError as error:
        sys.exit(f"drivelink: {error}")
