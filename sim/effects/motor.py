"""Effects at the motor: friction, ripple, and differences between acting and reported torque.

Signs: x of a motor opposes it in eqs 5, 7, x of the link opposes it in eqs 4, 6, x of a transmission adds
to tau_e. Names and parameters are the estimator's, so that a model can be simulated; the laws are
independent.
"""

from __future__ import annotations

import math

from sim.effects.assembly import Assembly, Definition, EffectParameter, Values
from sim.effects.common import SLIP, SMOOTHING, at_speed, not_negative, slip, wave


def _coulomb(a: Assembly, m: int, p: Values) -> None:
    level = not_negative(p, "torque_nm")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: level, p["smoothing_rad_s"]))


def _stribeck(a: Assembly, m: int, p: Values) -> None:
    level, more = not_negative(p, "torque_nm"), p["stribeck_nm"]
    per = 1.0 / p["stribeck_velocity_rad_s"]
    exp = math.exp
    a.motors[m].dry.append(
        at_speed(lambda x, w, te, t: level + more * exp(-((w * per) ** 2)), p["smoothing_rad_s"])
    )


def _asymmetric(a: Assembly, m: int, p: Values) -> None:
    up, down = not_negative(p, "positive_nm"), not_negative(p, "negative_nm")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: up if w > 0.0 else down, p["smoothing_rad_s"]))


def _load_dependent(a: Assembly, m: int, p: Values) -> None:
    share = not_negative(p, "coefficient")
    a.motors[m].dry.append(at_speed(lambda x, w, te, t: share * abs(te), p["smoothing_rad_s"]))


def _presliding(a: Assembly, m: int, p: Values) -> None:
    element = slip(p)
    a.motors[m].loads.append(lambda theta, w: element.torque(theta))
    a.motors[m].commits.append(lambda theta, phi: element.commit(theta))


def _viscous(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].viscous_damping_nm_s_rad += p["damping_nm_s_rad"]


def _quadratic(a: Assembly, m: int, p: Values) -> None:
    c = p["damping_nm_s2_rad2"]
    a.motors[m].loads.append(lambda theta, w: c * w * abs(w))


def _cogging(a: Assembly, m: int, p: Values) -> None:
    n, sin = p["periods_per_rev"], math.sin
    height, phase = wave(p["sin_nm"], p["cos_nm"], n)
    a.motors[m].loads.append(lambda theta, w: height * sin(n * theta + phase))


def _torque_offset(a: Assembly, m: int, p: Values) -> None:
    offset = p["torque_nm"]
    a.motors[m].torque_path.append(lambda tau, t, theta: tau - offset)


def _torque_constant(a: Assembly, m: int, p: Values) -> None:
    scale = 1.0 + p["relative_error"]
    a.motors[m].torque_path.append(lambda tau, t, theta: tau * scale)


def _saturation(a: Assembly, m: int, p: Values) -> None:
    twice, sqrt = 2.0 * not_negative(p, "coefficient_per_nm2"), math.sqrt
    a.motors[m].torque_path.append(lambda tau, t, theta: tau / sqrt(1.0 + twice * tau * tau))


def _drift(a: Assembly, m: int, p: Values) -> None:
    change, rate, expm1 = p["relative_change"], 1.0 / p["time_constant_s"], math.expm1
    a.motors[m].torque_path.append(lambda tau, t, theta: tau * (1.0 - change * expm1(-rate * t)))


def _motor_inertia(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].inertia_kg_m2 += p["inertia_kg_m2"]


def _back_driving(a: Assembly, m: int, p: Values) -> None:
    share = not_negative(p, "coefficient")

    def level(position: float, velocity: float, load: float, time: float) -> float:
        return share * abs(load) if load * velocity >= 0.0 else 0.0

    a.motors[m].dry.append(at_speed(level, p["smoothing_rad_s"]))


def _torque_lag(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].torque_lag_s += p["time_constant_s"]


def _torque_delay(a: Assembly, m: int, p: Values) -> None:
    a.motors[m].torque_delay_s += not_negative(p, "delay_s")


