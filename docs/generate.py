"""Makes the parts of the documentation that the code describes: `python docs/generate.py` writes them.

Keys, effects, layouts and commands stand in the pages between `<!-- from the code: NAME -->` and
`<!-- end -->`. Lists of modules are put in place when the documentation is built (docs/hooks.py): for them a
page has a link to the package, alone in a line, with the title "from the code".
"""

import ast
import dataclasses
import inspect
import os
import re
import types
import typing
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from drivelink import cli, jointfile
from drivelink.jointfile import schema
from drivelink.pubsub.wire import ESTIMATE, EXTERNAL, SAMPLE, Field, Layout
from drivelink.recording.formats import FORMATS
from estimator.effects import LIBRARY
from estimator.errors import EstimatorError
from estimator.flexibility import TransmissionModel
from estimator.ranges import range_of
from estimator.reasons import REASONS
from estimator.sample import Bits, ExternalStatus, Status
from estimator.transmissions import MODELS
from sim.canopen.profiles import PROFILES
from sim.effects import LISTED, UNLISTED, Definition

ROOT = Path(__file__).parent.parent
SIZES = {"u64": 8, "u32": 4, "f64": 8}
MARKED = re.compile(r"(<!-- from the code: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)
ASKED = re.compile(r'^\[(.+)\]\(\S+ "from the code"\)$', re.MULTILINE)

SECTIONS: list[tuple[str, type]] = [
    ("Top level", jointfile.JointFile),
    ("[[motor]]", jointfile.MotorSection),
    ("[motor.transmission]", schema.Transmission),
    ("[[motor.effect]], [[link.effect]]", schema.Effect),
    ("[motor.drive]", jointfile.DriveSection),
    ("[[motor.drive.tpdo]], [[link.encoder.tpdo]]", jointfile.TpdoSection),
    ("[link]", jointfile.LinkSection),
    ("[link.encoder]", jointfile.EncoderSection),
    ("[link.dynamics]", schema.LinkDynamics),
    ("[bus]", jointfile.BusSection),
    ("[recording]", schema.RecordingSection),
    ("[recording.columns]", schema.ColumnSection),
    ("[estimator]", schema.EstimatorSettings),
    ("[zenoh]", jointfile.ZenohSection),
    ("[ros2]", jointfile.Ros2Section),
    ("[motion]", schema.MotionSection),
    ("[sim]", jointfile.SimSection),
]

MODELS_HEAD = """\
Models (`none`: rigid transmission, no link encoder, no stiffness):

| model | parameters | law |
|---|---|---|
"""

LIBRARY_HEAD = """\
Effects that `diagnose` finds, or that you declare. `=` gives a default.
"""
SHARED = 2  # effects: a parameter that so many have is explained once, below the table


def type_name(annotation: object) -> str:
    """The type as an author of TOML knows it."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return type_name(arguments[0])
    if origin is typing.Literal:
        return ", ".join(default_text(item) for item in arguments)
    if origin in (types.UnionType, typing.Union):
        return " \\| ".join(dict.fromkeys(type_name(item) for item in arguments if item is not type(None)))
    if origin is tuple:
        return f"array of {type_name(arguments[0])}"
    if inspect.isclass(annotation):
        names = {bool: "true or false", int: "integer", float: "number", str: "text"}
        if annotation in names:
            return names[annotation]
        if dataclasses.is_dataclass(annotation) or issubclass(annotation, BaseModel):
            return "table"
    return "table"


def default_text(value: object) -> str:
    """The default, or what stands for its absence."""
    if value is PydanticUndefined or value is dataclasses.MISSING:
        return "required"
    if value is None or value == () or value == {}:
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`' if value else ""
    if isinstance(value, int | float):
        return f"`{value:_}`" if isinstance(value, int) and value >= 10_000 else f"`{value}`"
    return ""


def limits(name: str, annotation: object, metadata: typing.Iterable[object]) -> str:
    """Bounds on a number: its own, else those of its unit."""
    found = {
        bound: getattr(item, bound)
        for item in metadata
        for bound in ("gt", "ge", "le")
        if getattr(item, bound, None) is not None
    }
    allowed, numbers = range_of(name), {int, float} & {annotation, *typing.get_args(annotation)}
    if not numbers:
        return ""
    low = allowed.least if found.get("gt") == 0 else found.get("ge", -allowed.most)
    return f"{low:g} to {found.get('le', allowed.most):g}"


def rows(section: type) -> list[tuple[str, str, str, str, str]]:
    """(key, type, bounds, default, meaning) of each key of a section."""
    if issubclass(section, BaseModel):
        return [
            (
                name,
                type_name(info.annotation),
                limits(name, info.annotation, info.metadata),
                "" if info.default_factory else default_text(info.default),
                info.description or "",
            )
            for name, info in section.model_fields.items()
        ]
    hints = typing.get_type_hints(section)
    meanings = dict(
        re.findall(r"^    (\w+): (.+(?:\n {5,}.+)*)", inspect.getdoc(section) or "", re.MULTILINE)
    )
    return [
        (
            field.name,
            type_name(hints[field.name]),
            limits(field.name, hints[field.name], ()),
            "" if field.default_factory is not dataclasses.MISSING else default_text(field.default),
            " ".join(meanings.get(field.name, "").split()).rstrip(".").replace("None:", "left out:"),
        )
        for field in dataclasses.fields(section)
    ]


def value(kind: str, bounds: str, default: str) -> str:
    """What a key takes, in one cell: its choices, its default and bounds, or its type and bounds."""
    if default == "required":
        return f"**required** {kind} {bounds}".rstrip()
    if default and default in kind:
        return kind.replace(default, f"**{default}**")
    if not default:
        return f"{kind} {bounds}".rstrip()
    return f"{default}, {bounds}" if bounds else default


def models() -> str:
    """The transmissions' models, as a table."""
    lines = [MODELS_HEAD]
    for name, model in MODELS.items():
        names = ", ".join(f"`{key}`" for key in parameter_names(model))
        law = (inspect.getdoc(type(model)) or "").splitlines()[0].split(";")[0].rstrip(".")
        lines.append(f"| `{name}` | {names} | {law.replace('|', '&#124;')} |\n")
    return "".join(lines)


def parameter_names(model: TransmissionModel) -> list[str]:
    """Names of a model's parameters in the joint file."""
    try:
        return list(model.parameters(np.ones(1)))
    except (ValueError, IndexError, EstimatorError):
        return list(model.parameters(np.ones(2)))


def effects() -> str:
    """The library of effects, a table per place where they act."""
    lines = [LIBRARY_HEAD]
    location = ""
    explained = [
        f"`{p.name}`{'' if p.default is None else f' = {p.default:g}'} ({p.meaning})"
        for effect in LIBRARY.values()
        for p in effect.parameters
    ]
    names = [text.split(" ")[0] for text in explained]
    shared = [
        text
        for text in dict.fromkeys(explained)
        if SHARED <= explained.count(text) == names.count(text.split(" ")[0])
    ]
    rest = iter(explained)
    for effect in LIBRARY.values():
        texts = [next(rest) for _ in effect.parameters]
        parameters = "; ".join(text.split(" ")[0] if text in shared else text for text in texts)
        if effect.location != location:
            location = effect.location
            lines.append(f"\n| {location} | what it is | parameters |\n|---|---|---|\n")
        lines.append(f"| `{effect.name}` | {effect.description} | {parameters} |\n")
    return "".join(lines) + "\nParameters of several effects:\n\n" + "".join(f"- {text}\n" for text in shared)


def joint_file() -> str:
    """The tables of every section of the joint file."""
    parts = []
    described = {key for title, _ in SECTIONS for key in re.findall(r"(\w+)\]", title)}
    after = {schema.Transmission: models, schema.Effect: effects}
    for title, section in SECTIONS:
        summary = (inspect.getdoc(section) or "").splitlines()[0]
        heading = f"`{title}`" if title.startswith("[") else title
        parts.append(f"\n## {heading}\n\n{summary}\n\n| key | value | meaning |\n|---|---|---|\n")
        parts += [
            f"| `{key}` | {value(kind, bounds, default)} | {meaning} |\n"
            for key, kind, bounds, default, meaning in rows(section)
            if not (kind == "table" and key in described)
        ]
        if section in after:
            parts.append("\n" + after[section]())
    return "".join(parts)


def commands_help() -> str:
    """Every verb's --help, for the built documentation."""
    os.environ["COLUMNS"] = "82"
    parser = cli.make_parser(list(cli.VERBS))
    parts = []
    actions = [action for action in parser._actions if action.dest == "verb"]
    for name, subparser in actions[0].choices.items():  # type: ignore[union-attr]
        parts.append(f"\n## `drivelink {name}`\n\n```text\n{subparser.format_help().rstrip()}\n```\n")
    return "".join(parts)


def layout_table(layout: Layout) -> str:
    """One row a field, with its offset; the element's offsets count from where it begins."""
    rows, offset = ["| byte | type | field | meaning |", "|---|---|---|---|"], 0
    for field in layout.head:
        rows.append(_row(str(offset), field))
        offset += SIZES[field.type]
    if not layout.elements:
        return "\n".join([*rows, "", f"{offset} bytes."])
    rows.append(f"| {offset} | u8 | number of {layout.elements} | n, a LEB128 varint; one byte below 128 |")
    first = offset + 1
    size = layout.size(1) - layout.size(0)
    for field in layout.element:
        rows.append(_row(f"{first} + {size}·i", field, f"{layout.elements}[i]."))
        first += SIZES[field.type]
    rows.append("")
    rows.append(f"{layout.size(1)} bytes with one of the {layout.elements}, {layout.size(2)} with two.")
    return "\n".join(rows)


def _row(offset: str, field: Field, prefix: str = "") -> str:
    return f"| {offset} | {field.type} | `{prefix}{field.name}` | {field.meaning} |"


def bits_table(flags: type[Bits]) -> str:
    """One row a status bit."""
    rows = ["| bit | mask | name | meaning |", "|---|---|---|---|"]
    for bit in flags:
        name = str(bit.name).lower()
        rows.append(f"| {bit.bit_length() - 1} | 0x{int(bit):03X} | {name} | {bit.meaning} |")
    return "\n".join(rows)


def reasons_table() -> str:
    """One row a reason why an estimate is not valid: its sentence, with placeholders."""
    words = {"{share}": "44", "{asked:.2g}": "20", "{changes}": "torque gain or stiffness has"}
    rows = ["| name | sentence, with example numbers |", "|---|---|"]
    for name, sentence in REASONS.items():
        for placeholder, example in words.items():
            sentence = sentence.replace(placeholder, example)
        rows.append(f"| `{name}` | {sentence} |")
    return "\n".join(rows)


def defaults_table(definitions: Iterable[Definition]) -> str:
    """One row an effect whose parameters have defaults in the simulated world."""
    rows = ["| effect | defaults |", "|---|---|"]
    for effect in definitions:
        names = ", ".join(f"`{p.name}` {default_of(p.default)}" for p in effect.parameters if p.default)
        if names:
            rows.append(f"| `{effect.name}` | {names} |")
    return "\n".join(rows)


def formats_table() -> str:
    """One row a format of recordings."""
    rows = ["| ending | content | written | read |", "|---|---|---|---|"]
    for ending, kind in FORMATS.items():
        rows.append(f"| `{ending}` | {kind.holds} | {'yes' if kind.sink else 'no'} | yes |")
    return "\n".join(rows)


def profiles_table() -> str:
    """One row a profile of a maker's drives."""
    rows = ["| name | differences |", "|---|---|"]
    return "\n".join([*rows, *(f"| `{one.name}` | {one.differs} |" for one in PROFILES.values())])


def unlisted_effects_table(definitions: Iterable[Definition]) -> str:
    """One row an effect that only the simulated world has."""
    rows = ["| effect | of | what it is | parameters and defaults |", "|---|---|---|---|"]
    for effect in definitions:
        names = ", ".join(f"`{p.name}` {default_of(p.default)}".rstrip() for p in effect.parameters)
        rows.append(f"| `{effect.name}` | {effect.location} | {effect.meaning} | {names} |")
    return "\n".join(rows)


def default_of(default: float | Callable[[float], float] | None) -> str:
    """A default; a function of the first parameter is shown at 1."""
    if default is None:
        return ""
    return f"{default(1.0):g} × the first" if callable(default) else f"{default:g}"


def modules(package: str) -> str:
    """One row a module of a package, or a folder in it: the first sentence of its head."""
    folder = ROOT / package
    if package.endswith("/core"):
        heads = {path.relative_to(folder / "src").as_posix(): _rust_head(path)
                 for path in sorted((folder / "src").rglob("*.rs"))}  # fmt: skip
    else:
        paths = [path for path in folder.glob("*.py") if path.name[:2] != "__"]
        heads = {path.name: _python_head(path) for path in paths}
        heads |= {f"{path.parent.name}/": _python_head(path) for path in folder.glob("*/__init__.py")}
    rows = "".join(f"| `{name}` | {_sentence(heads[name])} |\n" for name in sorted(heads))
    return f"| part | does |\n|---|---|\n{rows}"


def _python_head(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""


def _rust_head(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").splitlines()
    return "\n".join(line.removeprefix("//!").strip() for line in lines if line.startswith("//!"))


def _sentence(head: str) -> str:
    """The first sentence of a head, fit for a table's cell."""
    paragraph = " ".join(head.split("\n\n")[0].split())
    return re.split(r"(?<=[.?])\s", paragraph)[0].rstrip(".").replace("|", "&#124;")


PARTS: dict[str, Callable[[], str]] = {
    "joint file": joint_file,
    "commands": commands_help,
    "estimate": partial(layout_table, ESTIMATE),
    "external": partial(layout_table, EXTERNAL),
    "sample": partial(layout_table, SAMPLE),
    "status bits": partial(bits_table, Status),
    "reasons": reasons_table,
    "formats": formats_table,
    "profiles": profiles_table,
    "external bits": partial(bits_table, ExternalStatus),
    "effects' defaults": partial(defaults_table, LISTED.values()),
    "unlisted effects": partial(unlisted_effects_table, UNLISTED.values()),
    **{f"modules of {package}": partial(modules, package)
       for package in ("drivelink", "drivelink/core", "estimator", "estimator/core", "sim")},
}  # fmt: skip


def filled(text: str) -> str:
    """A page with the lists of modules it asks for."""
    return ASKED.sub(lambda match: PARTS[match[1]](), text)


def updated(text: str) -> str:
    """A page with the present parts between its marks."""
    return MARKED.sub(lambda match: f"{match[1]}\n{PARTS[match[2]]().strip()}\n\n{match[3]}", text)


if __name__ == "__main__":
    for page in sorted((ROOT / "docs").rglob("*.md")):
        old = page.read_text(encoding="utf-8")
        if (new := updated(old)) != old:
            page.write_text(new, encoding="utf-8")
            print(f"{page.relative_to(ROOT)} written")
