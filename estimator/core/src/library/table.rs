//! The effects of the library, and what their parameters mean.

use super::{Kind, Law, Parameter, Place, Role};

const fn linear(name: &'static str, meaning: &'static str) -> Parameter {
    Parameter { name, meaning, role: Role::Linear, default: None }
}

const fn loss(name: &'static str, meaning: &'static str) -> Parameter {
    Parameter { name, meaning, role: Role::Loss, default: None }
}

const fn shape(name: &'static str, meaning: &'static str, default: Option<f64>) -> Parameter {
    Parameter { name, meaning, role: Role::Shape, default }
}

const fn scale(name: &'static str, meaning: &'static str, default: Option<f64>) -> Parameter {
    Parameter { name, meaning, role: Role::Scale, default }
}

const SMOOTHING: Parameter = scale("smoothing_rad_s", "velocity over which the sign changes", Some(0.01));
const PERIODS: Parameter = shape("periods_per_rev", "periods in one joint revolution", None);
const RELATIVE_ERROR: Parameter = linear("relative_error", "share by which the scale is off");
const DAMPING: Parameter = linear("damping_nm_s_rad", "damping beyond what is declared");
const INERTIA: Parameter = linear("inertia_kg_m2", "inertia beyond what is declared");
pub(super) const MEMORY: &[Parameter] = &[
    loss("torque_nm", "torque at full sliding"),
    scale("displacement_rad", "displacement scale of the build-up", None),
    scale("exponent", "1: Dahl; 2: Bouc-Wen; 50 and more: elastic up to the limit", Some(1.0)),
    shape("shape", "share of the law that depends on the direction (Dahl 1, Bouc-Wen 0.5)", Some(1.0)),
];

/// Where the velocity over which the sign changes stands among a kind's parameters.
pub(super) fn smoothing(kind: &Kind) -> Option<usize> {
    kind.parameters.iter().position(|parameter| parameter.name == SMOOTHING.name)
}

pub(super) fn one(term: f64) -> [f64; 2] {
    [term, 0.0]
}

fn sign(velocity: f64, smoothing: f64) -> f64 {
    (velocity / smoothing).tanh()
}

fn waves(angle: f64) -> [f64; 2] {
    let (sine, cosine) = angle.sin_cos();
    [sine, cosine]
}

