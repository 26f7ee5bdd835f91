//! See the module.

use super::*;

/// Reproducible numbers, uniform in (−1, 1).
fn noise(seed: &mut u64) -> f64 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*seed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn rows(n: usize, x: [f64; 2], seed: u64, amplitude: f64) -> Vec<Row> {
    let mut seed = seed;
    (0..n)
        .map(|_| {
            let mut row = [0.0; COLUMNS];
            (row[1], row[2], row[3]) = (noise(&mut seed), 1e3 * noise(&mut seed), noise(&mut seed));
            row[0] = x[0] * row[1] + x[1] * row[2] + amplitude * noise(&mut seed);
            row
        })
        .collect()
}

fn sum(rows: &[Row]) -> Gram {
    let mut gram = Gram::default();
    rows.iter().for_each(|row| gram.add_row(row));
    gram
}

/// Unknown j is the coefficient of column j.
fn plain(set: Set) -> Frame {
    let mut frame = Frame { left: [0.0; COLUMNS], directions: [[0.0; COLUMNS]; UNKNOWNS], set };
    frame.left[0] = 1.0;
    (1..UNKNOWNS).for_each(|j| frame.directions[j][j] = 1.0);
    frame
}

fn wide() -> Prior {
    Prior::independent([0.0; UNKNOWNS], &[1e6; UNKNOWNS])
}

#[test]
fn unknowns_are_those_of_dense_least_squares() {
    // Two columns: the normal equations in closed form.
    let rows = rows(400, [2.0, -0.03], 7, 0.1);
    let frame = plain(0b110);
    let found = solve(&frame.reduce(&sum(&rows)), 0b110, &wide(), 1.0 / 300.0).unwrap();
    let along = |a: usize, b: usize| rows.iter().map(|z| z[a] * z[b]).sum::<f64>();
    let determinant = along(1, 1) * along(2, 2) - along(1, 2).powi(2);
    let first = (along(2, 2) * along(1, 0) - along(1, 2) * along(2, 0)) / determinant;
    let second = (along(1, 1) * along(2, 0) - along(1, 2) * along(1, 0)) / determinant;
    assert!((found.x[1] - first).abs() < 1e-8 && (found.x[2] - second).abs() < 1e-11);
    assert!((found.covariance[1][1] * determinant / along(2, 2) * 300.0 - 1.0).abs() < 1e-6);
    let left: f64 = rows.iter().map(|z| (z[0] - first * z[1] - second * z[2]).powi(2)).sum();
    let residual = frame.residual(&found.x, found.set);
    assert!((sum(&rows).quadratic(&residual) / left - 1.0).abs() < 1e-6);
}

#[test]
fn a_direction_is_a_combination_of_columns() {
    // One unknown of the columns 2 c₁ + c₂: the same as one column of those sums.
    let rows = rows(200, [1.0, 0.5], 5, 0.1);
    let mut frame = plain(0b10);
    (frame.directions[1][1], frame.directions[1][2]) = (2.0, 1.0);
    let found = solve(&frame.reduce(&sum(&rows)), 0b10, &wide(), 0.003).unwrap();
    let column = |z: &Row| 2.0 * z[1] + z[2];
    let exact = rows.iter().map(|z| column(z) * z[0]).sum::<f64>()
        / rows.iter().map(|z| column(z).powi(2)).sum::<f64>();
    assert!((found.x[1] / exact - 1.0).abs() < 1e-9);
}

#[test]
fn a_block_that_is_left_out_was_never_there() {
    let rows = rows(300, [1.0, 1.0], 3, 0.5);
    let (mut all, part) = (sum(&rows), sum(&rows[100..]));
    all.add(&part, -1.0);
    let rest = sum(&rows[..100]);
    assert!((0..COLUMNS).all(|i| (all.at(i, 1) - rest.at(i, 1)).abs() < 1e-6));
    assert_eq!(all.rows, 100.0);
}

#[test]
fn scaled_columns_are_those_of_scaled_rows() {
    let mut rows = rows(50, [1.0, 1.0], 9, 0.5);
    let (mut gram, mut factors) = (sum(&rows), [1.0; COLUMNS]);
    (factors[0], factors[2]) = (3.0, 0.1);
    gram.scale(&factors);
    rows.iter_mut().for_each(|z| (z[0], z[2]) = (3.0 * z[0], 0.1 * z[2]));
    assert!((gram.at(2, 0) / sum(&rows).at(2, 0) - 1.0).abs() < 1e-12);
}

