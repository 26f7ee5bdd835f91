"""The live view as a web page: one self-contained file, served on the loopback, fed by server-sent events.

Nothing is loaded from other hosts, the server listens on loopback only, and requests of other sites' pages in
the user's browser (a foreign Host or Origin header) are refused. Of too many streams the oldest ends.
"""

import json
import math
import os
import shutil
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

from drivelink.errors import UsageError, ZenohError
from drivelink.loop import finding as findings
from drivelink.loop.acceptance import accepted_at
from drivelink.monitor.history import Touch, model_curves
from drivelink.monitor.statuslines import Shown, finding_age, shape
from drivelink.monitor.view import JointView
from drivelink.monitor.watcher import Watcher
from drivelink.monitor.webaccept import ACTIONS, WebAcceptance
from drivelink.monitor.webday import WebDay
from drivelink.output.numbers import number
from drivelink.pubsub.feed import decode_document
from drivelink.pubsub.publisher import finite, to_json
from estimator.sample import Sample

MAX_CONNECTIONS = 16
PATIENCE_S = 5.0  # for a whole request, however slowly it comes, and with a silent browser
MAX_STREAMS = 8
_MOST_BODY = 4096  # bytes of a request of the page
_DETAILS = 16  # lines of a finding
_EVENT_S = 0.1
_LOCAL_HOSTS = frozenset({"localhost", "127.0.0.1", "[::1]"})
_OWN_PAGES = ("same-origin", "none")  # what a browser says of our page, and of the user's own request
_AS_SHOWN = (
    "nodes", "wrong", "events", "not_valid", "rigid", "alarm", "advice", "torque_std_nm", "residual_nm",
    "no_gauge", "improved",
)  # fmt: skip
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class WebView:
    """Serves the page and its events.

    Args:
        watcher: source of the views; polled here.
        port: on loopback; 0: any free one.
        acceptance: what the page may change; None: nothing.
        day: the last 24 hours of a joint whose black box is on this machine; None: not shown.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(
        self,
        watcher: Watcher,
        port: int = 0,
        acceptance: WebAcceptance | None = None,
        day: WebDay | None = None,
    ) -> None:
        self.acceptance, self.day = acceptance, day
        self._watcher = watcher
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._streams: deque[threading.Event] = deque()
        self._lookers = 0  # streams that want the motor signals
        view = self

        class Handler(_Handler):
            web = view

        try:
            self._server = _Server(("127.0.0.1", port), Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"--port {port}: cannot be served: {reason}") from error
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/"  # address of the page

    def poll(self) -> None:
        """Process new messages; to be called often."""
        with self._lock:
            self._watcher.follow_signals(self._lookers > 0)
            self._watcher.poll()

    def close(self) -> None:
        """Stop serving."""
        self._closing.set()
        with self._lock:
            for over in self._streams:
                over.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @contextmanager
    def stream(self, signals: bool = False) -> Iterator[threading.Event]:
        """Take a place among the streams; the event is set when a newer stream needs it, and at the end.

        Args:
            signals: it wants the motor signals as well.
        """
        over = threading.Event()
        with self._lock:
            self._streams.append(over)
            self._lookers += signals
            if self._closing.is_set():
                over.set()
            if len(self._streams) > MAX_STREAMS:
                self._streams.popleft().set()
        try:
            yield over
        finally:
            with self._lock, suppress(ValueError):
                self._lookers -= signals
                self._streams.remove(over)

    def event(self, since: dict[str, float]) -> bytes:
        """Return the state of every joint as JSON, with the moments newer than `since`, which is updated."""
        with self._lock:
            joints = {
                name: snapshot(view, name in self._watcher.alive, since)
                for name, view in self._watcher.views.items()
            }
            acceptance = self.acceptance
            if acceptance is not None and acceptance.joint in joints:
                view = self._watcher.views[acceptance.joint]
                joints[acceptance.joint] |= {
                    "trial": acceptance.trial(view),
                    "acceptable": True,
                    "undoable": bool(accepted_at(view.model)),
                }
        return to_json({"joints": joints})


def snapshot(view: JointView, alive: bool, since: dict[str, float]) -> dict[str, Any]:
    """Return the data of one joint for the page; invalid and non-finite values are null.

    Args:
        since: times of the page's newest moment and residual, by joint; updated.
    """
    history = view.history
    last = since.get(view.name, -math.inf)
    window = history.window()
    if window and window[-1].time_s < last:  # the daemon restarted
        last = -math.inf
    fresh = [moment for moment in window if moment.time_s > last]
    residuals = [pair for pair in history.residuals if pair[0] > last]
    newest = fresh[-1].time_s if fresh else last
    curves, grey = ([c.points() for c in some] for some in (history.curves, history.doubtful))
    touches = [touch for touch in history.touches if last < touch.time_s <= newest]
    if fresh:
        since[view.name] = fresh[-1].time_s
    shown = shape(view.status or {}, view.model)
    fields = {
        **_now(view),
        "alive": alive,
        "status": _describe(shown),
        "finding": _finding(view.finding, shown),
        "restart": last == -math.inf,
        "moments": [(*moment[:4], moment.torque_valid, moment.stiffness_valid) for moment in fresh],
        "residuals": residuals,
        "touches": [_touch(touch) for touch in touches],
        "signals": [_signals(*pair) for pair in history.signals if last < pair[0] <= newest],
        "curves": curves,
        "doubtful": grey,
        "model": model_curves(view.model, curves if any(curves) else grey),
    }
    return {name: finite(value) for name, value in fields.items()}


def document(view: JointView) -> dict[str, Any]:
    """Return a joint's present state for `monitor --json`; non-finite values are null."""
    state: dict[str, Any] = finite(_now(view))
    return {"joint": view.name, "time": time.time(), **state, "status": view.status}


