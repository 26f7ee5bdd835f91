//! All that may have changed in a joint or be wrong with its readings: one table, one rule.
//!
//! What is known explains a window of rows up to residuals r = z · c. A cause adds one direction v with an unknown
//! amplitude. The probability of the window under each cause, amplitudes and what is uncertain integrated out,
//! times its probability before (the declared rate of false alarms), decides: the generalised likelihood ratio of
//! Willsky and Jones ("A generalized likelihood ratio approach to the detection and estimation of jumps in linear
//! systems", IEEE TAC 1976).

use serde::{Deserialize, Serialize};

use crate::balance::{ACCELERATION, DRY, LATE, OFFSET, READ, SPRING, TORQUE, TORQUE_RATE, VELOCITY};
use crate::choices::EVEN;
use crate::gram::{COLUMNS, Frame, Gram, Matrix, Prior, Reduced, Row, Set, UNKNOWNS, dot, solve, unknowns};
use crate::spring::{Coefficients, FIRST, TERMS};
use crate::unknowns;

/// A cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Cause {
    /// What is known holds.
    Nothing,
    /// The stiffness, by a factor.
    Stiffness,
    /// The spring's shape.
    Shape,
    /// Dry friction.
    Friction,
    /// A constant torque, or the zero of the torque's reading.
    TorqueZero,
    /// The zero between the encoders.
    PositionZero,
    /// The inertia that the motor moves.
    Inertia,
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
    /// Larger errors of any kind.
    Noise,
}

/// How many there are.
pub const CAUSES: usize = 14;

/// One row of the table.
pub struct Entry {
    /// The cause.
    pub cause: Cause,
    /// Its name in the table of sentences, `estimator/reasons.py`.
    pub name: &'static str,
    /// Standard deviation of its amplitude before any data, in the unit of its direction.
    pub std: f64,
    /// The unknowns that it makes uncertain; none: a reading that the balance has no unknown for.
    pub opens: Set,
}

const fn bit(unknown: usize) -> Set {
    1 << unknown
}

const fn entry(cause: Cause, name: &'static str, std: f64, opens: Set) -> Entry {
    Entry { cause, name, std, opens }
}

const SPRINGS: Set = 0b11111 << unknowns::SPRING.start;

/// The table. Amplitudes are shares (of the stiffness, of a scale, of the torque's rms) or periods.
pub const TABLE: [Entry; CAUSES] = [
    entry(Cause::Nothing, "nothing", 0.0, 0),
    entry(Cause::Stiffness, "stiffness", 0.5, SPRINGS),
    entry(Cause::Shape, "spring_shape", 0.3, SPRINGS),
    entry(Cause::Friction, "friction", 0.2, bit(unknowns::DRY)),
    entry(Cause::TorqueZero, "torque_zero", 0.3, bit(unknowns::OFFSET)),
    entry(Cause::PositionZero, "position_zero", 0.3, bit(unknowns::ZERO)),
    entry(Cause::Inertia, "inertia", 0.3, bit(unknowns::INERTIA)),
    entry(Cause::LinkDelay, "link_delay", 3.0, bit(unknowns::LATE)),
    entry(Cause::MotorScale, "motor_scale", 0.3, 0),
    entry(Cause::LinkScale, "link_scale", 0.3, 0),
    entry(Cause::TorqueScale, "torque_scale", 0.3, 0),
    entry(Cause::MotorDelay, "motor_delay", 3.0, 0),
    entry(Cause::TorqueDelay, "torque_delay", 3.0, 0),
    entry(Cause::Noise, "noise", 0.0, 0),
];

impl Cause {
    /// Its row of the table.
    #[must_use]
    pub fn entry(self) -> &'static Entry {
        &TABLE[self as usize]
    }
}

/// What is known of a balance, as the causes need it.
pub struct Known<'a> {
    /// Directions of the unknowns.
    pub frame: &'a Frame,
    /// The residual of a row is z · c.
    pub residual: &'a Row,
    /// Which unknowns are uncertain …
    pub set: Set,
    /// … and their precision.
    pub precision: &'a Matrix,
    /// The spring's torque and stiffness as sums of the family's functions.
    pub torque: &'a Coefficients,
    /// The same of the stiffness …
    pub slope: &'a Coefficients,
    /// … and as a sum of the slopes, and of the first ones alone.
    pub slopes: &'a ([f64; TERMS], [f64; FIRST]),
    /// The same of φ σ.
    pub turn: &'a Coefficients,
    /// B and D.
    pub motor: (f64, f64),
    /// rms of the torque, N·m.
    pub torque_rms: f64,
    /// The largest deflection, rad.
    pub deflection: f64,
    /// Of the samples, s.
    pub period_s: f64,
}

/// One cause as a window has it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Explanation {
    /// Probability.
    pub probability: f64,
    /// Mean square of what it leaves, over what is usual.
    pub misfit: f64,
    /// How large it is: a share, s, rad or N·m.
    pub amplitude: f64,
    /// Standard deviation of that.
    pub std: f64,
}

