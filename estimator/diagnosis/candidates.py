"""The library's effects as columns of the stacked regression, and the grids of their nonlinear parameters."""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.choices import choice, whole
from estimator.diagnosis.frame import Frame
from estimator.effects import LIBRARY, Coordinates, EffectType, elements
from estimator.sample import FloatArray

__all__ = [
    "AGAIN",
    "Candidate",
    "bounds_of",
    "columns",
    "grid",
    "least_periods",
    "members",
    "reach_of",
    "reverses",
    "rubbing",
    "sign_smoothing",
    "slips",
    "spread_of",
]

Values = Mapping[str, float]
AGAIN = "'"  # behind the name of a further ripple of the same kind

# Laws of friction and hysteresis with memory: Dahl, Bouc-Wen, elastic up to the limit.
LAWS = ((1.0, 1.0), (2.0, 0.5), (50.0, 1.0))
_FREE_ZEROS = ("torque_offset", "deflection_offset")  # fitted anyway where nothing ties them
# Without a second equation the torque's scale cannot be separated from inertia and stiffness, nor one that
# depends on the torque from the spring's law; one that changes with time can.
_SCALES = ("torque_constant", "torque_saturation")


@dataclass(frozen=True, slots=True)
class Candidate:
    """One effect at one motor (None: at the link); `again`: a ripple's place among those of its kind."""

    kind: EffectType
    motor: int | None
    again: int = 0

    @property
    def key(self) -> tuple[str, int | None]:
        """Its identity: name and motor."""
        return self.kind.name + AGAIN * self.again, self.motor

    def beside(self, taken: Container[tuple[str, int | None]]) -> Candidate | None:
        """The candidate, or a further ripple of its kind, beside those taken; None: there is none."""
        ripple = "periods_per_rev" in self.kind.nonlinear
        each = (replace(self, again=k) for k in range(whole("ripples_each") if ripple else 1))
        return next((one for one in each if one.key not in taken), None)

    @property
    def bends(self) -> bool:
        """Whether it is a function of the deflection alone, as the transmission's model is."""
        kind = self.kind
        return kind.location == "transmission" and kind.coordinates == ("deflection",) and not kind.remembers

    @property
    def rubs(self) -> bool:
        """Whether it is a law of the motor's dry friction, of which a motor has one."""
        kind = self.kind
        sign = kind.remembers or "smoothing_rad_s" in kind.nonlinear
        return kind.location == "motor" and sign and "flexibility_torque" not in kind.coordinates

    @property
    def family(self) -> tuple[str, str, str, int | None]:
        """Family of laws for the same phenomenon: place, channel and coordinate."""
        kind = self.kind
        # Friction with memory is friction: it changes with the direction. A constant torque is its even part.
        rubs = kind.location == "motor" and (kind.remembers or kind.name == "torque_offset")
        coordinate = "velocity" if rubs else kind.coordinates[0]
        return kind.location, kind.channel, coordinate, self.motor


def members(frame: Frame) -> list[Candidate]:
    """Effects that this joint can have and these data can reveal."""
    found = []
    for kind in LIBRARY.values():
        if kind.location == "link":
            smooth = "smoothing_rad_s" in kind.nonlinear
            shown = frame.linked or (frame.carried and kind.name == "gravity")  # all else is the motor's
            if shown and (not smooth or reverses(frame.motors[0].link_velocity)):
                found.append(Candidate(kind, None))
        elif kind.channel == "link_position":
            if any(frame.flexible) and (len(frame.motors) == 1 or kind.name != "deflection_delay"):
                found.append(Candidate(kind, None))
        else:
            if kind.channel == "deflection" and sum(frame.flexible) > 1 and frame.linked:
                found.append(Candidate(kind, None))
            found += [
                Candidate(kind, i)
                for i in range(len(frame.motors))
                if (frame.flexible[i] or not _needs_deflection(kind))
                and ("smoothing_rad_s" not in kind.nonlinear or reverses(frame.motors[i].velocity))
                and (frame.linked or kind.name not in (*_SCALES, *_FREE_ZEROS))
            ]
    return found


def reverses(velocity: FloatArray) -> bool:
    """Whether a motion has both directions: in one alone dry friction is a constant torque."""
    return bool(np.quantile(velocity, 0.05) < 0.0 < np.quantile(velocity, 0.95))


