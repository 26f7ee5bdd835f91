//! What is said of samples.

use super::Robust;
use crate::laws::Law;
use crate::model::{Arrangement, Model, Motor, Transmission};
use crate::sample::{MOTORS, Sample};
use crate::settings::{Priors, Settings};
use crate::suspicion::Reason;

const T: f64 = 1e-3;

fn sample(sequence: u64, moment: u64) -> Sample {
    let t = moment as f64 * T;
    Sample {
        sequence,
        motor_position: [0.6 * (4.0 * t).sin(); MOTORS],
        motor_velocity: [f64::NAN; MOTORS],
        motor_torque: [0.1 * (4.0 * t).cos(); MOTORS],
        link_position: 0.5 * (4.0 * t).sin(),
        link_velocity: f64::NAN,
        external_torque: f64::NAN,
    }
}

fn accused(late_s: f64) -> Option<Reason> {
    let transmission =
        Transmission::Elastic { law: Law::Linear, order: None, parameters: vec![1.0], covariance: None };
    let model = Model {
        arrangement: Arrangement::Single,
        motors: vec![Motor::bare(0.02, 0.02, transmission)],
        link: None,
        link_effects: Vec::new(),
    };
    let mut estimator = Robust::new(&model, &Settings::default(), &Priors::USUAL, T).unwrap();
    (0..3141).for_each(|k| {
        estimator.step(&sample(k, k));
    });
    estimator.delay_next(late_s);
    estimator.step(&sample(3141, 3142)); // 2.4 rad/s
    estimator.suspicion().map(|one| one.reason)
}

#[test]
fn a_sample_that_was_taken_late_accuses_no_position() {
    assert_eq!(accused(0.0), Some(Reason::Jumped));
    assert_eq!(accused(0.65 * T), None);
}
