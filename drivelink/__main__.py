"""`python -m drivelink`."""

import sys

from drivelink.cli import main

if __name__ == "__main__":
    sys.exit(main())