def sign_smoothing(frames: Sequence[Frame], motor: int) -> float:
    """Velocity over which everyday dry friction changes its sign, rad/s: declared, else from the motion."""
    for effect in frames[0].model.motors[motor].effects:
        if effect.name == "coulomb_friction":
            return elements(effect)[1][0]["smoothing_rad_s"]
    fast = max(float(np.max(np.abs(f.motors[motor].velocity))) for f in frames)
    noise = max(f.signals.velocity_noise(motor) for f in frames)
    least, most = choice("floor") * fast, choice("smoothing") * fast
    return min(max(choice("sure") * noise, least), most)


def _needs_deflection(kind: EffectType) -> bool:
    return (
        kind.location == "transmission"
        or kind.channel == "deflection"
        or kind.name in ("load_dependent_friction", "back_driving_loss")
    )


_OF_MOTOR = {"position", "velocity", "acceleration", "time"}  # coordinates that no correction changes


def columns(
    frame: Frame, candidate: Candidate, values: Values, weights: tuple[float, ...] = ()
) -> FloatArray:
    """Stacked, filtered columns (rows, k) of an effect, one per linear parameter; made once.

    Args:
        frame: the recording.
        candidate: the effect. values: its nonlinear parameters.
        weights: its linear ones, as far as they are known: the reaction depends on them too.
    """
    kind = candidate.kind
    lasting = kind.location == "motor" and not slips(kind) and _OF_MOTOR.issuperset(kind.coordinates)
    memo = frame.signals.memo if lasting else frame.memo
    key = (candidate.key, *values.values(), *(weights if _bilinear(kind) else ()))
    made = memo.get(key)
    if made is None:
        made = _columns(frame, candidate, values, weights)
        if "periods_per_rev" not in values:  # there are hundreds, which `Search` keeps
            memo[key] = made
    return made.T


def _bilinear(kind: EffectType) -> bool:
    """Whether an effect's reaction on the motor has a part in its own torque."""
    return kind.name == "kinematic_error"


def slips(kind: EffectType) -> bool:
    """Return whether an effect is dry friction of a motor, a law of the direction it moves in."""
    return kind.location == "motor" and "smoothing_rad_s" in kind.nonlinear


def rubbing(frame: Frame, motor: int) -> Coordinates:
    """Return a motor's coordinates as dry friction has them.

    Dry friction holds a motor at rest with what all else leaves of the balance, up to its level (a set-valued
    law: Acary and Brogliato, Numerical Methods for Nonsmooth Dynamical Systems, 2008). No reading tells this
    from a velocity; so a velocity is moved within its noise to where friction is what the balance leaves.
    """
    here, key = frame.motors[motor], ("rubbing", motor)
    if key not in frame.memo:
        held = here.flexibility_torque - frame.motor_balance(motor)
        noise = choice("sure") * frame.signals.velocity_noise(motor)
        frame.memo[key] = here.velocity + noise * np.clip(held / max(_rms(held), 1e-300), -1.0, 1.0)
    return here._replace(velocity=frame.memo[key])


def _columns(frame: Frame, candidate: Candidate, values: Values, weights: tuple[float, ...]) -> FloatArray:
    """The columns (k, rows) of an effect."""
    kind, motor = candidate.kind, candidate.motor or 0
    terms = kind.terms(rubbing(frame, motor) if slips(kind) else frame.motors[motor], values)
    if kind.channel == "link_position":
        return _reading(frame, terms)
    if kind.channel == "deflection" and candidate.motor is None:
        return _zero(frame, terms)
    if kind.channel == "deflection":
        force = -frame.motors[motor].stiffness * terms
        return frame.column(motor, force, force if frame.pulls[motor] else None)
    if kind.location == "transmission":
        here = frame.motors[motor]
        if weights and _bilinear(kind):
            here = here._replace(flexibility_torque=here.flexibility_torque + np.array(weights) @ terms)
        reaction = kind.reaction(here, values)
        on_motor = terms if reaction is None else terms - reaction
        return frame.column(motor, on_motor, terms if frame.pulls[motor] else None)
    if kind.location == "motor" or frame.carried:
        return frame.column(motor, -terms, None)
    return frame.column(None, None, terms)


