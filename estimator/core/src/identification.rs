//! On-line identification of one transmission: the motor's balance as one linear equation an update.
//!
//! ```text
//! B F[θ″] + D F[θ′] + F[x] − F[τ]                                                              (eq 5)
//!     = F[f(φ, α)] − ΔB F[θ″] − ΔD F[θ′] − F_c F[s] − o + F[σ (d q′ + e)] + noise
//! ```
//! F is the filter that all channels share (its delay is common and cancels), B and D are declared, x are
//! the declared effects, and α, ΔB, ΔD, the Coulomb friction F_c, the offset o, the delay d of the link
//! encoder and its offset e to the motor's are estimated together. The torque's own scale is the anchor:
//! nothing on the motor side reveals it. Black-box estimation is the derivative of the same equation, with
//! a local σ instead of f.

mod reference;
mod target_law;
mod units;

use crate::change_detection::{SURE, TAILS};
use crate::friction::{Friction, SHAPES};
use crate::isolation::Isolation;
use crate::kalman::{Kalman, NUISANCES, SIZE, Vector};
use crate::laws::{Law, PARAMETERS};
use crate::linear_algebra::{dot, times};
use crate::linearisation::Linearisation;
use crate::model::{Motor, Transmission};
use crate::settings::{Method, Priors, Settings};
use crate::signals::Signals;
use crate::student::t_quantile;
use units::{NO_UNITS, Units};

/// Of the regression; a sudden change is for the alarm to find.
pub const MEMORY_S: f64 = 20.0;
const LOCAL_MEMORY_S: f64 = 2.0; // of the black box, whose model holds only locally
const START_ORDER: usize = 3; // polynomial that an unknown curve starts from
const STEP: f64 = 0.3; // how much a stiffness may change at an alarm, relative
const SHAPE_STEP: f64 = 0.1; // … and its shape, of that
const ORDER_S: f64 = 5.0; // of updates between looks at the polynomial's highest powers
const OFTEN_S: f64 = 0.5; // of updates between two looks at what rounding has done
const ORDER_SIGMA: f64 = 3.0; // from which on a power of the polynomial is there
const DELAY_S: f64 = 0.5; // of updates between two alignments of late channels
const DELAY_PERIODS: f64 = 0.05; // no smaller delay is worth one
const DRIVING: f64 = 0.05; // of the largest torque: no damping drives its motor by more
const NOISE_FLOOR: f64 = 1e-10; // variance, of the torque's square, below which no noise is believed
const NOISE_SHARE: f64 = 0.01; // noise assumed at the start, as a share of the torque
const DIFFUSE: f64 = 30.0; // prior std of the linear coefficient: in units of torque per deflection
const SHARE: f64 = 2.0; // prior std of a higher power: its share of the torque at the largest deflection
const CUT_OFF: f64 = 0.003; // … of the first power that a declared order leaves out
const KNOWN: f64 = 0.3; // relative prior std of parameters that the model gives
const KNOWN_SHARE: f64 = 0.02; // … and, of a power, of the torque at the largest deflection
const RELAX: f64 = 2.5; // a nuisance this many prior std off: the prior was too narrow
const RMS: f64 = 0.5; // of a torque over its largest value, in usual motion
const LEAST_VARIANCE: f64 = 0.02; // however the noise is coloured, it leaves so much of what white would
// Published over computed standard deviation, without unit: errors that are in no covariance, measured, their cause not
// isolated. Without the factor, the 95 % intervals of `benchmarks/ensembles.py` cover too little, above all where the
// link encoder is late; a covariance from products of single innovations (Newey, West, Econometrica 1987) covers less.
const UNSEEN: f64 = 1.3;

// Places of the nuisances behind α.
const INERTIA: usize = 0;
const DAMPING: usize = 1;
const COULOMB: usize = 2;
const OFFSET: usize = 3;
const DELAY: usize = 4;
const DEFLECTION_OFFSET: usize = 5;

/// See the module.
#[derive(Clone, Debug)]
pub struct OnlineIdentification {
    // Declared.
    inertia: f64,
    damping: f64,
    period: f64,
    dt: f64,
    /// Whether there is no law: eqs 28-30, the derivative of the balance.
    pub black_box: bool,
    target: Option<Law>,
    known: Vec<f64>,
    /// Parameters of the widest law that it ever has.
    pub slots: usize,
    choose_order: bool,
    cut_off: bool,
    priors: Priors,
    credible: f64, // prior standard deviations of B beyond which the motor is another one
    // Estimated.
    law: Linearisation,
    units: Units,
    resolution: f64,
    friction: Friction,
    undeclared: [f64; SHAPES], // friction that the last equation may hold, scaled
    kalman: Option<Kalman>,
    reference: Option<Kalman>, // what was learned some time ago, while all was well …
    candidate: Option<Kalman>, // … and what is to be it next
    refresh_at: u32,
    window: Isolation,
    values: Vector, // α, then the nuisances, SI
    updates: u32,
    delay_at: u32,
    order_at: u32,
}

