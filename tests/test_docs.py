"""The documentation says what the code does: generated pages are current, links and examples lead somewhere."""

from __future__ import annotations

import argparse
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from drivelink import cli, jointfile

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
REFERENCE = DOCS / "reference"
PAGES = sorted(DOCS.rglob("*.md"))


def generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def subparsers() -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in cli.make_parser(list(cli.VERBS))._actions if a.dest == "verb")
    return dict(action.choices)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["joint-file.md", "wire.md", "simulation.md"])
def test_the_generated_reference_is_current(name: str) -> None:
    page = (REFERENCE / name).read_text(encoding="utf-8")
    assert page == generator().PAGES[name](), "run python docs/generate.py"


@pytest.mark.parametrize("package", ["drivelink", "estimator", "sim"])
def test_the_architecture_names_every_part_of_a_package_in_its_place(package: str) -> None:
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    section = page.partition(f"## Inside `{package}/`")[2].partition("\n## ")[0]
    named = set(re.findall(r"`(\w+(?:/|\.py))`", section))
    parts = {f"{path.parent.name}/" for path in (ROOT / package).glob("*/__init__.py")}
    assert parts <= named
    missing = [name for name in named if not (ROOT / package / name).exists()]
    assert not missing, f"not in {package}/"


def test_every_verb_explains_each_of_its_arguments() -> None:
    silent = [
        f"{verb} {action.dest}"
        for verb, p in subparsers().items()
        for action in p._actions
        if not action.help
    ]
    assert not silent


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_files_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`((?:examples|benchmarks|docs|tests|sim|estimator|drivelink)/[\w./*-]+)`", text)
    missing = [name for name in named if "*" not in name and not (ROOT / name).exists()]
    assert not missing


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_and_pictures_that_a_page_links_to_exist(page: Path) -> None:
    links = re.findall(r"\]\(([\w./-]+)(?:#[\w-]*)?\)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(DOCS)))
def test_commands_that_a_page_shows_can_be_parsed(page: Path) -> None:
    parser = cli.make_parser(list(cli.VERBS))
    for line in re.findall(
        r"^ {0,4}\$? ?drivelink ([a-z].*)$", page.read_text(encoding="utf-8"), re.MULTILINE
    ):
        command = re.split(r"\s{2,}|\s[#|&]|`", line)[0].split()
        if command[0] not in cli.VERBS or set(line) & set("…["):
            continue
        assert parser.parse_args(command).verb == command[0]


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.toml")), ids=lambda path: path.name)
def test_example_joint_files_are_valid(path: Path) -> None:
    assert jointfile.load(path).model().motors


@pytest.mark.parametrize("path", sorted((ROOT / "drivelink" / "joints").glob("*.toml")), ids=lambda p: p.name)
def test_the_cases_among_the_examples_are_those_of_the_package(path: Path) -> None:
    assert (ROOT / "examples" / path.name).read_text(encoding="utf-8") == path.read_text(encoding="utf-8")


def test_every_example_is_listed() -> None:
    listed = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    for path in (ROOT / "examples").iterdir():
        assert path.name == "README.md" or path.name in listed, path.name
