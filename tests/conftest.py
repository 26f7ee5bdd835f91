"""What holds for every test."""

import os
import signal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

# A shell starts what runs in the background with SIGINT ignored, and processes hand that on to the ones they
# start; the tests press Ctrl-C on theirs.
signal.signal(signal.SIGINT, signal.default_int_handler)
