"""Reads EDS and DCF files as vendors write them (CiA 306-1).

Makers' files have unexpected encodings, duplicate keys, missing values, other nodes' identifiers, unknown
types. Each is a line in `DataSheet.problems`, not an error. The objects are canopen's; its own reader accepts
none of that, and takes 50 µs for each.
"""

import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from canopen.objectdictionary import ODVariable, datatypes

from drivelink.canopen import Address
from drivelink.canopen.pdo import Tpdo, tpdos_of
from drivelink.errors import DriveError, raised_as
from drivelink.files import read_regular
from drivelink.plaintext import clean_text

Sections = dict[str, dict[str, str]]
MAX_BYTES = 4 << 20  # the longest in circulation have 1 MiB
_MOST_OBJECTS = 20_000  # compact arrays expanded; of those, some 2000
_MOST_DIGITS = 40  # of a number: 64 bits in binary notation are not written

_NUMBERS = frozenset({datatypes.BOOLEAN, *datatypes.INTEGER_TYPES})
_TIMES = (datatypes.TIME_OF_DAY, datatypes.TIME_DIFFERENCE)
_NO_NUMBERS = frozenset({*datatypes.FLOAT_TYPES, *datatypes.DATA_TYPES, *_TIMES})
_STAND_IN = datatypes.UNSIGNED32  # for an unknown type
_OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?")
_NODE = re.compile(r"\$(my_)?node_?id", re.IGNORECASE)  # $NODEID, and Roboteq's $MY_NODE_ID


@dataclass(slots=True, kw_only=True)
class DataSheet:
    """The content of an EDS or DCF file."""

    path: Path
    vendor_name: str = ""  # as the file has it
    product_name: str = ""  # as the file has it
    vendor_id: int = 0  # VendorNumber, or 0x1018:01; 0 where neither gives it
    product_code: int = 0  # ProductNumber, or 0x1018:02
    objects: dict[Address, ODVariable] = field(default_factory=dict)  # by (index, subindex)
    problems: list[str] = field(default_factory=list)  # problems of the file, one line each

    def value(self, index: int, subindex: int = 0) -> int | None:
        """Return the value of an object as an unsigned number of its length; None if the file has none."""
        entry = self.objects.get((index, subindex))
        if entry is None:
            return None
        value = entry.default if entry.value is None else entry.value
        return None if value is None else value & ((1 << len(entry)) - 1)

    def values(self) -> dict[tuple[int, int], int]:
        """Return all values, as `value` gives them."""
        pairs = ((address, self.value(*address)) for address in self.objects)
        return {address: value for address, value in pairs if value is not None}

    def tpdos(self) -> tuple[Tpdo, ...]:
        """Return the TPDOs in the file; `fixed` if it declares them read-only."""
        found = []
        for tpdo in tpdos_of(self.values()):
            parts = (self.objects.get((tpdo.mapping, subindex)) for subindex in (0, 1))
            fixed = not all(part is not None and part.writable for part in parts)
            found.append(replace(tpdo, fixed=fixed))
        return tuple(found)


def load_eds(path: Path, node_id: int | None = None) -> DataSheet:
    """Read an EDS or DCF file.

    Args:
        node_id: the node it is for; identifiers are computed with it. Left out: the one a DCF was made
            for, or 1.

    Raises:
        DriveError: it cannot be read, or is not an EDS.
    """
    with raised_as(DriveError, f"{path}: cannot be read as an EDS"):
        raw = read_regular(path, MAX_BYTES)
    sheet = DataSheet(path=path)
    if raw.lstrip()[:5].lower() == b"<?xml":
        raise DriveError(f"{path}: is XML (an XDD?), expected an EDS or DCF file")
    sections = _sections(_text(raw, sheet), sheet)
    if not any(_OBJECT.fullmatch(name) for name in sections):
        raise DriveError(f"{path}: is not an EDS: no section names an object, like [1000]")
    made_for = _made_for(sections)
    node = node_id or made_for or 1
    _read_objects(sections, node, sheet)
    _device(sections, sheet)
    _move_to_node(sheet, made_for, node)
    return sheet


def _text(raw: bytes, sheet: DataSheet) -> str:
    with suppress(UnicodeDecodeError):
        return raw.decode("utf-8-sig")
    with suppress(UnicodeDecodeError):
        text = raw.decode("cp1252")
        sheet.problems.append("is not UTF-8 text: read as Windows text (cp1252)")
        return text
    sheet.problems.append("is neither UTF-8 nor Windows text: read as Latin 1")
    return raw.decode("latin-1")


def _sections(text: str, sheet: DataSheet) -> Sections:
    """Sections and keys in lower case; the first of duplicate keys counts."""
    sections: Sections = {}
    current: dict[str, str] | None = None
    section = ""
    twice: list[str] = []
    stray = 0
    for line in text.splitlines():
        line = line.strip().strip("\0\x1a")
        if not line or line[0] in ";#":
            continue
        if line[0] == "[":
            section = line[1:].partition("]")[0].strip()
            if section.lower() in sections:
                twice.append(f"[{section}]")
            current = sections.setdefault(section.lower(), {})
            continue
        key, equals, value = line.partition("=")
        key = key.strip().lower()
        if not equals or current is None:
            stray += 1
        elif key in current:
            twice.append(f"the key {key} in [{section}]")
        else:
            current[key] = value.partition(";")[0].strip()
    if twice:
        more = f" and {len(twice) - 1} more" if len(twice) > 1 else ""
        sheet.problems.append(f"has {twice[0]}{more} twice: the first one counts")
    if stray:
        sheet.problems.append(f"has {stray} line{'s' if stray > 1 else ''} that are neither key nor section")
    return sections


