//! The library of physical effects.
//!
//! An entry of [`LIBRARY`] is the only definition of an effect, for the tick, `fit`, `diagnose` and the
//! documentation.
//!
//! Signs: with x in N·m, B θ″ + D θ′ + x_motor − τ_e(φ) − x_transmission = τ and
//! M q″ + D_q q′ + g(q) + τ_e + x_transmission + x_link = τ_k. x is the sum over an effect's terms, each
//! times its linear parameter. A measured torque is the acting torque plus x; a reading is the true position
//! plus its error.

mod table;

use serde::{Deserialize, Serialize};

use crate::error::Error;

use table::one;
pub use table::{LIBRARY, REACTION};

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

    /// Dry friction of a motor, N·m, that may hold it at rest under this load by anything up to this, and how much of that
    /// is open as its sign changes at this velocity; 0 of what has none.
    #[must_use]
    pub fn at_rest(&self, c: &Coordinates) -> [f64; 2] {
        let Some(place) = table::smoothing(self.kind) else { return [0.0; 2] };
        let sliding = 3.0 * self.values[place]; // tanh 3 is 0.995: its sign has changed
        let at = |velocity| self.torque(&Coordinates { velocity, ..*c }).abs();
        let (full, along) = (at(sliding).max(at(-sliding)), at(sliding.copysign(c.velocity)));
        let slid = if along > 0.0 { (at(c.velocity) / along).min(1.0) } else { 1.0 };
        [full, full * (1.0 - slid * slid)]
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
mod tests;
