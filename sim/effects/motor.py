"""Effects at the motor: friction, ripple, and differences between acting and reported torque."""

import math
from functools import partial

from sim.effects.assembly import (
    LISTED,
    SLIP,
    SMOOTHING,
    Assembly,
    Values,
    at_speed,
    define,
    not_negative,
    slip,
    wave,
)

_effect = partial(define, LISTED, "motor")


@_effect(
    "coulomb_friction", "dry friction of one level, which sticks", torque_nm="friction torque", **SMOOTHING
)
def _coulomb(a: Assembly, m: int, p: Values) -> None:
    level = not_negative(p, "torque_nm")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: level, p["smoothing_rad_s"]))


@_effect(
    "stribeck_friction",
    "dry friction that falls with velocity",
    torque_nm="friction torque while sliding",
    stribeck_nm=("what is added near standstill", lambda torque: 0.8 * torque),
    stribeck_velocity_rad_s=("velocity at which it has decayed", 0.1),
    **SMOOTHING,
)
def _stribeck(a: Assembly, m: int, p: Values) -> None:
    level, more = not_negative(p, "torque_nm"), p["stribeck_nm"]
    per = 1.0 / p["stribeck_velocity_rad_s"]
    exp = math.exp
    a.motors[m].dry.append(
        at_speed(lambda x, w, te, t: level + more * exp(-((w * per) ** 2)), p["smoothing_rad_s"])
    )


@_effect(
    "asymmetric_friction",
    "dry friction that differs between the directions",
    positive_nm="friction torque in positive motion",
    negative_nm=("friction torque in negative motion", lambda positive: 0.4 * positive),
    **SMOOTHING,
)
def _asymmetric(a: Assembly, m: int, p: Values) -> None:
    up, down = not_negative(p, "positive_nm"), not_negative(p, "negative_nm")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: up if w > 0.0 else down, p["smoothing_rad_s"]))


@_effect("presliding_friction", "friction that builds up over a displacement", **SLIP)
def _presliding(a: Assembly, m: int, p: Values) -> None:
    element = slip(p)
    a.motors[m].loads.append(lambda theta, w: element.torque(theta))
    a.motors[m].commits.append(lambda theta, phi: element.commit(theta))


@_effect(
    "load_dependent_friction",
    "dry friction in proportion to the transmitted torque",
    coefficient="friction per transmission torque",
    **SMOOTHING,
)
def _load_dependent(a: Assembly, m: int, p: Values) -> None:
    share = not_negative(p, "coefficient")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: share * abs(te), p["smoothing_rad_s"]))


@_effect("viscous_damping", "viscous damping beyond what is declared", damping_nm_s_rad="torque per velocity")
def _viscous(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].viscous_damping_nm_s_rad += p["damping_nm_s_rad"]


@_effect(
    "quadratic_damping",
    "damping with the square of velocity",
    damping_nm_s2_rad2="torque per squared velocity",
)
def _quadratic(a: Assembly, m: int, p: Values) -> None:
    c = p["damping_nm_s2_rad2"]
    a.motors[m].loads.append(lambda theta, w: c * w * abs(w))


@_effect(
    "cogging",
    "torque ripple over the motor position",
    sin_nm="amplitude of the sine",
    cos_nm=("amplitude of the cosine", 0.0),
    periods_per_rev=("periods in one joint revolution", 24.0),
)
def _cogging(a: Assembly, m: int, p: Values) -> None:
    n, sin = p["periods_per_rev"], math.sin
    height, phase = wave(p["sin_nm"], p["cos_nm"], n)
    a.motors[m].loads.append(lambda theta, w: height * sin(n * theta + phase))


@_effect("torque_offset", "a constant torque that opposes what the drive reports", torque_nm="that torque")
def _torque_offset(a: Assembly, m: int, p: Values) -> None:
    offset = p["torque_nm"]
    a.motors[m].torque_path.append(lambda tau, t, theta: tau - offset)


@_effect(
    "torque_constant",
    "torque per ampere is another one than the drive believes",
    relative_error="share by which more torque acts than is reported",
)
def _torque_constant(a: Assembly, m: int, p: Values) -> None:
    scale = 1.0 + p["relative_error"]
    a.motors[m].torque_path.append(lambda tau, t, theta: tau * scale)


@_effect(
    "torque_saturation",
    "iron saturates: large torques fall short, tau / sqrt(1 + 2 c tau²)",
    coefficient_per_nm2="c; small torques lose c tau³",
)
def _saturation(a: Assembly, m: int, p: Values) -> None:
    twice, sqrt = 2.0 * not_negative(p, "coefficient_per_nm2"), math.sqrt
    a.motors[m].torque_path.append(lambda tau, t, theta: tau / sqrt(1.0 + twice * tau * tau))


@_effect(
    "torque_drift",
    "torque per ampere changes as the motor warms up",
    relative_change="change in the long run",
    time_constant_s=("time constant of the change", 20.0),
)
def _drift(a: Assembly, m: int, p: Values) -> None:
    change, rate, expm1 = p["relative_change"], 1.0 / p["time_constant_s"], math.expm1
    a.motors[m].torque_path.append(lambda tau, t, theta: tau * (1.0 - change * expm1(-rate * t)))


@_effect("motor_inertia", "inertia beyond what is declared", inertia_kg_m2="that inertia, at the joint")
def _motor_inertia(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].inertia_kg_m2 += p["inertia_kg_m2"]


@_effect("torque_delay", "the torque acts later than it is reported", delay_s="by this time")
def _torque_delay(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].torque_delay_s += not_negative(p, "delay_s")


@_effect(
    "torque_lag",
    "the torque acts behind a first-order lag",
    time_constant_s="of the lag; negative: the reported torque lags the acting one",
)
def _torque_lag(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].torque_lag_s += p["time_constant_s"]


@_effect(
    "back_driving_loss",
    "the gear loses a share of the torque while the link drives the motor",
    coefficient="loss per transmission torque",
    **SMOOTHING,
)
def _back_driving(a: Assembly, m: int, p: Values) -> None:
    share = not_negative(p, "coefficient")

    def level(position: float, velocity: float, load: float, time: float) -> float:
        return share * abs(load) if load * velocity >= 0.0 else 0.0

    a.motors[m].dry.append(at_speed(level, p["smoothing_rad_s"]))
