//! A tick allocates nothing and never panics, whatever a sample holds and whatever the model has been given.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use estimator_core::effects::Element;
use estimator_core::estimator::Estimator;
use estimator_core::laws::Law;
use estimator_core::library::{Kind, LIBRARY, Role};
use estimator_core::model::{Arrangement, Link, Model, Motor, Transmission};
use estimator_core::model_monitor::{BALANCES, Baseline, ModelMonitor};
use estimator_core::sample::{MOTORS, Sample};
use estimator_core::settings::{Mode, Priors, Settings};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<usize> = const { Cell::new(0) };
}

// SAFETY: the system's allocator does the work.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

const T: f64 = 1e-3;

fn elements(on_link: bool) -> Vec<Element> {
    let value = |kind: &Kind, name: &str| match name {
        "exponent" => 2.0,
        "power" => 5.0,
        "side" => 1.0,
        "shape" => 0.5,
        _ if kind.place.names().0 == "measurement" || name == "delay_s" => 2e-3,
        _ => 0.05,
    };
    (LIBRARY.iter().filter(|kind| kind.place.on_link() == on_link))
        .map(|kind| {
            let values: Vec<f64> = kind.parameters.iter().map(|p| value(kind, p.name)).collect();
            assert!(kind.parameters.iter().zip(&values).all(|(p, v)| p.role != Role::Scale || *v > 0.0));
            Element::new(kind.name, &values).unwrap()
        })
        .collect()
}

fn model(law: Law, parameters: Vec<f64>, effects: bool) -> Model {
    let motor = Motor {
        inertia: 0.02,
        inertia_std: None,
        damping: 0.02,
        damping_std: None,
        zero_std: 0.0,
        fit_rms: None,
        transmission: Transmission::Elastic { law, order: None, parameters, covariance: None },
        effects: if effects { elements(false) } else { Vec::new() },
    };
    Model {
        arrangement: Arrangement::Antagonistic,
        motors: vec![motor; MOTORS],
        link: Some(Link {
            inertia: 0.1,
            damping: 0.05,
            gravity: 1.0,
            gravity_phase: 0.0,
            inertia_std: 0.0,
            damping_std: 0.0,
            gravity_std: 0.0,
        }),
        link_effects: if effects { elements(true) } else { Vec::new() },
    }
}

fn sample(k: u64) -> Sample {
    let t = k as f64 * T;
    let mut sample = Sample {
        sequence: k,
        motor_position: [0.3 * (4.0 * t).sin(), 0.3 * (9.0 * t).sin()],
        motor_velocity: [f64::NAN; MOTORS],
        motor_torque: [2.0 * (4.0 * t).cos(), (9.0 * t).cos()],
        link_position: 0.2 * (1.1 * t).sin(),
        link_velocity: f64::NAN,
        external_torque: f64::NAN,
    };
    match k % 997 {
        500 => sample.motor_position[0] = f64::NAN,
        600 => sample.link_position = 1e300,
        700 => sample.motor_torque[1] = f64::NEG_INFINITY,
        800 => sample.sequence = k - 5,
        900..950 => sample.sequence = k + 40,
        _ => {}
    }
    sample
}

fn priors() -> Priors {
    Priors {
        motor_inertia: 0.1,
        viscous_damping: 0.3,
        viscous_damping_floor: 0.01,
        coulomb_friction: 0.1,
        torque_offset: 0.02,
        deflection_offset: 0.05,
        encoder_delay: 1.0,
        late: 0.005,
        load_dependent_friction: 0.25,
        encoder_eccentricity: 0.01,
        undeclared: 0.05,
        law: 0.3,
        spring: 10.0,
    }
}

fn allocations(mut tick: impl FnMut(&Sample)) -> usize {
    let before = ALLOCATIONS.get();
    (0..6000).for_each(|k| tick(&sample(k)));
    ALLOCATIONS.get() - before
}

#[test]
fn estimators_allocate_nothing() {
    for (law, parameters) in
        [(Law::Polynomial, vec![60.0, 300.0]), (Law::VsaII, vec![]), (Law::Linear, vec![])]
    {
        for mode in [Mode::Robust, Mode::Paper] {
            let settings = Settings { mode, ..Settings::default() };
            let model = model(law.clone(), parameters.clone(), true);
            let mut estimator = Estimator::new(&model, &settings, &priors(), T).unwrap();
            let count = allocations(|sample| {
                estimator.step(sample);
            });
            assert_eq!(count, 0, "{law:?} {mode:?}");
        }
    }
}

#[test]
fn the_monitor_allocates_nothing() {
    let baseline = Baseline {
        residual: [0.1; BALANCES],
        torque: [1.0; BALANCES],
        log_std: [0.3; BALANCES],
        seconds: 30,
    };
    for effects in [false, true] {
        let model = model(Law::VsaII, vec![0.5, 1.75], effects);
        let mut monitor = ModelMonitor::new(&model, Some(baseline), 1.0, T).unwrap();
        let count = allocations(|sample| {
            monitor.step(sample);
        });
        assert_eq!(count, 0);
    }
}
