"""The measured machines: diagnosis of EMPS and two axes of a KUKA robot, with their reports.

    python benchmarks/real_data.py [--data DIR] [--out DIR] [--json FILE]

The recordings are not part of the project: DIR (or $DRIVELINK_DATA, or ../shared/data) holds emps/ and
kuka_kr300/ as docs/diagnosis.md describes them.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

from drivelink import jointfile, recording, report
from drivelink.progress import track
from estimator.diagnosis import diagnose

ROOT = Path(__file__).resolve().parents[1]


class Run(NamedTuple):
    """One diagnosis: joint file, training and validation data, bandwidth, what others got there."""

    joint: str
    train: str
    validation: str
    bandwidth_hz: float
    published: str


RUNS = (
    Run("emps", "emps/train.csv", "emps/pulses.csv", 40.0, "4.08 % train, 5.98 % pulses"),
    Run(
        "kuka_axis3",
        "kuka_kr300/axis3_A.csv",
        "kuka_kr300/axis3_B.csv",
        15.0,
        "25 % A, 23 % B with a velocity term of the wrong sign",
    ),
    Run(
        "kuka_axis2",
        "kuka_kr300/axis2_A.csv",
        "kuka_kr300/axis2_B.csv",
        15.0,
        "37 % A, 44 % B with a velocity term of the wrong sign",
    ),
)


def diagnosed(run: Run, data: Path, out: Path) -> dict[str, Any]:
    """Diagnose one machine and write its reports."""
    joint = jointfile.load(ROOT / "examples" / f"{run.joint}.toml")
    train, validation = (recording.read(data / name, joint) for name in (run.train, run.validation))
    outcome = diagnose(train, joint.model(), run.bandwidth_hz, validation)
    folder = out / run.joint
    folder.mkdir(parents=True, exist_ok=True)
    title = report.Title(run.joint, Path(run.train).name, Path(run.validation).name)
    report.write(outcome, title, folder)
    return {"joint": run.joint, "published": run.published, **report.as_json(outcome)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=default, metavar="DIR")
    parser.add_argument("--out", type=Path, default=Path("real_data"), metavar="DIR", help="reports go there")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all outcomes there")
    args = parser.parse_args()
    if not (args.data / RUNS[0].train).exists():
        sys.exit(f"real_data: no measured data in {args.data}: expected emps/ and kuka_kr300/ there")
    outcomes = [diagnosed(run, args.data, args.out) for run in track(RUNS, "diagnose")]
    print("| machine | found | taken out | train | validation | elsewhere |\n|---|---|---|---|---|---|")
    for one in outcomes:
        error = one["error"]
        found = ", ".join(effect["name"] for effect in one["effects"]) or one["verdict"]
        readings = ", ".join(f"{name} {value:.3g}" for name, value in one["alignment"].items()) or "-"
        print(
            f"| {one['joint']} | {found} | {readings} "
            f"| {error['train']['before_relative']:.1%} → {error['train']['after_relative']:.2%} "
            f"| {error['validation']['before_relative']:.1%} → {error['validation']['after_relative']:.2%} "
            f"| {one['published']} |"
        )
    if args.json:
        args.json.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
