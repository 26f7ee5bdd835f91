"""A bus on which somebody else makes SYNC: it is numbered, its period is measured, said, and used."""

import itertools
import logging
import random
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from canopenkit import joint_text

from drivelink._core import LATE
from drivelink.cycle.startup import BusPort, join_bus
from drivelink.cycle.syncclock import MEASURED_SYNCS, SyncClock, measure_period
from drivelink.errors import BusError
from drivelink.jointfile import parse

DRIVE = """counts_per_rev = 16384
rated_torque_nm = 0.8
[[motor.drive.tpdo]]
cob_id = 0x185
objects = ["0x6064:00:32", "0x6077:00:16"]
"""


class Playing:
    """A bus with a master at another period, as fast as it is read."""

    def __init__(self, period_s: float) -> None:
        self._frames = self._play(period_s)

    def _play(self, period_s: float) -> Iterator[can.Message]:
        for k in itertools.count():
            for cob_id, data in ((0x80, b""), (0x185, bytes(6))):
                yield can.Message(
                    timestamp=1.8e9 + k * period_s, arbitration_id=cob_id, data=data, is_extended_id=False
                )

    def recv(self, timeout: float | None = None) -> can.Message:
        return next(self._frames)


def joined(period_s: float, bus: str):
    joint = parse(joint_text(drive=DRIVE, bus=f'configure = false\nsync = "follow"\n{bus}'))
    configurator = join_bus(BusPort(Playing(period_s)), [joint], [Path()])
    return configurator.bus.period_s


HEARD = "heard in 0.1 s: 2 SYNC, 1 heartbeats (pre-operational), no SDO requests to it, no PDOs of it"
UNMAPPED = [(0x080, b""), (0x705, b"\x7f"), (0x080, b"")]


@pytest.mark.parametrize(
    ("drive", "first", "said"),
    [
        (DRIVE, [], 'in 0.1 s: with bus.sync = "follow" another master must produce it'),
        (
            DRIVE,
            UNMAPPED,
            f"node 5: expected frame 0x185 on SYNC; {HEARD}: has its master mapped and started it?",
        ),
        (DRIVE.partition("[[")[0], UNMAPPED, f"or eds in the joint file; {HEARD}"),
    ],
)
def test_another_master_is_waited_for_and_what_is_missing_is_said_once(drive, first, said, caplog):
    joint = parse(joint_text(drive=drive, bus='configure = false\nsync = "follow"\n'))
    bus = Playing(0.001)

    def late() -> Iterator[can.Message | None]:
        yield from (can.Message(arbitration_id=one, data=data, is_extended_id=False) for one, data in first)
        while said not in caplog.text:
            yield None
        for _ in range(1000):
            yield None
        if "[[" not in drive:
            raise can.CanOperationError("enough")
        yield from Playing(0.001)._frames

    bus._frames = late()
    if "[[" not in drive:  # nobody maps it
        with pytest.raises(BusError, match="enough"):
            join_bus(BusPort(bus), [joint], [Path()], patience_s=0.1)
    else:
        assert 5 in join_bus(BusPort(bus), [joint], [Path()], patience_s=0.1).layouts
    (line,) = [one for one in caplog.messages if one.startswith("waiting for another master: ")]
    assert said in line


WRONG = (
    "SYNC comes every 2 ms, the joint file says 1 ms: 2 ms is used; set bus.period_s = 0.002, or leave it out"
)


@pytest.mark.parametrize(
    ("period_s", "stated", "used", "said"),
    [
        *((s, "", s, f"SYNC comes every {s * 1e3:.4g} ms") for s in (0.00102, 0.00125, 0.002, 0.003, 0.01)),
        (0.002, "period_s = 0.001", 0.002, WRONG),
        (0.001001, "period_s = 0.001", 0.001, ""),
    ],
)
def test_the_master_s_period_is_used_and_one_that_is_stated_wrong_is_said_with_both_and_with_the_fix(
    period_s, stated, used, said, caplog
):
    with caplog.at_level(logging.INFO, "drivelink"):
        assert joined(period_s, stated) == used
    assert said in caplog.text and ("SYNC comes" in caplog.text) == bool(said)
    assert any(record.levelno >= logging.WARNING for record in caplog.records) == (said == WRONG)


