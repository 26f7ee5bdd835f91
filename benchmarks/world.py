"""Joints of `world.c`, the independent simulator: compile it, run it, read what it writes."""

import functools
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scene import joints

from estimator import Record

T = 1e-3


class World(NamedTuple):
    """A recording of `world.c`, the truth at each of its rows, and all of its columns."""

    record: Record
    stiffness_nm_rad: np.ndarray
    columns: dict[str, np.ndarray]


@functools.cache
def program() -> tuple[Path, tempfile.TemporaryDirectory]:
    """Compile `world.c`; the folder lives as long as this process."""
    folder = tempfile.TemporaryDirectory(prefix="world")
    path = Path(folder.name) / "world"
    source = Path(__file__).with_name("world.c")
    subprocess.run(
        ["cc", "-O2", "-std=c11", "-Wall", "-Wextra", "-Werror", "-o", path, source, "-lm"], check=True
    )
    return path, folder


def simulate(played: str | None = None, **settings: float | str) -> World:
    """Run a joint with these settings (`world help` lists them); `played`: positions and velocities."""
    arguments = [f"{name}={value}" for name, value in settings.items()]
    command = [program()[0], *arguments]
    done = subprocess.run(command, input=played, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"world.c: {done.stderr.strip()}")
    names, *lines = done.stdout.splitlines()
    table = np.array([line.split(",") for line in lines], dtype=float).T
    column = dict(zip(names.split(","), table, strict=True))
    record = joints.of_world(column, period_s=float(settings.get("period", T)))
    return World(record, column["true_stiffness_nm_rad"], column)
