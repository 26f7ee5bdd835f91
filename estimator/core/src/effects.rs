//! The declared effects, evaluated per tick: sorted by location, with their memories. [`crate::library`]
//! defines them.

pub use crate::corrections::Corrections;
use crate::error::Error;
pub use crate::library::{Coordinates, Element};
use crate::library::{Law, Place};
use crate::memory::Memory;
use crate::model::Model;
use crate::sample::MOTORS;

/// The elements at one place, with their memories.
#[derive(Clone, Debug, Default)]
pub struct Sum {
    elements: Vec<(Element, Memory)>,
}

impl Sum {
    fn add(&mut self, element: &Element) {
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

/// The effects of one motor and its transmission.
#[derive(Clone, Debug, Default)]
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
                Place::Link | Place::LinkReading | Place::LinkDelay => {
                    let name = element.kind.name;
                    return Err(Error(format!("effect \"{name}\": expected it under [[link.effect]]")));
                }
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

    /// x_motor and x_transmission of eq 5.
    pub fn balance(&mut self, c: &Coordinates, period_s: f64) -> (f64, f64) {
        (self.motor.torque(c, period_s), self.transmission.torque(c, period_s))
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

/// All effects of a joint: readings corrected first, then torques from values filtered alike.
#[derive(Clone, Debug)]
pub struct JointEffects {
    /// See [`Corrections`].
    pub corrections: Corrections,
    /// Of each motor.
    pub motors: Vec<MotorEffects>,
    /// x_link.
    pub link: Sum,
    period: f64,
}

/// What effects add to eqs 5 and 4.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Torques {
    /// x_motor of each motor, N·m.
    pub motor: [f64; MOTORS],
    /// x_transmission of each motor, N·m.
    pub transmission: [f64; MOTORS],
    /// x_link, N·m.
    pub link: f64,
}

impl JointEffects {
    /// Those of a model, for samples every `period_s` seconds.
    ///
    /// # Errors
    /// An effect is where it does not belong.
    pub fn new(model: &Model, period_s: f64) -> Result<JointEffects, Error> {
        let motors: Vec<MotorEffects> =
            model.motors.iter().map(|motor| MotorEffects::new(&motor.effects)).collect::<Result<_, _>>()?;
        let corrections = Corrections::new(&motors, &model.link_effects, period_s)?;
        Ok(JointEffects { corrections, motors, link: link_sum(&model.link_effects)?, period: period_s })
    }

    /// Forget memories, delayed samples, the time since the start.
    pub fn reset(&mut self) {
        self.corrections.reset();
        self.link.reset();
        for motor in &mut self.motors {
            motor.motor.reset();
            motor.transmission.reset();
        }
    }

    /// The torques at one period's coordinates, of each motor and of the link; corrected positions are taken
    /// back to what was read.
    pub fn torques(&mut self, motors: &[Coordinates], link: &Coordinates) -> Torques {
        let mut torques = Torques { link: self.link.torque(link, self.period), ..Torques::default() };
        for (i, (effects, c)) in self.motors.iter_mut().zip(motors).enumerate() {
            let c = Coordinates { position: c.position - effects.offset, ..*c };
            torques.motor[i] = effects.motor.torque(&c, self.period);
            torques.transmission[i] = effects.transmission.torque(&c, self.period);
        }
        torques
    }
}
