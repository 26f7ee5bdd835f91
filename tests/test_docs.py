"""The documentation says what the code does: generated pages are current, links and examples lead somewhere."""

import argparse
import ast
import dataclasses
import importlib
import importlib.util
import json
import re
import shlex
import tomllib
import typing
from pathlib import Path
from types import ModuleType

import daemonkit
import pytest

from drivelink import cli, jointfile
from drivelink.jointfile.columns import UNITS
from sim.excitation import KINDS
from sim.faults import Faults

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
REFERENCE = DOCS / "reference"
PAGES = sorted(DOCS.rglob("*.md"))
DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "benchmarks" / "README.md",
    ROOT / "benchmarks" / "results.md",
    ROOT / "examples" / "README.md",
    *PAGES,
]
OWN = {"drivelink", "estimator", "sim"}


def program(name: str) -> ModuleType:
    """A program of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def subparsers() -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in cli.make_parser(list(cli.VERBS))._actions if a.dest == "verb")
    return dict(action.choices)  # type: ignore[arg-type]


def test_tables_in_pages_are_those_of_the_code_and_each_is_asked_for():
    made, texts = program("generate"), {page: page.read_text(encoding="utf-8") for page in PAGES}
    asked = [name for text in texts.values() for name in made.ASKED.findall(text)]
    asked += [name for text in texts.values() for _, name, _ in made.MARKED.findall(text)]
    assert sorted(asked) == sorted(made.PARTS)
    for page, text in texts.items():
        assert made.updated(text) == text, f"{page}: python docs/generate.py writes it"


def test_no_cell_of_a_table_from_the_code_is_unexplained_and_every_key_of_a_joint_file_is_in_one():
    parts = {name: part() for name, part in program("generate").PARTS.items()}
    for name, text in parts.items():
        rows = re.findall(r"^\| .* \|$", text, re.MULTILINE)
        assert all(row.count(" | ") == rows[0].count(" | ") for row in rows), name
        assert (rows and all(row.rpartition(" | ")[2] for row in rows)) or name == "commands", name
    keys = keys_of(jointfile.JointFile)
    assert len(keys) > 60
    assert not [key for key in keys if f"| `{key}` |" not in parts["joint file"]]


def keys_of(section: object) -> set[str]:
    """Names of the keys at the ends of a section's tree."""
    parts = typing.get_args(section)
    if parts:  # a union, an array
        return set().union(*map(keys_of, parts))
    if not dataclasses.is_dataclass(section) and not hasattr(section, "model_fields"):
        return set()
    hints = typing.get_type_hints(section)
    names = getattr(section, "model_fields", None) or [field.name for field in dataclasses.fields(section)]  # type: ignore[arg-type]
    return set().union(*(keys_of(hints[name]) or {name} for name in names))


