"""Follows mappings in the traffic: another master's, live or from a log, and in a log the daemon's own.

The followers take the frames after the assemblers. From a frame that makes a mapping doubtful on, the node's
frames are not used. Another master's mapping that is known again applies from the next SYNC on, the first one
that the node answers with it; the daemon's own from the first SYNC after the start of the node on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator, is_mapping
from drivelink.canopen.sdo_sniffer import written_object
from drivelink.cycle.objectcheck import ObjectCheck, RecentSamples, Samples
from drivelink.errors import DriveError

_START, _BOOT_UP = 0x01, b"\0"  # NMT
_SILENT_S = 0.5  # without a frame, after which a node may have restarted unheard
_LOOKS = 5  # in that time


class MapFollower:
    """Keeps the assemblers of passive joints to trusted mappings.

    Args:
        configurator: takes the mappings from the traffic; starts with the layouts given here.
        assemblers: of each node's joint.
        layouts: the present layouts.
        relaid: called when the set of identifiers in use has changed.

    Attributes:
        changed: by node, layouts that have come into use since this was last cleared.
        refused: by node, why a mapping taken from the traffic cannot be used.
    """

    def __init__(
        self,
        configurator: PassiveConfigurator,
        assemblers: Mapping[int, Assembler],
        layouts: Mapping[int, NodeLayout],
        relaid: Callable[[], object] = lambda: None,
    ) -> None:
        self._configurator = configurator
        self._assemblers = assemblers
        self._in_use = dict(layouts)
        self._trusted = dict.fromkeys(layouts, True)
        self._due: set[int] = set()
        self._relaid = relaid
        period_s = configurator.bus.period_s
        self._silent = max(2 * _LOOKS, round(_SILENT_S / period_s))  # SYNCs
        self._heard = dict.fromkeys(assemblers, (0, 0))  # frames used, and the SYNC of the last frame
        self._speaking: set[int] = set()  # since the last SYNC, other than by PDOs
        self._numbers = {node: assembler.sequence for node, assembler in assemblers.items()}
        self.changed: dict[int, NodeLayout] = {}
        self.refused: dict[int, str] = {}
        configurator.adopt(layout for node, layout in layouts.items() if node not in configurator.layouts)
        for assembler in assemblers.values():
            assembler.supervise()
        self._judge()
        self.sync()

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why."""
        return {**self._configurator.doubts, **self.refused}

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take a frame, in bus order; `now_s` as for `PassiveConfigurator.feed`."""
        if cob_id == SYNC_COB_ID:
            self.sync()
            return
        if cob_id > 0x700 or 0x580 < cob_id < 0x600:
            self._speaking.add(cob_id & 0x7F)
        self._configurator.feed(cob_id, data, now_s)
        self._configurator.poll(now_s)
        self._judge()

    def _look(self) -> None:
        """Doubt the nodes that were not heard for a while; every so many SYNCs, or after a gap."""
        silent = []
        for node, assembler in self._assemblers.items():
            number, before = assembler.sequence, self._numbers[node]
            if number - before < self._silent // _LOOKS:
                continue
            self._numbers[node] = number
            if number - before >= self._silent:  # nobody was heard, SYNC included: a clock that was set
                self._heard[node] = (
                    assembler.counters[node].received + assembler.counters[node].ignored,
                    number,
                )
                continue
            used, last = self._heard[node]
            counters = assembler.counters[node]
            received = counters.received + counters.ignored
            if node in self._speaking or (received != used and number - before < self._silent):
                self._heard[node] = received, number
            elif number - last >= max(self._silent, 3 * _slowest(self._in_use[node])):
                silent.append(node)
                self._heard[node] = received, number
            self._speaking.discard(node)
        if silent:
            self.lose_sight(silent, f"no frame of it was heard for {_SILENT_S:g} s")

    def sync(self) -> None:
        """Take a SYNC, after the assemblers: new mappings apply from here on."""
        self._look()
        for node in self._due:
            layout, assembler = self._configurator.layouts[node], self._assemblers[node]
            before, self._in_use[node] = self._in_use[node], layout
            if layout.tpdos != before.tpdos:
                try:
                    assembler.relayout(layout)
                except DriveError as error:
                    self._in_use[node], self.refused[node] = before, str(error)
                    continue
                self._relaid()
            if layout != before:
                self.changed[node] = layout
            if not self._trusted[node]:
                self._trusted[node] = True
                assembler.trust(node)
        self._due.clear()

    def unasked(self, node: int) -> int:
        """SDO answers for a node that belong to no request heard."""
        return self._configurator.unasked(node)

    def lose_sight(self, nodes: Iterable[int] | None = None, why: str = "the bus was lost") -> None:
        """Handle a time in which nodes (None: all) may have restarted unheard."""
        self._configurator.lose_sight(nodes, why)
        self._configurator.poll(0.0)
        self._judge()

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


class ConfigurationFollower:
    """Repeats from a log how a daemon that configures the nodes has used their frames.

    Args:
        configurator: takes the mappings from the traffic; starts with the layouts given here.
        assembler: of the joint.
        layouts: the present layouts.
        samples: the joint's samples after a SYNC, at most so many; None: the daemon read nothing back.
    """

    def __init__(
        self,
        configurator: PassiveConfigurator,
        assembler: Assembler,
        layouts: Mapping[int, NodeLayout],
        samples: Samples | None,
    ) -> None:
        self._configurator = configurator
        self._assembler = assembler
        self._in_use = dict(layouts)
        self._samples = samples
        self._check = ObjectCheck(configurator.bus.sdo_timeout_s)
        self._started: set[int] = set()  # since the last SYNC
        assembler.supervise()
        for node in self._in_use:
            self._watch(node)

    @property
    def doubts(self) -> dict[int, str]:
        """Nodes whose frames are not used, and why: none for long, the daemon configures them."""
        return {}

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take a frame, in bus order; `now_s` as for `PassiveConfigurator.feed`."""
        if cob_id == SYNC_COB_ID:
            self._check.sync()
            for node in self._started:
                self._begin(node)
            self._started.clear()
        elif cob_id == 0:
            if len(data) == 2 and data[0] == _START and data[1] in self._in_use:
                self._started.add(data[1])
        elif cob_id > 0x700 and data == _BOOT_UP:
            self._started.discard(cob_id - 0x700)
        elif 0x580 < cob_id < 0x600:
            self._configurator.feed(cob_id, data, now_s)
            self._check.response(cob_id - 0x580, data, now_s)
        elif 0x600 < cob_id < 0x680:
            self._configurator.feed(cob_id, data, now_s)
            self._check.request(cob_id - 0x600, data, now_s)
            address = written_object(data)
            if address is not None and is_mapping(address):
                self._assembler.distrust(cob_id - 0x600)

    def _begin(self, node: int) -> None:
        """Use a node that was started as it has been configured."""
        self._configurator.poll(0.0)
        layout = self._configurator.layouts[node]
        if layout.tpdos != self._in_use[node].tpdos:
            try:
                self._assembler.relayout(layout)
            except DriveError:  # the daemon has refused it, too
                return
        self._in_use[node] = layout
        self._watch(node)
        self._assembler.trust(node)

    def _watch(self, node: int) -> None:
        if self._samples is not None:
            units = dict(self._in_use[node].reported) | self._configurator.units(node)
            self._check.watch(self._in_use[node], units, self._assembler, self._samples)


def follow_log(
    configurator: PassiveConfigurator, assembler: Assembler, recent: RecentSamples
) -> MapFollower | ConfigurationFollower:
    """Follow the mappings in a log of one joint as its daemon did.

    Args:
        configurator: knows the mapping of every node.
        assembler: of the joint.
        recent: is given every sample, before the follower takes the frame that has completed it.
    """
    layouts = configurator.layouts
    if not configurator.bus.configure:
        return MapFollower(configurator, dict.fromkeys(layouts, assembler), layouts)
    samples = recent.after if configurator.bus.read_back_s else None
    return ConfigurationFollower(configurator, assembler, layouts, samples)
