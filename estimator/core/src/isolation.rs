//! Isolates a change: each possible fault or change is tested on the balance of the last seconds.
//!
//! The reference was estimated while the balance was explained: parameters x̄ with their covariance Σ,
//! and the noise s². Against it the equations of a window leave r = y − h x̄. Under the hypothesis that
//! nothing has changed, r = h δ + e with δ ~ (0, Σ), e ~ (0, s²). Under every other one, one column with an
//! unknown amplitude is added: f itself where the stiffness has changed, F[σ q] where the link encoder has
//! another scale, F[τ] where the torque has, … The residual and the probability of the window under each
//! follow from one small system: the generalised likelihood ratio of Willsky and Jones ("A generalized
//! likelihood ratio approach to the detection and estimation of jumps in linear systems", IEEE TAC 1976), its
//! amplitudes integrated out.

use crate::kalman::{Kalman, SIZE, Vector};

/// Columns of readings that are not what they were, beside those of the equation.
pub const READINGS: usize = 7;
const COLUMNS: usize = SIZE + READINGS;
const DRIFTS: [usize; 2] = [COLUMNS - 2, COLUMNS - 1]; // the last ones: the zero's column times time is added here
const LEFT: usize = COLUMNS; // r, behind the columns
const WIDTH: usize = COLUMNS + 1;

/// A change of the joint or of one of its readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// None: the reference holds.
    Nothing,
    /// The stiffness, by a factor.
    Stiffness,
    /// Dry friction.
    Friction,
    /// A constant torque, or the zero of the torque's reading.
    TorqueZero,
    /// The zero between the encoders.
    PositionZero,
    /// The delay of the link's position.
    LinkDelay,
    /// The scale of the motor's position.
    MotorScale,
    /// The scale of the link's position.
    LinkScale,
    /// The scale of the motor's torque.
    TorqueScale,
    /// The delay of the motor's position.
    MotorDelay,
    /// The delay of the motor's torque.
    TorqueDelay,
    /// The zero of the link's position, which moves on.
    LinkDrift,
    /// The zero of the motor's position, which moves on: to the motor that is a velocity, which is damped.
    MotorDrift,
}

/// How many there are.
pub const CHANGES: usize = 13;

impl Change {
    /// All of them; the first five after `Nothing` are parameters of the equation, which can be followed.
    pub const ALL: [Change; CHANGES] = [
        Change::Nothing,
        Change::Stiffness,
        Change::Friction,
        Change::TorqueZero,
        Change::PositionZero,
        Change::LinkDelay,
        Change::MotorScale,
        Change::LinkScale,
        Change::TorqueScale,
        Change::MotorDelay,
        Change::TorqueDelay,
        Change::LinkDrift,
        Change::MotorDrift,
    ];

    /// Its name in the table of sentences, `estimator/reasons.py`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Change::Nothing => "nothing",
            Change::Stiffness => "stiffness",
            Change::Friction => "friction",
            Change::TorqueZero => "torque_zero",
            Change::PositionZero => "position_zero",
            Change::LinkDelay => "link_delay",
            Change::MotorScale => "motor_scale",
            Change::LinkScale => "link_scale",
            Change::TorqueScale => "torque_scale",
            Change::MotorDelay => "motor_delay",
            Change::TorqueDelay => "torque_delay",
            Change::LinkDrift => "link_drift",
            Change::MotorDrift => "motor_drift",
        }
    }

    /// Whether the equation has a parameter for it.
    #[must_use]
    pub fn is_parameter(self) -> bool {
        self != Change::Nothing && !self.is_reading()
    }

    /// Whether it goes on: by now it is elsewhere.
    #[must_use]
    pub fn is_drift(self) -> bool {
        matches!(self, Change::LinkDrift | Change::MotorDrift)
    }

    /// Whether it is of a reading that the equation has no parameter for.
    #[must_use]
    pub fn is_reading(self) -> bool {
        self as usize >= Change::MotorScale as usize
    }
}

