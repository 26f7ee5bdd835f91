"""Priors of a joint: one table for the on-line estimator, `fit` and `diagnose`.

Every number is a standard deviation relative to a scale given by the joint file or the recording, so the
table applies to joints of any size.
"""

from typing import Literal, NamedTuple

Scale = Literal[
    "absolute",  # nothing: in the unit of the quantity
    "declared",  # the declared value itself
    "torque",  # rms of the motor torque without its mean, N·m
    "torque over speed",  # that torque over the largest motor speed, N·m·s/rad
    "period",  # the sampling period, s
    "deflection",  # half the range of the deflection, rad
]


class Prior(NamedTuple):
    """A Gaussian prior about what is declared (zero where nothing is declared)."""

    std: float  # standard deviation, as a fraction of the scale
    scale: Scale  # what it is a share of
    meaning: str  # the quantity
    reason: str  # why this wide


PRIORS: dict[str, Prior] = {
    "motor_inertia": Prior(
        0.05, "declared", "motor inertia B", "rotor and gear inertias of data sheets agree with tests to 5 %"
    ),
    "torque_constant": Prior(
        0.03, "declared", "scale of the motor torque", "torque constants are specified to a few per cent"
    ),
    "viscous_damping": Prior(
        0.2, "declared", "viscous damping D beside its floor", "damping changes so much between cold and warm"
    ),
    "viscous_damping_floor": Prior(
        0.05, "torque over speed", "undeclared viscous damping", "what seals and grease take"
    ),
    "coulomb_friction": Prior(0.1, "torque", "undeclared dry friction", "usual loss of bearings and a gear"),
    "torque_offset": Prior(
        0.3, "torque", "constant torque", "current offsets, and a load that does not move"
    ),
    "deflection_offset": Prior(
        1.0, "deflection", "zero between the encoders", "two encoders are seldom set to one zero"
    ),
    "declared_zero": Prior(
        0.003,
        "deflection",
        "zero between the encoders where the joint file states it",
        "what is left once it has been set; on line it widens where the balance strains against it",
    ),
    "encoder_delay": Prior(
        1.0, "period", "delay of the link position", "it is sampled within a cycle and sent in the next one"
    ),
    "torque_delay": Prior(
        0.5, "period", "delay of the motor torque beyond its hold", "a drive samples within its own cycle"
    ),
    "link_inertia": Prior(
        0.1, "declared", "link inertia M", "payload and cables are seldom declared to better"
    ),
    "link_viscous_damping": Prior(
        0.2, "declared", "link damping D_q", "damping changes so much between cold and warm"
    ),
    "gravity": Prior(0.1, "declared", "amplitude of gravity", "as the link's inertia"),
    "effect": Prior(
        0.3, "torque", "torque of a missing effect", "larger ones are the joint's main physics, and declared"
    ),
    "load_dependent_friction": Prior(
        0.25, "absolute", "torque that a gear loses, as a share", "1 - e of gears with e from 0.6 to 0.95"
    ),
    "back_driving_loss": Prior(
        0.36, "absolute", "the same of one that the link drives", "1/e - 1 of the same gears"
    ),
    "undeclared_effect": Prior(
        0.05, "torque", "effect that nobody declared, on line", "machines are declared but for so much"
    ),
    "declared_law": Prior(
        0.3, "declared", "parameter of a law that is declared without its deviation", "as of data sheets"
    ),
    "declared": Prior(
        0.01, "declared", "a declared number, link dynamics declared too", "a rig that has been calibrated"
    ),
    "calibrated_torque": Prior(
        0.005, "declared", "scale of the motor torque then", "the anchor of all other calibrated numbers"
    ),
    "anchor": Prior(
        0.3, "declared", "an inertia that is called wrong", "inertias are the anchor of all torques"
    ),
    "torque_scale": Prior(0.1, "absolute", "relative error of a torque scale called wrong", "as the anchor"),
    "late": Prior(
        0.005, "absolute", "delay or lag beyond a sample, s", "current filters and fieldbus cycles"
    ),
    "late_deflection": Prior(
        0.03, "absolute", "delay of a deflection's sensor, s", "amplifiers of strain gauges take 5 to 100 ms"
    ),
    "encoder_scale": Prior(
        0.02, "absolute", "scale error of an encoder", "encoders count; gear ratios are rounded"
    ),
    "encoder_eccentricity": Prior(
        0.01, "absolute", "error of an encoder, rad", "mounting, well below a degree"
    ),
    "transmission": Prior(
        10.0, "torque", "flexibility torque at the deflections seen", "wide: the data decide"
    ),
}
