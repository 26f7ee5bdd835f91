"""Keeps assemblers to mappings that are known: another master's, or the daemon's own; live or from a log.

The followers take the frames after the assemblers. From a frame that makes a mapping doubtful on, the node's
frames are not used. A mapping that is known again applies from a SYNC on: another master's from the next one,
the first that the node answers with it; the daemon's own from the first after the start of the node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.configure import Configurator
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.sdo_sniffer import is_mapping, written_object
from drivelink.cycle.objectcheck import Mismatch, ObjectCheck, RecentSamples
from drivelink.errors import DriveError

_START, _BOOT_UP = 0x01, b"\0"  # NMT
_SILENT_S = 0.5  # without a frame, after which a node may have restarted unheard
_LOOKS = 5  # in that time

Used = Callable[[int, NodeLayout], object]
"""Called with a node and its layout when that comes into use."""


class MapFollower:
    """Common part of the two followers."""

    def __init__(
        self, assemblers: Mapping[int, Assembler], layouts: Mapping[int, NodeLayout], used: Used
    ) -> None:
        self._assemblers = assemblers
        self._in_use = dict(layouts)
        self._used = used
        self.refused: dict[int, str] = {}  # by node, why a mapping cannot be used
        for assembler in assemblers.values():
            assembler.supervise()

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why."""
        return {}

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take a frame, in bus order; `now_s` as for `PassiveConfigurator.feed`."""
        raise NotImplementedError

    def sync(self) -> Sequence[Mismatch]:
        """Take a SYNC, after the assemblers: new mappings apply from here on.

        Returns:
            What nodes have said by SDO that contradicts what is in use.
        """
        raise NotImplementedError

    def _use(self, node: int, layout: NodeLayout) -> bool:
        """Read a node's frames by a layout; return whether that is possible."""
        before = self._in_use[node]
        if layout.tpdos != before.tpdos:
            try:
                self._assemblers[node].relayout(layout)
            except DriveError as error:
                self.refused[node] = str(error)
                return False
        self._in_use[node] = layout
        self.refused.pop(node, None)
        return True


