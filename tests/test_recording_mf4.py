"""MF4 recordings: where asammdf is installed bit for bit, elsewhere one line."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from drivelink.errors import RecordingError
from drivelink.jointfile import parse
from drivelink.recording import read
from drivelink.recording.formats import open_sink
from estimator.sample import Sample

JOINT = parse('name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.1\n')
HAVE = importlib.util.find_spec("asammdf") is not None


def sample(k: int) -> Sample:
    return Sample(k, (0.1 * k,), (float("nan"),), (1.0 / (k + 1),), 0.2 * k)


@pytest.mark.skipif(not HAVE, reason="needs asammdf")
def test_samples_come_back_bit_for_bit_and_the_journal_is_gone(tmp_path: Path) -> None:
    path = tmp_path / "r.mf4"
    sink = open_sink(path, JOINT)
    for k in range(200):
        if k != 50:
            sink.sample(sample(k), k)
    sink.flush()
    assert len(read(tmp_path / "r.mf4.mcap", JOINT)) == 199  # what a kill would have left
    sink.close()
    record = read(path, JOINT)
    assert sorted(tmp_path.iterdir()) == [path]
    assert np.array_equal(record.sequence, np.delete(np.arange(200), 50))
    assert record.motor_torque_nm[-1, 0] == sample(199).motor_torque_nm[0]
    assert record.motor_velocity_rad_s is None


@pytest.mark.skipif(HAVE, reason="asammdf is installed")
def test_without_asammdf_it_is_one_line_before_anything_is_recorded(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r'MF4 needs asammdf: pip install "drivelink-vsa\[mf4\]"'):
        open_sink(tmp_path / "r.mf4", JOINT)
    assert not list(tmp_path.iterdir())
