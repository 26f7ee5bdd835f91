"""Starts on a bus: configure the nodes or listen to their configuration, then wait for their frames."""

import logging
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import can

from drivelink._core import SYNC_COB_ID
from drivelink.canopen.bus import Idle, frames, is_canopen, received_ns
from drivelink.canopen.configure import Configurator, configure_joints, refuse_foreign_sync
from drivelink.canopen.emcy import nmt_state
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.loop import CycleLoop
from drivelink.cycle.syncclock import MEASURED_SYNCS, measure_period
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection, JointFile


class BusPort:
    """The bus for senders of python-can messages: directly, or through the loop while it runs."""

    def __init__(self, bus: can.BusABC) -> None:
        self.bus = bus  # the open bus
        self.loop: CycleLoop | None = None  # the only reader, once it runs

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a frame."""
        if self.loop is None:
            self.bus.send(msg, timeout)
        else:
            self.loop.send(msg.arbitration_id, bytes(msg.data))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next frame; only before the loop runs."""
        return self.bus.recv(timeout)


logger = logging.getLogger(__name__)

_PATIENCE_S = 5.0  # after which it is said what another master is waited for


def join_bus(
    port: BusPort,
    joints: Sequence[JointFile],
    folders: Sequence[Path],
    *,
    idle: Idle | None = None,
    patience_s: float = _PATIENCE_S,
) -> Configurator | PassiveConfigurator:
    """Get the layouts of all nodes, by configuring them or by listening; return what knows them.

    Another master, for its SYNC or its configuration of the nodes, is waited for without end; after
    `patience_s` one line says so. The period of its SYNC is measured and returned in the configurator's
    `bus`; a different period in the joint file is logged.

    Raises:
        BusError: SYNC is unexpected, or the bus fails.
        DriveError: a node is absent, refuses, or its frames are shorter than the joint file says.
    """
    section, passive = joints[0].bus, None
    if section.sync == "produce":
        refuse_foreign_sync(port, section, idle)
    if section.configure:
        configurator: Configurator | PassiveConfigurator = configure_joints(port, joints, folders, idle=idle)
    else:
        configurator = passive = PassiveConfigurator(joints, folders)
        _listen(port, passive, idle, patience_s)
    if section.sync == "follow":
        expected = _Expected(section.channel, passive.layouts.values() if passive is not None else ())
        configurator.bus = _timed(section, _await(port, expected, idle, patience_s, passive))
    return configurator


def _timed(section: BusSection, stamps_ns: Sequence[int]) -> BusSection:
    """Return the bus section with the measured period of the master's SYNC."""
    measured = measure_period(stamps_ns, section.period_s)
    if measured is None or measured.same:
        return section
    comes = f"{measured.period_s * 1e3:.4g} ms"
    level, text = logging.INFO, f"SYNC comes every {comes}"
    if "period_s" in section.model_fields_set:
        level, says = logging.WARNING, f"the joint file says {section.period_s * 1e3:g} ms: {comes} is used"
        text += f", {says}; set bus.period_s = {measured.period_s:.4g}, or leave it out"
    logger.log(level, "%s: %s", section.channel, text)
    return section.model_copy(update={"period_s": measured.period_s})


def _frames(port: BusPort, idle: Idle | None, seconds: float) -> Iterator[tuple[int, bytes, int]]:
    """CANopen frames and their stamps in ns, for so long; -1 if there is none."""
    for message in frames(port, seconds, idle):
        if message is None:
            yield -1, b"", 0
        elif is_canopen(message):
            yield message.arbitration_id, bytes(message.data), received_ns(message)


def _patiently(
    port: BusPort, idle: Idle | None, patience_s: float, lacking: Callable[[], str]
) -> Iterator[tuple[int, bytes, int]]:
    """Wait for the same without end; what is lacking after a while is said once."""
    yield from _frames(port, idle, patience_s)
    if text := lacking():
        logger.warning("waiting for another master: %s", text)
    yield from _frames(port, idle, math.inf)


