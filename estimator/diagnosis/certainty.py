"""How sure each name is: the accounts of the data that are about as likely, and what they call it.

An account is a set of effects at its best fit. Its weight beside the account found is the odds that it would
turn out the better one, had the recording gone on (`Search.chance`): the pairwise form of weighting models by
how their predictive densities vary over the data (pseudo-BMA+; Yao, Vehtari, Simpson and Gelman, Bayesian
Analysis 13, 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from estimator.diagnosis.choices import choice
from estimator.diagnosis.hypothesis import Fitted, Keys
from estimator.diagnosis.search import Search

__all__ = ["Account", "Standing", "accounts", "standing"]


class Account(NamedTuple):
    """One set of effects; the weight of the one found is one."""

    weight: float
    fitted: Fitted

    @property
    def keys(self) -> Keys:
        """Its effects and where they are; a free curve is an unlisted one."""
        return self.fitted.keys


class Standing(NamedTuple):
    """How sure a name is, and what else the data may show: (name, probability), likeliest first."""

    probability: float
    alternatives: tuple[tuple[str, float], ...]


def accounts(search: Search, found: Fitted, others: Sequence[Fitted]) -> list[Account]:
    """The account found and others with as many effects at most; of one set of effects the likeliest fit."""
    made: dict[Keys, Account] = {found.keys: Account(1.0, found)}
    for other in others:
        if len(other.terms) > len(found.terms) or other.keys == found.keys:
            continue
        chance = min(search.chance(found, other), 0.5)  # nothing is likelier than what was found
        account = Account(chance / (1.0 - chance), other)
        if other.keys not in made or account.weight > made[other.keys].weight:
            made[other.keys] = account
    return list(made.values())


def standing(search: Search, found: Fitted, k: int, beside: Sequence[Account]) -> Standing:
    """How sure the k-th effect of the account found is."""
    key = found.terms[k].candidate.key
    own = {name for name, _ in found.keys}
    total = sum(a.weight for a in beside)
    probability = sum(a.weight for a in beside if key in a.keys) / total
    others: dict[str, float] = {}
    for account in beside:
        if key not in account.keys:
            for name in {name for name, _ in account.keys} - own:
                others[name] = others.get(name, 0.0) + account.weight / total
    if key[0] == "motor_inertia" and not search.problem.frames[0].linked:
        # Without a second balance the torque's scale and the inertia's are one number.
        probability, others["torque_constant"] = probability / 2.0, probability / 2.0
    listed = sorted(((n, p) for n, p in others.items() if p > choice("even")), key=lambda pair: -pair[1])
    return Standing(probability, tuple(listed))
