"""What a verb reports: sections of texts, tables and charts, drawn as a page or printed in a terminal."""

import html as markup
import io
import json
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from rich.text import Text

from drivelink.files import write_whole
from drivelink.output import plots
from drivelink.output.numbers import Units
from drivelink.plaintext import clean_text, spelt
from estimator.model import ParameterValue

_WIDTH = 100  # columns of a result in Python
_NARROWEST = 12  # columns of the names beside cells that are not folded
PARAMETER_HEAD = ("parameter", "value", "± (95 %)", "unit")


class Paragraph(NamedTuple):
    """A text; on the page with a label above and in a style of its own."""

    text: str
    label: str = ""
    style: str = ""


class Markup(NamedTuple):
    """HTML of our own making, a cell or a block, on a page only."""

    html: str


class Share(NamedTuple):
    """A cell with a bar: its text, and the part of a whole cell from 0 to 1."""

    text: str
    part: float


Cell = str | Share | Markup
Rows = list[tuple[Cell, ...]]


class Grid(NamedTuple):
    """A table; a row of one cell is a heading of those below it, one that begins with ▶ stands out."""

    head: tuple[str, ...]
    rows: Rows
    title: str = ""


class Chart(NamedTuple):
    """A figure, drawn on a page only."""

    draw: Callable[[], Figure]
    caption: str = ""


class Lines(NamedTuple):
    """Remarks, one line each."""

    lines: tuple[str, ...]


Block = Paragraph | Grid | Chart | Lines | Markup


class Section(NamedTuple):
    """Blocks below a heading; on the page over its whole width, or half of it."""

    title: str
    blocks: list[Block]
    wide: bool = True


class Document(NamedTuple):
    """A report: title, a line about its subject, sections; styles of its page beside those of all."""

    title: str
    about: str
    sections: list[Section]
    style: str = ""


def parameter_rows(
    name: str, value: ParameterValue, std: ParameterValue | None, units: Units
) -> list[tuple[str, ...]]:
    """Return the rows of a parameter below `PARAMETER_HEAD`: one for each coefficient."""
    return [
        (f"{name}[{k}]" if isinstance(value, tuple) else name, *cells)
        for k, cells in enumerate(units.parts(name, value, std), start=1)
    ]


def show(sections: Iterable[Section], console: Console) -> None:
    """Print all but the charts."""
    for section in sections:
        for block in section.blocks:
            if isinstance(block, Paragraph):
                console.print(Text(_plain(block.text)), soft_wrap=not console.is_terminal)
            elif isinstance(block, Grid):
                if title := block.title or section.title:  # a table's own would fold to its width
                    console.print(Text(spelt(_plain(title), console.encoding), "table.title"))
                console.print(_printed(block, console))
            elif isinstance(block, Lines):
                for line in block.lines:
                    console.print(Text(_plain(f"  {line}")), soft_wrap=not console.is_terminal)


def as_text(sections: Iterable[Section]) -> str:
    """Return what `show` prints: a result of Python that is looked at."""
    text = io.StringIO()
    show(sections, Console(file=text, width=_WIDTH))
    return text.getvalue().strip()


def _plain(text: str) -> str:
    return "\n".join(map(clean_text, text.split("\n")))


def _printed(grid: Grid, console: Console) -> Table | Text:
    encoding = console.encoding
    words = [
        max(len(word) for cell in (head, *(cell_text(row[k]) for row in grid.rows if len(row) > 1))
            for word in (cell.split() or [""]))
        for k, head in enumerate(grid.head)
    ]  # fmt: skip
    words[0] = min(words[0], _NARROWEST)  # a name may break
    if sum(words) + 3 * len(words) + 1 > console.width:
        return Text(spelt(_plain(_listed(grid)), encoding))
    body = [[cell_text(row[k]) for row in grid.rows if len(row) > 1] for k in range(len(grid.head))]
    widths = [max(map(len, cells), default=0) for cells in body]
    crowded = sum(max(pair) + 3 for pair in zip(widths, map(len, grid.head), strict=True)) >= console.width
    table = Table()
    room = sum(widths[1:]) + 3 * len(widths) + _NARROWEST <= console.width
    for k, column in enumerate(grid.head):
        left = k == 0 or column == "unit"
        if crowded and column:  # headings fold first
            column = textwrap.fill(column, max(widths[k], *map(len, column.split())))
        table.add_column(
            spelt(_plain(column), encoding),
            justify="left" if left else "right",
            overflow="fold",
            no_wrap=k > 0 and room,
            min_width=words[k],
        )
    for row in grid.rows:
        if len(row) == 1:
            table.add_section()
        style = "bold" if len(row) == 1 or cell_text(row[0]).startswith("▶") else ""
        table.add_row(*(Text(spelt(_plain(cell_text(cell)), encoding)) for cell in row), style=style)
    return table


