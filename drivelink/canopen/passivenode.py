"""What is known of a node that another master configures: mapping, units, and whether to trust them."""

from collections.abc import Iterable
from dataclasses import replace

from drivelink.canopen import Address
from drivelink.canopen.eds import load_eds
from drivelink.canopen.layout import NodeLayout, Offer, Role, Signal
from drivelink.canopen.pdo import OPTIONAL, Tpdo, decode, describe, objects_of, tpdos_of
from drivelink.canopen.sdo import SdoSniffer, is_mapping, written_object
from drivelink.canopen.units import offer, unit_objects
from drivelink.canopen.vendors import VENDORS, vendor_of
from drivelink.errors import DriveError
from drivelink.jointfile import BusSection, TpdoSection
from drivelink.notice import Notice

_IDENTITY = tuple((0x1018, subindex) for subindex in (1, 2, 3, 4))
_STORED = ((0x1020, 1), (0x1020, 2))  # date and time of the configuration
_STORE_OR_RESTORE = (0x1010, 0x1011)
_VOLATILE = frozenset({(0x1005, 0), (0x1006, 0), (0x1017, 0), (0x1019, 0)})  # as after power-on
_MOST_TOLD = 16  # findings of a node that are told; one may come of each unit that its master writes
_MOST_ENTRIES = 8  # of a map whose objects are whole bytes


