//! One motor and its transmission on line: the balance as one linear equation an update, and what it tells.
//!
//! ```text
//! B F[θ″] + D F[θ′] + F[x] − F[τ]                                                              (eq 5)
//!     = F[f(φ, α)] − ΔB F[θ″] − ΔD F[θ′] − F_c F[s] − o + F[σ (d q′ + e)] + noise
//! ```
//! F is the filter that all channels share (its delay is common and cancels), B and D are declared, x are
//! the declared effects, and α, ΔB, ΔD, the Coulomb friction F_c, the offset o, the delay d of the link
//! encoder and its offset e to the motor's are estimated together. The torque's own scale is the anchor:
//! nothing on the motor side can tell it. Black-box estimation is the derivative of the same equation, with
//! a local σ instead of f.

use crate::deflection::{DeflectionFilter, Tuning};
use crate::effects::{Coordinates, MotorEffects};
use crate::filters::StateVariableFilter;
use crate::handover::polynomial_to_law;
use crate::kalman::{Kalman, Matrix, NUISANCES, SIZE, Vector, dot, times};
use crate::laws::{Alpha, Law, PARAMETERS, powers};
use crate::model::{Motor, Transmission};
use crate::monitor::Monitor;
use crate::sample::TransmissionEstimate;
use crate::settings::{Method, Priors, Settings};

const COLUMNS: usize = PARAMETERS + 1; // basis channels: the last one carries φ², or ∂g/∂φ

const LIGHT_RATIO: f64 = 5.0; // bandwidth of the light filter over that of the main one
const MEMORY_S: f64 = 20.0; // of the regression; a sudden change is for the alarm to find
const LOCAL_MEMORY_S: f64 = 2.0; // of the black box, whose model holds only locally
const START_ORDER: usize = 3; // polynomial that an unknown curve starts from
const STEP: f64 = 0.3; // how much a stiffness may change at an alarm, relative
const SHAPE_STEP: f64 = 0.1; // … and its shape, of that
const ORDER_S: f64 = 5.0; // of updates between looks at the polynomial's highest powers
const OFTEN_S: f64 = 0.5; // of updates between two looks at what rounding has done
const DUE_S: f64 = 0.1; // of updates between two looks at a nonlinear law's linearisation
const ORDER_SIGMA: f64 = 3.0; // from which on a power of the polynomial is there
const OFF_TANGENT: f64 = 0.3; // standard deviations that a law's curve leaves its tangent by, at most
const DELAY_S: f64 = 0.5; // of updates between two alignments of late channels
const DELAY_PERIODS: f64 = 0.05; // no smaller delay is worth one
const USEFUL: f64 = 0.25; // relative standard deviation of the stiffness up to which it is of use
const DRIFT: f64 = 1e-4; // relative growth of the standard deviation per second held
const RESTED_S: f64 = 0.05; // without motion: from then on the interval grows …
const WIDEST: f64 = 0.02; // … up to this
const ASTRAY_S: f64 = 1.0; // of updates with parameters that cannot be, after which it starts anew
const VARIES_S: f64 = 2.0; // over which the balance's variance is taken: a constant torque tells nothing …
const VARIED_S: f64 = 30.0; // … and how long a lively phase is remembered
const QUIET: f64 = 0.25; // of the liveliest variance: the least that misses are held against
const EXPLAINED_S: f64 = 0.3; // over which the curve is held against the balance
const UNEXPLAINED: f64 = 0.04; // share of that variance that the curve may miss …
const UNEXPLAINED_LOCAL: f64 = 0.5; // … and the black box, which sees the derivative of both
const FIRST_S: f64 = 0.12; // of updates that are not held against a curve which has only begun
const BEYOND: f64 = 1.5; // times the largest deflection behind the filter: no more is known of the curve
const CREDIBLE: f64 = 8.0; // prior standard deviations of B beyond which the motor is another one
const DRIVING: f64 = 0.05; // of the largest torque: no damping drives its motor by more
const EDGE: f64 = 0.98; // of where a law ends
const NOISE_FLOOR: f64 = 1e-10; // variance, of the torque's square, below which no noise is believed
const NOISE_SHARE: f64 = 0.01; // noise assumed at the start, as a share of the torque
const DIFFUSE: f64 = 30.0; // prior std of the linear coefficient: in units of torque per deflection
const SHARE: f64 = 2.0; // prior std of a higher power: its share of the torque at the largest deflection
const CUT_OFF: f64 = 0.003; // … of the first power that a declared order leaves out
const KNOWN: f64 = 0.3; // relative prior std of parameters that the model gives
const KNOWN_SHARE: f64 = 0.02; // … and, of a power, of the torque at the largest deflection
const REOPENED: f64 = 0.1; // std of a deflection's offset after an encoder has moved its zero
const RELAX: f64 = 2.5; // a nuisance this many prior std off: the prior was too narrow
const RMS: f64 = 0.5; // of a torque over its largest value, in usual motion
const GROWN: f64 = 1.5; // peaks over units, from which on the units are outgrown
const FRICTION_SPEEDS: f64 = 0.02; // of the largest velocity: over which Coulomb friction changes its sign
const LEAST_SPEED: f64 = 1e-12; // rad/s
const TINY: f64 = 1e-12;
const LEAST_VARIANCE: f64 = 0.02; // however the noise is coloured, it leaves so much of what white would
// Errors that are in no covariance: noise in h, its linearisation, what aligns the channels. Measured as the
// error over its standard deviation without this, on 86 simulated joints that took no part in anything else.
const UNSEEN: f64 = 1.3;
const POINTS: usize = 16; // deflections that a nonlinear law is linearised anew over
const LOOKED_AT: [f64; 2] = [0.4, 0.9]; // of the largest deflection: where a curve is held against its tangent
const RIDGE: f64 = 1e-12; // relative, in the normal equations of that …
const STEPS: usize = 3; // … and Gauss-Newton steps for that
const PAST_DELAYS: f64 = 5.5; // filter delays that a nonlinear basis is recomputed over
const HANDED_OVER: f64 = 3.0; // by which the covariance of parameters grows that a polynomial has told

// Places of the nuisances behind α.
const INERTIA: usize = 0;
const DAMPING: usize = 1;
const COULOMB: usize = 2;
const OFFSET: usize = 3;
const DELAY: usize = 4;
const SHIFT: usize = 5;

