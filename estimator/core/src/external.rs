//! External torque on the link, as a residual of the link's momentum (eqs 4, 6).
//!
//! ```text
//! τ_k = M q″ + D_q q′ + g(q) + x_link + τ_e                                                    (eqs 4, 6)
//! ```
//! Every term passes the same filter, so nothing is differentiated: M q′ is the momentum, its derivative
//! behind the filter is M q″. Robust mode takes τ_e from the transmission's curve at the measured deflection,
//! free of the motor's friction; mode paper takes it from eq 14. Without τ_e the same sum is eqs 12 and 13,
//! the flexibility torque from the link side; their difference is the external torque minus its measurement.
//!
//! What is not noise does not average out: an inertia 5 % off is 5 % off as long as the link accelerates. So
//! the declared uncertainties, and that of the curve, make a band that nothing inside of it is called a
//! contact; a sequential test (Page's CUSUM, "Continuous inspection schemes", Biometrika 1954) adds up what
//! is beyond it, in units of the noise that is left.

mod contact;
mod link_errors;
mod paper;

pub use contact::ContactTest;
pub use paper::PaperMomentum;

use serde::{Deserialize, Serialize};

use crate::choices::{BLOCK_S, BLOCKS, LATEST, LINK_FLOOR, SETTLED, SLOW_S};
use crate::effects::{Coordinates, Element};
use crate::filters::StateVariableFilter;
use crate::model::{Link, Model};
use crate::settings::{Priors, Settings};
use crate::signals::Lanes;
use contact::Judge;
use link_errors::{DRY, LinkErrors};

/// Of how far the declared link is off, as that of the regression, s.
const MEMORY_S: f64 = BLOCKS as f64 * BLOCK_S;
const TINY: f64 = 1e-12; // keeps a division finite
// Channels: q, g, τ_e, τ_k, and what a late sample is off by in q and in g + τ_e.
const POSITION: usize = 0;
const GRAVITY: usize = 1;
const CARRIED: usize = 2;
const MEASURED: usize = 3;
const SHIFTED: usize = 4;
const PULLED: usize = 5;
const CHANNELS: usize = 6;

/// Bits of [`External::status`].
pub mod status {
    /// The numbers may be used.
    pub const VALID: u32 = 1 << 0;
    /// Something touches the link; only where valid.
    pub const CONTACT: u32 = 1 << 1;
}

/// What the world does to the link at one SYNC.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct External {
    /// That of the sample.
    pub sequence: u64,
    /// See [`status`].
    pub status: u32,
    /// τ_k of eqs 4, 6, N·m.
    pub torque: f64,
    /// Its standard deviation, N·m.
    pub torque_std: f64,
    /// −r of eqs 12, 13: τ_e,t from the link side, N·m.
    pub link_torque: f64,
    /// τ_e,t of the motor side less that: what the model leaves, or a torque that nobody measured, N·m.
    pub difference: f64,
}

impl External {
    /// Nothing is known.
    #[must_use]
    pub fn nothing(sequence: u64) -> External {
        let unknown = f64::NAN;
        External {
            sequence,
            status: 0,
            torque: unknown,
            torque_std: unknown,
            link_torque: unknown,
            difference: unknown,
        }
    }

    /// The same at another cycle, where it may not be used.
    #[must_use]
    pub fn void(self, sequence: u64) -> External {
        External { sequence, status: 0, ..self }
    }
}

/// What a transmission, or all of them, do to the link at one deflection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Carried {
    /// τ_e,t, with what else the transmissions transmit, N·m.
    pub torque: f64,
    /// Its variance, (N·m)², as the curve is uncertain; a skew between the encoders is not in it …
    pub variance: f64,
    /// … but here: what the torque lacks by it over the link's velocity, N·m·s/rad …
    pub skew: f64,
    /// … and its standard deviation; a late link is late for both motors.
    pub skew_std: f64,
    /// σ_t, N·m/rad.
    pub stiffness: f64,
    /// Variance that the motors' encoders give it, (N·m)².
    pub reading: f64,
}

impl Carried {
    /// Both pull at the link (eqs 9, 11); their errors are independent but for the skew.
    #[must_use]
    pub fn and(self, other: Carried) -> Carried {
        Carried {
            torque: self.torque + other.torque,
            variance: self.variance + other.variance,
            skew: self.skew + other.skew,
            skew_std: self.skew_std + other.skew_std,
            stiffness: self.stiffness + other.stiffness,
            reading: self.reading + other.reading,
        }
    }
}

