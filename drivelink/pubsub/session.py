"""Opens zenoh sessions with safe defaults or a configuration file; they never block the end of the process.

Without a configuration file a daemon is a peer on loopback. The first one of a machine listens at the
endpoint, `tcp/127.0.0.1:7447`; the others connect to it, so that a plain client there receives all of them.
Nothing listens beyond loopback or is multicast. A configuration file replaces all of these defaults.

When the first one dies, another takes over. Zenoh can retry a listener itself, but such a session takes ten
seconds to close (1.10). Therefore a daemon that lost a connection checks whether anything answers at the
endpoint; if not, it opens another session that only listens there. Daemons and clients keep reconnecting to
the endpoint. A router is not replaced: it will restart.
"""

from __future__ import annotations

import atexit
import json
import re
import resource
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from drivelink.errors import ZenohError
from drivelink.files import read_regular

if TYPE_CHECKING:
    from drivelink.jointfile import ZenohSection  # a subscriber need not wait for its validator's import


class Stream:
    """Puts bytes with the identity of the writing session."""

    __slots__ = ("_listener", "_publisher", "_source", "wanted")

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher
        self._source = zenoh.SourceInfo(publisher.id, 0)
        self.wanted = False  # whether there is a subscriber; set by zenoh's thread
        # indirect=False: in zenoh's thread, which never keeps the process from ending
        heard = zenoh.handlers.Callback(self._match, indirect=False)
        self._listener = publisher.declare_matching_listener(heard)
        before: Any = publisher.matching_status  # its stub says bool
        self.wanted = self.wanted or before.matching

    def _match(self, status: zenoh.MatchingStatus) -> None:
        self.wanted = status.matching

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        """Publish a message; a full queue drops it unless the publisher waits."""
        self._publisher.put(payload, attachment=attachment, source_info=self._source)


_ATTEMPT_S = 0.2
_LOOKS = 3  # consecutive answers required: a killed process loses its connections before its listener
_CONNECT_S = 0.5


def answers(endpoint: str) -> bool:
    """Return whether anything accepts a TCP connection at the endpoint."""
    address = _address(endpoint)
    with suppress(OSError):
        if address is not None:
            socket.create_connection(address, timeout=_CONNECT_S).close()
            return True
    return False


def _address(endpoint: str) -> tuple[str, int] | None:
    match = re.fullmatch(r"(?:tcp|tls)/\[?([^\[\]#?]+?)\]?:(\d+)(?:[#?].*)?", endpoint)
    return (match[1], int(match[2])) if match else None


