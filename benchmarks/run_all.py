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
import re
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
TIMEOUT_S = 7200  # of a section: the longest takes a quarter of an hour on two quiet cores


class Section(NamedTuple):
    """Title; arguments, and those where minutes count; the program, where several sections share one."""

    title: str
    full: str = ""
    quick: str = ""
    of: str = ""


SECTIONS = {
    "cycle": Section("One cycle beside the textbook way and the floor", quick="--seconds 2 --rounds 1"),
    "estimator_tick": Section("The estimator alone", quick="--ticks 8000"),
    "paper_table": Section("The paper's table"),
    "ensembles": Section("The estimator on random joints", quick="--joints 1", of="estimators"),
    "undeclared": Section(
        "Effects that nobody declared, on an independent simulator",
        "--undeclared --seconds 30",
        "--joints 1",
        of="estimators",
    ),
    "diagnosis_seeds": Section(
        "Diagnosis on published seeds", "--seeds 1", "--effects clean,coulomb_friction,backlash"
    ),
    "effect_pairs": Section("Two effects at once", "--pairs --seeds 1", "--seconds 10", of="diagnosis_seeds"),
    "motion": Section("What to move next: designed and random motions", quick="--recordings 1"),
    "loop": Section(
        "The loop that closes itself, on each effect", quick="--effects coulomb_friction,backlash"
    ),
    "healthy": Section("Second recordings of healthy joints", quick="--seeds 2"),
    "real_data": Section("Real data before and after"),
    "external": Section("External torque and contact", quick="--minutes 2 --errors 2 --joints sea"),
    "fault_matrix": Section(
        "Sensor faults: wrong samples called valid", quick="--joints constant --seconds 8"
    ),
    "fault_sizes": Section(
        "Sensor faults: sizes up to which nothing is noticed",
        "--sizes --joints constant,vsa-ii",
        "--joints constant",
        of="fault_matrix",
    ),
    "soak": Section("Ten minutes of random faults in real time", quick="--seconds 60"),
    "fleet_memory": Section("Memory of a recording in a fleet", quick="--seconds 8,16"),
}


def machine() -> dict[str, Any]:
    """What numbers are taken on."""
    names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return {
        "processor": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "python-can", "eclipse-zenoh")},
    }


def run(name: str, quick: bool) -> dict[str, Any]:
    """Run a section; what it printed, its numbers, or why there are none."""
    section = SECTIONS[name]
    program = f"{section.of or name}.py"
    arguments = f"{section.full} {section.quick if quick else ''}".split()
    start = time.monotonic()
    result: dict[str, Any] = {
        "title": section.title,
        "machine": machine(),
        "at": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "load": os.getloadavg()[0],
        "command": " ".join(["python", f"benchmarks/{program}", *arguments]),
    }
    with tempfile.TemporaryDirectory() as folder:
        numbers = Path(folder) / "numbers.json"
        command = ["timeout", str(TIMEOUT_S), sys.executable, HERE / program, *arguments, "--json", numbers]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=folder, env=environment, check=False
        )
        result["took_s"] = round(time.monotonic() - start, 1)
        if done.returncode != 0:
            lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
            return {**result, "skipped": lines[-1]}
        result["text"] = done.stdout.rstrip()
        if numbers.exists():
            result["numbers"] = json.loads(numbers.read_text(encoding="utf-8"))
    return result


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
        lines += [
            f"`{result['command']}`, {result['at']}, {result['took_s']:.0f} s, "
            f"load of the machine before: {result['load']:.1f}.",
            "",
            ", ".join(f"{name} {value}" for name, value in result["machine"].items()) + ".",
            "",
            result["text"] if result["text"].startswith("|") else f"```\n{result['text']}\n```",
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run what is asked for, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    names = list(SECTIONS)
    parser.add_argument("--quick", action="store_true", help="small sizes: minutes instead of hours")
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names)
    )
    parser.add_argument("--out", type=Path, default=HERE, help="where results.md and results.json go")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "results.json"
    before = json.loads(path.read_text(encoding="utf-8"))["sections"] if path.exists() else {}
    sections: dict[str, Any] = {}
    for name in names:
        if name in args.only:
            print(f"{name}: {SECTIONS[name].title} …", flush=True)
            sections[name] = run(name, args.quick)
            print(f"  {sections[name].get('skipped', 'done')}", flush=True)
        elif name in before:
            sections[name] = before[name]
        together = before | sections
        results = {"sections": {name: together[name] for name in names if name in together}}
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
        (args.out / "results.md").write_text(document(results), encoding="utf-8")
    print(f"{args.out / 'results.md'}, {path}")


if __name__ == "__main__":
    main()
