"""Torque profiles of the rig, which move the joint while no master commands its drives.

All torques are at the joint. A profile is a function of time; a soft spring (`centring_nm_rad`,
`centring_nm_s_rad`) can keep the motors near a position, so that an open-loop torque does not carry the joint
away. Both are sampled once per control period and held.
"""

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.errors import SimError, expected

Profile = Callable[[float], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Excitation:
    """Torques that the rig applies."""

    profiles: tuple[Profile, ...]  # torque (N·m, joint side) over time (s), one per motor
    external: Profile | None = None  # tau_k of eq 4 over time
    centre_rad: tuple[float, ...] = (0.0, 0.0)  # centre of the spring for each motor
    moved: tuple[tuple[Profile, Profile], ...] = ()  # position and velocity of that centre instead, over time
    centring_nm_rad: float = 0.0  # stiffness of that hold
    centring_nm_s_rad: float = 0.0  # damping of that hold

    def torque(self, motor: int, time_s: float, position_rad: float, velocity_rad_s: float) -> float:
        """Return the torque for the period that begins now, N·m at the joint."""
        centre, rate = self.centre_rad[motor], 0.0
        if self.moved:
            centre, rate = (profile(time_s) for profile in self.moved[motor])
        hold = self.centring_nm_rad * (position_rad - centre)
        return self.profiles[motor](time_s) - hold - self.centring_nm_s_rad * (velocity_rad_s - rate)


class _Keys:
    """The keys of one table: each is taken once; remaining keys are an error."""

    def __init__(self, table: Mapping[str, Any], where: str) -> None:
        self._left = dict(table)
        self._where = where

    def text(self, key: str, default: str, choices: tuple[str, ...] = ()) -> str:
        """Return one of the choices; without any: any text."""
        value = self._left.pop(key, default)
        if value not in choices and (choices or not isinstance(value, str)):
            wanted = expected(str(value), choices) if choices else "expected text"
            raise SimError(f'{self._where}.{key} "{value}": {wanted}')
        return str(value)

    def number(self, key: str, default: float | None, minimum: float = -math.inf) -> float:
        value = self._left.pop(key, default)
        if value is None:
            raise SimError(f"{self._where}.{key}: expected this key, it is missing")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise SimError(f"{self._where}.{key}: expected a finite number, got {value!r}")
        if value < minimum:
            raise SimError(f"{self._where}.{key}: expected a number >= {minimum:g}, got {value!r}")
        return float(value)

    def whole(self, key: str, default: int, minimum: int) -> int:
        value = self.number(key, default, minimum)
        if value != int(value):
            raise SimError(f"{self._where}.{key}: expected a whole number, got {value!r}")
        return int(value)

    def each(self, key: str, default: float | None, motors: int, minimum: float = -math.inf) -> list[float]:
        """Return one number for all motors, or a list with one number a motor."""
        value = self._left.get(key)
        if not isinstance(value, list | tuple):
            return [self.number(key, default, minimum)] * motors
        if len(value) != motors:
            raise SimError(f"{self._where}.{key}: expected {motors} number(s), got {len(value)}")
        self._left.pop(key)
        return [_Keys({key: v}, self._where).number(key, None, minimum) for v in value]

    def table(self, key: str) -> Mapping[str, Any] | None:
        value = self._left.pop(key, None)
        if value is not None and not isinstance(value, Mapping):
            raise SimError(f"{self._where}.{key}: expected a table, got {value!r}")
        return value

    def finish(self) -> None:
        if self._left:
            raise SimError(f"{self._where}.{next(iter(self._left))}: unknown key")


def build(table: Mapping[str, Any], motors: int, where: str = "excitation") -> Excitation:
    """Make an excitation from a table as it stands in a joint file.

    Args:
        table: `kind` and its keys (see `docs/reference/simulation.md`); an empty table is "rich".

    Raises:
        SimError: unknown, missing or impossible key.
    """
    keys = _Keys(table, where)
    kind = keys.text("kind", "rich", (*KINDS, "motion"))
    moved: tuple[tuple[Profile, Profile], ...] = ()
    if kind == "motion":
        profiles, moved = _played(keys, motors, where)
    else:
        profiles = _profiles(keys, kind, motors)
    external = keys.table("external")
    excitation = Excitation(
        profiles=profiles,
        moved=moved,
        external=None if external is None else _external(external, f"{where}.external"),
        centre_rad=tuple(keys.each("centre_rad", 0.0, motors)),
        centring_nm_rad=keys.number("centring_nm_rad", 0.0, 0.0),
        centring_nm_s_rad=keys.number("centring_nm_s_rad", 0.0, 0.0),
    )
    keys.finish()
    return excitation


def _external(table: Mapping[str, Any], where: str) -> Profile:
    keys = _Keys(table, where)
    (profile,) = _profiles(keys, keys.text("kind", "rich", tuple(KINDS)), 1)
    keys.finish()
    return profile


def _played(
    keys: _Keys, motors: int, where: str
) -> tuple[tuple[Profile, ...], tuple[tuple[Profile, Profile], ...]]:
    """Torque, position and velocity of each motor by a CSV file, over and over."""
    path = Path(keys.text("file", ""))
    names = [
        f"motor{i}_{name}"
        for i in range(1, motors + 1)
        for name in ("torque_nm", "position_rad", "velocity_rad_s")
    ]
    try:
        table = np.genfromtxt(path, delimiter=",", names=True, ndmin=1)
        time, columns = table["time_s"], [table[name] for name in names]
    except (OSError, ValueError, IndexError) as error:
        expected = f"a CSV file with the columns time_s, {', '.join(names)}"
        raise SimError(f"{where}.file: {path}: expected {expected}") from error
    if f"motor{motors + 1}_position_rad" in (table.dtype.names or ()):
        raise SimError(f"{where}.file: {path}: has more motors than the joint, which has {motors}")
    if len(time) < 2 or not np.all(np.isfinite([time, *columns])) or not np.all(np.diff(time) > 0.0):
        raise SimError(f"{where}.file: {path}: expected numbers, and a time_s that rises")
    length = float(time[-1] - time[0])

    def profile(values: Any) -> Profile:
        return lambda t: float(np.interp(time[0] + t % length, time, values))

    torque, position, velocity = ([profile(x) for x in columns[k::3]] for k in range(3))
    return tuple(torque), tuple(zip(position, velocity, strict=True))


def _profiles(keys: _Keys, kind: str, motors: int) -> tuple[Profile, ...]:
    amplitudes = keys.each("amplitude_nm", 0.0 if kind == "none" else None, motors)
    offsets = keys.each("offset_nm", 0.0, motors)
    ramp_s = keys.number("ramp_s", 0.0, 0.0)
    shapes = KINDS[kind](keys, motors)
    return tuple(
        _scaled(shape, amplitude, offset, ramp_s)
        for shape, amplitude, offset in zip(shapes, amplitudes, offsets, strict=True)
    )


def _scaled(shape: Profile, amplitude: float, offset: float, ramp_s: float) -> Profile:
    if ramp_s == 0.0:
        return lambda t: amplitude * shape(t) + offset
    return lambda t: (amplitude * shape(t) + offset) * min(1.0, t / ramp_s)


def _none(keys: _Keys, motors: int) -> list[Profile]:
    return [lambda t: 0.0] * motors


def _sines(keys: _Keys, motors: int) -> list[Profile]:
    """sin(2 pi f t + phase): the paper's excitation."""
    frequencies = keys.each("frequency_hz", None, motors, 0.0)
    phases = keys.each("phase_rad", 0.0, motors)
    return [_tones([(f, phase, 1.0)]) for f, phase in zip(frequencies, phases, strict=True)]


def _tones(tones: list[tuple[float, float, float]]) -> Profile:
    """Sum of a sin(2 pi f t + phase) over (f, phase, a)."""
    sin = math.sin
    terms = tuple((2.0 * math.pi * f, phase, a) for f, phase, a in tones)

    def shape(t: float) -> float:
        total = 0.0
        for omega, phase, a in terms:
            total += a * sin(omega * t + phase)
        return total

    return shape


def _band(keys: _Keys, low_hz: float, high_hz: float) -> tuple[float, float]:
    low, high = keys.number("low_hz", low_hz), keys.number("high_hz", high_hz)
    if not 0.0 < low < high:
        raise SimError(f"low_hz, high_hz: expected 0 < low_hz < high_hz, got {low:g} and {high:g}")
    return low, high


def _random_tones(
    motors: int, count: int, low: float, high: float, seed: int
) -> list[list[tuple[float, float, float]]]:
    """Tones spaced geometrically over the band, interleaved between motors, with the rms of one sine."""
    draw = random.Random(seed)
    amplitude = 1.0 / math.sqrt(count)
    ratio = high / low
    return [
        [
            (
                low * ratio ** ((k + (motor + 0.5) / motors) / count),
                draw.uniform(0.0, 2.0 * math.pi),
                amplitude,
            )
            for k in range(count)
        ]
        for motor in range(motors)
    ]


def _multisine(keys: _Keys, motors: int) -> list[Profile]:
    low, high = _band(keys, 0.1, 10.0)
    count, seed = keys.whole("tones", 10, 1), keys.whole("seed", 0, 0)
    return [_tones(tones) for tones in _random_tones(motors, count, low, high, seed)]


def _chirp(keys: _Keys, motors: int) -> list[Profile]:
    """Return a sine whose frequency goes from low to high and back, geometrically, each way in sweep_s."""
    low, high = _band(keys, 0.1, 10.0)
    sweep_s = keys.number("sweep_s", 10.0, 1e-3)
    rate = math.log(high / low) / sweep_s
    turns = low * (high / low - 1.0) / rate

    def shape(t: float) -> float:
        sweeps, s = divmod(t, sweep_s)
        up = low * math.expm1(rate * s) / rate
        down = high * -math.expm1(-rate * s) / rate
        return math.sin(2.0 * math.pi * (sweeps * turns + (down if sweeps % 2 else up)))

    return [shape] * motors


def _steps(keys: _Keys, motors: int) -> list[Profile]:
    """Random levels in -1 … 1, each held for hold_s."""
    hold_s, seed = keys.number("hold_s", 1.0, 1e-3), keys.whole("seed", 0, 0)

    def stairs(motor: int) -> Profile:
        draw = random.Random(f"{seed}/{motor}")
        levels: list[float] = []

        def shape(t: float) -> float:
            index = int(t / hold_s)
            while len(levels) <= index:
                levels.append(draw.uniform(-1.0, 1.0))
            return levels[index]

        return shape

    return [stairs(motor) for motor in range(motors)]


def _rich(keys: _Keys, motors: int) -> list[Profile]:
    """Twelve tones over the band, and a slow sine per motor that covers the whole range."""
    low, high = _band(keys, 0.15, 8.0)
    count, seed = keys.whole("tones", 12, 1), keys.whole("seed", 0, 0)
    shapes = []
    for motor, tones in enumerate(_random_tones(motors, count, low, high, seed)):
        slow = (low * (0.4 + 0.13 * motor), 0.0, 0.8)
        shapes.append(_tones([(f, phase, 0.6 * a) for f, phase, a in tones] + [slow]))
    return shapes


KINDS: dict[str, Callable[[_Keys, int], list[Profile]]] = {
    "none": _none,
    "sines": _sines,
    "multisine": _multisine,
    "chirp": _chirp,
    "steps": _steps,
    "rich": _rich,
}
"""Shape of peak or rms about one, by name."""
