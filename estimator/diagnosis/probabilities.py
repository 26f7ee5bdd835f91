"""Probability of each named effect: the stacking weights of all explanations that have it."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import AGAIN
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted, Keys

__all__ = ["Chances", "Standing", "accounts", "believed", "chances", "standing"]

Key = tuple[str, int | None]
Chances = dict[Key, float]  # one figure for each effect, whoever names it


class Standing(NamedTuple):
    """Probability of a name, and its alternatives as (name, probability), the most probable first."""

    probability: float
    alternatives: tuple[tuple[str, float], ...]


def accounts(held: Held, found: Fitted, others: Sequence[Fitted]) -> list[tuple[float, Fitted]]:
    """Return (weight, hypothesis) of the one found and of others with at most as many effects; the weights
    sum to one.

    Of each set of effects the best fit counts.
    """
    best: dict[Keys, Fitted] = {}
    for one in others:
        if len(one.terms) <= len(found.terms) and one.keys != found.keys:
            best[one.keys] = max(best.get(one.keys, one), one, key=lambda h: float(np.mean(held.scores(h))))
    every = [found, *best.values()]
    return list(zip(held.weights(every, found).tolist(), every, strict=True))


def believed(held: Held, found: Fitted, others: Sequence[Fitted]) -> Fitted:
    """Return the hypothesis without the effects that are less probable than their absence."""
    every = accounts(held, found, others)
    return max((pair for pair in every if pair[1].named <= found.named), key=lambda pair: pair[0])[1]


def _twins(
    key: tuple[str, int | None], beside: Keys, linked: bool, polynomial: Container[int | None]
) -> list[str]:
    """What no motion tells from an effect beside others."""
    name, motor = key
    if name == "backlash" and motor in polynomial:
        return ["higher_order_stiffness"]  # a polynomial is no law: one that bends otherwise looks like play
    if name == "motor_inertia" and not linked:
        return ["torque_constant"]  # without a second balance the scales of torque and inertia are one
    both = {("coulomb_friction", motor), ("torque_offset", motor)}
    if key in both and both <= beside:
        return ["asymmetric_friction"]  # it is their sum
    return ["torque_offset"] if name == "asymmetric_friction" else []


def chances(
    found: Fitted,
    beside: Sequence[tuple[float, Fitted]],
    linked: bool,
    polynomial: Container[int | None] = (),
) -> Chances:
    """Return the probability of each effect that any account has.

    Args:
        found: the hypothesis.
        beside: all accounts.
        linked: whether there are two balances.
        polynomial: motors whose spring is a polynomial with nothing known of it.
    """
    made: dict[Key, float] = {}
    for weight, one in beside:
        for key in one.keys | (one.named & found.keys):
            made[key] = made.get(key, 0.0) + weight
    shared: dict[Key, float] = {}
    for name, motor in found.keys:
        for twin in _twins((name, motor), found.keys, linked, polynomial):
            made[name, motor] /= 2.0
            shared[twin, motor] = max(shared.get((twin, motor), 0.0), made[name, motor])
    return made | {key: min(made.get(key, 0.0) + p, 1.0) for key, p in shared.items()}


def standing(
    found: Fitted,
    k: int,
    beside: Sequence[tuple[float, Fitted]],
    chance: Chances,
    linked: bool,
    polynomial: Container[int | None] = (),
) -> Standing:
    """Return the probability and alternatives of the k-th effect found: what accounts have in its place.

    Args:
        found: the hypothesis. k: which of its effects.
        beside: all accounts. chance: what `chances` says of them.
        linked, polynomial: as there.
    """
    key = found.terms[k].candidate.key
    own = {name.rstrip(AGAIN) for name, _ in found.keys}
    instead = dict.fromkeys(_twins(key, found.keys, linked, polynomial), chance[key])
    for weight, one in beside:
        if key not in one.named:
            for name in {name.rstrip(AGAIN) for name, _ in one.keys} - own:
                instead[name] = instead.get(name, 0.0) + weight
    listed = [
        (name, max(p for (other, _), p in chance.items() if other.rstrip(AGAIN) == name))
        for name, weight in instead.items()
        if weight > choice("even")
    ]
    return Standing(chance[key], tuple(sorted(listed, key=lambda pair: -pair[1])))
