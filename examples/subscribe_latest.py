"""A control loop at its own rate, 100 Hz, that takes the latest stiffness and never waits for it.

python examples/subscribe_latest.py [JOINT [ENDPOINT [SECONDS]]]
"""

import signal
import sys
import time

import drivelink
from drivelink.errors import DrivelinkError

PERIOD_S = 0.01
FALLBACK_NM_RAD = 500.0  # what the controller assumes where it must not trust the estimate


def main(joint: str = "elbow", endpoint: str = "tcp/127.0.0.1:7447", seconds: str = "10") -> None:
    with drivelink.subscribe(joint, endpoint=endpoint) as elbow:
        start = deadline = time.monotonic()
        while deadline < start + float(seconds):
            estimate = elbow.latest()
            fresh = estimate is not None and not elbow.stale
            trusted = fresh and estimate.usable and estimate.observable
            stiffness = estimate.stiffness_nm_rad if trusted else FALLBACK_NM_RAD
            gain = 0.1 * stiffness  # ... and here the controller uses it
            if round((deadline - start) / PERIOD_S) % 50 == 0:
                age_ms = elbow.age_s * 1e3
                print(f"{elbow.state:8} gain {gain:7.4g} N·m/rad  age {age_ms:6.2f} ms  gaps {elbow.gaps}")
            deadline += PERIOD_S
            time.sleep(max(0.0, deadline - time.monotonic()))


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
