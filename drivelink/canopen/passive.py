"""Layouts of nodes that somebody else configures: from the joint file, a data sheet, or by listening.

Nothing is ever sent from here; there is nothing here to send with. Where several sources tell, the joint
file comes before what is overheard, and that before the EDS or DCF.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from drivelink.canopen.busload import BusLoad, bus_load
from drivelink.canopen.eds import load_eds
from drivelink.canopen.layout import NodeLayout, Signal
from drivelink.canopen.overheard import SdoListener
from drivelink.canopen.pdo import Tpdo, decode, describe, tpdos_of
from drivelink.canopen.plan import OPTIONAL
from drivelink.canopen.roles import Role, roles
from drivelink.canopen.units import offer, unit_objects
from drivelink.canopen.vendors import VENDORS, vendor_of
from drivelink.errors import BusError, DriveError
from drivelink.finding import Finding, Severity, log_findings
from drivelink.jointfile import BusSection, JointFile, TpdoSection

__all__ = ["PassiveConfigurator"]

logger = logging.getLogger(__name__)

Address = tuple[int, int]

_COMMUNICATION = frozenset(
    {(0x1005, 0), (0x1006, 0), (0x1017, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x1019, 0)}
)
_MOST_ENTRIES = 8  # of a map whose objects are whole bytes


class _PassiveNode:
    """What is known of one node."""

    def __init__(self, role: Role) -> None:
        self.role = role
        self._sheet = load_eds(role.eds, role.node_id) if role.eds is not None else None
        self._units = {
            address for vendor in VENDORS.values() for address in unit_objects(role, vendor)
        } | _COMMUNICATION
        self.listener = SdoListener(self._interesting)
        self.seen_changes = -1

    def _interesting(self, index: int, subindex: int) -> bool:
        if 0x1800 <= index <= 0x1BFF:
            return subindex <= _MOST_ENTRIES
        return (index, subindex) in self._units

    def layout(self) -> NodeLayout:
        """The layout, from all that is known.

        Raises:
            DriveError: mapping or scale of something needed is not known.
        """
        role = self.role
        values = {**(self._sheet.values() if self._sheet else {}), **self.listener.values}
        if self._sheet is not None and self._sheet.vendor_id:
            values.setdefault((0x1018, 1), self._sheet.vendor_id)
        told = offer(role, values, vendor_of(values.get((0x1018, 1), 0)))
        findings = list(told.findings)
        if self._sheet is not None:
            findings += [
                Finding(severity=Severity.INFO, subject=str(self._sheet.path.name), text=problem)
                for problem in self._sheet.problems
            ]
        tpdos = self._tpdos(values)
        for signal, reason in told.missing.items() if tpdos else ():
            if signal not in OPTIONAL:
                raise DriveError(f"{role.subject} ({role.key}): {reason}")
        layouts = decode(tpdos, told.candidates)
        given = {mapped.signal for layout in layouts for mapped in layout.objects}
        lacking = [signal for signal in told.candidates if signal not in given and signal not in OPTIONAL]
        if lacking or not tpdos:
            raise DriveError(self._lacking(lacking, tpdos))
        used = tuple(layout for layout in layouts if any(o.signal != Signal.OTHER for o in layout.objects))
        identity = [values.get((0x1018, subindex), 0) for subindex in (1, 2, 3, 4)]
        return NodeLayout(
            node_id=role.node_id,
            motor=role.motor,
            tpdos=used,
            other_tpdos=tuple(layout for layout in layouts if layout not in used),
            heartbeat_ms=self.listener.values.get((0x1017, 0), 0),
            identity=(identity[0], identity[1], identity[2], identity[3]),
            findings=tuple(findings),
        )

    def _tpdos(self, values: dict[Address, int]) -> tuple[Tpdo, ...]:
        if self.role.tpdo:
            return tuple(_declared(section) for section in self.role.tpdo)
        found: dict[int, Tpdo] = {}
        for tpdo in tpdos_of(values):
            if tpdo.enabled and 0x181 <= tpdo.cob_id <= 0x57F:
                found.setdefault(tpdo.cob_id, tpdo)
        return tuple(found.values())

    def _lacking(self, lacking: list[Signal], tpdos: tuple[Tpdo, ...]) -> str:
        role = self.role
        if tpdos:
            return (
                f"{role.subject} ({role.key}) sends no {' and no '.join(lacking)}: {describe(tpdos)}; "
                f"have its master map it, or correct {role.key}.tpdo"
            )
        return (
            f"{role.subject} ({role.key}): its mapping is not known: give [[{role.key.partition('[')[0]}"
            f"{'.drive' if role.drive else ''}.tpdo]] or eds in the joint file, "
            "or start drivelink before the master configures the drives"
        )


def _declared(section: TpdoSection) -> Tpdo:
    entries = []
    for text in section.objects:
        index, subindex, bits = text.split(":")
        entries.append((int(index, 16), int(subindex, 16), int(bits)))
    return Tpdo(
        number=0,
        cob=section.cob_id,
        transmission_type=section.transmission_type,
        entries=tuple(entries),
    )


class PassiveConfigurator:
    """The counterpart of `Configurator` for a bus that we may not touch; it has nothing to send with.

    Args:
        joints: joint files on this bus; the first one's bus section counts.
        base_dirs: their folders, for EDS files.

    Attributes:
        layouts: of the nodes that are known so far.
        missing: for the others, what is missing.
    """

    def __init__(self, joints: Sequence[JointFile], base_dirs: Sequence[Path] | None = None) -> None:
        self.bus: BusSection = joints[0].bus
        folders = base_dirs or [Path()] * len(joints)
        self._nodes: dict[int, _PassiveNode] = {}
        for joint, folder in zip(joints, folders, strict=True):
            for role in roles(joint, folder):
                if role.node_id in self._nodes:
                    raise BusError(f"node {role.node_id} is claimed by two joints on one bus")
                self._nodes[role.node_id] = _PassiveNode(role)
        self.layouts: dict[int, NodeLayout] = {}
        self.missing: dict[int, DriveError] = {}
        self.poll(0.0)

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node ids, in the order of the joint files."""
        return tuple(self._nodes)

    @property
    def busy(self) -> bool:
        """Whether the mapping of any node is still unknown."""
        return bool(self.missing)

    def adopt(self, layouts: Iterable[NodeLayout]) -> None:
        """Take layouts that are known from elsewhere; what is overheard later counts more."""
        for layout in layouts:
            if layout.node_id in self._nodes:
                self.layouts[layout.node_id] = layout
                self.missing.pop(layout.node_id, None)

    def start(self, node: int, *, stopped: bool = False) -> None:
        """Nothing: whoever configures this node will do it again."""

    def feed(self, cob_id: int, data: bytes, now_s: float) -> None:
        """Take a frame; SDO requests (0x601 to 0x67F) and responses (0x581 to 0x5FF) are of interest."""
        node = self._nodes.get(cob_id & 0x7F)
        if node is None:
            return
        if cob_id >> 7 == 0x600 >> 7:
            node.listener.request(data)
        elif cob_id >> 7 == 0x580 >> 7:
            node.listener.response(data)

    def poll(self, now_s: float) -> list[tuple[int, NodeLayout | DriveError]]:
        """Nodes whose layout became known or another one since the last call."""
        ended: list[tuple[int, NodeLayout | DriveError]] = []
        for node_id, node in self._nodes.items():
            if node.seen_changes == node.listener.changes:
                continue
            node.seen_changes = node.listener.changes
            try:
                layout = node.layout()
            except DriveError as error:
                # While a master rewrites the map there is none for a moment; the old one goes on until then.
                if node_id not in self.layouts:
                    self.missing[node_id] = error
                continue
            self.missing.pop(node_id, None)
            if self.layouts.get(node_id) != layout:
                self.layouts[node_id] = layout
                log_findings(logger, layout.findings)
                ended.append((node_id, layout))
        return ended

    def load(self) -> BusLoad:
        """Bus load of all that is known."""
        return bus_load(
            self.layouts.values(),
            period_s=self.bus.period_s,
            bitrate=self.bus.bitrate,
            sync_bytes=1 if self.bus.sync_counter_overflow else 0,
        )
