"""Layouts of nodes that another master configures: from the joint file, a data sheet, or by listening.

This module cannot send. Only traffic and joint file are trusted, the traffic first; see `PassiveNode`.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from drivelink.canopen.layout import BusLoad, NodeLayout, bus_load, roles_by_node
from drivelink.canopen.passivenode import PassiveNode
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection, JointFile
from drivelink.notice import log_notices

logger = logging.getLogger(__name__)

_NMT_RESETS = (0x81, 0x82)  # of the node, of its communication


class PassiveConfigurator:
    """The counterpart of `Configurator` for a passive daemon; it cannot send.

    Args:
        joints: joint files on this bus; the first one's bus section counts.
        judging: is called before each layout that is made of what was heard.
    """

    def __init__(
        self,
        joints: Sequence[JointFile],
        base_dirs: Sequence[Path] | None = None,
        judging: Callable[[], object] = lambda: None,
    ) -> None:
        self.bus: BusSection = joints[0].bus
        self._judging = judging
        self._nodes = {
            node: PassiveNode(role, self.bus) for node, role in roles_by_node(joints, base_dirs).items()
        }
        self.layouts: dict[int, NodeLayout] = {}  # of the nodes that are known so far
        self.missing: dict[int, DriveError] = {}  # for the others, what is missing
        # of the nodes in `layouts`, those whose layout is not trusted now: reason and remedy
        self.doubts: dict[int, str] = {}
        self.poll(0.0)

    @property
    def busy(self) -> bool:
        """Whether the mapping of any node is still unknown."""
        return bool(self.missing)

    @property
    def believed(self) -> frozenset[int]:
        """Nodes whose layout is known, trusted, and not being changed."""
        return frozenset(
            node
            for node in self.layouts
            if node not in self.doubts and not (node in self._nodes and self._nodes[node].listener.is_mapping)
        )

    def unasked(self, node: int) -> int:
        """Return SDO answers for a node that belong to no request heard; they are not used."""
        return self._nodes[node].listener.unasked

    def adopt(self, layouts: Iterable[NodeLayout]) -> None:
        """Adopt layouts from another source; later traffic has priority."""
        for layout in layouts:
            if (node := self._nodes.get(layout.node_id)) is not None:
                node.adopted = self.layouts[layout.node_id] = layout
                self.missing.pop(layout.node_id, None)
                self.doubts.pop(layout.node_id, None)

    def start(self, node: int, *, stopped: bool = False) -> None:
        """Do nothing: the node's master configures it again."""

    def lose_sight(self, nodes: Iterable[int] | None = None, why: str = "the bus was lost") -> None:
        """Handle a time in which nodes (None: all) may have restarted unheard."""
        for node in self._nodes if nodes is None else nodes:
            self._nodes[node].restart(why)

    def feed(self, cob_id: int, data: bytes, now_s: float) -> bool:
        """Process a frame: SDO, boot-up, NMT resets, PDOs.

        Args:
            now_s: time by any clock, for the SDO time-out.

        Returns:
            Whether layouts or trust in them may have changed.
        """
        if cob_id == 0:
            if len(data) == 2 and data[0] in _NMT_RESETS:
                for node_id, node in self._nodes.items():
                    if data[1] in (0, node_id):
                        node.restart()
            return len(data) == 2
        one = self._nodes.get(cob_id & 0x7F)
        if one is None:
            return False
        function = cob_id >> 7
        if function == 0x600 >> 7:
            one.request(data, now_s)
        elif function == 0x580 >> 7:
            one.response(data, now_s)
        elif function == 0x700 >> 7:
            if len(data) == 1 and data[0] & 0x7F == 0:
                one.restart()
        elif 0x180 >> 7 <= function <= 0x480 >> 7 and function & 1:
            if cob_id not in one.heard and one.role.node_id in self.missing:
                one.listener.changes += 1  # the message can be more specific now
            one.heard[cob_id] = len(data)
        before, one.state = one.state, (one.listener.changes, one.listener.is_mapping)
        return one.state != before

    def poll(self, now_s: float) -> list[tuple[int, NodeLayout | DriveError]]:
        """Return the nodes whose layout became known or changed since the last call."""
        ended: list[tuple[int, NodeLayout | DriveError]] = []
        for node_id, node in self._nodes.items():
            if node.seen_changes == node.listener.changes:
                continue
            node.seen_changes = node.listener.changes
            self._judging()
            try:
                layout, doubt = node.layout()
                doubt = node.dispute() or doubt
            except DriveError as error:
                # While a master changes the mapping there is none; the old layout is kept.
                if node_id not in self.layouts:
                    self.missing[node_id] = error
                else:
                    self.doubts[node_id] = str(error)
                continue
            self.missing.pop(node_id, None)
            self.doubts.pop(node_id, None)
            if doubt:
                self.doubts[node_id] = doubt
            before, self.layouts[node_id] = self.layouts.get(node_id), layout
            if layout != before:
                log_notices(logger, node.untold(layout.notices))
                ended.append((node_id, layout))
        return ended

    def load(self) -> BusLoad:
        """Return the bus load of all known TPDOs."""
        return bus_load(self.layouts.values(), self.bus)
