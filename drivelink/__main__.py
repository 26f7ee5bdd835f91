"""`drivelink`, and `python -m drivelink`."""

import signal
import sys

_BEFORE = signal.getsignal(signal.SIGINT)
if _BEFORE is signal.default_int_handler:  # and not ignored, as behind `&` in a script
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while modules are loaded: no traceback
from drivelink.cli import main  # noqa: E402

if _BEFORE is signal.default_int_handler:
    signal.signal(signal.SIGINT, _BEFORE)

if __name__ == "__main__":
    sys.exit(main())
