"""The arrows of docs/architecture.md, held."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import literals
import pytest

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "benchmarks"))
from protections import PROTECTIONS  # noqa: E402

STANDARD = set(sys.stdlib_module_names) | {"__future__"}
ALLOWED = {
    "estimator": STANDARD | {"numpy", "scipy", "estimator"},
    "sim": STANDARD | {"numpy", "scipy", "can", "canopen", "sim"},
}
CLOCKS_AND_IO = {
    "time", "datetime", "socket", "os", "io", "pathlib", "threading", "subprocess", "asyncio", "random",
}  # fmt: skip


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    return [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]


@cache
def imports(path: Path) -> set[str]:
    """Top-level names of the packages that a module imports, wherever in the file."""
    found: set[str] = set()
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add((node.module or "").split(".")[0])
    return found


def modules(package: str) -> list[Path]:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"no module found in {package}"
    return files


@pytest.mark.parametrize("package", ["estimator", "sim"])
def test_the_package_imports_nothing_beyond_what_it_may(package):
    for path in modules(package):
        assert imports(path) <= ALLOWED[package], f"{path.relative_to(ROOT)}"
        if package == "estimator":  # reads no clock and touches no file or socket
            assert not imports(path) & CLOCKS_AND_IO, f"{path.relative_to(ROOT)}"
            calls = (node.func for node in nodes_of(path) if isinstance(node, ast.Call))
            names = {func.id for func in calls if isinstance(func, ast.Name)}
            assert not names & {"open", "print", "input"}, f"{path.relative_to(ROOT)}"
            slow = r"^(from|import) scipy\.(signal|stats)\b"  # each takes as long to load as all the rest
            assert not re.search(slow, path.read_text(encoding="utf-8"), re.MULTILINE), (
                f"{path.relative_to(ROOT)}"
            )


def test_every_number_that_the_estimator_chooses_is_in_a_table():
    assert [one.label for one in literals.constants(ROOT / "estimator") if one.key is None] == []


def test_every_number_inside_the_estimators_functions_has_a_reason_in_both_languages():
    assert list(literals.unexplained(ROOT / "estimator")) == []
    assert list(literals.untabled(ROOT / "estimator" / "core" / "src")) == []


def test_only_the_fleet_imports_what_its_extra_brings():
    extra = {"dask", "distributed", "fsspec", "pyarrow"}
    for path in modules("drivelink"):
        if path.parent.name != "fleet":
            assert not imports(path) & extra, f"{path.relative_to(ROOT)}"
            if path.name != "fleet.py":  # the verb
                text = path.read_text(encoding="utf-8")
                assert "drivelink.fleet" not in text, f"{path.relative_to(ROOT)}"


def test_the_service_reaches_the_simulated_world_in_one_place_only():
    for path in modules("drivelink"):
        if path.parent.name != "demo":
            assert "sim" not in imports(path), f"{path.relative_to(ROOT)}"


def _modules_imported(path: Path) -> set[str]:
    """Full names of the modules that a module imports at run time, wherever in the file."""
    typing_only = {
        id(inner)
        for node in nodes_of(path)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    found: set[str] = set()
    for node in nodes_of(path):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def _circles(needs: dict[str, set[str]]) -> set[str]:
    """What is in a circle, or above one."""
    left = dict(needs)
    while free := [name for name, needed in left.items() if not (needed - {name}) & left.keys()]:
        for name in free:
            del left[name]
    return set(left)


def test_no_circle_of_imports_between_modules_or_folders():
    names = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for package in ("drivelink", "estimator", "sim")
        for path in modules(package)
    }
    needs = {name: _modules_imported(path) & names.keys() for name, path in names.items()}
    assert _circles(needs) == set()
    folders: dict[str, set[str]] = {}
    for name, needed in needs.items():
        inside = {".".join(other.split(".")[:2]) for other in needed if other.count(".")}
        folders.setdefault(".".join(name.split(".")[:2]), set()).update(inside)
    assert _circles(folders) == set()


def _rust_needs(root: Path) -> dict[str, set[str]]:
    """By module of a crate, its tests aside: the modules that it names; a folder counts as one."""
    files = {path: (*path.relative_to(root).with_suffix("").parts,) for path in root.rglob("*.rs")}
    tops = {parts[0] for parts in files.values()}
    needs: dict[str, set[str]] = {top: set() for top in tops}
    for path, parts in files.items():
        text = re.sub(r"//.*", "", path.read_text(encoding="utf-8").split("#[cfg(test)]")[0])
        for group, single in re.findall(r"\bcrate::(?:\{([^}]*)\}|(\w+))", text):
            named = re.findall(r"(?:^|,)\s*(\w+)", group) if group else [single]
            needs[parts[0]] |= set(named) & tops
        if len(parts) == 1:
            needs[parts[0]] |= set(re.findall(r"\bsuper::(\w+)", text)) & tops
    return needs


@pytest.mark.parametrize("crate", ["drivelink", "estimator"])
def test_no_circle_between_modules_in_rust(crate):
    needs = _rust_needs(ROOT / crate / "core" / "src")
    assert "lib" in needs
    assert _circles(needs) == set()


@pytest.mark.parametrize("protection", PROTECTIONS, ids=lambda one: one.name)
def test_every_protection_is_where_the_benchmark_takes_it_away(protection):
    text = (ROOT / "drivelink" / protection.file).read_text(encoding="utf-8")
    assert text.count(protection.before) == 1
