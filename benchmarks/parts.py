"""Whether a stiffness's interval holds: disjoint parts of one recording must agree within what is said.

    python benchmarks/parts.py [--data DIR] [--shaft-line DIR] [--machines NAME ...] [--json FILE]

Each recording is cut into parts, each is diagnosed by itself, and chi-squared per degree of freedom of the
stiffnesses is formed with the standard deviations that `diagnose` states: 1 where they are right, more where
they promise too much. Measured machines as in real_data.py (which says what DIR must hold), and simulated
joints with physics that nobody declared.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from diagnosis_seeds import joint_of as simulated_joint
from diagnosis_seeds import measured
from real_data import ROOT, RUNS, SHAFT_RUNS, Run, joint_of, shaft_record
from rich.console import Console
from rich.progress import track

from drivelink import recording
from estimator.diagnosis import diagnose
from estimator.errors import EstimatorError
from estimator.model import JointModel
from estimator.sample import Record

SIMULATED = ("clean", "coulomb_friction", "presliding_friction", "cogging", "hysteresis", "gravity")
SEED = 700  # of the simulated joints, and one more each
SECONDS = 20.0
SIMULATED_HZ = 20.0
LEAST_S = 4.0  # of a part: a second more than `diagnose` asks for
MOST_PARTS = 9


class Machine(NamedTuple):
    """One recording to cut: of what machine, its own name, joint, bandwidth, stiffness that is known."""

    machine: str
    name: str
    record: Record
    model: JointModel
    bandwidth_hz: float
    known_nm_rad: float


def machines(data: Path, shaft_line: Path | None, only: list[str]) -> Iterator[Machine]:
    """The measured and the simulated recordings, of the machines asked for."""
    runs = {(run.joint, run.train): run for run in (*RUNS, *(SHAFT_RUNS if shaft_line else ()))}
    for run in runs.values():
        if run.known_nm_rad is not None and (not only or run.joint in only):
            joint = joint_of(run)
            yield Machine(
                run.joint, Path(run.train).stem, _record(run, data, shaft_line), joint.model(),
                run.bandwidth_hz, run.known_nm_rad,
            )  # fmt: skip
    if only and "simulated" not in only:
        return
    for k, name in enumerate(SIMULATED):
        declared, real = simulated_joint(() if name == "clean" else (name,), SEED + k)
        known = real.motor[0].transmission.parameters["k_nm_rad"]
        assert isinstance(known, float)
        model = replace(declared.model(), link=None)  # as most machines are: the link's side is not known
        yield Machine("simulated", name, measured(real, SECONDS), model, SIMULATED_HZ, known)


def _record(run: Run, data: Path, shaft_line: Path | None) -> Record:
    if run.joint == "shaft_line":
        assert shaft_line is not None
        return shaft_record(shaft_line, run.train)
    return recording.read(data / run.train, joint_of(run))


def parts_of(record: Record) -> list[Record]:
    """Disjoint parts of one length, long enough to be diagnosed."""
    count = int(np.clip(len(record) * record.period_s / LEAST_S, 1, MOST_PARTS))
    edges = np.linspace(0, len(record), count + 1).astype(int)
    return [_rows(record, slice(a, b)) for a, b in pairwise(edges)]


def _rows(record: Record, rows: slice) -> Record:
    def cut(x: Any) -> Any:
        return None if x is None else x[rows]

    return replace(
        record,
        sequence=record.sequence[rows],
        motor_position_rad=record.motor_position_rad[rows],
        motor_torque_nm=record.motor_torque_nm[rows],
        motor_velocity_rad_s=cut(record.motor_velocity_rad_s),
        link_position_rad=cut(record.link_position_rad),
        link_velocity_rad_s=cut(record.link_velocity_rad_s),
        external_torque_nm=cut(record.external_torque_nm),
    )


def stiffness_of(part: Record, one: Machine) -> dict[str, Any]:
    """What a diagnosis says of one part: stiffness and standard deviation, where it reports them."""
    try:
        outcome = diagnose(part, one.model, one.bandwidth_hz)
    except EstimatorError as error:
        return {"verdict": str(error), "effects": [], "k": None, "std": None}
    transmission = outcome.transmissions[0]
    return {
        "verdict": outcome.verdict,
        "effects": [finding.name for finding in outcome.effects],
        "k": transmission.parameters.get("k_nm_rad"),
        "std": transmission.std.get("k_nm_rad"),
    }


def agreement(parts: list[dict[str, Any]]) -> tuple[float, int]:
    """(chi-squared about the weighted mean, degrees of freedom) of the parts whose stiffness is reported."""
    reported = [(p["k"], p["std"]) for p in parts if p["k"] is not None]
    if len(reported) < 2:
        return 0.0, 0
    k, std = np.array(reported).T
    mean = np.sum(k / std**2) / np.sum(1.0 / std**2)
    return float(np.sum(((k - mean) / std) ** 2)), len(reported) - 1


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = Path(os.environ.get("DRIVELINK_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=default, metavar="DIR")
    parser.add_argument("--shaft-line", type=Path, metavar="DIR", help="recordings of the shaft line")
    parser.add_argument(
        "--machines", nargs="*", default=[], metavar="NAME", help='"simulated" is one of them'
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every part there")
    args = parser.parse_args()
    outcomes: list[dict[str, Any]] = []
    print("| recording | parts reported | std, median | chi²/dof, parts | of the machine | against known |")
    print("|---|---|---|---|---|---|")
    for one in track(
        list(machines(args.data, args.shaft_line, args.machines)), "recordings", console=Console(stderr=True)
    ):
        parts = [stiffness_of(part, one) for part in parts_of(one.record)]
        outcomes.append({**one._asdict(), "record": None, "model": None, "parts": parts})
        reported = [p for p in parts if p["k"] is not None]
        square, freedom = agreement(parts)
        alike = [p for o in outcomes if o["machine"] == one.machine for p in o["parts"]]
        total, degrees = agreement(alike) if one.machine != "simulated" else (square, freedom)
        far = [((p["k"] - one.known_nm_rad) / p["std"]) ** 2 for p in reported]
        print(
            f"| {one.machine} {one.name} | {len(reported)} of {len(parts)} "
            f"| {np.median([p['std'] / p['k'] for p in reported] or [np.nan]):.1%} "
            f"| {_ratio(square, freedom)} "
            f"| {_ratio(total, degrees)} | {np.mean(far or [np.nan]):.2f} |",
            flush=True,
        )
    for kind, chosen in (
        ("measured", [o for o in outcomes if o["machine"] != "simulated"]),
        ("simulated", [o for o in outcomes if o["machine"] == "simulated"]),
    ):
        pairs = [agreement(o["parts"]) for o in chosen]
        print(f"{kind}: {_ratio(sum(s for s, _ in pairs), sum(n for _, n in pairs))}")
    if args.json:
        args.json.write_text(json.dumps(outcomes, indent=2) + "\n", encoding="utf-8")


def _ratio(square: float, freedom: int) -> str:
    return f"{square / freedom:.2f} ({freedom})" if freedom else "-"


if __name__ == "__main__":
    main()
