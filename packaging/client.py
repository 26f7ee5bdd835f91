"""Write the sources of `drivelink-vsa-client`: what `drivelink.subscribe` imports, and no more.

    .venv/bin/python packaging/client.py build/client && .venv/bin/pip wheel --no-deps -w dist build/client

The modules are those that the import loads, as they are. The layouts of the messages, which the compiled
core defines, are written as a module `drivelink/_core.py`: the wheel runs on every processor, and needs numpy
and zenoh only.
"""

import subprocess
import sys
import tomllib
from pathlib import Path
from pprint import pformat

ROOT = Path(__file__).parent.parent
_OURS = ("drivelink", "estimator")
_NEEDS = ("numpy", "eclipse-zenoh")
_LOADED = f"""
import sys
from drivelink import State, joints, subscribe, subscribe_async
print(*(name for name in sys.modules if name.split(".")[0] in {_OURS}))
"""


def sources() -> dict[str, str]:
    """Return the text of each file by its path in the package."""
    command = [sys.executable, "-c", _LOADED]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    files = {f"{package}/py.typed": "" for package in _OURS}
    for name in done.stdout.split():
        path = ROOT / name.replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        if not path.stem.startswith("_core"):
            files[str(path.relative_to(ROOT))] = path.read_text(encoding="utf-8")
    from drivelink._core import MESSAGES

    head = '"""Layouts of the messages, from the compiled core."""\n\n'
    files["drivelink/_core.py"] = f"{head}MESSAGES = {pformat(MESSAGES, sort_dicts=False)}\n"
    return files


def project() -> str:
    """Return pyproject.toml: the whole project's facts, the client's name and dependencies."""
    whole = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needs = [each for each in whole["dependencies"] if each.startswith(_NEEDS)]
    facts = {
        "name": whole["name"] + "-client",
        "version": whole["version"],
        "description": "Subscriber of drivelink: stiffness and torque of a joint, every cycle, over zenoh",
        "requires-python": whole["requires-python"],
        "license": whole["license"],
        "dependencies": needs,
    }
    lines = [f"{key} = {value!r}" for key, value in facts.items()]
    return "\n".join(
        [
            "[build-system]", 'requires = ["setuptools>=77"]', 'build-backend = "setuptools.build_meta"',
            "[project]", *lines,
            "[tool.setuptools.packages.find]", 'include = ["drivelink*", "estimator*"]',
            "[tool.setuptools.package-data]", '"*" = ["py.typed"]', "",
        ]
    )  # fmt: skip


def write(folder: Path) -> None:
    """Write the sources into a folder."""
    for name, text in {**sources(), "pyproject.toml": project()}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
