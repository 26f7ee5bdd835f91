"""Every claim of speed and accuracy in one command: writes results.md beside this file.

    python benchmarks/run_all.py [--quick] [--only NAME ...] [--out FILE]

Each section is a program of its own that can be run alone (README.md says what it measures). With `--only`,
the other sections of an earlier run are kept, each with the time and the load of the machine it was run at.
A section whose data or tool is not there is left out, and the results say so.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
HEAD = (
    "# Results\n\nWritten by `python benchmarks/run_all.py`; [README.md](README.md) says what each measures."
)
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
    "ensembles": Section("The estimator on random joints", "--joints 32", "--joints 1", of="estimators"),
    "long": Section("A minute of random joints", "--seconds 60", "--joints 1", of="estimators"),
    "undeclared": Section(
        "Effects that nobody declared, on an independent simulator",
        "--undeclared --seconds 30",
        "--joints 1",
        of="estimators",
    ),
    "mixed": Section(
        "Random joints, effects and motions", "--mixed --joints 120", "--joints 5", of="estimators"
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
    "external": Section(
        "External torque and contact", "--minutes 10 --errors 0,2,5", "--minutes 2 --errors 2 --joints sea"
    ),
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


def machine() -> str:
    """What numbers are taken on."""
    names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    libraries = (f"{name} {version(name)}" for name in ("numpy", "python-can", "eclipse-zenoh"))
    processor = f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"
    system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
    return f"{processor}, {system}, {', '.join(libraries)}."


def run(name: str, quick: bool) -> str:
    """Run a section; its Markdown below the title, or why there is none."""
    section, load = SECTIONS[name], os.getloadavg()[0]
    program = f"{section.of or name}.py"
    arguments = f"{section.full} {section.quick if quick else ''}".split()
    start, at = time.monotonic(), time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    with tempfile.TemporaryDirectory() as folder:
        command = ["timeout", str(TIMEOUT_S), sys.executable, HERE / program, *arguments]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=folder, env=environment, check=False
        )
    if done.returncode != 0:
        lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        return f"Left out: `{name}`: {lines[-1]}"
    shown, took_s = " ".join(["python", f"benchmarks/{program}", *arguments]), time.monotonic() - start
    text = done.stdout.rstrip()
    return (
        f"`{shown}`, {at}, {took_s:.0f} s, load of the machine before: {load:.1f}.\n\n{machine()}\n\n"
        f"{text if text.startswith('|') else f'```{chr(10)}{text}{chr(10)}```'}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    names = list(SECTIONS)
    parser.add_argument("--quick", action="store_true", help="small sizes: minutes instead of hours")
    parser.add_argument(
        "--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names)
    )
    parser.add_argument("--out", type=Path, default=HERE / "results.md", metavar="FILE")
    args = parser.parse_args()
    before = args.out.read_text(encoding="utf-8") if args.out.exists() else ""
    made = {}
    for part in before.split("\n## ")[1:]:
        title, _, text = part.partition("\n")
        made[title] = text.strip()
    for name in args.only:
        title = SECTIONS[name].title
        print(f"{name}: {title} …", flush=True)
        made[title] = run(name, args.quick)
        known = [section.title for section in SECTIONS.values() if section.title in made]
        parts = [HEAD, *(f"## {title}\n\n{made[title]}" for title in known)]
        args.out.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    print(args.out)


if __name__ == "__main__":
    main()
