"""Simulated devices on a CAN bus, and the world they measure, advanced by SYNC.

In lockstep the caller's thread calls `poll` after it has sent; every SYNC advances the world by exactly one
period, so results do not depend on the machine. Served by a thread (`start`), the world follows the wall
clock in whole periods locked to the SYNC, as a drive's control loop does. `Bench` is what stands on one bus.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence

import can

from sim.canopen.drive import Cia402Drive
from sim.canopen.node import Node
from sim.errors import SimError
from sim.world import World

_log = logging.getLogger(__name__)

_WITHOUT_SYNC_S = 0.05  # without a SYNC for so long, the wall clock advances the world
_LONGEST_CATCH_UP_S = 0.2
_PHASE_GAIN = 0.05  # of the lock of control periods to the SYNC
_SAME_SYNC = 0.8  # periods: a SYNC that is less late, after the earliest ones, is the next one
_DELAY_GAIN = 0.01  # of what is usual, where it grows: those of a stall of a few periods are not
_TICK_S = 0.005
_RETRY_S = 0.1


class Network:
    """Devices of one world on one bus.

    Args:
        bus: any python-can bus; the network does not shut it down.
        nodes: the devices, switched on in this order with the first poll.
        clock: monotonic seconds, for the devices' timers.
    """

    def __init__(
        self,
        bus: can.BusABC,
        nodes: Iterable[Node],
        *worlds: World,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.nodes = list(nodes)  # the devices, also those switched off
        self.syncs = 0  # SYNC messages seen, dropped ones included
        self.send_failures = 0  # frames that the bus did not take
        self.plugged = True  # for tests: whether the cable is plugged in
        # called with each SYNC's data; False drops it for all devices. For tests.
        self.sync_filter: Callable[[bytes], bool] | None = None
        self._bus = bus
        self._worlds = worlds
        self._period_s = worlds[0].period_s if worlds else 0.001
        self._alive: list[Node] = []
        self._routes: dict[int, tuple[Callable[[bytes], None], ...]] = {}
        self._sync_ids: frozenset[int] = frozenset()
        self._stale = True
        self._own: deque[tuple[int, bytes]] = deque()
        self._lockstep = True
        self._now_s = 0.0
        self._clock = clock
        self._wall_s = clock()
        self._sync_wall_s = self._wall_s - _WITHOUT_SYNC_S
        self._anchor_s = time.time()
        self._stamp_s = 0.0  # of the last SYNC
        self._delay_s = 0.0  # from the stamp of a SYNC until it is read, usually
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        for node in self.nodes:
            node.attach(self._sender(), self._reroute)
        self.send = self._sender()  # puts any frame (identifier, data) on the bus, for tests

    # Devices

    def add(self, node: Node) -> None:
        """Add a device, switched on at once."""
        node.attach(self._sender(), self._reroute)
        self.nodes.append(node)
        self.power_on(node)

    def reverse(self) -> None:
        """Make the devices answer SYNC in the opposite order."""
        self._alive.reverse()

    def power_on(self, node: Node | None = None) -> None:
        """Switch on one device, or all that are off."""
        for candidate in [node] if node else self.nodes:
            if candidate not in self._alive:
                self._alive.append(candidate)
                candidate.timers.now_s = self._now_s
                candidate.power_on()
        self._reroute()

    def power_off(self, node: Node) -> None:
        """Switch a device off, silently."""
        if node in self._alive:
            self._alive.remove(node)
            node.power_off()
        self._reroute()

    # Lockstep

    def poll(self) -> int:
        """Handle all waiting frames and due timers.

        Returns:
            How many frames were handled.
        """
        if not self._alive:
            self.power_on()
        handled = 0
        self._pass_time()
        recv = self._bus.recv
        while (message := recv(0)) is not None:
            self._receive(message)
            handled += 1
        self._run_timers()
        return handled

    # Served

    def start(self) -> None:
        """Serve the bus in a thread until `stop`."""
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(
                target=self.serve, args=(self._stop,), name="sim-network", daemon=True
            )
            self._thread.start()

    def stop(self) -> None:
        """End the thread; back within a few milliseconds."""
        if self._thread:
            self._stop.set()
            self._thread.join()
            self._thread = None

    def serve(self, stop: threading.Event) -> None:
        """Serve the bus in this thread until `stop` is set; retry after a bus error."""
        self._lockstep = False
        self._anchor_s = time.time()
        self.power_on()
        failing = False
        while not stop.is_set():
            try:
                message = self._bus.recv(_TICK_S)
                failing = False
            except (can.CanError, OSError) as error:
                if not failing:
                    _log.warning("the bus fails: %s", error)
                failing = True
                stop.wait(_RETRY_S)
                message = None
            self._pass_time(silent=message is None)
            if message is not None:
                self._receive(message)
                self._run_timers()
        self._lockstep = True

    # Frames

    def _sender(self) -> Callable[[int, bytes], None]:
        send, own = self._bus.send, self._own

        def put(can_id: int, data: bytes) -> None:
            if not self.plugged:
                return
            message = can.Message(arbitration_id=can_id, is_extended_id=False)
            # Bytes, not the usual bytearray: the virtual bus deep-copies, and this halves its time.
            message.data, message.dlc = data, len(data)  # type: ignore[assignment]
            try:
                send(message)
            except (can.CanError, OSError):
                self.send_failures += 1
            if can_id in self._routes:
                own.append((can_id, data))

        return put

    def _reroute(self) -> None:
        self._stale = True

    def _rebuild(self) -> None:
        routes: dict[int, list[Callable[[bytes], None]]] = {}
        for node in self._alive:
            for can_id, handler in node.routes.items():
                routes.setdefault(can_id, []).append(handler)
        self._routes = {can_id: tuple(handlers) for can_id, handlers in routes.items()}
        self._sync_ids = frozenset(node.sync_id for node in self._alive)
        self._stale = False

    def _receive(self, message: can.Message) -> None:
        if message.is_extended_id or message.is_remote_frame or message.is_error_frame or not self.plugged:
            return
        if self._stale:
            self._rebuild()
        can_id = message.arbitration_id
        if can_id in self._sync_ids:
            self._sync(can_id, bytes(message.data), message.timestamp)
        elif can_id == 0:
            self._nmt(bytes(message.data))
        else:
            for handler in self._routes.get(can_id, ()):
                handler(bytes(message.data))
        if self._own:
            self._deliver_own()

    def _deliver_own(self) -> None:
        """Deliver a device's frames to the other devices."""
        while self._own:
            can_id, data = self._own.popleft()
            for handler in self._routes.get(can_id, ()):
                handler(data)

    def _nmt(self, data: bytes) -> None:
        if len(data) < 2:
            return
        for node in list(self._alive):
            if data[1] in (0, node.node_id):
                node.nmt(data[0])

    # Time

    def _sync(self, can_id: int, data: bytes, stamp_s: float) -> None:
        self.syncs += 1
        if self.sync_filter and not self.sync_filter(data):
            return
        self._sync_wall_s = self._clock()
        answering = [node for node in self._alive if node.sync_id == can_id and node.latch(data)]
        stamp_s = stamp_s or time.time()
        self._advance(1 if self._lockstep else self._periods(stamp_s))
        for node in answering:
            # In time or not at all: later it would be taken for the answer to the next SYNC.
            if self._lockstep or time.time() - stamp_s < self._delay_s + self._period_s:
                node.transmit()

    def _periods(self, stamp_s: float) -> int:
        """Whole control periods since the last SYNC, phase-locked to it."""
        since_s, self._stamp_s = stamp_s - self._stamp_s, stamp_s
        delay_s = time.time() - stamp_s
        self._delay_s = min(delay_s, self._delay_s + _DELAY_GAIN * (delay_s - self._delay_s))
        if not -_LONGEST_CATCH_UP_S < since_s < _LONGEST_CATCH_UP_S:
            self._anchor_s = stamp_s  # the clock has jumped, or there was no SYNC for long
            self._delay_s = delay_s
            return 1
        late_s = stamp_s - self._anchor_s
        periods = max(1, int(late_s / self._period_s + 1.0 - _SAME_SYNC))
        late_s -= periods * self._period_s
        # A SYNC may be late, none is early: the phase is that of the earliest, and follows the others slowly.
        self._anchor_s = stamp_s - (1.0 - _PHASE_GAIN) * max(late_s, 0.0)
        return periods

    def _advance(self, periods: int) -> None:
        for node in self._alive:
            node.on_control(periods)
        for world in self._worlds:
            world.advance(periods)
        if self._lockstep:
            self._now_s += periods * self._period_s
            self._run_timers()

    def _pass_time(self, silent: bool = True) -> None:
        """Advance the devices' clocks: by SYNC in lockstep, else by the wall clock (`silent`: none waits)."""
        wall_s = self._clock()
        elapsed_s, self._wall_s = wall_s - self._wall_s, wall_s
        silent = silent and wall_s - self._sync_wall_s > _WITHOUT_SYNC_S
        if silent or not self._lockstep:
            self._now_s += elapsed_s
            self._run_timers()
        if silent and not self._lockstep:
            self._drift()

    def _drift(self) -> None:
        """Advance the world by the wall clock, without SYNC."""
        stamp_s = time.time()
        late_s = stamp_s - self._anchor_s
        if not 0.0 <= late_s < _LONGEST_CATCH_UP_S:
            self._anchor_s = stamp_s
            return
        periods = int(late_s / self._period_s)
        if periods:
            self._anchor_s += periods * self._period_s
            self._advance(periods)
            for node in self._alive:
                node.process()

    def _run_timers(self) -> None:
        if self._stale:
            self._rebuild()
        now_s = self._now_s
        for node in self._alive:
            timers = node.timers
            timers.now_s = now_s
            if timers.next_s <= now_s:
                timers.run(now_s)
        if self._own:
            self._deliver_own()


