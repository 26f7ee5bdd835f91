"""The lock files: whole, with hashes, and what pyproject asks for; and the container that is built from them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRAS = PROJECT["project"]["optional-dependencies"]
RUN = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]]
CI = [*RUN, *(line for extra in ("test", "lint", "docs") for line in EXTRAS[extra])]


def locked(file: str) -> dict[str, list[str]]:
    """The versions of each package; several where they depend on the Python or the machine."""
    text = (ROOT / ".ci" / file).read_text(encoding="utf-8")
    entries = re.split(r"\n(?=[a-z0-9])", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).strip())
    found: dict[str, list[str]] = {}
    for entry in entries:
        name, version = re.match(r"([a-z0-9._-]+)==([^ ;]+)", entry).groups()  # type: ignore[union-attr]
        assert "--hash=sha256:" in entry, entry[:80]
        found.setdefault(canonicalize_name(name), []).append(version)
    return found


@pytest.mark.parametrize(("file", "wanted"), [("requirements.txt", CI), ("requirements-run.txt", RUN)])
def test_everything_that_is_asked_for_is_locked_in_a_version_that_is_asked_for(file, wanted):
    versions = locked(file)
    for line in wanted:
        requirement = Requirement(line)
        found = versions.get(canonicalize_name(requirement.name), [])
        assert found and all(requirement.specifier.contains(v) for v in found), f"{line}: run sh .ci/lock"


def test_both_locks_agree_and_name_no_place():
    every, run = locked("requirements.txt"), locked("requirements-run.txt")
    assert {name: every[name] for name in run} == run
    for file in ("requirements.txt", "requirements-run.txt"):
        assert "://" not in (ROOT / ".ci" / file).read_text(encoding="utf-8")


def test_the_container_installs_the_lock_and_runs_the_demo():
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    assert (
        "--require-hashes -r .ci/requirements-run.txt" in text and "--no-deps --no-build-isolation ." in text
    )
    assert text.rstrip().endswith('ENTRYPOINT ["drivelink"]\nCMD ["demo"]') and "USER nobody" in text
