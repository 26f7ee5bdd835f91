"""The controller's reactions to what touches the link, in lockstep: a wall, a push, a clamp; and back again."""

import math
from collections.abc import Callable
from dataclasses import replace

import controllerkit as kit
import pytest
from vsacontrol.phases import Phase, Reaction

from sim.effects import parse
from sim.excitation import build

# Cycles from the one in which the torque on the link passes `contact_torque_nm` to the reaction: the observer's time
# constant and the interval that the torque has to leave. At the speed of this motion a wall's torque passes it some
# cycles after the first touch.
REACTS_WITHIN = 25
TOUCHED_WITHIN = 50  # cycles from the obstacle's appearance where the link is
PUSH_NM = 0.12
WALL_NM_RAD = 3.0
WALL = f"contact={WALL_NM_RAD},position_rad={{:.4f}},side={{:d}}"
NOTHING = build({"kind": "none"}, 2)


def touches(rig, obstacle: str) -> Callable[[], float]:
    """Put an obstacle where the link is; the torque that it then has on the link."""
    q, side = rig.world.truth().link_position_rad, 1
    if obstacle == "push":
        table = {"kind": "none", "external": {"kind": "none", "offset_nm": PUSH_NM}}
        rig.world.excitation = build(table, 2)
        return lambda: PUSH_NM
    if rig.world.truth().link_velocity_rad_s < 0.0:  # in the way that the link goes
        side = -1
    sides = (side,) if obstacle == "wall" else (1, -1)
    rig.world.alter(effects=[parse(WALL.format(q, one)) for one in sides])

    def torque_nm() -> float:
        into = rig.world.truth().link_position_rad - q
        return -WALL_NM_RAD * (into if obstacle == "clamp" or side * into > 0.0 else 0.0)

    return torque_nm


def lets_go(rig) -> None:
    rig.world.alter(effects=[])
    rig.world.excitation = NOTHING


def reacts(rig, torque_nm: Callable[[], float]) -> float:
    """Run until it reacts, in time; the torque on the link by then."""
    least_nm = rig.joint.estimator.contact_torque_nm
    for cycle in range(TOUCHED_WITHIN):
        if abs(torque_nm()) >= least_nm:
            break
        assert rig.controller.phase is Phase.RUN, (cycle, rig.controller.events)
        rig.step()
    else:
        pytest.fail("nothing touched it")
    period_s = rig.joint.bus.period_s
    assert rig.run(REACTS_WITHIN * period_s, until=lambda: rig.controller.phase is Phase.REACT), torque_nm()
    return torque_nm()


CONTACTS = [(reaction, obstacle) for reaction in Reaction for obstacle in ("wall", "push", "clamp")]
QUICKLY = [(Reaction.SOFTEN, "push")]


@pytest.mark.parametrize(
    ("reaction", "obstacle"),
    [*QUICKLY, *(pytest.param(*each, marks=pytest.mark.slow) for each in CONTACTS if each not in QUICKLY)],
)
def test_it_reacts_to_what_touches_it_and_goes_on_when_it_is_gone(reaction, obstacle):
    settings = replace(kit.QUICK, reaction=reaction)
    with kit.running(settings=settings) as rig:
        torque_nm = touches(rig, obstacle)
        pushed = math.copysign(1.0, reacts(rig, torque_nm))
        assert rig.controller.events[-1].reason == f"contact: {reaction}"
        at = rig.world.truth().link_position_rad
        rows = [rig.step() for _ in range(450)]  # before it goes on once nothing touches it
        gave_way = pushed * (rows[-1].q - at)
        if reaction is Reaction.RETRACT and obstacle != "clamp":
            # As far as it is asked to; a push that lasts takes it further, a wall lets go of it on the way.
            assert gave_way > 0.8 * settings.retract_rad
        elif reaction is Reaction.SOFTEN:
            assert rows[-1].sigma == pytest.approx(settings.soft_nm_rad, rel=0.1)
        elif reaction is Reaction.STOP and obstacle != "push":  # which no stiffness holds
            assert all(abs(row.q - at) < 0.06 for row in rows)  # 40 % of the way that it would retract
        if obstacle == "wall":  # it does not lean on it: nothing, or less than it had when it reacted
            assert abs(torque_nm()) <= rig.joint.estimator.contact_torque_nm
        lets_go(rig)
        assert kit.recovers(rig, 12.0)[-1] is Phase.RUN  # it may have been on the way already


def test_a_motion_that_nothing_touches_is_not_interrupted():
    with kit.running(seconds=5.0) as rig:
        assert not [event for event in rig.controller.events if event.phase in (Phase.REACT, Phase.SAFE)]
