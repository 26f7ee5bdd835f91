"""From the transmissions to the joint: how torques and stiffnesses add up (eqs 8-11), and the serial case.

antagonistic: both transmissions pull at the link, phi_i = q - theta_i, torques and stiffnesses add
(eqs 9, 11).

serial: the paper only announces it. Assumed here: the kinematics of the AwAS (Jafari, Tsagarakis,
Vanderborght, Caldwell, "A novel actuator with adjustable stiffness", IROS 2010), where the first motor
moves the link through the flexible transmission, phi = q - theta_1, and the second one, in series with
it, only sets the lever that makes the stiffness. So tau_e,t = tau_e,1 and sigma_t = sigma_1. The second
motor's own balance (eq 7) gives the reaction it works against, which is reported as its torque; it has
no stiffness of its own, so its transmission is "none" in the joint file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from estimator.errors import EstimatorError
from estimator.model import Arrangement, JointModel
from estimator.sample import Estimate, TransmissionEstimate
from estimator.transmissions import RIGID

__all__ = ["check_arrangement", "joint_estimate", "total"]


def check_arrangement(model: JointModel) -> None:
    """Raise EstimatorError where transmissions and arrangement contradict each other."""
    if model.arrangement == "serial" and model.motors[1].transmission.model != RIGID:
        raise EstimatorError(
            f'arrangement = "serial": motor[2].transmission.model: expected "{RIGID}" '
            f'(the second motor sets the stiffness of the first), got "{model.motors[1].transmission.model}"'
        )


def total(arrangement: Arrangement, values: Sequence[float]) -> float:
    """The joint's torque (eq 9) or stiffness (eq 11) from the transmissions' own."""
    return values[0] if arrangement != "antagonistic" else values[0] + values[1]


def joint_estimate(
    arrangement: Arrangement, sequence: int, status: int, transmissions: tuple[TransmissionEstimate, ...]
) -> Estimate:
    """The joint's estimate; standard deviations of independent transmissions add as squares."""
    first = transmissions[0]
    if arrangement != "antagonistic":
        return Estimate(sequence, status, first[0], first[1], first[2], transmissions)
    second = transmissions[1]
    std = math.hypot(first[2], second[2])
    return Estimate(sequence, status, first[0] + second[0], first[1] + second[1], std, transmissions)
