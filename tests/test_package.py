"""What is installed: one compiled core of the same version, every file that is read, and locked versions."""

import os
import re
import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import numpy
import pytest
import zenoh
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from zenohkit import free_endpoint, ready, script

import drivelink
import drivelink._core
import estimator._core

ROOT = Path(__file__).parent.parent
TOOL = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]


def test_the_one_core_is_of_the_version_of_the_package():
    assert estimator._core.__version__ == drivelink.__version__ == version("drivelink-vsa")
    assert [module["target"] for module in TOOL["setuptools-rust"]["ext-modules"]] == ["estimator._core"]
    named = {name: one for name, one in vars(drivelink._core).items() if not name.startswith("__")}
    assert named and all(one is getattr(estimator._core, name) for name, one in named.items())


def test_every_data_file_of_the_packages_is_in_the_wheel():
    package_data = TOOL["setuptools"]["package-data"]
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


def test_every_example_is_in_the_wheel():
    shipped = {
        path
        for target, patterns in TOOL["setuptools"]["data-files"].items()
        for pattern in patterns
        for path in ROOT.glob(pattern)
        if target == f"share/drivelink/{path.relative_to(ROOT).parent}"
    }
    tracked = subprocess.run(
        ["git", "ls-files", "examples"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if tracked.returncode:
        pytest.skip("not a git checkout")
    assert {ROOT / name for name in tracked.stdout.split()} == {path for path in shipped if path.is_file()}


_IMPORTS = """
import pydoc, sys
def without(*names): assert not {*names} & {*sys.modules}, {*names} & {*sys.modules}
import drivelink
without("numpy", "scipy", "matplotlib", "zenoh")
import drivelink.cli.record, drivelink.daemon.service  # twice the time to start, and 80 MB
without("scipy", "matplotlib")
import drivelink.cli, drivelink.cli.run, drivelink.cli.fleet
without("dask", "distributed", "fsspec", "pyarrow", "pandas", "botocore", "paramiko")
assert "fit(recordings" in pydoc.plain(pydoc.render_doc(drivelink))
assert {"subscribe", *drivelink.__all__} <= {*dir(drivelink)}
"""


def test_what_is_imported_loads_no_more_than_it_needs_and_help_lists_what_there_is():
    subprocess.run([sys.executable, "-c", _IMPORTS], check=True, cwd=ROOT)


_SUBSCRIBER = """
import sys, drivelink
with drivelink.subscribe("elbow", endpoint=sys.argv[1]) as elbow:
    estimate = elbow.wait(60.0)
    print(estimate.usable, estimate.stiffness_nm_rad, elbow.take().dtype.names[:2])
print({"scipy", "matplotlib", "estimator._core"} & set(sys.modules))
drivelink.fit
"""


def test_the_client_alone_subscribes_with_numpy_and_zenoh_and_nothing_compiled(tmp_path):
    runpy.run_path(str(ROOT / "packaging" / "client.py"))["write"](tmp_path / "client")
    project = tomllib.loads((tmp_path / "client" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert [need.split(">")[0] for need in project["dependencies"]] == ["numpy", "eclipse-zenoh"]
    for package in (numpy, zenoh):  # all that a path has beside the client
        found = Path(str(package.__file__)).parent
        for each in (found, found.with_name(f"{found.name}.libs")):
            if each.exists():
                (tmp_path / each.name).symlink_to(each)
    endpoint = free_endpoint()
    with script("elbow", endpoint) as daemon:
        ready(daemon)
        done = subprocess.run(
            [sys.executable, "-S", "-c", _SUBSCRIBER, endpoint],
            env=os.environ | {"PYTHONPATH": f"{tmp_path / 'client'}:{tmp_path}"},
            cwd=tmp_path, capture_output=True, text=True, check=False,
        )  # fmt: skip
    assert done.stdout == "True 700.0 ('sequence', 'stamp_ns')\nset()\n", done.stderr
    assert done.stderr.splitlines()[-1] == (
        "ImportError: drivelink.fit: expected drivelink-vsa, only its client is installed"
    )


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]
RUN = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]]
CI = [*RUN, *(line for extra in ("test", "lint", "docs", "dbc", "foxglove") for line in EXTRAS[extra])]


def locked(file: str) -> dict[str, list[str]]:
    """The versions of each package; several where they depend on the Python or the machine."""
    text = (ROOT / ".ci" / file).read_text(encoding="utf-8")
    assert "://" not in text  # it names no place
    entries = re.split(r"\n(?=[a-z0-9])", re.sub(r"^[#-].*\n", "", text, flags=re.MULTILINE).strip())
    found: dict[str, list[str]] = {}
    for entry in entries:
        name, version = re.match(r"([a-z0-9._-]+)==([^ ;]+)", entry).groups()  # type: ignore[union-attr]
        assert "--hash=sha256:" in entry, entry[:80]
        found.setdefault(canonicalize_name(name), []).append(version)
    return found


def test_everything_that_is_asked_for_is_locked_once_in_a_version_that_is_asked_for():
    run, further = locked("requirements-run.txt"), locked("requirements.txt")
    assert not run.keys() & further.keys()
    assert "\n-r requirements-run.txt\n" in (ROOT / ".ci" / "requirements.txt").read_text(encoding="utf-8")
    for versions, wanted in ((run, RUN), (run | further, CI)):
        for line in wanted:
            requirement = Requirement(line)
            found = versions.get(canonicalize_name(requirement.name), [])
            assert found and all(requirement.specifier.contains(v) for v in found), f"{line}: run sh .ci/lock"


def test_the_container_installs_the_lock_and_runs_the_demo():
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    assert (
        "--require-hashes -r .ci/requirements-run.txt" in text and "--no-deps --no-build-isolation ." in text
    )
    assert text.rstrip().endswith('ENTRYPOINT ["drivelink"]\nCMD ["demo"]') and "USER nobody" in text


@pytest.mark.slow  # it makes an environment
def test_the_audit_without_a_network_is_one_line():
    offline = os.environ | {"PIP_INDEX_URL": "http://127.0.0.1:9/", "PIP_RETRIES": "0"}
    done = subprocess.run(
        ["sh", ROOT / ".ci/audit"], env=offline, capture_output=True, text=True, check=False
    )
    assert (
        done.returncode == 1
        and done.stderr.startswith("nothing was examined")
        and done.stderr.count("\n") == 1
    )
