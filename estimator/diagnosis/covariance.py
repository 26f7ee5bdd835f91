"""Covariance of a fitted hypothesis under model errors, which are not noise.

Model errors persist (they are similar at neighbouring times) and depend on the motion (they are similar in
similar states at any time). Rows are therefore grouped twice, by stretches of time and by kinds of motion,
and errors within a group are correlated: a heteroscedasticity and autocorrelation consistent covariance by
clusters (CR2 of Bell and McCaffrey, Survey Methodology 28, 2002), clustered two ways (Cameron, Gelbach and
Miller, J. of Business and Economic Statistics 29, 2011).
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.special import stdtrit

from estimator.choices import choice, whole
from estimator.diagnosis.hypothesis import Fitted
from estimator.diagnosis.problem import Problem, stretches
from estimator.sample import SIGMA_95, FloatArray

__all__ = ["design_effects", "hac_covariance"]


_FULL = 1e-9  # leverage is below one by the priors; guards a division against rounding

Labels = NDArray[np.int64]


def hac_covariance(problem: Problem, fitted: Fitted, surplus: float = 1.0) -> FloatArray:
    """Return (k, k) covariance of the parameters, at least that of the posterior.

    Standard deviations are scaled so that 1.96 of them are the 95 % interval of a t distribution, whose
    degrees of freedom follow from the number of groups that determine the parameter.

    Args:
        problem: the recordings.
        fitted: to all of them.
        surplus: mean square of the errors over that of the residual (`Held.surplus`).
    """
    free, moderated, freedom = _moderated(problem, fitted, surplus)
    out = np.zeros((len(fitted.posterior.x),) * 2)
    wider = stdtrit(freedom, NormalDist().cdf(SIGMA_95)) / SIGMA_95
    unit = _unit(fitted, free) * wider
    out[np.ix_(free, free)] = moderated * np.outer(unit, unit)
    return out + sum(_attenuated(problem, fitted, i) for i in range(len(problem.model.motors)))


def _attenuated(problem: Problem, fitted: Fitted, motor: int) -> FloatArray:
    """(k, k) what noise in a motor's deflection, velocity and acceleration moves the parameters by, squared.

    Errors in variables (Fuller, Measurement Error Models, 1987): the covariance of each column's noise with
    that of the row is taken for signal. It is nothing where the motor drives the motion.
    """
    posterior, law = fitted.posterior, fitted.base.models(problem.frames[0])[motor]
    declared, numbers = problem.model.motors[motor], {"motor_inertia": 0.0, "viscous_damping": 0.0}
    for slot, x in zip(fitted.slots, posterior.x, strict=True):
        if slot.name in numbers and slot.motor == motor:
            numbers[slot.name] += slot.taken + float(x)
    inertia = declared.inertia_kg_m2 + numbers["motor_inertia"]
    damping = declared.viscous_damping_nm_s_rad + numbers["viscous_damping"]
    taken = np.zeros(len(posterior.x))
    for run, frame in enumerate(problem.at(fitted.corrections, fitted.base)):
        group, c = run * problem.equations + motor, frame.motors[motor]
        velocity, acceleration, deflection = frame.signals.position_noise(motor)
        shaken = {"motor_inertia": inertia * acceleration, "viscous_damping": damping * velocity}
        bends = np.zeros(0)
        if law is not None:
            slopes = law.stiffness_jacobian(c.deflection, fitted.base.alpha[motor])
            shaken["motor_inertia"] -= float(np.mean(c.stiffness)) * velocity
            bends = slopes.T @ c.stiffness * (deflection / len(slopes))
            bends -= np.mean(slopes, axis=0) * inertia * velocity
        rows = np.count_nonzero(problem.group == group)
        weight = rows / (fitted.times[group] * posterior.sigma[group] ** 2)
        for j, slot in enumerate(fitted.slots):
            if slot.motor == motor and slot.kind != "shape":
                own = bends[slot.place] if slot.kind == "base" else shaken.get(slot.name, 0.0)
                taken[j] += float(weight * own)
    moved = posterior.covariance @ taken
    return np.outer(moved, moved)


def design_effects(problem: Problem, fitted: Fitted, surplus: float = 1.0) -> FloatArray:
    """Return (k,) variance of each parameter over that of independent rows, at least 1.

    So many rows have the information of one (Kish, Survey Sampling, 1965).
    """
    free, moderated, _ = _moderated(problem, fitted, surplus)
    out = np.ones(len(fitted.posterior.x))
    out[free] = np.diag(moderated)
    return out


def _unit(fitted: Fitted, free: NDArray[np.int64]) -> FloatArray:
    """(f,) standard deviations of the free parameters by the posterior."""
    return np.sqrt(np.maximum(np.diag(fitted.posterior.covariance)[free], 1e-300))


def _moderated(
    problem: Problem, fitted: Fitted, surplus: float
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """(free parameters, their covariance over the posterior's deviations, degrees of freedom of each).

    The clustered covariance is that by stretches of time plus that by kinds of motion minus that of rows that
    share both. With few groups it is uncertain, so it is moderated by that of independent errors, which
    counts as a number of groups (Smyth, Statistical Applications in Genetics and Molecular Biology 3, 2004).
    The priors' part is added; errors beyond the residual do not change it.
    """
    posterior = fitted.posterior
    free = np.flatnonzero(~posterior.bound)
    if not len(free):
        return free, np.zeros((0, 0)), np.zeros(0)
    unit = _unit(fitted, free)
    bread = posterior.covariance[np.ix_(free, free)] / np.outer(unit, unit)
    stretch = stretches(problem)
    kind = _kinds(problem, fitted)
    both = stretch * whole("groups") + kind
    by_time, freedom = _clustered(fitted, free, unit, bread, stretch)
    by_kind, by_both = (_clustered(fitted, free, unit, bread, x)[0] for x in (kind, both))
    values, vectors = np.linalg.eigh(by_kind - by_both)
    clustered = by_time + (vectors * np.maximum(values, 0.0)) @ vectors.T
    prior = bread @ np.diag((unit / fitted.regression.std[free]) ** 2) @ bread
    total = freedom + choice("moderation")
    own, theirs = np.sqrt(choice("moderation") / total), np.sqrt(freedom / total)
    errors = (bread - prior) * np.outer(own, own) + clustered * np.outer(theirs, theirs)
    least = np.sqrt(np.maximum(1.0 / np.maximum(np.diag(prior + errors), 1e-300), 1.0))
    return free, (prior + surplus * errors) * np.outer(least, least), total


def _clustered(
    fitted: Fitted, free: NDArray[np.int64], unit: FloatArray, bread: FloatArray, labels: Labels
) -> tuple[FloatArray, FloatArray]:
    """(covariance of x / unit where errors of one group of rows belong together, degrees of freedom).

    Residuals are corrected for the leverage H of their group: (1 - H)^(-1/2) e (CR2). The
    effective number of groups is (sum h)^2 / sum h^2, h the part of each in a parameter's variance.
    """
    regression = fitted.regression
    weight = np.sqrt(1.0 / (fitted.times * fitted.posterior.sigma**2))[regression.group]
    rows = regression.tangent(fitted.posterior.x)[:, free] * (weight[:, None] * unit)
    left = regression.residual(fitted.posterior.x) * weight
    sizes, directions = np.linalg.eigh(bread)
    root = directions * np.sqrt(np.maximum(sizes, 0.0))  # rounding may leave one below zero
    total = np.zeros_like(bread)
    parts = []
    for group in np.unique(labels):
        mine = labels == group
        a, e = rows[mine], left[mine]
        u, s, _ = np.linalg.svd(a @ root, full_matrices=False)  # H = u s² u'
        e = e + u @ ((1.0 / np.sqrt(np.maximum(1.0 - s**2, _FULL)) - 1.0) * (u.T @ e))
        change = bread @ (a.T @ e)
        total += np.outer(change, change)
        parts.append(np.sum((a @ bread) ** 2, axis=0))
    h = np.array(parts)
    freedom = np.sum(h, axis=0) ** 2 / np.maximum(np.sum(h**2, axis=0), 1e-300) - 1.0
    return total, np.maximum(freedom, 0.0)


def _kinds(problem: Problem, fitted: Fitted) -> Labels:
    """(n,) kind of motion of each row, by position, velocity, acceleration and deflection (k-means)."""
    made = []
    for frame in problem.at(fitted.corrections, fitted.base):
        parts = []
        for c, flexible in zip(frame.motors, frame.flexible, strict=True):
            parts += [c.position, c.velocity, c.acceleration] + ([c.deflection] if flexible else [])
        made.append(frame.project(np.stack(parts)).T)
    states = np.concatenate(made)
    states = (states - states.mean(axis=0)) / np.maximum(states.std(axis=0), 1e-300)
    _, kinds = kmeans2(states, whole("groups"), minit="++", seed=0)
    ends = np.cumsum([frame.rows for frame in problem.frames])[:-1]
    return np.concatenate([np.tile(part, problem.equations) for part in np.split(kinds, ends)]).astype(
        np.int64
    )
