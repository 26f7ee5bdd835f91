"""Injects faults of devices and wires, at once or at a given SYNC."""

from collections.abc import Callable

from sim.canopen.drive import Cia402Drive
from sim.canopen.node import Node
from sim.canopen.pdo import Tpdo
from sim.network import Network
from sim.sensors import DriveSignals

Action = Callable[[], None]


class _Tap:
    """Sits between a TPDO and the bus."""

    def __init__(self, tpdo: Tpdo) -> None:
        self.mute = self.late = self.cut = self.twice = 0
        self.length = 0
        self._emit = tpdo.emit
        self._held: list[tuple[int, bytes]] = []
        tpdo.emit = self

    def __call__(self, can_id: int, data: bytes) -> None:
        held, self._held = self._held, []
        for frame in held:
            self._emit(*frame)
        if self.mute:
            self.mute -= 1
        elif self.late:
            self.late -= 1
            self._held.append((can_id, data))
        elif self.cut:
            self.cut -= 1
            self._emit(can_id, data.ljust(self.length, b"\0")[: self.length])
        else:
            self._emit(can_id, data)
            if self.twice:
                self.twice -= 1
                self._emit(can_id, data)


class Faults:
    """Injects faults into a network."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._taps: dict[tuple[Node, int], _Tap] = {}
        self._script: dict[int, list[Action]] = {}
        self._dropped = 0
        self._babble: tuple[int, bytes, int] | None = None
        network.sync_filter = self._sync

    def at(self, sync: int, action: Action) -> None:
        """Call `action` just before the devices see SYNC number `sync` (`Network.syncs`, from 1)."""
        self._script.setdefault(sync, []).append(action)

    # Devices

    def kill(self, node: Node) -> None:
        """Switch a device off without notice."""
        self._network.power_off(node)

    def revive(self, node: Node) -> None:
        """Switch it on again: boot-up message, power-on values."""
        self._network.power_on(node)

    def reboot(self, node: Node) -> None:
        """Reset the node: an unexpected boot-up message."""
        node.reset_node()

    def emergency(self, node: Node, code: int, register: int = 0, vendor: bytes = b"") -> None:
        """Raise a fault: EMCY, and the state fault of a drive."""
        if isinstance(node, Cia402Drive):
            node.fault(code, register, vendor)
        else:
            node.emergency.raise_error(code, register, vendor)

    def misread(self, node: Cia402Drive, lie: Callable[[DriveSignals], DriveSignals] | None) -> None:
        """Falsify its sensors from now on; None: correct readings again."""
        node.misread = lie

    def ignore_sdo(self, node: Node, requests: int) -> None:
        """Make its SDO server ignore so many requests."""
        node.sdo.ignored = requests

    def refuse_sdo(self, node: Node, code: int, requests: int) -> None:
        """Make its SDO server abort so many requests."""
        node.sdo.refusal, node.sdo.refused = code, requests

    def endless_sdo(self, node: Node, segment_bytes: int) -> None:
        """Make its SDO server answer uploads without end, so many bytes (0 to 7) at a time; -1: stop."""
        node.sdo.endless = segment_bytes

    def impostor(self, node: Node) -> None:
        """Add a device, also with a node id in use."""
        self._network.add(node)

    # Wires

    def unplug(self) -> None:
        """Unplug the cable: the devices go on, disconnected."""
        self._network.plugged = False

    def plug(self) -> None:
        """Plug the cable in again."""
        self._network.plugged = True

    # Frames

    def mute(self, node: Node, tpdo: int, cycles: int = 1) -> None:
        """Lose so many transmissions of a TPDO."""
        self._tap(node, tpdo).mute = cycles

    def delay(self, node: Node, tpdo: int, cycles: int = 1) -> None:
        """Delay so many transmissions of a TPDO until after the next SYNC, before that cycle's own."""
        self._tap(node, tpdo).late = cycles

    def resize(self, node: Node, tpdo: int, length: int, cycles: int = 1) -> None:
        """Send so many transmissions of a TPDO with a length of `length` bytes (0 to 8)."""
        tap = self._tap(node, tpdo)
        tap.length, tap.cut = length, cycles

    def repeat(self, node: Node, tpdo: int, cycles: int = 1) -> None:
        """Send so many transmissions of a TPDO twice."""
        self._tap(node, tpdo).twice = cycles

    def reverse(self) -> None:
        """Reverse the order in which the devices answer SYNC."""
        self._network.reverse()

    def babble(self, can_id: int, data: bytes = b"", per_cycle: int = 10) -> None:
        """Make a node send additional frames with every SYNC; `per_cycle` 0 stops it."""
        self._babble = (can_id, data, per_cycle) if per_cycle else None

    def drop_sync(self, count: int = 1) -> None:
        """Hide the next `count` SYNC messages from all devices."""
        self._dropped = count

    # Underneath

    def _tap(self, node: Node, number: int) -> _Tap:
        key = (node, number)
        if key not in self._taps:
            self._taps[key] = _Tap(node.tpdos[number])
        return self._taps[key]

    def _sync(self, _data: bytes) -> bool:
        for action in self._script.pop(self._network.syncs, ()):
            action()
        if self._babble:
            can_id, data, count = self._babble
            for _ in range(count):
                self._network.send(can_id, data)
        if self._dropped:
            self._dropped -= 1
            return False
        return True