/// The effects, by their names in joint files.
pub static LIBRARY: &[Kind] = &[
    Kind {
        name: "coulomb_friction",
        place: Place::Motor,
        coordinates: &["velocity"],
        parameters: &[loss("torque_nm", "friction torque"), SMOOTHING],
        law: Law::Terms(|c, v| one(sign(c.velocity, v[1]))),
        description: "dry friction of the motor",
    },
    Kind {
        name: "stribeck_friction",
        place: Place::Motor,
        coordinates: &["velocity"],
        parameters: &[
            loss("torque_nm", "friction torque while sliding"),
            loss("stribeck_nm", "what is added near standstill"),
            scale("stribeck_velocity_rad_s", "velocity at which it has decayed", None),
            SMOOTHING,
        ],
        law: Law::Terms(|c, v| {
            let (ratio, sign) = (c.velocity / v[2], sign(c.velocity, v[3]));
            [sign, sign * (-ratio * ratio).exp()]
        }),
        description: "dry friction that falls with velocity",
    },
    Kind {
        name: "asymmetric_friction",
        place: Place::Motor,
        coordinates: &["velocity"],
        parameters: &[
            loss("positive_nm", "friction torque in positive motion"),
            loss("negative_nm", "friction torque in negative motion"),
            SMOOTHING,
        ],
        law: Law::Terms(|c, v| {
            let sign = sign(c.velocity, v[2]);
            [0.5 * (sign + sign.abs()), 0.5 * (sign - sign.abs())]
        }),
        description: "dry friction that differs between the directions",
    },
    Kind {
        name: "presliding_friction",
        place: Place::Motor,
        coordinates: &["position", "velocity"],
        parameters: MEMORY,
        law: Law::Memory { path: |c| c.position, rate: |c| c.velocity },
        description: "friction that builds up over a displacement",
    },
    Kind {
        name: "load_dependent_friction",
        place: Place::Motor,
        coordinates: &["velocity", "flexibility_torque"],
        parameters: &[loss("coefficient", "friction per flexibility torque"), SMOOTHING],
        law: Law::Terms(|c, v| one(c.flexibility_torque.abs() * sign(c.velocity, v[1]))),
        description: "dry friction that grows with the transmitted torque",
    },
    Kind {
        name: "viscous_damping",
        place: Place::Motor,
        coordinates: &["velocity"],
        parameters: &[DAMPING],
        law: Law::Terms(|c, _| one(c.velocity)),
        description: "viscous damping of the motor",
    },
    Kind {
        name: "quadratic_damping",
        place: Place::Motor,
        coordinates: &["velocity"],
        parameters: &[loss("damping_nm_s2_rad2", "torque per squared velocity")],
        law: Law::Terms(|c, _| one(c.velocity * c.velocity.abs())),
        description: "damping that grows with the square of velocity",
    },
    Kind {
        name: "cogging",
        place: Place::Motor,
        coordinates: &["position"],
        parameters: &[
            linear("sin_nm", "amplitude of the sine"),
            linear("cos_nm", "amplitude of the cosine"),
            PERIODS,
        ],
        law: Law::Terms(|c, v| waves(v[2] * c.position)),
        description: "torque ripple over the motor position",
    },
    Kind {
        name: "torque_offset",
        place: Place::Motor,
        coordinates: &["time"],
        parameters: &[linear("torque_nm", "torque that is always there")],
        law: Law::Terms(|_, _| one(1.0)),
        description: "offset of the motor torque or current",
    },
    Kind {
        name: "torque_constant",
        place: Place::Torque,
        coordinates: &["torque"],
        parameters: &[RELATIVE_ERROR],
        law: Law::Terms(|c, _| one(-c.torque)),
        description: "the torque that acts is another multiple of what is reported",
    },
    Kind {
        name: "torque_saturation",
        place: Place::Torque,
        coordinates: &["torque"],
        parameters: &[loss("coefficient_per_nm2", "what is lost per cubed torque")],
        law: Law::Terms(|c, _| one(c.torque * c.torque * c.torque)),
        description: "large torques fall short of what is reported",
    },
    Kind {
        name: "torque_drift",
        place: Place::Torque,
        coordinates: &["time", "torque"],
        parameters: &[
            linear("relative_change", "change of the torque scale in the long run"),
            scale("time_constant_s", "time constant of the change", None),
        ],
        law: Law::Terms(|c, v| one(-c.torque * (1.0 - (-c.time / v[1]).exp()))),
        description: "the torque scale changes as the motor warms up",
    },
    Kind {
        name: "motor_inertia",
        place: Place::Motor,
        coordinates: &["acceleration"],
        parameters: &[INERTIA],
        law: Law::Terms(|c, _| one(c.acceleration)),
        description: "another motor inertia than declared",
    },
    Kind {
        name: "torque_delay",
        place: Place::TorqueDelay,
        coordinates: &["torque_rate"],
        parameters: &[linear("delay_s", "the torque acts later than reported by")],
        law: Law::Terms(|c, _| one(c.torque_rate)),
        description: "the torque acts later than it is reported",
    },
    Kind {
        name: "torque_lag",
        place: Place::TorqueLag,
        coordinates: &["torque_rate"],
        parameters: &[linear(
            "time_constant_s",
            "by which the acting torque lags; negative: the reported one does",
        )],
        law: Law::Terms(|c, _| one(c.torque_rate)),
        description: "reported and acting torque are apart by a first-order lag",
    },
    Kind {
        name: "back_driving_loss",
        place: Place::Motor,
        coordinates: &["velocity", "flexibility_torque"],
        parameters: &[loss("coefficient", "loss per flexibility torque while the link drives"), SMOOTHING],
        // τ_e acts on the motor as +τ_e: the link drives while it has the velocity's sign.
        law: Law::Terms(|c, v| {
            let (torque, sign) = (c.flexibility_torque, sign(c.velocity, v[1]));
            one(0.5 * (torque.abs() * sign + torque * sign.abs()))
        }),
        description: "the gear loses torque while the link drives the motor",
    },
    Kind {
        name: "hysteresis",
        place: Place::Transmission,
        coordinates: &["deflection", "deflection_rate"],
        parameters: MEMORY,
        law: Law::Memory { path: |c| c.deflection, rate: |c| c.deflection_rate },
        description: "hysteresis of the transmission",
    },
    Kind {
        name: "backlash",
        place: Place::Transmission,
        coordinates: &["deflection"],
        parameters: &[
            loss("stiffness_nm_rad", "stiffness that is missing inside the gap"),
            scale("half_gap_rad", "half of the gap", None),
        ],
        law: Law::Spring(|phi, v| {
            let (above, below) = (phi - v[1], phi + v[1]);
            (0.5 * (above.abs() - below.abs()), 0.5 * (above.signum() - below.signum()))
        }),
        description: "play: a range of deflection without torque",
    },
    Kind {
        name: "asymmetric_stiffness",
        place: Place::Transmission,
        coordinates: &["deflection"],
        parameters: &[linear("coefficient_nm_rad2", "torque per squared deflection")],
        law: Law::Spring(|phi, _| (phi * phi, 2.0 * phi)),
        description: "stiffness that differs between the directions",
    },
    Kind {
        name: "higher_order_stiffness",
        place: Place::Transmission,
        coordinates: &["deflection"],
        parameters: &[
            linear("coefficient", "torque per power of deflection, N·m/rad^power"),
            scale("power", "odd power of the deflection", Some(5.0)),
        ],
        law: Law::Spring(|phi, v| {
            let power = v[1] as i32;
            (phi.powi(power), f64::from(power) * phi.powi(power - 1))
        }),
        description: "stiffening beyond the declared model",
    },
    Kind {
        name: "transmission_damping",
        place: Place::Transmission,
        coordinates: &["deflection_rate"],
        parameters: &[loss("damping_nm_s_rad", "torque per deflection rate")],
        law: Law::Terms(|c, _| one(c.deflection_rate)),
        description: "viscous damping of the transmission",
    },
    Kind {
        name: "kinematic_error",
        place: Place::Transmission,
        coordinates: &["position", "stiffness"],
        parameters: &[
            linear("sin_rad", "amplitude of the sine, as a deflection"),
            linear("cos_rad", "amplitude of the cosine, as a deflection"),
            PERIODS,
        ],
        law: Law::Terms(|c, v| waves(v[2] * c.position).map(|wave| c.stiffness * wave)),
        description: "transmission error over the motor position",
    },
    Kind {
        name: "deflection_offset",
        place: Place::Deflection,
        coordinates: &["time"],
        parameters: &[linear("offset_rad", "deflection that is read when there is none")],
        law: Law::Terms(|_, _| one(1.0)),
        description: "constant offset between the encoders",
    },
    Kind {
        name: "encoder_eccentricity",
        place: Place::LinkReading,
        coordinates: &["link_position"],
        parameters: &[
            linear("sin_rad", "amplitude of the reading's error, sine of q"),
            linear("cos_rad", "amplitude of the reading's error, cosine of q"),
        ],
        law: Law::Terms(|c, _| waves(c.link_position)),
        description: "once-per-revolution error of the link encoder",
    },
    Kind {
        name: "encoder_delay",
        place: Place::LinkDelay,
        coordinates: &["link_velocity"],
        parameters: &[linear("delay_s", "the link position is read later than the rest by")],
        law: Law::Terms(|c, _| one(-c.link_velocity)),
        description: "the link encoder lags the other channels",
    },
    Kind {
        name: "deflection_delay",
        place: Place::DeflectionDelay,
        coordinates: &["deflection_rate"],
        parameters: &[loss("delay_s", "the deflection is read later than the rest by")],
        law: Law::Terms(|c, _| one(-c.deflection_rate)),
        description: "the deflection's sensor lags the other channels",
    },
    Kind {
        name: "encoder_scale",
        place: Place::LinkReading,
        coordinates: &["link_position"],
        parameters: &[RELATIVE_ERROR],
        law: Law::Terms(|c, _| one(c.link_position)),
        description: "scale error of the link encoder",
    },
    Kind {
        name: "gravity",
        place: Place::Link,
        coordinates: &["link_position"],
        parameters: &[
            linear("sin_nm", "torque times sin q beyond what is declared"),
            linear("cos_nm", "torque times cos q beyond what is declared"),
        ],
        law: Law::Terms(|c, _| waves(c.link_position)),
        description: "gravity torque of the link",
    },
    Kind {
        name: "link_coulomb_friction",
        place: Place::Link,
        coordinates: &["link_velocity"],
        parameters: &[loss("torque_nm", "friction torque"), SMOOTHING],
        law: Law::Terms(|c, v| one(sign(c.link_velocity, v[1]))),
        description: "dry friction of the link",
    },
    Kind {
        name: "link_viscous_damping",
        place: Place::Link,
        coordinates: &["link_velocity"],
        parameters: &[DAMPING],
        law: Law::Terms(|c, _| one(c.link_velocity)),
        description: "viscous damping of the link",
    },
    Kind {
        name: "link_inertia",
        place: Place::Link,
        coordinates: &["link_acceleration"],
        parameters: &[INERTIA],
        law: Law::Terms(|c, _| one(c.link_acceleration)),
        description: "another link inertia than declared",
    },
    Kind {
        name: "contact",
        place: Place::Link,
        coordinates: &["link_position"],
        parameters: &[
            loss("stiffness_nm_rad", "stiffness of what is touched"),
            shape("position_rad", "link position of the first touch", None),
            shape("side", "1: touched from below, -1: from above", Some(1.0)),
        ],
        law: Law::Terms(|c, v| {
            let depth = v[2] * (c.link_position - v[1]);
            one(0.5 * v[2] * (depth + depth.abs()))
        }),
        description: "the link touches something",
    },
];

/// What a `kinematic_error` e(θ) does to its motor: the spring's torque acts as τ_e (1 − e′), since it does as
/// much work on both sides. Of the same parameters; no effect of its own.
pub static REACTION: Kind = Kind {
    name: "kinematic_reaction",
    place: Place::Motor,
    coordinates: &["position", "flexibility_torque"],
    parameters: &[linear("sin_rad", "of the error"), linear("cos_rad", "of the error"), PERIODS],
    law: Law::Terms(|c, v| {
        let [sine, cosine] = waves(v[2] * c.position);
        let steep = v[2] * c.flexibility_torque;
        [steep * cosine, -steep * sine]
    }),
    description: "reaction of a kinematic error",
};
