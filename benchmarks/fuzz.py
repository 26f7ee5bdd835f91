"""Fuzz everything that arrives from the bus or in a file, for as long as you like; the seed reproduces it.

    python benchmarks/fuzz.py [--frames 10000000] [--seed 1] [--hostile | --passive | --estimator]
    python benchmarks/fuzz.py --parsers [--hours 1] [--seed 1]

See `tests/fuzzbus.py` for what is done to the frames and what must hold. Every run of a million frames has a
seed of its own, counted up from the one given. With --parsers: damaged inputs for every parser
(`tests/fuzzparsers.py`), with CPU and memory of the costliest; what fails is kept in `tests/corpus`.
"""

import argparse
import hashlib
import logging
import random
import resource
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzparsers import CORPUS, PARSERS, damaged, seeds, take
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
    kind.add_argument("--parsers", action="store_true", help="of files and messages instead")
    parser.add_argument("--hours", type=float, default=1.0, help="of the parsers")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if options.parsers:
        sys.exit(fuzz_parsers(options.hours * 3600, options.seed))
    left, seed = options.frames, options.seed
    while left > 0:
        began_s = time.perf_counter()
        run = FuzzRun(seed, hostile=options.hostile, passive=options.passive, real=options.estimator)
        run.run(min(left, PORTION))
        print(f"{run.summary()} in {time.perf_counter() - began_s:.1f} s", flush=True)
        left -= PORTION
        seed += 1


def fuzz_parsers(seconds: float, seed: int) -> int:
    """Damage inputs of every parser in turn; return how many failures were kept in the corpus."""
    rng, failed = random.Random(seed), 0
    costs = dict.fromkeys(PARSERS, (0.0, 0.0))  # greatest CPU of an input, s; growth of the peak memory, MB
    cases, end_s = 0, time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < end_s:
            for name in PARSERS:
                data = damaged(rng.choice(seeds(name)), rng)
                before_s, before_kb = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
                try:
                    take(name, data, Path(folder))
                except Exception as error:  # noqa: BLE001 - that is what is sought
                    failed += 1
                    kept = CORPUS / name / hashlib.sha256(data).hexdigest()[:16]
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    kept.write_bytes(data)
                    print(f"{name}: {type(error).__name__}: {str(error)[:200]} ({kept})", flush=True)
                grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
                spent = time.process_time() - before_s
                costs[name] = max(costs[name][0], spent), max(costs[name][1], grown)
                cases += 1
    for name, (cpu_s, grown) in costs.items():
        print(f"{name:12} costliest input {cpu_s:.3f} s CPU, {grown:.0f} MB more than any before")
    print(f"{cases} inputs, {failed} failed")
    return min(failed, 1)


if __name__ == "__main__":
    main()