/// The two filters that every channel passes, F G.
#[derive(Clone, Copy, Debug)]
pub struct Filters {
    /// G: light, exact for what each channel is; what is nonlinear in velocities is formed behind it.
    pub light: StateVariableFilter<3>,
    /// F: the regression's bandwidth; alike for every channel, so what the two do to the signals cancels.
    pub main: StateVariableFilter<4>,
    /// Delay of a slow signal through both, s.
    pub delay: f64,
}

impl Filters {
    /// For the bandwidth of the regression.
    #[must_use]
    pub fn new(bandwidth_rad_s: f64, period_s: f64) -> Filters {
        let main = StateVariableFilter::<4>::new(bandwidth_rad_s.min(0.25 / period_s), period_s);
        let light = StateVariableFilter::<3>::new(LIGHT_RATIO * main.bandwidth, period_s);
        Filters { light, main, delay: 3.0 / light.bandwidth + 4.0 / main.bandwidth }
    }

    /// √Σh² of the first derivative behind both filters: the noise of a rate over that of a position.
    #[must_use]
    pub fn rate_gain(&self, period_s: f64) -> f64 {
        let (mut channel, mut square) = (Channel::rest(0.0), 0.0);
        for k in 0..(12.0 * self.delay / period_s).ceil() as usize {
            channel.smooth(self, if k == 0 { 1.0 } else { 0.0 });
            square += channel.main[1] * channel.main[1];
        }
        square.sqrt()
    }
}

/// A measured signal: its values behind G and behind F G, with their derivatives.
#[derive(Clone, Copy, Debug)]
pub struct Channel {
    light: [f64; 3],
    /// F G of the signal and its derivatives.
    pub main: [f64; 4],
    last: f64,
}

impl Channel {
    /// As if this input had been there for ever.
    #[must_use]
    pub fn rest(value: f64) -> Channel {
        Channel { light: [value, 0.0, 0.0], main: [value, 0.0, 0.0, 0.0], last: value }
    }

    /// One period of a signal that is straight between samples.
    #[inline]
    pub fn smooth(&mut self, filters: &Filters, now: f64) {
        let before = self.light[0];
        filters.light.smooth.apply(&mut self.light, self.last, now);
        filters.main.smooth.apply(&mut self.main, before, self.light[0]);
        self.last = now;
    }

    /// One period of a signal that is held between samples.
    #[inline]
    fn held(&mut self, filters: &Filters, now: f64) {
        let before = self.light[0];
        filters.light.held.apply(&mut self.light, self.last, now);
        filters.main.smooth.apply(&mut self.main, before, self.light[0]);
        self.last = now;
    }
}

/// A signal that is formed from lightly filtered ones, and passes F alone.
#[derive(Clone, Copy, Debug, Default)]
struct Formed {
    main: [f64; 4],
    last: f64,
}

impl Formed {
    fn pass(&mut self, filters: &Filters, now: f64) {
        filters.main.smooth.apply(&mut self.main, self.last, now);
        self.last = now;
    }
}

/// Does the motion at hand tell the stiffness? From the rate of the deflection, filtered, over its noise.
///
/// The noise of the filtered rate follows from that of the positions; the largest of late counts, as a
/// quantised position at rest has none.
#[derive(Clone, Copy, Debug, Default)]
struct Excitation {
    noise: f64,
    square: f64,
    peak: f64,
}

impl Excitation {
    const WINDOW_S: f64 = 0.3; // over which the rate's mean square is taken
    const NOISE_MARGIN: f64 = 5.0;
    const SHARE: f64 = 0.02; // of the largest rate seen: what is slower teaches next to nothing
    const PEAK_S: f64 = 60.0; // how long the largest rate is remembered

    fn update(&mut self, rate: f64, noise: f64, usable: bool, dt: f64) -> bool {
        if !usable {
            self.square = 0.0;
            return false;
        }
        let fade = (-dt / Self::PEAK_S).exp();
        self.square += (dt / Self::WINDOW_S).min(1.0) * (rate * rate - self.square);
        let rms = self.square.sqrt();
        self.peak = (fade * self.peak).max(rms);
        self.noise = (fade * self.noise).max(noise);
        rms > Self::NOISE_MARGIN * self.noise && rms > Self::SHARE * self.peak && rms > 0.0
    }
}

/// What a track learns from at one update, beside its own channels.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// F G of q and its derivatives.
    pub link: [f64; 4],
    /// Whether the filters hold nothing wrong.
    pub usable: bool,
    /// Variance of θ's and of q's noise, rad².
    pub noise: [f64; 2],
}

/// Estimation of one transmission (or of a rigid one's torque); the joint feeds it every tick.
#[derive(Clone, Debug)]
pub struct Track {
    // Declared.
    inertia: f64,
    damping: f64,
    period: f64,
    dt: f64,
    rigid: bool,
    black_box: bool,
    target: Option<Law>,
    known: Vec<f64>,
    slots: usize,
    choose_order: bool,
    cut_off: bool,
    effects: MotorEffects,
    priors: Priors,
    rate_gain: f64,
    // Channels.
    position: Channel,
    torque: Channel,
    basis: [Channel; COLUMNS],
    friction: Formed,
    formed: Formed,
    past: Vec<f64>, // deflections of the last ticks, a ring
    newest: usize,
    filled: usize,
    speed: f64,
    /// x_motor − x_transmission, the latest that is known, N·m.
    pub effect: f64,
    /// The deflection of this moment.
    pub deflection: DeflectionFilter,
    // Units of the equation.
    peaks: [f64; 3], // torque, deflection, velocity
    torque_unit: f64,
    deflection_unit: f64,
    rate_unit: f64,
    units: Vector,
    resolution: f64,
    // Estimation.
    law: Law, // that the basis channels carry
    size: usize,
    alpha0: Alpha, // where a nonlinear law is linearised
    tangent: [(f64, f64, Alpha); LOOKED_AT.len()],
    kalman: Option<Kalman>,
    monitor: Monitor,
    excitation: Excitation,
    excited: bool,
    updates: u32,
    delay_at: u32,
    order_at: u32,
    impossible: u32,
    missing: u32,
    mean: f64,
    varies: f64,
    varied: f64,
    missed: f64,
    misfit: f64,
    // What is published.
    values: Vector, // α, then the nuisances, SI
    told: bool,
    std: f64,
    reach: f64,
    held_s: f64,
    trusted: bool,
    lead: f64,
    acting: f64,
    stiffness: f64,
    unmodelled: f64,
    inertia_now: f64,
    damping_now: f64,
}

