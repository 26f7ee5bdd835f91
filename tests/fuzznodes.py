"""The slaves on the bus that lies: each value identifies the SYNC it was sampled at, and one of them is a trap."""

from dataclasses import replace

from simkit import StubRig

from sim.canopen.drive import Cia402Drive
from sim.canopen.encoder import Cia406Encoder
from sim.canopen.profiles import profile
from sim.sensors import DriveSignals, LinkEncoder

NO_RTR = 1 << 30
_TRAP = {  # default TPDO1 of node 1: identifier and length of ours, at every SYNC, and it means else
    (0x1800, 1): NO_RTR | 0x181, (0x1800, 2): 1, (0x1A00, 0): 3,
    (0x1A00, 1): 0x606C0020, (0x1A00, 2): 0x60770010, (0x1A00, 3): 0x60410010,
}  # fmt: skip


class FuzzNode:
    """One simulated device: a drive, or as node 3 the encoder; all but node 2 start by themselves."""

    def __init__(self, node: int) -> None:
        self.node = node
        self._rig = rig = StubRig(encoder=LinkEncoder(counts_per_rev=65536))
        rig.drive = lambda _motor: DriveSignals(3 * rig.tick + 1000 * node, 1e9, 0.5, 1e-3 * (rig.tick % 30))
        rig.link_counts = lambda: 5 * rig.tick + 7
        quirks = replace(profile("strict"), self_starting=node != 2)
        if node == 3:
            self.device = Cia406Encoder(3, rig, quirks, range_counts=1 << 24)
        else:
            self.device = Cia402Drive(node, rig, node - 1, quirks)
        for address, value in _TRAP.items() if node == 1 else ():
            self.device.dictionary.find(*address).default = value
        self._sent: list[tuple[int, bytes]] = []
        self.device.attach(lambda cob_id, data: self._sent.append((cob_id, data)), lambda: None)
        self.reset()

    def reset(self) -> None:
        """As after power-on, unheard."""
        self.device.power_on()
        self._sent.clear()

    def put(self, values: dict[tuple[int, int], int]) -> None:
        """Give objects other values, unasked."""
        for address, value in values.items():
            self.device.dictionary.find(*address).value = value
        for tpdo in self.device.tpdos.values():
            tpdo.compile()

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """A frame in, and what it answers."""
        if cob_id == 0:
            if len(data) == 2 and data[1] in (0, self.node):
                self.device.nmt(data[0])
        elif cob_id in self.device.routes:
            self.device.routes[cob_id](data)
        return self._said()

    def answer(self, tick: int) -> list[tuple[int, bytes]]:
        """Its TPDOs for one SYNC, by its own map, and what is due by then."""
        self._rig.tick, self.device.timers.now_s = tick, tick * 1e-3
        self.device.timers.run(tick * 1e-3)
        if self.device.latch(b""):
            self.device.transmit()
        return self._said()

    def _said(self) -> list[tuple[int, bytes]]:
        said, self._sent = self._sent, []
        return said
