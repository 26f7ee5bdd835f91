"""Reads, validates and rewrites joint files. An error is one line: file, key, what was expected."""

import dataclasses
import hashlib
import json
import logging
import re
import tomllib
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import BaseModel, ValidationError
from tomlkit.container import Container

from drivelink.errors import JointFileError, raised_as
from drivelink.files import read_regular, write_whole
from drivelink.jointfile.schema import JointFile
from estimator.errors import expected
from estimator.model import Effect, JointModel, Motor, ParameterValue

_DIGITS = 9  # of a covariance


def changes_to(model: JointModel) -> dict[str, Any]:
    """Return the changes of `write_model` that put a model's numbers and deviations into a joint file."""
    changes: dict[str, Any] = {"motor": [_motor(motor) for motor in model.motors]}
    link = link_entry(model)
    return changes | ({"link": link} if link else {})


def link_entry(model: JointModel) -> dict[str, Any]:
    """Return table [link]: dynamics, effects of link and encoder."""
    link: dict[str, Any] = {}
    if model.link is not None:
        link["dynamics"] = {name: x for name, x in asdict(model.link).items() if x is not None}
    if model.link_effects:
        link["effect"] = [effect_entry(effect) for effect in model.link_effects]
    return link


def effect_entry(effect: Effect) -> dict[str, Any]:
    """Return one effect: name, parameters, and the standard deviations of those that were fitted."""
    entry = {"name": effect.name, "parameters": plain_parameters(effect.parameters)}
    return entry | ({"std": plain_parameters(effect.std)} if effect.std else {})


def plain_parameters(parameters: Mapping[str, ParameterValue]) -> dict[str, float | list[float]]:
    """Return the parameters as a file has them: numbers and lists of numbers."""
    return {name: list(v) if isinstance(v, tuple) else float(v) for name, v in parameters.items()}


def _motor(motor: Motor) -> dict[str, Any]:
    names = (
        "inertia_kg_m2", "inertia_std_relative", "viscous_damping_nm_s_rad", "viscous_damping_std_nm_s_rad"
    )  # fmt: skip
    entry: dict[str, Any] = {name: x for name in names if (x := getattr(motor, name)) is not None}
    own = motor.transmission
    if own.parameters:
        entry["transmission"] = {"model": own.model, "parameters": plain_parameters(own.parameters)}
        if own.order is not None:
            entry["transmission"]["order"] = own.order
        if own.covariance is not None:
            rows = [[float(f"{x:.{_DIGITS}g}") for x in row] for row in own.covariance]
            entry["transmission"]["covariance"] = rows
    if motor.effects:
        entry["effect"] = [effect_entry(effect) for effect in motor.effects]
    return entry


def unknown_key(root: type, location: tuple[int | str, ...]) -> str:
    """Return the message for an unknown key, from the keys of its table."""
    section: Any = root
    for part in location[:-1]:
        if isinstance(part, str):
            section = _table(_keys(section).get(part))
    known = list(_keys(section))
    return f"unknown key, {expected(str(location[-1]), known)}" if known else "unknown key"


def _keys(section: Any) -> dict[str, Any]:
    """Name and annotation of each key of a table's schema."""
    if isinstance(section, type) and issubclass(section, BaseModel):
        return {name: info.annotation for name, info in section.model_fields.items()}
    if dataclasses.is_dataclass(section) and isinstance(section, type):
        hints = typing.get_type_hints(section)
        return {field.name: hints[field.name] for field in dataclasses.fields(section)}
    return {}


def _table(annotation: Any) -> Any:
    """Return the table's schema in an annotation like `tuple[MotorSection, ...]` or `Section | None`."""
    if _keys(annotation):
        return annotation
    found = (_table(argument) for argument in typing.get_args(annotation))
    return next((table for table in found if table is not None), None)


_LOG = logging.getLogger(__name__)

MAX_BYTES = 256 << 10  # of a joint file; the longest that fit and diagnose write have some 10 KiB
MAX_LINES = 8 << 10  # what they keep of each costs tomlkit up to 50 µs
MAX_LINE_BYTES = 4 << 10  # the longest that they write, a baseline, has some 300 bytes
_OTHERS = 3  # further keys that a message names
_SHOWN = 80  # characters of a wrong value in a message
_DEEP = re.compile(r"(?<![\w\"' \t-])(?:[\w\"' \t-]++\.){32}")  # parts of one key, found in linear time
_NESTED = "expected a joint file, got tables nested without end"
_MARK = "# drivelink wrote this file, and ends it with a check line: a part of it is refused."
_CHECK = re.compile(r"^# drivelink check: sha256 ([0-9a-f]{16})$\n?", re.MULTILINE)

