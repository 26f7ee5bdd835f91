"""A joint whose motor a controller holds while a hand moves the link, with presliding friction; in closed form."""

import math

import numpy as np
import onlinekit as kit

from estimator import JointModel, Motor, Sample, Transmission

B, D, M, K = 0.12, 0.8, 0.4, 150.0
PRESLIDING, SLIDING = 30.0, 0.5  # N·m/rad, up to so many N·m (Dahl's law)
KP, KD = 100.0, 4.0
HAND, HAND_DAMPING = 100.0, 2.0
COUNT = 2.0 * math.pi / 2**21
STEPS = 10  # of the integration in one period
NAN = (math.nan,)


def tones(rng, low, high, rms):
    """A sum of eight sines between two frequencies, as a function of time."""
    frequency = np.geomspace(low, high, 8) * rng.uniform(0.9, 1.1, 8)
    phase = rng.uniform(0.0, 2.0 * math.pi, 8)
    size = rms / 2.0  # of each: eight of them
    return lambda t: size * float(np.sum(np.sin(2.0 * math.pi * frequency * t + phase)))


def moved(seconds, by_hand_until=math.inf, kp=KP, hand_rad=0.02):
    """Samples of a held motor whose link a hand moves; then the motor is driven, and nobody touches the link."""
    rng = np.random.default_rng(4)
    hand, drive = tones(rng, 0.2, 3.0, hand_rad), tones(rng, 0.3, 5.0, 6.0)
    theta = omega = q = v = friction = before = 0.0
    h = kit.PERIOD_S / STEPS
    samples = []
    for k in range(round(seconds / kit.PERIOD_S)):
        t = k * kit.PERIOD_S
        read = round(theta / COUNT) * COUNT
        torque = -kp * read - KD * (read - before) / kit.PERIOD_S
        target, before = None, read
        if t < by_hand_until:
            target = hand(t)
        else:
            torque = drive(t) - 0.1 * K * read
        samples.append(Sample(k, (read,), NAN, (torque,), round(q / COUNT) * COUNT))
        for _ in range(STEPS):
            elastic = K * (q - theta)
            external = 0.0 if target is None else HAND * (target - q) - HAND_DAMPING * v
            friction += h * PRESLIDING * (omega - abs(omega) * friction / SLIDING)
            omega += h / B * (torque + elastic - D * omega - friction)
            v += h / M * (external - elastic)
            theta += h * omega
            q += h * v
    return samples


def declared():
    """The joint as a user declares it, without its friction."""
    motor = Motor(inertia_kg_m2=B, viscous_damping_nm_s_rad=D, transmission=Transmission(model="linear"))
    return JointModel(arrangement="single", motors=(motor,), period_s=kit.PERIOD_S)
