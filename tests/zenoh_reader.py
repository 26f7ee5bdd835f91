"""A subscriber in a process of its own, for tests that stop or kill it: python zenoh_reader.py ENDPOINT."""

import sys

import drivelink

with drivelink.subscribe("elbow", endpoint=sys.argv[1]) as joint:
    while joint.model is None:
        joint.wait(0.01)
    print("ready", flush=True)
    for _ in joint:
        pass
