"""Electronic data sheets (CiA 306) of the simulated devices, written from their objects."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path

from sim.canopen.cia402_objects import DriveData
from sim.canopen.cia406_objects import EncoderData
from sim.canopen.dictionary import Item, Kind, Object, Value
from sim.canopen.drive import drive_objects
from sim.canopen.encoder import encoder_objects
from sim.canopen.node import Node
from sim.canopen.profiles import PROFILES
from sim.canopen.quirks import Quirks

__all__ = ["eds_directory", "eds_files", "eds_text", "main", "node_eds"]

_MANDATORY = (0x1000, 0x1001, 0x1018)
_BAUD_RATES = (10, 20, 50, 125, 250, 500, 800, 1000)
_DUMMIES = {1: 0, 2: 1, 3: 1, 4: 1, 5: 1, 6: 1, 7: 1}
_DATED = ("11-20-2026", "12:00PM")


def eds_directory() -> Path:
    """Directory of the shipped EDS files."""
    return Path(__file__).parent.parent / "eds"


def eds_files() -> dict[str, str]:
    """File name to text, of every device and profile that is shipped."""
    files = {"cia406-encoder.eds": eds_text("cia406-encoder.eds", encoder_objects(EncoderData(), Quirks()))}
    for name, quirks in PROFILES.items():
        if name != "strict" and not quirks.missing and not quirks.tpdos:
            continue  # behaviour that an EDS file cannot express
        file = "cia402-drive.eds" if name == "strict" else f"{name}.eds"
        files[file] = eds_text(file, drive_objects(DriveData(), quirks), quirks)
    return files


def eds_text(file_name: str, objects: Sequence[Object], quirks: Quirks | None = None) -> str:
    """One EDS.

    Args:
        file_name: what the file will be called.
        objects: the dictionary that the device serves.
        quirks: identity of a drive that imitates this maker's.
    """
    lines = [*_head(file_name, objects, quirks or Quirks())]
    indices = [described.index for described in objects]
    groups = {
        "MandatoryObjects": [index for index in indices if index in _MANDATORY],
        "OptionalObjects": [
            index
            for index in indices
            if index not in _MANDATORY and (index < 0x2000 or 0x6000 <= index <= 0xFFFF)
        ],
        "ManufacturerObjects": [index for index in indices if 0x2000 <= index < 0x6000],
    }
    for group, members in groups.items():
        lines += ["", f"[{group}]", f"SupportedObjects={len(members)}"]
        lines += [f"{number}=0x{index:04X}" for number, index in enumerate(members, start=1)]
    for described in objects:
        lines += _object(described)
    return "\n".join([*lines, ""])


def node_eds(file_name: str, node: Node) -> str:
    """The EDS of one device with its present data."""
    return eds_text(file_name, list(node.dictionary.objects.values()), node.quirks)


def _head(file_name: str, objects: Sequence[Object], quirks: Quirks) -> Iterable[str]:
    item = {
        (described.index, item.subindex): _text(item.default)
        for described in objects
        for item in described.items
    }
    text = item[0x1008, 0]
    date, time = _DATED
    yield from ("[FileInfo]", f"FileName={file_name}", "FileVersion=1", "FileRevision=0", "EDSVersion=4.0")
    yield f"Description={text}"
    for noun, verb in (("Creation", "Created"), ("Modification", "Modified")):
        yield from (f"{noun}Time={time}", f"{noun}Date={date}", f"{verb}By=drivelink")
    yield from ("", "[DeviceInfo]", "VendorName=drivelink", f"VendorNumber={item[0x1018, 1]}")
    yield from (f"ProductName={text}", f"ProductNumber={item[0x1018, 2]}")
    yield from (f"RevisionNumber={item.get((0x1018, 3), 0)}", f"OrderCode={quirks.name}")
    yield from (f"BaudRate_{rate}=1" for rate in _BAUD_RATES)
    indices = [described.index for described in objects]
    yield from ("SimpleBootUpMaster=0", "SimpleBootUpSlave=1", "Granularity=8", "DynamicChannelsSupported=0")
    yield from ("GroupMessaging=0", f"NrOfRXPDO={sum(0x1400 <= index < 0x1600 for index in indices)}")
    yield from (f"NrOfTXPDO={sum(0x1800 <= index < 0x1A00 for index in indices)}", "LSS_Supported=0")
    yield from ("", "[DummyUsage]", *(f"Dummy{code:04X}={used}" for code, used in _DUMMIES.items()))
    yield from ("", "[Comments]", "Lines=1", "Line1=Served by drivelink sim; written by sim.canopen.edsfile")


def _text(value: Value) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _object(described: Object) -> list[str]:
    section = f"{described.index:04X}"
    if described.kind is Kind.VAR:
        return ["", f"[{section}]", *_item(described.items[0], described.name)]
    lines = [
        "",
        f"[{section}]",
        f"ParameterName={described.name}",
        f"ObjectType=0x{described.kind:X}",
        f"SubNumber={len(described.items)}",
    ]
    for item in described.items:
        lines += ["", f"[{section}sub{item.subindex:X}]", *_item(item, item.name)]
    return lines


def _item(item: Item, name: str) -> list[str]:
    lines = [
        f"ParameterName={name}",
        f"ObjectType=0x{Kind.VAR:X}",
        f"DataType=0x{item.type:04X}",
        f"AccessType={item.access}",
        f"DefaultValue={_default(item)}",
        f"PDOMapping={int(item.pdo)}",
    ]
    if item.low is not None:
        lines.append(f"LowLimit={item.low}")
    if item.high is not None:
        lines.append(f"HighLimit={item.high}")
    return lines


def _default(item: Item) -> str:
    if isinstance(item.default, bytes):
        return item.default.decode()
    text = f"0x{item.default:X}" if item.default >= 10 else str(item.default)
    return f"$NODEID+{text}" if item.plus_node_id else text


def main(argv: Sequence[str] | None = None) -> None:
    """Write every shipped EDS file anew."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--directory", type=Path, default=eds_directory())
    directory: Path = parser.parse_args(argv).directory
    for name, text in eds_files().items():
        (directory / name).write_text(text, encoding="ascii")


if __name__ == "__main__":
    main()
