//! See the module.

use super::*;
use crate::model::{Arrangement, Motor, Transmission};
use crate::sample::{MOTORS, Sample};

const T: f64 = 1e-3;

fn joint(link: Link) -> Model {
    let motor = Motor::bare(0.1, 0.2, Transmission::Unknown);
    Model {
        arrangement: Arrangement::Single,
        motors: vec![motor],
        link: Some(link),
        link_effects: Vec::new(),
    }
}

const FREE: Link = Link {
    inertia: 0.4,
    damping: 0.0,
    gravity: 0.0,
    gravity_phase: 0.0,
    inertia_std: 0.0,
    damping_std: 0.0,
    gravity_std: 0.0,
};

#[test]
fn a_load_on_a_link_that_turns_one_way_is_not_taken_for_its_friction() {
    let mut momentum = LinkMomentum::new(&joint(FREE), &Settings::default(), &Priors::USUAL, T).unwrap();
    momentum.reset();
    let (load, speed) = (-1.9, 40.0);
    momentum.restart(0.0, load);
    let stiffness: f64 = 35.0;
    let carried = Carried { torque: load, stiffness, skew_std: stiffness * T, ..Carried::default() };
    let mut external = External::nothing(0);
    for k in 1..20_000_u64 {
        momentum.feed(speed * k as f64 * T, Some(load), f64::NAN, 0.0);
        external = momentum.conclude(k, &carried, 1e-10, k > 200); // after the jump to this speed
    }
    assert!(external.status & status::VALID != 0);
    assert!((external.torque - load).abs() < 0.01 * load.abs(), "{}", external.torque);
    // A skew of one period between the encoders would make as much: that is said.
    assert!(external.torque_std > 0.5 * carried.stiffness * T * speed, "{}", external.torque_std);
}

#[test]
fn a_load_that_stays_is_not_taken_off_and_hides_no_error_of_the_link() {
    // Inertia 5 % more than declared; the load is there from the start, or comes after 20 s.
    let link = Link { inertia_std: 0.04, ..FREE };
    let load = 4.0;
    for begin in [0.0, 20.0] {
        let mut momentum = LinkMomentum::new(&joint(link), &Settings::default(), &Priors::USUAL, T).unwrap();
        momentum.reset();
        momentum.restart(0.0, 0.0);
        let carried = Carried { variance: 1e-4, ..Carried::default() };
        let (mut worst, mut widest) = (0.0_f64, 0.0_f64);
        for k in 1..60_000_u64 {
            let t = k as f64 * T;
            let (a, b) = ((2.1 * t).sin(), (5.3 * t).sin());
            let acceleration = -0.8 * 2.1 * 2.1 * a - 0.3 * 5.3 * 5.3 * b;
            let push = if t < begin { 0.0 } else { load };
            momentum.feed(0.8 * a + 0.3 * b, Some(push - 1.05 * link.inertia * acceleration), f64::NAN, 0.0);
            let external = momentum.conclude(k, &carried, 1e-14, k > 200);
            if t > 40.0 {
                worst = worst.max((external.torque - push).abs());
                widest = widest.max(external.torque_std);
            }
        }
        assert!(worst < 0.01, "{worst}"); // what is known of the curve
        assert!(widest < 0.1 * link.inertia_std * 12.0, "{widest}"); // rad/s²: a tenth of what is declared
    }
}

#[test]
fn a_skew_that_the_motors_balance_has_found_is_neither_external_nor_a_difference() {
    // A free link at 3 rad/s, read a period late: its spring seems to carry −σ T q′.
    let mut momentum = LinkMomentum::new(&joint(FREE), &Settings::default(), &Priors::USUAL, T).unwrap();
    momentum.reset();
    let (speed, stiffness) = (3.0, 500.0);
    let skew = stiffness * T;
    let carried = Carried { stiffness, skew, skew_std: 0.1 * skew, ..Carried::default() };
    let mut external = External::nothing(0);
    for k in 0..400_u64 {
        momentum.feed(speed * k as f64 * T, Some(-skew * speed), f64::NAN, 0.0);
        external = momentum.conclude(k, &carried, 1e-14, k > 200);
    }
    assert!(external.status & status::VALID != 0);
    let torques = [external.torque, external.difference];
    assert!(torques.iter().all(|torque| torque.abs() < 1e-3 * skew * speed), "{torques:?}");
}