/// What was published last; and mean squares of the flexibility torque's difference between both sides, and of the link's.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Latest {
    now: External,
    squares: Option<[f64; 2]>,
}

impl Latest {
    fn nothing() -> Latest {
        Latest { now: External::nothing(0), squares: None }
    }

    fn publish(&mut self, external: External, span_s: f64) -> External {
        self.now = external;
        if external.status & status::VALID != 0 {
            let now = [external.difference, external.link_torque].map(|torque| torque * torque);
            let squares = self.squares.get_or_insert(now);
            let gain = (span_s / SLOW_S).min(1.0);
            (0..2).for_each(|i| squares[i] += gain * (now[i] - squares[i]));
        }
        external
    }

    /// The same of a sample that was not used.
    #[must_use]
    pub fn repeat(&self, sequence: u64) -> External {
        self.now.void(sequence)
    }

    /// rms of the difference and of the link's flexibility torque over some seconds, N·m.
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.squares.map(|squares| squares.map(f64::sqrt))
    }
}

fn gravity(link: &Link, q: f64) -> f64 {
    link.gravity * (q + link.gravity_phase).sin()
}

/// The link's momentum of robust mode: everything through F(s) = w³/(s + w)³.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct LinkMomentum {
    link: Link,
    effects: Vec<Element>,
    period: f64,
    filter: StateVariableFilter<3>,
    gains: [f64; 3], // Σh² of F, s F, s² F
    settle: i64,
    unsettled: i64,
    known: bool, // whether τ_e is
    moved: bool, // whether q may count from elsewhere than gravity's phase is declared from
    channels: Lanes<3, CHANNELS>,
    dry: f64, // undeclared dry friction, as a share of the torque carried
    errors: LinkErrors,
    judge: Judge,
    trailing: f64, // the published torque behind one more delay of the filter
    /// See [`Latest`].
    pub latest: Latest,
}

impl LinkMomentum {
    /// Of a model whose link dynamics are declared; `None` without them.
    #[must_use]
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Option<LinkMomentum> {
        let link = model.link?;
        let bandwidth = settings.external_bandwidth.min(0.25 / period_s);
        let filter = StateVariableFilter::<3>::new(bandwidth, period_s);
        let delay = 3.0 / filter.bandwidth;
        let (mut state, mut gains, mut before) = ([0.0; 3], [0.0; 3], 0.0);
        for k in 0..(12.0 * delay / period_s).ceil() as usize {
            let now = if k == 0 { 1.0 } else { 0.0 };
            filter.smooth.apply(&mut state, before, now);
            before = now;
            (0..3).for_each(|i| gains[i] += state[i] * state[i]);
        }
        Some(LinkMomentum {
            link,
            effects: model.link_effects.iter().filter(|element| element.acts_on_link()).copied().collect(),
            period: period_s,
            gains,
            settle: (SETTLED * delay / period_s).ceil() as i64,
            unsettled: 0,
            known: false,
            moved: false,
            channels: Lanes::default(),
            judge: Judge::new(settings, filter.bandwidth, period_s),
            filter,
            dry: priors.coulomb_friction,
            errors: LinkErrors::default(),
            trailing: 0.0,
            latest: Latest::nothing(),
        })
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.judge.reset();
        self.errors = LinkErrors::default();
        self.latest = Latest::nothing();
        (self.unsettled, self.moved) = (self.settle, false);
    }

    /// Positions may count from anywhere: q may, too, where all have moved alike and no deflection shows it.
    pub fn lose_zero(&mut self) {
        self.reset();
        self.moved = true;
    }

    /// The filters hold something wrong.
    pub fn distrust(&mut self) {
        self.unsettled = self.settle;
        self.judge.test.reset();
    }

    /// The link is later, or earlier, than was assumed: what was learned is of other moments.
    pub fn shift(&mut self) {
        self.errors = LinkErrors::default();
        self.distrust();
    }

    /// At rest here.
    pub fn restart(&mut self, q: f64, carried: f64) {
        self.channels = Lanes::rest([q, gravity(&self.link, q), carried, 0.0, 0.0, 0.0]);
        self.distrust();
    }

    /// Whether q may count from elsewhere since its zero was lost: gravity is then known by its size alone.
    pub fn note_zero(&mut self, moved: bool) {
        if moved && !self.moved {
            self.errors = LinkErrors::default();
        }
        self.moved |= moved;
    }