impl OnlineIdentification {
    /// Of one motor of a model that has been checked; `dt_s`: between two updates.
    #[must_use]
    pub fn new(
        motor: &Motor,
        settings: &Settings,
        priors: &Priors,
        period_s: f64,
        dt_s: f64,
    ) -> OnlineIdentification {
        let (mut target, mut declared_order, mut known) = (None, None, Vec::new());
        if let Transmission::Elastic { law, order, parameters, .. } = &motor.transmission {
            if settings.method != Method::Bbe {
                (target, declared_order) = (Some(law.clone()), *order);
                known.clone_from(parameters);
            }
        }
        let declared = declared_order.unwrap_or(known.len());
        let slots = match &target {
            None => 2,
            Some(Law::Polynomial) if declared > 0 => declared + 1,
            Some(Law::Polynomial) => START_ORDER,
            Some(law) if law.shapes().is_empty() => 1,
            Some(law) => START_ORDER.max(1 + law.shapes().len()),
        };
        let mut made = OnlineIdentification {
            inertia: motor.inertia,
            damping: motor.damping,
            period: period_s,
            dt: dt_s,
            black_box: target.is_none(),
            choose_order: matches!(target, Some(Law::Polynomial)) && declared_order.is_none(),
            cut_off: matches!(target, Some(Law::Polynomial)) && declared > 0,
            target,
            known,
            slots,
            priors: *priors,
            // What is declared errs with the tails that noise has; further off than SURE's odds, it is contradicted.
            credible: t_quantile(TAILS, (-SURE).exp()),
            law: Linearisation::new(Law::Polynomial, 0, [0.0; PARAMETERS]),
            units: NO_UNITS,
            resolution: 0.0,
            friction: Friction::default(),
            undeclared: [0.0; SHAPES],
            kalman: None,
            reference: None,
            candidate: None,
            refresh_at: 0,
            window: Isolation::default(),
            values: [0.0; SIZE],
            updates: 0,
            delay_at: 0,
            order_at: 0,
        };
        made.reset();
        made
    }

    /// Forget what has been learned.
    pub fn reset(&mut self) {
        self.kalman = None;
        self.forget_reference();
        let law = match &self.target {
            Some(law) if law.shapes().is_empty() || !self.known.is_empty() => law.clone(),
            _ => Law::Polynomial,
        };
        let size = if law.is_polynomial() { self.slots } else { 1 + law.shapes().len() };
        let mut alpha0 = [0.0; PARAMETERS];
        let known = self.known.len().min(PARAMETERS);
        alpha0[..known].copy_from_slice(&self.known[..known]);
        self.law = Linearisation::new(law, size, alpha0);
        self.units = NO_UNITS;
        self.friction = Friction::default();
        (self.updates, self.delay_at, self.order_at) = (0, 0, self.updates_in(ORDER_S));
        self.values = [0.0; SIZE];
    }

    /// The law as it is linearised now.
    #[must_use]
    pub fn law(&self) -> &Linearisation {
        &self.law
    }

    /// Whether the law that is wanted has a shape, for which the past of φ is kept.
    #[must_use]
    pub fn is_nonlinear(&self) -> bool {
        self.target.as_ref().is_some_and(|law| !law.shapes().is_empty())
    }

    /// The law and the parameters that the model declares.
    #[must_use]
    pub fn declared(&self) -> Option<(&Law, &[f64])> {
        self.target.as_ref().filter(|_| !self.known.is_empty()).map(|law| (law, &self.known[..]))
    }

    /// The recursive estimation; `None` before the motion has revealed anything.
    #[must_use]
    pub fn kalman(&self) -> Option<&Kalman> {
        self.kalman.as_ref()
    }

    /// Whether there is something learned in good times to hold the balance against.
    #[must_use]
    pub fn has_reference(&self) -> bool {
        self.reference.is_some()
    }

    /// Equations learned from.
    #[must_use]
    pub fn updates(&self) -> u32 {
        self.updates
    }

