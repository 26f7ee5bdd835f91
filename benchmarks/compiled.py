"""Every compiled choice (`estimator/core/src/choices.rs`), halved and doubled: is a figure worse by a fifth?

    python benchmarks/compiled.py [--only NAME,…] [--joints N]

The sources are copied, one number changed, the core compiled, and random joints (`estimators.py --mixed`) run
with it: the share of time without a usable estimate, the share of that which is wrong, and the share of 95 %
intervals that do not hold. A choice above one half is a share: what it leaves to one is changed instead.
`benchmarks/constants.py` does the same for what is interpreted.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import scene

from estimator.choices import ON_LINE

FACTORS = (0.5, 2.0)
FIFTH = 1.2
FIGURES = ("unusable", "wrong", "missed")
LEAST = 0.005  # of the time: what a figure may change by chance
LOAD = """
import importlib.machinery, importlib.util, runpy, sys
_, core, program, *sys.argv[1:] = sys.argv
loader = importlib.machinery.ExtensionFileLoader("estimator._core", core)
spec = importlib.util.spec_from_loader("estimator._core", loader, origin=core)
sys.modules["estimator._core"] = module = importlib.util.module_from_spec(spec)
loader.exec_module(module)
sys.argv[0] = program
sys.path.insert(0, program.rpartition("/")[0])
runpy.run_path(program, run_name="__main__")
"""


def changed(name: str, factor: float) -> tuple[str, float]:
    """The table's text with one entry changed, and its new value."""
    text = (scene.ROOT / "estimator/core/src/choices.rs").read_text(encoding="utf-8")
    line = re.search(rf"(?m)^    {name.upper()}: (\w+) = ([\d.e-]+),", text)
    assert line is not None, name
    value = float(line[2])
    value = 1.0 - (1.0 - value) / factor if 0.5 < value < 1.0 else factor * value
    new = f"{max(round(value), 1)}" if line[1] != "f64" else repr(value)
    return text[: line.start(2)] + new + text[line.end(2) :], float(new)


def build(folder: Path, text: str) -> Path:
    """Compile the core with this table; its extension module."""
    (folder / "estimator/core/src/choices.rs").write_text(text, encoding="utf-8")
    command = ["cargo", "rustc", "-q", "--release", "--locked", "--lib", "--features", "python"]
    command += ["--manifest-path", "drivelink/core/Cargo.toml", "--crate-type", "cdylib"]
    subprocess.run(command, cwd=folder, env=os.environ | {"PYO3_PYTHON": sys.executable}, check=True)
    return next((folder / "target/release").glob("*drivelink_core.so"))


def figures(core: Path, joints: int) -> dict[str, float] | str:
    """What is judged, with this core; or what the change breaks."""
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        program = str(Path(__file__).parent / "estimators.py")
        more = ["--mixed", "--joints", str(joints), "--json", file.name]
        found = subprocess.run(
            [sys.executable, "-c", LOAD, str(core), program, *more],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if found.returncode:
            return found.stderr.strip().splitlines()[-1]
        whole = json.loads(Path(file.name).read_text(encoding="utf-8"))[-1]
    return {"unusable": 1.0 - whole["usable"], "wrong": whole["wrong"], "missed": 1.0 - whole["coverage"]}


def rows(args) -> Iterator[scene.Row]:
    """The figures as they are, and each change that makes one worse by more than a fifth."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("Cargo.toml", "Cargo.lock", "estimator/core", "drivelink/core"):
            source, place = scene.ROOT / part, folder / part
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(source, place) if source.is_dir() else shutil.copy(source, place)
        usual = figures(build(folder, (folder / "estimator/core/src/choices.rs").read_text()), args.joints)
        if isinstance(usual, str):
            raise SystemExit(usual)
        names = args.only or list(ON_LINE)
        yield {
            "choice": "as it is",
            "value": None,
            "tried": len(names) * len(FACTORS),
            "worse": None,
            **usual,
        }
        for name in names:
            for factor in FACTORS:
                text, value = changed(name, factor)
                found = figures(build(folder, text), args.joints)
                row = {"choice": name, "value": value}
                if isinstance(found, str):
                    yield row | dict.fromkeys(FIGURES) | {"worse": found}
                elif worse := [key for key in FIGURES if found[key] > FIFTH * usual[key] + LEAST]:
                    yield row | found | {"worse": ", ".join(worse)}
                else:
                    print(f"{name} {value:g}: {found}", file=sys.stderr)


COLUMNS = {
    "choice": "{choice}",
    "value": "{value:g}",
    "not usable": "{unusable:.1%}",
    "wrong of usable": "{wrong:.2%}",
    "not held": "{missed:.1%}",
    "worse by more than a fifth": "{worse}",
}

if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        COLUMNS,
        scene.Option("--only", [], "of choices; all if left out"),
        scene.Option("--joints", 40, "random ones"),
        after=lambda found: (
            f"{len(found) - 1} of {found[0]['tried']} changes make a figure worse by more than a fifth."
        ),
    )
