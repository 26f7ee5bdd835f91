"""An extended Kalman filter on the raw positions, with the stiffness parameters as states, beside ours.

    python benchmarks/ekf.py [--joints 8] [--seconds 20] [--seed 1] [--cases NAME,…]

The joints are those of `ensembles.py`, and so are the measures: from five seconds on, error and coverage of
the stiffness. The filter's states are θ, θ′, q, q′, q″, the law's parameters, Coulomb friction, the torque's
offset, the zero between the encoders and the link's delay; its model of the motor is eq 5, that of the link
white jerk. It is given what a user would have to find out: the law with parameters that are right to its
prior, the true variance of the torque's noise and of the link's jerk. It has no gaps, no alarms and no check
of its input; its covariance is published as it is. CPU is one joint's, of numpy beside the compiled core; the
multiplications of a tick are counted.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import scene
from ensembles import CASES, OPTIONS, USABLE, T, draw_joints, judged, summary
from scene import joints as world

from estimator import EstimatorSettings, make_estimator

THETA, OMEGA, Q, DQ, DDQ, LAW = range(6)
STRIBECK_RAD_S = 0.02  # friction is a tanh of the velocity over this
DELAY_STD = 3.0  # periods
FRICTION_STD, OFFSET_STD = 0.1, 0.1  # of the largest torque
ZERO_STD_RAD = 0.01
WANDER = 1e-4  # of a parameter's prior standard deviation, in a second: it is a constant


class Law:
    """Torque, stiffness, slopes of both by the parameters, for a row of joints at once."""

    def __init__(self, model, order):
        self.polynomial = model in ("linear", "polynomial")
        self.size = {"linear": 1, "polynomial": order or 3}.get(model, 2)
        self._model = model

    def torque(self, phi, a):
        if self.polynomial:
            return sum(a[:, h] * phi ** (2 * h + 1) for h in range(self.size))
        if self._model == "vsa-ii":
            return world.vsa_ii(a[:, 0], a[:, 1])[0](phi)
        return np.sign(phi) * a[:, 0] / a[:, 1] * np.expm1(a[:, 1] * np.abs(phi))

    def stiffness(self, phi, a):
        if self.polynomial:
            return sum((2 * h + 1) * a[:, h] * phi ** (2 * h) for h in range(self.size))
        if self._model == "vsa-ii":
            return world.vsa_ii(a[:, 0], a[:, 1])[1](phi)
        return a[:, 0] * np.exp(a[:, 1] * np.abs(phi))

    def slopes(self, function, phi, a):
        """By the parameters, (joints, size), by differences."""
        out = np.empty(a.shape)
        for i in range(a.shape[1]):
            h = 1e-6 * np.maximum(np.abs(a[:, i]), 1e-9)
            more = a.copy()
            more[:, i] += h
            out[:, i] = (function(phi, more) - function(phi, a)) / h
        return out

    def prior(self, declared, torque, deflection):
        """Mean and standard deviation, (joints, size)."""
        if declared is not None:
            return declared, 0.3 * np.abs(declared)
        count = len(torque)
        if self.polynomial:
            unit = np.stack([torque / deflection ** (2 * h + 1) for h in range(self.size)], axis=1)
            return 0.5 * unit * (np.arange(self.size) == 0), 2.0 * unit
        middle, std = {"vsa-ii": ((500.0, 1.7), (200.0, 0.15)), "exponential": ((150.0, 7.0), (80.0, 3.0))}[
            self._model
        ]
        return np.tile(middle, (count, 1)), np.tile(std, (count, 1))


class Filter:
    """The filter of a row of joints at once."""

    def __init__(self, law, drawn):
        records = [joint.record for joint in drawn]
        self.law, count = law, len(records)
        self.theta = np.stack([np.ravel(r.motor_position_rad) for r in records])
        self.tau = np.stack([np.ravel(r.motor_torque_nm) for r in records])
        self.q = np.stack([r.link_position_rad for r in records])
        self.B = np.array([joint.model.motors[0].inertia_kg_m2 for joint in drawn])
        self.D = np.array([joint.model.motors[0].viscous_damping_nm_s_rad for joint in drawn])
        resolution = [[np.min(np.abs(np.diff(np.unique(x)))) for x in each] for each in (self.theta, self.q)]
        self.noise = np.array(resolution).T ** 2 / 12.0
        torque, deflection = np.abs(self.tau).max(axis=1), np.abs(self.q - self.theta).max(axis=1)
        declared = [joint.model.motors[0].transmission.parameters for joint in drawn]
        given = np.array([list(p.values()) for p in declared]) if declared[0] else None
        mean, std = law.prior(given, torque, deflection)
        self.n = n = LAW + law.size + 4
        self.friction, self.offset, self.zero, self.delay = range(n - 4, n)
        self.x, self.P = np.zeros((count, n)), np.zeros((count, n, n))
        self.x[:, THETA], self.x[:, Q], self.x[:, LAW : LAW + law.size] = self.theta[:, 0], self.q[:, 0], mean
        prior = np.zeros((count, n))
        prior[:, [THETA, Q]] = np.sqrt(self.noise)
        prior[:, [OMEGA, DQ]], prior[:, DDQ] = 1.0, 30.0
        prior[:, LAW : LAW + law.size] = std
        prior[:, self.friction], prior[:, self.offset] = FRICTION_STD * torque, OFFSET_STD * torque
        prior[:, self.zero], prior[:, self.delay] = ZERO_STD_RAD, DELAY_STD
        self.P[:, range(n), range(n)] = prior**2
        self.Q = np.zeros((count, n, n))
        wander = (WANDER * prior) ** 2 * T
        self.Q[:, range(n), range(n)] = wander
        self.Q[:, [THETA, Q], [THETA, Q]] = 0.0
        self.Q[:, OMEGA, OMEGA] = (T / self.B * np.array([j.torque_noise_nm for j in drawn])) ** 2
        jerk = np.array([joint.jerk_rad_s3 for joint in drawn]) ** 2 * T
        walk = np.array([T * T * T / 6.0, T * T / 2.0, T])  # of q, q′, q″ by a jerk that is white
        self.Q[:, Q : DDQ + 1, Q : DDQ + 1] = jerk[:, None, None] * np.outer(walk, walk) / T
        self.F = np.tile(np.eye(n), (count, 1, 1))
        self.F[:, THETA, OMEGA] = self.F[:, Q, DQ] = self.F[:, DQ, DDQ] = T
        self.F[:, Q, DDQ] = 0.5 * T * T

    def step(self, k):
        """Prediction and two scalar corrections; (stiffness, its standard deviation)."""
        x, F, law, n = self.x, self.F, self.law, self.n
        a, tau = x[:, LAW : LAW + law.size], self.tau[:, k - 1]
        phi = x[:, Q] - x[:, THETA] + x[:, self.zero]
        stiff, grip = law.stiffness(phi, a), np.tanh(x[:, OMEGA] / STRIBECK_RAD_S)
        slope = (1.0 - grip**2) / STRIBECK_RAD_S * x[:, self.friction]
        pull = (
            tau + law.torque(phi, a) - self.D * x[:, OMEGA] - x[:, self.friction] * grip + x[:, self.offset]
        )
        gain = T / self.B
        F[:, OMEGA, THETA], F[:, OMEGA, Q], F[:, OMEGA, self.zero] = -gain * stiff, gain * stiff, gain * stiff
        F[:, OMEGA, OMEGA] = 1.0 - gain * (self.D + slope)
        F[:, OMEGA, LAW : LAW + law.size] = gain[:, None] * law.slopes(law.torque, phi, a)
        F[:, OMEGA, self.friction], F[:, OMEGA, self.offset] = -gain * grip, gain
        x[:, THETA] += T * x[:, OMEGA] + 0.5 * T * gain * pull
        x[:, OMEGA] += gain * pull
        x[:, Q] += T * x[:, DQ] + 0.5 * T * T * x[:, DDQ]
        x[:, DQ] += T * x[:, DDQ]
        self.P = F @ self.P @ F.transpose(0, 2, 1) + self.Q
        for measured, place in ((self.theta[:, k], THETA), (self.q[:, k], Q)):
            h = np.zeros((len(x), n))
            h[:, place] = 1.0
            expected = x[:, place].copy()
            if place == Q:  # the link is late by so many periods
                expected -= T * x[:, self.delay] * x[:, DQ]
                h[:, DQ], h[:, self.delay] = -T * x[:, self.delay], -T * x[:, DQ]
            Ph = np.einsum("jab,jb->ja", self.P, h)
            K = Ph / (np.einsum("ja,ja->j", h, Ph) + self.noise[:, int(place == Q)])[:, None]
            x += K * (measured - expected)[:, None]
            self.P -= K[:, :, None] * Ph[:, None, :]
        self.P = 0.5 * (self.P + self.P.transpose(0, 2, 1))
        return self._curve()

    def _curve(self):
        x, law = self.x, self.law
        a, phi = x[:, LAW : LAW + law.size], x[:, Q] - x[:, THETA] + x[:, self.zero]
        stiff, h = law.stiffness(phi, a), 1e-6
        row = np.zeros(x.shape)
        row[:, LAW : LAW + law.size] = law.slopes(law.stiffness, phi, a)
        by_phi = (law.stiffness(phi + h, a) - law.stiffness(phi - h, a)) / (2 * h)
        row[:, THETA], row[:, Q], row[:, self.zero] = -by_phi, by_phi, by_phi
        return stiff, np.sqrt(np.maximum(np.einsum("ja,jab,jb->j", row, self.P, row), 0.0))

    def multiplications(self):
        """Of one tick of one joint: F P F' with what of F is not that of 1, two corrections, laws aside."""
        dense = self.n + 5  # entries of F that are not those of the unit matrix
        return 2 * dense * self.n + 2 * (2 * self.n**2 + 3 * self.n)