class Rendezvous:
    """Takes over the endpoint of a dead daemon on this machine."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        address = _address(endpoint)
        self._here = address is not None and (address[0] == "localhost" or address[0].startswith("127."))
        self._routed = False  # whether a router was ever there
        self._closed = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._session: zenoh.Session | None = None
        self._listener: Any = None

    def watch(self, session: zenoh.Session) -> None:
        """Check the endpoint whenever this session loses a connection."""
        if self._here:
            # indirect=False: in zenoh's thread, which never keeps the process from ending
            handler = zenoh.handlers.Callback(self._changed, indirect=False)
            self._listener = session.info.declare_transport_events_listener(handler, history=True)

    def close(self) -> None:
        """Stop listening; a second time does nothing."""
        self._closed.set()
        with self._lock:
            thread, session = self._thread, self._session
            self._session = None
        if thread is not None:
            thread.join()
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def _changed(self, event: zenoh.TransportEvent) -> None:
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            self._routed = True
        if event.kind != zenoh.SampleKind.DELETE or self._routed:
            return
        with self._lock:
            busy = self._thread is not None and self._thread.is_alive()
            if not busy and self._session is None and not self._closed.is_set():
                self._thread = threading.Thread(target=self._follow, name="drivelink-rendezvous", daemon=True)
                self._thread.start()

    def _follow(self) -> None:
        answered = 0
        while answered < _LOOKS and not self._closed.wait(_ATTEMPT_S if answered else 0.0):
            if answers(self._endpoint):
                answered += 1
            elif self._listen():
                return
            else:  # another daemon was quicker, or the port is not free yet
                answered = 0
                self._closed.wait(_ATTEMPT_S)

    def _listen(self) -> bool:
        try:
            session = zenoh.open(daemon_config(self._endpoint, listen=True))
        except zenoh.ZError:
            return False
        with self._lock:
            if not self._closed.is_set():
                self._session = session
                return True
        session.close()  # type: ignore[no-untyped-call]
        return True


_MEETING_S = 2.0  # timeout of a local handshake, reached only if another program answers
_POLL_S = 0.01
_SCOUTING_MS = 250  # for a session to hear of another one
ENDPOINT = "tcp/127.0.0.1:7447"
_WITH_PORT = ("tcp", "tls", "udp", "quic", "ws")
_LINKS = (*_WITH_PORT, "unixsock-stream", "serial", "vsock")
_MOST_CONFIG_BYTES = 256 << 10
FILES = 8192  # open files: more than the connections that may wait
_LEAST_FILES = 64  # of which a daemon takes two dozen; a child process and subscribers need more

_COMMON: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/delay": _SCOUTING_MS,
    "transport/unicast/open_timeout": 2000,  # ms; closing waits for it
    "transport/unicast/accept_timeout": 2000,  # ms that a connection may say nothing
    "transport/unicast/accept_pending": 4096,  # of these; further ones, subscribers too, have to wait
    "adminspace/enabled": False,
    "transport/shared_memory/enabled": False,  # these messages are far too small for it
    "transport/link/tx/queue/size/real_time": 16,
    "transport/link/tx/queue/size/interactive_high": 16,
    "transport/link/tx/queue/size/data": 16,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,  # a stuck subscriber costs no wait
}
_CONNECT: dict[str, Any] = {  # forever, in the background
    "connect/timeout_ms": -1,
    "connect/exit_on_failure": False,
    "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 2},
}

_open_sessions: list[tuple[zenoh.Session, Rendezvous | None]] = []


def daemon_config(endpoint: str, listen: bool) -> zenoh.Config:
    """Return a peer on loopback that listens at `endpoint`, or connects to its listener."""
    if listen:
        return _config({"listen/endpoints": [endpoint]})
    return _config({"listen/endpoints": ["tcp/127.0.0.1:0"], "connect/endpoints": [endpoint], **_CONNECT})


def open_session(section: ZenohSection, base_dir: Path) -> zenoh.Session:
    """Open the daemon's session, connected to the other daemons of the machine.

    Args:
        base_dir: base of a relative `config`: the joint file's directory.

    Raises:
        ZenohError: the configuration file cannot be used, the endpoint is taken by another program, or too
            few files may be open.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    _require_files()
    if section.config is not None:
        return _open(_read(base_dir / section.config))
    endpoint = _require_endpoint(section.endpoint)
    if not answers(endpoint):
        with suppress(zenoh.ZError):  # not an address of this machine, or another daemon was quicker
            return _keep(zenoh.open(daemon_config(endpoint, listen=True)))
    return _join(endpoint)


def open_client(endpoint: str, config: str | Path | None = None) -> zenoh.Session:
    """Open a subscriber's session.

    Args:
        endpoint: of a daemon or router, which may start later.
        config: a zenoh configuration file (JSON5) instead of the endpoint.

    Raises:
        ZenohError: the endpoint or the configuration file cannot be used, or too few files may be open.
    """
    _require_files()
    if config is not None:
        return _open(_read(Path(config)))
    # A peer that only connects, and through the one that it reaches to the machine's daemons.
    connects = {"listen/endpoints": [], "connect/endpoints": [_require_endpoint(endpoint)], **_CONNECT}
    return _open(_config(connects))