/// All causes held against one window.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Odds {
    /// One for each row of [`TABLE`].
    pub of: [Explanation; CAUSES],
    /// ln of the likelihoods, up to what all have in common.
    pub log: [f64; CAUSES],
}

/// How noisy rows are.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Noise {
    /// Variance of a row.
    pub variance: f64,
    /// Rows that one independent error is worth.
    pub correlated: f64,
    /// Degrees of freedom of its level, which varies from one moment to another.
    pub tails: f64,
}

impl Known<'_> {
    /// What is known before the window, with the amplitude of a cause in the place `own`.
    fn precision_with(&self, entry: &Entry, own: usize) -> Matrix {
        let mut precision = *self.precision;
        precision[own][own] = entry.std.powi(-2);
        if matches!(entry.cause, Cause::MotorScale | Cause::LinkScale) && self.set >> unknowns::ZERO & 1 == 1
        {
            // A reading of another scale is of another zero, too: where it was right is not known.
            (0..UNKNOWNS).for_each(|i| precision[i][unknowns::ZERO] = 0.0);
            precision[unknowns::ZERO] = [0.0; UNKNOWNS];
            precision[unknowns::ZERO][unknowns::ZERO] = self.deflection.powi(-2);
        }
        precision
    }

    /// The direction of a cause in the space of a row's columns, for an amplitude of 1 in the table's unit; and what
    /// an amplitude of 1 is in SI units. `None`: it has no direction.
    #[must_use]
    fn direction(&self, cause: Cause) -> Option<(Row, f64)> {
        let mut v = [0.0; COLUMNS];
        let unit = match cause {
            Cause::Nothing | Cause::Noise => return None,
            Cause::Stiffness => add(&mut v, SPRING.start, self.torque, 1.0),
            Cause::Shape => {
                // The curve with another bend, the torque at the largest deflection as it was.
                let whole = self.carried();
                (v[SPRING.start], v[SPRING.start + 1]) = (whole, -whole);
                1.0
            }
            Cause::Friction => put(&mut v, DRY, self.torque_rms),
            // On a linear spring these two are the same, and as large.
            Cause::TorqueZero => put(&mut v, OFFSET, self.largest()),
            Cause::PositionZero => {
                add(&mut v, SPRING.start, self.slope, self.deflection * self.largest() / self.carried())
            }
            Cause::Inertia => {
                v[ACCELERATION] = self.motor.0;
                1.0
            }
            Cause::LinkDelay => add(&mut v, LATE.start, &self.slopes.0, self.period_s),
            // q reads (1 + a) q.
            Cause::LinkScale => -add(&mut v, READ.start, &self.slopes.1, -1.0),
            Cause::MotorScale => self.add_motor_scale(&mut v),
            // τ reads (1 + a) τ.
            Cause::TorqueScale => put(&mut v, TORQUE, 1.0),
            Cause::TorqueDelay => -put(&mut v, TORQUE_RATE, -self.period_s),
            Cause::MotorDelay => {
                // The same as a link and a torque that are early.
                add(&mut v, LATE.start, &self.slopes.0, -self.period_s);
                put(&mut v, TORQUE_RATE, self.period_s)
            }
        };
        Some((v, unit))
    }

    /// The spring's torque at the largest deflection, N·m.
    fn carried(&self) -> f64 {
        self.torque[..TERMS].iter().sum()
    }

    /// The larger one of that and the motor's torque, N·m.
    fn largest(&self) -> f64 {
        self.torque_rms.max(self.carried().abs())
    }

    /// θ reads (1 + a) θ; σ θ = σ q − σ φ.
    fn add_motor_scale(&self, v: &mut Row) -> f64 {
        (v[ACCELERATION], v[VELOCITY]) = (-self.motor.0, -self.motor.1);
        add(v, SPRING.start, self.turn, -1.0);
        add(v, READ.start, &self.slopes.1, 1.0)
    }

    /// Hold every cause against a window; `before`: probability, before it, that something has changed.
    #[must_use]
    pub fn judge(&self, window: &Gram, noise: &Noise, before: f64) -> Odds {
        let scale = noise.variance * noise.correlated;
        let independent = (window.rows / noise.correlated).max(1.0);
        let mut frame = self.frame.clone();
        (frame.left, frame.set) = (*self.residual, self.set);
        let reduced = frame.reduce(window);
        let mut prior = Prior { mean: [0.0; UNKNOWNS], precision: *self.precision };
        // The place of the cause's own amplitude: an unknown that is not in the set, or the last one.
        let own = (1..UNKNOWNS).rev().find(|i| self.set >> i & 1 == 0);
        let evidence = |square: f64, log_ratio: f64| {
            let square = square.max(independent); // what is left below the noise speaks for nothing
            -0.5 * (independent + noise.tails) * (square / noise.tails).ln_1p() + 0.5 * log_ratio
        };
        let mut odds = Odds { of: [Explanation::default(); CAUSES], log: [f64::NEG_INFINITY; CAUSES] };
        let mut judged = |cause: Cause, reduced: &Reduced, set: Set, prior: &Prior, unit: f64| {
            let Some(found) = solve(reduced, set, prior, scale) else { return f64::INFINITY };
            let (square, log_ratio) = (found.square, 2.0 * found.log_evidence + found.square);
            let (x, std) = own.map_or((0.0, 0.0), |own| (found.x[own], found.covariance[own][own].sqrt()));
            odds.log[cause as usize] = evidence(square, log_ratio);
            odds.of[cause as usize] = Explanation {
                probability: 0.0,
                misfit: square.max(0.0) / independent,
                amplitude: unit * x,
                std: unit * std,
            };
            square
        };
        let healthy = judged(Cause::Nothing, &reduced, self.set, &prior, 0.0);
        // No cause gains more than all that is left, and each has less than this chance.
        let most = evidence(independent, 0.0) - evidence(healthy, 0.0);
        if most + before.max(f64::MIN_POSITIVE).ln() + (CAUSES as f64 / (CAUSES - 1) as f64).ln() <= 0.0 {
            odds.of[Cause::Nothing as usize].probability = 1.0;
            return odds;
        }
        if let Some(own) = own {
            for entry in &TABLE[1..] {
                let Some((v, unit)) = self.direction(entry.cause) else { continue };
                let more = with_direction(&reduced, window, &frame, &v, own);
                prior.precision = self.precision_with(entry, own);
                judged(entry.cause, &more, self.set | bit(own), &prior, unit);
            }
        }
        let gain = evidence(independent, 0.0) - evidence(healthy, 0.0);
        odds.add_noise((healthy / independent).max(1.0), independent, gain);
        odds.normalise(before);
        odds
    }
}