def _now(view: JointView) -> dict[str, Any]:
    """State and newest estimate."""
    touch = view.history.touch
    event: dict[str, Any] = {
        "live": view.live and view.history.latest is not None,
        "state": view.state,
        "external": _touch(touch) if touch else None,
        "external_not_valid": view.external_doubt() or None,
    }
    if (estimate := view.history.latest) is not None:
        event["estimate"] = {
            "stiffness": estimate.stiffness_nm_rad,
            "std": estimate.stiffness_std_nm_rad,
            "torque": estimate.flexibility_torque_nm,
            "transmissions": estimate.transmissions,
            "flags": view.flags,
        }
    return event


def _touch(touch: Touch) -> tuple[float, ...]:
    """(time, external torque, standard deviation, contact, valid)."""
    return (*touch[:3], touch.valid and touch.contact, touch.valid)


def _signals(time_s: float, sample: Sample) -> tuple[Any, ...]:
    """(time, torque of each motor, position of each, velocity of each, position of the link)."""
    motors = sample.motor_torque_nm, sample.motor_position_rad, sample.motor_velocity_rad_s
    return (time_s, *motors, sample.link_position_rad)


def _describe(shown: Shown) -> dict[str, Any]:
    """Return the rows of the status on the page."""
    return {
        "cycle": [
            ("rate", shown.rate),
            *((f"{name}, p99", f"{number(p99, 3)} µs") for name, p99 in shown.times),
            ("missed cycles", shown.missed),
            ("load of the bus", shown.load),
            ("cpu", shown.cpu),
            ("recording", shown.recording),
        ],
        **{name: getattr(shown, name) for name in _AS_SHOWN},
        "balances": [(*balance, balance.ratio) for balance in shown.balances],
    }


def _finding(found: Mapping[str, Any], shown: Shown) -> dict[str, Any] | None:
    """Return what the page shows of a finding; None without one."""
    if not findings.line(found):
        return None
    texts = {key: str(found.get(key) or "") for key in ("state", "sentence", "cause", "recording")}
    error, report = found.get("error"), found.get("report")
    listed = (found.get("parameters"), report.get("advice") if isinstance(report, Mapping) else None)
    pair = (
        [error.get(f"{when}_relative") for when in ("before", "after")] if isinstance(error, Mapping) else []
    )
    return {
        **texts,
        "age": finding_age(found, shown),
        "since": found.get("since") if isinstance(found.get("since"), float) else None,
        "details": [str(text) for part in listed if isinstance(part, list) for text in part[:_DETAILS]],
        "error": pair if all(isinstance(value, float) for value in pair) else [],
    }


