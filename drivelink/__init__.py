"""Stiffness and flexibility torque of a variable-stiffness drive, on line, without a torque sensor.

>>> fit = drivelink.fit("run.csv", joint="elbow.toml")
>>> fit.predict("other.csv").fit_percent
>>> fit.plot()
>>> fit.write("better.toml")

`drivelink.diagnose("suspect.csv", joint="better.toml")` names the effect that a model lacks.
`drivelink.subscribe()` follows a daemon. SI units at the joint side; names carry their unit.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drivelink.version import __version__ as __version__

if TYPE_CHECKING:
    from drivelink.analysis import Diagnosed as Diagnosed
    from drivelink.analysis import Fit as Fit
    from drivelink.analysis import Picture as Picture
    from drivelink.analysis import diagnose as diagnose
    from drivelink.analysis import fit as fit
    from drivelink.comparison import compare as compare
    from drivelink.output.comparison import Comparison as Comparison
    from drivelink.pubsub.client import AsyncSubscription as AsyncSubscription
    from drivelink.pubsub.client import Subscription as Subscription
    from drivelink.pubsub.client import subscribe as subscribe
    from drivelink.pubsub.client import subscribe_async as subscribe_async
    from drivelink.pubsub.clientbase import joints as joints
    from drivelink.pubsub.feed import State as State

_MODULES = {  # imported when asked for, so that `import drivelink` stays cheap
    "analysis": ("Diagnosed", "Fit", "Picture", "diagnose", "fit"),
    "comparison": ("compare",),
    "output.comparison": ("Comparison",),
    "pubsub.client": ("AsyncSubscription", "Subscription", "subscribe", "subscribe_async"),
    "pubsub.clientbase": ("joints",),
    "pubsub.feed": ("State",),
}
_LAZY = {name: f"drivelink.{module}" for module, names in _MODULES.items() for name in names}

__all__ = ["__version__", *_LAZY]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        try:
            return getattr(import_module(_LAZY[name]), name)
        except ModuleNotFoundError as error:
            if error.name != _LAZY[name]:
                raise
            # the wheel of the client alone (packaging/client.py)
            text = f"drivelink.{name}: expected drivelink-vsa, only its client is installed"
            raise ImportError(text) from None
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_LAZY])
