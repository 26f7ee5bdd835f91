"""Configures the nodes of a joint file: before the start (blocking), and beside the loop.

`configure_joints` runs before the start. In a run, `Configurator.start(node)` configures a rebooted node
again: the loop passes every SDO response to `feed`, calls `poll` regularly, and takes the new layout from it.
Nothing here waits or reads the bus.
"""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from drivelink._core import SYNC_COB_ID
from drivelink.canopen.bus import FrameBus, Idle, frames, is_canopen, listening_s, run_program, sender
from drivelink.canopen.layout import COMFORTABLE, BusLoad, NodeLayout, bus_load, check_capacity, roles_by_node
from drivelink.canopen.mapping import NMT_START
from drivelink.canopen.node import configure_node
from drivelink.canopen.sdo import Program, SdoTimeout, Session
from drivelink.errors import BusError, DriveError
from drivelink.jointfile import BusSection, JointFile
from drivelink.notice import log_notices

logger = logging.getLogger(__name__)

T = TypeVar("T")

_DEVICE_TYPE = 0x1000  # what a node is asked for first


class Configurator:
    """Configures the nodes of one or several joints, repeatedly if necessary.

    Args:
        send: puts a frame (identifier, data) on the bus.
        joints: joint files on this bus; the first one's bus section counts.
    """

    def __init__(
        self,
        send: Callable[[int, bytes], None],
        joints: Sequence[JointFile],
        base_dirs: Sequence[Path] | None = None,
    ) -> None:
        self._send = send
        self.bus: BusSection = joints[0].bus
        self._roles = roles_by_node(joints, base_dirs)
        self.nodes = tuple(self._roles)  # node ids, in the order of the joint files
        self.layouts: dict[int, NodeLayout] = {}
        self.drop_others = False
        self._sessions: dict[int, Session[NodeLayout]] = {}
        self._ended: list[tuple[int, NodeLayout | DriveError]] = []  # since the last poll

    def program(self, node: int, *, start: bool, stopped: bool = False) -> Program[NodeLayout]:
        """Return the SDO program that configures a node; a stopped node is woken first."""
        taken = {
            tpdo.cob_id
            for other, layout in self.layouts.items()
            if other != node
            for tpdo in layout.tpdos + layout.other_tpdos
        }
        return configure_node(
            self._roles[node], self.bus, taken, drop_others=self.drop_others, start=start, stopped=stopped
        )

    def start(self, node: int, *, stopped: bool = False) -> None:
        """Start to configure a node beside the loop; restart if it is already being configured."""
        program = self.program(node, start=True, stopped=stopped)
        self._sessions[node] = self.run(program, self.bus.sdo_retries)

    def run(self, program: Program[T], retries: int = 0) -> Session[T]:
        """Return the session of a program; the caller feeds and polls it."""
        return Session(program, self._send, timeout_s=self.bus.sdo_timeout_s, retries=retries)

    @property
    def busy(self) -> bool:
        """Whether any configuration is under way."""
        return bool(self._sessions or self._ended)

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Process a frame; only SDO responses (0x581 to 0x5FF) are of interest."""
        node = cob_id - 0x580
        if node in self._sessions:
            self._advance(node, lambda session: session.feed(cob_id, data, now_s))

    def poll(self, now_s: float) -> list[tuple[int, NodeLayout | DriveError]]:
        """Advance the configurations; return finished nodes with their new layout or error."""
        for node in list(self._sessions):
            self._advance(node, lambda session: session.poll(now_s))
        ended, self._ended = self._ended, []
        self.layouts |= {node: result for node, result in ended if isinstance(result, NodeLayout)}
        return ended

    def _advance(self, node: int, step: Callable[[Session[NodeLayout]], object]) -> None:
        """Advance a configuration; whatever the node provokes ends its own one."""
        session = self._sessions[node]
        result: NodeLayout | DriveError
        try:
            step(session)
            if not session.done:
                return
            result = session.result
        except DriveError as error:
            result = error
        except Exception as error:  # of one node: the others are configured
            logger.debug("the configuration of node %d has failed", node, exc_info=error)
            result = DriveError(f"node {node}: {type(error).__name__} in its configuration: {error}")
        del self._sessions[node]
        self._ended.append((node, result))

    def load(self) -> BusLoad:
        """Return the bus load of all configured nodes."""
        return bus_load(self.layouts.values(), self.bus)


def configure_joints(
    bus: FrameBus,
    joints: Sequence[JointFile],
    base_dirs: Sequence[Path] | None = None,
    *,
    idle: Idle | None = None,
) -> Configurator:
    """Configure and start all nodes of all joints on one bus, and check the bus load.

    Args:
        joints: joint files with `configure = true`; the first one's bus section counts.

    Returns:
        The configurator, which knows the layouts, for reboots in the run.

    Raises:
        DriveError: a node is absent, refuses, or cannot give what is needed.
        BusError: the bus fails, or is too slow.
    """
    section = joints[0].bus
    configurator = Configurator(sender(bus), joints, base_dirs)
    for node in configurator.nodes:
        _configure_one(configurator, node, bus, idle)
    if configurator.load().fraction > COMFORTABLE:
        configurator.drop_others = True
        for node in configurator.nodes:
            if configurator.layouts[node].other_tpdos:
                _configure_one(configurator, node, bus, idle)
    load = configurator.load()
    check_capacity(load, section.period_s)
    for layout in configurator.layouts.values():
        log_notices(logger, layout.notices)
    logger.info("bus load %.0f %% of %d kbit/s", 100 * load.fraction, section.bitrate // 1000)
    send = sender(bus)
    for node in configurator.nodes:
        send(0, bytes([NMT_START, node]))
    return configurator


def _configure_one(configurator: Configurator, node: int, bus: FrameBus, idle: Idle | None) -> None:
    section = configurator.bus
    try:
        configurator.layouts[node] = run_program(
            configurator.program(node, start=False), bus, section, idle=idle
        )
    except SdoTimeout as error:
        if error.index != _DEVICE_TYPE:
            raise DriveError(
                f"{error}, though it has answered before: bus.sdo_timeout_s = {2 * section.sdo_timeout_s:g} "
                "gives it more time"
            ) from error
        raise DriveError(
            f"{error} on {section.interface} {section.channel} at {section.bitrate // 1000} kbit/s: "
            "is it powered, and are node id and bit rate right?"
        ) from error


def refuse_foreign_sync(bus: FrameBus, section: BusSection, idle: Idle | None) -> None:
    """Check that no other master produces SYNC.

    Raises:
        BusError: another master does.
    """
    heard = frames(bus, listening_s(section), idle)
    syncs = sum(m is not None and is_canopen(m) and m.arbitration_id == SYNC_COB_ID for m in heard)
    if syncs > 1:
        raise BusError(
            f"another master already produces SYNC on {section.interface} {section.channel}: "
            'set bus.sync = "follow", or stop it'
        )