def test_every_verb_explains_each_of_its_arguments():
    verbs = subparsers().items()
    assert not [f"{verb} {action.dest}" for verb, p in verbs for action in p._actions if not action.help]


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_links_and_programs_of_a_page_exist_and_its_code_parses(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`((?:examples|benchmarks|docs|tests|sim|estimator|drivelink)/[\w./*-]+)`", text)
    assert page not in PAGES or not [n for n in named if "*" not in n and not (ROOT / n).exists()]
    links = re.findall(r"\]\(([\w./-]+)(?:#[\w-]*)?\)", text)
    assert not [link for link in links if not (page.parent / link).exists()]
    programs = re.findall(r"\bpython ((?:benchmarks|examples|docs)/[\w/.-]+\.py)", text)
    assert not [program for program in programs if not (ROOT / program).is_file()]
    for language, code in re.findall(r"^```(\w+)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if language == "python":
            for node in ast.walk(ast.parse(code)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OWN:
                    module = importlib.import_module(node.module or "")
                    assert all(hasattr(module, name.name) for name in node.names)
        elif language == "toml":
            tomllib.loads(code)


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_that_a_page_shows_can_be_parsed(page):
    parser = cli.make_parser(list(cli.VERBS))
    text = re.sub(r" \\\n +", " ", page.read_text(encoding="utf-8"))
    for line in re.findall(r"^ {0,4}(?:sudo |\.venv/bin/)?drivelink ([a-z].*)$", text, re.MULTILINE):
        command = shlex.split(re.split(r"\s{2,}|\s[#|&>]|`", line)[0])
        if command[0] in cli.VERBS and not set(line) & set("…["):
            assert parser.parse_args(command).verb == command[0]
    verbs = subparsers()
    for fragment in re.findall(r"`drivelink ([a-z][^`]* --[^`]*)`", text):
        known = verbs[fragment.split()[0]]._option_string_actions
        assert set(re.findall(r"--[\w-]+", fragment)) <= set(known), fragment


@pytest.mark.parametrize(
    ("name", "heading", "known"),
    [
        ("simulated-drives.md", "Faults", {name for name in vars(Faults) if name[0] != "_"}),
        ("recordings.md", "Units", {unit for units in UNITS.values() for unit in units}),
        ("simulation.md", "Excitation", set(KINDS)),
    ],
)
def test_a_reference_page_lists_what_the_code_knows(name, heading, known):
    page = (REFERENCE / name).read_text(encoding="utf-8")
    section = re.split(r"\n##+ ", page.partition(f"# {heading}")[2])[0]
    assert known <= set(re.findall(r"`([\w/-]+)`", section))


def test_the_reference_describes_every_key_of_the_status_document():
    page = (REFERENCE / "wire.md").read_text(encoding="utf-8")
    section = page.partition("## Status document")[2].partition("\n## ")[0]
    first_cells = " ".join(re.findall(r"^\| (`.*?) \|", section, re.MULTILINE))
    with daemonkit.rig() as rig:
        assert set(rig.status) == set(re.findall(r"`(\w+)`", first_cells))


def test_the_benchmarks_page_lists_every_program():
    folder = ROOT / "benchmarks"
    text = (folder / "README.md").read_text(encoding="utf-8")
    programs = {path.stem for path in folder.glob("*.py") if "argparse" in path.read_text(encoding="utf-8")}
    assert programs <= set(re.findall(r"`(\w+)(?:\.py)?`", text)) | {"run_all"}


def test_examples_are_listed_valid_and_their_cases_those_of_the_package():
    listed = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    for path in (ROOT / "examples").iterdir():
        left = path.name == "__pycache__"  # by a test that ran an example
        assert left or path.name == "README.md" or path.name in listed, path.name
        if path.suffix == ".toml":
            assert jointfile.load(path).model().motors
    for path in (ROOT / "drivelink" / "joints").glob("*.toml"):
        assert (ROOT / "examples" / path.name).read_text(encoding="utf-8") == path.read_text(encoding="utf-8")


def test_the_workflow_and_the_hooks_run_programs_that_are_there():
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    assert "- run: .ci/run\n" in workflow and (ROOT / ".ci" / "run").stat().st_mode & 0o100
    hooks = re.findall(r"entry: (.*)", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8").replace("check .", "check")
    assert hooks and all(hook.removesuffix(" --force-exclude") in run for hook in hooks)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_notebook_finds_the_effect_and_its_outputs_are_stored(tmp_path):
    made = program("notebook")
    stored = json.loads(made.NOTEBOOK.read_text(encoding="utf-8"))
    executed, names = made.execute(made.NOTEBOOK, tmp_path)
    (effect,) = names["outcome"].effects
    assert (effect.name, effect.motor) == ("coulomb_friction", 0)
    assert effect.parameters["torque_nm"] == pytest.approx(0.004, rel=0.05)  # as it was switched on
    errors = names["outcome"].validation
    assert errors.after_rms_nm < 0.2 * errors.before_rms_nm
    files = (jointfile.load(names[name]) for name in ("elbow", "better"))
    fitted, better = ([one.name for one in file.motor[0].effect] for file in files)
    assert better == [*fitted, "coulomb_friction"]  # to what the fit wrote, the diagnosis adds one effect
    for cell, fresh in zip(stored["cells"], executed["cells"], strict=True):
        shown = [[sorted(out.get("data", ())) for out in one.get("outputs", ())] for one in (cell, fresh)]
        assert shown[0] == shown[1], "run python docs/notebook.py"