class Bench:
    """Several joints on one bus.

    Raises:
        SimError: two devices have the same node id.
    """

    def __init__(
        self, names: Sequence[str], worlds: Sequence[World], nodes: Sequence[Sequence[Node]]
    ) -> None:
        self._groups = list(zip(names, nodes, strict=True))
        self.worlds = tuple(worlds)
        self.nodes = tuple(node for group in nodes for node in group)
        ids = [node.node_id for node in self.nodes]
        for node_id in ids:
            if ids.count(node_id) > 1:
                raise SimError(f"expected a node id of its own for each device, got {node_id} twice")

    def network(self, bus: can.BusABC) -> Network:
        """Return all devices on a bus."""
        return Network(bus, self.nodes, *self.worlds)

    def serve(self, bus: can.BusABC, stop: threading.Event) -> None:
        """Serve the bus in this thread until `stop` is set."""
        self.network(bus).serve(stop)

    def devices(self) -> dict[str, dict[str, list[int]]]:
        """Return node ids of the drives and encoders, by joint."""
        found: dict[str, dict[str, list[int]]] = {}
        for name, group in self._groups:
            kinds = found.setdefault(name, {"drive": [], "encoder": []})
            for node in group:
                kinds["drive" if isinstance(node, Cia402Drive) else "encoder"].append(node.node_id)
        return found

    def describe(self) -> str:
        """Return joints and node ids, for messages."""
        joints = []
        for name, kinds in self.devices().items():
            nodes = (f"{kind} {node_id}" for kind, ids in kinds.items() for node_id in ids)
            joints.append(f"{name} ({', '.join(nodes)})")
        return "; ".join(joints)

    def eds(self) -> dict[str, str]:
        """Return the EDS file of every device by its name."""
        files = {f"{name}-node{node.node_id}.eds": node for name, group in self._groups for node in group}
        return {file: node.eds(file) for file, node in files.items()}
