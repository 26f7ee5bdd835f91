//! See the module.

use super::*;
use crate::effects::Element;
use crate::model::Motor;

const T: f64 = 1e-3;

fn model(effects: Vec<Element>) -> Model {
    Model {
        arrangement: Arrangement::Single,
        motors: vec![Motor {
            inertia: 0.1,
            inertia_std: None,
            damping: 0.5,
            damping_std: None,
            zero_std: 0.0,
            fit_rms: None,
            transmission: Transmission::Elastic {
                law: Law::Linear,
                order: None,
                parameters: vec![100.0],
                covariance: None,
            },
            effects,
        }],
        link: Some(Link {
            inertia: 0.3,
            damping: 0.2,
            gravity: 0.0,
            gravity_phase: 0.0,
            inertia_std: 0.0,
            damping_std: 0.0,
            gravity_std: 0.0,
        }),
        link_effects: Vec::new(),
    }
}

/// θ and q are sines and the torques follow from eqs 5 and 4, with torques that the model lacks.
fn sample(k: u64, lacks: [f64; 3]) -> Sample {
    let (t, w) = (k as f64 * T, 7.0f64);
    let (theta, velocity, acceleration) = ((w * t).sin(), w * (w * t).cos(), -w * w * (w * t).sin());
    let q = 1.2 * theta;
    let wave = (3.0 * w * t).sin(); // what is lacking changes as quickly as this
    let [motor, transmission, link] = lacks.map(|size| size * wave);
    let through = 100.0 * (q - theta) + transmission;
    let torque = 0.1 * acceleration + 0.5 * velocity + motor - through;
    let external = 0.3 * 1.2 * acceleration + 0.2 * 1.2 * velocity + through + link;
    Sample {
        sequence: k,
        motor_position: [theta, f64::NAN],
        motor_velocity: [f64::NAN; MOTORS],
        motor_torque: [torque, f64::NAN],
        link_position: q,
        link_velocity: f64::NAN,
        external_torque: external,
    }
}

fn baseline() -> Baseline {
    Baseline { residual: [0.1; BALANCES], torque: [15.0; BALANCES], log_std: [0.3; BALANCES], seconds: 30 }
}

fn monitor(effects: Vec<Element>) -> ModelMonitor {
    ModelMonitor::new(&model(effects), Some(baseline()), 1.0, T).unwrap()
}

#[test]
fn a_true_model_leaves_little_and_a_missing_torque_is_measured_and_placed() {
    for (lacks, place) in
        [([3.0, 0.0, 0.0], "motor"), ([0.0, 3.0, 0.0], "transmission"), ([0.0, 0.0, 3.0], "link")]
    {
        let mut monitor = monitor(Vec::new());
        for k in 0..4000 {
            assert!(!monitor.step(&sample(k, [0.0; 3])));
        }
        assert!(monitor.found().ratio < 1.0);
        (4000..7000).for_each(|k| {
            monitor.step(&sample(k, lacks));
        });
        assert!(monitor.alarm());
        assert_eq!(monitor.location(), place);
        // A sine of 3 N·m at 21 rad/s behind (180/(s + 180))³ (60/(s + 60))².
        let gain = |w: f64, n: i32| (1.0 + (21.0 / w).powi(2)).powf(-0.5 * f64::from(n));
        let rms = 3.0 / 2f64.sqrt() * gain(180.0, 3) * gain(60.0, 2);
        let b = usize::from(place == "link");
        assert!((monitor.found().residual[b] / rms - 1.0).abs() < 0.05);
    }
}

#[test]
fn a_push_that_nobody_measures_raises_no_alarm() {
    let mut monitor = monitor(Vec::new());
    for k in 0..7000 {
        let lacks = [0.0, 0.0, if k < 4000 { 0.0 } else { 3.0 }];
        let pushed = Sample { external_torque: f64::NAN, ..sample(k, lacks) };
        assert!(!monitor.step(&pushed));
    }
    assert!(monitor.found().residual[1] > 1.0 && monitor.found().ratio < 1.0);
}

#[test]
fn an_effect_that_the_model_has_is_no_residual() {
    let element = Element::new("viscous_damping", &[-0.5]).unwrap();
    let mut with = monitor(vec![element]);
    let mut without = monitor(Vec::new());
    for k in 0..3000 {
        let mut sample = sample(k, [0.0; 3]);
        sample.motor_torque[0] -= 0.5 * 7.0 * (7.0 * k as f64 * T).cos();
        with.step(&sample);
        without.step(&sample);
    }
    assert!(with.found().residual[0] < 0.1 * without.found().residual[0]);
}

#[test]
fn the_rate_of_false_alarms_is_the_declared_one() {
    // ln S of a second is normal about the baseline's as long as MOTION stands for the rest of it: the
    // limit is exceeded as often as t says, which for many seconds is the normal distribution's tail.
    let many = Baseline { log_std: [0.0; BALANCES], seconds: 10_001, ..baseline() };
    let monitor = ModelMonitor::new(&model(Vec::new()), Some(many), 36.0, T).unwrap();
    // 36 an hour and two balances: 0.5 % of the seconds, beyond 2.576 standard deviations.
    assert!((monitor.limit[0] / MOTION - 2.576).abs() < 2e-3);
}

#[test]
fn samples_that_are_lost_leave_hardly_more_than_none() {
    // The torque changes by 0.7 N·m in two periods: held over them, it would leave a hundred times as much.
    let left = |lost: fn(u64) -> bool| {
        let mut monitor = monitor(Vec::new());
        (0..4000).filter(|k| !lost(*k)).for_each(|k| {
            monitor.step(&sample(k, [0.0; 3]));
        });
        monitor.found().residual[0]
    };
    let (none, some) = (left(|_| false), left(|k| k % 5 == 3 || k % 5 == 4));
    assert!(some < none + 0.01, "{some} beside {none}");
}

#[test]
fn gaps_are_bridged_or_begin_anew_and_what_is_no_measurement_is_passed_over() {
    let mut monitor = monitor(Vec::new());
    for k in (0..4000).filter(|k| k % 10 != 3 && k % 10 != 4) {
        monitor.step(&sample(k, [0.0; 3]));
    }
    assert!(monitor.found().ratio < 1.0);
    for value in [f64::NAN, f64::INFINITY, -1e300] {
        let mut bad = sample(4000, [0.0; 3]);
        bad.link_position = value;
        assert!(!monitor.step(&bad));
    }
    assert!(!monitor.found().residual[0].is_nan());
    monitor.step(&sample(9000, [0.0; 3]));
    assert!(monitor.found().residual[0].is_nan());
}
