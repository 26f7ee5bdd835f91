//! One motor and its transmission on line: takes every sample, estimates at every update.

use crate::change_detection::{Action, ChangeDetection, Innovation, SURE};
use crate::deflection::{AT_REST, DeflectionFilter, Motion, Present, Tuning};
use crate::effects::{Coordinates, MotorEffects};
use crate::external::Carried;
use crate::identification::OnlineIdentification;
use crate::isolation::{CHANGES, Change, Verdict};
use crate::laws::Law;
use crate::model::Motor;
use crate::reasons::Reason;
use crate::sample::TransmissionEstimate;
use crate::settings::{Priors, Settings};
use crate::signals::{Channel, Excitation, Filters, Signals};

const DUE_S: f64 = 0.1; // of updates between two looks at a nonlinear law's linearisation
/// Up to which a curve explains the balance: rms of what it leaves over the balance's own.
const USEFUL: f64 = 0.2;
const DRIFT: f64 = 1e-4; // relative growth of the standard deviation per second held
const RESTED_S: f64 = 0.05; // without motion: from then on the interval grows …
const WIDEST: f64 = 0.02; // … up to this
const ASTRAY_S: f64 = 1.0; // of updates with parameters that cannot be, after which it starts anew
const VARIES_S: f64 = 2.0; // over which the balance's variance is taken: a constant torque is not informative …
const VARIED_S: f64 = 30.0; // … and how long a lively phase is remembered
const QUIET: f64 = 0.25; // of the liveliest variance: the least that misses are held against
const EXPLAINED_S: f64 = 0.3; // over which the curve is held against the balance
const USEFUL_LOCAL: f64 = 0.7; // the same of the black box's balance, a derivative: noise grows by the bandwidth over ω
const FIRST_S: f64 = 0.12; // of updates that are not held against a curve which has only begun
const BEYOND: f64 = 1.5; // times the largest deflection behind the filter: no more is known of the curve
const EDGE: f64 = 0.98; // of where a law ends

/// What a transmission's estimator learns from at one update, beside its own channels.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// F G of q and its derivatives.
    pub link: [f64; 4],
    /// Whether the filters hold nothing wrong.
    pub usable: bool,
    /// Variance of θ's and of q's noise, rad².
    pub noise: [f64; 2],
}

/// How much of the balance's variation the curve leaves over.
#[derive(Clone, Copy, Debug, Default)]
struct Fit {
    mean: f64,
    varies: f64,
    varied: f64,
    missed: f64,
}

impl Fit {
    fn see(&mut self, y: f64, innovation: f64, dt: f64) {
        let share = (dt / VARIES_S).min(1.0);
        self.mean += share * (y - self.mean);
        self.varies += share * ((y - self.mean).powi(2) - self.varies);
        self.varied = (self.varied * (1.0 - dt / VARIED_S)).max(self.varies);
        self.missed += (dt / EXPLAINED_S).min(1.0) * (innovation * innovation - self.missed);
    }

    /// Whether what is missed is at most this share of the balance, in rms.
    fn is_good(&self, share: f64) -> bool {
        self.missed <= share * share * self.lively()
    }

    /// What is missed as a share of the balance, in rms.
    fn share(&self) -> f64 {
        (self.missed / self.lively()).sqrt()
    }

    fn lively(&self) -> f64 {
        self.varies.max(QUIET * self.varied)
    }
}

