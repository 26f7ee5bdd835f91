"""Probability of each named effect, from all explanations that are about as likely.

An account is a fitted set of effects. Its weight relative to the one found is the odds that it would be
better on a longer recording (`Search.chance`): the pairwise form of model weights from the variation of
predictive densities over the data (pseudo-BMA+; Yao, Vehtari, Simpson and Gelman, Bayesian Analysis 13,
2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from estimator.choices import choice
from estimator.diagnosis.candidates import AGAIN
from estimator.diagnosis.heldout import Held
from estimator.diagnosis.hypothesis import Fitted, Keys
from estimator.diagnosis.search import Search

__all__ = ["Account", "Standing", "accounts", "standing"]


class Account(NamedTuple):
    """One set of effects; the weight of the one found is one."""

    weight: float
    fitted: Fitted

    @property
    def keys(self) -> Keys:
        """Its effects and their places; a free curve counts as unlisted."""
        return self.fitted.keys


class Standing(NamedTuple):
    """Probability of a name, and its alternatives as (name, probability), the most probable first."""

    probability: float
    alternatives: tuple[tuple[str, float], ...]


def accounts(search: Search, held: Held, found: Fitted, others: Sequence[Fitted]) -> list[Account]:
    """Return the account found and others with at most as many effects; the best fit for each
    set of effects.

    One of the same families, with at most as many parameters, that held-out data cannot tell from it is as
    likely.
    """
    made: dict[Keys, Account] = {found.keys: Account(1.0, found)}
    for other in others:
        if len(other.terms) > len(found.terms) or other.keys == found.keys:
            continue
        chance = min(search.chance(found, other), 0.5)  # nothing is likelier than what was found
        simpler = other.families == found.families and other.parameters <= found.parameters
        if simpler and other.believable and held.alike(found, other):
            chance = 0.5
        account = Account(chance / (1.0 - chance), other)
        if other.keys not in made or account.weight > made[other.keys].weight:
            made[other.keys] = account
    return list(made.values())


def standing(search: Search, found: Fitted, k: int, beside: Sequence[Account]) -> Standing:
    """Return the probability and alternatives of the k-th effect found."""
    key = found.terms[k].candidate.key
    own = {name.rstrip(AGAIN) for name, _ in found.keys}
    total = sum(a.weight for a in beside)
    probability = sum(a.weight for a in beside if key in a.keys) / total
    others: dict[str, float] = {}
    for account in beside:
        if key not in account.keys:
            for name in {name.rstrip(AGAIN) for name, _ in account.keys} - own:
                others[name] = others.get(name, 0.0) + account.weight / total
    if key[0] == "motor_inertia" and not search.problem.frames[0].linked:
        # Without a second balance torque scale and inertia scale cannot be separated.
        probability, others["torque_constant"] = probability / 2.0, probability / 2.0
    listed = sorted(((n, p) for n, p in others.items() if p > choice("even")), key=lambda pair: -pair[1])
    return Standing(probability, tuple(listed))