MS = 1_000_000


@pytest.mark.parametrize(
    "stamps",
    [
        [(round(k * MS * 1.0005),) for k in range(20_000)],  # a master that drifts
        [(k * MS, (k if k < 10 else max(k, 40)) * MS) for k in range(60)],  # frames read late in one go
        *(
            [(k * MS + round(step_s * 1e9) * (k >= 50), k * MS + 7) for k in range(100)]
            for step_s in (3600, -3600, 0.2, -0.2)  # a clock that is set
        ),
    ],
)
def test_what_is_no_gap_stays_in_step(stamps):
    clock = SyncClock(0.001)
    assert {clock.jump(*stamp) for stamp in stamps} == {1}


@pytest.mark.parametrize(
    ("tenths", "jumps"),
    [
        ((0, 10, 13, 20, 30), [1, 1, 0, 1, 1]),  # one that was not due
        ((0, 10, 20, 38, 41, 50, 60), [1, 1, 1, 2, LATE, 1, 1]),  # one taken for lost
    ],
)
def test_a_sync_that_is_not_due_or_late_is_no_period(tenths, jumps):
    clock = SyncClock(0.001)
    assert [clock.jump(t * MS // 10) for t in tenths] == jumps


@pytest.mark.parametrize("factor", [1.02, 1.04, 1.25, 1.5, 2.0, 3.0, 0.5])
@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.5])
def test_a_period_that_is_not_the_expected_one_is_found(factor, jitter):
    for seed in range(5):
        rng = random.Random(seed)
        stamps = [round((k + rng.uniform(-jitter, jitter)) * factor * MS) for k in range(256)]
        found = measure_period(stamps, 0.001)
        assert found is not None and not found.same
        assert found.period_s == pytest.approx(factor * 1e-3, rel=0.005)


@pytest.mark.parametrize("lost", [0.0, 0.03, 0.1])
def test_jitter_lost_syncs_and_stalls_are_no_other_period(lost):
    for seed in range(100):
        rng, late, stamps = random.Random(seed), 0.0, []
        for k in range(64):  # a master that stalls, and frames that do
            late += rng.uniform(0.3, 20.0) if rng.random() < lost else 0.0
            stamps.append(round((k + late + rng.uniform(0.0, 0.02)) * MS))
        assert measure_period(stamps, 0.001)[:2] == (0.001, True)
        stamps = [
            round((k + rng.uniform(0, 0.2) + (3.0 if 40 <= k < 43 else 0.0)) * MS)
            for k in range(100)
            if rng.random() >= lost
        ]
        assert measure_period(sorted(stamps)[:64], 0.001)[:2] == (0.001, True)


@pytest.mark.parametrize("factor", [1.0, 0.97, 1.03])
@pytest.mark.parametrize("caught_up", [True, False], ids=["the reader stalls", "the master stalls"])
def test_of_a_start_with_stalls_of_twenty_periods_the_period_is_right(caught_up, factor):
    for seed in range(60):
        rng, free, stamps = random.Random(seed), 0.0, []
        for k in range(MEASURED_SYNCS):
            stall = 20 * factor * (rng.random() < 0.02)
            due = k * factor + rng.uniform(0.0, 0.05)
            free = max(free + 0.01, due + stall) if caught_up else free + stall
            stamps.append(round((free if caught_up else due + free) * MS))
        assert measure_period(stamps, 0.001).period_s == pytest.approx(factor * 1e-3, rel=0.003)


def test_too_few_stamps_decide_nothing():
    assert measure_period([k * MS for k in range(7)], 0.001) is None
    assert measure_period([5] * 100, 0.001) is None


def test_the_period_is_not_that_of_the_short_steps_after_each_late_sync():
    """On a busy machine most steps catch up: their median is 0.97 periods, that of many periods is 1."""
    rng, late, stamps = np.random.default_rng(2), 0.0, []
    for k in range(1000):
        late = max(late - 0.056, 0.0) + (1.2 if rng.random() < 0.03 else 0.0)
        stamps.append(round((k + late + rng.normal(0.0, 0.02)) * MS))
    assert 0.94 < np.median(np.diff(stamps)) / MS < 0.98
    assert measure_period(stamps, 0.001)[:2] == (0.001, True)
