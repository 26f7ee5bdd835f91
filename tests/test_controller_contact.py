"""The controller's reactions to what touches the link, in lockstep: a wall, a push, a clamp; and back again."""

from dataclasses import replace

import controllerkit as kit
import pytest
from vsacontrol.phases import Phase, Reaction

from sim.effects import parse
from sim.excitation import build

REACTS_WITHIN_S = 0.05  # of bus time, from the first touch; the push is strong enough to be seen at once
WALL = "contact=3.0,position_rad={:.4f},side={:d}"
NOTHING = build({"kind": "none"}, 2)


def touches(rig, obstacle: str) -> None:
    """Put an obstacle where the link is."""
    q = rig.world.truth().link_position_rad
    if obstacle == "wall":  # in the way that the link goes
        side = 1 if rig.world.truth().link_velocity_rad_s > 0.0 else -1
        rig.world.alter(effects=[parse(WALL.format(q, side))])
    elif obstacle == "clamp":
        rig.world.alter(effects=[parse(WALL.format(q, side)) for side in (1, -1)])
    else:
        table = {"kind": "none", "external": {"kind": "none", "offset_nm": 0.12}}
        rig.world.excitation = build(table, 2)


def lets_go(rig) -> None:
    rig.world.alter(effects=[])
    rig.world.excitation = NOTHING


def reacts(rig, limit_s: float) -> float:
    """Run until it reacts; how long that took, of bus time."""
    begin_s = rig.now_s
    assert rig.run(limit_s, until=lambda: rig.controller.phase is Phase.REACT), rig.controller.events
    return rig.now_s - begin_s


@pytest.mark.slow
@pytest.mark.parametrize("obstacle", ["wall", "push", "clamp"])
@pytest.mark.parametrize("reaction", [*Reaction])
def test_it_reacts_to_what_touches_it_and_goes_on_when_it_is_gone(reaction, obstacle):
    with kit.running(settings=replace(kit.QUICK, reaction=reaction)) as rig:
        touches(rig, obstacle)
        took_s = reacts(rig, 2.0)
        if obstacle == "push":
            assert took_s <= REACTS_WITHIN_S
        assert rig.controller.events[-1].reason == f"contact: {reaction}"
        at, stiff = rig.world.truth().link_position_rad, rig.world.truth().stiffness_nm_rad
        row = None
        for _ in range(450):  # before it goes on where nothing touches it any more
            row = rig.step()
        if reaction is Reaction.RETRACT and obstacle != "clamp":
            assert abs(row.q - at) > 0.05  # it gave way …
        elif reaction is Reaction.SOFTEN:
            assert row.sigma < 0.9 * stiff
        elif obstacle != "push":
            assert abs(row.q - at) < 0.1  # it stays
        lets_go(rig)
        assert kit.recovers(rig, 12.0)[-1] is Phase.RUN  # it may have been on the way already


def test_a_motion_that_nothing_touches_is_not_interrupted():
    with kit.running(seconds=8.0) as rig:
        assert not [event for event in rig.controller.events if event.phase in (Phase.REACT, Phase.SAFE)]
