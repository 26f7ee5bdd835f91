use super::*;

/// Uniform in [-1, 1] from a small congruential generator.
fn random(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn run(check: &mut CrossCheck, from: i64, to: i64, reading: impl Fn(f64, f64) -> (f64, f64)) {
    let mut seed = from as u64 + 1;
    for k in from..to {
        let (x, y) = reading(k as f64 * 1e-3, random(&mut seed));
        check.add(k, x, y);
    }
}

fn position(t: f64) -> f64 {
    (5.0 * t).sin() + 0.3 * (17.0 * t).sin()
}

fn velocity(t: f64) -> f64 {
    5.0 * (5.0 * t).cos() + 5.1 * (17.0 * t).cos()
}

fn counts(value: f64, step: f64) -> f64 {
    (value / step).round() * step
}

const STEPS: (f64, f64) = (1e-4, 1e-2);

fn healthy(t: f64, _noise: f64) -> (f64, f64) {
    (counts(position(t), STEPS.0), counts(velocity(t - 0.004), STEPS.1))
}

#[test]
fn a_velocity_that_lags_agrees_and_one_of_another_scale_does_not() {
    let mut check = CrossCheck::new(Kind::Velocity, 0, STEPS, 1e-3);
    run(&mut check, 0, 60_000, healthy);
    assert_eq!(check.verdict(), Verdict::Agrees, "{}", check.statistic);
    run(&mut check, 60_000, 60_200, |t, n| (healthy(t, n).0, 0.9 * healthy(t, n).1));
    assert_eq!(check.verdict(), Verdict::Contradicts);
    assert!((check.scale().0 - 1.0).abs() > 0.01);
    run(&mut check, 60_200, 62_000, |t, n| (healthy(t, n).0, 0.9 * healthy(t, n).1));
    assert!((check.scale().0 - 0.9).abs() < 0.01, "{:?}", check.scale());
    run(&mut check, 62_000, 64_000, healthy);
    assert_eq!(check.verdict(), Verdict::Agrees);
}

#[test]
fn a_declared_scale_that_is_wrong_from_the_start_is_found() {
    let mut check = CrossCheck::new(Kind::Velocity, 0, STEPS, 1e-3);
    run(&mut check, 0, 10_000, |t, n| (healthy(t, n).0, 4.0 * healthy(t, n).1));
    assert_eq!(check.verdict(), Verdict::Contradicts);
    assert!((check.scale().0 - 4.0).abs() < 0.1, "{:?}", check.scale());
}

#[test]
fn the_scale_of_a_current_is_learned_and_a_change_of_it_found_through_noise() {
    let mut check = CrossCheck::new(Kind::Current, 0, (0.01, 0.01), 1e-3);
    let ratio = 1.7;
    let torque =
        |t: f64, n: f64| (counts(velocity(t), 0.01), counts(ratio * velocity(t) + 0.2 + 0.2 * n, 0.01));
    run(&mut check, 0, 60_000, torque);
    assert_eq!(check.verdict(), Verdict::Agrees, "{}", check.statistic);
    assert!((check.scale().0 - ratio).abs() < 0.02, "{:?}", check.scale());
    run(&mut check, 60_000, 60_300, |t, n| (1.1 * torque(t, n).0, torque(t, n).1));
    assert_eq!(check.verdict(), Verdict::Contradicts);
}

#[test]
fn a_second_encoder_that_slips_once_stays_wrong() {
    let mut check = CrossCheck::new(Kind::SecondEncoder, 0, (1e-4, 1e-4), 1e-3);
    let both = |t: f64, slip: f64| (counts(position(t), 1e-4), counts(3.0 - position(t) + slip, 1e-4));
    run(&mut check, 0, 10_000, |t, _| both(t, 0.0));
    assert_eq!(check.verdict(), Verdict::Agrees);
    run(&mut check, 10_000, 20_000, |t, _| both(t, 0.1));
    assert_eq!(check.verdict(), Verdict::Contradicts);
}

#[test]
fn cycles_that_are_lost_cost_nothing_and_nothing_is_tested_at_rest() {
    let mut check = CrossCheck::new(Kind::Velocity, 0, STEPS, 1e-3);
    let mut seed = 7;
    for k in 0..60_000 {
        if random(&mut seed) > -0.8 {
            let (x, y) = healthy(k as f64 * 1e-3, 0.0);
            check.add(k, x, y);
        }
    }
    assert_eq!(check.verdict(), Verdict::Agrees, "{}", check.statistic);
    let mut check = CrossCheck::new(Kind::Velocity, 0, STEPS, 1e-3);
    run(&mut check, 0, 10_000, |_, _| (0.5, 0.0));
    assert_eq!(check.verdict(), Verdict::Untested);
}

#[test]
fn the_statistic_errs_no_more_often_than_declared() {
    // Mean 20 of a chi squared of 20 degrees of freedom, at most: what a block is allowed is not all used.
    let mut check = CrossCheck::new(Kind::Current, 0, (0.01, 0.01), 1e-3);
    let (mut sum, mut number, mut worst, mut seed) = (0.0, 0.0, 0.0f64, 3);
    for k in 0..600_000 {
        let t = k as f64 * 1e-3;
        let y = counts(velocity(t) + 0.5 * random(&mut seed), 0.01);
        if check.add(k, counts(velocity(t) + 0.5 * random(&mut seed), 0.01), y) && k > 10_000 {
            (sum, number, worst) = (sum + check.statistic, number + 1.0, worst.max(check.statistic));
        }
    }
    assert!(sum / number < 1.2 * WINDOW as f64, "{}", sum / number);
    assert!(worst < LIMIT, "{worst}");
}