#[test]
fn a_prior_is_data_that_came_before() {
    // The posterior of the first half as the prior of the second is the posterior of both.
    let rows = rows(400, [2.0, -0.03], 7, 0.1);
    let frame = plain(0b110);
    let first = solve(&frame.reduce(&sum(&rows[..200])), 0b110, &wide(), 0.003).unwrap();
    let prior = Prior { mean: first.x, precision: inverse(&first.covariance, 0b110) };
    let second = solve(&frame.reduce(&sum(&rows[200..])), 0b110, &prior, 0.003).unwrap();
    let both = solve(&frame.reduce(&sum(&rows)), 0b110, &wide(), 0.003).unwrap();
    assert!((second.x[1] - both.x[1]).abs() < 1e-8);
    assert!((second.covariance[2][1] - both.covariance[2][1]).abs() < 1e-9 * both.covariance[1][1]);
}

#[test]
fn evidence_takes_the_unknown_that_acts_and_leaves_the_one_that_does_not() {
    let prior = Prior::independent([0.0; UNKNOWNS], &[1.0; UNKNOWNS]);
    let reduced = plain(0b1110).reduce(&sum(&rows(400, [2.0, -0.03], 7, 0.1)));
    assert_eq!(choose(&reduced, 0b10, &[0b100, 0b1000], 0, &prior, 1.0 / 300.0), 0b110);
}

#[test]
fn a_column_that_leaves_less_of_the_noise_of_another_one_is_no_evidence() {
    // Column 1 is column 2 read with noise; what is explained follows column 1's truth, whose reading's noise remains.
    let (gain, deviation, mut seed) = (5.0, 0.02, 3);
    let prior = Prior::independent([0.0; UNKNOWNS], &[10.0; UNKNOWNS]);
    let read: Vec<Row> = (0..4000)
        .map(|_| {
            let (truth, error) = (noise(&mut seed), deviation * noise(&mut seed) / 0.5);
            let mut row = [0.0; COLUMNS];
            (row[0], row[1], row[2], row[3]) = (gain * truth, truth + error, truth, 1.0);
            row
        })
        .collect();
    let (gram, frame) = (sum(&read), plain(0b110));
    let left = gram.quadratic(&frame.residual(&[gain; UNKNOWNS], 0b10)) / gram.rows;
    let of_column = left / gain.powi(2); // its variance
    let noisy = frame.reduce_noisy(&gram, &gram.noise(&[(1, 3, 1.0, 0)], &[[of_column]]));
    let odds = |reduced: &Reduced| {
        log_evidence(reduced, 0b110, &prior, left) - log_evidence(reduced, 0b10, &prior, left)
    };
    assert!(odds(&frame.reduce(&gram)) > 100.0);
    assert!(odds(&noisy) < 0.0, "{}", odds(&noisy));
}

#[test]
fn of_two_that_explain_the_same_evidence_takes_the_usual_one() {
    let prior = Prior::independent([0.0; UNKNOWNS], &[1.0; UNKNOWNS]);
    let same: Vec<Row> = (rows(400, [2.0, -0.03], 7, 0.1).into_iter())
        .map(|mut row| {
            row[3] = 1.01 * row[2];
            row
        })
        .collect();
    let reduced = plain(0b1110).reduce(&sum(&same));
    for usual in [0b100, 0b1000] {
        assert_eq!(choose(&reduced, 0b10, &[0b100, 0b1000], usual, &prior, 1.0 / 300.0), 0b10 | usual);
    }
}

#[test]
fn evidence_is_that_of_the_data_in_closed_form() {
    // One unknown, one row: y ~ N(0, noise + z² s²), compared between two priors.
    let mut row = [0.0; COLUMNS];
    (row[0], row[1]) = (1.5, 2.0);
    let log = |s: f64| {
        let prior = Prior::independent([0.0; UNKNOWNS], &[s; UNKNOWNS]);
        log_evidence(&plain(0b10).reduce(&sum(&[row])), 0b10, &prior, 0.25)
    };
    let exact = |s: f64| {
        let v: f64 = 0.25 + 4.0 * s * s;
        -0.5 * (v / 0.25).ln() - 0.5 * 2.25 / v
    };
    assert!((log(0.5) - log(3.0) - exact(0.5) + exact(3.0)).abs() < 1e-9);
}

