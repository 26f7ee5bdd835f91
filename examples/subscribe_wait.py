"""A controller in step with the joint: one pass per SYNC, and a safe state when none comes in time.

python examples/subscribe_wait.py [JOINT [ENDPOINT [SECONDS]]]
"""

import signal
import sys
import time

import drivelink
from drivelink.errors import DrivelinkError

TIMEOUT_S = 0.01  # ten cycles at 1 kHz


def main(joint: str = "elbow", endpoint: str = "tcp/127.0.0.1:7447", seconds: str = "10") -> None:
    end = time.monotonic() + float(seconds)
    passes, safe = 0, None  # which it is, is said from the start
    with drivelink.subscribe(joint, endpoint=endpoint) as elbow:
        while time.monotonic() < end:
            estimate = elbow.wait(TIMEOUT_S)
            late = estimate is None or elbow.stale
            if late or not estimate.usable:
                if safe is not True:
                    why = f"no estimate in time, the daemon is {elbow.state}" if late else "it is not usable"
                    print(f"safe state: {why}")
                safe = True
                continue
            if safe is not False:
                print(f"in control from cycle {estimate.sequence} on")
            safe = False
            passes += 1
            reaction_nm = -estimate.flexibility_torque_nm  # ... and here the controller uses it
            if passes % 500 == 0:
                stiffness = f"{estimate.stiffness_nm_rad:.5g} ± {estimate.stiffness_std_nm_rad:.2g} N·m/rad"
                print(f"cycle {estimate.sequence}: {reaction_nm:+.3f} N·m, {stiffness}")
        print(f"{passes} passes, {elbow.gaps} cycles missing, {elbow.foreign} messages of a foreign writer")


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        sys.exit(print(__doc__))
    sys.stdout.reconfigure(line_buffering=True)  # a pipe or a file has every line, however it ends
    for ending in (signal.SIGINT, signal.SIGPIPE):  # Ctrl-C and `| head` end it without a traceback
        signal.signal(ending, signal.SIG_DFL)
    try:
        main(*sys.argv[1:])
    except (DrivelinkError, ValueError) as error:
        sys.exit(f"{error}\n{__doc__}")