    /// How many updates there are in a time.
    #[must_use]
    pub fn updates_in(&self, seconds: f64) -> u32 {
        (seconds / self.dt).round().max(1.0) as u32
    }

    /// α.
    #[must_use]
    pub fn alpha(&self) -> &[f64] {
        &self.values[..self.law.size]
    }

    /// Largest deflection so far, rad, behind the filter.
    #[must_use]
    pub fn largest_deflection(&self) -> f64 {
        self.units.peaks[1]
    }

    /// What the equation is divided by, N·m.
    #[must_use]
    pub fn torque_unit(&self) -> f64 {
        self.units.torque
    }

    fn nuisance(&self, place: usize) -> f64 {
        self.values[self.law.size + place]
    }

    /// d: what is left of the link encoder's delay, s.
    #[must_use]
    pub fn late(&self) -> f64 {
        self.nuisance(DELAY)
    }

    /// e: the zero between the encoders, rad.
    #[must_use]
    pub fn deflection_offset(&self) -> f64 {
        self.nuisance(DEFLECTION_OFFSET)
    }

    /// o, N·m.
    #[must_use]
    pub fn torque_offset(&self) -> f64 {
        self.nuisance(OFFSET)
    }

    /// F_c, N·m.
    #[must_use]
    pub fn coulomb_friction(&self) -> f64 {
        self.nuisance(COULOMB)
    }

    /// (B, D) as they have turned out; `None` where no such motor can be.
    #[must_use]
    pub fn motor(&self) -> Option<(f64, f64)> {
        let (inertia, damping) = (self.nuisance(INERTIA), self.nuisance(DAMPING) + self.damping);
        let contradicted = inertia.abs() > self.credible * self.priors.motor_inertia * self.inertia
            || damping * self.units.rate < -DRIVING * self.units.torque;
        (!contradicted).then_some((inertia + self.inertia, damping.max(0.0)))
    }

    // -- the equation ------------------------------------------------------------------------------

    /// B θ″ + D θ′ + x − τ, filtered, its k-th derivative: the flexibility torque from the motor side (eq 5).
    ///
    /// A position is taken as straight between samples, which costs it (ωT)²/12 of its amplitude; the torque,
    /// which is held, is given the same loss.
    fn balance(&self, signals: &Signals, k: usize) -> f64 {
        let (motor, torque) = (&signals.position.main, &signals.torque.main);
        let torque = torque[k] + self.period * self.period / 12.0 * torque[k + 2];
        self.inertia * motor[k + 2] + self.damping * motor[k + 1] + signals.effects.main[k] - torque
    }

    /// The scaled equation of this moment, (h, y); `link`: F G of q and its derivatives.
    pub fn equation(&mut self, signals: &Signals, link: &[f64; 4]) -> (Vector, f64) {
        let k = usize::from(self.black_box);
        let n = self.law.size;
        self.unscale();
        let mut row = [0.0; SIZE];
        let mut y = self.balance(signals, k) + self.law.fill_row(&signals.basis, k, &mut row);
        let motor = &signals.position.main;
        row[n + INERTIA] = -motor[k + 2];
        row[n + DAMPING] = -motor[k + 1];
        row[n + COULOMB] = -signals.friction.main[k];
        row[n + OFFSET] = if self.black_box { 0.0 } else { -1.0 };
        if !self.black_box {
            row[n + DELAY] = self.law.law.at(link[0] - motor[0], &self.values[..n]).1 * link[1];
        }
        row[n + DEFLECTION_OFFSET] = self.law.filtered_stiffness(&signals.basis, k, &self.values);
        for (entry, unit) in row.iter_mut().zip(&self.units.of) {
            *entry *= unit / self.units.torque;
        }
        y /= self.units.torque;
        let share = self.priors.coulomb_friction / self.units.torque;
        self.undeclared = self.friction.torques(signals, k).map(|torque| share * torque);
        (row, y)
    }

    /// How motor and torque move: the measure of friction that nobody declared.
    pub fn observe_motion(&mut self, signals: &Signals) {
        self.friction.see(signals, MEMORY_S / self.dt);
    }

    // -- before any equation -----------------------------------------------------------------------

    fn nuisance_std(&self) -> [f64; NUISANCES] {
        let priors = &self.priors;
        let floor = priors.viscous_damping_floor * RMS;
        let damping = priors.viscous_damping * self.damping * self.units.rate / self.units.torque + floor;
        let late = if self.black_box { 0.0 } else { 1.0 };
        [
            priors.motor_inertia,
            damping,
            late * priors.coulomb_friction * RMS,
            late * priors.torque_offset * RMS,
            late * priors.encoder_delay,
            priors.deflection_offset + self.resolution / self.units.deflection,
        ]
    }

