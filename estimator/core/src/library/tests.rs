//! See the module.

use super::table::MEMORY;
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
fn only_dry_friction_holds_a_motor_at_rest() {
    let loaded = Coordinates { velocity: 0.3, flexibility_torque: -5.0, ..Coordinates::default() };
    for (name, values, most) in [
        ("coulomb_friction", vec![0.5, 0.01], 0.5),
        ("stribeck_friction", vec![0.4, 0.3, 10.0, 0.01], 0.7),
        ("asymmetric_friction", vec![0.3, 0.6, 0.01], 0.6),
        ("viscous_damping", vec![0.5], 0.0),
        ("load_dependent_friction", vec![0.2, 0.01], 1.0),
    ] {
        let element = Element::new(name, &values).unwrap();
        let [found, changing] = element.at_rest(&loaded);
        assert!((found - most).abs() <= 0.01 * most, "{name}: {found}"); // tanh 3 is 0.995
        assert!(changing < 0.02 * most + f64::MIN_POSITIVE, "{name}: {changing}"); // it slides
        let [_, changing] = element.at_rest(&Coordinates { velocity: 0.0, ..loaded });
        assert_eq!(changing, found, "{name}");
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
