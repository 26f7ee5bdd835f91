"""Keeps assemblers to mappings that are known: another master's, or the daemon's own; live or from a log.

The followers take the frames after the assemblers. From a frame that makes a mapping doubtful on, the node's
frames are not used. A mapping that is known again applies from a SYNC on: another master's from the next one,
the first that the node answers with it; the daemon's own from the first after the start of the node.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.configure import Configurator
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.sdo import is_mapping, written_object
from drivelink.cycle.objectcheck import Mismatch, ObjectCheck, RecentSamples
from drivelink.errors import DriveError

_START, _BOOT_UP = 0x01, b"\0"  # NMT
_SILENT_S = 0.5  # without a frame, after which a node may have restarted unheard
_LOOKS = 5  # in that time

Used = Callable[[int, NodeLayout], object]
"""Called with a node and its layout when that comes into use."""


class MapFollower:
    """Uses nodes by the mappings that their configurator knows.

    Another master's come from the traffic and have to be trusted. The daemon's own are used as they were
    configured; in a log of it, the configurator takes them from the traffic too.

    Args:
        configurator: knows the mappings.
        assemblers: of the nodes' joints.
        layouts: of the nodes, as in use.
        check: compares what the daemon's nodes say by SDO with what is in use; None: nothing is read back.
    """

    def __init__(
        self,
        configurator: Configurator | PassiveConfigurator,
        assemblers: Mapping[int, Assembler],
        layouts: Mapping[int, NodeLayout],
        used: Used = lambda _node, _layout: None,
        check: ObjectCheck | None = None,
    ) -> None:
        self._known = configurator
        self._assemblers = assemblers
        self._in_use = dict(layouts)
        self._used = used
        self._check = check
        self._due: dict[int, int] = {}  # nodes whose layout is to be used, and the SYNC after which
        self._syncs = 0
        self.refused: dict[int, str] = {}  # by node, why a mapping cannot be used
        for assembler in assemblers.values():
            assembler.supervise()
        if check is not None:
            for node, layout in layouts.items():
                check.watch(layout, assemblers[node])

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why."""
        return self.refused

    def feed(self, cob_id: int, data: bytes, now_s: float, ahead: int = 0) -> None:
        """Process a frame, in bus order.

        Args:
            now_s: time by any clock, for the SDO time-out.
            ahead: SYNCs that were sent before the frame, and come here after it.
        """
        if cob_id == SYNC_COB_ID:
            self.sync()
        elif cob_id == 0:
            if len(data) == 2 and data[0] == _START and data[1] in self._in_use:
                self._due[data[1]] = self._syncs + ahead
        elif cob_id > 0x700 and data == _BOOT_UP:
            self._due.pop(cob_id - 0x700, None)
        elif 0x580 < cob_id < 0x600:
            if self._check is not None:
                self._check.response(cob_id - 0x580, data, now_s)
            self._known.feed(cob_id, data, now_s)
        elif 0x600 < cob_id < 0x680:
            self._known.feed(cob_id, data, now_s)
            if self._check is not None:
                self._check.request(cob_id - 0x600, data, now_s)
            if self.unsettles(cob_id - 0x600, data):
                self._assemblers[cob_id - 0x600].distrust(cob_id - 0x600)

    def unsettles(self, node: int, data: bytes) -> str:
        """Return what an SDO frame of a master begins to write that its frames are read by; or nothing."""
        address, layout = written_object(data), self._in_use.get(node)
        if address is None or layout is None:
            return ""
        return "mapping" if is_mapping(address) else "units" if address in dict(layout.reported) else ""

    def sync(self) -> Sequence[Mismatch]:
        """Process a SYNC, after the assemblers: new mappings apply from here on.

        Returns:
            What nodes have said by SDO that contradicts what is in use.
        """
        self._syncs += 1
        found = self._check.sync() if self._check is not None else ()
        if self._due:
            for node in [node for node, before in self._due.items() if before < self._syncs]:
                del self._due[node]
                self._use(node)
        return found

    def _use(self, node: int) -> None:
        """Read a node's frames by its layout, if that is possible."""
        if isinstance(self._known, PassiveConfigurator):
            self._known.poll(0.0)
        layout, assembler = self._known.layouts[node], self._assemblers[node]
        if layout.tpdos != self._in_use[node].tpdos:
            try:
                assembler.relayout(layout)
            except DriveError as error:
                self.refused[node] = str(error)
                return
        self._in_use[node] = layout
        self.refused.pop(node, None)
        self._used(node, layout)
        if self._check is not None:
            self._check.watch(layout, assembler)
        self._trust(node)

    def _trust(self, node: int) -> None:
        self._assemblers[node].trust(node)