    /// Begin with the priors, in the units seen so far.
    pub fn start(&mut self) {
        self.set_units();
        let n = self.law.size;
        let (mut mean, mut std) = ([0.0; SIZE], [0.0; SIZE]);
        for i in 0..n {
            std[i] = if i == 0 { DIFFUSE } else { SHARE };
        }
        if !self.known.is_empty() {
            let least = if self.law.is_polynomial() { KNOWN_SHARE } else { 0.0 };
            for i in 0..n {
                mean[i] = self.known.get(i).map_or(0.0, |known| known / self.units.of[i]);
                std[i] = KNOWN * mean[i].abs() + least;
            }
        }
        if self.cut_off {
            std[n - 1] = CUT_OFF;
        }
        std[n..n + NUISANCES].copy_from_slice(&self.nuisance_std());
        let memory = if self.black_box { LOCAL_MEMORY_S } else { MEMORY_S };
        let all = n + NUISANCES;
        let mut kalman = Kalman::new(&mean[..all], &std[..all], NOISE_SHARE, 1.0 + self.dt / memory);
        if !self.black_box {
            // The anchor: it separates another torque or encoder scale from another stiffness.
            kalman.keep(n + INERTIA);
        }
        self.kalman = Some(kalman);
        self.law.remember_tangent(self.units.deflection);
    }

    // -- one equation ------------------------------------------------------------------------------

    /// Learn from an equation; `noisy`: whether its innovation is one of usual times.
    pub fn learn(&mut self, h: &Vector, innovation: f64, predicted_variance: f64, noisy: bool) {
        let Some(kalman) = &mut self.kalman else { return };
        if noisy {
            kalman.learn_noise(innovation, predicted_variance);
        }
        kalman.update(h, innovation, NOISE_FLOOR, &self.undeclared);
        kalman.remember(innovation, predicted_variance);
        self.updates = self.updates.saturating_add(1);
        if self.updates % self.updates_in(OFTEN_S) == 0 {
            self.keep_regular(noisy);
        }
        if self.choose_order && self.updates >= self.order_at {
            self.order_at = self.updates + self.updates_in(ORDER_S);
            self.draw_higher_orders();
        }
    }

    /// An equation that nothing is learned from.
    pub fn pass_over(&mut self, innovation: f64, predicted_variance: f64) {
        if let Some(kalman) = &mut self.kalman {
            kalman.remember(innovation, predicted_variance);
        }
    }

    /// What rounding has done is mended; where a nuisance strains against its prior in usual times, the
    /// prior was too narrow: widen it.
    fn keep_regular(&mut self, usual: bool) {
        let Some(kalman) = &mut self.kalman else { return };
        kalman.keep_regular();
        if !usual {
            return; // what is not explained strains at everything
        }
        for i in self.law.size..self.law.size + NUISANCES {
            let ceiling = kalman.ceiling[i];
            if ceiling > 0.0 && kalman.x[i].powi(2) > RELAX * RELAX * ceiling {
                kalman.inflate(i, 4.0 * ceiling);
                for reference in [&mut self.reference, &mut self.candidate].into_iter().flatten() {
                    reference.inflate(i, 4.0 * ceiling);
                }
            }
        }
    }

    /// Draw the highest powers towards zero, down to the first one that the data want.
    ///
    /// As far as a prior does that is as wide as the power is large or uncertain: what is not significant
    /// may still be there, and matters most at large deflections. In the filter's memory it is drawn a few
    /// times.
    fn draw_higher_orders(&mut self) {
        let Some(kalman) = &mut self.kalman else { return };
        for h in (1..self.law.size).rev() {
            let square = kalman.x[h].powi(2) / kalman.sigma[h][h].max(1e-300);
            if square > ORDER_SIGMA * ORDER_SIGMA {
                break;
            }
            kalman.draw(h, square.max(1.0) * MEMORY_S / ORDER_S);
        }
    }

    /// The stiffness has changed: its scale by about a `STEP`, its shape by less.
    pub fn open_up(&mut self) {
        let Some(kalman) = &mut self.kalman else { return };
        let mut scale = [0.0; SIZE];
        for i in 0..self.law.size {
            scale[i] = if i < self.law.linear() { STEP * kalman.x[i] } else { 0.0 };
            kalman.inflate(i, (SHAPE_STEP * STEP * kalman.x[i].abs().max(SHAPE_STEP)).powi(2));
        }
        kalman.inflate_along(&scale);
    }

