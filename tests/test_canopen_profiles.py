"""The daemon on simulated drives, each with its maker's habits, in lockstep."""

import numpy as np
import pytest
from daemonkit import rig, vsa_text

from drivelink.canopen.layout import Signal
from drivelink.jointfile import parse
from estimator.sample import Status
from sim.canopen.profiles import PROFILES


@pytest.mark.parametrize("quirks", PROFILES)
def test_every_makers_drive_is_configured_and_its_frames_decode(quirks):
    text = vsa_text().replace("[motor.drive]", "[motor.drive]\ncounts_per_rev = 8192\nrated_current_a = 4.0")
    with rig(parse(f'{text}quirks = "{quirks}"\n')) as made:
        world, truth = made.network._worlds[0], []
        for _ in range(200):
            made.run(1)
            truth.append([motor.position_rad for motor in world.truth().motors])
        mapped = {
            o.signal for node in (1, 2) for tpdo in made.daemon.layouts[node].tpdos for o in tpdo.objects
        }
        assert {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD} <= mapped
        assert not any(e.status & Status.STALE for e, _ in made.collector.estimates[2:])
        measured = np.array([sample.motor_position_rad for sample, _ in made.collector.samples])
        assert np.ptp(measured[:, 0]) > 0.01
        assert measured[-150:-2] == pytest.approx(np.array(truth)[-150:-2], abs=2e-3)
