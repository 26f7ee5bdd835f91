"""The library of physical effects: batch regressors and their on-line terms, from one definition."""

from estimator.effects.library import LIBRARY
from estimator.effects.online import OnlineEffects, Torques, elements
from estimator.effects.types import Coordinates, EffectType, Parameter

__all__ = ["LIBRARY", "Coordinates", "EffectType", "OnlineEffects", "Parameter", "Torques", "elements"]
