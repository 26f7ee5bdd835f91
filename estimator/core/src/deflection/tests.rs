//! What the filter of the deflection follows and foresees.

use super::*;

#[test]
fn a_deflection_that_bends_steadily_is_followed_without_delay() {
    let mut filter = DeflectionFilter::new(0.1, 0.5, 60.0, 1e-3, 0.03);
    filter.restart(0.0, 0.0);
    for k in 1..3000 {
        let t = f64::from(k) * 1e-3;
        filter.update(0.2 * t, 0.1 * t + 0.3 * t * t, 0.0, 0.0);
    }
    assert!((filter.at(0.0) - (0.1 * 2.999 + 0.3 * 2.999 * 2.999)).abs() < 1e-6);
    assert!((filter.link_rate() - (0.2 + 0.1 + 0.6 * 2.999)).abs() < 1e-4);
}

#[test]
fn a_steep_spring_behind_a_coarse_encoder_is_followed_better_than_it_is_read() {
    let (t, inertia, damping, count) = (1e-3, 0.1, 1.2, 7.7e-4);
    let spring = |phi: f64| {
        let stiffness = 4.5 * (6.6 * phi.abs()).exp();
        ((stiffness - 4.5) / 6.6 * phi.signum(), stiffness)
    };
    let (theta, phi) = (|s: f64| 0.8 * (7.0 * s).sin(), |s: f64| 0.45 * (12.0 * s).sin());
    let mut filter = DeflectionFilter::new(inertia, damping, 60.0, t, 0.03);
    let tuning = Tuning {
        jerk: 0.45 * 12.0_f64.powi(3),
        motor_noise: count * count / 12.0,
        link_noise: 1e-10,
        inertia,
        damping,
        rate_damping: 0.0,
        unmodelled: 0.01,
    };
    filter.restart(0.0, 0.0);
    let mut square = 0.0;
    for k in 1..6000 {
        let (now, before) = (f64::from(k) * t, (f64::from(k) - 0.5) * t);
        let acceleration = -49.0 * theta(before);
        let torque = inertia * acceleration + damping * 5.6 * (7.0 * before).cos() - spring(phi(before)).0;
        let read = (theta(now) / count).round() * count;
        let (acting, stiffness) = spring(filter.at(0.0));
        filter.update(read, theta(now) + phi(now) - read, torque + acting, stiffness);
        if k % 30 == 0 {
            filter.tune(&tuning);
        }
        if k > 3000 {
            square += (filter.at(0.0) - phi(now)).powi(2) / 2999.0;
        }
    }
    assert!(square < tuning.motor_noise / 9.0, "{} of {}", square.sqrt(), tuning.motor_noise.sqrt());
    let foreseen = filter.now(&Present { phi: 0.0, behind_s: 0.0, ahead_s: 0.0 }, 0.0).1;
    assert!((0.5..2.0).contains(&(square / foreseen)), "{square} of {foreseen}");
}

#[test]
fn what_is_foreseen_is_as_uncertain_as_it_is_wrong() {
    let (t, count, ahead_s) = (1e-3, 1e-4, 0.012);
    let phi = |s: f64| 0.05 * (12.0 * s).sin() + 0.01 * (29.0 * s).sin();
    let jerk = |s: f64| -86.4 * (12.0 * s).cos() - 243.9 * (29.0 * s).cos();
    let mut filter = DeflectionFilter::new(0.1, 0.5, 60.0, t, 0.03);
    let (mut square, mut foreseen) = (0.0, 0.0);
    for k in 1..9000 {
        let now = f64::from(k) * t;
        filter.update(0.0, (phi(now) / count).round() * count, 0.0, 0.0);
        let noise = count * count / 12.0;
        if k % 30 == 0 {
            filter.tune(&Tuning {
                jerk: jerk(now) / HIDDEN.sqrt(),
                motor_noise: 0.1 * noise,
                link_noise: noise,
                inertia: 0.1,
                damping: 0.5,
                rate_damping: 0.0,
                unmodelled: 1.0,
            });
        }
        if k > 3000 {
            let (ahead, variance) = filter.now(&Present { phi: 0.0, behind_s: 0.0, ahead_s }, 1.1 * noise);
            square += (ahead - phi(now + ahead_s)).powi(2);
            foreseen += variance;
        }
    }
    assert!((0.3..3.0).contains(&(square / foreseen)), "{square} of {foreseen}");
}

#[test]
fn dampings_that_cancel_each_other_make_no_filter_unstable() {
    let (damping, stiffness) = (28.0, 1000.0);
    let mut filter = DeflectionFilter::new(0.0275, 0.0, 60.0, 2e-3, 0.02);
    let tuning = Tuning {
        jerk: 0.5,
        motor_noise: 1e-10,
        link_noise: 1e-10,
        inertia: 0.0275,
        damping: -damping,
        rate_damping: damping,
        unmodelled: 0.1,
    };
    filter.restart(0.0, 0.0);
    let mut worst: f64 = 0.0;
    for k in 1..5000 {
        let theta = 0.008 * (f64::from(k) * 2e-3).sin() + 1e-5 * (f64::from(k) * 2.3).sin();
        let acting = stiffness * filter.at(0.0) + damping * filter.rate();
        filter.update(theta, -theta, stiffness * theta + acting, stiffness);
        if k % 10 == 0 {
            filter.tune(&tuning);
        }
        worst = worst.max((filter.at(0.0) + theta).abs());
    }
    assert!(worst < 1e-4, "{worst}");
    assert_eq!(filter.unsettled, 0);
}

#[test]
fn a_deflection_is_as_uncertain_as_its_reading_before_motion_is_known() {
    let mut filter = DeflectionFilter::new(0.1, 0.5, 60.0, 1e-3, 0.03);
    filter.restart(0.0, 0.1);
    let present = |behind_s| Present { phi: 0.2, behind_s, ahead_s: 0.0 };
    assert_eq!(filter.now(&present(0.0), 1e-8), (0.1, 1e-8));
    assert_eq!(filter.now(&present(2e-3), 1e-8), (0.2, 1e-8));
}