def _zero(frame: Frame, error: FloatArray) -> FloatArray:
    """Columns of a common error of all deflections."""
    parts: list[FloatArray | None] = [frame.project(-c.stiffness * error) for c in frame.motors]
    if frame.linked:
        force = [-c.stiffness * error for c, pulls in zip(frame.motors, frame.pulls, strict=True) if pulls]
        parts.append(frame.project(np.sum(force, axis=0)))
    return frame.stack(parts)


def _reading(frame: Frame, error: FloatArray) -> FloatArray:
    """Columns of an error e of the link's reading, through tau_e and the link's balance."""
    narrow, response = frame.signals.narrow, frame.signals.response
    parts: list[FloatArray | None] = []
    total = np.zeros_like(error)
    for c, flexible, pulls in zip(frame.motors, frame.flexible, frame.pulls, strict=True):
        parts.append(frame.project(-c.stiffness * error) if flexible else None)
        if pulls:
            total = total + c.stiffness
    link = frame.model.link
    if frame.linked and link is not None:
        slope = link.gravity_nm * np.cos(frame.motors[0].link_position + link.gravity_phase_rad)
        spectrum = narrow.transform(error)
        rate = narrow.apply(spectrum, response, 1)[..., frame.signals.keep]
        acceleration = narrow.apply(spectrum, response, 2)[..., frame.signals.keep]
        force = frame.project((total + slope) * error)
        own = link.inertia_kg_m2 * acceleration + link.viscous_damping_nm_s_rad * rate
        parts.append(-(force + own))
    return frame.stack(parts)


def grid(frame: Frame, candidate: Candidate, smoothing_rad_s: float, ripples: int) -> list[dict[str, float]]:
    """Start values of the nonlinear parameters.

    Args:
        frame: the recording.
        candidate: the effect.
        smoothing_rad_s: velocity below which a sign is lost in noise.
        ripples: frequencies of a ripple at most, the slowest ones.
    """
    kind = candidate.kind
    c = frame.motors[candidate.motor or 0]
    fixed = {p.name: float(p.default) for p in kind.parameters if not p.linear and p.default is not None}
    if "smoothing_rad_s" in kind.nonlinear:
        _, most = bounds_of(frame, candidate, "smoothing_rad_s", {})
        smooth = smoothing_rad_s * choice("softer") ** np.arange(3)
        smooth = smooth[smooth <= max(most, smoothing_rad_s)]
        if kind.name == "stribeck_friction":
            fast = _rms(c.velocity) * np.geomspace(0.01, 0.8, 9)
            return [
                {**fixed, "smoothing_rad_s": float(s), "stribeck_velocity_rad_s": float(v)}
                for s in smooth
                for v in fast
                if v > choice("sure") * s
            ]
        return _vary(fixed, "smoothing_rad_s", smooth)
    if kind.remembers:
        path = c.position if kind.location == "motor" else c.deflection
        scales = _spread(path) * np.geomspace(0.0002, choice("slips"), 11 if _spread(path) > 0.0 else 0)
        return [{"displacement_rad": float(d), "exponent": n, "shape": b} for n, b in LAWS for d in scales]
    if kind.name in ("cogging", "kinematic_error"):
        return _vary(fixed, "periods_per_rev", _waves(frame, c, ripples))
    if kind.name == "backlash":
        gaps = np.quantile(np.abs(c.deflection), np.linspace(0.05, 0.9, 9))
        return _vary(fixed, "half_gap_rad", gaps[gaps > 0.0])
    if kind.name == "higher_order_stiffness":
        declared = _declared_power(frame, candidate.motor or 0)
        return _vary(fixed, "power", np.array([p for p in (3.0, 5.0, 7.0) if p > declared][:2]))
    if kind.name == "torque_drift":
        return _vary(fixed, "time_constant_s", c.time[-1] * np.geomspace(_shortest_drift(), 1.0, 6))
    if kind.name == "contact":
        places = np.quantile(c.link_position, np.linspace(0.04, 0.96, 12))
        return [{"position_rad": float(x), "side": side} for side in (1.0, -1.0) for x in places]
    return [fixed]


def _shortest_drift() -> float:
    """Shortest time constant of a drift, in recordings: half a stretch; a shorter one is a start-up
    transient.
    """
    return 0.5 / whole("groups")


def _vary(fixed: Values, name: str, values: Iterable[float]) -> list[dict[str, float]]:
    return [{**fixed, name: float(value)} for value in values]


