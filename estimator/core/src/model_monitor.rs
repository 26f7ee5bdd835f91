//! Tests whether the model is still sufficient: its residual against the baseline of its fit.
//!
//! The balances of eqs 5 and 4 are formed with the model's own parameters and effects, not with those that
//! the estimator adapts. All channels pass one light filter that gives derivatives, the balances a second one.
//!
//! The mean square S of a balance in a second is predicted from the healthy recording, larger with more
//! torque, as model errors grow with it. x = ln(S/predicted) of N healthy seconds has the standard deviation
//! s; one more second is then Student's t with N − 1 degrees of freedom about 0 with the variance s² (1 +
//! 1/N), and another motion than the recorded one adds its own. The alarm is the quantile of x at the rate of
//! false alarms that is declared, shared by the balances and by the seconds of an hour.
//!
//! If τ_k is not measured, the residual of the link's balance may be a push as well as a model error, and
//! neither affects the flexibility torque: it helps to locate an effect, but raises no alarm (see
//! [`crate::external`]).

mod balance;

use serde::{Deserialize, Serialize};

use crate::choices::{BRIDGED, FLOOR, LIGHT, MOTION, SETTLED};
use crate::error::Error;
use crate::filters::StateVariableFilter;
use crate::joint_effects::JointEffects;
use crate::laws::Law;
use crate::library::ABSURD;
use crate::model::{Arrangement, Link, Model, Motor, Transmission};
use crate::sample::{MOTORS, Sample};
use crate::settings::Settings;
use crate::student::t_quantile;

/// Balances of a joint, at most: of its motors, then of its link.
pub const BALANCES: usize = MOTORS + 1;

const WINDOW_S: f64 = 1.0; // over which a mean square is taken: several periods of usual motions

const TORQUE: usize = MOTORS; // channels: motor positions, motor torques, link position, external torque
const LINK: usize = 2 * MOTORS;
const EXTERNAL: usize = LINK + 1;
const CHANNELS: usize = EXTERNAL + 1;

/// What a sufficient model leaves of each balance, from the seconds of a healthy recording.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// Usual rms of each second, N·m.
    pub residual: [f64; BALANCES],
    /// Rms of the torque at which that was, N·m.
    pub torque: [f64; BALANCES],
    /// s: standard deviation of the logarithm of a second's mean square.
    pub log_std: [f64; BALANCES],
    /// N.
    pub seconds: usize,
}

impl Baseline {
    /// Of x, that a second of a sufficient model exceeds with this chance.
    fn limit(&self, chance: f64) -> [f64; BALANCES] {
        let n = self.seconds as f64;
        let t = t_quantile((n - 1.0).max(1.0), 2.0 * chance); // the quantile's probability is that of both tails
        self.log_std.map(|s| t * (s * s * (1.0 + 1.0 / n) + MOTION * MOTION).sqrt())
    }
}

/// What was found in the last whole second.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Found {
    /// Rms of each balance, N·m.
    pub residual: [f64; BALANCES],
    /// Rms of the torque it is to be compared with, N·m.
    pub torque: [f64; BALANCES],
    /// Largest of residual over foreseen, and the one that raises the alarm there.
    pub ratio: f64,
    /// See `ratio`.
    pub limit: f64,
    /// ∫ of each motor's residual times the link's over the second, N²·m².
    cross: [f64; MOTORS],
    /// The foreseen mean squares.
    foreseen: [f64; BALANCES],
}

impl Found {
    const NOTHING: Found = Found {
        residual: [f64::NAN; BALANCES],
        torque: [f64::NAN; BALANCES],
        ratio: f64::NAN,
        limit: f64::NAN,
        cross: [f64::NAN; MOTORS],
        foreseen: [f64::NAN; BALANCES],
    };
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct MotorSide {
    inertia: f64,
    damping: f64,
    flexible: bool,
    law: Option<(Law, Vec<f64>)>, // None: its torque is not known
}

impl MotorSide {
    fn of(motor: &Motor) -> MotorSide {
        let law = match &motor.transmission {
            Transmission::Elastic { law, parameters, .. } if !parameters.is_empty() => {
                Some((law.clone(), parameters.clone()))
            }
            _ => None,
        };
        MotorSide { inertia: motor.inertia, damping: motor.damping, flexible: motor.flexible(), law }
    }
}

/// See the module.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ModelMonitor {
    motors: Vec<MotorSide>,
    flexible: bool,
    link: Option<Link>,
    linked: bool, // whether the link has a balance
    pulls: usize, // transmissions that act on the link (eqs 4, 9)
    effects: JointEffects,
    light: StateVariableFilter<3>,
    narrow: StateVariableFilter<2>,
    baseline: Option<Baseline>,
    limit: [f64; BALANCES], // of x
    settle: u64,
    window: u64,
    bridged: u64,
    period: f64,