    /// Whether the parameters are numbers, and those of a spring that reaches as far as this one does.
    pub fn is_possible(&mut self) -> bool {
        self.unscale();
        let alpha = &self.values[..self.law.size];
        self.law.is_polynomial()
            || alpha[0] > 0.0 && self.law.law.reach(&alpha[1..]) >= 0.5 * self.units.deflection
    }

    // -- the link encoder's delay ------------------------------------------------------------------

    /// How many periods later than assumed the link is, where that has become clear.
    pub fn take_delay(&mut self) -> Option<f64> {
        let wait = self.updates_in(DELAY_S);
        let kalman = self.kalman.as_ref()?;
        if self.black_box || self.updates < self.delay_at + wait {
            return None;
        }
        let place = self.law.size + DELAY;
        let (late, std) = (kalman.x[place], kalman.sigma[place][place].max(0.0).sqrt());
        if late.abs() < DELAY_PERIODS || late.abs() < 3.0 * std {
            return None;
        }
        self.delay_at = self.updates;
        Some(late)
    }

    /// The channels have been aligned by so much more.
    pub fn shift_delay(&mut self, periods: f64) {
        let place = self.law.size + DELAY;
        for kalman in [&mut self.kalman, &mut self.reference, &mut self.candidate].into_iter().flatten() {
            kalman.x[place] -= periods;
        }
        self.window.clear();
        self.values[place] -= periods * self.period;
    }

    // -- what it says ------------------------------------------------------------------------------

    /// All parameters in SI, for what is read off until the next update.
    pub fn conclude(&mut self) {
        self.unscale();
    }

    /// Standard deviation of σ at φ, from the covariance of α, of the delay and the offset, from friction that nobody
    /// declared, and of φ.
    #[must_use]
    pub fn stiffness_std(&self, phi: f64, link_rate: f64, phi_variance: f64) -> f64 {
        let (n, mut row) = (self.law.size, [0.0; SIZE]);
        let slope = self.law.law.stiffness_slopes(phi, &self.values[..n], &mut row[..n]);
        (row[n + DELAY], row[n + DEFLECTION_OFFSET]) = (slope * link_rate, slope);
        (self.variance_of(row) + self.considered_variance(row) + slope * slope * phi_variance).sqrt()
    }

    /// Variance of f at a φ that is known but for its offset, from the covariance of α and of that.
    #[must_use]
    pub fn torque_variance(&self, phi: f64) -> f64 {
        let (n, mut row) = (self.law.size, [0.0; SIZE]);
        self.law.law.jacobian(phi, &self.values[..n], &mut row[..n]);
        row[n + DEFLECTION_OFFSET] = self.law.law.at(phi, &self.values[..n]).1;
        self.variance_of(row)
    }

    fn scaled(&self, mut slopes: Vector) -> Vector {
        slopes.iter_mut().zip(&self.units.of).for_each(|(slope, unit)| *slope *= unit);
        slopes
    }

    /// What friction that nobody declared adds to the variance of what has these slopes by the parameters.
    fn considered_variance(&self, slopes: Vector) -> f64 {
        let Some(kalman) = &self.kalman else { return f64::NAN };
        kalman.considered_variance(&self.scaled(slopes))
    }

    /// Variance of what has these slopes by the parameters; NaN before there are any.
    fn variance_of(&self, slopes: Vector) -> f64 {
        let Some(kalman) = &self.kalman else { return f64::NAN };
        let slopes = self.scaled(slopes);
        let sandwich = dot(&slopes, &times(&kalman.sigma, &slopes));
        let honest = UNSEEN * UNSEEN * kalman.variance_over_scale() * sandwich;
        honest.max(LEAST_VARIANCE * dot(&slopes, &times(&kalman.p, &slopes))).max(0.0)
    }

    /// The law's parameters with their standard deviations; `None` before any, or without a law.
    pub fn parameters(&self, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        let kalman = self.kalman.as_ref().filter(|_| !self.black_box)?;
        for i in 0..self.law.size {
            values.push(self.values[i]);
            let mut slopes = [0.0; SIZE];
            slopes[i] = 1.0;
            let variance = UNSEEN * UNSEEN * kalman.variance_over_scale() * kalman.sigma[i][i].max(0.0);
            std.push((variance + kalman.considered_variance(&slopes)).sqrt() * self.units.of[i]);
        }
        Some(&self.law.law)
    }
}
