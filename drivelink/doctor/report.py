"""The doctor's findings, as data and in the terminal."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from drivelink.notice import Findings, Notice, Severity
from drivelink.plaintext import spelt

_UNFOLDED = 10_000  # columns
_MARKS = {
    Severity.OK: ("✓", "green"),
    Severity.INFO: ("·", "cyan"),
    Severity.WARNING: ("!", "yellow"),
    Severity.ERROR: ("✗", "red"),
}


@dataclass(slots=True)
class Section(Findings):
    """Findings that belong together."""

    title: str  # their subject
    facts: dict[str, Any] = field(default_factory=dict)  # figures for `--json`


@dataclass(slots=True)
class Report:
    """All sections."""

    sections: list[Section] = field(default_factory=list)  # in their order
    fine: str = "no problem found"  # summary without findings

    def section(self, title: str) -> Section:
        """Start a section."""
        self.sections.append(Section(title))
        return self.sections[-1]

    @property
    def worst(self) -> Severity:
        """The worst finding."""
        severities = [finding.severity for section in self.sections for finding in section.notices]
        return max(severities, default=Severity.OK)

    def as_dict(self) -> dict[str, Any]:
        """Return for `--json`."""
        return {
            "schema": "drivelink.doctor/1",
            "verdict": self.worst.name.lower(),
            "findings": [
                {"section": section.title, **finding.as_dict()}
                for section in self.sections
                for finding in section.notices
            ],
            "facts": {section.title: section.facts for section in self.sections if section.facts},
        }

    def show(self, console: Console) -> None:
        """Print it, unfolded and without padding where nobody sees columns."""
        if console.is_terminal:
            self._show(console)
            return
        with console.capture() as printed:
            console.width = _UNFOLDED
            self._show(console)
        console.file.write("".join(f"{line.rstrip()}\n" for line in printed.get().splitlines()))

    def _show(self, console: Console) -> None:
        """Print it; what may be done with several nodes alike stands at the first one."""
        said: dict[Notice, str] = {}  # and where
        for section in self.sections:
            notices = [notice for notice in section.notices if notice not in said]
            again = Counter((n.subject, said[n].lower()) for n in section.notices if n in said)
            for (subject, where), count in again.items():
                text = f"{count} more, as with {where}"
                notices.append(Notice(severity=Severity.INFO, subject=subject, text=text))
            if notices:
                console.print(f"[bold]{escape(section.title)}[/bold]", highlight=False)
                console.print(Padding(_table(notices, console.encoding), (0, 0, 1, 1)))
            offers = (one for one in notices if one.severity is Severity.INFO and one.fix)
            said |= dict.fromkeys(offers, section.title)
        console.print(self._closing(), highlight=False)

    def _closing(self) -> str:
        counts = Counter(finding.severity for section in self.sections for finding in section.notices)
        errors, warnings = counts[Severity.ERROR], counts[Severity.WARNING]
        if errors:
            plural = "s" if errors > 1 else ""
            return f"[red]{errors} problem{plural} to solve[/red], {warnings} to look at"
        if warnings:
            return f"[yellow]{warnings} to look at[/yellow], nothing that prevents operation"
        return f"[green]{self.fine}[/green]"


def _table(notices: Sequence[Notice], encoding: str) -> Table:
    table = Table(box=None, show_header=False, padding=(0, 1), pad_edge=False)
    table.add_column(width=1)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for finding in notices:
        mark, colour = _MARKS[finding.severity]
        text = Text(spelt(finding.text, encoding))
        if finding.fix:
            text.append("\nfix: ", "dim").append(spelt(finding.fix, encoding), colour)
        table.add_row(Text(spelt(mark, encoding), colour), Text(finding.subject), text)
    return table
