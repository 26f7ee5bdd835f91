//! See the module.

use super::*;

#[test]
fn the_residual_of_a_constant_torque_rises_as_its_filter_does() {
    // A motor held at rest against a constant torque: τ_e = −τ, through K/(s + K) (eq 15).
    let (k, period, tau) = (300.0, 1e-3, 2.0);
    let balance = Balance { inertia: 0.1, damping: 0.2, period, origin: None, integral: 0.0, torque: 0.0 };
    let mut residual = FirstOrder { balance, k, value: 0.0, last: 0.0 };
    for n in 0..50 {
        let expected = -tau * (1.0 - (-k * period * f64::from(n)).exp());
        assert!((residual.update(0.4, 0.0, tau, 1.0) - expected).abs() < 1e-12);
    }
}

#[test]
fn recursive_least_squares_find_the_coefficients_of_exact_rows() {
    let mut squares = RecursiveLeastSquares::new(2);
    for k in 1..20 {
        let phi = 0.01 * f64::from(k);
        squares.update(&[phi, phi * phi * phi], 150.0 * phi + 1500.0 * phi * phi * phi);
    }
    let alpha = squares.alpha();
    assert!((alpha[0] - 150.0).abs() < 1e-8 && (alpha[1] - 1500.0).abs() < 1e-6);
    assert!(squares.std(&[1.0, 0.0]) < 1e-6);
}

#[test]
fn the_saturated_regressor_stays_stable_where_the_plain_one_would_not() {
    // With K_R φ′² limited to K_max < 2 the error shrinks by 1 − K_max a step.
    let mut stiffness = 0.0;
    for _ in 0..200 {
        stiffness = regressor_step(stiffness, 50.0 * 3.0, 3.0, 1900.0, 1.9);
    }
    assert!((stiffness - 50.0).abs() < 1e-6);
}