impl Track {
    /// Of one motor of a model that has been checked; `dt_s`: between two updates.
    #[must_use]
    pub fn new(
        motor: &Motor,
        effects: MotorEffects,
        settings: &Settings,
        priors: &Priors,
        filters: &Filters,
        period_s: f64,
        dt_s: f64,
    ) -> Track {
        let (mut target, mut declared_order, mut known) = (None, None, Vec::new());
        if let Transmission::Elastic { law, order, parameters } = &motor.transmission {
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
        let past = (PAST_DELAYS * filters.delay / period_s).ceil() as usize;
        let bandwidth = filters.main.bandwidth;
        let mut track = Track {
            inertia: motor.inertia,
            damping: motor.damping,
            period: period_s,
            dt: dt_s,
            rigid: !motor.flexible(),
            black_box: target.is_none(),
            choose_order: matches!(target, Some(Law::Polynomial)) && declared_order.is_none(),
            cut_off: matches!(target, Some(Law::Polynomial)) && declared > 0,
            past: vec![
                0.0;
                if target.as_ref().is_some_and(|law| !law.shapes().is_empty()) { past } else { 0 }
            ],
            target,
            known,
            slots,
            effects,
            priors: *priors,
            rate_gain: filters.rate_gain(period_s),
            position: Channel::rest(0.0),
            torque: Channel::rest(0.0),
            basis: [Channel::rest(0.0); COLUMNS],
            friction: Formed::default(),
            formed: Formed::default(),
            newest: 0,
            filled: 0,
            speed: LEAST_SPEED,
            effect: 0.0,
            deflection: DeflectionFilter::new(motor.inertia, motor.damping, bandwidth, period_s, dt_s / 2.0),
            peaks: [0.0; 3],
            torque_unit: 0.0,
            deflection_unit: 0.0,
            rate_unit: 0.0,
            units: [1.0; SIZE],
            resolution: 0.0,
            law: Law::Polynomial,
            size: 0,
            alpha0: [0.0; PARAMETERS],
            tangent: [(0.0, 0.0, [0.0; PARAMETERS]); LOOKED_AT.len()],
            kalman: None,
            monitor: Monitor::new(settings.false_alarms_per_hour, dt_s, filters.delay),
            excitation: Excitation::default(),
            excited: false,
            updates: 0,
            delay_at: 0,
            order_at: 0,
            impossible: 0,
            missing: 0,
            mean: 0.0,
            varies: 0.0,
            varied: 0.0,
            missed: 0.0,
            misfit: f64::NAN,
            values: [0.0; SIZE],
            told: false,
            std: f64::NAN,
            reach: 0.0,
            held_s: 0.0,
            trusted: false,
            lead: f64::NAN,
            acting: 0.0,
            stiffness: 0.0,
            unmodelled: f64::INFINITY,
            inertia_now: motor.inertia,
            damping_now: motor.damping,
        };
        track.reset();
        track
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.effects.motor.reset();
        self.effects.transmission.reset();
        self.deflection.reset();
        self.excitation = Excitation::default();
        (self.speed, self.effect, self.formed) = (LEAST_SPEED, 0.0, Formed::default());
        (self.lead, self.misfit) = (f64::NAN, f64::NAN);
        self.relearn();
    }

    /// Forget what has been learned of the transmission.
    pub fn relearn(&mut self) {
        self.kalman = None;
        self.law = match &self.target {
            Some(law) if law.shapes().is_empty() || !self.known.is_empty() => law.clone(),
            _ => Law::Polynomial,
        };
        self.size = if self.law.is_polynomial() { self.slots } else { 1 + self.law.shapes().len() };
        self.alpha0 = [0.0; PARAMETERS];
        let known = self.known.len().min(PARAMETERS);
        self.alpha0[..known].copy_from_slice(&self.known[..known]);
        self.peaks = [0.0; 3];
        (self.torque_unit, self.deflection_unit, self.rate_unit) = (0.0, 0.0, 0.0);
        self.monitor.reset();
        (self.updates, self.delay_at, self.order_at) = (0, 0, self.updates_in(ORDER_S));
        (self.impossible, self.missing) = (0, 0);
        (self.mean, self.varies, self.varied, self.missed) = (0.0, 0.0, 0.0, 0.0);
        (self.told, self.std, self.reach, self.held_s, self.trusted) = (false, f64::NAN, 0.0, 0.0, false);
        self.values = [0.0; SIZE];
        (self.acting, self.stiffness, self.unmodelled) = (0.0, 0.0, f64::INFINITY);
        (self.inertia_now, self.damping_now) = (self.inertia, self.damping);
    }

    /// Filters at rest where the joint is now; what has been learned is kept.
    pub fn restart(&mut self, theta: f64, phi: f64, torque: f64) {
        self.position = Channel::rest(theta);
        self.torque = Channel::rest(torque);
        self.friction = Formed::default();
        self.formed = Formed::default();
        self.filled = 0;
        if self.rigid {
            return;
        }
        let mut columns = [0.0; COLUMNS];
        self.columns(phi, &mut columns);
        for (channel, value) in self.basis.iter_mut().zip(columns) {
            *channel = Channel::rest(value);
        }
        self.deflection.restart(theta, phi);
    }

    /// Whether its transmission is rigid.
    #[must_use]
    pub fn is_rigid(&self) -> bool {
        self.rigid
    }

    /// Whether the joint has changed and is being followed.
    #[must_use]
    pub fn changed(&self) -> bool {
        self.monitor.changed()
    }

    /// Whether the motion at hand tells the stiffness.
    #[must_use]
    pub fn excited(&self) -> bool {
        self.excited
    }

    /// What the model left unexplained at the last update, N·m.
    #[must_use]
    pub fn misfit(&self) -> f64 {
        self.misfit
    }

    fn updates_in(&self, seconds: f64) -> u32 {
        (seconds / self.dt).round().max(1.0) as u32
    }

    // -- every tick --------------------------------------------------------------------------------

    /// One period: the deflection of this moment, and every channel through the filters.
    ///
    /// `before`: the torque that has acted over the period; `link`: lightly filtered q and q′.
    pub fn feed(&mut self, filters: &Filters, theta: f64, phi: f64, torque: f64, before: f64, usable: bool) {
        if !self.rigid {
            self.deflection.update(theta, phi, before + self.acting - self.effect);
            if !self.past.is_empty() {
                self.newest = (self.newest + 1) % self.past.len();
                self.past[self.newest] = phi;
                self.filled = (self.filled + 1).min(self.past.len());
            }
            let mut columns = [0.0; COLUMNS];
            self.columns(phi, &mut columns);
            for i in 0..self.slots {
                self.basis[i].smooth(filters, columns[i]);
            }
            self.basis[PARAMETERS].smooth(filters, columns[PARAMETERS]);
        }
        self.position.smooth(filters, theta);
        self.torque.held(filters, torque);
        let rate = self.position.light[1];
        if usable {
            self.speed = self.speed.max(rate.abs());
        }
        self.friction.pass(filters, (rate / (FRICTION_SPEEDS * self.speed)).tanh());
    }

    /// x_motor − x_transmission of the declared effects, from lightly filtered values of q and of the motor.
    pub fn feed_effects(&mut self, filters: &Filters, link: &Channel, time: f64) {
        if self.effects.is_empty() {
            return;
        }
        let phi = link.light[0] - self.position.light[0];
        let (flexibility_torque, stiffness) = self.curve(phi);
        let c = Coordinates {
            position: self.position.light[0] - self.effects.offset,
            velocity: self.position.light[1],
            acceleration: self.position.light[2],
            deflection: phi,
            deflection_rate: link.light[1] - self.position.light[1],
            flexibility_torque,
            stiffness,
            torque: self.torque.light[0],
            time,
            ..Coordinates::default()
        };
        self.effect = self.effects.balance(&c, self.period);
        self.formed.pass(filters, self.effect);
    }

    /// (τ_e, σ) at a deflection as it is measured; zeros before anything is known.
    fn curve(&self, phi: f64) -> (f64, f64) {
        match &self.target {
            _ if self.told => self.law.at(phi + self.values[self.size + SHIFT], &self.values[..self.size]),
            Some(law) if !self.known.is_empty() => law.at(phi, &self.known),
            _ => (0.0, 0.0),
        }
    }

    /// What the basis channels take in at a deflection: the slopes of f by α, and that of g by φ (or φ²).
    fn columns(&self, phi: f64, out: &mut [f64; COLUMNS]) {
        if self.law.is_polynomial() {
            powers(phi, &mut out[..self.slots]);
            out[PARAMETERS] = phi * phi;
            return;
        }
        let mut alpha = self.alpha0;
        alpha[0] = 1.0;
        self.law.jacobian(phi, &alpha[..self.size], &mut out[..self.size]);
        out[PARAMETERS] = self.law.at(phi, &alpha[..self.size]).1;
    }

    // -- the equation ------------------------------------------------------------------------------

    /// B θ″ + D θ′ + x − τ, filtered, its k-th derivative: the flexibility torque as the motor tells it (eq 5).
    ///
    /// A position is taken as straight between samples, which costs it (ωT)²/12 of its amplitude; the torque,
    /// which is held, is given the same loss.
    fn balance(&self, k: usize) -> f64 {
        let (motor, torque) = (&self.position.main, &self.torque.main);
        let torque = torque[k] + self.period * self.period / 12.0 * torque[k + 2];
        self.inertia * motor[k + 2] + self.damping * motor[k + 1] + self.formed.main[k] - torque
    }

    /// The scaled equation of this moment, (h, y).
    fn equation(&mut self, link: &[f64; 4]) -> (Vector, f64) {
        let k = usize::from(self.black_box);
        let n = self.size;
        self.unscale();
        let mut row = [0.0; SIZE];
        let mut y = self.balance(k);
        for i in 0..n {
            row[i] = self.basis[i].main[k];
        }
        if !self.law.is_polynomial() {
            // f ≈ k g + k0 (c − c0) ∂g/∂c: y is referred to the point of linearisation.
            for i in 1..n {
                row[i] *= self.alpha0[0];
                y += row[i] * self.alpha0[i];
            }
        }
        let motor = &self.position.main;
        row[n + INERTIA] = -motor[k + 2];
        row[n + DAMPING] = -motor[k + 1];
        row[n + COULOMB] = -self.friction.main[k];
        row[n + OFFSET] = if self.black_box { 0.0 } else { -1.0 };
        if !self.black_box {
            row[n + DELAY] = self.law.at(link[0] - motor[0], &self.values[..n]).1 * link[1];
        }
        row[n + SHIFT] = self.filtered_stiffness(k);
        for (entry, unit) in row.iter_mut().zip(&self.units) {
            *entry *= unit / self.torque_unit;
        }
        (row, y / self.torque_unit)
    }

    /// F[σ] (or its derivative) from the channel of φ², or of ∂g/∂φ.
    fn filtered_stiffness(&self, k: usize) -> f64 {
        let last = &self.basis[PARAMETERS].main;
        if !self.law.is_polynomial() {
            return self.values[0] * last[k];
        }
        if self.black_box {
            return 3.0 * self.values[1] * last[k];
        }
        let (mut sum, mut power) = (0.0, 1.0);
        for h in 0..self.size {
            sum += (2 * h + 1) as f64 * self.values[h] * power;
            power *= last[0];
        }
        sum
    }

    /// Follow the largest torque, deflection and velocity; change units when they have outgrown them.
    fn observe_scale(&mut self, link: &[f64; 4]) -> bool {
        let k = usize::from(self.black_box);
        let motor = &self.position.main;
        let inertial = self.inertia * motor[k + 2].abs();
        let torque = self.balance(k).abs().max(inertial).max(self.torque.main[k].abs());
        let now = [torque, (link[k] - motor[k]).abs(), motor[k + 1].abs()];
        for (peak, now) in self.peaks.iter_mut().zip(now) {
            *peak = peak.max(now);
        }
        let units = [self.torque_unit, self.deflection_unit, self.rate_unit];
        let outgrown = self.peaks.iter().zip(units).any(|(peak, unit)| *peak > GROWN * unit);
        if self.kalman.is_none() || !outgrown {
            return false;
        }
        self.change_units();
        true
    }

    fn set_units(&mut self) {
        let [torque, deflection, rate] = self.peaks.map(|peak| peak.max(TINY));
        (self.torque_unit, self.deflection_unit, self.rate_unit) = (torque, deflection, rate);
        self.make_units();
    }

    fn make_units(&mut self) {
        let (torque, deflection, n) = (self.torque_unit, self.deflection_unit, self.size);
        self.units = [1.0; SIZE];
        if self.law.is_polynomial() {
            for h in 0..n {
                self.units[h] = torque / deflection.powi(2 * h as i32 + 1);
            }
        } else if self.alpha0[0] == 0.0 {
            self.units[0] = torque / self.law.at(deflection, &[1.0]).0.abs().max(1e-300);
        } else {
            for i in 0..n {
                self.units[i] = self.alpha0[i].abs();
            }
        }
        let nuisances = [self.inertia, torque / self.rate_unit, torque, torque, self.period, deflection];
        self.units[n..n + NUISANCES].copy_from_slice(&nuisances);
    }

    fn change_units(&mut self) {
        let (old_units, old_torque, old_std) = (self.units, self.torque_unit, self.nuisance_std());
        self.set_units();
        let n = self.size;
        let mut ratio = [1.0; SIZE];
        for i in 0..n + NUISANCES {
            ratio[i] = old_units[i] / self.units[i];
        }
        let new_std = self.nuisance_std();
        let noise = old_torque / self.torque_unit;
        let Some(kalman) = &mut self.kalman else { return };
        kalman.rescale(&ratio, noise);
        for i in 0..NUISANCES {
            kalman.inflate(n + i, (new_std[i].powi(2) - (old_std[i] * ratio[n + i]).powi(2)).max(0.0));
        }
        // The cut-off's prior, which was a share of the torque at the deflection reached then, is one of now.
        let (power, most) = (n - 1, CUT_OFF * CUT_OFF);
        let variance = kalman.p[power][power];
        if self.cut_off && variance > most {
            kalman.ceiling[power] = most;
            kalman.draw(power, most / variance);
        }
        self.remember_tangent();
    }

    fn nuisance_std(&self) -> [f64; NUISANCES] {
        let priors = &self.priors;
        let floor = priors.viscous_damping_floor * RMS;
        let damping = priors.viscous_damping * self.damping * self.rate_unit / self.torque_unit + floor;
        let late = if self.black_box { 0.0 } else { 1.0 };
        [
            priors.motor_inertia,
            damping,
            late * priors.coulomb_friction * RMS,
            late * priors.torque_offset * RMS,
            late * priors.encoder_delay,
            priors.deflection_offset + self.resolution / self.deflection_unit,
        ]
    }

    /// Begin with the priors, in the units seen so far.
    fn start(&mut self) {
        self.set_units();
        let n = self.size;
        let (mut mean, mut std) = ([0.0; SIZE], [0.0; SIZE]);
        for i in 0..n {
            std[i] = if i == 0 { DIFFUSE } else { SHARE };
        }
        if !self.known.is_empty() {
            let least = if self.law.is_polynomial() { KNOWN_SHARE } else { 0.0 };
            for i in 0..n {
                mean[i] = self.known.get(i).map_or(0.0, |known| known / self.units[i]);
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
            // The anchor: what tells another torque or encoder scale from another stiffness.
            kalman.keep(n + INERTIA);
        }
        self.kalman = Some(kalman);
        self.remember_tangent();
    }

    /// α and the nuisances in SI, the shape where it can be.
    fn unscale(&mut self) {
        let Some(kalman) = &self.kalman else { return };
        for i in 0..kalman.size() {
            self.values[i] = kalman.x[i] * self.units[i];
        }
        bound(&self.law, &mut self.values);
    }

    // -- one update --------------------------------------------------------------------------------

    /// Everything that is learned from the filtered signals of this moment.
    ///
    /// Returns whether the estimate has long been where it cannot be and has begun anew.
    pub fn update(&mut self, filters: &Filters, now: &Moment) -> bool {
        let motor = self.position.main;
        self.resolution = (now.noise[0] + now.noise[1]).sqrt();
        let noise = self.rate_gain * self.resolution;
        self.excited = self.excitation.update(now.link[1] - motor[1], noise, now.usable, self.dt);
        let mut astray = false;
        if self.kalman.is_none() && now.usable {
            self.observe_scale(&now.link);
            if self.excited {
                self.start();
            }
        }
        if self.kalman.is_some() {
            if now.usable {
                self.observe_scale(&now.link);
            }
            self.learn(now);
            astray = self.is_astray();
            if astray {
                self.relearn();
            }
        }
        if now.usable {
            self.deflection.tune(&Tuning {
                jerk: now.link[3] - motor[3],
                motor_noise: now.noise[0],
                link_noise: now.noise[1],
                inertia: self.inertia_now,
                damping: self.damping_now,
                stiffness: self.stiffness,
                unmodelled: self.unmodelled,
            });
        }
        if self.kalman.is_some() {
            if now.usable {
                self.hand_over(filters);
            }
            self.publish();
        }
        astray
    }

    /// One equation: the test of its innovation, the noise, the parameters.
    fn learn(&mut self, now: &Moment) {
        let (h, y) = self.equation(&now.link);
        let (telling, first) = (now.usable && self.excited, self.updates_in(FIRST_S));
        let Some(kalman) = &mut self.kalman else { return };
        let innovation = kalman.innovation(&h, y);
        let spread = kalman.spread(&h);
        self.misfit = innovation * self.torque_unit;
        self.held_s += self.dt;
        if now.usable && self.updates >= first {
            let share = (self.dt / VARIES_S).min(1.0);
            self.mean += share * (y - self.mean);
            self.varies += share * ((y - self.mean).powi(2) - self.varies);
            self.varied = (self.varied * (1.0 - self.dt / VARIED_S)).max(self.varies);
            self.missed += (self.dt / EXPLAINED_S).min(1.0) * (innovation * innovation - self.missed);
        }
        let settled = self.updates >= (1.0 / self.dt) as u32;
        if now.usable {
            if self.monitor.watch(innovation, spread, kalman.noise, settled) {
                self.open_up();
            }
        } else {
            self.monitor.pause();
        }
        let Some(kalman) = &mut self.kalman else { return };
        if telling && self.monitor.may_learn() {
            self.held_s = 0.0;
            if self.monitor.may_learn_noise() {
                kalman.learn_noise(innovation, spread);
            }
            kalman.update(&h, innovation, NOISE_FLOOR);
            kalman.remember(innovation, spread);
            self.updates = self.updates.saturating_add(1);
            if self.updates % self.updates_in(OFTEN_S) == 0 {
                self.relax();
            }
            if self.choose_order && self.updates >= self.order_at {
                self.order_at = self.updates + self.updates_in(ORDER_S);
                self.draw_higher_orders();
            }
        } else {
            kalman.remember(innovation, spread);
        }
    }

    /// Where a nuisance strains against its prior, the prior was too narrow: widen it.
    fn relax(&mut self) {
        let Some(kalman) = &mut self.kalman else { return };
        kalman.keep_regular();
        for i in self.size..self.size + NUISANCES {
            let ceiling = kalman.ceiling[i];
            if ceiling > 0.0 && kalman.x[i].powi(2) > RELAX * RELAX * ceiling {
                kalman.inflate(i, 4.0 * ceiling);
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
        for h in (1..self.size).rev() {
            let square = kalman.x[h].powi(2) / kalman.sigma[h][h].max(1e-300);
            if square > ORDER_SIGMA * ORDER_SIGMA {
                break;
            }
            kalman.draw(h, square.max(1.0) * MEMORY_S / ORDER_S);
        }
    }

    /// The stiffness has changed: its scale by about a `STEP`, its shape by less.
    fn open_up(&mut self) {
        let Some(kalman) = &mut self.kalman else { return };
        let mut scale = [0.0; SIZE];
        for i in 0..self.size {
            scale[i] = STEP * kalman.x[i];
            kalman.inflate(i, (SHAPE_STEP * STEP * kalman.x[i].abs().max(SHAPE_STEP)).powi(2));
        }
        kalman.inflate_along(&scale);
    }

    /// An encoder has moved its zero: the deflection's offset is not what it was to the last digit.
    pub fn reopen_shift(&mut self) {
        let place = self.size + SHIFT;
        if let Some(kalman) = &mut self.kalman {
            kalman.inflate(place, REOPENED * REOPENED);
        }
    }

    /// Whether the curve leaves only a part of the balance unexplained.
    fn explains(&self) -> bool {
        let share = if self.black_box { UNEXPLAINED_LOCAL } else { UNEXPLAINED };
        self.missed <= share * self.varies.max(QUIET * self.varied)
    }

    /// Whether the estimate has long been where it cannot be: no way back by small steps.
    fn is_astray(&mut self) -> bool {
        let Some(kalman) = &self.kalman else { return false };
        let long = self.updates_in(ASTRAY_S);
        if !kalman.is_finite() {
            return true;
        }
        self.unscale();
        let alpha = &self.values[..self.size];
        let impossible = !self.law.is_polynomial()
            && (alpha[0] <= 0.0 || self.law.reach(&alpha[1..]) < 0.5 * self.deflection_unit);
        self.impossible = if impossible { self.impossible + 1 } else { 0 };
        if self.explains() {
            self.missing = 0;
        } else if self.excited && self.monitor.may_learn_noise() {
            self.missing += 1;
        }
        self.impossible > long || self.missing > long
    }

    /// What the ticks until the next update say, and how sure it is.
    fn publish(&mut self) {
        let Some(kalman) = &self.kalman else { return };
        let noise = kalman.noise.sqrt() * self.torque_unit;
        self.unscale();
        self.told = true;
        let n = self.size;
        let (inertia, damping) = (self.values[n + INERTIA], self.values[n + DAMPING] + self.damping);
        let contradicted = inertia.abs() > CREDIBLE * self.priors.motor_inertia * self.inertia
            || damping * self.rate_unit < -DRIVING * self.torque_unit;
        if !contradicted {
            self.inertia_now = inertia + self.inertia;
            self.damping_now = damping.max(0.0);
        }
        self.unmodelled = noise.hypot(self.values[n + COULOMB]);
        let link_rate = self.deflection.link_rate();
        let phi = self.deflection.at(0.0) + self.values[n + SHIFT] + self.late() * link_rate;
        self.std = self.stiffness_std(phi, link_rate);
        self.reach = BEYOND * self.peaks[1];
        if !self.law.is_polynomial() {
            self.reach = self.reach.min(EDGE * self.law.reach(&self.values[1..n]));
        }
        if contradicted || !self.explains() || !self.monitor.explained() {
            self.reach = 0.0;
        }
    }

    /// What is left of the link encoder's delay, s.
    fn late(&self) -> f64 {
        self.values[self.size + DELAY]
    }

    /// From the covariance of α, of the delay and the offset, and of the deflection that σ is read off at.
    fn stiffness_std(&self, phi: f64, link_rate: f64) -> f64 {
        let Some(kalman) = &self.kalman else { return f64::NAN };
        let (n, mut row) = (self.size, [0.0; SIZE]);
        let slope = self.law.stiffness_slopes(phi, &self.values[..n], &mut row[..n]);
        (row[n + DELAY], row[n + SHIFT]) = (slope * link_rate, slope);
        for (entry, unit) in row.iter_mut().zip(&self.units) {
            *entry *= unit;
        }
        let honest = UNSEEN * UNSEEN * kalman.variance_over_scale() * dot(&row, &times(&kalman.sigma, &row));
        let least = LEAST_VARIANCE * dot(&row, &times(&kalman.p, &row));
        (honest.max(least).max(0.0) + slope * slope * self.deflection.variance()).sqrt()
    }

    /// How many periods later than assumed the link is, where that has become clear.
    pub fn take_delay(&mut self) -> Option<f64> {
        let wait = self.updates_in(DELAY_S);
        let kalman = self.kalman.as_ref()?;
        if self.black_box || self.updates < self.delay_at + wait {
            return None;
        }
        let place = self.size + DELAY;
        let (late, std) = (kalman.x[place], kalman.sigma[place][place].max(0.0).sqrt());
        if late.abs() < DELAY_PERIODS || late.abs() < 3.0 * std {
            return None;
        }
        self.delay_at = self.updates;
        Some(late)
    }

    /// The channels have been aligned by so much more.
    pub fn shift_delay(&mut self, periods: f64) {
        let place = self.size + DELAY;
        if let Some(kalman) = &mut self.kalman {
            kalman.x[place] -= periods;
        }
        self.values[place] -= periods * self.period;
    }

    // -- nonlinear laws ----------------------------------------------------------------------------

    /// Go over from the polynomial to the nonlinear law, or linearise that anew, when it is due.
    fn hand_over(&mut self, filters: &Filters) {
        let due = self.updates > 0 && self.updates % self.updates_in(DUE_S) == 0 && self.excited;
        if self.past.is_empty() || !due || self.filled < self.past.len() {
            return;
        }
        if self.law.is_polynomial() {
            if !self.adopt_target() {
                return;
            }
        } else {
            if !self.is_off_tangent() {
                return;
            }
            self.relinearise();
        }
        self.recompute_basis(filters);
    }

    /// From the polynomial to the nonlinear law that it approximates; false where it is too early.
    fn adopt_target(&mut self) -> bool {
        let (Some(kalman), Some(target)) = (&self.kalman, &self.target) else { return false };
        let n_old = self.size;
        let mut std = [0.0; PARAMETERS];
        for i in 0..n_old {
            std[i] = (kalman.caution * kalman.sigma[i][i].max(0.0)).sqrt() * self.units[i];
        }
        let coefficients = &self.values[..n_old];
        let Some((alpha, slopes)) =
            polynomial_to_law(target, coefficients, &std[..n_old], self.deflection_unit)
        else {
            return false;
        };
        let old_units = self.units;
        let kalman = kalman.clone();
        (self.law, self.size, self.alpha0) = (target.clone(), 1 + target.shapes().len(), alpha);
        self.make_units();
        let n = self.size;
        let (mut mean, mut ceiling, mut change) = ([0.0; SIZE], [1.0; SIZE], [[0.0; SIZE]; SIZE]);
        for i in 0..n {
            mean[i] = alpha[i] / self.units[i];
            for j in 0..n_old {
                change[i][j] = slopes[i][j] * old_units[j] / self.units[i];
            }
        }
        for i in 0..NUISANCES {
            mean[n + i] = kalman.x[n_old + i];
            ceiling[n + i] = kalman.ceiling[n_old + i];
            change[n + i][n_old + i] = 1.0;
        }
        let mut adopted = kalman.transformed(&mean[..n + NUISANCES], &ceiling[..n + NUISANCES], &change);
        for i in 0..n {
            for j in 0..n {
                let wider = HANDED_OVER * adopted.sigma[i][j];
                adopted.p[i][j] += wider;
                adopted.sigma[i][j] += wider;
            }
            adopted.ceiling[i] = adopted.ceiling[i].max(adopted.p[i][i]);
        }
        self.kalman = Some(adopted);
        self.remember_tangent();
        true
    }

    /// Deflections, torques and slopes of the tangent at α0, for `is_off_tangent`.
    fn remember_tangent(&mut self) {
        if self.law.is_polynomial() || self.alpha0[0] == 0.0 {
            return;
        }
        let n = self.size;
        for (place, part) in self.tangent.iter_mut().zip(LOOKED_AT) {
            place.0 = part * self.deflection_unit;
            place.1 = self.law.at(place.0, &self.alpha0[..n]).0;
            self.law.jacobian(place.0, &self.alpha0[..n], &mut place.2[..n]);
        }
    }

    /// Whether the law's curve has left its tangent by more than a share of the curve's uncertainty.
    fn is_off_tangent(&mut self) -> bool {
        self.unscale();
        let Some(kalman) = &self.kalman else { return false };
        let n = self.size;
        self.tangent.iter().any(|(phi, torque, slopes)| {
            let (mut row, mut on_tangent) = ([0.0; SIZE], *torque);
            for i in 0..n {
                on_tangent += slopes[i] * (self.values[i] - self.alpha0[i]);
                row[i] = slopes[i] * self.units[i];
            }
            let variance = kalman.caution * dot(&row, &times(&kalman.sigma, &row));
            let off = self.law.at(*phi, &self.values[..n]).0 - on_tangent;
            off * off > OFF_TANGENT * OFF_TANGENT * variance
        })
    }

    /// Linearise the nonlinear law anew, where the parameters are now.
    ///
    /// What has been learned is the curve, as far as the tangent at the old parameters goes. It is held: the
    /// new parameters are those of the curve nearest to it, and their covariance is that of the curve.
    /// Holding the parameters' covariance instead would make sure of what no data have told: the tangent
    /// turns, so along the direction in which parameters compensate each other, old and new seem to cross.
    fn relinearise(&mut self) {
        let n = self.size;
        let (mut tangent, mut curve) = ([[0.0; PARAMETERS]; POINTS], [0.0; POINTS]);
        let at = |p: usize| self.deflection_unit * (p + 1) as f64 / POINTS as f64;
        for p in 0..POINTS {
            self.law.jacobian(at(p), &self.alpha0[..n], &mut tangent[p][..n]);
            curve[p] = self.law.at(at(p), &self.alpha0[..n]).0;
            for i in 0..n {
                curve[p] += tangent[p][i] * (self.values[i] - self.alpha0[i]);
            }
        }
        let mut alpha: Vector = self.values;
        let (mut normal, mut right);
        let mut last = 0;
        loop {
            (normal, right) = ([[0.0; PARAMETERS]; PARAMETERS], [[0.0; PARAMETERS]; PARAMETERS]);
            let (mut slopes, mut down) = ([0.0; PARAMETERS], [0.0; PARAMETERS]);
            for p in 0..POINTS {
                self.law.jacobian(at(p), &alpha[..n], &mut slopes[..n]);
                let left = curve[p] - self.law.at(at(p), &alpha[..n]).0;
                for i in 0..n {
                    slopes[i] *= self.units[i];
                }
                for i in 0..n {
                    down[i] += slopes[i] * left;
                    for j in 0..n {
                        normal[i][j] += slopes[i] * slopes[j];
                        right[i][j] += slopes[i] * (tangent[p][j] * self.units[j] - slopes[j]);
                    }
                }
            }
            // What the curve does not tell stays as it is.
            let ridge = RIDGE * (0..n).map(|i| normal[i][i]).sum::<f64>();
            (0..n).for_each(|i| normal[i][i] += ridge);
            let steps = solve(&normal, &down, n);
            for i in 0..n {
                alpha[i] += self.units[i] * steps[i];
            }
            bound(&self.law, &mut alpha);
            last += 1;
            if last == STEPS {
                break;
            }
        }
        let mut change: Matrix = [[0.0; SIZE]; SIZE];
        for j in 0..n {
            let mut column = [0.0; PARAMETERS];
            (0..n).for_each(|i| column[i] = right[i][j]);
            let solved = solve(&normal, &column, n);
            (0..n).for_each(|i| change[i][j] = solved[i]);
            change[j][j] += 1.0;
        }
        for i in n..n + NUISANCES {
            change[i][i] = 1.0;
        }
        let Some(kalman) = &self.kalman else { return };
        let mut mean = kalman.x;
        for i in 0..n {
            mean[i] = alpha[i] / self.units[i];
            self.alpha0[i] = alpha[i];
        }
        let all = n + NUISANCES;
        self.kalman = Some(kalman.transformed(&mean[..all], &kalman.ceiling[..all], &change));
        self.remember_tangent();
    }

    /// Give the basis channels the past that they would have had with the law linearised where it is now.
    fn recompute_basis(&mut self, filters: &Filters) {
        let length = self.past.len();
        let mut columns = [0.0; COLUMNS];
        for k in 0..length {
            self.columns(self.past[(self.newest + 1 + k) % length], &mut columns);
            for i in (0..self.size).chain([PARAMETERS]) {
                if k == 0 {
                    self.basis[i] = Channel::rest(columns[i]);
                } else {
                    self.basis[i].smooth(filters, columns[i]);
                }
            }
        }
    }

    // -- what it says ------------------------------------------------------------------------------

    /// The estimate at a deflection a little ahead of the last sample, and whether it is of use.
    ///
    /// `delay`: of the filters; the torque behind them is brought up to the present by its own slope.
    pub fn estimate(&mut self, ahead_s: f64, delay: f64) -> (TransmissionEstimate, bool) {
        let (motor, tau, x) = (&self.position.main, &self.torque.main, &self.formed.main);
        let value = self.inertia * motor[2] + self.damping * motor[1] + x[0] - tau[0];
        let rate = self.inertia * motor[3] + self.damping * motor[2] + x[1] - tau[1];
        self.lead = value + (delay + ahead_s) * rate;
        if self.rigid {
            let torque = self.lead;
            let estimate =
                TransmissionEstimate { flexibility_torque: torque, ..TransmissionEstimate::NOTHING };
            return (estimate, torque.is_finite());
        }
        let now = self.deflection.at(ahead_s);
        let n = self.size;
        if !self.told {
            let (mut torque, mut stiffness) = (self.lead, f64::NAN);
            if let (Some(law), false) = (&self.target, self.known.is_empty()) {
                let more = self.effects.spring(now);
                (torque, stiffness) = law.at(now, &self.known);
                (torque, stiffness) = (torque + more.0, stiffness + more.1);
            }
            let nothing = TransmissionEstimate::NOTHING;
            let estimate =
                TransmissionEstimate { flexibility_torque: torque, stiffness, deflection: now, ..nothing };
            return (estimate, false);
        }
        let off = self.values[n + SHIFT] + self.late() * self.deflection.link_rate();
        let phi = now + off;
        let (mut torque, mut stiffness) = self.law.at(phi, &self.values[..n]);
        let acted = if ahead_s == 0.0 {
            torque
        } else {
            self.law.at(self.deflection.at(0.0) + off, &self.values[..n]).0
        };
        self.acting = acted - self.values[n + OFFSET];
        let more = self.effects.spring(phi);
        (torque, stiffness) = (torque + more.0, stiffness + more.1);
        let mut std = self.std;
        if self.held_s > RESTED_S {
            std = std.hypot((DRIFT * self.held_s).min(WIDEST) * stiffness);
        }
        let valid = std > 0.0 && std < USEFUL * stiffness && phi.abs() < self.reach;
        if valid && !self.black_box {
            self.trusted = true;
        } else if self.reach == 0.0 {
            self.trusted = false;
        }
        self.stiffness = if self.trusted { stiffness } else { 0.0 };
        if !self.trusted {
            self.acting = self.lead;
            torque = self.lead + more.0;
        }
        let estimate = TransmissionEstimate {
            flexibility_torque: torque,
            stiffness,
            stiffness_std: std,
            deflection: phi,
        };
        (estimate, valid)
    }

    /// The law's parameters with their standard deviations; `None` before any, or without a law.
    pub fn parameters(&self, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        let kalman = self.kalman.as_ref()?;
        if self.black_box || !self.told {
            return None;
        }
        for i in 0..self.size {
            values.push(self.values[i]);
            std.push(
                (UNSEEN * UNSEEN * kalman.variance_over_scale() * kalman.sigma[i][i].max(0.0)).sqrt()
                    * self.units[i],
            );
        }
        Some(&self.law)
    }
}

/// Shape parameters where they can be.
fn bound(law: &Law, values: &mut Vector) {
    for (i, shape) in law.shapes().iter().enumerate() {
        values[1 + i] = values[1 + i].max(shape.low * (1.0 + 1e-6)).min(shape.high);
    }
}

/// x of A x = b, A symmetric and positive definite, n of it.
#[must_use]
pub fn solve(a: &[Alpha; PARAMETERS], b: &Alpha, n: usize) -> Alpha {
    let (mut lower, mut x) = ([[0.0; PARAMETERS]; PARAMETERS], [0.0; PARAMETERS]);
    for i in 0..n {
        for j in 0..=i {
            let rest: f64 = (0..j).map(|k| lower[i][k] * lower[j][k]).sum();
            let value = a[i][j] - rest;
            lower[i][j] = if i == j { value.max(1e-300).sqrt() } else { value / lower[j][j] };
        }
    }
    for i in 0..n {
        let rest: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (b[i] - rest) / lower[i][i];
    }
    for i in (0..n).rev() {
        let rest: f64 = (i + 1..n).map(|k| lower[k][i] * x[k]).sum();
        x[i] = (x[i] - rest) / lower[i][i];
    }
    x
}
