"""Joining a bus on which somebody else makes SYNC: its period is measured, said, and used."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from canopenkit import joint_text

from drivelink.cycle.startup import BusPort, join_bus
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
    configurator, _ = join_bus(BusPort(Playing(period_s)), [joint], [Path()])
    return configurator.bus.period_s


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
