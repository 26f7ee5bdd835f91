"""Faults in the loop on the virtual bus, in lockstep: safe torque within 20 ms of bus time, and back again.

Each rig takes a few seconds of simulation to get moving, so a test goes through a fault and its recovery.
"""

import math

import controllerkit as kit
import pytest
from vsacontrol.drive import PowerState
from vsacontrol.phases import Drives, Phase

from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Sample, Status, TransmissionEstimate
from sim.effects import parse


def test_a_killed_daemon_and_its_return():
    with kit.running() as rig:
        rig.kill_daemon()
        assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
        rig.run(0.5)
        assert rig.controller.phase is Phase.SAFE
        rig.start_daemon()  # it knows nothing of before
        phases = kit.recovers(rig, 8.0)
        assert phases == [Phase.IDENTIFY, Phase.APPROACH, Phase.RUN]


def test_zenoh_cut_while_the_bus_goes_on_and_back():
    with kit.running() as rig:
        rig.cut = True
        assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
        rig.cut = False
        # nothing is wrong with the joint: no need to identify anything again
        assert kit.recovers(rig, 4.0) == [Phase.APPROACH, Phase.RUN]


def test_a_drive_in_fault_is_reset_and_taken_up_again():
    with kit.running() as rig:
        rig.faults.emergency(rig.network.nodes[1], 0x2310)
        assert kit.goes_safe(rig, rig.now_s) == "a drive reports a fault"
        assert kit.recovers(rig, 4.0)[-2:] == [Phase.APPROACH, Phase.RUN]


def test_a_drive_that_reboots_is_configured_by_both_masters_and_taken_up_again():
    with kit.running() as rig:
        mapping = {drive.status_id for drive in rig.master.drives}
        rig.faults.reboot(rig.network.nodes[0])
        rig.run(0.02)
        assert rig.controller.phase is Phase.SAFE
        kit.recovers(rig, 12.0)
        assert {drive.status_id for drive in rig.master.drives} == mapping


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["torque_offset=0.04,motor=2", "coulomb_friction=0.05"])
def test_an_undeclared_effect_in_the_middle_of_a_motion_and_its_end(effect):
    with kit.running() as rig:
        rig.world.alter(effects=[parse(effect)])
        assert kit.goes_safe(rig, rig.now_s) == "an undeclared torque acts"
        rig.world.alter(effects=[])  # what was estimated with it is forgotten over the estimator's 20 s
        assert kit.recovers(rig, 30.0)[-2:] == [Phase.APPROACH, Phase.RUN]


@pytest.mark.slow
def test_an_effect_that_stays_keeps_it_from_going_on():
    with kit.running() as rig:
        rig.world.alter(effects=[parse("coulomb_friction=0.05")])
        rig.run(4.0)
        reached = {event.phase for event in rig.controller.events[-2:]}
        assert Phase.RUN not in reached


def test_a_dead_controller_leaves_drives_without_torque():
    """The drives watch the master's heartbeat (0x1016) and switch off by themselves (0x6007)."""
    with kit.running() as rig:
        rig.daemon.run_lockstep(150)  # the controller has stopped
        assert not any(node.machine.state == PowerState.OPERATION_ENABLED for node in rig.network.nodes[:2])
        assert all(abs(motor.torque_nm) < 2e-3 for motor in rig.world.truth().motors)
        assert all(node.state == 0x05 for node in rig.network.nodes)  # and go on measuring for the daemon


# Without a rig: what the controller makes of single estimates.


def estimate(sequence: int, status: int = 1, stiffness: float = 0.6, std: float = 0.001) -> EstimateMessage:
    each = TransmissionEstimate(0.0, stiffness / 2, std, 0.0)
    return EstimateMessage(sequence, sequence * 1_000_000, status, 0.0, stiffness, std, (each, each))


def sample(sequence: int, q: float = 0.0) -> Sample:
    return Sample(sequence, (0.0, 0.0), (math.nan,) * 2, (0.0, 0.0), q)


ENABLED, DISABLED = Drives(enabled=True, faulted=False), Drives(enabled=False, faulted=False)


def moving() -> tuple[kit.Controller, int]:
    """A controller that identifies, and the sequence number of its last cycle."""
    controller = kit.Controller(
        kit.VSA, kit.Decoupler(joint=kit.VSA), kit.Reference(kit.WAYPOINTS["decoupling"]), 1e-3
    )
    for k in range(400):
        controller.cycle(estimate(k, status=0), sample(k), ENABLED, k * 1e-3)
    assert controller.phase is Phase.IDENTIFY
    return controller, 399


def test_no_torque_before_estimates_and_drives_are_there():
    controller = kit.Controller(
        kit.VSA, kit.Decoupler(joint=kit.VSA), kit.Reference(kit.WAYPOINTS["decoupling"]), 1e-3
    )
    assert controller.watch(ENABLED, 10.0) == (0.0, 0.0)
    for k in range(400):
        assert controller.cycle(estimate(k), sample(k), DISABLED, k * 1e-3) == (0.0, 0.0)
    assert controller.phase is Phase.WAITING


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({"status": int(Status.DRIVE_FAULT)}, "a drive reports a fault"),
        ({"status": int(Status.RESTARTED)}, "positions have started anew"),
        ({"q": 1.3}, "the link is beyond its limit"),
        ({"drives": DISABLED}, "a drive is not enabled"),
        ({"age_s": 0.5}, "estimates are stale"),
    ],
)
def test_one_bad_cycle_is_enough(what, reason):
    controller, last = moving()
    now_s = (last + 1) * 1e-3
    if "age_s" in what:  # it was long on its way: a backlog after a cut
        now_s += 0.5
    torques = controller.cycle(
        estimate(last + 1, what.get("status", 0)),
        sample(last + 1, what.get("q", 0.0)),
        what.get("drives", ENABLED),
        now_s,
        what.get("age_s", 0.0),
    )
    assert torques == (0.0, 0.0)
    assert (controller.phase, controller.events[-1].reason) == (Phase.SAFE, reason)


def test_the_dead_man_needs_no_cycle():
    controller, last = moving()
    now_s = last * 1e-3
    assert controller.watch(ENABLED, now_s + 0.009) is None
    assert controller.watch(ENABLED, now_s + 0.011) == (0.0, 0.0)
    assert controller.events[-1].age_s == pytest.approx(0.011)


def test_torques_stay_within_the_limit():
    settings = kit.Settings(torque_nm=0.01)
    reference = kit.Reference(kit.WAYPOINTS["decoupling"])
    controller = kit.Controller(kit.VSA, kit.Decoupler(joint=kit.VSA), reference, 1e-3, settings=settings)
    largest = 0.0
    for k in range(2000):
        torques = controller.cycle(estimate(k, status=0), sample(k), ENABLED, k * 1e-3)
        largest = max(largest, *map(abs, torques))
    assert largest == 0.01
