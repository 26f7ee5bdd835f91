"""What every benchmark is made of: options, a function that yields rows, columns; one writer of tables.

A column is a header and a template over the row: `{"RMSE %": "{rmse:.2%}"}`. What is None or not a number is
shown as a dash. Rows are dictionaries, written as they are by `--json FILE`.
"""

import argparse
import json
import math
import string
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

__all__ = [
    "ROOT", "Columns", "Option", "Row", "diagnosiskit", "faultmatrix", "fleetkit", "gatekit", "joints",
    "literals", "main", "table",
]  # fmt: skip

Row = dict[str, Any]
Columns = dict[str, str]  # header: template
ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "tests"))  # the simulators and stages that the tests have
import diagnosiskit  # noqa: E402
import faultmatrix  # noqa: E402
import fleetkit  # noqa: E402
import gatekit  # noqa: E402
import joints  # noqa: E402
import literals  # noqa: E402


class _Cells(string.Formatter):
    def format_field(self, value: Any, spec: str) -> str:
        """Format a value; a dash for none."""
        missing = value is None or (isinstance(value, float) and not math.isfinite(value))
        return "–" if missing else str(format(value, spec))


class Option:
    """A flag and its default; a tuple: choices, the first is it; a list: several; False: a switch."""

    def __init__(self, flag: str, default: Any, text: str = "", metavar: str | None = None) -> None:
        self.flag, self.default, self.text, self.metavar = flag, default, text, metavar

    def add(self, parser: argparse.ArgumentParser) -> None:
        """Add it to a parser."""
        more: dict[str, Any] = {"help": self.text or None}
        if isinstance(self.default, bool):
            parser.add_argument(self.flag, action="store_true", **more)
            return
        if isinstance(self.default, tuple):
            more |= {"choices": self.default, "default": self.default[0]}
        elif isinstance(self.default, list):  # names may hold commas: ";" stands for them
            more |= {"type": _several, "default": self.default, "metavar": self.metavar or "NAME,…"}
        else:
            kind = Path if self.default is None or isinstance(self.default, Path) else type(self.default)
            more |= {"type": kind, "default": self.default, "metavar": self.metavar}
        parser.add_argument(self.flag, **more)


def _several(text: str) -> list[str]:
    return [name.strip().replace(";", ",") for name in text.split(",")]


def table(columns: Columns, rows: Iterable[Row], show: Callable[[str], object] = print) -> list[Row]:
    """Write rows as they come; give them back."""
    kept = []
    for row in rows:
        if not kept:
            show("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
        show("| " + " | ".join(_Cells().format(cell, **row) for cell in columns.values()) + " |")
        kept.append(row)
    return kept


def main(
    doc: str | None,
    rows: Callable[[argparse.Namespace], Iterable[Row]],
    columns: Columns,
    *options: Option,
    after: Callable[[list[Row]], str] | None = None,
) -> None:
    """Run a scene: parse the command line, write the table, what is said `after` it, and `--json FILE`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for option in options:
        option.add(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the rows there")
    args = parser.parse_args()
    kept = table(columns, rows(args), lambda line: print(line, flush=True))
    if args.json:  # first: what is said after them may end the program
        args.json.write_text(json.dumps(kept, indent=1, default=str) + "\n", encoding="utf-8")
    if after is not None and kept and (text := after(kept)):
        print(f"\n{text}")
