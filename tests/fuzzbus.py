"""A bus that lies: three simulated slaves, one of them a trap, and everything between them and the daemon.

No clock, no thread, no plant: each slave's values identify the SYNC they were sampled at, so that every published
sample can be compared with it. What the fuzzer does to the frames comes in two strengths:

*Faulty*: what wires, queues, gateways, other masters and confused nodes do. Frames are lost, late, doubled,
cut, in another order; nodes are reset, stopped, started by others; frames of any identifier and content come in
between. Then no estimate may be VALID and wrong. One thing nobody can detect: a forged frame that is
right in identifier and length and comes first in its cycle. Those are counted, not judged.

*Hostile*: answers of the SDO server are forged too, so that even the configuration may be wrong. Then there
must be no exception, and an end.
"""

import random
import struct
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import can
from simkit import StubRig

from drivelink.cycle.sources import CanFrame
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


def _message(cob_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)


Mix = tuple[float, float, float]

# Shares of what comes in between, added up: anything at all, frames seen before, services; the rest: SYNC, NMT.
MIXES: tuple[Mix, ...] = (
    (1.0, 1.0, 1.0),
    (0.98, 1.0, 1.0),
    (0.9, 0.99, 1.0),
    (0.95, 0.97, 0.995),
    (0.97, 0.98, 0.99),
    (0.2, 0.4, 0.8),
)


