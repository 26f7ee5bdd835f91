"""What holds for every test."""

import signal

# A shell starts what runs in the background with SIGINT ignored, and processes hand that on to the ones they
# start; the tests press Ctrl-C on theirs.
signal.signal(signal.SIGINT, signal.default_int_handler)