class _Server(ThreadingHTTPServer):
    """One thread per connection, with a limit on connections."""

    daemon_threads = True
    request_queue_size = 2 * MAX_CONNECTIONS

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self._room = threading.BoundedSemaphore(MAX_CONNECTIONS)
        super().__init__(address, handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection, or refuse it if there are too many."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with suppress(OSError):
            request.settimeout(0.1)
            request.sendall(
                b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
            )
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection to its end."""
        late = threading.Timer(PATIENCE_S, _hear_no_more, (request,))
        late.daemon = True
        late.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            late.cancel()
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that end early."""


def _hear_no_more(request: Any) -> None:
    """End what a browser says; an answer goes on."""
    with suppress(OSError):
        request.shutdown(socket.SHUT_RD)


class _Handler(BaseHTTPRequestHandler):
    """One request: the page, or the stream of events."""

    web: WebView
    timeout = PATIENCE_S
    protocol_version = "HTTP/1.1"
    server_version = "drivelink"
    sys_version = ""

    def do_GET(self) -> None:
        host, origin = self.headers.get("Host") or "", self.headers.get("Origin")
        if host.rsplit(":", 1)[0] not in _LOCAL_HOSTS or origin not in (None, f"http://{host}"):
            self.send_error(HTTPStatus.FORBIDDEN)
        elif self.path == "/":
            self._page()
        elif (
            self.path in ("/events", "/events?signals")
            and self.headers.get("Sec-Fetch-Site", "none") in _OWN_PAGES
        ):
            self._events()
        elif (
            self.web.day is not None
            and self.headers.get("Sec-Fetch-Site", "none") in _OWN_PAGES
            and (found := self.web.day.answer(self.path)) is not None
        ):
            self._give(*found)
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Answer a request that may change something."""
        self.close_connection = True
        acceptance, action = self.web.acceptance, self.path.removeprefix("/")
        host = self.headers.get("Host") or ""
        if acceptance is None or action not in ACTIONS:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif host.rsplit(":", 1)[0] not in _LOCAL_HOSTS or not acceptance.allows(self.headers):
            self.send_error(HTTPStatus.FORBIDDEN)
        else:
            try:
                length = int(self.headers.get("Content-Length") or 0)
                asked = decode_document(self.rfile.read(max(0, min(length, _MOST_BODY))))
            except (ValueError, ZenohError):
                self.send_error(HTTPStatus.BAD_REQUEST)
                return
            self._send("application/json", json.dumps(acceptance.act(action, asked)).encode())

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  (named so in the base class)
        """Log nothing."""

    def _page(self) -> None:
        page = files("drivelink.monitor").joinpath("page.html").read_bytes()
        token = self.web.acceptance.token if self.web.acceptance is not None else ""
        page = page.replace(b"{{token}}", token.encode())
        self._send(
            "text/html; charset=utf-8", page.replace(b"{{day}}", b"hidden" if self.web.day is None else b"")
        )

    def _give(self, kind: str, content: bytes | Path) -> None:
        """Answer with some text, or a file."""
        if isinstance(content, bytes):
            self._send(kind, content)
            return
        # Dropped, or the browser has closed the connection.
        with suppress(OSError), open(content, "rb", opener=findings.open_own) as file:
            self._head(kind, os.fstat(file.fileno()).st_size)
            shutil.copyfileobj(file, self.wfile)

    def _send(self, kind: str, page: bytes) -> None:
        self._head(kind, len(page))
        self.wfile.write(page)

    def _head(self, kind: str, size: int | None = None) -> None:
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        if size is not None:
            self.send_header("Content-Length", str(size))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", _POLICY)
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Connection", "close")
        self.end_headers()

    def _events(self) -> None:
        self._head("text/event-stream")
        since: dict[str, float] = {}
        try:
            with self.web.stream(signals=self.path.endswith("?signals")) as over:
                while not over.is_set():
                    begin = time.monotonic()
                    self.wfile.write(b"data: " + self.web.event(since) + b"\n\n")
                    self.wfile.flush()
                    over.wait(max(0.0, _EVENT_S - (time.monotonic() - begin)))
        except OSError:  # the browser has closed the connection or stopped reading
            return
