//! The library of physical effects.
//!
//! An entry of [`LIBRARY`] is the only definition of an effect, for the tick, `fit`, `diagnose` and the
//! documentation.
//!
//! Signs: with x in N·m, B θ″ + D θ′ + x_motor − τ_e(φ) − x_transmission = τ and
//! M q″ + D_q q′ + g(q) + τ_e + x_transmission + x_link = τ_k. x is the sum over an effect's terms, each
//! times its linear parameter. A measured torque is the acting torque plus x; a reading is the true position
//! plus its error.

use serde::{Deserialize, Serialize};

use crate::error::Error;

/// Parameters of one element, at most.
pub const VALUES: usize = 4;
/// Beyond this nothing is a measurement any more; terms are not evaluated there.
pub const ABSURD: f64 = 1e9;
macro_rules! coordinates {
    ($($(#[$doc:meta])* $field:ident),* $(,)?) => {
        /// What a term may depend on; SI, all filtered alike.
        #[derive(Clone, Copy, Debug, Default, PartialEq)]
        pub struct Coordinates { $($(#[$doc])* pub $field: f64),* }

        impl Coordinates {
            /// Their names, in order.
            pub const NAMES: &[&str] = &[$(stringify!($field)),*];

            /// From numbers in the order of `NAMES`.
            #[must_use]
            pub fn from_fn(mut number: impl FnMut(usize) -> f64) -> Coordinates {
                let mut place = 0;
                $(let $field = number(place); place += 1;)*
                debug_assert_eq!(place, Coordinates::NAMES.len());
                Coordinates { $($field),* }
            }

            /// One of them, by its place in `NAMES`.
            pub fn set(&mut self, place: usize, number: f64) {
                let mut at = 0;
                $(if at == place { self.$field = number; } at += 1;)*
                debug_assert!(place < at);
            }

            /// Whether all are numbers that a measurement may give.
            #[must_use]
            pub fn sane(&self) -> bool {
                $(self.$field.abs() < ABSURD)&&*
            }
        }
    };
}

coordinates! {
    /// θ.
    position,
    /// θ′.
    velocity,
    /// θ″.
    acceleration,
    /// φ = q − θ.
    deflection,
    /// φ′.
    deflection_rate,
    /// τ_e(φ).
    flexibility_torque,
    /// σ(φ).
    stiffness,
    /// τ.
    torque,
    /// τ′.
    torque_rate,
    /// q.
    link_position,
    /// q′.
    link_velocity,
    /// q″.
    link_acceleration,
    /// Since the start.
    time,
}

/// Where an effect acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// x_motor of eq 5.
    Motor,
    /// x_transmission of eqs 4 and 5.
    Transmission,
    /// x_link of eq 4.
    Link,
    /// The motor torque's measurement.
    Torque,
    /// When the motor torque acts, against when it is reported.
    TorqueDelay,
    /// The same, by a first-order lag.
    TorqueLag,
    /// The zero between the encoders.
    Deflection,
    /// The link encoder's reading.
    LinkReading,
    /// When the link encoder reads.
    LinkDelay,
    /// When a sensor of the deflection reads, whose sum with the first motor's position is the link's.
    DeflectionDelay,
}

impl Place {
    /// (location, channel) as `estimator.effects` names them.
    #[must_use]
    pub fn names(self) -> (&'static str, &'static str) {
        match self {
            Place::Motor => ("motor", "torque"),
            Place::Transmission => ("transmission", "torque"),
            Place::Link => ("link", "torque"),
            Place::Torque | Place::TorqueDelay | Place::TorqueLag => ("motor", "motor_torque"),
            Place::Deflection => ("measurement", "deflection"),
            Place::LinkReading | Place::LinkDelay | Place::DeflectionDelay => {
                ("measurement", "link_position")
            }
        }
    }

    /// Whether it belongs to the link or its encoder, not to a motor.
    #[must_use]
    pub fn on_link(self) -> bool {
        matches!(self, Place::Link | Place::LinkReading | Place::LinkDelay | Place::DeflectionDelay)
    }
}

/// What values a parameter may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The effect is proportional to it; the k-th of them weighs the k-th term.
    Linear,
    /// The same, and it is not negative: it only dissipates, or is only missing.
    Loss,
    /// It enters nonlinearly; any number.
    Shape,
    /// It enters nonlinearly, and is above 0.
    Scale,
}

impl Role {
    /// Whether the effect is proportional to the parameter.
    #[must_use]
    pub fn linear(self) -> bool {
        matches!(self, Role::Linear | Role::Loss)
    }
}

/// One parameter of an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameter {
    /// With its unit, as it stands in a joint file.
    pub name: &'static str,
    /// In words.
    pub meaning: &'static str,
    /// See [`Role`].
    pub role: Role,
    /// Its value where a joint file leaves it out; `None`: it must be given.
    pub default: Option<f64>,
}

/// Parameters in the order of their kind, padded with zeros.
pub type Values = [f64; VALUES];

/// What an effect does; all of it without its linear parameters.
#[derive(Clone, Copy, Debug)]
pub enum Law {
    /// Terms, one a linear parameter.
    Terms(fn(&Coordinates, &Values) -> [f64; 2]),
    /// One term of the deflection alone, a part of the spring: the term and its slope at φ.
    Spring(fn(f64, &Values) -> (f64, f64)),
    /// A [`Memory`] that moves along this path, at this rate; its state is the term.
    Memory {
        /// The displacement, rad.
        path: fn(&Coordinates) -> f64,
        /// Its derivative, rad/s.
        rate: fn(&Coordinates) -> f64,
    },
}

/// One kind of effect.
#[derive(Clone, Copy, Debug)]
pub struct Kind {
    /// As in joint files and reports.
    pub name: &'static str,
    /// See [`Place`].
    pub place: Place,
    /// What it depends on; first the one that reveals it.
    pub coordinates: &'static [&'static str],
    /// The linear ones first; those of a memory are torque, displacement, exponent, shape.
    pub parameters: &'static [Parameter],
    /// See [`Law`].
    pub law: Law,
    /// For reports, in a few words.
    pub description: &'static str,
}

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
const MEMORY: &[Parameter] = &[
    loss("torque_nm", "torque at full sliding"),
    scale("displacement_rad", "displacement scale of the build-up", None),
    scale("exponent", "1: Dahl; 2: Bouc-Wen; 50 and more: elastic up to the limit", Some(1.0)),
    shape("shape", "share of the law that depends on the direction (Dahl 1, Bouc-Wen 0.5)", Some(1.0)),
];

fn one(term: f64) -> [f64; 2] {
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

impl Kind {
    /// By its name.
    #[must_use]
    pub fn named(name: &str) -> Option<&'static Kind> {
        LIBRARY.iter().chain([&REACTION]).find(|kind| kind.name == name)
    }

    /// What acts on the motor beside it, with the same parameters.
    #[must_use]
    pub fn reaction(&self) -> Option<&'static Kind> {
        (self.name == "kinematic_error").then_some(&REACTION)
    }

    /// How many linear parameters it has, each weighing one term.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.parameters.iter().filter(|parameter| parameter.role.linear()).count()
    }
}

