"""Makes estimators that run tick by tick, and the protocol that they implement."""

import math
from typing import Any, Protocol

import numpy as np

from estimator import _core
from estimator.effects import elements
from estimator.model import JointModel, Motor
from estimator.ranges import require_in_range
from estimator.reasons import reason_text
from estimator.sample import SIGMA_95, Consistency, Estimate, External, Sample
from estimator.settings import EstimatorSettings
from estimator.transmissions import MODELS, RIGID, UNKNOWN, transmission_model


class Estimator(Protocol):
    """Interface of both modes."""

    @property
    def residual_nm(self) -> float:
        """Residual of the torque balance at the last sample, N·m; NaN: unknown."""

    @property
    def flexibility_torque_std_nm(self) -> float:
        """Standard deviation of the joint's flexibility torque at the last sample, N·m; NaN: unknown."""

    @property
    def external(self) -> External | None:
        """External torque on the link at the last sample. None: no link dynamics declared, or no sample yet.
        Never valid if no transmission deflects.
        """

    @property
    def consistency(self) -> Consistency | None:
        """Recent agreement of both sides of the joint on the flexibility torque; None: not known."""

    def step(self, sample: Sample) -> Estimate:
        """Estimate at this sample. Never raises, whatever values the sample has.

        `sample.sequence` counts periods: a jump by more than one is a gap of whole periods.
        """

    def distrust(self) -> None:
        """Use the next sample without updating parameters: its timing is in doubt."""

    def lose_zeros(self) -> None:
        """Forget where the positions' zeros are: a drive that restarts may count from anywhere.

        What was learned of the joint is kept. What depends on the zeros is valid when motion has shown them.
        """

    def reset(self) -> None:
        """Reset: forget every estimate."""

    def parameters(self) -> list[dict[str, Any]]:
        """Return the current {"model", "parameters", "std"} of each transmission, names as in
        the joint file.
        """

    def undeclared(self) -> list[list[str]]:
        """Return effects of each motor that nobody declared and the motion has shown, names
        as in `report.json`.
        """

    def friction(self) -> list[dict[str, float] | None]:
        """Return dry friction of each motor, declared and found: {"torque_nm", "std_nm"}; None: not known."""

    def why(self) -> tuple[str, str] | None:
        """Return why the last estimate is not valid: key of `estimator.reasons.REASONS`,
        sentence; None: it is.
        """

    def suspicion(self) -> dict[str, Any] | None:
        """Return the reading that is suspected while readings contradict the model; None: none.

        {"signal": "motor_position" | "motor_torque" | "link_position" | "motor_or_link_position",
        "motor": from 1 on (0: the link's),
        "reason": "scale" (relative), "delay" (s), "zero" (rad, N·m), "impossible", "jumped" or "frozen",
        "amount" and "std": in the reason's unit, or None, "explains": whether it explains the whole residual,
        "text": the same in words}.
        """


