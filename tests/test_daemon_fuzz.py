"""Half a million frames that no standard foresees: no exception, no estimate valid that should not be."""

import random

import pytest
from canlayouts import LINK_RAD, TORQUE_NM, VSA, link, vsa_cycle
from daemonkit import rig

from drivelink._core import Assembler
from drivelink.cycle.framesource import CanFrame
from estimator.sample import Status

SYNC = 0x080
TURN = 30_000  # torques have 16 bits


@pytest.mark.parametrize(
    ("share", "certain"),
    # A lost frame keeps 100 cycles in doubt: with three frames a cycle that are lost or cut with `2 * share`,
    # about exp(-600 * share) of the cycles may be called certain; asked for is a good half of that.
    [(0.001, 20_000), (0.004, 2_000)],
)
def test_a_sample_that_is_not_of_its_cycle_is_always_flagged(share: float, certain: int) -> None:
    """Frames get lost, late, doubled, cut and reordered, amid noise; every value identifies its cycle."""
    rng = random.Random(17)
    assembler = Assembler(VSA, 2)
    noise = [0x000, 0x181 + 0x200, 0x585, 0x605, 0x7E5, 0x710, 0x0FF, 0x7FF]
    late: list[tuple[int, bytes]] = []
    frames = given = unflagged = 0

    def feed(cob_id: int, data: bytes) -> None:
        nonlocal frames, given, unflagged
        frames += 1
        sample = assembler.feed(cob_id, data)
        if sample is None:
            return
        given += 1
        torque = sample.sequence % TURN * TORQUE_NM
        right = sample.link_position_rad == sample.sequence * LINK_RAD
        right = right and sample.motor_torque_nm == (torque, -torque)
        if not assembler.flags & Status.BUS_FAULT:
            unflagged += 1
            assert right, sample

    for k in range(60_000):
        feed(SYNC, b"")
        arrived, late = late, []
        mine = cycle_frames(k)
        rng.shuffle(mine)
        for frame in mine:
            fate = rng.random()
            if fate < share:
                continue
            if fate < 2 * share:
                late.append(frame)
            elif fate < 3 * share:
                arrived.append((frame[0], frame[1][: rng.randint(0, 3)]))
            else:
                arrived += [frame] * (2 if fate < 4 * share else 1)
        for frame in arrived:
            feed(*frame)
            if rng.random() < 0.5:
                feed(rng.choice(noise), rng.randbytes(rng.randint(0, 8)).replace(b"\x81", b"\0"))
    assert frames > 300_000
    assert given > 40_000
    assert unflagged > certain


def cycle_frames(k: int) -> list[tuple[int, bytes]]:
    """Frames whose values identify the cycle: the torques modulo TURN, the link position for good."""
    first, second, _ = vsa_cycle(k % TURN)
    return [first, second, (0x183, link(k))]


class Fuzzed:
    """The bus of a running daemon, with frames added, changed and lost on the way in."""

    def __init__(self, inner, seed: int) -> None:
        self.inner = inner
        self.rng = random.Random(seed)
        self.real: list[CanFrame] = []
        self.frames = 0
        self.quiet = False

    def __getattr__(self, name: str):
        return getattr(self.inner, name)

    def take(self) -> list[CanFrame]:
        frames = self.inner.take()
        if self.quiet:
            return frames
        rng = self.rng
        self.real = (self.real + frames)[-200:]
        found = [frame for frame in frames if rng.random() < 0.9]
        for _ in range(rng.randint(20, 60)):
            found.insert(rng.randint(0, len(found)), self.bad())
        self.frames += len(found)
        return found

    def bad(self) -> CanFrame:
        """Anything, or something real with some bits changed."""
        rng = self.rng
        if rng.random() < 0.5 or not self.real:
            node = rng.choice((0, 1, 2, 3, 4, 127))
            function = rng.choice((0x000, 0x080, 0x180, 0x280, 0x380, 0x580, 0x600, 0x700, 0x100))
            return CanFrame(function + node, rng.randbytes(rng.choice((0, 1, 2, 4, 6, 8, 8, 8))), 0)
        frame = rng.choice(self.real)
        data = bytearray(frame.data)
        for _ in range(rng.randint(0, 3)):
            if data:
                data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return CanFrame(frame.cob_id, bytes(data[: rng.randint(0, 8)]), 0)


@pytest.mark.slow
def test_a_daemon_amid_random_and_mutated_frames_goes_on_and_recovers() -> None:
    with rig() as made:
        made.run(1500)
        layouts = dict(made.daemon.layouts)
        loop = made.daemon.loop
        loop.source = fuzzed = Fuzzed(loop.source, seed=23)
        estimates = made.run(5000)
        assert fuzzed.frames > 190_000
        sequences = [estimate.sequence for estimate in estimates]
        assert sequences == sorted(set(sequences))
        for estimate in estimates:
            assert not (estimate.status & Status.STALE and estimate.status & Status.VALID)
        fuzzed.quiet = True
        # Among the frames were forged answers to the configuration; they cannot be distinguished from the node's own. What
        # they said of its units and mapping stays until it is configured again.
        for node in list(made.network.nodes):
            made.faults.reboot(node)
        recovered = made.run(6000)
        assert dict(made.daemon.layouts) == layouts
        assert recovered[-1].status & Status.VALID
        assert not recovered[-1].status & Status.STALE
        assert len(made.events) <= 16
