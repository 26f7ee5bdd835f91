"""The example controller: safe torque within 20 ms of bus time after any fault, reactions to contacts, and back again.

Each rig takes some seconds of simulation to get moving, so a test goes through a fault and its recovery.
"""

import itertools
import math
import time
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import controllerkit as kit
import pytest
import run as program
from controller import Controller, Cycle, Settings
from drives import MOST_RESETS

from drivelink import jointfile
from drivelink._core import encode_sample
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Sample, Status, TransmissionEstimate
from sim.canopen.drive import PowerState
from sim.effects import parse
from sim.excitation import build

NO_TORQUE = (0.0, 0.0)


@pytest.fixture(scope="module")
def rig():
    """On its way between its targets, for one fault after the other; each test leaves it as it was."""
    with kit.running() as made:
        yield made


def test_it_goes_to_its_targets_and_when_it_is_dead_the_drives_end_the_torque():
    with kit.running(seconds=1.3, rest_s=0.6) as rig:
        targets = rig.controller.settings.targets
        for q, sigma in (*targets, targets[0]):
            truth = rig.world.truth()
            assert truth.link_position_rad == pytest.approx(q, abs=0.02)
            assert truth.stiffness_nm_rad == pytest.approx(sigma, abs=0.04)
            rig.run(1.4)
        assert [phase for phase, _, _ in rig.events] == ["identify", "run"]  # nothing interrupts it
        rig.daemon.run_lockstep(150)  # the controller has stopped
        # The drives watch the master's heartbeat (0x1016) and switch off by themselves (0x6007).
        assert not any(node.machine.state == PowerState.OPERATION_ENABLED for node in rig.network.nodes[:2])
        assert all(abs(motor.torque_nm) < 2e-3 for motor in rig.world.truth().motors)
        assert all(node.state == 0x05 for node in rig.network.nodes)  # and go on measuring for the daemon


def test_a_killed_daemon_and_its_return_then_a_joint_that_has_changed(rig):
    rig.kill_daemon()
    assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
    rig.run(0.5)
    assert rig.controller.phase == "safe"
    rig.start_daemon()  # it knows nothing of before
    assert kit.recovers(rig, 8.0) == ["identify", "run"]
    put = rig.put
    for doubt in (Status.CHANGED, Status.MODEL_ALARM):

        def doubtful(tick, doubt=doubt):
            put(tick)
            one = rig._estimates[-1]
            rig._estimates[-1] = one._replace(status=one.status | doubt)

        rig.put = doubtful
        rig.run(0.05)
        assert rig.controller.phase == "safe"
        rig.put = put
        assert kit.recovers(rig, 8.0) == ["identify", "run"]


def test_zenoh_cut_and_back_then_a_drive_in_fault_that_is_reset_and_one_that_reboots(rig):
    rig.cut = True
    assert kit.goes_safe(rig, rig.last_estimate_s) == "estimates are stale"
    rig.cut = False
    assert kit.recovers(rig, 4.0) == ["run"]  # nothing is wrong with the joint: nothing to identify
    rig.run(0.2)
    rig.faults.emergency(rig.network.nodes[1], 0x2310)
    assert kit.goes_safe(rig, rig.now_s) == "a drive reports a fault"
    assert kit.recovers(rig, 4.0)[-1] == "run"
    rig.faults.reboot(rig.network.nodes[0])  # set up by both masters and taken up again
    rig.run(0.02)
    assert rig.controller.phase == "safe"
    kit.recovers(rig, 12.0)
    rig.run(3.0)  # motion shows where gravity pulls, too


@pytest.mark.parametrize("reaction", ["stop", "retract", "soften"])
def test_it_reacts_to_a_push_and_goes_on_when_it_is_gone(rig, reaction):
    rig.controller.settings = replace(rig.controller.settings, reaction=reaction)
    push = {"kind": "none", "external": {"kind": "none", "offset_nm": 0.12}}
    rig.world.excitation = build(push, 2)
    assert rig.run(0.03, "react"), rig.events
    assert rig.events[-1][1] == f"contact: {reaction}"
    at = rig.world.truth().link_position_rad
    rig.run(0.45)
    truth = rig.world.truth()
    if reaction == "retract":
        assert truth.link_position_rad - at > 0.8 * rig.controller.settings.retract_rad
    elif reaction == "soften":
        assert truth.stiffness_nm_rad < 1.1 * rig.controller.settings.soft_nm_rad
    rig.world.excitation = build({"kind": "none"}, 2)
    assert kit.recovers(rig, 12.0)[-1] == "run"


