"""EDS and DCF files as vendors write them (CiA 306-1): everything that can be read is read.

Makers' files have other encodings, keys twice, values left out, other nodes' identifiers, unknown types.
None of that is a reason to give up; each is a line in `DataSheet.problems`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

from drivelink.canopen.pdo import Tpdo, tpdos_of
from drivelink.errors import DriveError

__all__ = ["DataSheet", "SheetObject", "load_eds"]

Sections = dict[str, dict[str, str]]

# CiA 301, table 44: length in bits, signed.
_TYPES = {
    0x01: (1, False),
    0x02: (8, True),
    0x03: (16, True),
    0x04: (32, True),
    0x05: (8, False),
    0x06: (16, False),
    0x07: (32, False),
    0x08: (32, True),
    0x10: (24, True),
    0x11: (64, True),
    0x12: (40, True),
    0x13: (48, True),
    0x14: (56, True),
    0x15: (64, True),
    0x16: (24, False),
    0x18: (40, False),
    0x19: (48, False),
    0x1A: (56, False),
    0x1B: (64, False),
}
_NO_NUMBER = frozenset({0x08, 0x09, 0x0A, 0x0B, 0x0C, 0x0D, 0x0F, 0x11})  # floats, strings, times, domain
_OBJECT = re.compile(r"([0-9a-f]{4})(?:sub([0-9a-f]{1,2}))?")
_NODE = re.compile(r"\$(my_)?node_?id", re.IGNORECASE)  # $NODEID, and Roboteq's $MY_NODE_ID


@dataclass(frozen=True, slots=True, kw_only=True)
class SheetObject:
    """One entry of the object dictionary.

    Attributes:
        name: ParameterName.
        data_type: of CiA 301; 0 where the file does not say.
        access: ro, rw, wo, const, …, in lower case.
        mappable: PDOMapping.
        value: ParameterValue, else DefaultValue, as a number; None where there is none.
    """

    name: str
    data_type: int
    access: str
    mappable: bool
    value: int | None

    @property
    def bits(self) -> int | None:
        """Length, where the type gives it."""
        known = _TYPES.get(self.data_type)
        return known[0] if known else None

    @property
    def signed(self) -> bool:
        """Whether the type is a signed one."""
        return _TYPES.get(self.data_type, (0, False))[1]

    @property
    def writable(self) -> bool:
        """Whether it can be written."""
        return self.access not in ("ro", "const")


@dataclass(slots=True, kw_only=True)
class DataSheet:
    """The content of an EDS or DCF file.

    Attributes:
        path: the file.
        vendor_name: as the file has it.
        product_name: as the file has it.
        vendor_id: VendorNumber, or 0x1018:01; 0 where neither gives it.
        product_code: ProductNumber, or 0x1018:02.
        revision: RevisionNumber, or 0x1018:03.
        objects: by (index, subindex).
        problems: what is wrong with the file, a line each.
    """

    path: Path
    vendor_name: str = ""
    product_name: str = ""
    vendor_id: int = 0
    product_code: int = 0
    revision: int = 0
    objects: dict[tuple[int, int], SheetObject] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def value(self, index: int, subindex: int = 0) -> int | None:
        """Value of an object as an unsigned number of its length; None where the file has none."""
        entry = self.objects.get((index, subindex))
        if entry is None or entry.value is None:
            return None
        return entry.value & ((1 << (entry.bits or 64)) - 1)

    def values(self) -> dict[tuple[int, int], int]:
        """All values, as `value` gives them."""
        pairs = ((address, self.value(*address)) for address in self.objects)
        return {address: value for address, value in pairs if value is not None}

    def tpdos(self) -> tuple[Tpdo, ...]:
        """The TPDOs as the file has them; fixed where it says that they cannot be written."""
        return tuple(replace(tpdo, fixed=self._fixed(tpdo)) for tpdo in tpdos_of(self.values()))

    def _fixed(self, tpdo: Tpdo) -> bool:
        parts = (self.objects.get((tpdo.mapping, subindex)) for subindex in (0, 1))
        return not all(part is not None and part.writable for part in parts)


def load_eds(path: Path, node_id: int | None = None) -> DataSheet:
    """Read an EDS or DCF file.

    Args:
        path: the file.
        node_id: the node it is for; identifiers are computed with it. Left out: the one a DCF was made
            for, or 1.

    Raises:
        DriveError: it cannot be read at all, or is no EDS.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise DriveError(f"{path}: cannot be read as an EDS: {error.strerror}") from error
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
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if encoding == "cp1252":
            sheet.problems.append("is not UTF-8 text: read as Windows text (cp1252)")
        return text
    sheet.problems.append("is neither UTF-8 nor Windows text: read as Latin 1")
    return raw.decode("latin-1")