/// One change as the window has it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Explanation {
    /// Mean square of what is left, over what is foreseen: about one if it is the truth.
    pub misfit: f64,
    /// Logarithm of the window's probability density, up to what all changes have in common.
    pub evidence: f64,
    /// How large it is, in the unit of its column.
    pub amplitude: f64,
    /// Standard deviation of that.
    pub std: f64,
    /// Where what drifts is by now, in the unit of the zero between the encoders.
    pub place: f64,
}

/// All changes held against one window.
#[derive(Clone, Copy, Debug)]
pub struct Verdict {
    /// One for each of [`Change::ALL`].
    pub explanations: [Explanation; CHANGES],
    /// Independent equations in the window …
    pub equations: f64,
    /// … and how many there are.
    pub updates: f64,
}

impl Verdict {
    /// What is said of a change.
    #[must_use]
    pub fn of(&self, change: Change) -> &Explanation {
        &self.explanations[change as usize]
    }

    /// The most probable one of those that are asked for.
    pub fn best(&self, wanted: impl Fn(Change) -> bool) -> Option<Change> {
        let mut best = None;
        let mut most = f64::NEG_INFINITY;
        for change in Change::ALL {
            let evidence = self.of(change).evidence;
            if wanted(change) && evidence > most {
                (best, most) = (Some(change), evidence);
            }
        }
        best
    }
}

/// Where the columns of parameters are, and how wide the amplitudes of changes may be.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Entries of α …
    pub law: usize,
    /// … and how many of them, the first ones, are linear coefficients.
    pub linear: usize,
    /// Places of friction, torque offset, deflection offset and the link's delay behind α.
    pub places: [usize; 4],
    /// Prior standard deviations of each change's amplitude, in the unit of its column.
    pub std: [f64; CHANGES],
}

/// The window: normal equations of all columns and of what the reference leaves.
#[derive(Clone, Debug)]
pub struct Isolation {
    gram: [[f64; WIDTH]; WIDTH], // lower triangle
    equations: f64,
}

impl Default for Isolation {
    fn default() -> Isolation {
        Isolation { gram: [[0.0; WIDTH]; WIDTH], equations: 0.0 }
    }
}

impl Isolation {
    /// Forget the window.
    pub fn clear(&mut self) {
        *self = Isolation::default();
    }

    /// How many equations there are in it.
    #[must_use]
    pub fn equations(&self) -> f64 {
        self.equations
    }

    /// One equation: its row, the columns of other readings, what the reference leaves. `memory`: equations.
    ///
    /// `zero`: the column of the zero between the encoders; `dt_s`: since the last one.
    pub fn take(
        &mut self,
        h: &Vector,
        readings: &[f64; READINGS],
        left: f64,
        memory: f64,
        zero: usize,
        dt_s: f64,
    ) {
        self.age(zero, dt_s);
        let mut z = [0.0; WIDTH];
        z[..SIZE].copy_from_slice(h);
        z[SIZE..COLUMNS].copy_from_slice(readings);
        z[LEFT] = left;
        let keep = if self.equations + 1.0 > memory { 1.0 - 1.0 / memory } else { 1.0 };
        for i in 0..WIDTH {
            for j in 0..=i {
                self.gram[i][j] = keep * self.gram[i][j] + z[i] * z[j];
            }
        }
        self.equations = keep * self.equations + 1.0;
    }

    /// What drifts is h t + d with t = 0 now: all that is in the window is older by so much.
    fn age(&mut self, zero: usize, dt_s: f64) {
        for drift in DRIFTS {
            // The corner last, with the cross terms moved already: (d − z dt)² = d² − dt (2 z (d − z dt) + dt z²).
            for i in (0..WIDTH).filter(|i| *i != drift) {
                let moved = self.at(drift, i) - dt_s * self.at(zero, i);
                *self.at_mut(drift, i) = moved;
            }
            let (now, square) = (self.at(drift, zero), self.at(zero, zero));
            self.gram[drift][drift] -= dt_s * (2.0 * now + dt_s * square);
        }
    }

    fn at_mut(&mut self, i: usize, j: usize) -> &mut f64 {
        if i >= j { &mut self.gram[i][j] } else { &mut self.gram[j][i] }
    }

    fn at(&self, i: usize, j: usize) -> f64 {
        if i >= j { self.gram[i][j] } else { self.gram[j][i] }
    }

