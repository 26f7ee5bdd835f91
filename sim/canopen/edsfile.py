"""Electronic data sheets (CiA 306): the object dictionaries of the simulated devices."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from copy import copy
from functools import cache
from pathlib import Path

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, import_od

from sim.canopen.dictionary import Object, variables
from sim.canopen.node import Node

_CODES: dict[type, int] = {ODVariable: 0x7, ODArray: 0x8, ODRecord: 0x9}  # CiA 301, table 42


def eds_directory() -> Path:
    """Return the directory of the shipped EDS files."""
    return Path(__file__).parent.parent / "eds"


@cache
def load_eds(name: str) -> tuple[Object, ...]:
    """Return the objects of a shipped EDS file, by index."""
    dictionary = import_od(str(eds_directory() / f"{name}.eds"), 0)
    return tuple(dictionary[index] for index in sorted(dictionary) if index >= 0x1000)


def with_values(objects: Iterable[Object], values: Mapping[tuple[int, int], int | str]) -> list[Object]:
    """Return copies with other power-on values, by (index, subindex); missing objects are ignored."""

    def changed(variable: ODVariable) -> ODVariable:
        made = copy(variable)
        made.default = values.get((made.index, made.subindex), made.default)  # type: ignore[assignment]
        return made

    return [with_members(one, map(changed, variables(one))) for one in objects]


def with_members(described: Object, members: Iterable[ODVariable]) -> Object:
    """Return an object like this one with other sub-indices."""
    if isinstance(described, ODVariable):
        return next(iter(members))
    made = type(described)(described.name, described.index)
    for member in members:
        made.add_member(member)
    return made


def node_eds(file_name: str, node: Node) -> str:
    """Return the EDS file of a device, with its present power-on values."""
    shipped = (eds_directory() / f"{node.quirks.eds}.eds").read_text(encoding="ascii")
    head = shipped.partition("\n[1000]\n")[0]
    objects = node.dictionary.objects
    name = _default(variables(objects[0x1008])[0])
    for key, value in (
        ("FileName", file_name),
        ("Description", name),
        ("ProductName", name),
        ("ProductNumber", str(variables(objects[0x1018])[2].default)),
        ("OrderCode", node.quirks.name),
    ):
        head = re.sub(f"^{key}=.*$", f"{key}={value}", head, flags=re.MULTILINE)
    return "\n".join([head, *(line for described in objects.values() for line in _object(described))])


def _object(described: Object) -> Iterator[str]:
    section = f"{described.index:04X}"
    if isinstance(described, ODVariable):
        yield from (f"[{section}]", *_item(described), "")
        return
    members = variables(described)
    yield from (
        f"[{section}]",
        f"ParameterName={described.name}",
        f"ObjectType=0x{_CODES[type(described)]:X}",
    )
    yield from (f"SubNumber={len(members)}", "")
    for item in members:
        yield from (f"[{section}sub{item.subindex:X}]", *_item(item), "")


def _item(item: ODVariable) -> Iterator[str]:
    yield from (f"ParameterName={item.name}", f"ObjectType=0x{_CODES[ODVariable]:X}")
    yield from (f"DataType=0x{item.data_type:04X}", f"AccessType={item.access_type}")
    yield from (f"DefaultValue={_default(item)}", f"PDOMapping={int(item.pdo_mappable)}")
    if item.min is not None:
        yield f"LowLimit={item.min}"
    if item.max is not None:
        yield f"HighLimit={item.max}"


def _default(item: ODVariable) -> str:
    default: int | str = item.default or 0
    if isinstance(default, str):
        return default
    text = f"0x{default:X}" if default >= 10 else str(default)
    return f"$NODEID+{text}" if item.relative else text