def _listen(port: BusPort, passive: PassiveConfigurator, idle: Idle | None, patience_s: float) -> None:
    """Listen until the mapping of every node is known."""
    if not passive.busy:
        return
    heard = _Heard()

    def lacking() -> str:
        node, missing = next(iter(passive.missing.items()))
        return f"{missing}; {heard.of(node, patience_s)}"

    for cob_id, data, _ in _patiently(port, idle, patience_s, lacking):
        heard.feed(cob_id, data)
        _overhear(passive, cob_id, data)
        if not passive.busy:
            return


def _overhear(passive: PassiveConfigurator, cob_id: int, data: bytes) -> bool:
    """Process a frame; return whether it has changed the layout of a node."""
    now_s = time.monotonic()
    if cob_id >= 0:
        passive.feed(cob_id, data, now_s)
    return bool(passive.poll(now_s))


class _Heard:
    """Counts the frames that come while a node is waited for."""

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._states: dict[int, str] = {}

    def feed(self, cob_id: int, data: bytes) -> None:
        self._counts[cob_id] += 1
        if cob_id >> 7 == 0x700 >> 7 and len(data) == 1:
            self._states[cob_id & 0x7F] = f" ({nmt_state(data[0] & 0x7F)})"

    def of(self, node: int, seconds: float) -> str:
        """Return what was heard of a node."""
        counts, state = self._counts, self._states.get(node, "")
        pdos = sum(counts[base + node] for base in range(0x180, 0x580, 0x100))
        kinds = {"SYNC": counts[SYNC_COB_ID], f"heartbeats{state}": counts[0x700 + node]}
        kinds |= {"SDO requests to it": counts[0x600 + node], "PDOs of it": pdos}
        parts = ", ".join(f"{number or 'no'} {kind}" for kind, number in kinds.items())
        return f"heard in {seconds:g} s: {parts}"


class _Expected:
    """Frames required before the loop runs: SYNC, and the answers of every node."""

    def __init__(self, channel: str, layouts: Iterable[NodeLayout]) -> None:
        self.channel = channel
        self.synced = False
        self.heard = _Heard()
        self.expect(layouts)

    def expect(self, layouts: Iterable[NodeLayout]) -> None:
        """Require the answers of nodes with these layouts from now on."""
        self._frames = {
            tpdo.cob_id: (layout.node_id, tpdo.length)
            for layout in layouts
            for tpdo in layout.tpdos
            if 1 <= tpdo.transmission_type <= 240
        }

    @property
    def met(self) -> bool:
        return self.synced and not self._frames

    def feed(self, cob_id: int, data: bytes) -> None:
        self.heard.feed(cob_id, data)
        if cob_id == SYNC_COB_ID:
            self.synced = True
        elif cob_id in self._frames and self.synced:
            node, length = self._frames.pop(cob_id)
            if len(data) < length:
                raise DriveError(
                    f"node {node}: frame 0x{cob_id:03X} has {len(data)} bytes, expected {length}: "
                    "its mapping is not what the joint file says"
                )

    def lacking(self, patience_s: float) -> str:
        """Return what has not come; empty: nothing."""
        if self.met:
            return ""
        if not self.synced:
            return (
                f'no SYNC on {self.channel} in {patience_s:g} s: with bus.sync = "follow" another master '
                'must produce it; set bus.sync = "produce" if there is none'
            )
        cob_id, (node, _) = next(iter(self._frames.items()))
        return (
            f"node {node}: expected frame 0x{cob_id:03X} on SYNC; {self.heard.of(node, patience_s)}: "
            "has its master mapped and started it?"
        )


def _await(
    port: BusPort,
    expected: _Expected,
    idle: Idle | None,
    patience_s: float,
    passive: PassiveConfigurator | None = None,
) -> list[int]:
    """Listen until all expected frames have come; follow mapping changes meanwhile.

    Returns:
        Stamps of the last SYNCs, if possible enough to measure their period.
    """
    stamps: deque[int] = deque(maxlen=MEASURED_SYNCS)
    end_s = time.monotonic() + patience_s
    for cob_id, data, stamp_ns in _patiently(port, idle, patience_s, lambda: expected.lacking(patience_s)):
        if passive is not None and _overhear(passive, cob_id, data):
            expected.expect(passive.layouts.values())
        expected.feed(cob_id, data)
        if cob_id == SYNC_COB_ID:
            stamps.append(stamp_ns)
        if expected.met and (len(stamps) == MEASURED_SYNCS or time.monotonic() > end_s):
            break
    return list(stamps)
