"""The last 24 hours in the web view: rows of the black box, its events, and the files that they link to."""

import json
import mimetypes
from importlib.resources import files
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit

from drivelink.loop import day
from drivelink.loop.finding import finding_file, kept, page_file
from drivelink.plaintext import for_page

_MOST_ROWS = 1500  # of a plot


class WebDay:
    """What the page of a joint's last day asks for.

    Args:
        folder: of its black box; it need not exist yet.
    """

    def __init__(self, folder: Path, joint: str) -> None:
        self._folder, self._joint = folder, joint

    def answer(self, path: str) -> tuple[str, bytes | Path] | None:
        """Return type and content, or file, of what a request asks for; None: there is no such thing."""
        asked = urlsplit(path).path
        if asked == "/day":
            text = files("drivelink.monitor").joinpath("day.html").read_text(encoding="utf-8")
            page = text.replace("{{joint}}", for_page(self._joint))
            return "text/html; charset=utf-8", page.encode()
        if asked == "/day.json":
            return "application/json", self._data(path)
        return self._file(asked) if asked.startswith("/kept/") else None

    def _data(self, path: str) -> bytes:
        """Rows and events as JSON: `?begin=&end=` in UNIX seconds, else the last day."""
        table = day.rows(self._folder, self._joint)
        end_s = float(table[-1, 0]) if len(table) else 0.0
        query = parse_qs(urlsplit(path).query)
        try:
            begin, end = (float(query[name][0]) for name in ("begin", "end"))
        except (KeyError, ValueError):
            begin, end = end_s - day.DAY_S, end_s
        document = {
            "rows": day.thinned(table, begin, end, _MOST_ROWS),
            "events": day.events(self._folder, self._joint, end_s - day.DAY_S),
            "end": end_s,
        }
        return json.dumps(document, allow_nan=False).encode()

    def _file(self, path: str) -> tuple[str, Path] | None:
        """Return a kept recording or its diagnosis, by its name; None: there is none."""
        name = unquote(path).removeprefix("/kept/")
        try:
            recordings = kept(self._folder, self._joint)
        except OSError:
            return None
        for recording in recordings:
            for one in (recording, page_file(recording), finding_file(recording)):
                if one.name == name and one.is_file() and not one.is_symlink():
                    kind = mimetypes.guess_type(name)[0] or "application/octet-stream"
                    return kind + ("; charset=utf-8" if kind.startswith("text/") else ""), one
        return None
