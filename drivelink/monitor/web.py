"""The live view as a web page: one self-contained file, served on the loopback, fed by server-sent events.

Nothing is loaded from anywhere else, nothing listens beyond this machine, and a page of another site that
tries to read it by way of the user's browser is refused by its Host header.
"""

from __future__ import annotations

import json
import math
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from drivelink.errors import UsageError
from drivelink.monitor.view import JointView, flags
from drivelink.monitor.watcher import Watcher

__all__ = ["WebView", "snapshot"]

_EVENT_S = 0.1
_LOCAL_HOSTS = frozenset({"localhost", "127.0.0.1", "[::1]"})
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class WebView:
    """Serves the page and its events.

    Args:
        watcher: what is shown; polled here.
        port: on the loopback; 0: any that is free.

    Attributes:
        url: where the page is.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(self, watcher: Watcher, port: int = 0) -> None:
        self._watcher = watcher
        self._lock = threading.Lock()
        self._closing = threading.Event()
        view = self

        class Handler(_Handler):
            web = view

        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"--port {port}: cannot be served: {reason}") from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"

    def poll(self) -> None:
        """Take in what has come; to be called often."""
        with self._lock:
            self._watcher.poll()

    def close(self) -> None:
        """Stop serving."""
        self._closing.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @property
    def closing(self) -> bool:
        """Whether the end has come."""
        return self._closing.is_set()

    def wait(self, seconds: float) -> None:
        """Wait so long, or until the end."""
        self._closing.wait(seconds)

    def event(self, since: dict[str, float]) -> bytes:
        """The state of every joint as JSON, with the moments newer than `since`, which is brought forward."""
        with self._lock:
            joints = {
                name: snapshot(view, name in self._watcher.alive, since)
                for name, view in sorted(self._watcher.views.items())
            }
        return json.dumps({"joints": joints}, allow_nan=False).encode()


def snapshot(view: JointView, alive: bool, since: dict[str, float]) -> dict[str, Any]:
    """What the page is told of one joint; what is not finite is null."""
    history, estimate = view.history, view.history.latest
    last = since.get(view.name, -math.inf)
    window = history.window()
    if window and window[-1].time_s < last:  # the daemon was started anew
        last = -math.inf
    fresh = [moment for moment in window if moment.time_s > last]
    if fresh:
        since[view.name] = fresh[-1].time_s
    told: dict[str, Any] = {
        "alive": alive,
        "status": view.status,
        "restart": last == -math.inf,
        "moments": [[_finite(value) for value in moment[:4]] for moment in fresh],
        "curves": [[[_finite(v) for v in point] for point in curve.points()] for curve in history.curves],
    }
    if estimate is not None:
        told["estimate"] = {
            "stiffness": _finite(estimate.stiffness_nm_rad),
            "std": _finite(estimate.stiffness_std_nm_rad),
            "torque": _finite(estimate.flexibility_torque_nm),
            "transmissions": [[_finite(value) for value in one] for one in estimate.transmissions],
            "flags": flags(estimate.status),
        }
    return told


class _Handler(BaseHTTPRequestHandler):
    """One request: the page, or the stream of events."""

    web: WebView
    protocol_version = "HTTP/1.1"
    server_version = "drivelink"
    sys_version = ""

    def do_GET(self) -> None:
        """Answer a request."""
        host = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        if host not in _LOCAL_HOSTS:
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._page()
        elif self.path == "/events":
            self._events()
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  (named so in the base class)
        """Say nothing."""

    def _page(self) -> None:
        page = files("drivelink.monitor").joinpath("page.html").read_bytes()
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(page)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(page)

    def _events(self) -> None:
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Cache-Control", "no-store")
        self.send_header("Connection", "close")
        self.end_headers()
        since: dict[str, float] = {}
        try:
            while not self.web.closing:
                begin = time.monotonic()
                self.wfile.write(b"data: " + self.web.event(since) + b"\n\n")
                self.wfile.flush()
                self.web.wait(max(0.0, _EVENT_S - (time.monotonic() - begin)))
        except (BrokenPipeError, ConnectionResetError):
            return


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
