"""Stiffness and flexibility torque of a variable-stiffness drive, on line, without a torque sensor."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivelink.version import __version__ as __version__

if TYPE_CHECKING:
    from drivelink.pubsub.asyncclient import AsyncSubscription as AsyncSubscription
    from drivelink.pubsub.asyncclient import subscribe_async as subscribe_async
    from drivelink.pubsub.client import Subscription as Subscription
    from drivelink.pubsub.client import subscribe as subscribe
    from drivelink.pubsub.feed import State as State
    from drivelink.pubsub.names import joints as joints

_LAZY = {  # imported when asked for, so that `import drivelink` stays cheap
    "AsyncSubscription": "drivelink.pubsub.asyncclient",
    "State": "drivelink.pubsub.feed",
    "Subscription": "drivelink.pubsub.client",
    "joints": "drivelink.pubsub.names",
    "subscribe": "drivelink.pubsub.client",
    "subscribe_async": "drivelink.pubsub.asyncclient",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])
