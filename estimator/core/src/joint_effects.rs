//! All declared effects of a joint, tick by tick.

use serde::{Deserialize, Serialize};

use crate::corrections::Corrections;
use crate::effects::{MotorEffects, Sum, link_sum};
use crate::error::Error;
use crate::library::Coordinates;
use crate::model::Model;
use crate::sample::MOTORS;

/// All effects of a joint: readings corrected first, then torques from values filtered alike.
#[derive(Clone, Debug, Serialize, Deserialize)]
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::Element;
    use crate::laws::Law as Spring;
    use crate::library::{LIBRARY, Law, Place, Role};
    use crate::model::{Arrangement, Motor, Transmission};

    /// One element of every kind, its parameters all small and possible.
    fn every(on_link: bool) -> Vec<Element> {
        let kinds = LIBRARY.iter().filter(|kind| kind.place.on_link() == on_link);
        let value = |role: Role| if role == Role::Scale { 2.0 } else { 0.1 };
        kinds
            .map(|kind| {
                let values: Vec<f64> = kind.parameters.iter().map(|p| value(p.role)).collect();
                Element::new(kind.name, &values).unwrap()
            })
            .collect()
    }

    fn joint(effects: Vec<Element>, link_effects: Vec<Element>) -> Model {
        let transmission = Transmission::Elastic {
            law: Spring::Linear,
            order: None,
            parameters: vec![100.0],
            covariance: None,
        };
        let (inertia_std, damping_std, fit_rms) = (None, None, None);
        let motor = Motor {
            inertia: 0.1,
            inertia_std,
            damping: 0.0,
            damping_std,
            zero_std: 0.0,
            fit_rms,
            transmission,
            effects,
        };
        Model { arrangement: Arrangement::Single, motors: vec![motor], link: None, link_effects }
    }

    #[test]
    fn torques_have_the_signs_of_the_balances() {
        let element = |name: &str, values: &[f64]| Element::new(name, values).unwrap();
        let motor = vec![element("coulomb_friction", &[0.5, 0.01]), element("asymmetric_stiffness", &[10.0])];
        let model = joint(motor, vec![element("link_viscous_damping", &[2.0])]);
        let mut effects = JointEffects::new(&model, 1e-3).unwrap();
        let c = Coordinates { velocity: 1.0, deflection: 0.1, link_velocity: 1.2, ..Coordinates::default() };
        let x = effects.torques(&[c], &c);
        assert!((x.motor[0] - 0.5).abs() < 1e-12 && (x.transmission[0] - 0.1).abs() < 1e-12);
        assert!((x.link - 2.4).abs() < 1e-12);
        let (torque, slope) = effects.motors[0].spring(0.1);
        assert!((torque - 0.1).abs() < 1e-12 && (slope - 2.0).abs() < 1e-12);
    }

    #[test]
    fn x_is_the_weighted_sum_of_the_terms_and_absurd_values_add_none() {
        let mut effects = JointEffects::new(&joint(every(false), every(true)), 1e-3).unwrap();
        for absurd in [f64::NAN, f64::INFINITY, -1e300, 1e12] {
            let c = Coordinates::from_fn(|_| absurd);
            assert_eq!(effects.torques(&[c], &c), Torques::default());
        }
        let c = Coordinates::from_fn(|k| 0.1 + 0.01 * k as f64);
        // The motor's position as it was read, without the declared offset of 0.1 rad.
        let read = Coordinates { position: c.position - 0.1, ..c };
        let weighted = |place: Place, elements: &[Element]| -> f64 {
            let of_place = elements.iter().filter(|e| e.kind.place == place);
            let sum =
                |e: &Element| e.values.iter().zip(e.terms(&read)).map(|(v, term)| v * term).sum::<f64>();
            of_place.map(sum).sum()
        };
        let memories = |place: &Place| {
            let mut each = every(false);
            each.retain(|e| matches!(e.kind.law, Law::Memory { .. }) && e.kind.place == *place);
            let mut sum = Sum::default();
            each.iter().for_each(|e| sum.add(e));
            sum.torque(&c, 1e-3)
        };
        let react = |e: &Element| Some(Element { kind: e.kind.reaction()?, values: e.values });
        let reactions: Vec<Element> = every(false).iter().filter_map(react).collect();
        let expected = (
            weighted(Place::Motor, &every(false))
                + weighted(Place::Motor, &reactions)
                + memories(&Place::Motor),
            weighted(Place::Transmission, &every(false)) + memories(&Place::Transmission),
        );
        let x = effects.torques(&[c], &c);
        assert!((x.motor[0] - expected.0).abs() < 1e-12, "{x:?} is not {expected:?}");
        assert!((x.transmission[0] - expected.1).abs() < 1e-12, "{x:?} is not {expected:?}");
        assert!((x.link - weighted(Place::Link, &every(true))).abs() < 1e-12);
        effects.reset();
        assert_eq!(effects.torques(&[c], &c), x);
    }

    #[test]
    fn an_effect_where_it_does_not_belong_is_one_line() {
        let message = |model: &Model| JointEffects::new(model, 1e-3).unwrap_err().to_string();
        let contact = Element::new("contact", &[1.0, 0.0, 1.0]).unwrap();
        let offset = Element::new("torque_offset", &[1.0]).unwrap();
        assert_eq!(
            message(&joint(vec![contact], vec![])),
            "effect \"contact\": expected it under [[link.effect]]"
        );
        assert_eq!(
            message(&joint(vec![], vec![offset])),
            "effect \"torque_offset\": expected it under [[motor.effect]]"
        );
    }
}