class PassiveNode:
    """Mapping of one node, and whether it is trusted.

    A mapping is trusted if it was written or read back since the node's last start, or if the joint file
    declares it: until the node restarts, or may have been mapped or have restarted out of sight; with
    `default = true` again from a restart that was heard on, until somebody stores or restores the node's
    parameters. A data sheet contains the factory setting, which may have changed, so it is only suggested.
    Another identity or date of the configuration than before ends trust.
    """

    def __init__(self, role: Role, bus: BusSection) -> None:
        self.role, self._bus = role, bus
        self._sheet = load_eds(role.eds, role.node_id) if role.eds is not None else None
        self._units = {address for vendor in VENDORS.values() for address in unit_objects(role, vendor)}
        followed = self._units.union(_VOLATILE, _IDENTITY, _STORED)
        self.listener = SdoSniffer(
            lambda *address: address[1] <= _MOST_ENTRIES if is_mapping(address) else address in followed,
            bus.sdo_timeout_s,
        )
        self.seen_changes = -1
        self.state = (-1, False)  # changes and `is_mapping` of the listener after its last frame
        self.adopted: NodeLayout | None = None
        self.restarted = False  # or it may have
        self.stored = False  # its own mapping may be another one than the joint file states
        self.lost = ""  # why it may have restarted
        self._identity: dict[Address, int] = {}
        self._offered: tuple[dict[Address, int], Offer | None] = {}, None  # by the units before it
        self.heard: dict[int, int] = {}  # lengths of frames with its predefined identifiers
        self._told: set[Notice] = set()

    def restart(self, lost: str = "") -> None:
        """Handle a boot-up: mapping and parameters are the node's defaults again.

        Args:
            lost: why there may have been one that was not heard.
        """
        self.restarted, self.adopted, self.lost = True, None, lost
        self.listener.forget(lambda address: is_mapping(address) or address in _VOLATILE)

    def request(self, data: bytes, now_s: float) -> None:
        """Process an SDO frame of the master."""
        if not self.stored:
            address = written_object(data)
            self.stored = address is not None and address[0] in _STORE_OR_RESTORE
        self.listener.request(data, now_s)

    def response(self, data: bytes, now_s: float) -> None:
        """Process an SDO frame of the node."""
        changes = self.listener.changes
        self.listener.response(data, now_s)
        if self.listener.changes != changes:
            self._check_identity()

    def _check_identity(self) -> None:
        """Compare identity and date of the configuration with what the node said before."""
        for address in (*_IDENTITY, *_STORED):
            value = self.listener.values.get(address)
            if value is not None and self._identity.setdefault(address, value) != value:
                self._identity[address], self.stored = value, True
                if address not in self.listener.written:
                    self.restart("it has another identity or date of configuration than before")

    def untold(self, notices: Iterable[Notice]) -> list[Notice]:
        """Return the findings that were not told before, while there are not too many."""
        untold = [one for one in notices if one not in self._told][: _MOST_TOLD - len(self._told)]
        self._told.update(untold)
        return untold

    def dispute(self) -> str:
        """Return one line on an object whose value is not known although it was transferred; empty: none."""
        if not self.listener.disputed:
            return ""
        index, subindex = min(self.listener.disputed)
        return (
            f"{self.role.subject} ({self.role.key}): the SDO transfer of 0x{index:04X}:{subindex:02X} has "
            "two different answers, or was given up: its frames are not used until the object is read or "
            "written again; does another device answer for it?"
        )

    def layout(self) -> tuple[NodeLayout, str]:
        """Return the best known layout, and why it is not trusted (empty: it is).

        Raises:
            DriveError: mapping or scale of a needed signal is unknown.
        """
        try:
            return self._layout(self._believed_tpdos()), ""
        except DriveError as error:
            if self.adopted is not None and not any(map(is_mapping, self.listener.written)):
                return replace(self.adopted, reported=self._reported(self.adopted)), ""
            sheet = self._sheet_tpdos()
            if not sheet:
                raise
            try:
                layout = self._layout(sheet)
            except DriveError:
                raise error from None
            return layout, self.doubt()

    def _reported(self, adopted: NodeLayout | None = None) -> tuple[tuple[Address, int], ...]:
        """Unit objects with their values, the heard ones first."""
        heard = {a: value for a, value in self.listener.values.items() if a in self._units}
        return tuple({**dict(adopted.reported if adopted is not None else ()), **heard}.items())

    def doubt(self) -> str:
        """Return one line on a mapping that is not trusted, with the remedy."""
        role = self.role
        if self.lost:
            why = f"{self.lost}, and its mapping was neither written nor read since"
        elif self.restarted and self.stored:
            why = "it has restarted after parameters were stored or restored (0x1010, 0x1011)"
        elif self.restarted:
            why = "it has restarted, and its mapping was neither written nor read since"
        elif self._sheet is not None:
            why = f"its mapping is that of {self._sheet.path.name}, which a master may have changed"
        else:
            why = "its mapping was neither written nor read"
        if any(section.default for section in role.tpdo):
            way_out = "" if self.stored else ", or the node starts anew"
        else:
            way_out = f"; if the node has it by itself, say so in the joint file: {self.offered()}"
        return (
            f"{role.subject} ({role.key}): {why}: its frames are not used until its master writes or reads "
            f"back the mapping{way_out}"
        )

    def offered(self) -> str:
        """Return TOML for the joint file that declares the mapping, from a data sheet if there is one."""
        if self.role.tpdo:
            return f"default = true in {self._keys()}"
        tpdos = self._sheet_tpdos()
        if not tpdos:
            return f"{self._keys()} with default = true"
        return f"in [{self._table()}] tpdo = [{', '.join(map(_toml, tpdos))}]"

    def _table(self) -> str:
        return f"{self.role.key.partition('[')[0]}{'.drive' if self.role.drive else ''}"

    def _keys(self) -> str:
        return f"[[{self._table()}.tpdo]]"

    def _layout(self, tpdos: tuple[Tpdo, ...]) -> NodeLayout:
        role = self.role
        values = {**(self._sheet.values() if self._sheet else {}), **self.listener.values}
        if self._sheet is not None and self._sheet.vendor_id:
            values.setdefault((0x1018, 1), self._sheet.vendor_id)
        offered = self._offer(values)
        for signal, reason in offered.missing.items() if tpdos else ():
            if signal not in OPTIONAL:
                raise DriveError(f"{role.subject} ({role.key}): {reason}")
        layouts = decode(tpdos, offered.readable)
        given = {mapped.signal for layout in layouts for mapped in layout.objects}
        lacking = [signal for signal in offered.candidates if signal not in given and signal not in OPTIONAL]
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
            reported=self._reported(),
            notices=tuple(offered.notices),
        )

    def _offer(self, values: dict[Address, int]) -> Offer:
        """Return what its units give: they change less often than its mapping."""
        units = {address: value for address, value in values.items() if not is_mapping(address)}
        before, offered = self._offered
        if offered is None or units != before:
            offered = offer(self.role, units, vendor_of(units.get((0x1018, 1), 0)))
            if self._sheet is not None:
                for problem in self._sheet.problems:
                    offered.info(self._sheet.path.name, problem)
            self._offered = units, offered
        return offered

    def _believed_tpdos(self) -> tuple[Tpdo, ...]:
        """TPDOs from the joint file, as far as still valid, and from the traffic."""
        seen = {address: value for address, value in self.listener.values.items() if is_mapping(address)}
        touched = {(index & 0x1FF) + 1 for index, _ in seen}
        stated, values = [], dict(seen)
        for section in self.role.tpdo:
            if self.restarted and (self.stored or self.lost or not section.default):
                continue
            tpdo, number = _declared(section), self._number(section, seen)
            if number not in touched:
                stated.append(tpdo)
                continue
            for address, value in objects_of(tpdo, number).items():
                values.setdefault(address, value)
        return _sent(stated + list(tpdos_of(values)))

    def _sheet_tpdos(self) -> tuple[Tpdo, ...]:
        if self._sheet is None:
            return ()
        seen = {address: value for address, value in self.listener.values.items() if is_mapping(address)}
        return _sent(tpdos_of({**self._sheet.values(), **seen}))

    def _number(self, section: TpdoSection, seen: dict[Address, int]) -> int:
        """Return the number of a TPDO that the joint file declares by its identifier; 0: unknown."""
        for (index, subindex), value in seen.items():
            if index < 0x1A00 and subindex == 1 and value & 0x7FF == section.cob_id:
                return index - 0x17FF
        number, node = divmod(section.cob_id - 0x80, 0x100)
        known = seen.get((0x17FF + number, 1))
        predefined = 1 <= number <= 4 and node == self.role.node_id
        return number if predefined and known is None else 0

    def _lacking(self, lacking: list[Signal], tpdos: tuple[Tpdo, ...]) -> str:
        role = self.role
        if tpdos:
            return (
                f"{role.subject} ({role.key}) sends no {' and no '.join(lacking)}: {describe(tpdos)}; "
                f"have its master map it, or correct {role.key}.tpdo"
            )
        if self.restarted:
            return self.doubt()
        heard = ", ".join(f"0x{cob_id:03X} ({length} bytes)" for cob_id, length in sorted(self.heard.items()))
        # With `configure` only a recorder listens, beside the daemon that is to write the mapping.
        master = "drivelink run" if self._bus.configure else "its master"
        return (
            f"{role.subject} ({role.key}): its mapping is not known: expected {master} to write it or read "
            f"it back while this listens, or {self._keys()} or eds in the joint file"
        ) + (f"; it sends {heard}" if heard else "")


def _sent(tpdos: Iterable[Tpdo]) -> tuple[Tpdo, ...]:
    """Return the enabled and known TPDOs, one per identifier."""
    found: dict[int, Tpdo] = {}
    for tpdo in tpdos:
        if tpdo.enabled and tpdo.known and 0x181 <= tpdo.cob_id <= 0x57F:
            found.setdefault(tpdo.cob_id, tpdo)
    return tuple(found.values())


def _toml(tpdo: Tpdo) -> str:
    objects = ", ".join(f'"0x{index:04X}:{subindex:02X}:{bits}"' for index, subindex, bits in tpdo.entries)
    timing = "" if tpdo.transmission_type == 1 else f", transmission_type = {tpdo.transmission_type}"
    return f"{{ cob_id = 0x{tpdo.cob_id:03X}, objects = [{objects}]{timing}, default = true }}"


def _declared(section: TpdoSection) -> Tpdo:
    objects = (text.split(":") for text in section.objects)
    entries = tuple((int(index, 16), int(subindex, 16), int(bits)) for index, subindex, bits in objects)
    kind = section.transmission_type
    return Tpdo(number=0, cob=section.cob_id, transmission_type=kind, entries=entries)
