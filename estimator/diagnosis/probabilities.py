"""Probability of each named effect: the stacking weights of all explanations that have it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from estimator.choices import choice
from estimator.diagnosis.candidates import AGAIN
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted, Keys
from estimator.diagnosis.twins import Twin

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
    """Return the most probable of the hypothesis and simpler ones.

    Simpler is one without some of its effects, or with laws of the same phenomena that have fewer parameters.
    """

    def simpler(one: Fitted) -> bool:
        fewer = one.families <= found.families and one.parameters < found.parameters
        return fewer or one.named <= found.named

    every = accounts(held, found, others)
    return max((pair for pair in every if simpler(pair[1])), key=lambda pair: pair[0])[1]


def chances(found: Fitted, beside: Sequence[tuple[float, Fitted]], alike: Sequence[Twin] = ()) -> Chances:
    """Return the probability of each effect that any account has.

    Args:
        found: the hypothesis.
        beside: all accounts.
        alike: what no data tell from its effects.
    """
    made: dict[Key, float] = {}
    for weight, one in beside:
        for key in one.keys | (one.named & found.keys):
            made[key] = made.get(key, 0.0) + weight
    for twin in alike:
        mine, instead = twin.held & found.keys, twin.instead - found.keys
        every = (max((made.get(key, 0.0) for key in keys), default=0.0) for keys in (mine, instead))
        made |= dict.fromkeys(mine | instead, min(sum(every), 1.0) / 2.0)
    return made


def standing(
    found: Fitted,
    k: int,
    beside: Sequence[tuple[float, Fitted]],
    chance: Chances,
    alike: Sequence[Twin] = (),
) -> Standing:
    """Return the probability and alternatives of the k-th effect found: what accounts have in its place.

    Args:
        found: the hypothesis. k: which of its effects.
        beside: all accounts. chance: what `chances` says of them.
        alike: as there.
    """
    key = found.terms[k].candidate.key
    own = {name.rstrip(AGAIN) for name, _ in found.keys}
    twins = {
        name.rstrip(AGAIN): chance[key]
        for twin in alike
        if key in twin.held
        for name, _ in twin.instead - found.keys
    }
    instead: dict[str, float] = {}
    for weight, one in beside:
        if key not in one.named:
            for name in {name.rstrip(AGAIN) for name, _ in one.keys} - own - set(twins):
                instead[name] = instead.get(name, 0.0) + weight
    listed = [
        (name, max(p for (other, _), p in chance.items() if other.rstrip(AGAIN) == name))
        for name, weight in instead.items()
        if weight > choice("even")
    ]
    return Standing(chance[key], tuple(sorted([*twins.items(), *listed], key=lambda pair: -pair[1])))
