"""The fault script on the virtual bus, in lockstep: every fault in turn, one daemon, never a restart."""

import struct
import sys
from argparse import Namespace
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from daemonkit import vsa
from faultscript import SCRIPT
from faultstages import LockstepStage

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from soak import Soak


@pytest.fixture(scope="module")
def stage() -> Iterator[LockstepStage]:
    with pytest.MonkeyPatch.context() as patch:
        made = LockstepStage(vsa(bus="period_s = 0.002"), patch.setattr)  # as much in half as many cycles
        made.settle()
        yield made
        made.close()


@pytest.mark.parametrize("fault", [f for f in SCRIPT if f.where != "real"], ids=lambda fault: fault.name)
def test_each_fault_is_flagged_said_once_and_survived_without_a_restart(stage, fault):
    if not stage.well:
        stage.settle()
    stage.play(fault)


@pytest.mark.slow
def test_a_reset_after_a_few_blocks_of_motion_leaves_no_joint_that_is_never_valid_again(monkeypatch):
    """The law was fitted with its end where the joint was, and stayed so."""
    stage = LockstepStage(vsa(), monkeypatch.setattr)
    stage.settle()
    stage.run(1.0)
    pdo = stage.daemon.layouts[2].tpdos[0]
    mapping, cob = 0x1A00 + pdo.number - 1, (0x1800 + pdo.number - 1, 1)
    writes = [
        (*cob, 0xC0000000 | pdo.cob_id, 0x23),
        (mapping, 0, 0, 0x2F),
        (mapping, 1, 0x606C0020, 0x23),
        (mapping, 0, len(pdo.objects), 0x2F),
        (*cob, 0x40000000 | pdo.cob_id, 0x23),
    ]
    for k, (index, subindex, value, command) in enumerate(writes):
        frame = struct.pack("<BHBI", command, index, subindex, value)
        stage.schedule(0.1 + 0.003 * k, partial(stage.inject, 0x602, frame))
    stage.run(12.0)
    well = stage.well
    stage.close()
    assert well


@pytest.mark.slow
@pytest.mark.real_time
def test_a_soak_in_real_time_that_is_stopped_ends_well_with_its_report_and_as_many_threads(monkeypatch):
    soak = Soak(Namespace(seconds=1e9, seed=7, lockstep=False, two=0.0, recount=0.0))
    monkeypatch.setattr(soak, "_tell", lambda done: done > 10.0 and soak.stop())
    result = soak.run()
    assert result["faults"] >= 1  # how many fit into the time depends on the machine
    assert len(result["threads"]) == 1
    assert result["samples_checked"] > 100