_PATTERNS = {  # in words, by key
    "name": "letters from a to z, digits, '.', '-' and '_', a letter or digit first",
    "prefix": "parts of a zenoh key with '/' between, without spaces and without any of *$#?",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class JointText:
    """A joint file and its text."""

    joint: JointFile  # the parsed file
    text: str  # the whole text, comments included
    folder: Path  # base of its EDS and zenoh files
    name: str  # for messages
    path: Path | None = None  # the file; None: from a recording

    @property
    def zenoh_config(self) -> Path | None:
        """The zenoh configuration of subscribers that it names."""
        name = self.joint.zenoh.subscriber_config or self.joint.zenoh.config
        return self.folder / name if name else None


def load(path: str | Path) -> JointFile:
    """Read and validate a joint file.

    Raises:
        JointFileError: it cannot be read, is not TOML, or a key is unknown, wrong or missing.
    """
    return load_text(path).joint


def load_text(path: str | Path) -> JointText:
    """Read and validate a joint file, and keep its text.

    Raises:
        JointFileError: as `load`.
    """
    path = Path(path)
    text = read_text(path)
    joint = parse(text, str(path))
    return JointText(joint=joint, text=text, folder=path.absolute().parent, name=str(path), path=path)


def read_text(path: Path) -> str:
    """Return the text of a joint file, not yet validated.

    Raises:
        JointFileError: it cannot be read.
    """
    try:
        return read_regular(path, MAX_BYTES).decode("utf-8-sig").replace("\r\n", "\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "expected UTF-8 text"
        raise JointFileError(f"{path}: cannot be read as a joint file: {reason}") from error


def parse(text: str, where: str = "joint file") -> JointFile:
    """Validate the text of a joint file; `where` begins every message.

    Raises:
        JointFileError: too large, cut off, not TOML, or a key is unknown, wrong or missing.
    """
    return from_json(to_json(text, where), where)


def to_json(text: str, where: str) -> str:
    """Return the text of a joint file as JSON, not yet validated.

    Raises:
        JointFileError: too large, too many lines, a line too long, cut off, nested too deep, or not TOML.
    """
    if len(text) > MAX_BYTES or len(text.encode()) > MAX_BYTES:
        raise JointFileError(f"{where}: expected a joint file, of at most {MAX_BYTES >> 10} KiB, got more")
    lines = text.split("\n")
    if len(lines) > MAX_LINES:
        raise JointFileError(f"{where}: expected at most {MAX_LINES} lines, got {len(lines)}")
    for number, line in enumerate(lines, 1):
        if len(line.encode()) > MAX_LINE_BYTES:
            at_most = f"expected at most {MAX_LINE_BYTES >> 10} KiB"
            raise JointFileError(f"{where}: line {number}: {at_most}, got {len(line)} letters")
    _require_whole(text, where)
    if _DEEP.search(text):  # tomllib's time grows with the square of it
        raise JointFileError(f"{where}: {_NESTED}")
    try:
        return json.dumps(tomllib.loads(text), default=str)
    except RecursionError as error:
        raise JointFileError(f"{where}: {_NESTED}") from error
    except ValueError as error:
        raise JointFileError(f"{where}: expected TOML: {error}") from error


def from_json(document: str, where: str) -> JointFile:
    """Validate a joint file as `to_json` gives it.

    JSON, because strict mode then accepts an array as tuple and 6 as float.

    Raises:
        JointFileError: a key is unknown, wrong or missing.
    """
    try:
        return JointFile.model_validate_json(document)
    except ValidationError as error:
        raise JointFileError(f"{where}: {_one_line(error)}") from error


def write_model(
    source: JointText, target: Path, changes: dict[str, Any], *, force: bool = False
) -> JointFile:
    """Copy a joint file with its comments, replace some values, and validate the copy.

    The copy ends with a check line, so that readers detect a truncated file.

    Args:
        target: path of the copy; written atomically, and only if valid.
        changes: nested like the file. Mappings are merged, a list of mappings for an array (`motor`) element
            by element; everything else, and `effect`, is replaced.

    Raises:
        JointFileError: the result is invalid, or the target cannot be written.
    """
    before = without_check(source.text)
    document = tomlkit.parse(before)
    _merge(document, changes)
    text = f"{_MARK}\n{_apart(tomlkit.dumps(document), before).rstrip()}\n"
    text += f"# drivelink check: sha256 {fingerprint(text)}\n"
    joint = parse(text, str(target))
    with raised_as(JointFileError, f"{target}: cannot be written"):
        write_whole(target, text, force=force)
    return joint


def _apart(text: str, before: str) -> str:
    """Separate what is new from the table after it by a blank line, which tomlkit does not."""
    known, lines = set(before.split("\n")), [""]
    for line in text.split("\n"):
        if line.startswith("[") and lines[-1].strip() and not {line, lines[-1]} <= known:
            lines.append("")
        lines.append(line)
    return "\n".join(lines[1:])


def without_check(text: str) -> str:
    """Return the text of a joint file without the first and the check line that drivelink writes."""
    return _CHECK.sub("", text).replace(f"{_MARK}\n", "", 1)


def fingerprint(text: str) -> str:
    """Return what says of two joint files whether they are the same."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _require_whole(text: str, where: str) -> None:
    """Refuse a truncated file that drivelink wrote; an edited one is accepted.

    Raises:
        JointFileError: its check line is missing.
    """
    checks = list(_CHECK.finditer(text))
    if not checks:
        if _MARK in text:
            raise JointFileError(
                f"{where}: truncated: its last line, the check line, is missing (write it again; if you "
                "removed that line yourself, remove the first one as well)"
            )
    elif (digest := fingerprint(text[: checks[-1].start()])) != checks[-1][1]:
        _warn_once(where, digest)


@lru_cache(maxsize=16)
def _warn_once(where: str, _digest: str) -> None:
    """A file is read several times: for its joint, its text, what is changed in it."""
    _LOG.warning("%s: edited since drivelink wrote it: read as it is now", where)


def _merge(table: Any, changes: dict[str, Any], *, dotted: bool = False) -> None:
    """Merge changes into a table; `dotted`: it has no header, so new values go into one line."""
    for key, value in changes.items():
        if isinstance(value, dict) and key in table and key != "parameters":
            _merge(table[key], value, dotted=dotted or _is_dotted(table, key))
        elif key == "motor":
            for element, change in zip(table[key], value, strict=True):
                _merge(element, change)
        else:
            table[key] = _inline(value) if dotted else value


def _is_dotted(table: Any, key: str) -> bool:
    """Return whether a table is written as `key.name = …` instead of below a header."""
    container = table if isinstance(table, Container) else getattr(table, "value", None)
    body = container.body if isinstance(container, Container) else ()
    return any(k is not None and k.key == key and k.is_dotted() for k, _ in body)


def _inline(value: Any) -> Any:
    """Return a value without header."""
    if isinstance(value, dict):
        made = tomlkit.inline_table()
        made.update({key: _inline(one) for key, one in value.items()})
        return made
    if isinstance(value, list):
        array = tomlkit.array()
        array.extend([_inline(one) for one in value])
        return array
    return value


def _one_line(error: ValidationError) -> str:
    problems = error.errors(include_url=False)
    # A table that is wrong inside also makes its array "too short": that says nothing.
    problems = [problem for problem in problems if problem["type"] != "too_short"] or problems
    first = problems[0]
    key = _key(first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        message = unknown_key(JointFile, first["loc"])
    elif first["type"] == "missing":
        message = "expected this key, it is missing"
    elif first["type"] == "string_pattern_mismatch" and first["loc"][-1] in _PATTERNS:
        message = f"expected {_PATTERNS[str(first['loc'][-1])]}, got {_shown(first['input'])}"
    elif first["type"] != "value_error":
        message = f"{message[0].lower()}{message[1:]}, got {_shown(first['input'])}"
    others = [_key(problem["loc"]) for problem in problems[1:]]
    rest = f" (and {len(others)} more: {', '.join(others[:_OTHERS])})" if others else ""
    return f"{key}: {message}{rest}" if key else f"{message}{rest}"


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _key(location: tuple[int | str, ...]) -> str:
    parts = (f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).lstrip(".")
