"""The CANopen side: object dictionaries as they are found, PDO mapping, units, supervision of nodes.

Before the start, blocking::

    configurator, layouts = configure_joints(bus, [joint], [folder])

In the run, beside the loop, which alone reads the bus: `configurator.start(node)` after a boot-up message,
`configurator.feed(cob_id, data, now_s)` for every frame 0x581 to 0x5FF, `configurator.poll(now_s)` now and
then; it returns the nodes that are done, each with its new layout or its error. With `configure = false`
the configurator is a `PassiveConfigurator`: same methods, nothing to send with; it also wants the frames
0x601 to 0x67F, and its `poll` reports when another master has changed a mapping.
"""

from drivelink.canopen.bus import interface_is_up, open_bus
from drivelink.canopen.configure import Configurator, configure, configure_joints
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout
from drivelink.canopen.passive import PassiveConfigurator

__all__ = [
    "Configurator",
    "MappedObject",
    "NodeLayout",
    "PassiveConfigurator",
    "Signal",
    "TpdoLayout",
    "configure",
    "configure_joints",
    "interface_is_up",
    "open_bus",
]