#[test]
fn clustered_intervals_hold_correlated_errors_and_plain_ones_do_not() {
    // An error that is constant inside blocks of 20 rows beside a regressor that is, too.
    let (mut inside, mut plain_inside, mut seed) = (0, 0, 11);
    let frame = plain(0b10);
    for _ in 0..400 {
        let mut blocks = Vec::new();
        for _ in 0..40 {
            let (z, e) = (noise(&mut seed), noise(&mut seed));
            let mut row = [0.0; COLUMNS];
            (row[0], row[1]) = (3.0 * z + e, z);
            blocks.push(frame.reduce(&sum(&[row; 20])));
        }
        let mut total = frame.reduce(&Gram::default());
        for block in &blocks {
            (0..4).for_each(|k| total[k / 2][k % 2] += block[k / 2][k % 2]);
        }
        let mut found = solve(&total, 0b10, &wide(), 1.0 / 3.0).unwrap();
        let off = (found.x[1] - 3.0).abs();
        plain_inside += i32::from(off < 1.96 * found.covariance[1][1].sqrt());
        let score = |block: &Reduced| {
            let mut score = [0.0; UNKNOWNS];
            score[1] = block[1][0] - found.x[1] * block[1][1];
            score
        };
        let scores: Vec<Vector> = blocks.iter().map(score).collect();
        assert!(cluster(&mut found, &scores, &wide(), 1.0 / 3.0).is_some());
        inside += i32::from(off < 2.023 * found.covariance[1][1].sqrt()); // Student's t of 39
    }
    // 400 trials: one standard error of a share of 95 % is 1.1 %.
    assert!((367..=393).contains(&inside), "{inside}");
    assert!(plain_inside < 250, "{plain_inside}");
}

/// What rounding leaves of a covariance may be below zero along a direction: that direction is not known.
#[test]
fn a_variance_below_zero_is_no_certainty() {
    let mut covariance = [[0.0; UNKNOWNS]; UNKNOWNS];
    (covariance[1][1], covariance[2][2]) = (1.0, 1.0);
    (covariance[1][2], covariance[2][1]) = (-1.1, -1.1);
    let known = Posterior::believed(set(1..3), [0.0; UNKNOWNS], covariance);
    let along = |first: f64, second: f64| {
        let mut g = [0.0; UNKNOWNS];
        (g[1], g[2]) = (first, second);
        known.variance_along(&g)
    };
    assert!((along(1.0, -1.0) - 4.2).abs() < 1e-12);
    assert_eq!(along(1.0, 1.0), f64::INFINITY);
    assert_eq!(along(0.0, 0.0), 0.0);
}

/// Powers of a deflection around a zero far from it cancel: what rounding leaves of them is no information.
#[test]
fn sums_of_directions_that_cancel_stay_positive_definite() {
    let rows: Vec<Row> = (0..400)
        .map(|k| {
            let u = 1.0 + 0.1 * (f64::from(k) * 0.37).sin();
            std::array::from_fn(|column| if column < 10 { u.powi(column as i32) } else { 0.0 })
        })
        .collect();
    let mut frame = plain(0);
    frame.set = set(1..6);
    for (power, direction) in (5..10).zip(&mut frame.directions[1..6]) {
        *direction = [0.0; COLUMNS];
        let mut chosen = 1.0; // power over k
        for k in 0..=power {
            direction[k] = chosen * (-1.0_f64).powi((power - k) as i32);
            chosen *= (power - k) as f64 / (k + 1) as f64;
        }
    }
    let found = solve(&frame.reduce(&sum(&rows)), frame.set, &wide(), 1e-9).unwrap();
    assert!(found.x.iter().all(|x| x.abs() < 1e12), "{:?}", found.x);
    assert!(found.log_evidence < 0.0);
}

#[test]
fn noise_of_columns_pulls_what_multiplies_them() {
    // Both columns are read with the same noise, with opposite signs: least squares errs by what is foreseen.
    let (x, deviation, n, mut seed) = ([0.0, 5.0, -3.0], 0.1, 20000, 7);
    let variance = 4.0 / 3.0 * deviation * deviation; // uniform within twice the deviation
    let read: Vec<Row> = (0..n)
        .map(|_| {
            let (one, other, error) =
                (noise(&mut seed), noise(&mut seed), 2.0 * deviation * noise(&mut seed));
            let mut row = [0.0; COLUMNS];
            (row[0], row[1], row[2], row[3]) = (x[1] * one + x[2] * other, one + error, other - error, 1.0);
            row
        })
        .collect();
    let (gram, frame) = (sum(&read), plain(0b110));
    let covariance = [[variance, -variance], [-variance, variance]];
    let reduced = frame.reduce_noisy(&gram, &gram.noise(&[(1, 3, 1.0, 0), (2, 3, 1.0, 1)], &covariance));
    let prior = Prior::independent([0.0; UNKNOWNS], &[1e3; UNKNOWNS]);
    let found = solve(&reduced, 0b110, &prior, 1.0).unwrap();
    // By the true unknowns it is exact, but for what n rows leave of noise: 0.01, five times.
    let mut truth = [0.0; UNKNOWNS];
    truth[..3].copy_from_slice(&x);
    let pull = reduced.pull(&truth, 0b110);
    for i in 1..3 {
        let (foreseen, is) = (product(&found.covariance[i], &pull), found.x[i] - x[i]);
        assert!(is.abs() > 0.05 && (foreseen - is).abs() < 0.05, "{foreseen} of {is}");
    }
}
