"""The simulated devices, byte for byte on the wire."""

import pytest
from simkit import TRANSCRIPTS, StubRig, play, wired

from sim.canopen.drive import Cia402Drive
from sim.canopen.encoder import Cia406Encoder
from sim.sensors import LinkEncoder


def device(name, rig):
    if name == "encoder":
        rig.encoder = LinkEncoder(counts_per_rev=65536)
        return Cia406Encoder(1, rig, range_counts=65536 * 4096)
    return Cia402Drive(1, rig, 0, link_encoder=True)


@pytest.mark.parametrize("transcript", sorted(path.stem for path in TRANSCRIPTS.glob("*.txt")))
def test_the_device_answers_as_written(transcript):
    rig = StubRig()
    with wired(device(transcript, rig), rig=rig) as wire:
        assert play(wire, TRANSCRIPTS / f"{transcript}.txt") > 3
