"""CANopen: EDS files, SDO, PDO mapping, units.

Before the start (blocking)::

    configurator = configure_joints(bus, [joint], [folder])

In the run the loop alone reads the bus. It calls `configurator.start(node)` after a boot-up message,
`configurator.feed(cob_id, data, now_s)` for every frame 0x581 to 0x5FF, and regularly
`configurator.poll(now_s)`, which returns finished nodes, each with its new layout or its error. With
`configure = false` it is a `PassiveConfigurator` with the same methods, which sends nothing, also takes the
frames 0x601 to 0x67F, and reports in `poll` when another master has changed a mapping.
"""

Address = tuple[int, int]
"""Index and subindex of an object."""