class _Compiled:
    """`estimator._core.Estimator` with parameters by their names."""

    def __init__(self, model: JointModel, settings: EstimatorSettings, period_s: float) -> None:
        self.core = _core.Estimator(model, settings, period_s)
        self._model = model
        self._asked = settings.valid_within
        self.step = self.core.step
        self.reset = self.core.reset
        self.lose_zeros = self.core.lose_zeros
        self.distrust = self.core.distrust

    @property
    def residual_nm(self) -> float:
        return self.core.residual_nm

    @property
    def flexibility_torque_std_nm(self) -> float:
        return self.core.flexibility_torque_std_nm

    @property
    def external(self) -> External | None:
        return self.core.external

    @property
    def consistency(self) -> Consistency | None:
        result = self.core.consistency
        return None if result is None else Consistency(*result)

    def parameters(self) -> list[dict[str, Any]]:
        return [self._named(i, motor) for i, motor in enumerate(self._model.motors)]

    def undeclared(self) -> list[list[str]]:
        return [self.core.undeclared(i) for i in range(len(self._model.motors))]

    def friction(self) -> list[dict[str, float] | None]:
        return [self._friction(i, motor) for i, motor in enumerate(self._model.motors)]

    def _friction(self, i: int, motor: Motor) -> dict[str, float] | None:
        found = self.core.friction(i)
        if found is None or not all(map(math.isfinite, found)):
            return None
        declared = sum(
            values["torque_nm"]
            for effect in motor.effects
            if effect.name in _DRY
            for values in elements(effect)[1]
        )
        return {"torque_nm": declared + found[0], "std_nm": found[1]}

    def why(self) -> tuple[str, str] | None:
        why = self.core.why()
        if why is None:
            return None
        name, motor, share, changes = why
        motor = motor if len(self._model.motors) > 1 else 0
        return name, reason_text(name, motor=motor, share=share, asked=self._asked, changes=changes)

    def suspicion(self) -> dict[str, Any] | None:
        suspicion = self.core.suspicion()
        if suspicion is None:
            return None
        signal, motor, reason, amount, std, explains = suspicion
        known = math.isfinite(amount) and math.isfinite(std)
        return {
            "signal": signal,
            "motor": motor,
            "reason": reason,
            "amount": amount if known else None,
            "std": std if known else None,
            "explains": explains,
            "text": _in_words(signal, motor if len(self._model.motors) > 1 else 0, reason, amount, std)
            + ("" if explains else "; it is the likeliest, but does not explain all"),
        }

    def _named(self, i: int, motor: Motor) -> dict[str, Any]:
        known, polynomial, values, std = self.core.alpha(i)
        if not motor.flexible:
            return {"model": RIGID, "parameters": {}, "std": {}}
        if not known:
            black_box = {"stiffness_nm_rad": values[0]} if values and math.isfinite(values[0]) else {}
            return {"model": UNKNOWN, "parameters": black_box, "std": {}}
        declared = transmission_model(motor.transmission)
        model = MODELS["polynomial"] if polynomial or declared is None else declared
        return {
            "model": model.name,
            "parameters": model.parameters(np.array(values)),
            "std": model.parameters(np.array(std)),
        }


_DRY = ("coulomb_friction", "stribeck_friction", "presliding_friction")
_SIGNALS = {
    "motor_position": "motor position",
    "motor_torque": "motor torque",
    "link_position": "link position",
    "motor_or_link_position": "zero between motor and link position",
}
_REASONS = {
    "impossible": "the value is impossible",
    "jumped": "it jumps by more than it can",
    "frozen": "it repeats itself while others move",
}


def _in_words(signal: str, motor: int, reason: str, amount: float, std: float) -> str:
    which = _SIGNALS[signal] if motor == 0 else f"{_SIGNALS[signal]} of motor {motor}"
    if reason == "scale":
        why = f"its scale is {_with_interval(1.0 + amount, std)} times what it was"
    elif reason == "delay":
        why = f"it is {_with_interval(1e3 * amount, 1e3 * std)} ms later than it was"
    elif reason == "zero":
        unit = "N·m" if signal == "motor_torque" else "rad"
        why = f"it has moved by {_with_interval(amount, std)} {unit}"
    else:
        why = _REASONS[reason]
    return f"{which}: {why}"


def _with_interval(value: float, std: float) -> str:
    """Return a value and half its 95 % interval, both to the second digit of the latter."""
    half = SIGMA_95 * std
    decimals = max(0, 1 - math.floor(math.log10(half))) if 0.0 < half < math.inf else 3
    return f"{value:.{decimals}f} ± {half:.{decimals}f}"


def make_estimator(model: JointModel, settings: EstimatorSettings, period_s: float) -> Estimator:
    """Make the estimator that the settings select.

    Raises:
        EstimatorError: the model names a transmission that does not exist, or contradicts itself.
    """
    require_in_range("period_s", period_s, positive=True)
    return _Compiled(model, settings, period_s)
