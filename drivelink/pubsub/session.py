"""Opens zenoh sessions with safe defaults or a configuration file; they never block the end of the process.

Without a configuration file a daemon is a peer on loopback. The first one of a machine listens at the
endpoint, `tcp/127.0.0.1:7447`; the others connect to it, so that a plain client there receives all of them.
When the first one dies, `drivelink.pubsub.rendezvous` lets another one take over. Nothing listens beyond
loopback or is multicast.

A configuration file replaces all of these defaults.
"""

from __future__ import annotations

import atexit
import json
import re
import resource
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from drivelink.errors import ZenohError
from drivelink.infile import read_regular
from drivelink.pubsub.rendezvous import Rendezvous, answers

if TYPE_CHECKING:
    from drivelink.jointfile import ZenohSection  # a subscriber need not wait for its validator's import

_MEETING_S = 2.0  # timeout of a local handshake, reached only if another program answers
_POLL_S = 0.01
ENDPOINT = "tcp/127.0.0.1:7447"
_LINKS = ("tcp", "tls", "udp", "quic", "ws", "unixsock-stream", "serial", "vsock")
_MOST_CONFIG_BYTES = 256 << 10
FILES = 8192  # open files: more than the connections that may wait

_COMMON: dict[str, Any] = {
    "mode": "peer",
    "scouting/multicast/enabled": False,
    "scouting/delay": 250,  # ms that opening waits for somebody to connect to
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


def client_config(endpoint: str) -> zenoh.Config:
    """Return a peer without listener that connects to `endpoint`, and through it to every
    daemon of the machine.
    """
    return _config({"listen/endpoints": [], "connect/endpoints": [endpoint], **_CONNECT})


def open_session(section: ZenohSection, base_dir: Path) -> zenoh.Session:
    """Open the daemon's session, connected to the other daemons of the machine.

    Args:
        base_dir: base of a relative `config`: the joint file's directory.

    Raises:
        ZenohError: the configuration file cannot be used, or the endpoint is taken by another program.
    """
    _allow_files()
    if section.config is not None:
        return _open(_read(base_dir / section.config))
    endpoint = _require_endpoint(section.endpoint)
    if not answers(endpoint):
        try:
            return _keep(zenoh.open(daemon_config(endpoint, listen=True)))
        except zenoh.ZError:  # not an address of this machine, or another daemon was quicker
            pass
    return _join(endpoint)


def open_client(endpoint: str, config: str | Path | None = None) -> zenoh.Session:
    """Open a subscriber's session.

    Args:
        endpoint: of a daemon or router, which may start later.
        config: a zenoh configuration file (JSON5) instead of the endpoint.

    Raises:
        ZenohError: the endpoint or the configuration file cannot be used.
    """
    if config is not None:
        return _open(_read(Path(config)))
    return _open(client_config(_require_endpoint(endpoint)))


def _allow_files() -> None:
    """Raise the process's limit of open files to `FILES`, as far as it is permitted."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _join(endpoint: str) -> zenoh.Session:
    """Connect to the listener at the endpoint, and be ready to take over."""
    session = _open(daemon_config(endpoint, listen=False), Rendezvous(endpoint))
    if not connected(session) and answers(endpoint):
        close_session(session)
        raise ZenohError(
            f"{endpoint}: another program listens there and does not speak zenoh: "
            f"end it, or set zenoh.endpoint in the joint file"
        )
    return session


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
    return re.sub(r"\s+at /\S+?:\d+\.?(?=\]|\s|$)", "", text)


def _require_endpoint(endpoint: str) -> str:
    link, _, address = endpoint.partition("/")
    if link not in _LINKS or not address:
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
        return zenoh.Config.from_file(path)
    except OSError as error:
        raise ZenohError(f"{path}: zenoh.config: cannot be read: {error.strerror}") from error
    except zenoh.ZError as error:
        raise ZenohError(f"{path}: expected a zenoh configuration (JSON5): {one_line(error)}") from error


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
    """Return whether the session has a connection, or gets one within two seconds."""
    deadline = time.monotonic() + _MEETING_S
    while time.monotonic() < deadline:
        if session.info.peers_zid() or session.info.routers_zid():
            return True
        time.sleep(_POLL_S)
    return False


@atexit.register
def _close_all() -> None:
    while _open_sessions:
        close_session(_open_sessions[-1][0])
