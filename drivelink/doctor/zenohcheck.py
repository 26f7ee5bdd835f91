"""Checks zenoh as seen by a subscriber on this machine."""

from __future__ import annotations

import time
from pathlib import Path

import zenoh

from drivelink.doctor.report import Section
from drivelink.errors import ZenohError
from drivelink.jointfile import JointFile
from drivelink.notice import Severity
from drivelink.pubsub.rendezvous import answers
from drivelink.pubsub.session import close_session, open_client

_WAIT_S = 2.0


def examine_zenoh(section: Section, joint: JointFile, base_dir: Path) -> None:
    """Check who listens at the endpoint, which daemons are alive, and whether this joint's key is taken."""
    settings = joint.zenoh
    if settings.config is not None and not (base_dir / settings.config).is_file():
        section.say(
            Severity.ERROR, "zenoh", f"{settings.config}: there is no such file", "correct zenoh.config"
        )
        return
    where = settings.config or settings.endpoint
    if settings.config is None and not answers(settings.endpoint):
        section.ok("zenoh", f"{where}: nobody there yet, the daemon will listen there")
        return
    try:
        session = open_client(settings.endpoint, base_dir / settings.config if settings.config else None)
    except ZenohError as error:
        section.say(Severity.ERROR, "zenoh", str(error))
        return
    try:
        alive = _alive(session, f"{settings.prefix}/*/alive")
    finally:
        close_session(session)
    section.facts["alive"] = alive
    if not alive:
        section.ok("zenoh", f"{where}: reachable, no daemon is alive there")
        return
    names = [key.split("/")[-2] for key in alive]
    section.ok("zenoh", f"{where}: reachable, alive: {', '.join(names)}")
    if joint.name in names:
        section.say(
            Severity.INFO,
            "zenoh",
            f'a daemon for "{joint.name}" runs: a second one would be refused',
            f"drivelink monitor {joint.name}",
        )


def _alive(session: zenoh.Session, key: str) -> list[str]:
    end_s = time.monotonic() + _WAIT_S
    while time.monotonic() < end_s:
        replies = session.liveliness().get(key, timeout=0.5)
        found = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        if found:
            return sorted(found)
        time.sleep(0.1)
    return []
