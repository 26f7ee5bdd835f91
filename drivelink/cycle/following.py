"""Follows mappings that another master writes, to decode the samples of a passive daemon.

It receives the frames after the assemblers, live or from a log. From a frame that makes a mapping doubtful
on, the node's frames are not used; a mapping that is known again applies from the next SYNC on, the first one
that the node answers with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.layout import NodeLayout
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.errors import DriveError

__all__ = ["MapFollower"]


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
        self._configurator.feed(cob_id, data, now_s)
        self._configurator.poll(now_s)
        self._judge()

    def sync(self) -> None:
        """Take a SYNC, after the assemblers: new mappings apply from here on."""
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

    def lose_sight(self) -> None:
        """Handle a loss of the bus: knowledge from the traffic may be out of date."""
        self._configurator.lose_sight()
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