    /// One period: q, what the transmissions do to the link where that is known, and τ_k where it is measured.
    ///
    /// `late`: by how much they are later than their period, s. Each is then off by its rate times that.
    pub fn feed(&mut self, q: f64, carried: Option<f64>, measured: f64, late: f64) {
        let known = carried.filter(|torque| torque.is_finite());
        let external = if measured.is_finite() { measured } else { 0.0 };
        let ahead = 3.0 / self.filter.bandwidth; // the filtered rates are as old as that
        let [_, rates, bends] = self.channels.state;
        let off = |channel: usize| late * (rates[channel] + ahead * bends[channel]);
        let (shifted, pulled) = (off(POSITION), off(GRAVITY) + off(CARRIED));
        let carried = known.unwrap_or(self.channels.last[CARRIED]);
        let now = [q, gravity(&self.link, q), carried, external, shifted, pulled];
        self.channels.smooth(&self.filter, now);
        self.unsettled -= 1;
        self.known = known.is_some();
        if !self.known || late > LATEST * self.period {
            self.distrust();
        }
    }

    /// What the declared link leaves of one balance; variances that the curve and the readings give it.
    fn learn(&mut self, row: &link_errors::Row, left: f64, curve: f64, readings: f64) {
        let expected = curve + readings;
        let doubt = self.errors.doubt(left, expected, self.period);
        if self.errors.is_usual(left, expected) {
            // Errors of readings last as long as the filter does.
            let lasting = (readings / self.filter.bandwidth).max(self.errors.lasting());
            self.errors.identify(row, left, doubt * lasting / self.period);
        }
    }

    /// What is published of a sample that was used.
    ///
    /// `valid`: whether the estimate is; `noise`: variance of q's noise, rad².
    pub fn conclude(&mut self, sequence: u64, carried: &Carried, noise: f64, valid: bool) -> External {
        if !self.known {
            return self.latest.publish(External::nothing(sequence), self.period);
        }
        let link = &self.link;
        let [now, rates, bends] = self.channels.state;
        let [position, velocity, acceleration] = [now[POSITION], rates[POSITION], bends[POSITION]];
        let c = Coordinates {
            link_position: position,
            link_velocity: velocity,
            link_acceleration: acceleration,
            ..Coordinates::default()
        };
        let own = link.inertia * acceleration + link.damping * velocity + now[GRAVITY];
        let own = own + self.effects.iter().map(|element| element.torque(&c)).sum::<f64>();
        let sum = own + now[CARRIED];
        let damping = link.damping_std.powi(2) + carried.skew_std.powi(2);
        // From another phase, gravity is off by up to twice its amplitude.
        let anywhere = if self.moved { 2.0 * link.gravity } else { 0.0 };
        let (dry, gravity) = (self.dry * self.judge.largest, link.gravity_std.powi(2) + anywhere * anywhere);
        let prior = [f64::INFINITY, link.inertia_std.powi(2), damping, gravity, gravity, dry * dry];
        let row = self.errors.row(link, [position, velocity, acceleration]);
        self.errors.forget(row[DRY], self.period);
        let row = std::array::from_fn(|i| if prior[i] > 0.0 { row[i] } else { 0.0 }); // 0: known exactly
        let (off, unknown) = self.errors.at(&row, &prior, -carried.skew, self.effects.is_empty());
        // A reading that is rounded errs alike for as long as it stands: what the spring makes of it is no noise.
        let read = carried.reading + carried.stiffness.powi(2) * noise;
        let white = noise * (link.inertia.powi(2) * self.gains[2] + link.damping.powi(2) * self.gains[1]);
        let late = link.inertia * bends[SHIFTED] + link.damping * rates[SHIFTED] + now[PULLED];
        let late = late * late;
        let around = carried.variance + read + unknown + late;
        let valid = valid && self.unsettled <= 0 && (sum + around + white).is_finite();
        let (torque, contact) = self.judge.judge(sum - off, now[CARRIED], around, white, valid);
        if valid {
            let curve = carried.variance + (LINK_FLOOR * self.judge.largest).powi(2);
            self.learn(&row, sum - now[MEASURED], curve, read + white + late);
        }
        // What it has changed by over the filter's delay, it may have changed by since.
        let moved = torque - self.trailing;
        self.trailing +=
            if valid { (self.period * self.filter.bandwidth / 3.0).min(1.0) * moved } else { moved };
        let external = External {
            sequence,
            status: if valid { status::VALID } else { 0 } | if contact { status::CONTACT } else { 0 },
            torque,
            torque_std: (around + white + moved * moved).sqrt(),
            link_torque: now[MEASURED] - own,
            difference: sum + carried.skew * velocity - now[MEASURED],
        };
        self.latest.publish(external, self.period)
    }
}

#[cfg(test)]
mod tests;
