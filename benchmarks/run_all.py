"""Every claim of speed and accuracy in one command: writes results.md and results.json beside this file.

    python benchmarks/run_all.py [--quick] [--only NAME ...] [--out DIR]

Each section is a program of its own that can be run alone (README.md says what it measures). With `--only`,
the other sections of an earlier run are kept, each with the time and the load of the machine it was run at.
A section whose data or tool is not there is left out, and the results say so.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import can
import numpy as np

HERE = Path(__file__).parent
TIMEOUT_S = 7200  # of a section: the longest takes a quarter of an hour on two quiet cores


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One program.

    Attributes:
        name: its file, without the ending.
        of: the file, where several sections share one.
        title: over its results.
        full: its arguments.
        quick: its arguments where minutes count.
        json_file: it takes `--json FILE`; else `--json` prints instead of the table.
        markdown: what it prints is Markdown; else it is shown as it is.
    """

    name: str
    title: str
    full: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    json_file: bool = False
    markdown: bool = True
    of: str = ""


SECTIONS = (
    Section(
        name="cycle",
        title="One cycle beside the textbook way and the floor",
        quick=("--seconds", "2", "--rounds", "2"),
        json_file=True,
    ),
    Section(
        name="stages", title="Stages, and joints on one core", quick=("--cycles", "2000"), json_file=True
    ),
    Section(
        name="service",
        title="Jitter, recorder, start, memory",
        quick=("--seconds", "2", "--rounds", "1"),
        json_file=True,
    ),
    Section(name="endurance", title="Missed cycles by cause", quick=("--seconds", "10"), json_file=True),
    Section(
        name="growth",
        title="Cost against size",
        quick=("--seconds", "5,10", "--diagnose-seconds", "10"),
        json_file=True,
    ),
    Section(
        name="latency",
        title="Publisher to subscriber, beside bare zenoh",
        quick=("--cycles", "4000"),
        markdown=False,
    ),
    Section(
        name="joints",
        title="Many joints through one router",
        full=("--joints", "1,6,12,24"),
        quick=("--joints", "1,6", "--seconds", "3"),
        markdown=False,
    ),
    Section(
        name="estimator_tick",
        title="The estimator alone",
        quick=("--ticks", "8000"),
        markdown=False,
    ),
    Section(
        name="compiled",
        title="The compiled core beside the last interpreted commit",
        quick=("--seconds", "5", "--rounds", "1"),
        json_file=True,
    ),
    Section(name="paper_table", title="The paper's table", markdown=False),
    Section(name="sensitivity", title="Sensitivity", markdown=False),
    Section(
        name="ensembles",
        title="The estimator on random joints",
        quick=("--joints", "1"),
    ),
    Section(
        name="intervals",
        title="The 95 % intervals over a minute",
        quick=("--seconds", "20"),
        markdown=False,
    ),
    Section(
        name="diagnosis_seeds",
        title="Diagnosis on published seeds",
        full=("--seeds", "1"),
        quick=("--seeds", "1", "--effects", "clean", "coulomb_friction", "backlash"),
        markdown=False,
        json_file=True,
    ),
    Section(
        name="effect_pairs",
        title="Two effects at once",
        quick=("--seconds", "10"),
    ),
    Section(name="real_data", title="Real data before and after", markdown=False, json_file=True),
    Section(name="control", title="Control with the estimates", markdown=False, json_file=True),
    Section(
        name="parts",
        title="Disjoint parts of one recording",
        quick=("--machines", "emps"),
    ),
    Section(
        name="gate",
        title="Wrong units, signs, gears and time",
        full=("--seeds", "2"),
        quick=("--seeds", "1", "--kinds", "serial"),
    ),
    Section(
        name="constants", title="Choice constants halved and doubled", full=("--report",), quick=("--report",)
    ),
    Section(
        name="external",
        title="External torque and contact",
        quick=("--minutes", "2", "--errors", "2", "--joints", "sea"),
    ),
    Section(
        name="fault_matrix",
        title="Sensor faults: wrong samples called valid",
        quick=("--joints", "constant", "--seconds", "8"),
    ),
    Section(
        name="fault_sizes",
        of="fault_matrix",
        title="Sensor faults: sizes up to which nothing is noticed",
        full=("--sizes", "--joints", "constant,vsa-ii"),
        quick=("--sizes", "--joints", "constant"),
    ),
    Section(
        name="queries",
        title="A flood of queries",
        quick=("--seconds", "2", "--rounds", "1"),
    ),
    Section(
        name="kill_recorder",
        title="Recorders killed at random",
        quick=("--kills", "5"),
        markdown=False,
    ),
    Section(
        name="soak",
        title="Ten minutes of random faults in real time",
        quick=("--seconds", "60"),
        markdown=False,
    ),
    Section(
        name="fleet_throughput",
        title="A fleet: two workers beside one",
        of="fleet",
        full=("throughput", "--nights", "2", "--recordings", "12", "--rounds", "2"),
        quick=("throughput", "--nights", "2", "--recordings", "4"),
        markdown=False,
    ),
    Section(
        name="fleet_cpu",
        title="A fleet: CPU of a recording beside fit and diagnose alone",
        of="fleet",
        full=("cpu", "--nights", "2", "--recordings", "8"),
        quick=("cpu", "--nights", "2", "--recordings", "2"),
        markdown=False,
    ),
    Section(
        name="fleet_table",
        title="A fleet: 10 000 rows appended and reported",
        of="fleet",
        full=("table",),
        quick=("table", "--rows", "1000"),
        markdown=False,
    ),
    Section(
        name="fleet_statistics",
        title="A fleet: false discoveries and power of the tests",
        of="fleet",
        full=("statistics", "--fleets", "120"),
        quick=("statistics", "--fleets", "10"),
        markdown=False,
    ),
    Section(
        name="fleet_changes",
        title="A fleet: 40 joints, 25 nights, one of two workers killed half-way",
        of="fleet",
        full=("changes", "--seconds", "5"),
        quick=("changes", "--seconds", "5", "--joints", "8", "--nights", "8"),
        markdown=False,
    ),
    Section(
        name="fleet_storage",
        title="A fleet: local files, SFTP and S3",
        markdown=False,
    ),
)