    /// Parameters have other units: the columns of the equation become `columns` times as large, what the
    /// equation is divided by 1/`scale` times.
    pub fn rescale(&mut self, columns: &Vector, scale: f64, zero: usize) {
        let mut factors = [scale; WIDTH];
        factors[..SIZE].copy_from_slice(columns);
        DRIFTS.iter().for_each(|drift| factors[*drift] = columns[zero]);
        for i in 0..WIDTH {
            for j in 0..=i {
                self.gram[i][j] *= factors[i] * factors[j];
            }
        }
    }

    /// The reference is another one, larger by `change`.
    pub fn rebase(&mut self, change: &Vector) {
        let mut square = 0.0;
        let mut shifts = [0.0; COLUMNS];
        for i in 0..COLUMNS {
            for j in 0..SIZE {
                shifts[i] += self.at(i, j) * change[j];
            }
        }
        for i in 0..SIZE {
            square += change[i] * (shifts[i] - 2.0 * self.gram[LEFT][i]);
        }
        for i in 0..COLUMNS {
            self.gram[LEFT][i] -= shifts[i];
        }
        self.gram[LEFT][LEFT] = (self.gram[LEFT][LEFT] + square).max(0.0);
    }

    /// What a change that has been explained so adds to an equation.
    #[must_use]
    pub fn effect(
        change: Change,
        explanation: &Explanation,
        h: &Vector,
        readings: &[f64; READINGS],
        reference: &Kalman,
        layout: &Layout,
    ) -> f64 {
        let along = |change: Change| -> f64 {
            let direction = direction(change, reference, layout);
            direction.iter().zip(h.iter().chain(readings)).map(|(a, b)| a * b).sum()
        };
        let drifted = if change.is_drift() { explanation.place * along(Change::PositionZero) } else { 0.0 };
        explanation.amplitude * along(change) + drifted
    }