def test_a_wall_is_not_leant_on(rig):
    rig.run(0.5)
    while abs((truth := rig.world.truth()).link_velocity_rad_s) < 1.0:
        rig.step()
    q, side = truth.link_position_rad, int(math.copysign(1, truth.link_velocity_rad_s))
    rig.world.alter(effects=[parse(f"contact=3.0,position_rad={q:.4f},side={side}")])
    assert rig.run(0.08, "react"), rig.events
    rig.run(0.45)
    assert 3.0 * side * (rig.world.truth().link_position_rad - q) < 0.06
    rig.world.alter(effects=[])
    kit.recovers(rig, 12.0)


def test_drives_are_set_up_enabled_and_commanded_by_the_controllers_own_objects_alone(capsys):
    text = kit.declared_text().replace("[motor.drive]", "[motor.drive]\ndirection = -1", 1)
    with closing(kit.Rig(text=text)) as rig:
        first, second, _ = rig.network.nodes
        number = lambda node, index, subindex=0: node.dictionary.find(index, subindex).number  # noqa: E731
        tpdos = [number(first, 0x1800 + n, s) for n in range(4) for s in (1, 2)]
        rig.master.command((0.1, 0.1), 0.0)
        assert [cob for cob, _ in rig.sent] == [0x77E]  # before the set-up there is the heartbeat only
        assert rig.run(4.0, "identify") and rig.master.states["enabled"]
        rig.master.command((0.02, 5.0), rig.now_s)
        rig.network.poll()
        unit_nm, most = rig.master.drives[0].unit_nm, number(second, 0x6072)
        assert number(first, 0x6071) == -round(0.02 / unit_nm)  # against the joint's sign
        assert number(second, 0x6071) == most == round(QUICK_NM / unit_nm)  # limited here and in the drive
        assert (number(first, 0x6061), number(first, 0x1402, 2)) == (10, 255)  # cyclic synchronous torque
        assert written(rig) <= {0x1402, 0x1602, 0x6071, 0x6072, 0x6060, 0x1016, 0x1029, 0x6007}
        assert tpdos == [number(first, 0x1800 + n, s) for n in range(4) for s in (1, 2)]
        assert not any(cob in (0x000, 0x080) for cob, _ in rig.sent)  # no NMT, no SYNC
        rig.sent.clear()
        rig.master.drives[0].forget()  # a mapping that is there already is not written
        rig.run(0.1)
        assert rig.master.states["enabled"] and not written(rig) & {0x1402, 0x1602}
        for drive in rig.master.drives:
            drive.forget()
            drive._node.sdo.RESPONSE_TIMEOUT = 0.01
        rig.network.plugged = False
        rig.master.set_up(rig.now_s)
        assert "node 1: No SDO response received\n" in capsys.readouterr().err


QUICK_NM = kit.QUICK.torque_nm


def written(rig) -> set[int]:
    frames = (data for cob, data in rig.sent if 0x600 < cob < 0x680 and data[0] >> 5 == 1)
    return {int.from_bytes(data[1:3], "little") for data in frames}


def test_a_fault_that_comes_back_at_once_is_reset_by_edges_and_not_for_ever():
    with kit.running() as rig:
        drive = rig.network.nodes[0]
        rig.sent.clear()
        for _ in range(900):
            if drive.machine.state is not PowerState.FAULT:
                drive.fault(0x2310)
            rig.step()
        words = [data[0] for cob, data in rig.sent if cob == 0x401]
        edges = sum(1 for a, c in itertools.pairwise(words) if c & 0x80 and not a & 0x80)
        assert 1 <= edges <= MOST_RESETS


# Without a rig: what the controller makes of single cycles.


def estimate(sequence: int, status: int = 1) -> EstimateMessage:
    each = TransmissionEstimate(0.0, 0.3, 0.001, 0.0)
    return EstimateMessage(sequence, sequence * 1_000_000, status, 0.0, 0.6, 0.001, (each, each))


def sample(sequence: int, q: float = 0.0) -> Sample:
    return Sample(sequence, NO_TORQUE, (math.nan,) * 2, NO_TORQUE, q)


