//! See the module.

use super::*;
use crate::laws::Law;

const T: f64 = 1e-3;

/// A joint on a sine whose torque is known in closed form: the row's columns add up to zero.
#[test]
fn the_row_of_a_known_joint_is_a_balance() {
    let filters = Filters::new(60.0, T);
    let (inertia, damping, k1, k3) = (0.1, 0.5, 100.0, 4000.0);
    let w = 7.0;
    let at = |t: f64| (0.5 * (w * t).sin(), 0.4 * (w * t + 0.2).sin());
    let torque = |t: f64| {
        let (theta, q) = at(t);
        let (rate, acceleration) = (0.5 * w * (w * t).cos(), -w * w * theta);
        let phi = q - theta;
        inertia * acceleration + damping * rate - k1 * phi - k3 * phi.powi(3)
    };
    let mut balance = Balance::new(Family::Smooth);
    let mut link = Channel::rest(0.0);
    let (mut left, mut largest): (f64, f64) = (0.0, 0.0);
    for k in 0..6000 {
        let t = f64::from(k) * T;
        let (theta, q) = at(t);
        if k == 1000 {
            balance.grow(balance.largest());
        }
        link.smooth(&filters, q);
        // The mean over a period is what a held torque of this value amounts to.
        balance.read(&filters, theta, torque(t + 0.5 * T));
        balance.feed(&filters, q - theta, &link, &Declared::default());
        balance.observe(q - theta, true);
        if k > 2000 {
            let (row, size) = (balance.row(), balance.size.deflection);
            let sum = inertia * row[ACCELERATION]
                + damping * row[VELOCITY]
                + k1 * size * row[SPRING.start]
                + k3 * size.powi(3) * row[SPRING.start + 1];
            left = left.max((row[TORQUE] - sum).abs());
            largest = largest.max(row[TORQUE].abs());
        }
    }
    assert!(left < 2e-4 * largest, "{left} of {largest}");
}

fn moved(balance: &mut Balance, from: u32, to: u32, amplitude: f64) -> Row {
    let filters = Filters::new(60.0, T);
    let mut link = Channel::rest(0.0);
    for k in 0..to {
        let q = amplitude * (f64::from(k) * 3e-3).sin();
        link.smooth(&filters, q);
        if k >= from {
            balance.read(&filters, 0.0, 0.0);
            balance.feed(&filters, q, &link, &Declared::default());
            balance.observe(q, true);
        }
    }
    balance.row()
}

#[test]
fn a_stop_remembers_which_way_it_came() {
    let mut balance = Balance::new(Family::Smooth);
    moved(&mut balance, 0, 3000, 0.01);
    balance.grow(0.01);
    balance.fit_widths(0.0);
    moved(&mut balance, 0, 4000, 0.01);
    assert!(balance.extras(0.0).0[STOPS.start].abs() > 0.5 * STOP_WIDTHS[0]);
    assert_eq!(balance.extras(0.0).1[STOPS.start], 0.0);
}

#[test]
fn columns_that_have_grown_are_those_of_a_joint_that_was_larger_from_the_start() {
    let mut grown = Balance::new(Family::Smooth);
    moved(&mut grown, 0, 2500, 0.01);
    grown.grow(0.01);
    moved(&mut grown, 0, 2500, 0.01);
    let mut link = Channel::rest(0.0);
    link.smooth(&Filters::new(60.0, T), 0.0);
    let before = grown.row();
    let factors = grown.grow(0.02);
    let after = grown.row();
    for column in SPRING.chain(SLOPE).chain([CORNER]) {
        assert!((before[column] * factors[column] - after[column]).abs() < 1e-12, "{column}");
    }
}

