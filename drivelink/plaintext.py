"""Words of drives, files and messages as plain text: what a terminal or a browser would obey is left out."""

import codecs
import html
import logging
import os
import re
import shutil
import sys
import textwrap
import time
import unicodedata
from collections.abc import Iterable
from itertools import accumulate
from typing import TextIO

MAX_TEXT = 4096  # characters of one text
_SHOWN = 12  # of many names, at most
_ROOM = 600  # characters for them: the rest of the message has to be read too
# Control and format characters (direction, zero width), surrogates, private and unassigned ones.
_UNSHOWABLE = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def clean_text(text: str, length: int = MAX_TEXT) -> str:
    """Return the text in one line, without control and format characters."""
    text = text[: length + 1]
    if not text.isascii() or not text.isprintable():
        text = "".join(_shown(character) for character in text)
    return text if len(text) <= length else text[: length - 1] + "…"


def for_page(text: str) -> str:
    """Return a text of any length as one of a page, in attributes too."""
    return html.escape(clean_text(text, len(text)))


def some(names: Iterable[object], length: int = _ROOM) -> str:
    """Return the first of many names, each cut at so many characters, and how many there are."""
    shown = [str(name)[:length] for name in names]
    fit = sum(used <= _ROOM for used in accumulate(map(len, shown[:_SHOWN]))) or 1
    return ", ".join(shown[:fit]) + (f", … ({len(shown)} in all)" if len(shown) > fit else "")


def natural(name: str) -> list[str | tuple[int, str]]:
    """Return the key that sorts names as people do: elbow-2 before elbow-10."""
    parts = re.split(r"([0-9]+)", name)
    return [(len(digits := part.lstrip("0")), digits) if k % 2 else part for k, part in enumerate(parts)]


def _shown(character: str) -> str:
    if character in "\t\n\r":
        return " "
    return "" if unicodedata.category(character) in _UNSHOWABLE else character


# What stands for a character where the terminal's encoding lacks it; others become "?".
_SPELT = {
    "±": "+/-", "·": "*", "×": "x", "µ": "u", "−": "-", "–": "-", "→": "->", "…": "...", "°": " deg",
    "φ": "phi", "θ": "theta", "σ": "sigma", "τ": "tau", "π": "pi", "Ω": "Ohm", "≤": "<=", "≥": ">=", "✓": "+",
    "✗": "x", "●": "*", "▶": ">", "█": "#", "░": ".", "⁻": "^-",
    **{raised: f"^{digit}" for digit, raised in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")},
}  # fmt: skip


def _replaced(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_SPELT.get(character, "?") for character in lacking), error.end


codecs.register_error("drivelink.spelt", _replaced)


def spelt(text: str, encoding: str) -> str:
    """Return the text with characters that the encoding lacks spelt out: before anything is aligned."""
    return text.encode(encoding, "drivelink.spelt").decode(encoding)


def spell_out() -> None:
    """Make stdout and stderr spell out characters that their encoding lacks: a C locale, a serial console."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="drivelink.spelt")


def stamped(text: str, stream: TextIO, indent: int = 9) -> str:
    """Write the time of day before a line, and fold it to at most 100 columns of a terminal.

    Args:
        stream: where it goes; a journal has stamps of its own.
    """
    if not stream.isatty():
        return text if "JOURNAL_STREAM" in os.environ else f"{time.strftime('%H:%M:%S')} {text}"
    columns = min(100, shutil.get_terminal_size().columns)
    line = spelt(f"{time.strftime('%H:%M:%S')} {text}", getattr(stream, "encoding", None) or "utf-8")
    return textwrap.fill(line, columns, subsequent_indent=" " * indent, break_on_hyphens=False)


class PlainFormatter(logging.Formatter):
    """Formats log records as plain text, line by line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines."""
        return "\n".join(clean_text(line) for line in super().format(record).split("\n"))


class _Stamped(PlainFormatter):
    """Formats log records as lines with the time of day."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines."""
        return "\n".join(stamped(line, sys.stderr, 11) for line in super().format(record).split("\n"))


def log_to_stderr(level: int) -> None:
    """Log from this level on to stderr, as a daemon and the processes beside it do."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Stamped("%(levelname).1s %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])
