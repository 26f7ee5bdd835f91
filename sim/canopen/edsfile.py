"""Electronic data sheets (CiA 306): the object dictionaries of the simulated devices."""

import io
import re
from configparser import RawConfigParser
from functools import cache
from pathlib import Path

from canopen.objectdictionary.eds import import_eds

from sim.canopen.dictionary import Object

Value = tuple[tuple[int, int], int | str]
"""(index, subindex) and the power-on value."""

_SENSORS = ("60E4", "60E5", "60E6", "60EB")  # arrays with an entry per encoder


def eds_directory() -> Path:
    """Return the directory of the shipped EDS files."""
    return Path(__file__).parent.parent / "eds"


@cache
def data_sheet(name: str, values: frozenset[Value], sensors: int = 0) -> str:
    """Return a shipped EDS file with other power-on values; those of missing objects are ignored.

    Args:
        sensors: how many encoders its arrays are for; 0: as shipped.
    """
    eds = _parsed((eds_directory() / f"{name}.eds").read_text(encoding="ascii"))
    for section in _SENSORS if sensors else ():
        if eds.has_section(section):
            _resize(eds, section, sensors)
    for (index, subindex), value in values:
        places = (f"{index:04X}sub{subindex:X}", *([] if subindex else [f"{index:04X}"]))
        for place in filter(eds.has_section, places):
            eds[place]["DefaultValue"] = (
                f"0x{value:X}" if isinstance(value, int) and value >= 10 else str(value)
            )
            break
    return _written(eds)


@cache
def objects_of(sheet: str) -> tuple[Object, ...]:
    """Return the objects of an EDS file's text, by index."""
    dictionary = import_eds(io.StringIO(sheet), 0)  # type: ignore[no-untyped-call]
    return tuple(dictionary[index] for index in sorted(dictionary) if index >= 0x1000)


def with_head(sheet: str, file_name: str, name: str, product: int, order_code: str) -> str:
    """Return an EDS file's text with another name and number of the device."""
    eds = _parsed(sheet)
    eds["FileInfo"].update(FileName=file_name, Description=name)
    eds["DeviceInfo"].update(ProductName=name, ProductNumber=str(product), OrderCode=order_code)
    return _written(eds)


def _resize(eds: RawConfigParser, section: str, count: int) -> None:
    """Resize an array to so many sensors, all zero."""
    first = dict(eds[f"{section}sub1"])
    for place in eds.sections():
        if place.startswith(f"{section}sub") and int(place[7:], 16) > count:
            eds.remove_section(place)
    eds[section]["SubNumber"] = str(count + 1)
    eds[f"{section}sub0"]["DefaultValue"] = str(count)
    for k in range(1, count + 1):
        name = re.sub(r"\d+$", str(k), first["ParameterName"])
        eds[f"{section}sub{k:X}"] = {**first, "ParameterName": name, "DefaultValue": "0"}


def _parsed(text: str) -> RawConfigParser:
    eds = RawConfigParser()
    eds.optionxform = str  # type: ignore[assignment, method-assign]
    eds.read_string(text)
    return eds


def _written(eds: RawConfigParser) -> str:
    text = io.StringIO()
    eds.write(text, space_around_delimiters=False)
    return text.getvalue().rstrip("\n") + "\n"