/// One element of an effect.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Element {
    /// What it is.
    #[serde(with = "by_name")]
    pub kind: &'static Kind,
    /// Its parameters.
    pub values: Values,
}

/// A kind as its name.
mod by_name {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    use super::Kind;

    pub fn serialize<S: Serializer>(kind: &&'static Kind, to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(kind.name)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<&'static Kind, D::Error> {
        let name = <&str>::deserialize(from)?;
        Kind::named(name).ok_or_else(|| D::Error::custom(format!("no such effect: {name}")))
    }
}

impl Element {
    /// An element from its kind's parameters in order.
    ///
    /// # Errors
    /// There is no such effect, it has another number of parameters, or a value is impossible.
    pub fn new(name: &str, values: &[f64]) -> Result<Element, Error> {
        let wrong = |what: String| Error(format!("effect \"{name}\": {what}"));
        let kind = Kind::named(name).ok_or_else(|| wrong("no such effect".into()))?;
        let (expected, got) = (kind.parameters.len(), values.len());
        if got != expected {
            return Err(wrong(format!("expected {expected} values, got {got}")));
        }
        for (parameter, value) in kind.parameters.iter().zip(values) {
            let name = parameter.name;
            if !value.is_finite() {
                return Err(wrong(format!("{name}: expected a finite number, got {value}")));
            }
            if parameter.role == Role::Scale && *value <= 0.0 {
                return Err(wrong(format!("{name}: expected a number above 0, got {value}")));
            }
        }
        let mut padded = [0.0; VALUES];
        padded[..got].copy_from_slice(values);
        Ok(Element { kind, values: padded })
    }