def _number(text: str, node: int = 0) -> int | None:
    """Return a number in any notation of the files, `$NODEID` included."""
    relative = bool(_NODE.search(text))
    text = _NODE.sub("", text).replace(" ", "").strip("+")
    if not text or len(text) > _MOST_DIGITS:
        return node if relative and not text else None
    for base in (0, 10, 16):
        try:
            return int(text, base) + (node if relative else 0)
        except ValueError:
            continue
    return None


def _made_for(sections: Sections) -> int | None:
    """Return the node a DCF was made for: declared, or from its first TPDO's identifier."""
    for name in ("devicecomissioning", "devicecommissioning"):
        stated = _number(sections.get(name, {}).get("nodeid", ""))
        if stated is not None and 1 <= stated <= 127:
            return stated
    for number in range(4):
        cob = sections.get(f"{0x1800 + number:04x}sub1", {}).get("parametervalue", "")
        value = _number(cob) if not _NODE.search(cob) else None
        if value is not None and (value & 0x7FF) - (0x180 + 0x100 * number) in range(1, 128):
            return value & 0x7F
    return None


def _read_objects(sections: Sections, node: int, sheet: DataSheet) -> None:
    """Add the objects, compact arrays expanded.

    Raises:
        DriveError: there are too many.
    """
    found: dict[Address, dict[str, str]] = {}
    for name, keys in sections.items():
        if match := _OBJECT.fullmatch(name):
            index, subindex = int(match[1], 16), int(match[2] or "0", 16)
            if match[2] is None and "datatype" not in keys:
                found |= _compact(index, keys, sections.get(f"{index:04x}value", {}))
            else:
                found[index, subindex] = keys
            if len(found) > _MOST_OBJECTS:
                raise DriveError(f"{sheet.path}: expected at most {_MOST_OBJECTS} objects, got more")
    unreadable: list[str] = []
    unknown: list[str] = []
    for (index, subindex), keys in sorted(found.items()):
        entry = ODVariable(keys.get("parametername", ""), index, subindex)
        entry.data_type = _data_type(keys, sections)
        if entry.data_type not in _NUMBERS | _NO_NUMBERS:
            unknown.append(f"{index:04X}:{subindex:02X}")
            entry.data_type = _STAND_IN
        if entry.data_type in _NUMBERS:
            stated = keys.get("parametervalue", ""), keys.get("defaultvalue", "")
            entry.value, entry.default = (_number(text, node) for text in stated)
            if any(stated) and entry.value is None and entry.default is None:
                unreadable.append(f"{index:04X}:{subindex:02X}")
        entry.access_type = keys.get("accesstype", "rw").lower()
        entry.pdo_mappable = bool(_number(keys.get("pdomapping", "")))
        sheet.objects[index, subindex] = entry
    for places, what in ((unreadable, "a value that is not a number"), (unknown, "an unknown data type")):
        has = "has" if len(places) == 1 else f"and {len(places) - 1} more have"
        sheet.problems += [f"object {places[0]} {has} {what}"] if places else []


def _data_type(keys: dict[str, str], sections: Sections) -> int:
    """Return the declared type; the base type for CANFestival's editor, which has a section for each."""
    data_type = _number(keys.get("datatype", "")) or 0
    base = sections.get(f"{data_type:x}sub1", {}).get("defaultvalue", "") if data_type > 0x1B else ""
    return _number(base) or data_type


def _compact(index: int, keys: dict[str, str], values: dict[str, str]) -> dict[Address, dict[str, str]]:
    """Expand a compact array (CompactSubObj, [XXXXValue])."""
    count = min(_number(keys.get("compactsubobj", "")) or 0, 254)
    if not count:
        return {}
    stated = ({"parametervalue": values[str(k)]} if str(k) in values else {} for k in range(1, count + 1))
    members = {(index, k): keys | one for k, one in enumerate(stated, start=1)}
    length = {"parametername": "Number of entries", "accesstype": "ro", "defaultvalue": str(count)}
    return {(index, 0): length | {"datatype": str(datatypes.UNSIGNED8)}} | members


def _device(sections: Sections, sheet: DataSheet) -> None:
    info = sections.get("deviceinfo", {})
    if "deviceinfo" not in sections:
        sheet.problems.append("has no [DeviceInfo]")
    sheet.vendor_name = clean_text(info.get("vendorname", ""))
    sheet.product_name = clean_text(info.get("productname", ""))
    empty = [key for key in ("vendornumber", "productnumber", "revisionnumber") if info.get(key) == ""]
    if empty:
        sheet.problems.append(f"[DeviceInfo] has no value for {', '.join(empty)}")
    sheet.vendor_id = _number(info.get("vendornumber", "")) or sheet.value(0x1018, 1) or 0
    sheet.product_code = _number(info.get("productnumber", "")) or sheet.value(0x1018, 2) or 0


def _move_to_node(sheet: DataSheet, made_for: int | None, node: int) -> None:
    """Change the identifiers of a DCF to those of the requested node."""
    if made_for is None or made_for == node:
        return
    moved = 0
    for (index, subindex), entry in sheet.objects.items():
        value = sheet.value(index, subindex)
        if subindex != 1 or not 0x1400 <= index <= 0x19FF or value is None:
            continue
        if value & 0x7F == made_for and value & 0x780:
            entry.value = value - made_for + node
            moved += 1
    if moved:
        sheet.problems.append(
            f"has {moved} PDO identifier{'s' if moved > 1 else ''} of node {made_for}: "
            f"changed for node {node}"
        )
