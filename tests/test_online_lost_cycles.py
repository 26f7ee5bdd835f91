"""Whole cycles lost at random cost no validity.

With every tenth cycle lost there is a gap of more than one cycle each tenth of a second: filters and the search for a
late encoder must not restart at each of them. What a gap costs follows from the straight line across it: (w n T)²/12 of the
amplitude, for n periods T in a filter of bandwidth w.
"""

import numpy as np
import onlinekit as kit
import pytest

from estimator import Status

SECONDS = 12.0
SETTLED = 3000


@pytest.mark.parametrize(
    ("name", "share", "least"),
    [
        pytest.param(name, share, least, marks=() if k == at else pytest.mark.slow)
        for k, name in enumerate(("constant", "quadratic", "vsa-ii"))
        for at, (share, least) in enumerate(((0.003, 0.99), (0.03, 0.95), (0.1, 0.8)))
    ],
)
def test_cycles_lost_at_random_cost_little_and_make_nothing_wrong(name, share, least):
    motion = kit.motion(name, SECONDS)
    samples, kept = kit.without(motion.samples, share, 0)
    estimates, _ = kit.play(kit.declared(name), samples)
    assert not np.any(kit.wrong(estimates, motion.stiffness_nm_rad[kept]))
    late = kept > SETTLED
    assert np.mean(estimates.valid[late]) >= least
    assert np.mean(estimates.status[late] & kit.OBSERVABLE > 0) > 0.8


def test_a_late_link_encoder_is_found_while_cycles_are_lost():
    late_by = 3
    motion = kit.motion("vsa-ii", SECONDS)
    samples = [
        sample._replace(link_position_rad=motion.samples[max(k - late_by, 0)].link_position_rad)
        for k, sample in enumerate(motion.samples)
    ]
    left, kept = kit.without(samples, 0.05, 1)
    estimates, _ = kit.play(kit.declared("vsa-ii"), left)
    end = kept > SETTLED + 5000
    assert np.mean(estimates.valid[end]) > 0.95
    assert not np.any(kit.wrong(estimates, motion.stiffness_nm_rad[kept])[end])


@pytest.mark.parametrize(("name", "gap"), [("constant", 20), ("quadratic", 22)])
def test_a_gap_that_a_straight_line_bridges_badly_is_no_change(name, gap):
    motion = kit.motion(name, SECONDS)
    left = [sample for k, sample in enumerate(motion.samples) if k < 2 * SETTLED or k % 1000 >= gap]
    estimates, _ = kit.play(kit.declared(name), left)
    assert not np.any(estimates.status & int(Status.CHANGED))
    assert np.mean(estimates.valid[SETTLED:]) > 0.95


def test_what_is_left_out_after_a_long_gap_is_not_as_it_was_before():
    """The estimate before the gap was valid for another eight samples: it is held for 20 ms of time, not of samples."""
    motion = kit.motion("quadratic", 8.0)
    elsewhere = [
        sample._replace(motor_position_rad=(sample.motor_position_rad[0] + 1000.0,), sequence=sample.sequence)
        for sample in motion.samples[6000:6005]
    ]
    estimates, _ = kit.play(kit.declared("quadratic"), [*motion.samples[:4500], *elsewhere])
    assert np.all(estimates.valid[4000:4500])
    assert not np.any(estimates.status[4500:] & int(Status.VALID | Status.TORQUE_VALID))
    assert np.all(estimates.status[4500:] & int(Status.INPUT_REJECTED))