class FuzzBus:
    """The slaves, the wire and the fuzzer, as the loop sees a bus (`FrameSource`) and as configuration does."""

    def __init__(self, generator: random.Random, *, hostile: bool) -> None:
        self.nodes = [FuzzNode(node) for node in (1, 2, 3)]
        self.errors: dict[str, int] = {}
        self.lost_sends = self.tick = self.frames = self._stamp_ns = 0
        self.rate, self.mix = 0.0, MIXES[0]
        self.kinds: Counter[str] = Counter()
        self.forged: deque[set[tuple[int, int]]] = deque([set(), set()], maxlen=2)  # (identifier, length)
        self._hostile = hostile
        self._random = generator
        self._queue: deque[tuple[int, bytes]] = deque()
        self._late: list[tuple[int, bytes]] = []
        self._recent: deque[tuple[int, bytes]] = deque(maxlen=64)

    @property
    def wire(self) -> Any:
        """As configuration sees it before the loop runs."""
        take = lambda _timeout=None: _message(*self._queue.popleft()) if self._queue else None  # noqa: E731
        return SimpleNamespace(send=lambda msg, _: self.send(msg.arbitration_id, bytes(msg.data)), recv=take)

    # FrameSource

    def wait(self, timeout_s: float) -> bool:
        return bool(self._queue)

    def narrow(self, cob_ids: Iterable[int]) -> None:
        pass

    def receive(self) -> list[CanFrame]:
        taken = [CanFrame(cob_id, data, self._stamp_ns) for cob_id, data in self._queue]
        self._queue.clear()
        self.frames += len(taken)
        return taken

    def lead(self, stamp_ns: int) -> None:
        """Somebody else makes SYNC, mostly in time."""
        draw = self._random
        if draw.random() < 0.99:
            late_ns = draw.choice((0, 0, 0, 0, 0, 0, 400_000, -1_500_000, 10**13))
            self.sync(stamp_ns + late_ns, draw.choice((b"", b"", bytes([draw.randrange(256)]))))

    def sync(self, stamp_ns: int, data: bytes = b"") -> None:
        """Somebody else's SYNC, stamped, and what answers it."""
        self._stamp_ns = stamp_ns
        self._queue.append((0x80, data))
        self.forged.append(set())
        self._cycle()

    def send(self, cob_id: int, data: bytes) -> None:
        """From the daemon: the nodes answer at once, and the fuzzer gets at the answers."""
        if cob_id == 0x80:
            self.forged.append(set())
            self._cycle()
            return
        for answer in self._handled(cob_id, data):
            self._put_service(answer)

    def _handled(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        return [answer for node in self.nodes for answer in node.handle(cob_id, data)]

    # The fuzzer

    def _cycle(self) -> None:
        """One SYNC of ours: late frames of the cycle before, the answers, and whatever else."""
        draw = self._random
        frames, self._late = self._late, []
        late = len(frames)
        self._sync(frames)
        if self.rate and draw.random() < 0.7:
            frames = self._disturbed(frames, late)
        self._queue.extend(frames)
        self._recent.extend(frames[:2])

    def _sync(self, frames: list[tuple[int, bytes]]) -> None:
        self.tick += 1
        for node in self.nodes:
            frames += node.answer(self.tick)

    def _disturbed(self, frames: list[tuple[int, bytes]], late: int) -> list[tuple[int, bytes]]:
        draw = self._random
        out: list[tuple[int, bytes]] = []
        if draw.random() < 0.05:  # of what answers one SYNC, anything may come first
            self.kinds["order"] += 1
            answers = frames[late:]
            draw.shuffle(answers)
            frames = frames[:late] + answers
        for place, frame in enumerate(frames):
            self._inject(out)
            if place < late or draw.random() > self.rate or frame[0] < 0x180:
                out.append(frame)
            else:
                self._mistreat(frame, out)
        self._inject(out)
        return out

    def _mistreat(self, frame: tuple[int, bytes], out: list[tuple[int, bytes]]) -> None:
        draw = self._random
        cob_id, data = frame
        kind = draw.choice(("lost", "late", "twice", "cut", "longer"))
        self.kinds[kind] += 1
        if kind == "late":
            self._late.append(frame)
        elif kind == "twice":
            out += (frame, frame)
        elif kind == "cut":
            out.append((cob_id, data[: draw.randrange(len(data))] if data else data))
        elif kind == "longer":
            out.append((cob_id, data + draw.randbytes(draw.randrange(1, 5))))

    def _inject(self, out: list[tuple[int, bytes]]) -> None:
        """Frames of somebody else; the nodes hear them too."""
        draw = self._random
        anything, replayed, service = self.mix
        for _ in range(draw.choice((0, 0, 1, 2, 4, 8))):
            kind = draw.random()
            if kind < anything:
                frame = (draw.randrange(0x800), draw.randbytes(draw.randrange(9)))
            elif kind < replayed:
                frame = self._replayed()
            elif kind < service:
                frame = self._service()
            else:
                frame = self._rare()
            self.kinds["forged"] += 1
            self._forge(frame, out)

    def _replayed(self) -> tuple[int, bytes]:
        """A frame that has been on the bus before, changed a little."""
        draw = self._random
        if not self._recent:
            return (0x7E5, b"")
        cob_id, data = draw.choice(self._recent)
        changed = bytearray(data)
        if changed:
            changed[draw.randrange(len(changed))] = draw.randrange(256)
        if draw.random() < 0.5:
            cob_id ^= 1 << draw.randrange(11)
        return (cob_id, bytes(changed))

    def _service(self) -> tuple[int, bytes]:
        """NMT, EMCY, heartbeat and SDO of the nodes, nearly right."""
        draw = self._random
        node = draw.randrange(1, 5)
        base = draw.choice((0x080, 0x700, 0x580, 0x600))
        if base == 0x700:
            return (base + node, bytes([draw.choice((0, 4, 5, 0x7F, 0x85, 9))])[: draw.randrange(3)])
        if base == 0x080:
            return (base + node, draw.randbytes(draw.choice((8, 8, 2, 0))))
        return (base + node, self._sdo())

    def _sdo(self) -> bytes:
        draw = self._random
        command = draw.choice((0x40, 0x43, 0x4B, 0x4F, 0x60, 0x80, 0x00, 0x10, 0x20, 0x41, 0xC0))
        indices, lengths = (0x1000, 0x1018, 0x1800, 0x1A00, 0x6064, 0x608F, 0x6076, 0x60A9, 0x6004), (8,)
        if not self._hostile:
            # An object that the configuration never asks for: a forged answer that fits cannot be detected.
            indices, lengths = (0x2000, 0x6502, 0x1003), (8, 8, 8, 7, 3)
        data = struct.pack("<BHB", command, draw.choice(indices), draw.randrange(4)) + draw.randbytes(4)
        return data[: draw.choice(lengths)]

    def _rare(self) -> tuple[int, bytes]:
        """What changes the state of a node, or of the bus."""
        draw = self._random
        if draw.random() < 0.3:
            return (0x080, draw.choice((b"", b"", b"\x01", draw.randbytes(8))))
        if draw.random() < 0.93:
            return (0x000, draw.randbytes(draw.choice((0, 1, 3, 8))))
        return (0x000, bytes((draw.choice((1, 1, 2, 0x80, 0x81, 0x82)), draw.choice((0, 1, 2, 3)))))

    def _forge(self, frame: tuple[int, bytes], out: list[tuple[int, bytes]]) -> None:
        out.append(frame)
        cob_id, data = frame
        if cob_id == 0x80:
            self.kinds["SYNC"] += 1
            self._sync(out)
        elif cob_id == 0 or 0x600 < cob_id < 0x680:
            out += self._handled(cob_id, data)
        else:
            self.forged[-1].add((cob_id, len(data)))

    def _put_service(self, answer: tuple[int, bytes]) -> None:
        """An answer to the daemon's SDO, perhaps spoilt."""
        draw = self._random
        if self.rate and draw.random() < 0.02:
            kinds = ("lost", "cut", "twice", "other", "abort", *("changed",) * (3 * self._hostile))
            kind = draw.choice(kinds)
            self.kinds["SDO " + kind] += 1
            cob_id, data = answer
            if kind == "lost":
                return
            if kind == "cut":
                answer = (cob_id, data[: draw.randrange(8)])
            elif kind == "twice":
                self._queue.append(answer)
            elif kind == "other":
                answer = (cob_id, data[:1] + bytes((data[1] ^ 0x80, data[2] ^ 0x55)) + data[3:])
            elif kind == "abort":
                answer = (cob_id, b"\x80" + data[1:4] + struct.pack("<I", 0x08000022))
            elif kind == "changed":
                changed = bytearray(data)
                for _ in range(draw.randrange(1, 4)):
                    changed[draw.randrange(8)] = draw.randrange(256)
                answer = (cob_id, bytes(changed))
        self._queue.append(answer)
