"""Torques with memory: presliding friction, hysteresis, creep, delays.

Each memory keeps its state of the last step: `torque` evaluates another displacement without changing it,
`commit` moves there.
"""

import math
from collections import deque
from collections.abc import Callable

from sim.errors import SimError

Element = Callable[[float, float], float]
"""(state y, way U >= 0), both counted in the direction of motion -> state after it."""


class Slip:
    """Parallel elements that yield one after the other (P. Dahl 1968; Y. Wen 1976).

    Each follows dz/du = 1 - (s sign(dz u) + 1 - s) |z|^n over its displacement in units of its own scale:
    n = 1, s = 1 is Dahl's law, n = 2, s = 0.5 the usual Bouc-Wen, n >= 50 a spring that slips (Jenkins).
    Scales of several elements are spread geometrically about the given one, as in Iwan's assembly.
    """

    def __init__(
        self,
        torque_nm: float,
        displacement_rad: float,
        exponent: float = 2.0,
        shape: float = 0.5,
        elements: float = 1.0,
    ) -> None:
        if displacement_rad <= 0.0 or exponent < 1.0 or not 0.0 <= shape <= 1.0 or elements < 1.0:
            raise SimError(
                "expected displacement_rad > 0, exponent >= 1, shape 0 to 1 and elements >= 1, got "
                f"{displacement_rad!r}, {exponent!r}, {shape!r} and {elements!r}"
            )
        count = round(elements)
        self._each = torque_nm / count
        self._element = _element(exponent, shape)
        self._per_rad = [1.0 / (displacement_rad * 2.0 ** (k - (count - 1) / 2)) for k in range(count)]
        self._z = [0.0] * count
        self._x: float | None = None  # unloaded at its first position

    def torque(self, x: float) -> float:
        """Return the torque (N·m) at displacement x (rad)."""
        return self._each * sum(self._moved(x))

    def commit(self, x: float) -> None:
        """Move to x."""
        self._z = self._moved(x)
        self._x = x

    def _moved(self, x: float) -> list[float]:
        if self._x is None:
            self._x = x
        element, way = self._element, x - self._x
        if way >= 0.0:
            return [element(z, way * per_rad) for z, per_rad in zip(self._z, self._per_rad, strict=True)]
        return [-element(-z, -way * per_rad) for z, per_rad in zip(self._z, self._per_rad, strict=True)]


def _element(exponent: float, shape: float) -> Element:
    """Return the law in closed form where there is one."""
    if exponent >= 50.0:
        return lambda y, way: min(y + way, 1.0)
    if exponent == 1.0 and shape == 1.0:
        return lambda y, way: 1.0 - (1.0 - y) * math.exp(-way)
    if exponent == 2.0 and shape == 0.5:
        return _bouc_wen
    return _integrated(exponent, shape)


def _bouc_wen(y: float, way: float) -> float:
    """Elastic until the torque is gone, then dy/dU = 1 - y²."""
    if y < 0.0:
        if y + way <= 0.0:
            return y + way
        return math.tanh(y + way)
    grown = math.tanh(way)
    return (y + grown) / (1.0 + y * grown)


def _integrated(exponent: float, shape: float) -> Element:
    """Midpoint steps of a tenth."""
    unloading = 1.0 - 2.0 * shape

    def slope(y: float) -> float:
        return float(1.0 - (unloading if y < 0.0 else 1.0) * abs(y) ** exponent)

    def element(y: float, way: float) -> float:
        if way > 10.0:
            return 1.0
        pieces = 1 + int(way / 0.1)
        du = way / pieces
        for _ in range(pieces):
            y = min(y + du * slope(y + 0.5 * du * slope(y)), 1.0)
        return y

    return element


class Creep:
    """A Maxwell element (spring and damper in series) beside the spring: its torque relaxes in time_s."""

    def __init__(self, stiffness_nm_rad: float, time_s: float, step_s: float) -> None:
        self._k, self._decay = stiffness_nm_rad, math.exp(-step_s / time_s)
        self._mean = time_s / step_s * -math.expm1(-step_s / time_s)
        self._torque = 0.0
        self._x: float | None = None  # unloaded at its first position

    def torque(self, x: float) -> float:
        """Return the torque (N·m) at deflection x (rad)."""
        if self._x is None:
            self._x = x
        return self._torque + self._k * (x - self._x)

    def commit(self, x: float) -> None:
        """Advance one step, to x: relax the torque and add the change."""
        way = 0.0 if self._x is None else x - self._x
        self._torque = self._torque * self._decay + self._k * way * self._mean
        self._x = x


class Delayed:
    """A held torque that acts with a delay: its mean over each step of a period."""

    def __init__(self, delay_s: float, period_s: float, substeps: int) -> None:
        width = 1.0 / substeps
        starts = [k * width - delay_s / period_s for k in range(substeps)]
        first = [math.floor(start + 1e-12) for start in starts]
        # Share of each step that falls into the period after the one it begins in.
        self._plan = [(i, max(0.0, s + width - (i + 1)) / width) for i, s in zip(first, starts, strict=True)]
        back = 1 - min(first)
        self._past: deque[float] = deque([0.0] * back, maxlen=back)

    def schedule(self, torque: float) -> list[float]:
        """Return the torque of each step of the period that begins with this set-point."""
        past = self._past
        past.append(torque)
        last = len(past) - 1
        return [
            past[last + i] if share == 0.0 else past[last + i] * (1.0 - share) + past[last + i + 1] * share
            for i, share in self._plan
        ]


class Lag:
    """A first-order low-pass of a torque that is held over steps: its mean over each of them."""

    def __init__(self, time_constant_s: float, step_s: float) -> None:
        self._keep = math.exp(-step_s / time_constant_s)
        self._mean = -math.expm1(-step_s / time_constant_s) * time_constant_s / step_s
        self._torque = 0.0

    def passed(self, torque: float) -> float:
        """Return the mean output over the next step with this input."""
        ahead = self._torque - torque
        self._torque = torque + ahead * self._keep
        return torque + ahead * self._mean


class PositionHistory:
    """Past positions of a body: samples at plant steps, cubic interpolation between them."""

    def __init__(self, delay_s: float, step_s: float, position: float) -> None:
        steps = delay_s / step_s
        self._back = math.ceil(steps - 1e-9)
        self._along = self._back - steps
        self._step_s = step_s
        self._past: deque[tuple[float, float]] = deque(
            [(position, 0.0)] * (self._back + 1), maxlen=self._back + 1
        )

    def push(self, position: float, velocity: float) -> None:
        """Advance by one step."""
        self._past.append((position, velocity))

    def position(self) -> float:
        """Return the delayed position."""
        (a, va), s, h = self._past[0], self._along, self._step_s
        if s == 0.0:
            return a
        b, vb = self._past[1]
        rise = b - a
        bend_a, bend_b = h * va - rise, rise - h * vb
        return a + s * rise + s * (1.0 - s) * ((1.0 - s) * bend_a + s * bend_b)