class PassiveFollower(MapFollower):
    """Keeps the assemblers of passive joints to trusted mappings.

    Args:
        configurator: takes the mappings from the traffic; starts with the layouts given here.
    """

    def __init__(
        self,
        configurator: PassiveConfigurator,
        assemblers: Mapping[int, Assembler],
        layouts: Mapping[int, NodeLayout],
        used: Used = lambda _node, _layout: None,
    ) -> None:
        super().__init__(assemblers, layouts, used)
        self._configurator = configurator
        self._trusted = dict.fromkeys(layouts, True)
        self._due: set[int] = set()
        self._silent = max(2 * _LOOKS, round(_SILENT_S / configurator.bus.period_s))  # SYNCs
        self._heard = dict.fromkeys(assemblers, (0, 0))  # frames of a node, and the SYNC of the last one
        self._speaking: set[int] = set()  # since the last look, other than by PDOs
        self._numbers = {node: assembler.sequence for node, assembler in assemblers.items()}
        configurator.adopt(layout for node, layout in layouts.items() if node not in configurator.layouts)
        self._judge()
        self.sync()

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why."""
        return {**self._configurator.doubts, **self.refused}

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """See `MapFollower.feed`."""
        if cob_id == SYNC_COB_ID:
            self.sync()
            return
        if cob_id > 0x700 or 0x580 < cob_id < 0x600:
            self._speaking.add(cob_id & 0x7F)
        self._configurator.feed(cob_id, data, now_s)
        self._configurator.poll(now_s)
        self._judge()

    def sync(self) -> Sequence[Mismatch]:
        """See `MapFollower.sync`."""
        self._check_silence()
        for node in self._due:
            layout, before = self._configurator.layouts[node], self._in_use[node]
            if not self._use(node, layout):
                continue
            if layout != before:
                self._used(node, layout)
            if not self._trusted[node]:
                self._trusted[node] = True
                self._assemblers[node].trust(node)
        self._due.clear()
        return ()

    def unasked(self, node: int) -> int:
        """Return SDO answers for a node that belong to no request heard."""
        return self._configurator.unasked(node)

    def lose_sight(self, nodes: Iterable[int] | None = None, why: str = "the bus was lost") -> None:
        """Handle a time in which nodes (None: all) may have restarted unheard."""
        self._configurator.lose_sight(nodes, why)
        self._configurator.poll(0.0)
        self._judge()

    def _check_silence(self) -> None:
        """Doubt the nodes that were not heard for a while; every so many SYNCs, or after a gap."""
        silent = []
        for node, assembler in self._assemblers.items():
            number, before = assembler.sequence, self._numbers[node]
            if number - before < self._silent // _LOOKS:
                continue
            self._numbers[node] = number
            counters, (frames, last) = assembler.counters[node], self._heard[node]
            received = counters.received + counters.ignored
            gap = number - before >= self._silent  # nobody was heard, SYNC included: a clock that was set
            if gap or node in self._speaking or received != frames:
                self._heard[node] = received, number
            elif number - last >= max(self._silent, 3 * _slowest(self._in_use[node])):
                silent.append(node)
                self._heard[node] = received, number
            if not gap:
                self._speaking.discard(node)
        if silent:
            self.lose_sight(silent, f"no frame of it was heard for {_SILENT_S:g} s")

    def _judge(self) -> None:
        believed = self._configurator.believed
        for node, assembler in self._assemblers.items():
            if node not in believed:
                self._due.discard(node)
                self._trusted[node] = False
                assembler.distrust(node)
            elif not self._trusted[node] or self._configurator.layouts[node] != self._in_use[node]:
                if self._configurator.layouts[node].tpdos != self._in_use[node].tpdos:
                    self._trusted[node] = False
                    assembler.distrust(node)
                self.refused.pop(node, None)
                self._due.add(node)


def _slowest(layout: NodeLayout) -> float:
    """SYNCs between two frames of a node; infinite: it sends on events only."""
    every = [tpdo.transmission_type for tpdo in layout.tpdos if 1 <= tpdo.transmission_type <= 240]
    return min(every, default=math.inf)


class OwnFollower(MapFollower):
    """Uses the nodes as the daemon has configured them.

    Args:
        configurator: the daemon's, or in a log one that takes the mappings from the traffic.
        check: compares what the nodes say by SDO with what is in use; None: nothing was read back.
    """

    def __init__(
        self,
        configurator: Configurator | PassiveConfigurator,
        assemblers: Mapping[int, Assembler],
        layouts: Mapping[int, NodeLayout],
        used: Used,
        check: ObjectCheck | None,
    ) -> None:
        super().__init__(assemblers, layouts, used)
        self._configurator = configurator
        self._check = check
        self._syncs = 0
        self._started: dict[int, int] = {}  # nodes, and the SYNC before their start

    def feed(self, cob_id: int, data: bytes, now_s: float, ahead: int = 0) -> None:
        """See `MapFollower.feed`.

        Args:
            now_s: time by any clock, for the SDO time-out.
            ahead: SYNCs that were sent before the frame, and come here after it.
        """
        if cob_id == SYNC_COB_ID:
            self.sync()
        elif cob_id == 0:
            if len(data) == 2 and data[0] == _START and data[1] in self._in_use:
                self._started[data[1]] = self._syncs + ahead
        elif cob_id > 0x700 and data == _BOOT_UP:
            self._started.pop(cob_id - 0x700, None)
        elif 0x580 < cob_id < 0x600:
            if self._check is not None:
                self._check.response(cob_id - 0x580, data, now_s)
            self._configurator.feed(cob_id, data, now_s)
        elif 0x600 < cob_id < 0x680:
            self._configurator.feed(cob_id, data, now_s)
            if self._check is not None:
                self._check.request(cob_id - 0x600, data, now_s)
            address, assembler = written_object(data), self._assemblers.get(cob_id - 0x600)
            if address is not None and is_mapping(address) and assembler is not None:
                assembler.distrust(cob_id - 0x600)

    def sync(self) -> Sequence[Mismatch]:
        """See `MapFollower.sync`."""
        self._syncs += 1
        found = self._check.sync() if self._check is not None else ()
        for node in [node for node, before in self._started.items() if before < self._syncs]:
            del self._started[node]
            self._begin(node)
        return found

    def _begin(self, node: int) -> None:
        """Use a node that was started as it has been configured."""
        if isinstance(self._configurator, PassiveConfigurator):
            self._configurator.poll(0.0)
        layout = self._configurator.layouts[node]
        if self._use(node, layout):
            self._used(node, layout)
            self._assemblers[node].trust(node)


def follow_log(configurator: PassiveConfigurator, assembler: Assembler, recent: RecentSamples) -> MapFollower:
    """Follow the mappings in a log of one joint as its daemon did.

    Args:
        recent: is given every sample, before the follower takes the frame that has completed it.
    """
    layouts, section = configurator.layouts, configurator.bus
    assemblers = dict.fromkeys(layouts, assembler)
    if not section.configure:
        return PassiveFollower(configurator, assemblers, layouts)
    check = ObjectCheck(section.sdo_timeout_s) if section.read_back_s else None

    def watch(node: int, layout: NodeLayout) -> None:
        if check is not None:
            units = dict(layout.reported) | configurator.units(node)
            check.watch(layout, units, assembler, recent.after)

    for node, layout in layouts.items():
        watch(node, layout)
    return OwnFollower(configurator, assemblers, layouts, watch, check)