    last: Option<u64>,
    begins: bool, // with the next sample that the corrections let pass
    inputs: [f64; CHANNELS],
    torque: [f64; MOTORS], // as it acts since the last sample
    channels: [[f64; 3]; CHANNELS],
    raw: [f64; 2 * BALANCES], // balances, then the torques they are compared with
    filtered: [[f64; 2]; 2 * BALANCES],
    squares: [f64; 2 * BALANCES],
    cross: [f64; MOTORS],
    ticks: u64,
    found: Found,
    seconds: u64,
    alarm: bool,
    measured: bool, // whether every sample of this second had τ_k
}

/// How many balances a joint has: of its motors, then of its link where its dynamics are known.
#[must_use]
pub fn balances(model: &Model) -> usize {
    model.motors.len() + usize::from(model.link.is_some() && model.has_deflection())
}

impl ModelMonitor {
    /// For a model with its transmissions' parameters, and its baseline; without one it only measures.
    ///
    /// # Errors
    /// The model contradicts itself, or an effect is where it does not belong.
    pub fn new(
        model: &Model,
        baseline: Option<Baseline>,
        false_alarms_per_hour: f64,
        period_s: f64,
    ) -> Result<ModelMonitor, Error> {
        model.check()?;
        let motors: Vec<MotorSide> = model.motors.iter().map(MotorSide::of).collect();
        let linked = model.link.is_some() && model.has_deflection();
        let bandwidth = Settings::default().bandwidth; // whatever the estimator's is: a baseline is of one filter
        let narrow = StateVariableFilter::new(bandwidth.min(1.0 / (LIGHT * period_s)), period_s);
        let periods = |rad: f64| (rad / (narrow.bandwidth * period_s)).ceil() as u64;
        let chance = false_alarms_per_hour * WINDOW_S / 3600.0 / balances(model) as f64;
        let limit = baseline.map_or([f64::INFINITY; BALANCES], |baseline| baseline.limit(chance));
        let mut made = ModelMonitor {
            flexible: model.has_deflection(),
            link: model.link,
            linked,
            pulls: if model.arrangement == Arrangement::Antagonistic { motors.len() } else { 1 },
            effects: JointEffects::new(model, period_s)?,
            light: StateVariableFilter::new(LIGHT * narrow.bandwidth, period_s),
            baseline,
            limit,
            settle: periods(SETTLED * (2.0 + 3.0 / LIGHT)),
            window: (WINDOW_S / period_s).round().max(1.0) as u64,
            bridged: periods(BRIDGED),
            period: period_s,
            narrow,
            motors,
            last: None,
            begins: true,
            inputs: [0.0; CHANNELS],
            torque: [0.0; MOTORS],
            channels: [[0.0; 3]; CHANNELS],
            raw: [0.0; 2 * BALANCES],
            filtered: [[0.0; 2]; 2 * BALANCES],
            squares: [0.0; 2 * BALANCES],
            cross: [0.0; MOTORS],
            ticks: 0,
            found: Found::NOTHING,
            seconds: 0,
            alarm: false,
            measured: true,
        };
        made.reset();
        Ok(made)
    }

    /// Forget everything but the model and its baseline.
    pub fn reset(&mut self) {
        self.effects.reset();
        self.last = None;
        self.seconds = 0;
        self.alarm = false;
        self.found = Found::NOTHING;
    }

    /// See [`balances`].
    #[must_use]
    pub fn balances(&self) -> usize {
        self.motors.len() + usize::from(self.linked)
    }

    /// Whether the alarm is on.
    #[must_use]
    pub fn alarm(&self) -> bool {
        self.alarm
    }

    /// What was found in the last second; NaN before a whole one, and after a gap.
    #[must_use]
    pub fn found(&self) -> &Found {
        &self.found
    }

    /// Whole seconds that have been judged.
    #[must_use]
    pub fn seconds(&self) -> u64 {
        self.seconds
    }

    /// Take one sample as it was measured; whether the alarm is on. What is no measurement is passed over.
    pub fn step(&mut self, sample: &Sample) -> bool {
        let channels = self.inputs_of(sample);
        if !channels.iter().all(|value| value.abs() < ABSURD) {
            return self.alarm;
        }
        let periods = self.last.map_or(0, |last| sample.sequence.wrapping_sub(last));
        let goes_on = (1..=self.bridged.max(1)).contains(&periods);
        if !goes_on {
            self.effects.reset();
        }
        self.measured &= sample.external_torque.is_finite();
        self.last = Some(sample.sequence);
        self.begins |= !goes_on;
        let Some(corrected) = self.effects.corrections.correct(sample, !goes_on) else {
            return self.alarm;
        };
        let now = self.inputs_of(&corrected.aligned);
        if std::mem::take(&mut self.begins) {
            self.restart(&now);
            return self.alarm;
        }
        // A torque acts from its sample to the next: around a moment it is half the old, half the new one.
        let mut from = self.inputs;
        from[TORQUE..LINK].copy_from_slice(&self.torque);
        for k in 1..=periods {
            let share = |ago: f64| (k as f64 - ago) / periods as f64;
            let at = |c: usize, share: f64| (1.0 - share) * from[c] + share * now[c];
            let torque = TORQUE..LINK;
            self.advance(&std::array::from_fn(|c| at(c, share(if torque.contains(&c) { 0.5 } else { 0.0 }))));
        }
        self.torque.copy_from_slice(&now[TORQUE..LINK]);
        self.alarm
    }