/// Estimation of one transmission (or of a rigid one's torque).
#[derive(Clone, Debug)]
pub struct TransmissionEstimator {
    inertia: f64,
    damping: f64,
    period: f64,
    dt: f64,
    rigid: bool,
    effects: MotorEffects,
    valid_within: f64,
    rate_gain: f64,
    signals: Signals,
    /// x_motor − x_transmission, the latest that is known, N·m.
    pub effect: f64,
    transmitted: f64, // x_transmission
    /// The deflection of this moment.
    pub deflection: DeflectionFilter,
    identification: OnlineIdentification,
    changes: ChangeDetection,
    excitation: Excitation,
    excited: bool,
    fit: Fit,
    usual: [(Fit, Motion, [f64; 3]); 2], // beside the reference, and beside what is to be it next
    impossible: u32,
    missing: u32,
    misfit: f64,
    // What is published.
    concluded: bool,
    std: f64,
    torque_variance: f64,
    reach: f64,
    doubt: Option<Reason>, // why the curve is not used, whatever the deflection
    held_s: f64,
    trusted: bool,
    lead: f64,
    acting: f64,
    stiffness: f64,
    unmodelled: f64,
    inertia_now: f64,
    damping_now: f64,
}

impl TransmissionEstimator {
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
    ) -> TransmissionEstimator {
        let bandwidth = filters.main.bandwidth;
        let identification = OnlineIdentification::new(motor, settings, priors, period_s, dt_s);
        let mut made = TransmissionEstimator {
            inertia: motor.inertia,
            damping: motor.damping,
            period: period_s,
            dt: dt_s,
            rigid: !motor.flexible(),
            effects,
            valid_within: settings.valid_within,
            rate_gain: filters.rate_gain(period_s),
            signals: Signals::new(
                filters,
                period_s,
                (dt_s / period_s).round() as usize,
                identification.is_nonlinear(),
            ),
            effect: 0.0,
            transmitted: 0.0,
            deflection: DeflectionFilter::new(motor.inertia, motor.damping, bandwidth, period_s, dt_s / 2.0),
            identification,
            changes: ChangeDetection::new(settings.false_alarms_per_hour, dt_s, filters.delay),
            excitation: Excitation::default(),
            excited: false,
            fit: Fit::default(),
            usual: [(Fit::default(), AT_REST, [0.0; 3]); 2],
            impossible: 0,
            missing: 0,
            misfit: f64::NAN,
            concluded: false,
            std: f64::NAN,
            torque_variance: f64::NAN,
            reach: 0.0,
            doubt: None,
            held_s: 0.0,
            trusted: false,
            lead: f64::NAN,
            acting: 0.0,
            stiffness: 0.0,
            unmodelled: f64::INFINITY,
            inertia_now: motor.inertia,
            damping_now: motor.damping,
        };
        made.reset();
        made
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.effects.motor.reset();
        self.effects.transmission.reset();
        self.signals.reset();
        self.deflection.reset();
        self.excitation = Excitation::default();
        (self.effect, self.transmitted) = (0.0, 0.0);
        (self.lead, self.misfit) = (f64::NAN, f64::NAN);
        self.relearn();
    }

    /// Forget what has been learned of the transmission.
    pub fn relearn(&mut self) {
        self.identification.reset();
        self.changes.reset();
        (self.impossible, self.missing, self.fit) = (0, 0, Fit::default());
        self.usual = [(Fit::default(), AT_REST, [0.0; 3]); 2];
        (self.concluded, self.std, self.reach, self.held_s, self.trusted) =
            (false, f64::NAN, 0.0, 0.0, false);
        (self.acting, self.stiffness, self.unmodelled, self.doubt) = (0.0, 0.0, f64::INFINITY, None);
        (self.inertia_now, self.damping_now) = (self.inertia, self.damping);
    }

    /// Filters at rest where the joint is now; what has been learned is kept.
    pub fn restart(&mut self, theta: f64, phi: f64, torque: f64) {
        self.signals.restart(theta, torque);
        if !self.rigid {
            self.signals.rest_basis(self.identification.law(), phi);
            self.deflection.restart(theta, phi);
        }
    }

    /// Whether its transmission is rigid.
    #[must_use]
    pub fn is_rigid(&self) -> bool {
        self.rigid
    }

    /// Whether the joint has changed and is being followed.
    #[must_use]
    pub fn changed(&self) -> bool {
        self.changes.changed()
    }

    /// What the window says of all changes; `None` before there is a reference.
    #[must_use]
    pub fn verdict(&self) -> Option<&Verdict> {
        self.changes.verdict()
    }

    /// The same while a change has not been explained.
    #[must_use]
    pub fn doubt(&self) -> Option<&Verdict> {
        self.changes.doubt()
    }

    /// Whether a change leaves no more of the window than noise does; true where nothing is said of it.
    #[must_use]
    pub fn is_explained_by(&self, change: Change) -> bool {
        self.changes.is_explained_by(change)
    }

    /// Which changes the window does not tell from the likeliest one; none while it is too short.
    #[must_use]
    pub fn likely_changes(&self) -> [bool; CHANGES] {
        let Some(verdict) = self.changes.doubt() else { return [false; CHANGES] };
        let best = verdict.best(|change| change != Change::Nothing);
        let most = best.map_or(f64::INFINITY, |change| verdict.of(change).evidence);
        Change::ALL.map(|change| change != Change::Nothing && verdict.of(change).evidence > most - SURE)
    }

    /// SI units (s for delays) in which a change's amplitude is counted.
    #[must_use]
    pub fn unit_of(&self, change: Change) -> f64 {
        self.identification.unit_of(change)
    }

    /// Whether the motion reveals the stiffness.
    #[must_use]
    pub fn excited(&self) -> bool {
        self.excited
    }

    /// What the model left unexplained at the last update, N·m.
    #[must_use]
    pub fn misfit(&self) -> f64 {
        self.misfit
    }

    // -- every tick --------------------------------------------------------------------------------

    /// One period: the deflection of this moment, and every channel through the filters.
    ///
    /// `before`: the torque that has acted over the period.
    pub fn feed(&mut self, filters: &Filters, theta: f64, phi: f64, torque: f64, before: f64, usable: bool) {
        if !self.rigid {
            self.deflection.update(theta, phi, before + self.acting - self.effect);
            let (law, slots) = (self.identification.law(), self.identification.slots);
            self.signals.feed_basis(filters, law, phi, slots);
        }
        self.signals.feed_motor(filters, theta, torque, usable);
    }

    /// x_motor − x_transmission of the declared effects, from lightly filtered values of q and of the motor.
    pub fn feed_effects(&mut self, filters: &Filters, link: &Channel, time: f64) {
        if self.effects.is_empty() {
            return;
        }
        let position = &self.signals.position;
        let phi = link.light[0] - position.light[0];
        let (flexibility_torque, stiffness) = self.curve(phi);
        let c = Coordinates {
            position: position.light[0] - self.effects.offset,
            velocity: position.light[1],
            acceleration: position.light[2],
            deflection: phi,
            deflection_rate: link.light[1] - position.light[1],
            flexibility_torque,
            stiffness,
            torque: self.signals.torque.light[0],
            time,
            ..Coordinates::default()
        };
        let (motor, transmission) = self.effects.balance(&c, self.period);
        (self.effect, self.transmitted) = (motor - transmission, transmission);
        self.signals.effects.pass(filters, self.effect);
    }

    /// (τ_e, σ) at a deflection as it is measured; zeros before anything is known.
    fn curve(&self, phi: f64) -> (f64, f64) {
        let learned = &self.identification;
        if self.concluded {
            return learned.law().law.at(phi + learned.deflection_offset(), learned.alpha());
        }
        learned.declared().map_or((0.0, 0.0), |(law, known)| law.at(phi, known))
    }

    // -- every update ------------------------------------------------------------------------------

    /// Everything that is learned from the filtered signals of this moment.
    ///
    /// Returns whether the estimate has long been where it cannot be and has begun anew.
    pub fn update(&mut self, filters: &Filters, now: &Moment) -> bool {
        // Does the motion reveal the stiffness?
        let motor = self.signals.position.main;
        let resolution = (now.noise[0] + now.noise[1]).sqrt();
        let rate = now.link[1] - motor[1];
        self.excited = self.excitation.update(
            rate,
            self.rate_gain * resolution,
            now.usable,
            !self.changes.changed(),
            self.dt,
        );
        if now.usable && self.excited {
            self.identification.observe_motion(&self.signals);
        }
        self.identification.observe_noise(resolution);
        // How large motion is: what is not explained does not tell.
        if now.usable && !self.changes.changed() && !self.is_beyond_noise(now) {
            self.identification.observe_scale(&self.signals, &now.link);
        }
        if self.identification.kalman().is_none() && now.usable && self.excited {
            self.identification.start();
        }
        self.signals.catch_up(filters, self.identification.law(), usize::MAX);
        // The balance (eq 5) as one equation: has the joint changed? What does it teach?
        let mut astray = false;
        if self.identification.kalman().is_some() {
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
        if self.identification.kalman().is_some() {
            if now.usable {
                self.follow_law(filters);
            }
            self.publish();
        }
        astray
    }

    /// One equation: the test of its innovation, the noise, the parameters.
    fn learn(&mut self, now: &Moment) {
        let (h, y) = self.identification.equation(&self.signals, &now.link);
        let Some(kalman) = self.identification.kalman() else { return };
        let (innovation, predicted) = (kalman.innovation(&h, y), kalman.predicted_variance(&h));
        let noise = kalman.noise;
        self.misfit = innovation * self.identification.torque_unit();
        self.held_s += self.dt;
        let updates = self.identification.updates();
        if now.usable && updates >= self.identification.updates_in(FIRST_S) {
            self.fit.see(y, innovation, self.dt);
        }
        // Is it the reference's? If not, is it another stiffness, or a reading that is not what it was?
        let mut of_reference = None;
        if now.usable && self.excited && self.changes.may_learn() {
            let (window, suspect) = (self.changes.window(), self.changes.suspect());
            of_reference = self.identification.observe(&self.signals, &now.link, &h, y, window, suspect);
        }
        let settled = updates >= (1.0 / self.dt) as u32;
        if now.usable {
            let verdict = self.identification.judge();
            let seen = Innovation { value: innovation, predicted_variance: predicted, noise, of_reference };
            let usual = !self.changes.changed();
            let action = self.changes.watch(&seen, verdict, settled);
            if usual && self.changes.changed() && self.identification.has_reference() {
                self.identification.recall_scale(self.usual[1].2); // what raised the alarm is no measure
            }
            match action {
                Action::GoOn => {}
                Action::OpenUp => {
                    self.identification.restore_reference();
                    self.identification.open_up();
                    return;
                }
                Action::Restore => {
                    self.recall();
                    return self.identification.restore_reference();
                }
                Action::Accept(change) => {
                    self.recall();
                    if let Some(verdict) = verdict {
                        self.identification.accept(change, &verdict);
                    }
                    return;
                }
                Action::LookAgain => self.identification.look_again(),
                Action::Relearn => return self.relearn(),
            }
        } else {
            self.changes.pause();
        }
        // What it teaches.
        if now.usable && self.excited && self.changes.may_learn() {
            self.held_s = 0.0;
            self.identification.learn(&h, innovation, predicted, self.changes.may_learn_noise());
            if !self.changes.changed() && self.identification.keep_reference() {
                let now = (self.fit, self.deflection.motion(), self.identification.scale());
                let first = self.usual[1].0.varied == 0.0;
                self.usual = [if first { now } else { self.usual[1] }, now];
            }
        } else {
            self.identification.pass_over(innovation, predicted);
        }
    }

    /// Whether the equation of this moment is not explained by what was learned in good times.
    fn is_beyond_noise(&mut self, now: &Moment) -> bool {
        if !self.identification.has_reference() {
            return false;
        }
        let (h, y) = self.identification.equation(&self.signals, &now.link);
        self.identification.kalman().is_some_and(|kalman| {
            let foreseen = kalman.noise + kalman.predicted_variance(&h);
            self.changes.is_step(kalman.innovation(&h, y).powi(2), foreseen)
        })
    }

    /// A change has been explained: what was read meanwhile is no measure of how the joint moves.
    fn recall(&mut self) {
        self.usual[1] = self.usual[0];
        let (fit, motion, _) = self.usual[0];
        self.fit = fit;
        self.deflection.recall(motion);
    }

    /// Whether the curve leaves only a part of the balance unexplained.
    fn explains(&self) -> bool {
        self.fit.is_good(if self.identification.black_box { USEFUL_LOCAL } else { USEFUL })
    }

    /// Whether the estimate has long been where it cannot be: no way back by small steps.
    fn is_astray(&mut self) -> bool {
        let long = self.identification.updates_in(ASTRAY_S);
        if !self.identification.kalman().is_some_and(|kalman| kalman.is_finite()) {
            if self.identification.has_reference() {
                self.identification.restore_reference();
                return false;
            }
            return true;
        }
        self.impossible = if self.identification.is_possible() { 0 } else { self.impossible + 1 };
        if self.identification.has_reference() {
            // Then there is a way back.
            if self.impossible > long {
                self.identification.restore_reference();
                self.impossible = 0;
            }
            self.missing = 0;
        } else if self.explains() {
            self.missing = 0;
        } else if self.excited && self.changes.may_learn_noise() {
            self.missing += 1;
        }
        self.impossible > long || self.missing > long
    }

    /// The nonlinear law instead of the polynomial, or linearised anew, when it is due.
    fn follow_law(&mut self, filters: &Filters) {
        let updates = self.identification.updates();
        let due = updates > 0 && updates % self.identification.updates_in(DUE_S) == 0;
        let well = self.excited && !self.changes.changed();
        if due && well && self.signals.has_past() && self.identification.switch_model() {
            self.signals.rebuild_basis(filters, self.identification.law());
        }
    }

    // -- what it says ------------------------------------------------------------------------------

    /// What the ticks until the next update say, and how sure it is.
    fn publish(&mut self) {
        let learned = &mut self.identification;
        learned.conclude();
        self.concluded = true;
        let motor = learned.motor();
        if let Some((inertia, damping)) = motor {
            (self.inertia_now, self.damping_now) = (inertia, damping);
        }
        let noise = learned.kalman().map_or(f64::NAN, |kalman| kalman.noise.sqrt() * learned.torque_unit());
        self.unmodelled = noise.hypot(learned.coulomb_friction());
        let link_rate = self.deflection.link_rate();
        let phi = self.deflection.at(0.0) + learned.deflection_offset() + learned.late() * link_rate;
        self.std = learned.stiffness_std(phi, link_rate, self.deflection.variance());
        self.torque_variance = learned.torque_variance(phi);
        self.reach = BEYOND * learned.largest_deflection();
        if !learned.law().is_polynomial() {
            self.reach = self.reach.min(EDGE * learned.law().law.reach(&learned.alpha()[1..]));
        }
        self.doubt = if !self.changes.explained() {
            Some(Reason::Changed)
        } else if motor.is_none() {
            Some(Reason::Motor)
        } else if !self.explains() {
            Some(Reason::Unexplained(self.fit.share()))
        } else {
            None
        };
    }

    /// How many periods later than assumed the link is, where that has become clear.
    pub fn take_delay(&mut self) -> Option<f64> {
        if self.changes.changed() { None } else { self.identification.take_delay() }
    }

    /// The channels have been aligned by so much more.
    pub fn shift_delay(&mut self, periods: f64) {
        self.identification.shift_delay(periods);
    }

    /// An encoder has moved its zero, `known`: by so much, or somewhere.
    pub fn reopen_deflection_offset(&mut self, known: bool) {
        self.identification.reopen_deflection_offset(known);
    }

    /// Whether a deflection is larger than any that the joint can have.
    #[must_use]
    pub fn is_beyond(&self, phi: f64) -> bool {
        let largest = self.identification.largest_deflection();
        largest > 0.0 && phi.abs() > BEYOND * largest
    }

    /// The estimate at the present deflection, and why it is of no use; `None`: it is of use.
    ///
    /// `delay`: of the filters; the torque behind them is brought up to the present by its own slope.
    pub fn estimate(&mut self, present: &Present, delay: f64) -> (TransmissionEstimate, Option<Reason>) {
        let ahead_s = present.behind_s + present.ahead_s;
        let signals = &self.signals;
        let (motor, tau, x) = (&signals.position.main, &signals.torque.main, &signals.effects.main);
        let value = self.inertia * motor[2] + self.damping * motor[1] + x[0] - tau[0];
        let rate = self.inertia * motor[3] + self.damping * motor[2] + x[1] - tau[1];
        self.lead = value + (delay + ahead_s) * rate;
        let nothing = TransmissionEstimate::NOTHING;
        if self.rigid {
            let torque = self.lead;
            let reason = (!torque.is_finite()).then_some(Reason::Settling);
            return (TransmissionEstimate { flexibility_torque: torque, ..nothing }, reason);
        }
        let (now, learned) = (self.deflection.now(present), &self.identification);
        if !self.concluded {
            let (mut torque, mut stiffness) = (self.lead, f64::NAN);
            if let Some((law, known)) = learned.declared() {
                let more = self.effects.spring(now);
                (torque, stiffness) = law.at(now, known);
                (torque, stiffness) = (torque + more.0, stiffness + more.1);
            }
            let estimate =
                TransmissionEstimate { flexibility_torque: torque, stiffness, deflection: now, ..nothing };
            return (estimate, Some(Reason::Unmoved));
        }
        let off = learned.deflection_offset() + learned.late() * self.deflection.link_rate();
        let phi = now + off;
        let law = &learned.law().law;
        let (mut torque, mut stiffness) = law.at(phi, learned.alpha());
        let acted =
            if ahead_s == 0.0 { torque } else { law.at(self.deflection.at(0.0) + off, learned.alpha()).0 };
        self.acting = acted - learned.torque_offset();
        let more = self.effects.spring(phi);
        (torque, stiffness) = (torque + more.0, stiffness + more.1);
        let mut std = self.std;
        if self.held_s > RESTED_S {
            std = std.hypot((DRIFT * self.held_s).min(WIDEST) * stiffness);
        }
        let beyond = (phi.is_nan() || phi.abs() >= self.reach).then_some(Reason::Beyond);
        let imprecise = Reason::of_precision(stiffness, std, self.valid_within);
        let reason = self.doubt.or(imprecise).or(beyond);
        if reason.is_none() && !learned.black_box {
            self.trusted = true;
        } else if self.doubt.is_some() || self.reach == 0.0 {
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
        (estimate, reason)
    }

    /// What it does to the link at a deflection as it is measured; `None` where no curve is trusted.
    ///
    /// `noise`: variance of θ's noise, rad².
    #[must_use]
    pub fn carried(&self, phi: f64, noise: f64) -> Option<Carried> {
        if !self.trusted {
            return None;
        }
        let learned = &self.identification;
        let phi = phi + learned.deflection_offset() + learned.late() * self.deflection.link_rate();
        let (torque, stiffness) = learned.law().law.at(phi, learned.alpha());
        let stiffness = stiffness + self.effects.spring(phi).1;
        Some(Carried {
            torque: torque + self.transmitted,
            variance: self.torque_variance,
            stiffness,
            reading: stiffness * stiffness * noise,
        })
    }

    /// The law's parameters with their standard deviations; `None` before any, or without a law.
    pub fn parameters(&self, values: &mut Vec<f64>, std: &mut Vec<f64>) -> Option<&Law> {
        if self.concluded { self.identification.parameters(values, std) } else { None }
    }
}