def _waves(frame: Frame, c: Coordinates, ripples: int) -> FloatArray:
    """Periods per revolution whose ripple is within the bandwidth for much of the time in which it moves: at
    rest any torque is a fast ripple's.
    """
    spread = _spread(c.position)
    if spread <= 0.0:
        return np.array([])
    least = least_periods(c.position)
    motor = [own is c for own in frame.motors].index(True)
    speed = np.abs(c.velocity)
    moves = speed > choice("sure") * frame.signals.velocity_noise(motor)
    slow = float(np.quantile(speed[moves], 0.4)) if np.any(moves) else np.inf
    most = 2.0 * np.pi * frame.signals.bandwidth_hz / max(slow, 1e-12)
    step = np.pi / spread
    count = int(np.clip((most - least) / step, 0, ripples))
    # Once and twice a turn of the output and of the motor, where the motion has a whole period.
    gear = frame.model.motors[motor].gear_ratio
    turns = np.array([1.0, 2.0] if gear is None else [1.0, 2.0, gear, 2.0 * gear])
    turns = turns[(turns * spread >= 2.0 * np.pi) & (turns <= most)]
    return np.concatenate((turns, least + step * np.arange(count)))


def least_periods(position: FloatArray) -> float:
    """Fewest periods per revolution that count as a ripple in this range of motion."""
    return choice("ripple_periods") * 2.0 * np.pi / max(_spread(position), 1e-300)


def _declared_power(frame: Frame, motor: int) -> float:
    transmission = frame.model.motors[motor].transmission
    if transmission.model == "linear":
        return 1.0
    if transmission.model != "polynomial":
        return 3.0
    coefficients = transmission.parameters.get("coefficients_nm_rad")
    order = transmission.order or (len(coefficients) if isinstance(coefficients, tuple) else 1)
    return 2.0 * order - 1.0


def reach_of(frame: Frame, candidate: Candidate, name: str) -> float | None:
    """Prior standard deviation of a nonlinear parameter, in its unit; None: a factor of e either way."""
    c = frame.motors[candidate.motor or 0]
    if name == "periods_per_rev":
        waves = _waves(frame, c, whole("ripples"))
        return float(np.ptp(waves) / 12.0**0.5) if len(waves) > 1 else 1.0
    if name == "position_rad":
        return float(_spread(c.link_position) / 12.0**0.5)
    if name == "half_gap_rad":
        return float(np.max(np.abs(c.deflection)) / 12.0**0.5)
    return None


def bounds_of(frame: Frame, candidate: Candidate, name: str, values: Values) -> tuple[float, float]:
    """Bounds of a nonlinear parameter beside the others: resolved, and within the motion."""
    c = frame.motors[candidate.motor or 0]
    fast = float(np.max(np.abs(c.link_velocity if candidate.motor is None else c.velocity)))
    if name == "smoothing_rad_s":
        most = choice("smoothing") * fast  # smoothed more, a sign is damping
        least = frame.signals.velocity_noise(candidate.motor or 0)  # less is not resolved
        return least, min(most, values.get("stribeck_velocity_rad_s", np.inf) / choice("sure"))
    if name == "stribeck_velocity_rad_s":
        return choice("sure") * values["smoothing_rad_s"], fast
    if name == "position_rad":  # beyond the motion, what is touched always or never is no contact
        return float(np.min(c.link_position)), float(np.max(c.link_position))
    if name == "exponent":
        return 1.0, 20.0
    if name == "shape":
        return 0.05, 1.0
    if name == "displacement_rad":
        path = c.position if candidate.kind.location == "motor" else c.deflection
        return 0.0, choice("slips") * _spread(path)
    if name == "time_constant_s":
        return _shortest_drift() * float(c.time[-1]), float(c.time[-1])
    return 0.0, np.inf


def spread_of(frame: Frame, candidate: Candidate, name: str) -> float:
    """Largest step of a nonlinear parameter: between points of its grid."""
    c = frame.motors[candidate.motor or 0]
    if name == "periods_per_rev":
        return 0.5 * np.pi / max(_spread(c.position), 1e-300)
    if name == "position_rad":
        return _spread(c.link_position) / 12.0
    return float(np.max(np.abs(c.deflection))) / 9.0


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(x * x)))


def _spread(x: FloatArray) -> float:
    low, high = np.quantile(x, [0.01, 0.99])
    return float(high - low)