def _require_files() -> None:
    """Refuse a limit of open files at which zenoh would end the process, by a backtrace."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < _LEAST_FILES:
        wanted = f"expected a limit of at least {_LEAST_FILES}"
        raise ZenohError(f"open files: {wanted}, got {soft}: ulimit -n {FILES}")


def _join(endpoint: str) -> zenoh.Session:
    """Connect to the listener at the endpoint, and be ready to take over."""
    session = _open(daemon_config(endpoint, listen=False), Rendezvous(endpoint))
    if not connected(session) and answers(endpoint):
        close_session(session)
        fix = "end it, or set zenoh.endpoint in the joint file"
        raise ZenohError(f"{endpoint}: another program listens there and does not speak zenoh: {fix}")
    return session


def watch_router(session: zenoh.Session, tell: Callable[[bool], object]) -> Any:
    """Call `tell` in zenoh's thread when the connection to a router is lost (True), or there (False).

    Returns:
        The listener, to be undeclared.
    """

    def changed(event: zenoh.TransportEvent) -> None:
        if event.transport.whatami == zenoh.WhatAmI.ROUTER:
            tell(event.kind == zenoh.SampleKind.DELETE)

    # indirect=False: in zenoh's thread, which never keeps the process from ending
    handler = zenoh.handlers.Callback(changed, indirect=False)
    return session.info.declare_transport_events_listener(handler)


def close_session(session: zenoh.Session) -> None:
    """Close a session; may be called twice."""
    for entry in [entry for entry in _open_sessions if entry[0] is session]:
        _open_sessions.remove(entry)
        if entry[1] is not None:
            entry[1].close()
    if not session.is_closed():
        session.close()  # type: ignore[no-untyped-call]


def one_line(error: BaseException) -> str:
    """Return a zenoh error without locations in zenoh's sources."""
    text = " ".join(str(error).split())
    if nobody := re.match(r"Unable to connect to any of \[(.+?)\](?:[.!]|$)", text):
        refused = ", or not to this certificate" if re.search(r"\b(?:tls|quic)/", nobody[1]) else ""
        return "nobody answers at " + re.sub(r"Single\((.+?)\)", r"\1", nobody[1]) + refused
    # Of a dump, which may hold all of the file, what is wrong.
    if said := re.search(r'(?:message: |msg: |Error\()"((?:[^"\\]|\\.)*)"', text):
        line = "".join(f", line {n}" for n in re.findall(r"\bline: (\d+), column: \d+", text))
        text = re.sub(r"((?:`\w+`, ){3}).+", r"\1…", said[1]) + line
    return re.sub(r"\s+at /\S+?:\d+\.?(?=\]|\s|$)", "", text)


def _require_endpoint(endpoint: str) -> str:
    link, _, address = endpoint.partition("/")
    port = re.fullmatch(r".+:(\d{1,5})(?:[#?].*)?", address)
    if link not in _LINKS or not address or (link in _WITH_PORT and not (port and int(port[1]) < 1 << 16)):
        raise ZenohError(f'endpoint: expected a zenoh endpoint like "{ENDPOINT}", got "{endpoint}"')
    return endpoint


def _config(settings: dict[str, Any]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in (_COMMON | settings).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _read(path: Path) -> zenoh.Config:
    if not path.is_file():
        raise ZenohError(f"{path}: zenoh.config: expected a zenoh configuration file (JSON5), there is none")
    try:
        read_regular(path, _MOST_CONFIG_BYTES)
        config = zenoh.Config.from_file(path)
    except OSError as error:
        raise ZenohError(f"{path}: zenoh.config: cannot be read: {error.strerror}") from error
    except zenoh.ZError as error:
        raise ZenohError(f"{path}: expected a zenoh configuration (JSON5): {one_line(error)}") from error
    for key, value in json.loads(config.get_json("transport/link/tls")).items():
        if key.endswith(("_certificate", "_private_key")) and value and not Path(value).is_file():
            raise ZenohError(f"{path}: transport.link.tls.{key}: expected a file, there is no {value}")
    return config


def _open(config: zenoh.Config, rendezvous: Rendezvous | None = None) -> zenoh.Session:
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise ZenohError(f"zenoh cannot be opened: {one_line(error)}") from error
    if rendezvous is not None:
        rendezvous.watch(session)
    return _keep(session, rendezvous)


def _keep(session: zenoh.Session, rendezvous: Rendezvous | None = None) -> zenoh.Session:
    """Register the session to be closed at the end of the process."""
    _open_sessions[:] = [entry for entry in _open_sessions if not entry[0].is_closed()]
    _open_sessions.append((session, rendezvous))
    return session


def connected(session: zenoh.Session) -> bool:
    """Return whether the session gets connections within two seconds, once no further one comes.

    Opening waits for none of them, and a peer does not answer for another.
    """
    met: set[zenoh.ZenohId] = set()
    since_s = time.monotonic()
    deadline_s = since_s + _MEETING_S
    while (now_s := time.monotonic()) < deadline_s:
        if (there := {*session.info.peers_zid(), *session.info.routers_zid()}) != met:
            met, since_s = there, now_s
        elif met and now_s - since_s > 1e-3 * _SCOUTING_MS:
            break
        time.sleep(_POLL_S)
    return bool(met)


@atexit.register
def _close_all() -> None:
    while _open_sessions:
        close_session(_open_sessions[-1][0])