def _listed(grid: Grid) -> str:
    """Return a table as a list, for where a column would break within a number."""
    lines = []
    for row in grid.rows:
        lines.append(cell_text(row[0]))
        cells = zip(grid.head[1:], map(cell_text, row[1:]), strict=False)
        lines += [f"  {head}: {cell}" if head else f"  {cell}" for head, cell in cells if cell]
    return "\n".join(lines)


def write(folder: Path, stem: str, content: Mapping[str, Any], html: str) -> list[Path]:
    """Write what a verb reports, as JSON and as a page; return both paths."""
    made = [folder / f"{stem}.{kind}" for kind in ("json", "html")]
    for path, text in zip(made, (json.dumps(content, indent=2) + "\n", html), strict=True):
        write_whole(path, text, force=True)
    return made


def page(document: Document) -> str:
    """Draw a document as one self-contained page."""
    template = Template(Path(__file__).with_name("document.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=_escaped(document.title),
        about=_escaped(document.about),
        sections="\n".join(map(_section, document.sections)),
        style=document.style,
    )


def _section(section: Section) -> str:
    heading = f"<h2>{_escaped(section.title)}</h2>" if section.title else ""
    return f'<section class="{"wide" if section.wide else "half"}">{heading}{drawn(section.blocks)}</section>'


def drawn(blocks: Iterable[Block]) -> str:
    """Draw blocks as HTML, charts after all others."""
    parts, charts = [], []
    for block in blocks:
        if isinstance(block, Chart):
            caption = f"<figcaption>{_escaped(block.caption)}</figcaption>" if block.caption else ""
            charts.append(f"<figure>{plots.svg_text(block.draw())}{caption}</figure>")
        elif isinstance(block, Grid):
            parts.append(_table(block))
        elif isinstance(block, Lines):
            parts.append(f"<ul>{''.join(f'<li>{_escaped(line)}</li>' for line in block.lines)}</ul>")
        elif isinstance(block, Markup):
            parts.append(block.html)
        else:
            label = f"<b>{_escaped(block.label)}</b>" if block.label else ""
            parts.append(f'<p class="{block.style}">{label}{_escaped(block.text)}</p>')
    if charts:
        parts.append(f'<div class="charts">{"".join(charts)}</div>')
    return "".join(parts)


def _table(grid: Grid) -> str:
    rows = "".join(_row(cells, len(grid.head)) for cells in grid.rows)
    head = "".join(f"<th>{_escaped(cell)}</th>" for cell in grid.head)
    return f'<div class="table"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _row(cells: tuple[Cell, ...], columns: int) -> str:
    if len(cells) == 1:
        return f'<tr class="over"><th colspan="{columns}">{_escaped(cell_text(cells[0]))}</th></tr>'
    first, *rest = cells
    kind = ' class="chosen"' if cell_text(first).startswith("▶") else ""
    name = re.sub("([_/])", r"\1<wbr>", _escaped(cell_text(first)))
    return f"<tr{kind}><th>{name}</th>{''.join(map(_cell, rest))}</tr>"


def _cell(cell: Cell) -> str:
    if not isinstance(cell, Share):
        whole = re.sub(r"(?<=\d) (?=[%σ])", "\u00a0", cell_text(cell))  # no line ends within "100 %"
        return f"<td>{cell.html if isinstance(cell, Markup) else _escaped(whole)}</td>"
    width = 100.0 * min(max(cell.part, 0.0), 1.0)
    return f'<td class="bar"><i><b style="width:{width:.1f}%"></b></i>{_escaped(cell.text)}</td>'


def _escaped(text: str) -> str:
    return markup.escape(clean_text(text, len(text)), quote=False)


def cell_text(cell: Cell) -> str:
    """Return what a cell says."""
    return cell if isinstance(cell, str) else getattr(cell, "text", "")