def compare(case, n_joints, seconds, seed) -> scene.Row:
    """One row."""
    drawn = list(draw_joints(case, n_joints, seconds, seed))
    _, model, order, *_ = CASES[case]
    steps, ours, us = len(drawn[0].record), [], []
    for joint in drawn:
        estimator, samples = make_estimator(joint.model, EstimatorSettings(), T), list(joint.record.samples())
        start = time.process_time()
        out = np.array([estimator.step(sample)[:5] for sample in samples])
        us.append(1e6 * (time.process_time() - start) / steps)
        usable = out[:, 1].astype(int) & USABLE == USABLE
        ours.append(judged(out[:, 3], out[:, 4], joint.stiffness_nm_rad, usable))
    with np.errstate(all="ignore"):
        ekf = Filter(Law(model, order), drawn)
        stepped = np.array([ekf.step(k) for k in range(1, steps)])  # (steps, 2, joints)
        theirs = []
        for j, joint in enumerate(drawn):
            stiffness, std = (np.concatenate([[np.nan], stepped[:, i, j]]) for i in (0, 1))
            usable = np.isfinite(stiffness) & (std < 0.25 * stiffness)
            theirs.append(judged(stiffness, std, joint.stiffness_nm_rad, usable))
        single = Filter(Law(model, order), drawn[:1])
        start = time.process_time()
        for k in range(1, 1000):
            single.step(k)
    us = {"ours_us": float(np.median(us)), "ekf_us": 1e3 * (time.process_time() - start)}
    states = {"states": ekf.n, "multiplications": ekf.multiplications()}
    return {"case": case, **us, **states, "ours": summary(ours), "ekf": summary(theirs)}


def rows(args) -> Iterator[scene.Row]:
    """One row a case."""
    return (compare(case, args.joints, args.seconds, args.seed) for case in args.cases)


if __name__ == "__main__":
    columns = {"springs": "{case}"}
    for name, key, form in (
        ("usable", "usable", ".0%"),
        ("RMSE, median", "rmse_median", ".2%"),
        ("worst", "rmse_worst", ".2%"),
        ("95 % intervals hold", "coverage", ".0%"),
    ):
        columns[f"{name}: ours, EKF"] = f"{{ours[{key}]:{form}}}, {{ekf[{key}]:{form}}}"
    columns |= {"µs a tick: ours compiled, EKF in numpy": "{ours_us:.1f}, {ekf_us:.0f}"}
    columns |= {"EKF's states, multiplications": "{states}, {multiplications}"}
    scene.main(__doc__, rows, columns, *OPTIONS)