class PassiveFollower(MapFollower):
    """Uses the nodes of another master, while their mappings are trusted.

    Args:
        clock_may_be_set: a gap between SYNCs need not be silence, as in a log, which has one clock only.
    """

    def __init__(
        self,
        configurator: PassiveConfigurator,
        assemblers: Mapping[int, Assembler],
        layouts: Mapping[int, NodeLayout],
        used: Used = lambda _node, _layout: None,
        clock_may_be_set: bool = False,
    ) -> None:
        super().__init__(configurator, assemblers, layouts, used)
        self._clock_may_be_set = clock_may_be_set
        self.listener = configurator  # hears what the nodes and their master say
        self._silent = max(2 * _LOOKS, round(_SILENT_S / configurator.bus.period_s))  # SYNCs
        self._heard = dict.fromkeys(assemblers, (0, 0))  # frames of a node, and the SYNC of the last one
        self._speaking: set[int] = set()  # since the last look, other than by PDOs
        self._since_sync: Counter[int] = Counter()  # such frames of each node since the last SYNC
        self._joints = tuple(dict.fromkeys(assemblers.values()))
        self._numbers = {node: assembler.sequence for node, assembler in assemblers.items()}
        configurator.adopt(layout for node, layout in layouts.items() if node not in configurator.layouts)
        self._judge()
        self.sync()

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why."""
        return {**self.listener.doubts, **self.refused}

    def feed(self, cob_id: int, data: bytes, now_s: float, ahead: int = 0) -> None:
        """See `MapFollower.feed`."""
        if cob_id == SYNC_COB_ID:
            self.sync()
            return
        if cob_id > 0x700 or 0x580 < cob_id < 0x600:
            self._speaking.add(cob_id & 0x7F)
            self._since_sync[cob_id & 0x7F] += 1
        changed = self.listener.feed(cob_id, data, now_s)
        if changed or any(assembler.untrusted for assembler in self._joints):
            self.listener.poll(now_s)
            self._judge()

    def sync(self) -> Sequence[Mismatch]:
        """See `MapFollower.sync`."""
        self._check_silence()
        self._since_sync.clear()
        return super().sync()

    def lose_sight(self, nodes: Iterable[int] | None = None, why: str = "the bus was lost") -> None:
        """Handle a time in which nodes (None: all) may have restarted unheard."""
        self.listener.lose_sight(nodes, why)
        self.listener.poll(0.0)
        self._judge()

    def _trust(self, node: int) -> None:
        if node in self._assemblers[node].untrusted:
            super()._trust(node)

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
            if gap := number - before >= self._silent:  # no SYNC either; one frame may be as old as the last
                heard = self._clock_may_be_set or self._since_sync[node] > 1
            else:
                heard = node in self._speaking or received != frames
            if not heard and (gap or number - last >= max(self._silent, 3 * _slowest(self._in_use[node]))):
                silent.append(node)
                heard = True  # said once
            if heard:
                self._heard[node] = received, number
            self._speaking.discard(node)
        if silent:
            self.lose_sight(silent, f"no frame of it was heard for {_SILENT_S:g} s")

    def _judge(self) -> None:
        believed = self.listener.believed
        for node, assembler in self._assemblers.items():
            layout, before = self.listener.layouts[node], self._in_use[node]
            if node not in believed:
                self._due.pop(node, None)
                assembler.distrust(node)
            elif layout != before or node in assembler.untrusted:
                if layout.tpdos != before.tpdos:
                    assembler.distrust(node)
                self.refused.pop(node, None)
                self._due[node] = 0


def _slowest(layout: NodeLayout) -> float:
    """SYNCs between two frames of a node; infinite: it sends on events only."""
    every = [tpdo.transmission_type for tpdo in layout.tpdos if 1 <= tpdo.transmission_type <= 240]
    return min(every, default=math.inf)


def follow_log(configurator: PassiveConfigurator, assembler: Assembler, recent: RecentSamples) -> MapFollower:
    """Follow the mappings in a log of one joint as its daemon did.

    Args:
        recent: is given every sample, before the follower takes the frame that has completed it.
    """
    layouts, section = configurator.layouts, configurator.bus
    assemblers = dict.fromkeys(layouts, assembler)
    if not section.configure:
        return PassiveFollower(configurator, assemblers, layouts, clock_may_be_set=True)
    samples = dict.fromkeys(layouts, recent.after)
    check = ObjectCheck(section.sdo_timeout_s, samples) if section.read_back_s else None
    return MapFollower(configurator, assemblers, layouts, check=check)
