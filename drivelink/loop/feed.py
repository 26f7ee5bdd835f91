"""What the daemon does for the loop, in threads: its state for the black box, the newest finding."""

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from drivelink._core import JointPipeline
from drivelink.loop import finding
from drivelink.pubsub.publisher import JointPublisher

_SNAPSHOT_S = 10.0


class _Feed:
    """Work that is too long for the slack, one thread at a time."""

    _thread: threading.Thread | None = None

    def check(self) -> None:
        """Start the work in the slack, if it is due."""
        if (self._thread is None or not self._thread.is_alive()) and self._due():
            self._thread = threading.Thread(target=self._work, name=type(self).__name__, daemon=True)
            self._thread.start()

    def _due(self) -> bool:
        raise NotImplementedError

    def _work(self) -> None:
        raise NotImplementedError


class SnapshotFeed(_Feed):
    """Publishes the state of a joint's estimator now and then: the black box's recordings begin with it."""

    def __init__(self, pipeline: JointPipeline, publisher: JointPublisher) -> None:
        self._pipeline, self._publisher = pipeline, publisher
        self._due_s = 0.0

    def _due(self) -> bool:
        return self._publisher.snapshot_wanted and time.monotonic() >= self._due_s

    def _work(self) -> None:
        if (made := self._pipeline.snapshot()) is not None:
            self._due_s = time.monotonic() + _SNAPSHOT_S
            self._publisher.put_snapshot(*made)


class FindingFeed(_Feed):
    """Watches the folder of a black box.

    Args:
        folder: of the black box; it need not exist yet.
        publish: called with each new finding, in the slack.
    """

    def __init__(self, folder: Path, joint: str, publish: Callable[[Mapping[str, Any]], None]) -> None:
        self._folder, self._joint, self._publish = folder, joint, publish
        self._seen = 0
        self._found: Mapping[str, Any] | None = None
        self._published: Mapping[str, Any] | None = None

    def check(self) -> None:
        """Publish what was read, in the slack; start to read if the folder has changed."""
        if self._found is not None:
            found, self._found = self._found, None
            if found != self._published:
                self._published = found
                self._publish(found)
        super().check()

    def _due(self) -> bool:
        try:
            before, self._seen = self._seen, self._folder.stat().st_mtime_ns
        except OSError:
            return False
        return self._seen != before

    def _work(self) -> None:
        self._found = finding.foremost(self._folder, self._joint)
