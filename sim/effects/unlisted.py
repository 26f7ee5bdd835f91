"""Effects outside the estimator's library, to test diagnosis on the unknown."""

import math
from functools import partial

from sim.effects.assembly import UNLISTED, Assembly, Described, Values, define, not_negative
from sim.effects.memory import Creep
from sim.errors import SimError

_effect = partial(define, UNLISTED)

_WIDTH: dict[str, Described] = {"width_rad": ("how far it reaches", 0.1)}


@_effect(
    "motor",
    "damaged_tooth",
    "dry friction in one place only",
    torque_nm="friction torque there",
    position_rad=("where, as motor position at the joint", 0.0),
    **_WIDTH,
)
def _damaged_tooth(a: Assembly, m: int, p: Values) -> None:
    level, at, per, exp = not_negative(p, "torque_nm"), p["position_rad"], 1.0 / p["width_rad"], math.exp
    a.motors[m].dry.append(lambda theta, w, te, t: level * exp(-(((theta - at) * per) ** 2)))


@_effect(
    "motor",
    "cold_grease",
    "dry friction that fades as the joint warms up",
    torque_nm="friction torque at the start",
    time_constant_s=("in which it fades", 5.0),
)
def _cold_grease(a: Assembly, m: int, p: Values) -> None:
    level, rate, exp = not_negative(p, "torque_nm"), 1.0 / p["time_constant_s"], math.exp
    a.motors[m].dry.append(lambda theta, w, te, t: level * exp(-rate * t))


@_effect(
    "motor",
    "phase_imbalance",
    "ripple in proportion to the torque, over the motor position",
    relative="share of the torque",
    periods_per_rev=("periods in one joint revolution", 20.0),
)
def _phase_imbalance(a: Assembly, m: int, p: Values) -> None:
    share, n, sin = p["relative"], p["periods_per_rev"], math.sin
    a.motors[m].torque_path.append(lambda tau, t, theta: tau * (1.0 + share * sin(n * theta)))


@_effect(
    "transmission",
    "mesh_stiffness",
    "stiffness that varies over the motor position",
    relative="share of the stiffness",
    periods_per_rev=("periods in one joint revolution", 10.0),
)
def _mesh_stiffness(a: Assembly, m: int, p: Values) -> None:
    share, n, sin = p["relative"], p["periods_per_rev"], math.sin
    torque = a.plant.motors[m].law().torque
    a.motors[m].extras.append(lambda phi, rate, theta: share * sin(n * theta) * torque(phi))


@_effect(
    "transmission",
    "creep",
    "a further spring that relaxes (Maxwell)",
    stiffness_nm_rad="stiffness at once",
    time_constant_s=("in which it relaxes", 0.5),
)
def _creep(a: Assembly, m: int, p: Values) -> None:
    if p["time_constant_s"] <= 0.0:
        raise SimError(f"time_constant_s: expected a number > 0, got {p['time_constant_s']!r}")
    element = Creep(p["stiffness_nm_rad"], p["time_constant_s"], a.step_s)
    a.motors[m].extras.append(lambda phi, rate, theta: element.torque(phi))
    a.motors[m].commits.append(lambda theta, phi: element.commit(phi))


@_effect(
    "link",
    "cable_pull",
    "a cable that is pushed aside in one place",
    torque_nm="largest torque, on either side of it",
    position_rad=("where", 0.1),
    **_WIDTH,
)
def _cable_pull(a: Assembly, m: int, p: Values) -> None:
    height, at, per, exp = p["torque_nm"], p["position_rad"], 1.0 / p["width_rad"], math.exp

    def pull(q: float, v: float) -> float:
        u = (q - at) * per
        return height * u * exp(0.5 - 0.5 * u * u)

    a.link.loads.append(pull)


@_effect(
    "link",
    "air_drag",
    "drag with the square of the link velocity",
    damping_nm_s2_rad2="torque per squared velocity",
)
def _air_drag(a: Assembly, m: int, p: Values) -> None:
    c = p["damping_nm_s2_rad2"]
    a.link.loads.append(lambda q, v: c * v * abs(v))


@_effect(
    "measurement",
    "interpolation_error",
    "the link encoder errs within each of its lines",
    amplitude_rad="largest error",
    periods_per_rev=("lines of its disc", 64.0),
)
def _interpolation_error(a: Assembly, m: int, p: Values) -> None:
    height, n, sin = p["amplitude_rad"], p["periods_per_rev"], math.sin
    a.link.readings.append(lambda q: q + height * sin(n * q))