def machine() -> dict[str, Any]:
    """What numbers are taken on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.partition(":")[2].strip()
            for line in cpuinfo.read_text().splitlines()
            if "model name" in line
        ]
        model = names[0] if names else model
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "python-can": can.__version__,
        "zenoh": version("eclipse-zenoh"),
    }


def run(section: Section, quick: bool) -> dict[str, Any]:
    """Run a section; what it printed, its numbers, or why there are none."""
    path = HERE / f"{section.of or section.name}.py"
    result: dict[str, Any] = {
        "title": section.title,
        "markdown": section.markdown,
        "machine": machine(),
        "at": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "load": os.getloadavg()[0],
    }
    if not path.exists():
        return {**result, "skipped": f"{path.name} is not there"}
    arguments = list(section.quick if quick else section.full)
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        numbers = Path(folder) / "numbers.json"
        extra = ["--json", str(numbers)] if section.json_file else []
        done = execute([sys.executable, str(path), *arguments, *extra], folder)
        result["command"] = " ".join(["python", f"benchmarks/{path.name}", *arguments])
        result["took_s"] = round(time.monotonic() - start, 1)
        if done.returncode != 0:
            lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
            return {**result, "skipped": lines[-1]}
        result["text"] = done.stdout.rstrip()
        if numbers.exists():
            result["numbers"] = json.loads(numbers.read_text(encoding="utf-8"))
    return result


def execute(command: list[str], folder: str) -> subprocess.CompletedProcess[str]:
    """Run a program, in a folder it may write to."""
    environment = {**os.environ, "COLUMNS": "150", "OPENBLAS_NUM_THREADS": "1"}
    try:
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            cwd=folder,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"not done after {TIMEOUT_S} s")


def document(results: dict[str, Any]) -> str:
    """The results in Markdown."""
    lines = [
        "# Results",
        "",
        "Written by `python benchmarks/run_all.py`; [README.md](README.md) says what each measures.",
    ]
    for name, result in results["sections"].items():
        lines += ["", f"## {result['title']}", ""]
        if "skipped" in result:
            lines.append(f"Left out: `{name}`: {result['skipped']}")
            continue
        lines.append(
            f"`{result['command']}`, {result['at']}, {result['took_s']:.0f} s, "
            f"load of the machine before: {result['load']:.1f}."
        )
        if "machine" in result:
            lines += ["", ", ".join(f"{name} {value}" for name, value in result["machine"].items()) + "."]
        text = result["text"]
        lines += ["", text if result["markdown"] else f"```\n{text}\n```"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is asked for, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    names = [section.name for section in SECTIONS]
    parser.add_argument("--quick", action="store_true", help="small sizes: minutes instead of hours")
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names)
    )
    parser.add_argument("--out", type=Path, default=HERE, help="where results.md and results.json go")
    args = parser.parse_args()
    path = args.out / "results.json"
    before = json.loads(path.read_text(encoding="utf-8"))["sections"] if path.exists() else {}
    sections: dict[str, Any] = {}
    for section in SECTIONS:
        if section.name in args.only:
            print(f"{section.name}: {section.title} …", flush=True)
            sections[section.name] = run(section, args.quick)
            print(f"  {sections[section.name].get('skipped', 'done')}", flush=True)
        elif section.name in before:
            sections[section.name] = before[section.name]
        together = before | sections
        results = {"sections": {name: together[name] for name in names if name in together}}
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        (args.out / "results.md").write_text(document(results), encoding="utf-8")
    print(f"{args.out / 'results.md'}, {path}")


if __name__ == "__main__":
    main()
