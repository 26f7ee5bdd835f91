"""Both control laws with the true, the nominal (20 % wrong) and the estimated springs: errors and plots.

    python examples/controller/compare.py [--out FOLDER] [--seed N] [--law regulation|decoupling]

Everything runs in lockstep, the daemon's own code included: some minutes in all. Each law follows its
reference twice: undisturbed, and while an undeclared torque pushes the link.
"""

from __future__ import annotations

import argparse
import itertools
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from vsacontrol.study import KNOWLEDGE, LAWS, draw, follow, table

from drivelink.output.progress import track


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("control-comparison"), help="folder of the plots")
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' noise")
    parser.add_argument("--law", choices=[*LAWS], action="append", help="only this one; may be repeated")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    args = parser.parse_args()
    pairs = list(itertools.product(args.law or LAWS, KNOWLEDGE))
    with ProcessPoolExecutor(args.jobs) as pool:
        runs = [pool.submit(follow, law, knowledge, seed=args.seed) for law, knowledge in pairs]
        outcomes = [outcome for run in track(runs, "runs") for outcome in run.result()]
    print(table(outcomes))
    for path in draw(outcomes, args.out):
        print(path)


if __name__ == "__main__":
    main()
