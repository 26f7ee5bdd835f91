"""Accepting a finding from the web view, where it was started with `--allow-accept`.

Only the page itself can ask for it: it carries a token that no other site can read, in a header that no other
site may send without being refused first; and it names the recording whose proposal it has shown.
"""

import hmac
import secrets
import time
from collections.abc import Mapping
from email.message import Message
from pathlib import Path
from typing import Any

from drivelink import jointfile
from drivelink.errors import DrivelinkError, UsageError
from drivelink.loop.acceptance import Trial, accept, proposal, undo
from drivelink.monitor.view import JointView

TOKEN_HEADER = "X-Drivelink-Token"
ACTIONS = ("proposal", "accept", "undo")


class WebAcceptance:
    """The actions of the page on one joint file.

    Raises:
        JointFileError: the joint file is wrong.
    """

    def __init__(self, path: Path) -> None:
        self.token = secrets.token_urlsafe(32)  # what the page has to send
        self.joint = jointfile.load(path).name  # name of the joint
        self._path = path
        self._trial: Trial | None = None

    def allows(self, headers: Message) -> bool:
        """Return whether a request comes from the page: it has the token, and its origin is this server."""
        given = str(headers.get(TOKEN_HEADER, "")).encode()
        own = headers.get("Origin") == f"http://{headers.get('Host')}"
        return own and hmac.compare_digest(given, self.token.encode())

    def act(self, action: str, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Perform what the page asks for; what goes wrong is `error`, in one line.

        Args:
            asked: to accept, `recording`: the one whose proposal was shown.
        """
        try:
            if action == "undo":
                old = undo(self._path)
                self._trial = Trial(self._path, time.monotonic(), undone=True)
                return {"text": f"{self._path.name}: as it was before the acceptance ({old.name})"}
            offer = proposal(self._path)
            if action == "proposal":
                return {"recording": offer.recording.name, "difference": offer.difference()}
            if asked.get("recording") != offer.recording.name:
                raise UsageError("there is a newer finding than the one that was shown: look at it first")
            old = accept(offer)
            self._trial = Trial(self._path, time.monotonic())
        except DrivelinkError as error:
            return {"error": str(error)}
        return {"text": f"{self._path.name} is written; the old one is {old.name}"}

    def trial(self, view: JointView) -> dict[str, Any] | None:
        """Return what has come of the last acceptance so far; None without one."""
        if self._trial is None:
            return None
        fallen = self._trial.update(view.status, view.model, time.monotonic())
        return {"fallen": fallen, "text": self._trial.sentence()}
