"""Writes the tables of docs/wire.md from drivelink/pubsub/wire.py. A test holds that they are current.

Run it after a change of the layout: `python docs/generate_wire.py`.
"""

from __future__ import annotations

from pathlib import Path

from drivelink.pubsub.wire import ESTIMATE, SAMPLE, STATUS_BITS, Field, Layout
from estimator.sample import Status

PAGE = Path(__file__).parent / "wire.md"
SIZES = {"u64": 8, "u32": 4, "f64": 8}
BEGIN, END = "<!-- generated: {} -->", "<!-- end -->"


def layout_table(layout: Layout) -> str:
    """One row a field, with its offset; the element's offsets count from where it begins."""
    rows, offset = ["| byte | type | field | meaning |", "|---|---|---|---|"], 0
    for field in layout.head:
        rows.append(_row(str(offset), field))
        offset += SIZES[field.type]
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


def bits_table() -> str:
    """One row a status bit."""
    rows = ["| bit | mask | name | meaning |", "|---|---|---|---|"]
    for name, meaning in STATUS_BITS.items():
        bit = Status[name]
        rows.append(f"| {bit.bit_length() - 1} | 0x{int(bit):03X} | {name.lower()} | {meaning} |")
    return "\n".join(rows)


def generate(page: str) -> str:
    """The page with each generated part made anew."""
    parts = {"estimate": layout_table(ESTIMATE), "sample": layout_table(SAMPLE), "status bits": bits_table()}
    for name, text in parts.items():
        begin = BEGIN.format(name)
        before, rest = page.split(begin)
        page = f"{before}{begin}\n{text}\n{END}{rest.partition(END)[2]}"
    return page


if __name__ == "__main__":
    PAGE.write_text(generate(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
