//! See the module.

use super::*;

fn near(a: f64, b: f64, tolerance: f64) {
    assert!((a - b).abs() <= tolerance * b.abs().max(1.0), "{a} is not {b}");
}

fn all() -> Vec<(Law, Vec<f64>)> {
    let table = Table::new(&[0.1, 0.2, 0.4], &[10.0, 24.0, 60.0]).unwrap();
    vec![
        (Law::Linear, vec![150.0]),
        (Law::Polynomial, vec![150.0, 1500.0, -300.0]),
        (Law::VsaII, vec![0.5, 1.75]),
        (Law::Exponential, vec![80.0, 6.0]),
        (Law::Tabulated(Arc::new(table)), vec![1.5]),
    ]
}

#[test]
fn stiffness_is_the_torques_slope_and_every_law_is_odd() {
    for (law, alpha) in all() {
        for phi in [-0.3, -0.05, 0.02, 0.15, 0.33] {
            let h = 1e-6;
            let slope = (law.at(phi + h, &alpha).0 - law.at(phi - h, &alpha).0) / (2.0 * h);
            near(law.at(phi, &alpha).1, slope, 1e-6);
            near(law.at(-phi, &alpha).0, -law.at(phi, &alpha).0, 1e-12);
        }
    }
}

#[test]
fn jacobians_are_slopes_by_the_parameters() {
    for (law, alpha) in all() {
        let n = alpha.len();
        let (mut by_torque, mut by_stiffness) = (vec![0.0; n], vec![0.0; n]);
        let phi = 0.17;
        law.jacobian(phi, &alpha, &mut by_torque);
        law.stiffness_slopes(phi, &alpha, &mut by_stiffness);
        for i in 0..n {
            let h = 1e-6 * alpha[i].abs();
            let (mut more, mut less) = (alpha.clone(), alpha.clone());
            more[i] += h;
            less[i] -= h;
            let (a, b) = (law.at(phi, &more), law.at(phi, &less));
            near(by_torque[i], (a.0 - b.0) / (2.0 * h), 1e-5);
            near(by_stiffness[i], (a.1 - b.1) / (2.0 * h), 1e-5);
        }
    }
}

#[test]
fn vsa_ii_is_the_slope_of_its_potential() {
    // U = k β², so f = ∂U/∂φ.
    let (k, c) = (0.5, 1.75);
    let potential = |phi: f64| {
        let beta = (c * (phi / 2.0).sin()).asin() - phi / 2.0;
        k * beta * beta
    };
    let h = 1e-6;
    near(Law::VsaII.at(0.4, &[k, c]).0, (potential(0.4 + h) - potential(0.4 - h)) / (2.0 * h), 1e-8);
}

#[test]
fn a_table_of_a_line_is_that_line_and_goes_through_its_points() {
    let line = Table::new(&[0.1, 0.2, 0.5], &[3.0, 6.0, 15.0]).unwrap();
    for phi in [-0.7, -0.2, 0.0, 0.15, 0.5] {
        near(line.at(phi).0, 30.0 * phi, 1e-12);
        near(line.at(phi).1, 30.0, 1e-12);
    }
    assert!(Table::new(&[0.2, 0.1], &[1.0, 2.0]).is_none());
}
