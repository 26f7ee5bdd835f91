"""Whatever arrives, a simulated device neither raises nor forgets how to answer."""

import random
import struct

import pytest
from simkit import StubRig, wired

from sim.canopen.drive import Cia402Drive
from sim.canopen.encoder import Cia406Encoder
from sim.canopen.profiles import PROFILES, profile

FRAMES = 1000

_INDICES = (
    *(0x1000, 0x1001, 0x1003, 0x1005, 0x1006, 0x1008, 0x1010, 0x1011, 0x1014, 0x1016, 0x1017, 0x1019),
    *(0x1029, 0x1400, 0x1402, 0x1600, 0x1602, 0x1800, 0x1801, 0x1A00, 0x1A01, 0x6003, 0x6040, 0x6060),
    *(0x6071, 0x607E, 0x60A9, 0x6000, 0x6200),
)
_WORDS = (0x60640020, 0x60410010, 0x60770010, 0x60E40120, 0x40000181, 0xC0000281, 0x181, 1, 2, 10, 0xFF)


_COMMANDS = (0x40, 0x2F, 0x2B, 0x23, 0x21, 0x20, 0x60, 0x70, 0x00, 0x10, 0xA4, 0xA3, 0xA2, 0xA1)


def request(draw):
    """An SDO request that is often nearly right."""
    command = draw.randrange(256) if draw.random() < 0.1 else draw.choice(_COMMANDS)
    index, subindex = draw.choice(_INDICES), draw.choice((0, 0, 1, 2, 3, 8))
    value = draw.choice(_WORDS) if draw.random() < 0.8 else draw.randrange(1 << 32)
    return struct.pack("<BHBI", command, index, subindex, value)


def frame(draw):
    kind, data = draw.random(), draw.randbytes(draw.randrange(9))
    if kind < 0.5:
        return 0x601, request(draw)
    if kind < 0.7:
        return 0x80, draw.randbytes(draw.choice((0, 0, 0, 0, 1, 8)))
    if kind < 0.8:
        return 0, bytes([draw.choice((1, 2, 0x80, 0x81, 0x82, 7)), draw.choice((0, 1, 2))])
    return (draw.choice((0x201, 0x301, 0x401, 0x501, 0x702)) if kind < 0.9 else draw.randrange(0x800)), data


@pytest.mark.parametrize(
    "name",
    [*(pytest.param(p, marks=pytest.mark.slow) for p in PROFILES if p != "strict"), "strict", "encoder"],
)
def test_random_and_nearly_right_frames_leave_a_device_that_answers(name):
    draw = random.Random(f"fuzz/{name}")
    rig = StubRig()
    node = Cia406Encoder(1, rig) if name == "encoder" else Cia402Drive(1, rig, 0, quirks=profile(name))
    with wired(node, rig=rig) as wire:
        wire.power_on()
        for _ in range(FRAMES):
            wire.send(*frame(draw))
            if draw.random() < 0.02:
                wire.wait(draw.choice((0.01, 0.06, 1.2)) / 10)
        wire.say("000 81 00")
        wire.wait(2.0)
        assert wire.read(1, 0x1000) in (0x0002_0192, 0x0002_0196)
        wire.say("000 01 00")
        assert node.state == 5
