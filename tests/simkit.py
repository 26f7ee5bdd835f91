"""What the tests of the simulated devices share: a rig of known values, a wire, annotated transcripts."""

import itertools
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import can

from sim.canopen.node import Node
from sim.network import Network
from sim.sensors import DriveHardware, DriveSignals, LinkEncoder

TRANSCRIPTS = Path(__file__).parent / "transcripts"
_channels = itertools.count()


class StubRig:
    """Position 100 counts further each period, link 7; 0.5 A and 0.05 N·m; pi rad/s, which is 30 rpm."""

    period_s = 0.001

    def __init__(self, drive: DriveHardware | None = None, encoder: LinkEncoder | None = None) -> None:
        self.tick, self.commands = 0, []
        self.drives, self.encoder = (drive or DriveHardware(),) * 2, encoder or LinkEncoder()
        self.drive = lambda _motor: DriveSignals(100 * self.tick, 3.14159265358979, 0.5, 0.05)
        self.link_counts = lambda: 7 * self.tick
        self.command = lambda _motor, torque_nm: self.commands.append(torque_nm)

    @property
    def time_s(self) -> float:
        return self.tick * self.period_s

    def advance(self, periods: int = 1) -> None:
        self.tick += periods


class Wire:
    """A master's end of a virtual bus with devices on it, and a clock that stands still by itself."""

    def __init__(self, nodes: list[Node], rig: StubRig) -> None:
        channel = f"wire-{next(_channels)}"
        self.now_s = 0.0
        self._device_end = can.Bus(interface="virtual", channel=channel)
        self._master_end = can.Bus(interface="virtual", channel=channel)
        self.network = Network(self._device_end, nodes, rig, clock=lambda: self.now_s)

    def power_on(self) -> list[str]:
        self.network.poll()
        return self.heard()

    def heard(self) -> list[str]:
        frames = []
        while (message := self._master_end.recv(0)) is not None:
            frames.append(f"{message.arbitration_id:03X} {bytes(message.data).hex(' ').upper()}".strip())
        return frames

    def send(self, can_id: int, data: bytes) -> list[str]:
        """Send one frame; what the devices answer."""
        self._master_end.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        self.network.poll()
        return self.heard()

    def say(self, text: str) -> list[str]:
        """Send "601 40 00 10 00 …"."""
        can_id, _, data = text.partition(" ")
        return self.send(int(can_id, 16), bytes.fromhex(data))

    def wait(self, seconds: float) -> list[str]:
        """Time passes without a SYNC, in steps of a millisecond; what is heard in it."""
        for _ in range(round(seconds * 1000)):
            self.now_s += 0.001
            self.network.poll()
        return self.heard()

    def read(self, node_id: int, index: int, subindex: int = 0) -> int:
        """Expedited read; asserts that it is no abort."""
        (answer,) = self.send(0x600 + node_id, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))
        data = bytes.fromhex(answer.split(" ", 1)[1])
        assert data[0] & 0xE3 == 0x43, answer
        return int.from_bytes(data[4 : 8 - ((data[0] >> 2) & 3)], "little")

    def write(self, node_id: int, index: int, subindex: int, value: int, size: int) -> int:
        """Expedited write; the abort code, or 0."""
        command = 0x23 | (4 - size) << 2
        head = bytes([command, index & 0xFF, index >> 8, subindex])
        answers = self.send(0x600 + node_id, head + (value & 0xFFFFFFFF).to_bytes(4, "little"))
        own = [answer for answer in answers if answer.startswith(f"{0x580 + node_id:03X}")]
        data = bytes.fromhex(own[0].split(" ", 1)[1])
        return int.from_bytes(data[4:8], "little") if data[0] == 0x80 else 0

    def close(self) -> None:
        self._device_end.shutdown()
        self._master_end.shutdown()


@contextmanager
def wired(*nodes: Node, rig: StubRig) -> Iterator[Wire]:
    """The nodes on a wire, not yet switched on."""
    with closing(Wire(list(nodes), rig)) as wire:
        yield wire


def play(wire: Wire, transcript: Path) -> int:
    """Hold a device to a transcript.

    `> ID BYTES` is sent, `< ID BYTES` is what must come back (all of it, in this order, and nothing else),
    `wait SECONDS` lets time pass; what stands after `;` or `#` is for the reader.

    Returns:
        How many frames were compared.
    """
    compared = 0
    heard = wire.power_on()
    where = "power-on"
    for number, line in enumerate(transcript.read_text(encoding="utf-8").splitlines(), start=1):
        text = line.partition(";")[0].partition("#")[0].strip()
        if not text:
            continue
        if text.startswith("<"):
            assert heard, f"{transcript.name}:{number}: nothing more heard after {where}"
            assert heard.pop(0) == text[1:].strip(), f"{transcript.name}:{number}"
            compared += 1
            continue
        assert not heard, f"{transcript.name}:{number}: unexpected {heard} after {where}"
        where = f"line {number}"
        heard = wire.wait(float(text[5:])) if text.startswith("wait ") else wire.say(text[1:].strip())
    assert not heard, f"{transcript.name}: unexpected {heard} at the end"
    return compared
