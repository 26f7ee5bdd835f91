"""Another master's SYNC: its counter jumps, it is left out, comes twice, and clocks are set; nothing shifts."""

import itertools
import random
import time
from functools import partial

import pytest
from fuzzrun import FuzzRun

from estimator.sample import Status

PERIOD_NS = 1_000_000
START_NS = 1_800_000_000 * 1_000_000_000


class Follower:
    """A passive daemon, and the master that it follows."""

    def __init__(self) -> None:
        self.run = FuzzRun(1, passive=True, overflow=10)
        self.stamp_ns = START_NS
        self.counter = 0
        self.found: list[tuple[int, int, set[float]]] = []
        self.run.judge.put = self._keep  # type: ignore[method-assign]
        self.periods: list[float] = []  # that the daemon is to begin anew with
        self.run.supervisor.bus.on_period = self.periods.append

    def _keep(self, tick) -> None:
        if tick.sample is not None and tick.estimate.status & Status.VALID:
            values = set(self.run.ticks_of(tick.sample).values())
            self.found.append((tick.sample.sequence, tick.estimate.status, values))

    def syncs(self, count: int) -> None:
        for _ in range(count):
            self.stamp_ns += PERIOD_NS
            self.counter = self.counter % 10 + 1
            self.run.bus.sync(self.stamp_ns, bytes([self.counter]))
            self.run.loop.receive()
        self.run.supervisor.check()

    def jittering(self, count: int, deviation, period_ns: float = PERIOD_NS) -> None:
        """SYNCs that are off by so much, in periods, each from where it is due."""
        start_ns = self.stamp_ns
        for k in range(1, count + 1):
            self.stamp_ns = round(start_ns + k * period_ns + deviation() * period_ns)
            self.counter = self.counter % 10 + 1
            self.run.bus.sync(self.stamp_ns, bytes([self.counter]))
            self.run.loop.clock = partial(int, self.stamp_ns)
            self.run.loop.receive()
            if k % 50 == 0:
                self.run.supervisor.check()

    @property
    def events(self) -> list[str]:
        return [event["text"] for event in self.run.events.recent()]

    def steps(self) -> set[tuple[int, float]]:
        """From one sample to the next: by how much the sequence grows, and the SYNC that the values belong to."""
        assert all(len(ticks) == 1 for _, _, ticks in self.found)  # never two SYNCs in one sample
        answered = [(sequence, next(iter(ticks))) for sequence, _, ticks in self.found]
        return {(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(answered)}


@pytest.fixture
def follower(monkeypatch: pytest.MonkeyPatch) -> Follower:
    made = Follower()
    monkeypatch.setattr(time, "monotonic_ns", lambda: made.stamp_ns)
    return made


def test_a_counter_that_jumps_is_said_and_syncs_that_are_left_out_are_a_gap_of_whole_periods(follower):
    follower.syncs(100)
    follower.counter += 3
    follower.syncs(100)
    assert follower.steps() == {(1, 1.0)}
    assert follower.run.loop.counter_jumps == 1
    assert follower.events == ["the SYNC counter jumped, 1 times so far"]
    follower.stamp_ns += 5 * PERIOD_NS
    follower.counter += 5
    follower.syncs(100)
    assert follower.steps() == {(1, 1.0), (6, 1.0)}  # these slaves count SYNCs, not time


def test_a_second_masters_sync_spoils_its_cycle_only(follower):
    follower.syncs(100)
    follower.run.bus.sync(follower.stamp_ns + PERIOD_NS // 4)
    follower.run.loop.receive()
    follower.syncs(100)
    assert all(len(ticks) == 1 for _, _, ticks in follower.found)
    assert [sequence for sequence, _, _ in follower.found][-90:] == list(range(110, 200))
    assert follower.run.loop.foreign_syncs == 1
    assert not follower.found[-1][1] & Status.BUS_FAULT


@pytest.mark.parametrize("most", [0.25, 0.5])
def test_one_master_that_jitters_by_up_to_half_a_period_is_one_master(most, follower):
    draw = random.Random(7)
    follower.jittering(100, lambda: 0.0)
    follower.jittering(5000, lambda: draw.uniform(-most, most))
    assert follower.run.loop.foreign_syncs <= 1
    assert not any("master" in text for text in follower.events)
    timely = [status for _, status, _ in follower.found if not status & Status.UNTIMED]
    assert len(timely) > 0.97 * 5100
    numbered = [b[0] - a[0] for a, b in itertools.pairwise(follower.found)]
    assert sum(step != 1 for step in numbered) <= 0.01 * len(numbered)
    assert follower.found[-1][0] == pytest.approx(5099, abs=1)  # the numbers keep to time


def test_a_master_that_stalls_and_catches_up_in_a_burst_is_no_second_one(follower):
    late = itertools.chain.from_iterable(
        itertools.repeat([0.0] * 488 + [max(0.0, 12 - k * 0.95) for k in range(12)])
    )
    follower.jittering(5000, lambda: next(late))
    assert follower.run.loop.foreign_syncs == 0
    assert follower.run.loop.late_syncs >= 90
    assert not any("master" in text for text in follower.events)
    assert not any(status & Status.UNTIMED for _, status, _ in follower.found)
    assert all(len(ticks) == 1 for _, _, ticks in follower.found)  # never two SYNCs in one sample


def test_a_second_master_is_named_when_following_too(follower):
    follower.jittering(200, lambda: 0.0)
    for _ in range(100):
        follower.jittering(1, lambda: 0.0)
        follower.run.bus.sync(follower.stamp_ns + PERIOD_NS // 3)
        follower.run.loop.receive()
    follower.run.supervisor.check()
    assert any(text.startswith("a second master produces SYNC too") for text in follower.events)
    follower.jittering(3000, lambda: 0.0)
    assert follower.periods == []


def test_a_master_that_changes_its_period_is_named_with_both_and_followed(follower):
    follower.jittering(1500, lambda: 0.0)
    assert follower.run.supervisor.bus.sync_period_s == 0.001
    follower.jittering(2500, lambda: 0.0, 1.5 * PERIOD_NS)
    text = "SYNC comes every 1.5 ms now, 1 ms is in use"
    assert any(active.startswith(text) for active in follower.run.events.active.values())
    assert set(follower.periods) == {0.0015}
    follower.jittering(2500, lambda: 0.0)
    assert "SYNC comes every 1 ms again" in follower.events


def test_a_master_that_goes_on_from_where_it_was_late_is_no_second_one(follower):
    draw, late = random.Random(5), 0.0

    def walk() -> float:  # as the kernel's broadcast manager does it
        nonlocal late
        late += draw.uniform(0.2, 0.5) if draw.random() < 0.2 else 0.0
        return late

    follower.jittering(5000, walk)
    assert not any("master makes" in text for text in follower.events)
    assert follower.run.loop.skipped_periods > 100  # time without a SYNC is a gap