DEFINITIONS = (
    Definition(
        name="coulomb_friction",
        location="motor",
        meaning="dry friction of one level, which sticks",
        parameters=(EffectParameter("torque_nm", "friction torque"), SMOOTHING),
        apply=_coulomb,
    ),
    Definition(
        name="stribeck_friction",
        location="motor",
        meaning="dry friction that falls with velocity",
        parameters=(
            EffectParameter("torque_nm", "friction torque while sliding"),
            EffectParameter("stribeck_nm", "what is added near standstill", lambda torque: 0.8 * torque),
            EffectParameter("stribeck_velocity_rad_s", "velocity at which it has decayed", 0.1),
            SMOOTHING,
        ),
        apply=_stribeck,
    ),
    Definition(
        name="asymmetric_friction",
        location="motor",
        meaning="dry friction that differs between the directions",
        parameters=(
            EffectParameter("positive_nm", "friction torque in positive motion"),
            EffectParameter(
                "negative_nm", "friction torque in negative motion", lambda positive: 0.4 * positive
            ),
            SMOOTHING,
        ),
        apply=_asymmetric,
    ),
    Definition(
        name="presliding_friction",
        location="motor",
        meaning="friction that builds up over a displacement",
        parameters=(*SLIP,),
        apply=_presliding,
    ),
    Definition(
        name="load_dependent_friction",
        location="motor",
        meaning="dry friction in proportion to the transmitted torque",
        parameters=(EffectParameter("coefficient", "friction per transmission torque"), SMOOTHING),
        apply=_load_dependent,
    ),
    Definition(
        name="viscous_damping",
        location="motor",
        meaning="viscous damping beyond what is declared",
        parameters=(EffectParameter("damping_nm_s_rad", "torque per velocity"),),
        apply=_viscous,
    ),
    Definition(
        name="quadratic_damping",
        location="motor",
        meaning="damping with the square of velocity",
        parameters=(EffectParameter("damping_nm_s2_rad2", "torque per squared velocity"),),
        apply=_quadratic,
    ),
    Definition(
        name="cogging",
        location="motor",
        meaning="torque ripple over the motor position",
        parameters=(
            EffectParameter("sin_nm", "amplitude of the sine"),
            EffectParameter("cos_nm", "amplitude of the cosine", 0.0),
            EffectParameter("periods_per_rev", "periods in one joint revolution", 24.0),
        ),
        apply=_cogging,
    ),
    Definition(
        name="torque_offset",
        location="motor",
        meaning="a constant torque that opposes what the drive reports",
        parameters=(EffectParameter("torque_nm", "that torque"),),
        apply=_torque_offset,
    ),
    Definition(
        name="torque_constant",
        location="motor",
        meaning="torque per ampere is another one than the drive believes",
        parameters=(EffectParameter("relative_error", "share by which more torque acts than is reported"),),
        apply=_torque_constant,
    ),
    Definition(
        name="torque_saturation",
        location="motor",
        meaning="iron saturates: large torques fall short, tau / sqrt(1 + 2 c tau²)",
        parameters=(EffectParameter("coefficient_per_nm2", "c; small torques lose c tau³"),),
        apply=_saturation,
    ),
    Definition(
        name="torque_drift",
        location="motor",
        meaning="torque per ampere changes as the motor warms up",
        parameters=(
            EffectParameter("relative_change", "change in the long run"),
            EffectParameter("time_constant_s", "time constant of the change", 20.0),
        ),
        apply=_drift,
    ),
    Definition(
        name="motor_inertia",
        location="motor",
        meaning="inertia beyond what is declared",
        parameters=(EffectParameter("inertia_kg_m2", "that inertia, at the joint"),),
        apply=_motor_inertia,
    ),
    Definition(
        name="torque_delay",
        location="motor",
        meaning="the torque acts later than it is reported",
        parameters=(EffectParameter("delay_s", "by this time"),),
        apply=_torque_delay,
    ),
    Definition(
        name="torque_lag",
        location="motor",
        meaning="the torque acts behind a first-order lag",
        parameters=(
            EffectParameter(
                "time_constant_s", "of the lag; negative: the reported torque lags the acting one"
            ),
        ),
        apply=_torque_lag,
    ),
    Definition(
        name="back_driving_loss",
        location="motor",
        meaning="the gear loses a share of the torque while the link drives the motor",
        parameters=(EffectParameter("coefficient", "loss per transmission torque"), SMOOTHING),
        apply=_back_driving,
    ),
)