def _sections(text: str, sheet: DataSheet) -> Sections:
    """Sections and keys, in lower case; the first of two equal keys counts."""
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
    """A number in any of the ways the files have it, `$NODEID` included."""
    relative = bool(_NODE.search(text))
    text = _NODE.sub("", text).replace(" ", "").strip("+")
    if not text:
        return node if relative else None
    for base in (0, 10, 16):
        try:
            return int(text, base) + (node if relative else 0)
        except ValueError:
            continue
    return None


def _made_for(sections: Sections) -> int | None:
    """The node a DCF was made for: stated, or seen from its first TPDO's identifier."""
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
    unreadable: list[str] = []
    unknown: list[str] = []
    for name, keys in sections.items():
        match = _OBJECT.fullmatch(name)
        if match is None:
            continue
        index, subindex = int(match[1], 16), int(match[2] or "0", 16)
        if match[2] is None and "datatype" not in keys:
            _compact(index, keys, sections, node, sheet)
            continue
        entry = _object(keys, node, sections)
        text = keys.get("parametervalue") or keys.get("defaultvalue")
        if entry.value is None and text and entry.data_type not in _NO_NUMBER:
            unreadable.append(f"{index:04X}:{subindex:02X}")
        if entry.bits is None and entry.data_type not in _NO_NUMBER:
            unknown.append(f"{index:04X}:{subindex:02X}")
        sheet.objects[index, subindex] = entry
    for names, what in ((unreadable, "a value that is not a number"), (unknown, "an unknown data type")):
        if len(names) > 1:
            sheet.problems.append(f"object {names[0]} and {len(names) - 1} more have {what}")
        elif names:
            sheet.problems.append(f"object {names[0]} has {what}")


def _object(keys: dict[str, str], node: int, sections: Sections) -> SheetObject:
    data_type = _number(keys.get("datatype", "")) or 0
    if data_type > 0x1B:  # CANFestival's editor: a section of its own gives the base type
        data_type = _number(sections.get(f"{data_type:x}sub1", {}).get("defaultvalue", "")) or data_type
    value = None
    if data_type not in _NO_NUMBER:
        for key in ("parametervalue", "defaultvalue"):
            value = _number(keys.get(key, ""), node)
            if value is not None:
                break
    return SheetObject(
        name=keys.get("parametername", ""),
        data_type=data_type,
        access=keys.get("accesstype", "rw").lower(),
        mappable=bool(_number(keys.get("pdomapping", "")) or 0),
        value=value,
    )


def _compact(index: int, keys: dict[str, str], sections: Sections, node: int, sheet: DataSheet) -> None:
    """An array written once for all its subindices (CompactSubObj, [XXXXValue])."""
    count = _number(keys.get("compactsubobj", "")) or 0
    if not count:
        return
    values = sections.get(f"{index:04x}value", {})
    for subindex in range(1, min(count, 254) + 1):
        stated = values.get(str(subindex))
        sheet.objects[index, subindex] = _object(
            {**keys, **({"parametervalue": stated} if stated else {})}, node, sections
        )
    sheet.objects[index, 0] = SheetObject(
        name="Number of entries", data_type=0x05, access="ro", mappable=False, value=count
    )


def _device(sections: Sections, sheet: DataSheet) -> None:
    info = sections.get("deviceinfo")
    if info is None:
        sheet.problems.append("has no [DeviceInfo]")
        info = {}
    sheet.vendor_name = info.get("vendorname", "")
    sheet.product_name = info.get("productname", "")
    empty = [key for key in ("vendornumber", "productnumber", "revisionnumber") if info.get(key) == ""]
    if empty:
        sheet.problems.append(f"[DeviceInfo] has no value for {', '.join(empty)}")
    sheet.vendor_id = _number(info.get("vendornumber", "")) or sheet.value(0x1018, 1) or 0
    sheet.product_code = _number(info.get("productnumber", "")) or sheet.value(0x1018, 2) or 0
    sheet.revision = _number(info.get("revisionnumber", "")) or sheet.value(0x1018, 3) or 0


def _move_to_node(sheet: DataSheet, made_for: int | None, node: int) -> None:
    """Identifiers that a DCF has for the node it was made for become those of the node asked for."""
    if made_for is None or made_for == node:
        return
    moved = 0
    for (index, subindex), entry in list(sheet.objects.items()):
        if subindex != 1 or not 0x1400 <= index <= 0x19FF or entry.value is None:
            continue
        if entry.value & 0x7F == made_for and entry.value & 0x780:
            sheet.objects[index, subindex] = SheetObject(
                name=entry.name,
                data_type=entry.data_type,
                access=entry.access,
                mappable=entry.mappable,
                value=entry.value - made_for + node,
            )
            moved += 1
    if moved:
        sheet.problems.append(
            f"has {moved} PDO identifier{'s' if moved > 1 else ''} of node {made_for}: "
            f"changed for node {node}"
        )
