"""A joint whose motor a controller holds while a hand moves the link, with presliding friction (Dahl)."""

import math
from functools import cache

import joints
import numpy as np
import onlinekit as kit

from estimator import Sample

B, D, M, K = 0.12, 0.8, 0.4, 150.0
PRESLIDING, SLIDING = 30.0, 0.5  # N·m/rad, up to so many N·m (Dahl's law)
KP, KD = 100.0, 4.0
HAND, HAND_DAMPING = 100.0, 2.0
COUNT = 2.0 * math.pi / 2**21
NAN = (math.nan,)


@cache
def moved(seconds, kp=KP, hand_rad=0.02):
    """Samples of a held motor whose link a hand moves along a sum of eight sines."""
    rng = np.random.default_rng(4)
    frequency = 2.0 * math.pi * np.geomspace(0.2, 3.0, 8) * rng.uniform(0.9, 1.1, 8)
    phase = rng.uniform(0.0, 2.0 * math.pi, 8)
    reads = [0.0]

    def controller(k, x):
        reads.append(round(x[0, 0] / COUNT) * COUNT)
        return np.array([[-kp * reads[-1] - KD * (reads[-1] - reads[-2]) / kit.PERIOD_S]])

    def hand_and_friction(t, x, rate, tau):
        _, omega, q, v, friction = x[0]
        rate[0, 1] -= friction / B
        hand = 0.5 * hand_rad * np.sum(np.sin(frequency * t + phase))
        rate[0, 3] += (HAND * (hand - q) - HAND_DAMPING * v) / M
        rate[0, 4] = PRESLIDING * (omega - abs(omega) * friction / SLIDING)

    plants = joints.Plants(
        *joints.polynomial(np.array([[[K]]])), *(B, D, M, 0.0, 0.0), more=hand_and_friction, memories=1
    )
    size = (round(seconds / kit.PERIOD_S), 1, 1)
    truth = joints.simulate(plants, controller, kit.PERIOD_S, 2, size=size, method=joints.HEUN)
    link = np.round(truth.q[:, 0] / COUNT) * COUNT
    rows = zip(reads[1:], truth.tau[:, 0, 0].tolist(), link.tolist(), strict=True)
    return [Sample(k, (read,), NAN, (torque,), q) for k, (read, torque, q) in enumerate(rows)]


def declared():
    """The joint as a user declares it, without its friction."""
    return joints.joint_model(B, D, model="linear", period_s=kit.PERIOD_S)