    fn restart(&mut self, now: &[f64; CHANNELS]) {
        self.inputs = *now;
        self.torque.copy_from_slice(&now[TORQUE..LINK]);
        self.channels = now.map(StateVariableFilter::<3>::rest);
        self.raw = [0.0; 2 * BALANCES];
        self.filtered = [[0.0; 2]; 2 * BALANCES];
        self.found = Found::NOTHING;
        self.ticks = 0;
        self.begin_second();
    }

    fn begin_second(&mut self) {
        self.squares = [0.0; 2 * BALANCES];
        self.cross = [0.0; MOTORS];
        self.measured = true;
    }

    /// One period: filters, balances, and at the end of a second its judgement.
    fn advance(&mut self, now: &[f64; CHANNELS]) {
        for (state, (before, now)) in self.channels.iter_mut().zip(self.inputs.iter().zip(now)) {
            self.light.smooth.apply(state, *before, *now);
        }
        self.inputs = *now;
        self.ticks += 1;
        let raw = self.balance();
        if !raw.iter().all(|value| value.abs() < ABSURD) {
            self.last = None; // outside the law's range: begin anew
            return;
        }
        for (state, (before, now)) in self.filtered.iter_mut().zip(self.raw.iter().zip(&raw)) {
            self.narrow.smooth.apply(state, *before, *now);
        }
        self.raw = raw;
        if self.ticks <= self.settle {
            return;
        }
        for (square, state) in self.squares.iter_mut().zip(&self.filtered) {
            *square += state[0] * state[0];
        }
        let link = self.filtered[self.motors.len()][0];
        for (cross, state) in self.cross.iter_mut().zip(&self.filtered) {
            *cross += state[0] * link;
        }
        if (self.ticks - self.settle) % self.window == 0 {
            self.judge();
            self.begin_second();
        }
    }

    /// One second: its rms beside what is foreseen of it.
    fn judge(&mut self) {
        let (balances, window) = (self.balances(), self.window as f64);
        let mean = self.squares.map(|sum| sum / window);
        let found = &mut self.found;
        for b in 0..BALANCES {
            (found.residual[b], found.torque[b]) = (mean[b].sqrt(), mean[BALANCES + b].sqrt());
        }
        found.cross = self.cross.map(|sum| sum / window);
        self.seconds += 1;
        let Some(baseline) = &self.baseline else { return };
        let largest = found.torque.iter().fold(0.0f64, |a, b| a.max(*b));
        let (mut worst, mut alarm) = (f64::NEG_INFINITY, false);
        let judged = if self.measured { balances } else { self.motors.len() };
        for b in 0..balances {
            let growth = (found.torque[b] / baseline.torque[b]).max(1.0);
            found.foreseen[b] = (baseline.residual[b] * growth).powi(2) + (FLOOR * largest).powi(2);
            if b >= judged {
                continue;
            }
            let x = (mean[b] / found.foreseen[b]).ln();
            alarm |= x > self.limit[b];
            if x - self.limit[b] > worst {
                worst = x - self.limit[b];
                (found.ratio, found.limit) = ((0.5 * x).exp(), (0.5 * self.limit[b]).exp());
            }
        }
        self.alarm = alarm;
    }

    /// Where the effect that the model lacks is likely to sit: the place that explains most of both balances.
    ///
    /// An effect of the motor or of the link is in its own balance alone, one of the transmission is the same
    /// torque in both. What each of these leaves is compared in units of what is foreseen.
    #[must_use]
    pub fn location(&self) -> &'static str {
        let Found { residual, foreseen, cross, .. } = &self.found;
        let motors = self.motors.len();
        let foreseen = foreseen.map(|square| if square > 0.0 { square } else { 1.0 });
        let over = |b: usize| residual[b] * residual[b] / foreseen[b];
        let worst = (1..motors).fold(0, |worst, i| if over(i) > over(worst) { i } else { worst });
        if !self.linked {
            return if self.motors[worst].flexible { "motor or transmission" } else { "motor" };
        }
        let both = residual[worst].powi(2) + residual[motors].powi(2) - 2.0 * cross[worst];
        let left = [
            ("motor", over(motors)),
            ("link", over(worst)),
            ("transmission", both / (foreseen[worst] + foreseen[motors])),
        ];
        left.iter().fold(left[0], |least, one| if one.1 < least.1 { *one } else { least }).0
    }
}

#[cfg(test)]
mod tests;