def moving(**settings) -> tuple[Controller, list]:
    """A controller that identifies, after 400 cycles, and its events."""
    events = []
    joint = jointfile.parse(kit.declared_text())
    controller = Controller(joint, replace(Settings(), **settings), lambda *event: events.append(event))
    for k in range(400):
        controller.step(k * 1e-3, Cycle(estimate(k, 0), sample(k)), enabled=True, faulted=False)
    assert controller.phase == "identify"
    return controller, events


def test_no_torque_before_estimates_and_drives_are_there():
    controller = Controller(jointfile.parse(kit.declared_text()), Settings())
    assert controller.step(10.0, None, enabled=True, faulted=False) == NO_TORQUE
    for k in range(400):
        cycle = Cycle(estimate(k), sample(k))
        assert controller.step(k * 1e-3, cycle, enabled=False, faulted=False) == NO_TORQUE
    assert controller.phase == "waiting"


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ({"status": int(Status.DRIVE_FAULT)}, "a drive reports a fault"),
        ({"faulted": True}, "a drive reports a fault"),
        ({"status": int(Status.RESTARTED)}, "positions have started anew"),
        ({"q": 1.3}, "the link is beyond its limit"),
        ({"q": math.nan}, "the link is beyond its limit"),
        ({"enabled": False}, "a drive is not enabled"),
        ({"age_s": 0.5}, "estimates are stale"),  # it was long on its way: a backlog after a cut
        ({"cycle": False}, "estimates are stale"),  # the dead man needs none
    ],
)
def test_one_bad_cycle_is_enough(what, reason):
    controller, events = moving()
    late_s = what.get("age_s", 0.0)
    cycle = Cycle(estimate(400, what.get("status", 0)), sample(400, what.get("q", 0.0)), None, late_s)
    drives = {"enabled": what.get("enabled", True), "faulted": what.get("faulted", False)}
    if "cycle" in what:
        assert controller.step(0.408, None, **drives) != NO_TORQUE
        cycle, late_s = None, 0.01
    assert controller.step(0.4 + late_s, cycle, **drives) == NO_TORQUE
    assert (controller.phase, events[-1][1]) == ("safe", reason)
    assert cycle or events[-1][2] == pytest.approx(0.011)


def test_torques_stay_within_the_limit():
    controller, _ = moving(torque_nm=0.01)
    largest = 0.0
    for k in range(400, 2000):
        torques = controller.step(k * 1e-3, Cycle(estimate(k, 0), sample(k)), enabled=True, faulted=False)
        largest = max(largest, *map(abs, torques))
    assert largest == 0.01


def test_the_process_ends_the_torque_a_deadline_and_a_look_after_the_last_estimate(monkeypatch):
    """By a clock that stands still unless the process waits."""
    controller, _ = moving()
    clock = SimpleNamespace(now_s=0.4, last_s=0.4, count=400)
    sent = []

    def wait(timeout_s):
        clock.now_s += 0.001 if clock.now_s < 0.5 else timeout_s
        if clock.now_s >= 0.5:
            return None
        clock.last_s, clock.count = clock.now_s, clock.count + 1
        return estimate(clock.count, 0)

    class Estimates:
        status = external = None
        age_s = property(lambda _: clock.now_s - clock.last_s)

    estimates = Estimates()
    estimates.wait = wait
    payloads = iter(range(10_000))

    def try_recv():
        if next(payloads) % 2:
            return None
        data = encode_sample(sample(clock.count), 0)
        return SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: data))

    master = SimpleNamespace(
        states={"enabled": True, "faulted": False}, set_up=lambda _: None, release=lambda: None,
        command=lambda torques, now_s: sent.append((now_s, torques)),
    )  # fmt: skip
    monkeypatch.setattr(time, "monotonic", lambda: clock.now_s)
    process = program.Process(controller, master, estimates, SimpleNamespace(try_recv=try_recv))
    process.run(lambda: clock.now_s > 0.6)
    last_s = max(now_s for now_s, torques in sent if torques != NO_TORQUE)
    ended = [now_s for now_s, _ in sent if now_s > last_s]
    assert 0.010 < ended[0] - clock.last_s <= 0.012 + 1e-9
    assert len(ended) > 10  # and says it again: the frame may have been lost
