"""Fuzz everything that arrives from the bus, for as long as you like; the seed reproduces what was found.

    python benchmarks/fuzz.py [--frames 10000000] [--seed 1] [--hostile | --passive | --estimator]

See `tests/fuzzbus.py` for what is done to the frames and what must hold. Every run of a million frames has a
seed of its own, counted up from the one given.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzrun import FuzzRun

PORTION = 1_000_000


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--hostile", action="store_true", help="forge answers to the configuration too")
    kind.add_argument("--passive", action="store_true", help="of a daemon that only listens")
    kind.add_argument("--estimator", action="store_true", help="with the real estimator, which is slow")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    left, seed = options.frames, options.seed
    while left > 0:
        began_s = time.perf_counter()
        run = FuzzRun(seed, hostile=options.hostile, passive=options.passive, real=options.estimator)
        run.run(min(left, PORTION))
        print(f"{run.summary()} in {time.perf_counter() - began_s:.1f} s", flush=True)
        left -= PORTION
        seed += 1


if __name__ == "__main__":
    main()
