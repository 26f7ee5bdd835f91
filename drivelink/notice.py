"""A finding about a machine, a bus or a drive: its severity, and the command that fixes it."""

import logging
from dataclasses import asdict, dataclass, field
from enum import IntEnum

from drivelink.plaintext import clean_text


class Severity(IntEnum):
    """How bad it is."""

    OK = 0
    INFO = 1
    WARNING = 2
    ERROR = 3


_LEVELS = {
    Severity.OK: logging.DEBUG,
    Severity.INFO: logging.INFO,
    Severity.WARNING: logging.WARNING,
    Severity.ERROR: logging.ERROR,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Notice:
    """One thing that was noticed; its words, which may be those of a drive or a file, as plain text."""

    severity: Severity  # how bad it is
    subject: str  # e.g. "can0" or "node 1".
    text: str  # one line: what was found, and what it should be
    fix: str = ""  # the command or joint-file line that fixes it, or empty

    def __post_init__(self) -> None:
        for name in ("subject", "text", "fix"):
            object.__setattr__(self, name, clean_text(getattr(self, name)))

    def __str__(self) -> str:
        return f"{self.subject}: {self.text}" + (f" [{self.fix}]" if self.fix else "")

    def as_dict(self) -> dict[str, str]:
        """Return for JSON: the severity by name."""
        return {**asdict(self), "severity": self.severity.name.lower()}


@dataclass(slots=True)
class Findings:
    """A list of notices to add to, by severity."""

    notices: list[Notice] = field(default_factory=list, kw_only=True)

    def add(self, severity: Severity, subject: str, text: str, fix: str = "") -> None:
        """Add a notice."""
        self.notices.append(Notice(severity=severity, subject=subject, text=text, fix=fix))

    def ok(self, subject: str, text: str) -> None:
        """Add a passed check."""
        self.add(Severity.OK, subject, text)

    def info(self, subject: str, text: str, fix: str = "") -> None:
        """Add a remark."""
        self.add(Severity.INFO, subject, text, fix)

    def warn(self, subject: str, text: str, fix: str = "") -> None:
        """Add what someone should look at."""
        self.add(Severity.WARNING, subject, text, fix)

    def error(self, subject: str, text: str, fix: str = "") -> None:
        """Add what prevents operation."""
        self.add(Severity.ERROR, subject, text, fix)


def log_notices(logger: logging.Logger, findings: tuple[Notice, ...] | list[Notice]) -> None:
    """Log each at the level of its severity."""
    for finding in findings:
        logger.log(_LEVELS[finding.severity], "%s", finding)