    /// Its terms, unweighted; those with a memory have none at a single moment.
    #[must_use]
    pub fn terms(&self, c: &Coordinates) -> [f64; 2] {
        match self.kind.law {
            Law::Terms(terms) => terms(c, &self.values),
            Law::Spring(term) => one(term(c.deflection, &self.values).0),
            Law::Memory { .. } => [0.0; 2],
        }
    }

    /// Whether its torque acts on the link (x_link of eq 4).
    #[must_use]
    pub fn acts_on_link(&self) -> bool {
        self.kind.place == Place::Link
    }

    /// x of an element without a memory.
    #[must_use]
    pub fn torque(&self, c: &Coordinates) -> f64 {
        let terms = self.terms(c);
        let weighted = self.values[0] * terms[0];
        if self.kind.terms() == 2 { weighted + self.values[1] * terms[1] } else { weighted }
    }

    /// (x, ∂x/∂φ) where x depends on the deflection alone, so that the element is a part of the spring.
    #[must_use]
    pub fn spring(&self, phi: f64) -> Option<(f64, f64)> {
        let Law::Spring(term) = self.kind.law else { return None };
        let (torque, slope) = term(phi, &self.values);
        Some((self.values[0] * torque, self.values[0] * slope))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn element(name: &str, values: &[f64]) -> Element {
        Element::new(name, values).unwrap()
    }

    #[test]
    fn every_kind_is_whole() {
        for kind in LIBRARY {
            assert!(std::ptr::eq(Kind::named(kind.name).unwrap(), kind), "{}: a name twice", kind.name);
            assert!((1..=2).contains(&kind.terms()) && kind.parameters.len() <= VALUES, "{}", kind.name);
            let linear = |parameter: &Parameter| parameter.role.linear();
            assert!(kind.parameters[..kind.terms()].iter().all(linear), "{}: linear ones first", kind.name);
            if let Law::Memory { .. } = kind.law {
                assert!(kind.parameters == MEMORY);
            }
        }
    }

    #[test]
    fn an_effect_depends_on_what_it_names_alone() {
        for kind in LIBRARY {
            // Nothing is saturated here, and every other coordinate is absurd.
            let element = Element { kind, values: [1.0, 1.5, 2.5, 3.5] };
            let mut named = Coordinates::default();
            for name in kind.coordinates {
                let place = Coordinates::NAMES.iter().position(|known| known == name);
                named.set(place.unwrap(), 0.7);
            }
            let place = |k: usize| kind.coordinates.contains(&Coordinates::NAMES[k]);
            let others = Coordinates::from_fn(|k| if place(k) { 0.7 } else { f64::NAN });
            assert_eq!(element.terms(&named), element.terms(&others), "{}", kind.name);
            if let Law::Memory { path, rate } = kind.law {
                assert!(path(&others) + rate(&others) == 1.4);
            }
        }
    }

    #[test]
    fn terms_are_their_closed_forms() {
        let mut number = 0.0;
        let c = Coordinates::from_fn(|_| {
            number += 0.13;
            number
        });
        let (v, phi, tau) = (c.velocity, c.deflection, c.torque);
        for (name, values, expected) in [
            ("coulomb_friction", vec![1.0, 0.2], vec![(v / 0.2).tanh()]),
            (
                "stribeck_friction",
                vec![1.0, 1.0, 0.3, 0.2],
                vec![(v / 0.2).tanh(), (v / 0.2).tanh() * (-(v / 0.3).powi(2)).exp()],
            ),
            ("asymmetric_friction", vec![1.0, 1.0, 0.2], vec![(v / 0.2).tanh(), 0.0]),
            ("load_dependent_friction", vec![1.0, 0.2], vec![c.flexibility_torque * (v / 0.2).tanh()]),
            ("back_driving_loss", vec![1.0, 0.2], vec![c.flexibility_torque * (v / 0.2).tanh()]),
            ("viscous_damping", vec![1.0], vec![v]),
            ("quadratic_damping", vec![1.0], vec![v * v]),
            ("cogging", vec![1.0, 1.0, 7.0], vec![(7.0 * c.position).sin(), (7.0 * c.position).cos()]),
            ("torque_constant", vec![1.0], vec![-tau]),
            ("torque_saturation", vec![1.0], vec![tau.powi(3)]),
            ("torque_drift", vec![1.0, 2.0], vec![-tau * (1.0 - (-c.time / 2.0).exp())]),
            ("torque_lag", vec![1.0], vec![c.torque_rate]),
            ("backlash", vec![1.0, 0.05], vec![-0.05]),
            ("asymmetric_stiffness", vec![1.0], vec![phi * phi]),
            ("higher_order_stiffness", vec![1.0, 5.0], vec![phi.powi(5)]),
            (
                "kinematic_error",
                vec![1.0, 1.0, 3.0],
                vec![c.stiffness * (3.0 * c.position).sin(), c.stiffness * (3.0 * c.position).cos()],
            ),
            ("gravity", vec![1.0, 1.0], vec![c.link_position.sin(), c.link_position.cos()]),
            ("link_inertia", vec![1.0], vec![c.link_acceleration]),
            ("contact", vec![1.0, 1.0, 1.0], vec![c.link_position - 1.0]),
            ("contact", vec![1.0, 1.0, -1.0], vec![0.0]),
        ] {
            let found = element(name, &values).terms(&c);
            for (found, expected) in found.iter().zip(expected) {
                assert!((found - expected).abs() < 1e-12, "{name}: {found} is not {expected}");
            }
        }
        // While the motor drives the link, there is no back-driving loss.
        let driving = Coordinates { velocity: -v, ..c };
        assert!(element("back_driving_loss", &[1.0, 0.2]).terms(&driving)[0].abs() < 1e-12);
    }

    #[test]
    fn springs_have_the_slope_of_their_torque() {
        for element in [
            element("backlash", &[30.0, 0.05]),
            element("asymmetric_stiffness", &[4.0]),
            element("higher_order_stiffness", &[7.0, 5.0]),
        ] {
            for phi in [-0.2, -0.02, 0.03, 0.3] {
                let h = 1e-6;
                let torque = |phi: f64| element.spring(phi).unwrap().0;
                let slope = (torque(phi + h) - torque(phi - h)) / (2.0 * h);
                assert!((element.spring(phi).unwrap().1 - slope).abs() < 1e-6 * slope.abs().max(1.0));
                let c = Coordinates { deflection: phi, ..Coordinates::default() };
                assert!((element.torque(&c) - torque(phi)).abs() < 1e-15);
            }
        }
    }

    #[test]
    fn what_a_joint_file_gets_wrong_is_one_line() {
        for (name, values, message) in [
            ("cogging", vec![1.0], "effect \"cogging\": expected 3 values, got 1"),
            ("friction", vec![1.0], "effect \"friction\": no such effect"),
            (
                "coulomb_friction",
                vec![1.0, 0.0],
                "effect \"coulomb_friction\": smoothing_rad_s: expected a number above 0, got 0",
            ),
            (
                "torque_offset",
                vec![f64::NAN],
                "effect \"torque_offset\": torque_nm: expected a finite number, got NaN",
            ),
        ] {
            assert_eq!(Element::new(name, &values).unwrap_err().to_string(), message);
        }
    }
}
