"""A CANopen slave: NMT state machine, and the services that depend on its state (CiA 301)."""

from collections.abc import Callable
from enum import IntEnum

from sim.canopen.dictionary import Abort, Dictionary, Entry, SdoAbortedError
from sim.canopen.edsfile import objects_of, with_head
from sim.canopen.pdo import COB_INVALID, Rpdo, Tpdo, restricted
from sim.canopen.profiles import Quirks
from sim.canopen.sdo import SdoServer
from sim.canopen.services import Emergency, HeartbeatConsumer, HeartbeatProducer, watch_storing
from sim.canopen.timers import Timers

_SYNC_PRODUCER = 1 << 30
_FRAME_29_BIT = 1 << 29
_APPLICATION = (0x2000, 0xFFFF)

_SYNC_LENGTH = 0x8240
_HEARTBEAT_LOST = 0x8130
_COMMUNICATION_ERROR = 0x10  # bit of the error register

Route = Callable[[bytes], None]


class Nmt(IntEnum):
    """NMT states as a heartbeat reports them."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PREOPERATIONAL = 0x7F


class Node:
    """One device on the bus; drives and encoders derive from it and override the `on_…` hooks."""

    # whether changed process data trigger types 254 and 255; if not, only the event timer does
    sends_on_change = True

    def __init__(self, node_id: int, sheet: str, quirks: Quirks) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node_id: expected 1 to 127, got {node_id}")
        self.node_id = node_id  # 1 to 127
        self.quirks = quirks
        self.sheet = sheet  # its EDS file's text
        self.dictionary = Dictionary(objects_of(sheet), node_id)  # live values
        self.timers = Timers()  # its appointments; the network moves their clock
        self.state = Nmt.INITIALISING  # NMT state
        self.sync_id = 0x80  # identifier of the SYNC it listens to
        self.routes: dict[int, Route] = {}  # handlers by identifier, besides NMT and SYNC
        self._put: Callable[[int, bytes], None] = lambda _can_id, _data: None
        self._rerouted: Callable[[], None] = lambda: None
        self._synchronous: tuple[Tpdo, ...] = ()
        self._change_driven: tuple[Tpdo, ...] = ()
        self._latched: tuple[Rpdo, ...] = ()
        self._counting = False  # SYNC messages are to carry a counter
        self._counter: int | None = None
        self._make_services()
        self._watch_objects()

    # Wiring to the network

    def attach(self, put: Callable[[int, bytes], None], rerouted: Callable[[], None]) -> None:
        """Connect to a network: how to send, and whom to notify of changed routes."""
        self._put = put
        self._rerouted = rerouted

    def eds(self, file_name: str) -> str:
        """Return the text of its EDS file."""
        name, product = (self.dictionary.find(*address).default for address in ((0x1008, 0), (0x1018, 2)))
        return with_head(self.sheet, file_name, bytes(name).decode(), int(product), self.quirks.name)

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame."""
        self._put(can_id, data)

    def _make_services(self) -> None:
        self.emergency, self.sdo = Emergency(self), SdoServer(self)
        self.heartbeat, self.consumer = HeartbeatProducer(self), HeartbeatConsumer(self)
        numbers = range(1, 513)
        # by number from 1
        self.tpdos = {n: Tpdo(self, n) for n in numbers if (0x17FF + n, 1) in self.dictionary}
        self.rpdos = {n: Rpdo(self, n) for n in numbers if (0x13FF + n, 1) in self.dictionary}

    def _watch_objects(self) -> None:
        find = self.dictionary.find
        find(0x1005, 0).check = self._check_sync_id
        find(0x1005, 0).changed = self._take_sync_id
        find(0x1014, 0).check = self._check_emergency_id
        overflow = self.dictionary.optional(0x1019)
        overflow.check = self._check_overflow
        overflow.changed = self.pdos_changed
        watch_storing(self.dictionary)

    # NMT

    def power_on(self) -> None:
        """Switch on: as after *reset node*."""
        self.reset_node()

    def power_off(self) -> None:
        """Switch off: silent from now on."""
        self._enter(Nmt.INITIALISING)
        self.timers.clear()
        self.routes = {}

    def nmt(self, command: int) -> None:
        """Obey an NMT command that addresses this node."""
        if self.state is Nmt.INITIALISING:
            return
        if command == 0x01:
            self._enter(Nmt.OPERATIONAL)
        elif command == 0x02:
            self._enter(Nmt.STOPPED)
        elif command == 0x80:
            self._enter(Nmt.PREOPERATIONAL)
        elif command == 0x81:
            self.reset_node()
        elif command == 0x82:
            self.reset_communication()

    def reset_node(self) -> None:
        """Restore power-on values everywhere, then boot."""
        self.dictionary.reset(*_APPLICATION)
        self._reset(keep_pdos=False)
        self.on_reset_node()

    def reset_communication(self) -> None:
        """Restore the communication profile's power-on values, then boot."""
        self._reset(keep_pdos=self.quirks.keeps_pdos)

    def _reset(self, keep_pdos: bool) -> None:
        self._enter(Nmt.INITIALISING)
        self.timers.clear()
        self.dictionary.reset(0x1000, 0x13FF)
        if not keep_pdos:
            self.dictionary.reset(0x1400, 0x1BFF)
        self.dictionary.reset(0x1C00, 0x1FFF)
        self.sdo.reset()
        self.emergency.reset()
        for pdo in (*self.tpdos.values(), *self.rpdos.values()):
            pdo.compile()
        self.consumer.restart()
        self._take_sync_id()
        if self.quirks.boot_s:
            self.timers.set("boot", self.quirks.boot_s, self._boot)
        else:
            self._boot()

    def _boot(self) -> None:
        self.send(0x700 + self.node_id, b"\0")
        self._enter(Nmt.PREOPERATIONAL)
        self.heartbeat.restart()
        if self.quirks.self_starting:
            self._enter(Nmt.OPERATIONAL)

    def _enter(self, state: Nmt) -> None:
        if state is self.state:
            return
        left, self.state = self.state, state
        self.pdos_changed()
        if left is Nmt.OPERATIONAL:
            self.on_leave_operational()

    @property
    def operational(self) -> bool:
        """Whether the NMT state is operational."""
        return self.state is Nmt.OPERATIONAL

    @property
    def may_send_emergency(self) -> bool:
        """Whether its NMT state has EMCY (CiA 301, table 37)."""
        return self.state in (Nmt.PREOPERATIONAL, Nmt.OPERATIONAL)

    def pdos_changed(self) -> None:
        """Apply changed PDO parameters, or another NMT state."""
        self._counting = self.dictionary.optional(0x1019).number > 0
        active = [pdo for pdo in self.tpdos.values() if self.operational and pdo.valid]
        received = [pdo for pdo in self.rpdos.values() if self.operational and pdo.valid]
        for pdo in (*self.tpdos.values(), *self.rpdos.values()):
            pdo.activate(self.operational and pdo.valid, self._counting)
        self._synchronous = tuple(pdo for pdo in active if pdo.synchronous)
        self.on_pdos(frozenset(entry for pdo in active for entry in pdo.entries if entry))
        self._change_driven = tuple(pdo for pdo in active if not pdo.synchronous and self.sends_on_change)
        self._latched = tuple(pdo for pdo in received if pdo.synchronous)
        self.reroute()
        if self._change_driven:
            self.timers.set("process", 0.0, self.process)

    def reroute(self) -> None:
        """Rebuild the table of which identifier it receives."""
        routes: dict[int, Route] = {}
        if self.may_send_emergency:
            routes[0x600 + self.node_id] = self.sdo.receive
        if self.operational:
            routes |= {rpdo.can_id: rpdo.receive for rpdo in self.rpdos.values() if rpdo.valid}
        for node_id in self.consumer.watched if self.state is not Nmt.INITIALISING else ():
            routes[0x700 + node_id] = self._heartbeat_route(node_id)
        self.routes = routes
        self._rerouted()

    # Services

    def _heartbeat_route(self, node_id: int) -> Route:
        return lambda _data: self.consumer.receive(node_id)

    def heartbeat_lost(self, node_id: int) -> None:
        """React to the loss of a monitored node's heartbeat."""
        self.emergency.raise_error(_HEARTBEAT_LOST, _COMMUNICATION_ERROR, bytes([node_id]))
        reaction = self.dictionary.optional(0x1029, 1).number
        if reaction == 0 and self.operational:
            self._enter(Nmt.PREOPERATIONAL)
        elif reaction == 2:
            self._enter(Nmt.STOPPED)
        self.on_connection_lost()

    def heartbeat_back(self) -> None:
        """Clear the error of a lost heartbeat."""
        self.emergency.clear_error(_HEARTBEAT_LOST)

    # SYNC

    def latch(self, data: bytes) -> bool:
        """Handle a SYNC: apply the values of synchronous RPDOs.

        Returns:
            Whether this node will answer with its TPDOs (`transmit`).
        """
        if not self.operational:
            return False
        self._counter = data[0] if data else None
        if len(data) > 1 or bool(data) != self._counting:
            self.emergency.raise_error(_SYNC_LENGTH, _COMMUNICATION_ERROR)
            return False
        if self.emergency.active:
            self.emergency.clear_error(_SYNC_LENGTH)
        for rpdo in self._latched:
            rpdo.apply()
        return True

    def transmit(self) -> None:
        """Sample at the instant of a SYNC, and send the due TPDOs."""
        self.on_sample()
        for tpdo in self._synchronous:
            tpdo.sync(self._counter)
        for tpdo in self._change_driven:
            tpdo.event()

    def process(self) -> None:
        """Advance without a SYNC: sample, and send event-driven TPDOs."""
        self.on_sample()
        for tpdo in self._change_driven:
            tpdo.event()

    def _take_sync_id(self) -> None:
        self.sync_id = self.dictionary.find(0x1005, 0).number & 0x7FF
        self._rerouted()

    def _check_sync_id(self, value: int) -> None:
        if value & (_SYNC_PRODUCER | _FRAME_29_BIT) or restricted(value & 0x7FF):
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _check_overflow(self, value: int) -> None:
        if self.dictionary.optional(0x1006).number:
            raise SdoAbortedError(Abort.DEVICE_STATE)
        if value == 1 or value > 240:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _check_emergency_id(self, value: int) -> None:
        if value & _FRAME_29_BIT or (not value & COB_INVALID and restricted(value & 0x7FF)):
            raise SdoAbortedError(Abort.INVALID_VALUE)

    # What a device does besides

    def on_pdos(self, mapped: frozenset[Entry]) -> None:
        """React to a change of the active TPDOs, which contain these entries."""

    def on_control(self, periods: int) -> None:
        """Control periods begin."""

    def on_sample(self) -> None:
        """Update the process data."""

    def on_reset_node(self) -> None:
        """React to a reset of the application."""

    def on_leave_operational(self) -> None:
        """React to leaving the NMT state operational."""

    def on_connection_lost(self) -> None:
        """React to the loss of a monitored node's heartbeat."""