/// A multiple of a curve in the columns from `from` on; returns the factor.
fn add(v: &mut Row, from: usize, curve: &[f64], factor: f64) -> f64 {
    v[from..from + curve.len()].iter_mut().zip(curve).for_each(|(v, c)| *v += factor * c);
    factor
}

/// Reduced sums with one more direction, in the place `own`.
fn with_direction(reduced: &Reduced, window: &Gram, frame: &Frame, v: &Row, own: usize) -> Reduced {
    let mut more = *reduced;
    let image = window.times(v);
    for i in unknowns(frame.set) {
        let value = dot(&image, &frame.directions[i]);
        (more[own][i], more[i][own]) = (value, value);
    }
    let value = dot(&image, &frame.left);
    (more[own][0], more[0][own]) = (value, value);
    more[own][own] = dot(&image, v);
    more
}

fn put(v: &mut Row, column: usize, value: f64) -> f64 {
    v[column] = value;
    value
}

impl Odds {
    /// Larger errors: as much larger as fits best, at the price of that choice.
    fn add_noise(&mut self, factor: f64, independent: f64, gain: f64) {
        let price = 0.5 * independent * factor.ln() + 0.5 * independent.ln_1p();
        self.log[Cause::Noise as usize] = self.log[0] + gain - price;
        self.of[Cause::Noise as usize] =
            Explanation { misfit: 1.0, amplitude: factor.sqrt(), ..Explanation::default() };
    }

    fn normalise(&mut self, before: f64) {
        let each = (before / (CAUSES - 1) as f64).max(f64::MIN_POSITIVE).ln();
        let most = self.log.iter().skip(1).fold(self.log[0], |most, log| most.max(log + each));
        let weight = |k: usize| (self.log[k] + if k == 0 { 0.0 } else { each } - most).exp();
        let total: f64 = (0..CAUSES).map(weight).sum();
        let share: [f64; CAUSES] = std::array::from_fn(|k| weight(k) / total);
        self.of.iter_mut().zip(share).for_each(|(one, share)| one.probability = share);
    }

    /// How many times as well as what is known a cause explains the window.
    #[must_use]
    pub fn against_nothing(&self, cause: Cause) -> f64 {
        (self.log[cause as usize] - self.log[Cause::Nothing as usize]).exp()
    }

    /// What is said of a cause.
    #[must_use]
    pub fn of(&self, cause: Cause) -> &Explanation {
        &self.of[cause as usize]
    }

    /// Which of some causes the window does not tell from the likeliest of them.
    #[must_use]
    pub fn likely(&self, wanted: impl Fn(Cause) -> bool) -> [bool; CAUSES] {
        let Some(best) = self.best(&wanted) else { return [false; CAUSES] };
        let least = EVEN * self.of(best).probability;
        std::array::from_fn(|k| wanted(TABLE[k].cause) && self.of[k].probability > least)
    }

    /// The most probable cause of those that are asked for.
    pub fn best(&self, wanted: impl Fn(Cause) -> bool) -> Option<Cause> {
        let asked = TABLE.iter().map(|entry| entry.cause).filter(|cause| wanted(*cause));
        asked.max_by(|a, b| self.log[*a as usize].total_cmp(&self.log[*b as usize]))
    }
}
