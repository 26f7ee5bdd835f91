"""What is installed: one compiled core of the same version, and every file that the package reads."""

from __future__ import annotations

import tomllib
from importlib.metadata import version
from pathlib import Path

import drivelink
import drivelink._core
import estimator._core

ROOT = Path(__file__).parent.parent


def test_the_one_core_is_of_the_version_of_the_package() -> None:
    assert estimator._core.__version__ == drivelink.__version__ == version("drivelink-vsa")
    configured = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools-rust"
    ]
    assert [module["target"] for module in configured["ext-modules"]] == ["estimator._core"]
    named = vars(drivelink._core)
    assert all(named[name] is getattr(estimator._core, name) for name in drivelink._core.__all__)


def test_every_data_file_of_the_packages_is_in_the_wheel() -> None:
    package_data = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"][
        "package-data"
    ]
    packed = {
        path
        for package in ("drivelink", "estimator", "sim")
        for where in [ROOT / package, *(p.parent for p in (ROOT / package).rglob("__init__.py"))]
        for pattern in [*package_data["*"], *(package_data.get(package, []) if where.name == package else [])]
        for path in where.glob(pattern)
    }
    sources = {".py", ".rs", ".so", ".pyc"}
    data = {
        path
        for package in ("drivelink", "estimator", "sim")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in sources and "core" not in path.relative_to(ROOT).parts
    }
    assert data <= packed
