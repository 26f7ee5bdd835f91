"""Electronic data sheets (CiA 306): the object dictionaries of the simulated devices."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from configparser import RawConfigParser
from copy import copy
from functools import cache
from pathlib import Path

from canopen.objectdictionary import ODVariable, import_od

from sim.canopen.dictionary import Object, variables
from sim.canopen.node import Node


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
    """Return the EDS file of a device: the shipped one, with its present power-on values and sensors."""
    eds = RawConfigParser()
    eds.optionxform = str  # type: ignore[assignment, method-assign]
    eds.read(eds_directory() / f"{node.quirks.eds}.eds", encoding="ascii")
    objects = node.dictionary.objects
    name, product = _default(variables(objects[0x1008])[0]), variables(objects[0x1018])[2].default
    eds["FileInfo"].update(FileName=file_name, Description=name)
    eds["DeviceInfo"].update(ProductName=name, ProductNumber=str(product), OrderCode=node.quirks.name)
    for described in objects.values():
        section, members = f"{described.index:04X}", variables(described)
        if isinstance(described, ODVariable):
            eds[section]["DefaultValue"] = _default(described)
            continue
        eds[section]["SubNumber"] = str(len(members))
        first, places = dict(eds[f"{section}sub1"]), [f"{section}sub{item.subindex:X}" for item in members]
        for place in eds.sections():
            if place.startswith(f"{section}sub") and place not in places:
                eds.remove_section(place)
        for place, item in zip(places, members, strict=True):
            text = eds[place] if eds.has_section(place) else first
            eds[place] = {**text, "ParameterName": item.name, "DefaultValue": _default(item)}
    written = io.StringIO()
    eds.write(written, space_around_delimiters=False)
    return written.getvalue().rstrip("\n") + "\n"


def _default(item: ODVariable) -> str:
    default: int | str = item.default or 0
    if isinstance(default, str):
        return default
    text = f"0x{default:X}" if default >= 10 else str(default)
    return f"$NODEID+{text}" if item.relative else text
