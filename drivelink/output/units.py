"""How reports write effects, and parameters with their intervals and units."""

from __future__ import annotations

from estimator.model import ParameterValue
from estimator.sample import SIGMA_95

_RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_UNITS = (  # by the end of a parameter's name; the first match
    ("_nm_s2_rad2", "N·m·s²/rad²"), ("_nm_s_rad", "N·m·s/rad"), ("_nm_rad2", "N·m/rad²"),
    ("_nm_rad", "N·m/rad"), ("_per_nm2", "1/(N·m)²"), ("_kg_m2", "kg·m²"),
    ("_rad_s2", "rad/s²"), ("_rad_s", "rad/s"), ("_per_rev", "per rev"), ("_per_rad", "1/rad"),
    ("_nm", "N·m"), ("_rad", "rad"), ("_hz", "Hz"), ("_s", "s"), ("_error", "relative"),
    ("_change", "relative"),
)  # fmt: skip
_LINEAR = {  # of a linear axis: metres for rad, newtons for N·m
    "N·m·s/rad": "N·s/m", "N·m/rad": "N/m", "N·m·s²/rad²": "N·s²/m²", "kg·m²": "kg", "rad/s²": "m/s²",
    "rad/s": "m/s", "per rev": "per 2π m", "N·m/rad²": "N/m²", "1/(N·m)²": "1/N²", "N·m/s": "N/s",
    "1/rad": "1/m", "N·m": "N", "rad": "m",
}  # fmt: skip


def in_words(name: str) -> str:
    """The name of an effect as it stands in a sentence."""
    return name.replace("_", " ").replace("coulomb", "Coulomb").replace("stribeck", "Stribeck")


class Units:
    """Units in reports of an axis.

    Args:
        linear: whether it is a linear axis.
    """

    def __init__(self, linear: bool) -> None:
        self._linear = linear

    def shown(self, unit: str) -> str:
        """The unit of this axis for one of a rotary axis."""
        return _LINEAR.get(unit, unit) if self._linear else unit

    def label(self, text: str) -> str:
        """An axis label "quantity / unit" as it is for this one."""
        quantity, _, unit = text.rpartition(" / ")
        bare = unit.strip("()")
        return f"{quantity} / {unit.replace(bare, self.shown(bare))}"

    def of(self, name: str) -> str:
        """The unit of a parameter by the end of its name, or empty."""
        return self.shown(next((unit for end, unit in _UNITS if f"_{name}".endswith(end)), ""))

    def value(self, name: str, value: ParameterValue, std: ParameterValue | None) -> str:
        """A parameter with its 95 % interval and unit; of a polynomial each coefficient has its own."""
        unit = self.of(name)
        if not isinstance(value, tuple):
            return f"{_text(value, std if isinstance(std, float) else None)} {unit}".rstrip()
        deviations = std if isinstance(std, tuple) else (None,) * len(value)
        length = self.shown("rad")
        texts = []
        for k, (x, s) in enumerate(zip(value, deviations, strict=True)):
            power = str(2 * k + 1).translate(_RAISED) if k and unit.endswith(f"/{length}") else ""
            texts.append(f"{_text(x, s)} {unit}{power}".rstrip())
        return ", ".join(texts)


def _text(value: float, std: float | None) -> str:
    """A number with its 95 % interval."""
    return f"{value:.5g} ± {SIGMA_95 * std:.2g}" if std is not None and std > 0.0 else f"{value:.5g}"