    /// Hold every change against the window.
    ///
    /// `noise`: s², of one equation; `correlated`: how many equations have one independent error; `tails`:
    /// degrees of freedom of the noise's level.
    #[must_use]
    pub fn judge(
        &self,
        reference: &Kalman,
        layout: &Layout,
        noise: f64,
        correlated: f64,
        tails: f64,
    ) -> Verdict {
        let m = reference.size();
        let root = cholesky(&reference.sigma, reference.variance_over_scale(), m);
        let q = 1.0 / (correlated * noise);
        let independent = self.equations / correlated;
        // A = 1 + q L' G L = T T', u = T⁻¹ q L' g
        let (mut half, mut t, mut u) = ([[0.0; SIZE]; SIZE], [[0.0; SIZE]; SIZE], [0.0; SIZE]);
        for i in 0..m {
            for j in 0..m {
                half[i][j] = (j..m).map(|k| self.at(i, k) * root[k][j]).sum();
            }
        }
        for i in 0..m {
            for j in 0..=i {
                let product: f64 = (i..m).map(|k| root[k][i] * half[k][j]).sum();
                let rest: f64 = (0..j).map(|k| t[i][k] * t[j][k]).sum();
                let value = q * product + if i == j { 1.0 } else { 0.0 } - rest;
                t[i][j] = if i == j { value.max(1e-300).sqrt() } else { value / t[j][j] };
            }
        }
        let whitened = |column: &Vector| -> Vector {
            let mut out = [0.0; SIZE];
            for i in 0..m {
                let product: f64 = (i..m).map(|k| root[k][i] * column[k]).sum();
                let rest: f64 = (0..i).map(|k| t[i][k] * out[k]).sum();
                out[i] = (q * product - rest) / t[i][i];
            }
            out
        };
        let mut left = [0.0; SIZE];
        left.copy_from_slice(&self.gram[LEFT][..SIZE]);
        u.copy_from_slice(&whitened(&left));
        let healthy = q * self.gram[LEFT][LEFT] - u.iter().map(|x| x * x).sum::<f64>();
        let log_healthy: f64 = (0..m).map(|i| t[i][i].ln()).sum::<f64>() * 2.0;
        // What is left below the noise that is foreseen speaks for nothing.
        let explain = |square: f64, log: f64, amplitude: f64, std: f64| Explanation {
            misfit: square.max(0.0) / independent,
            evidence: -0.5 * (independent + tails) * (square.max(independent) / tails).ln_1p() - 0.5 * log,
            amplitude,
            std,
            place: 0.0,
        };
        let mut explanations = [Explanation::default(); CHANGES];
        explanations[0] = explain(healthy, log_healthy, 0.0, 0.0);
        // One more column c with an amplitude of this prior std, beside those in A: its row of T, its corner,
        // its entry of u, scaled.
        let add = |direction: &[f64; COLUMNS], std: f64| {
            let mut column = [0.0; COLUMNS];
            for (j, share) in direction.iter().enumerate() {
                if *share != 0.0 {
                    (0..COLUMNS).for_each(|i| column[i] += share * self.at(i, j));
                }
            }
            let power: f64 = (0..COLUMNS).map(|i| direction[i] * column[i]).sum();
            let along: f64 = (0..COLUMNS).map(|i| direction[i] * self.gram[LEFT][i]).sum();
            let mut known = [0.0; SIZE];
            known.copy_from_slice(&column[..SIZE]);
            let row = whitened(&known).map(|x| std * x);
            let corner = (1.0 + q * std * std * power - row.iter().map(|x| x * x).sum::<f64>()).max(1e-12);
            let projection = std * q * along - row.iter().zip(&u).map(|(a, b)| a * b).sum::<f64>();
            (row, corner, projection, column)
        };
        for change in &Change::ALL[1..] {
            let (std, own) = (layout.std[*change as usize], direction(*change, reference, layout));
            let (row, mut corner, mut projection, _) = add(&own, std);
            let (mut square, mut log) = (healthy, log_healthy);
            let mut place = [0.0; 2]; // without a drift, and what its amplitude takes from it
            if change.is_drift() {
                // What drifts is elsewhere by now.
                let zero_std = layout.std[Change::PositionZero as usize];
                let (first, power, moved, column) =
                    add(&direction(Change::PositionZero, reference, layout), zero_std);
                let along: f64 = (0..COLUMNS).map(|i| own[i] * column[i]).sum();
                let cross =
                    q * std * zero_std * along - row.iter().zip(&first).map(|(a, b)| a * b).sum::<f64>();
                square -= moved * moved / power;
                log += power.ln();
                projection -= cross * moved / power;
                corner = (corner - cross * cross / power).max(1e-12);
                place = [zero_std * moved / power, zero_std * cross / power];
            }
            explanations[*change as usize] = explain(
                square - projection * projection / corner,
                log + corner.ln(),
                std * projection / corner,
                std / corner.sqrt(),
            );
            explanations[*change as usize].place = place[0] - place[1] * projection / corner;
        }
        Verdict { explanations, equations: independent, updates: self.equations }
    }
}

/// What a change adds to the equation, by its columns.
#[must_use]
fn direction(change: Change, reference: &Kalman, layout: &Layout) -> [f64; COLUMNS] {
    let mut out = [0.0; COLUMNS];
    let parameter = |place: usize| layout.law + layout.places[place];
    match change {
        Change::Nothing => {}
        Change::Stiffness => out[..layout.linear].copy_from_slice(&reference.x[..layout.linear]),
        Change::Friction => out[parameter(0)] = 1.0,
        Change::TorqueZero => out[parameter(1)] = 1.0,
        Change::PositionZero => out[parameter(2)] = 1.0,
        Change::LinkDelay => out[parameter(3)] = 1.0,
        reading => out[SIZE + reading as usize - Change::MotorScale as usize] = 1.0,
    }
    out
}

