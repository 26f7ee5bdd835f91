//! The declared effects, evaluated per tick: sorted by location, with their memories. [`crate::library`]
//! defines them.

use serde::{Deserialize, Serialize};

use crate::error::Error;
pub use crate::library::{Coordinates, Element};
use crate::library::{Law, Place};
use crate::memory::Memory;

/// The elements at one place, with their memories.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Sum {
    elements: Vec<(Element, Memory)>,
}

impl Sum {
    pub(crate) fn add(&mut self, element: &Element) {
        self.elements.push((*element, Memory::of(element)));
    }

    /// Nothing remembered.
    pub fn reset(&mut self) {
        self.elements.iter_mut().for_each(|(_, memory)| memory.reset());
    }

    /// Whether there is any.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.elements.is_empty()
    }

    /// x at these coordinates, one period after the last ones; 0 where they are absurd or not finite.
    pub fn torque(&mut self, c: &Coordinates, period_s: f64) -> f64 {
        if self.elements.is_empty() || !c.sane() {
            return 0.0;
        }
        let mut total = 0.0;
        for (element, memory) in &mut self.elements {
            total += match element.kind.law {
                Law::Memory { rate, .. } => element.values[0] * memory.advance(rate(c) * period_s),
                _ => element.torque(c),
            };
        }
        total
    }
}

/// What the effects of a motor and its transmission do at a moment, N·m.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Declared {
    /// x_motor − x_transmission of eq 5, without the elastic ones.
    pub formed: f64,
    /// What depends on the deflection alone: part of what the transmission transmits.
    pub elastic: f64,
    /// x_transmission.
    pub transmission: f64,
    /// Dry friction of the motor that is open at rest.
    pub at_rest: f64,
    /// What of it is open while its sign changes.
    pub changing: f64,
}

/// The effects of one motor and its transmission.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct MotorEffects {
    /// x_motor.
    pub motor: Sum,
    /// x_transmission.
    pub transmission: Sum,
    pub(crate) drive: Vec<Element>, // errors of the torque's measurement
    springs: Vec<Element>,
    /// The offset between the encoders, rad.
    pub offset: f64,
    pub(crate) delay: f64,
    pub(crate) lag: f64,
}

impl MotorEffects {
    /// Sorted by where they act.
    ///
    /// # Errors
    /// One belongs to the link.
    pub fn new(elements: &[Element]) -> Result<MotorEffects, Error> {
        let mut sorted = MotorEffects::default();
        for element in elements {
            match element.kind.place {
                Place::Motor => sorted.motor.add(element),
                Place::Transmission => sorted.transmission.add(element),
                Place::Torque => sorted.drive.push(*element),
                Place::TorqueDelay => sorted.delay += element.values[0],
                Place::TorqueLag => sorted.lag += element.values[0],
                Place::Deflection => sorted.offset += element.values[0],
                Place::Link | Place::LinkReading | Place::LinkDelay | Place::DeflectionDelay => {
                    let name = element.kind.name;
                    return Err(Error(format!("effect \"{name}\": expected it under [[link.effect]]")));
                }
            }
            if let Some(kind) = element.kind.reaction() {
                sorted.motor.add(&Element { kind, values: element.values });
            }
            if matches!(element.kind.law, Law::Spring(_)) {
                sorted.springs.push(*element);
            }
        }
        Ok(sorted)
    }

    /// Whether a torque has to be formed at all.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.motor.is_empty() && self.transmission.is_empty()
    }

    /// What they do at a moment, from filtered signals, and the elastic ones at φ as it is read.
    pub fn balance(&mut self, c: &Coordinates, phi: f64, period_s: f64) -> Declared {
        let (motor, transmission) = (self.motor.torque(c, period_s), self.transmission.torque(c, period_s));
        let friction = self.motor.elements.iter().filter(|_| c.sane()).map(|(element, _)| element.at_rest(c));
        let [at_rest, changing] = friction.fold([0.0; 2], |sum, one| [sum[0] + one[0], sum[1] + one[1]]);
        Declared {
            formed: motor - transmission + self.spring(c.deflection).0,
            elastic: self.spring(phi).0,
            transmission,
            at_rest,
            changing,
        }
    }

    /// By how much the spring is deflected beyond φ where the gear turns unevenly, rad.
    #[must_use]
    pub fn kinematic_error(&self, position: f64) -> f64 {
        let uneven =
            self.transmission.elements.iter().filter(|(element, _)| element.kind.reaction().is_some());
        let c = Coordinates { position, stiffness: 1.0, ..Coordinates::default() };
        uneven.map(|(element, _)| element.torque(&c)).sum()
    }

    /// (torque, stiffness) of what depends on the deflection alone: part of what the transmission transmits.
    #[must_use]
    pub fn spring(&self, phi: f64) -> (f64, f64) {
        self.springs
            .iter()
            .filter_map(|element| element.spring(phi))
            .fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }
}

/// x_link of eq 4 from the effects of the link.
///
/// # Errors
/// One belongs to a motor.
pub fn link_sum(effects: &[Element]) -> Result<Sum, Error> {
    let mut sum = Sum::default();
    for element in effects {
        if !element.kind.place.on_link() {
            let name = element.kind.name;
            return Err(Error(format!("effect \"{name}\": expected it under [[motor.effect]]")));
        }
        if element.kind.place == Place::Link {
            sum.add(element);
        }
    }
    Ok(sum)
}

/// Terms of an element, unweighted, over consecutive moments: column k into `out[k]`.
pub fn along(element: &Element, moments: impl Iterator<Item = Coordinates>, out: &mut [&mut [f64]]) {
    let mut memory = Memory::of(element);
    let mut from = None;
    for (k, c) in moments.enumerate() {
        let terms = match element.kind.law {
            Law::Memory { path, .. } => {
                let now = path(&c);
                [memory.advance(now - from.replace(now).unwrap_or(now)), 0.0]
            }
            _ => element.terms(&c),
        };
        for (column, term) in out.iter_mut().zip(terms) {
            column[k] = term;
        }
    }
}
