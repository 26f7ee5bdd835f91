"""Electronic data sheets (CiA 306): the object dictionaries of the simulated devices."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import canopen

from sim.canopen.dictionary import DataType, Item, Kind, Object, Value
from sim.canopen.node import Node

_KINDS: dict[type, Kind] = {
    canopen.objectdictionary.ODArray: Kind.ARRAY,
    canopen.objectdictionary.ODRecord: Kind.RECORD,
}
_STRINGS = (DataType.VISIBLE_STRING, DataType.OCTET_STRING, DataType.DOMAIN)


def eds_directory() -> Path:
    """Directory of the shipped EDS files."""
    return Path(__file__).parent.parent / "eds"


@cache
def load_eds(name: str) -> tuple[Object, ...]:
    """The objects of a shipped EDS file, by index."""
    dictionary = canopen.import_od(str(eds_directory() / f"{name}.eds"), 0)
    return tuple(_read(dictionary[index]) for index in sorted(dictionary) if index >= 0x1000)


def _read(described: Any) -> Object:
    kind = _KINDS.get(type(described), Kind.VAR)
    variables = [described] if kind is Kind.VAR else list(described.subindices.values())
    return Object(
        index=described.index,
        name=described.name,
        kind=kind,
        items=tuple(
            Item(
                subindex=v.subindex,
                name=v.name,
                type=DataType(v.data_type),
                access=v.access_type,
                default=v.default.encode() if v.data_type in _STRINGS else v.default,
                low=v.min,
                high=v.max,
                pdo=v.pdo_mappable,
                plus_node_id=v.relative,
            )
            for v in variables
        ),
    )


def with_values(objects: Sequence[Object], values: Mapping[tuple[int, int], Value]) -> list[Object]:
    """The objects with other power-on values, by (index, subindex); those of missing objects are ignored."""
    return [
        replace(
            described,
            items=tuple(
                replace(item, default=values.get((described.index, item.subindex), item.default))
                for item in described.items
            ),
        )
        for described in objects
    ]


def node_eds(file_name: str, node: Node) -> str:
    """The EDS file of a device, with its present power-on values."""
    shipped = (eds_directory() / f"{node.quirks.eds}.eds").read_text(encoding="ascii")
    head = shipped.partition("\n[1000]\n")[0]
    objects = node.dictionary.objects
    name = _default(objects[0x1008].items[0])
    for key, value in (
        ("FileName", file_name),
        ("Description", name),
        ("ProductName", name),
        ("ProductNumber", str(objects[0x1018].items[2].default)),
        ("OrderCode", node.quirks.name),
    ):
        head = re.sub(f"^{key}=.*$", f"{key}={value}", head, flags=re.MULTILINE)
    return "\n".join([head, *(line for described in objects.values() for line in _object(described))])


def _object(described: Object) -> Iterator[str]:
    section = f"{described.index:04X}"
    if described.kind is Kind.VAR:
        yield from (f"[{section}]", *_item(described.items[0], described.name), "")
        return
    yield from (f"[{section}]", f"ParameterName={described.name}", f"ObjectType=0x{described.kind:X}")
    yield from (f"SubNumber={len(described.items)}", "")
    for item in described.items:
        yield from (f"[{section}sub{item.subindex:X}]", *_item(item, item.name), "")


def _item(item: Item, name: str) -> Iterator[str]:
    yield from (f"ParameterName={name}", f"ObjectType=0x{Kind.VAR:X}", f"DataType=0x{item.type:04X}")
    yield from (f"AccessType={item.access}", f"DefaultValue={_default(item)}", f"PDOMapping={int(item.pdo)}")
    if item.low is not None:
        yield f"LowLimit={item.low}"
    if item.high is not None:
        yield f"HighLimit={item.high}"


def _default(item: Item) -> str:
    if isinstance(item.default, bytes):
        return item.default.decode()
    text = f"0x{item.default:X}" if item.default >= 10 else str(item.default)
    return f"$NODEID+{text}" if item.plus_node_id else text