/// L of factor · Σ = L L'; what has no variance stays as it is.
fn cholesky(sigma: &[Vector; SIZE], factor: f64, n: usize) -> [Vector; SIZE] {
    let mut lower = [[0.0; SIZE]; SIZE];
    for i in 0..n {
        for j in 0..=i {
            let rest: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let value = factor * 0.5 * (sigma[i][j] + sigma[j][i]) - rest;
            if i == j {
                lower[i][i] = value.max(0.0).sqrt();
            } else if lower[j][j] > 0.0 {
                lower[i][j] = value / lower[j][j];
            }
        }
    }
    lower
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: Layout = Layout {
        law: 1,
        linear: 1,
        places: [2, 3, 5, 4],
        std: [0.0, 0.5, 0.1, 0.3, 0.3, 3.0, 0.3, 0.3, 0.3, 3.0, 3.0, 0.3, 0.3],
    };

    const DAMPING: f64 = 0.8; // what a drift of the motor does by itself

    /// A spring of 1 with the six other parameters at nothing, known to a thousandth, under noise of a hundredth.
    fn reference() -> Kalman {
        let std = [1e-3; 7];
        Kalman::new(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], &std, 0.01, 1.0)
    }

    /// A window of 60 equations; `fault`: what the balance gains from (h, readings).
    fn judged(mut fault: impl FnMut(&Vector, &[f64; READINGS]) -> f64) -> Verdict {
        let (reference, mut window) = (reference(), Isolation::default());
        for k in 0..60 {
            let t = f64::from(k);
            let (mut h, mut readings) = ([0.0; SIZE], [0.0; READINGS]);
            (0..7).for_each(|i| h[i] = ((0.11 + 0.07 * i as f64) * t).sin());
            (0..READINGS - 2).for_each(|i| readings[i] = ((0.13 + 0.09 * i as f64) * t).cos());
            readings[READINGS - 1] = DAMPING;
            let noise = 0.01 * if (k * 7919) % 13 < 6 { 1.0 } else { -1.0 };
            window.take(&h, &readings, fault(&h, &readings) + noise, 200.0, 6, 0.03);
        }
        window.judge(&reference, &LAYOUT, 1e-4, 1.0, 8.0)
    }

    #[test]
    fn without_a_change_the_reference_leaves_the_noise() {
        let verdict = judged(|_, _| 0.0);
        assert!((verdict.of(Change::Nothing).misfit - 1.0).abs() < 0.1);
        assert_eq!(verdict.best(|_| true), Some(Change::Nothing));
    }

    #[test]
    fn every_change_is_the_best_explanation_of_itself() {
        for (i, change) in Change::ALL.into_iter().enumerate().skip(1) {
            let place = [0, 0, 3, 4, 6, 5][i.min(5)]; // of its column
            let mut age = -60.0 * 0.03; // of the drift
            let mut drift = |h: &Vector| {
                age += 0.03;
                0.2 * age * h[6]
            };
            let verdict = judged(|h, readings| match change {
                Change::LinkDrift => drift(h),
                Change::MotorDrift => drift(h) + 0.2 * DAMPING,
                _ if i < 6 => 0.2 * h[place],
                _ => 0.2 * readings[i - 6],
            });
            assert_eq!(verdict.best(|_| true), Some(change));
            let found = verdict.of(change);
            assert!((found.amplitude - 0.2).abs() < 4.0 * found.std + 1e-3, "{change:?} {found:?}");
            assert!(found.misfit < 1.5 && verdict.of(Change::Nothing).misfit > 20.0);
        }
    }

    #[test]
    fn another_reference_is_as_if_the_window_had_been_taken_with_it() {
        let (mut first, mut second) = (Isolation::default(), Isolation::default());
        let mut change = [0.0; SIZE];
        (change[0], change[3]) = (0.3, -0.2);
        for k in 0..20 {
            let t = f64::from(k);
            let mut h = [0.0; SIZE];
            (0..7).for_each(|i| h[i] = ((0.11 + 0.07 * i as f64) * t).sin());
            let (readings, left) = ([t.cos(); READINGS], (0.3 * t).cos());
            first.take(&h, &readings, left, 200.0, 6, 0.03);
            let shift: f64 = (0..SIZE).map(|i| h[i] * change[i]).sum();
            second.take(&h, &readings, left - shift, 200.0, 6, 0.03);
        }
        first.rebase(&change);
        for i in 0..WIDTH {
            assert!((first.at(LEFT, i) - second.at(LEFT, i)).abs() < 1e-9);
        }
    }
}
