"""Names of the joints whose daemons are alive, and what to say where a name is not among them."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import zenoh

from drivelink.plaintext import clean_text
from drivelink.pubsub.session import ENDPOINT, close_session, connected, open_client

PATIENCE_S = 3.0  # without a sign of the daemon, until something is said
_MOST = 64  # names that are kept, also against invented ones
_SHOWN = 12
_ANSWER_S = 1.0


def joints(
    *, endpoint: str = ENDPOINT, config: str | Path | None = None, prefix: str = "drivelink"
) -> list[str]:
    """List the joints whose daemons are alive.

    Args:
        endpoint: where a daemon or a router listens.
        config: a zenoh configuration file (JSON5) instead.

    Raises:
        ZenohError: no session can be opened.
    """
    session = open_client(endpoint, config)
    try:
        if not connected(session):
            return []
        names: set[str] = set()
        for reply in session.liveliness().get(f"{prefix}/*/alive/**", timeout=_ANSWER_S):
            _enter(names, reply, prefix)
        return sorted(names)
    finally:
        close_session(session)


def ask(session: zenoh.Session, prefix: str, answer: Callable[[list[str]], None]) -> None:
    """Have `answer` called in zenoh's thread with the names; never waits."""
    names: set[str] = set()
    handler: zenoh.handlers.Callback[zenoh.Reply] = zenoh.handlers.Callback(
        lambda reply: _enter(names, reply, prefix), drop=lambda: answer(sorted(names)), indirect=False
    )
    with suppress(zenoh.ZError):
        session.liveliness().get(f"{prefix}/*/alive/**", handler, timeout=_ANSWER_S)


def absent(joint: str, names: Sequence[str]) -> str:
    """Report that a joint has no daemon, and which others have one."""
    if not names:
        return f'no daemon of "{joint}", nor of any other joint: drivelink run JOINT starts one'
    near = difflib.get_close_matches(joint, names, n=1, cutoff=0.5)
    guess = f'; did you mean "{near[0]}"?' if near else ""
    shown = ", ".join(clean_text(name, _MOST) for name in names[:_SHOWN])
    return f'no daemon of "{joint}"{guess or ";"} there is {shown}{", …" if len(names) > _SHOWN else ""}'


def _enter(names: set[str], reply: zenoh.Reply, prefix: str) -> None:
    if reply.ok is not None and len(names) < _MOST:
        names.add(str(reply.ok.key_expr).removeprefix(f"{prefix}/").split("/alive", 1)[0])
