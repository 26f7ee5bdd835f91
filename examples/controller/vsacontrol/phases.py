"""The controller's inputs and outputs: phases, drives, events, limits and times."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

__all__ = ["SAFE_TORQUES", "Drives", "Event", "Phase", "Reaction", "Settings"]

SAFE_TORQUES = (0.0, 0.0)


class Phase(StrEnum):
    """What the controller does."""

    WAITING = "waiting"  # for estimates and enabled drives
    IDENTIFY = "identify"  # moves open loop so that the daemon identifies the springs
    APPROACH = "approach"  # goes to where the reference is
    RUN = "run"  # follows the reference
    REACT = "react"  # something touches the link
    SAFE = "safe"  # safe torque, because of a fault


class Reaction(StrEnum):
    """What the controller does about a contact."""

    STOP = "stop"  # stays where it is, as stiff as it is
    RETRACT = "retract"  # gives way, the way it was pushed
    SOFTEN = "soften"  # stays where it is, as soft as the joint can be


class Drives(NamedTuple):
    """What the CANopen master knows."""

    enabled: bool
    faulted: bool


class Event(NamedTuple):
    """A change of phase.

    Attributes:
        time_s: when, monotonic.
        phase: to what.
        reason: why, where that is no matter of course.
        age_s: of the last fresh cycle.
    """

    time_s: float
    phase: Phase
    reason: str
    age_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Limits and times.

    Attributes:
        deadline_s: age of the last fresh cycle, and of the last valid one, from which it is safe torque.
        hold_s: without any fault before it goes on.
        doubt_s: the same, where the joint did what it should not.
        identify_s: of the first identification.
        again_s: of one after the joint has changed.
        approach_s: of the way to the reference; it rests there for `rest_s`.
        rest_s: see there.
        fade_s: from one phase's torque to the next one's.
        torque_nm: limit of each motor's torque.
        position_rad: limit of |q|.
        deflection_rad: limit of |phi_i|; the VSA-II's linkage is stretched out at 1.217 rad.
        speed_rad_s: limit of the link's speed.
        motor_mismatch_nm: undeclared torque at a motor from which the model is not believed.
        mismatch_cycles: for which it must last.
        reaction: to a contact, which the daemon reports.
        retract_rad: how far it gives way, in `retract_s`.
        retract_s: see there.
        soft_nm_rad: total stiffness of the softened joint.
        clear_s: without a contact before it goes on.
        certainty: relative standard deviation of the stiffness that ends an identification.
    """

    deadline_s: float = 0.010
    hold_s: float = 0.3
    doubt_s: float = 1.0
    identify_s: float = 20.0
    again_s: float = 4.0
    approach_s: float = 1.5
    rest_s: float = 1.0
    fade_s: float = 0.1
    torque_nm: float = 0.4
    position_rad: float = 1.2
    deflection_rad: float = 1.15
    speed_rad_s: float = 15.0
    motor_mismatch_nm: float = 0.01
    mismatch_cycles: int = 3
    reaction: Reaction = Reaction.STOP
    retract_rad: float = 0.15
    retract_s: float = 0.3
    soft_nm_rad: float = 0.4
    clear_s: float = 0.5
    certainty: float = 0.02