/// What noise in u adds to a column is its slope, which is another column.
#[test]
fn the_slopes_of_columns_are_columns() {
    let columns = |family: &Family, u: f64| {
        let mut row = [0.0; COLUMNS];
        row[SPRING.start..SLOPE.end].copy_from_slice(&family.at(u, 0.1));
        (row[UNEVEN], row[CORNER]) = (u.abs(), u * u.abs());
        row
    };
    for family in [Family::Smooth, Family::Kinked, Family::Near(Law::VsaII, 1.7)] {
        for u in [-0.7, 0.3] {
            let (now, h) = (columns(&family, u), 1e-6);
            for (column, slope, factor, _) in slopes().into_iter().filter(|one| one.3 == 0) {
                let ahead = columns(&family, u + h)[column] - columns(&family, u - h)[column];
                assert!((ahead / (2.0 * h) - factor * now[slope]).abs() < 1e-7, "{column} at {u}");
            }
        }
    }
}

/// A gap's edge inside a piece: its slope is the mean of 0 and K over it, its variance known in closed form.
#[test]
fn a_piece_with_an_edge_is_as_uncertain_as_the_edge_makes_it() {
    let mut balance = Balance::new(Family::Smooth);
    moved(&mut balance, 0, 3000, 1.0);
    balance.grow(1.0);
    balance.fit_widths(0.0);
    let (range, k, below) = (balance.size.range, 100.0, 0.3);
    // Slopes of the pieces: 0, then the edge's, then k: what the clips take off k.
    let mean = k * (1.0 - below);
    let clips = [-mean * range, (mean - k) * range, 0.0, 0.0];
    let variance = |piece: usize, stiffness: f64| {
        balance.within_piece(0.99 * CLIP_WIDTHS[piece] * range, &clips, stiffness)
    };
    assert!((variance(1, mean) - k * k * below * (1.0 - below)).abs() < 1e-9);
    assert_eq!((variance(0, 0.0), variance(2, k)), (0.0, 0.0));
    // In the middle the next slope is all that is known.
    assert!((variance(0, 20.0) - 20.0 * mean).abs() < 1e-9);
}

/// What rounding does to F G q, and what is foreseen of it, rad², over all phases of the count.
fn rounded(filters: &Filters, count: f64, position: impl Fn(f64) -> f64) -> [f64; 2] {
    let (noise, white, phases) = (count * count / 12.0, filters.noise_gains(T)[0], 32);
    let mut squares = [0.0; 2];
    for phase in 0..phases {
        let start = count * f64::from(phase) / f64::from(phases);
        let (mut balance, mut error) = (Balance::new(Family::Smooth), Channel::rest(0.0));
        let mut link = Channel::rest(position(0.0) + start);
        for k in 0..3000 {
            let q = position(f64::from(k) * T) + start;
            let read = (q / count).round() * count;
            link.smooth(filters, read);
            error.smooth(filters, read - q);
            balance.feed_rounding(filters, link.light[1], [0.0, noise]);
            if k >= 500 {
                squares[0] += error.main[0].powi(2);
                squares[1] += noise * white + balance.rounding([0.0, noise], white);
            }
        }
    }
    squares.map(|sum| sum / f64::from(2500 * phases))
}

#[test]
fn rounding_is_an_error_that_stays_where_a_position_does() {
    let (filters, count) = (Filters::new(60.0, T), 1e-3);
    let ratio = |position: &dyn Fn(f64) -> f64| {
        let [is, foreseen] = rounded(&filters, count, |t| count * position(t));
        foreseen / is
    };
    let step = |t: f64| t * t * (3.0 - 2.0 * t);
    let moves = |t: f64| 500.0 * (t.floor() + step((2.0 * t.fract()).min(1.0)));
    let (rest, moves) = (ratio(&|_| 0.0), ratio(&moves));
    assert!((rest - 1.0).abs() < 0.01 && (moves - 1.0).abs() < 0.05, "{rest} {moves}");
    // A wave of a few counts a second is taken for rest in part; a fast one is white, but for its beats with the sampling.
    for (size, w) in
        [(0.3, 6.0), (3.0, 6.0), (30.0, 6.0), (100.0, 6.0), (1000.0, 6.0), (10.0, 30.0), (100.0, 30.0)]
    {
        let wave = ratio(&|t| size * (w * t).sin());
        assert!((0.5..5.0).contains(&wave), "{size} {w}: {wave}");
    }
}
