"""Lockstep: world, devices, bus and the daemon's cycle in one thread, faster than real time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from drivelink.canopen.bus import open_bus
from drivelink.cycle.busport import BusPort
from drivelink.cycle.loop import CycleLoop, CycleSink, LoopJoint
from drivelink.cycle.pipeline import make_pipeline
from drivelink.cycle.sources import open_source
from drivelink.cycle.startup import join_bus
from drivelink.jointfile import JointFile


class Devices(Protocol):
    """Simulated devices on the joint's bus (`sim.network.Network`)."""

    def poll(self) -> int:
        """Handle what has been sent."""


def run_lockstep(
    joint: JointFile,
    devices: Devices,
    sink: CycleSink | None,
    cycles: int,
    *,
    folder: Path = Path(),
    start_ns: int = 0,
    each: Callable[[], object] | None = None,
) -> LoopJoint:
    """Configure the devices, then run so many cycles of the daemon's loop.

    Args:
        joint: on the virtual bus of the devices.
        devices: polled in this thread; SYNC advances their world by one period.
        sink: gets estimates and samples, e.g. a `JointPublisher`; None: only the loop_joint counts them.
        start_ns: UNIX time that the first SYNC is stamped with.
        each: called after every cycle, e.g. to look at the truth.

    Returns:
        The loop_joint, with its pipeline and counters.

    Raises:
        DriveError, BusError: as the daemon's start does.
    """
    bus = open_bus(joint.bus)
    try:
        port = BusPort(bus)
        _, layouts = join_bus(port, [joint], [folder], idle=devices.poll)
        loop_joint = LoopJoint(joint.name, make_pipeline(joint, layouts[0]), sink)
        loop = CycleLoop(
            open_source(bus, devices.poll),
            [loop_joint],
            period_s=joint.bus.period_s,
            counter_overflow=joint.bus.sync_counter_overflow,
            world_steps=True,
        )
        if each is None:
            loop.run_lockstep(cycles, start_ns)
        else:
            for stamp_ns in loop.stamps(cycles, start_ns):
                loop.run_lockstep(1, stamp_ns)
                each()
        return loop_joint
    finally:
        bus.shutdown()
