"""A second of estimates as numpy arrays, for analysis rather than control.

python examples/subscribe_numpy.py [JOINT [ENDPOINT [SECONDS]]]
"""

import signal
import sys
import time

import numpy as np

import drivelink
from drivelink.errors import DrivelinkError


def main(joint: str = "elbow", endpoint: str = "tcp/127.0.0.1:7447", seconds: str = "1") -> None:
    with drivelink.subscribe(joint, endpoint=endpoint, depth=100_000) as elbow:
        if elbow.wait(timeout_s=5.0) is None:
            sys.exit(f"no estimate of {joint} within 5 s: the daemon is {elbow.state}")
        time.sleep(float(seconds))
        records = elbow.take()
    steps_ms = np.diff(records["stamp_ns"].astype(np.int64)) / 1e6
    print(f"{len(records)} estimates of {joint}, {elbow.gaps} missing")
    print(f"period {np.mean(steps_ms):.3f} ms, from {np.min(steps_ms):.3f} to {np.max(steps_ms):.3f} ms")
    print(f"stiffness {np.mean(records['stiffness_nm_rad']):.4g} N·m/rad")
    deflection = records["transmissions"]["deflection_rad"]  # (n, transmissions)
    print(f"deflection {np.round(deflection.min(axis=0), 4)} to {np.round(deflection.max(axis=0), 4)} rad")


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        sys.exit(print(__doc__))
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it without a traceback
    try:
        main(*sys.argv[1:])
    except (DrivelinkError, ValueError) as error:
        sys.exit(f"{error}\n{__doc__}")