#[test]
fn a_push_on_a_free_link_rises_as_its_filter_does() {
    // q = ½ (τ/M) t² with τ_e = 0: the residual is w³/(s + w)³ of the push.
    let settings = Settings { contact_torque: Some(0.1), ..Settings::default() };
    let mut momentum = LinkMomentum::new(&joint(FREE), &settings, &Priors::USUAL, T).unwrap();
    momentum.reset();
    momentum.restart(0.0, 0.0);
    for _ in 0..200 {
        momentum.feed(0.0, Some(0.0), f64::NAN, 0.0);
    }
    let (push, w) = (2.0, settings.external_bandwidth);
    let mut found = None;
    for k in 1..60 {
        let t = f64::from(k) * T;
        momentum.feed(0.5 * push / FREE.inertia * t * t, Some(0.0), f64::NAN, 0.0);
        let external = momentum.conclude(k as u64, &Carried::default(), 1e-14, true);
        let x = w * t;
        let expected = push * (1.0 - (-x).exp() * (1.0 + x + 0.5 * x * x));
        assert!((external.torque - expected).abs() < 0.01 * push, "{k}: {} {expected}", external.torque);
        assert!(external.difference == external.torque && external.link_torque == -external.torque);
        if found.is_none() && external.status & status::CONTACT != 0 {
            found = Some(k);
        }
    }
    assert!(found.is_some_and(|k| k <= 12), "{found:?}");
}

#[test]
fn an_external_torque_that_is_measured_leaves_no_difference() {
    let settings = Settings::default();
    let mut momentum = LinkMomentum::new(&joint(FREE), &settings, &Priors::USUAL, T).unwrap();
    momentum.reset();
    momentum.restart(0.0, 0.0);
    for k in 1..400 {
        let t = f64::from(k) * T;
        let push = 3.0 * (20.0 * t).sin();
        let q = 3.0 / FREE.inertia * (t / 20.0 - (20.0 * t).sin() / 400.0);
        momentum.feed(q, Some(0.0), push, 0.0);
        let external = momentum.conclude(k as u64, &Carried::default(), 1e-14, true);
        assert!(external.difference.abs() < 2e-3, "{k}: {}", external.difference);
    }
}

#[test]
fn the_papers_external_residual_obeys_equation_13() {
    // A link held at rest by its transmission against gravity: −r is g through K/(s + K).
    let link = Link { gravity: 6.0, ..FREE };
    let settings = Settings::default();
    let mut momentum = PaperMomentum::new(&joint(link), &settings, &Priors::USUAL, T).unwrap();
    let q: f64 = 0.7;
    let nothing = f64::NAN;
    for k in 0..60u64 {
        let sample = Sample {
            sequence: k,
            motor_position: [q; MOTORS],
            motor_velocity: [0.0; MOTORS],
            motor_torque: [0.0; MOTORS],
            link_position: q,
            link_velocity: 0.0,
            external_torque: nothing,
        };
        let external = momentum.update(&sample, 1, 0.0, 0.0, true);
        if k > 0 {
            let expected = -6.0 * q.sin() * (1.0 - (-settings.k_tau * T * k as f64).exp());
            assert!((external.link_torque - expected).abs() < 1e-9, "{k}");
        }
    }
}

#[test]
fn a_late_sample_is_no_push_and_a_push_beside_it_is_found() {
    // A link that swings freely at 6 rad/s; every 50th sample is 0.3 periods late.
    let contacts = |told: bool, push: f64| {
        let settings = Settings { contact_torque: Some(0.5), ..Settings::default() };
        let mut momentum = LinkMomentum::new(&joint(FREE), &settings, &Priors::USUAL, T).unwrap();
        momentum.reset();
        momentum.restart(0.0, 0.0);
        let (speed, begin) = (6.0, 1.0);
        (1..1500_u64).any(|k| {
            let late = if k % 50 == 0 { 0.3 * T } else { 0.0 };
            let t = k as f64 * T + late;
            let pushed = 0.5 * push / FREE.inertia * (t - begin).max(0.0).powi(2);
            momentum.feed(speed * t + pushed, Some(0.0), f64::NAN, if told { late } else { 0.0 });
            let external = momentum.conclude(k, &Carried::default(), 1e-14, k > 200);
            external.status & status::CONTACT != 0
        })
    };
    assert!(contacts(false, 0.0));
    assert!(!contacts(true, 0.0));
    assert!(contacts(true, 3.0));
}
