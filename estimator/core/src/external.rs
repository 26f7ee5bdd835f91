//! What touches the link: the torque of the environment as a residual of the link's momentum (eqs 4, 6).
//!
//! ```text
//! τ_k = M q″ + D_q q′ + g(q) + x_link + τ_e                                                    (eqs 4, 6)
//! ```
//! Every term passes the same filter, so nothing is differentiated: M q′ is the momentum, its derivative
//! behind the filter is M q″. Robust mode takes τ_e from the transmission's curve at the measured deflection,
//! which knows nothing of the motor's friction; mode paper takes it from eq 14. Without τ_e the same sum is
//! eqs 12 and 13, the flexibility torque from the link side; the difference of the two is the external
//! torque, less what was measured of it.
//!
//! What is not noise does not average out: an inertia 5 % off is 5 % off as long as the link accelerates. So
//! the declared uncertainties, and that of the curve, make a band that nothing inside of it is called a
//! contact; a sequential test (Page's CUSUM, "Continuous inspection schemes", Biometrika 1954) adds up what
//! is beyond it, in units of the noise that is left.

use crate::effects::{Coordinates, Element};
use crate::filters::{StateVariableFilter, first_order_pole};
use crate::model::{Link, Model};
use crate::noise::NoiseMeter;
use crate::sample::{MOTORS, Sample};
use crate::settings::{Priors, Settings};

const BAND_SIGMA: f64 = 3.0; // of what is declared: so many joints in a thousand are further off than they say
const SHARE: f64 = 0.05; // of the torque carried: the least contact, where none is declared; what bearings take
const FIND_S: f64 = 0.02; // in which the test is to find the smallest push it can
const SETTLED: f64 = 4.5; // delays of the filter after which a wrong start is forgotten
const UNCORRELATED: f64 = 0.697; // w t from which on the noise of s² w³/(s + w)³ is not positively correlated
const OVERSHOOT: f64 = 1.166; // of a sum over its threshold, standard deviations (Siegmund 1985, chapter X)
const CAP: f64 = 2.0; // thresholds that a sum may reach: a long contact ends as soon as a short one
const MEMORY_S: f64 = 20.0; // of how far the declared link is off, as that of the regression
const FRICTION_SPEEDS: f64 = 0.02; // of the largest velocity: over which dry friction changes its sign
const ONE_WAY: f64 = 0.9; // mean direction beyond which less than a twentieth of the motion goes the other way
const PARAMETERS: usize = 6; // of `LinkErrors`
const CONSTANT: usize = 0;
const DAMPING: usize = 2;
const DRY: usize = 3;
const FLOOR: f64 = 1e-3; // of the torque carried: no curve is known better
const CONSISTENCY_S: f64 = 10.0; // over which the two flexibility torques are compared
const TINY: f64 = 1e-12;

/// Bits of [`External::status`].
pub mod status {
    /// The numbers may be used.
    pub const VALID: u32 = 1 << 0;
    /// Something touches the link; only where valid.
    pub const CONTACT: u32 = 1 << 1;
}

/// What the world does to the link at one SYNC.
#[derive(Clone, Copy, Debug, PartialEq)]
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
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Carried {
    /// τ_e,t, with what else the transmissions transmit, N·m.
    pub torque: f64,
    /// Its variance, (N·m)², as the curve is uncertain; a skew between the encoders is not in it.
    pub variance: f64,
    /// σ_t, N·m/rad.
    pub stiffness: f64,
    /// Variance that the motors' encoders give it, (N·m)².
    pub reading: f64,
}

impl Carried {
    /// Both pull at the link (eqs 9, 11); their errors are independent.
    #[must_use]
    pub fn and(self, other: Carried) -> Carried {
        Carried {
            torque: self.torque + other.torque,
            variance: self.variance + other.variance,
            stiffness: self.stiffness + other.stiffness,
            reading: self.reading + other.reading,
        }
    }
}

// -- contact ---------------------------------------------------------------------------------------

/// A two-sided CUSUM of what is beyond a band.
///
/// Its reference value is the one with which the smallest push is found in [`FIND_S`], its threshold follows
/// from the rate of false alarms by Siegmund's approximation of the average run length. Torques are looked
/// at so far apart that their noise is not positively correlated, so the rate is an upper bound.
#[derive(Clone, Debug)]
pub struct ContactTest {
    every: u32,
    reference: f64,
    threshold: f64,
    ticks: u32,
    sums: [f64; 2],
    contact: bool,
}

impl ContactTest {
    /// For torques behind a filter of this bandwidth, seen every period.
    #[must_use]
    pub fn new(false_alarms_per_hour: f64, bandwidth: f64, period_s: f64) -> ContactTest {
        let every = (UNCORRELATED / (bandwidth * period_s)).ceil().max(1.0);
        let dt = every * period_s;
        // Two one-sided tests, each with half of the false alarms.
        let run = (2.0 * 3600.0 / (false_alarms_per_hour * dt)).max(2.0);
        let looks = (FIND_S / dt).round().max(1.0);
        let (mut best, mut reference, mut threshold) = (f64::INFINITY, 0.0, 0.0);
        for step in 1..=80 {
            let k = 0.05 * f64::from(step);
            let h = threshold_of(k, run);
            if h / looks + k < best {
                (best, reference, threshold) = (h / looks + k, k, h);
            }
        }
        ContactTest { every: every as u32, reference, threshold, ticks: 0, sums: [0.0; 2], contact: false }
    }

    /// Nothing has been seen.
    pub fn reset(&mut self) {
        (self.ticks, self.sums, self.contact) = (0, [0.0; 2], false);
    }

    /// One sample: whether something touches the link.
    ///
    /// `band`: what no contact is, N·m; `noise`: standard deviation of the rest.
    pub fn see(&mut self, torque: f64, band: f64, noise: f64) -> bool {
        self.ticks += 1;
        if self.ticks < self.every {
            return self.contact;
        }
        self.ticks = 0;
        for (sum, side) in self.sums.iter_mut().zip([1.0, -1.0]) {
            let beyond = (side * torque - band) / noise.max(TINY) - self.reference;
            *sum = (*sum + beyond).clamp(0.0, CAP * self.threshold);
        }
        let largest = self.sums[0].max(self.sums[1]);
        self.contact = largest > self.threshold || (self.contact && largest > 0.0);
        self.contact
    }
}

/// h at which a one-sided CUSUM of white noise with reference value k has this average run length.
fn threshold_of(k: f64, run: f64) -> f64 {
    let (mut low, mut high) = (0.0, 1e3);
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        let e = 2.0 * k * (middle + OVERSHOOT);
        let length = (e.min(700.0).exp() - 1.0 - e) / (2.0 * k * k);
        if length < run { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// What both modes do with the sum once they have it: a bias that follows, the band, the test.
#[derive(Clone, Debug)]
struct Judge {
    least: Option<f64>,
    follow: f64, // share of the residual that the bias takes in a period; 0: there is none
    bias: f64,
    largest: f64, // torque carried while nothing touched the link
    test: ContactTest,
}

impl Judge {
    fn new(settings: &Settings, bandwidth: f64, period_s: f64) -> Judge {
        let bias_s = settings.external_bias_s;
        Judge {
            least: settings.contact_torque,
            follow: bias_s.map_or(0.0, |bias_s| (period_s / bias_s).min(1.0)),
            bias: 0.0,
            largest: 0.0,
            test: ContactTest::new(settings.contact_false_alarms_per_hour, bandwidth, period_s),
        }
    }

    fn reset(&mut self) {
        (self.bias, self.largest) = (0.0, 0.0);
        self.test.reset();
    }

    /// The torque without its bias, and whether something touches the link.
    fn see(&mut self, sum: f64, carried: f64, uncertain: f64, noise: f64, valid: bool) -> (f64, bool) {
        if !valid {
            return (sum - self.bias, false); // a contact that lasts is one still when it is valid again
        }
        self.bias += self.follow * (sum - self.bias);
        let least = self.least.unwrap_or(SHARE * self.largest);
        let band = least.max(BAND_SIGMA * uncertain.sqrt());
        let contact = self.test.see(sum - self.bias, band, noise.sqrt());
        if !contact {
            self.largest = self.largest.max(carried.abs());
        }
        (sum - self.bias, contact)
    }
}

/// Do both sides of the joint agree on the flexibility torque? Mean squares of their difference and of the link's.
#[derive(Clone, Copy, Debug, Default)]
struct Consistency {
    squares: Option<[f64; 2]>,
}

impl Consistency {
    fn see(&mut self, external: &External, period_s: f64) {
        if external.status & status::VALID == 0 {
            return;
        }
        let now = [external.difference * external.difference, external.link_torque * external.link_torque];
        let squares = self.squares.get_or_insert(now);
        let gain = (period_s / CONSISTENCY_S).min(1.0);
        (0..2).for_each(|i| squares[i] += gain * (now[i] - squares[i]));
    }

    fn rms(&self) -> Option<[f64; 2]> {
        self.squares.map(|squares| squares.map(f64::sqrt))
    }
}

fn gravity(link: &Link, q: f64) -> f64 {
    link.gravity * (q + link.gravity_phase).sin()
}

/// How far the declared link is off: identified from the link's own balance, where that is as expected.
///
/// Parameters: a constant torque, inertia, viscous damping, dry friction, gravity's sine and cosine. The
/// declared uncertainties are the priors. Recursive least squares with exponential forgetting in information
/// form: Λ = Λ₀ + Σ e^(−t/20 s) x xᵀ/r.
///
/// The constant may be a push: it is identified with a flat prior so that the others have to explain what varies
/// with the motion, and it is not taken off: a load on a link at rest is no gravity. Of a link that turns one way
/// only, a load and friction are the same even so, since the load changes the speed: no friction is identified
/// there. A skew between the encoders makes σ d q′, which looks like damping; from the motor's side it looks like
/// the motor's friction.
#[derive(Clone, Copy, Debug, Default)]
struct LinkErrors {
    information: [[f64; PARAMETERS]; PARAMETERS], // of the data alone; the lower triangle
    vector: [f64; PARAMETERS],
    fastest: f64,
    direction: Option<f64>, // its mean over the memory: ±1 one way only, 0 to and fro
}

type Row = [f64; PARAMETERS];

impl LinkErrors {
    /// What the parameters multiply.
    fn row(&mut self, link: &Link, [q, velocity, acceleration]: [f64; 3]) -> Row {
        self.fastest = self.fastest.max(velocity.abs());
        let dry = (velocity / (FRICTION_SPEEDS * self.fastest).max(TINY)).tanh();
        let (sine, cosine) = (q + link.gravity_phase).sin_cos();
        [1.0, acceleration, velocity, dry, sine, cosine]
    }

    /// One period of motion in this direction (−1 to 1) passes.
    fn forget(&mut self, direction: f64, period_s: f64) {
        let kept = 1.0 - period_s / MEMORY_S;
        let mean = self.direction.unwrap_or(direction.signum());
        self.direction = Some(direction + kept * (mean - direction));
        self.information.iter_mut().flatten().chain(&mut self.vector).for_each(|x| *x *= kept);
    }

    /// The torque that these errors make, and its variance.
    fn at(&self, row: &Row, prior: &Row) -> (f64, f64) {
        let mut factor = self.information;
        let least = prior.map(|variance| if variance > 0.0 { 1.0 / variance } else { 1.0 });
        for i in 0..PARAMETERS {
            factor[i][i] += least[i];
        }
        // Cholesky, and L⁻¹ of both sides on the way. No pivot is less than what was known before any data.
        let mut own = *row;
        own[CONSTANT] = 0.0;
        let mut vector = self.vector;
        let (mut torque, mut variance) = (0.0, 0.0);
        for i in 0..PARAMETERS {
            for j in 0..=i {
                let sum: f64 = (0..j).map(|k| factor[i][k] * factor[j][k]).sum();
                let left = factor[i][j] - sum;
                factor[i][j] =
                    if i == j { left.max(least[i]).max(TINY * TINY).sqrt() } else { left / factor[j][j] };
            }
            for k in 0..i {
                own[i] -= factor[i][k] * own[k];
                vector[i] -= factor[i][k] * vector[k];
            }
            own[i] /= factor[i][i];
            vector[i] /= factor[i][i];
            torque += own[i] * vector[i];
            variance += own[i] * own[i];
        }
        (torque, variance)
    }

    /// What the declared link leaves of one balance; `noise`: its variance, as if errors were independent.
    fn identify(&mut self, row: &Row, left: f64, noise: f64) {
        let weight = 1.0 / noise.max(TINY * TINY);
        let mut row = *row;
        if self.direction.is_none_or(|mean| mean.abs() > ONE_WAY) {
            (row[DAMPING], row[DRY]) = (0.0, 0.0);
        }
        for i in 0..PARAMETERS {
            self.vector[i] += weight * row[i] * left;
            for j in 0..=i {
                self.information[i][j] += weight * row[i] * row[j];
            }
        }
    }
}

// -- robust mode -----------------------------------------------------------------------------------

/// The link's momentum of robust mode: everything through F(s) = w³/(s + w)³.
#[derive(Clone, Debug)]
pub struct LinkMomentum {
    link: Link,
    effects: Vec<Element>,
    period: f64,
    filter: StateVariableFilter<3>,
    gains: [f64; 3], // Σh² of F, s F, s² F
    settle: i64,
    unsettled: i64,
    known: bool, // whether τ_e is
    position: [f64; 3],
    gravity: [f64; 3],
    carried: [f64; 3],
    measured: [f64; 3],
    last: [f64; 4], // q, g, τ_e, τ_k
    skew: f64,      // between the encoders, before any data, s
    dry: f64,       // undeclared dry friction, as a share of the torque carried
    errors: LinkErrors,
    judge: Judge,
    consistency: Consistency,
    now: External,
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
            position: [0.0; 3],
            gravity: [0.0; 3],
            carried: [0.0; 3],
            measured: [0.0; 3],
            last: [0.0; 4],
            judge: Judge::new(settings, filter.bandwidth, period_s),
            filter,
            skew: priors.encoder_delay * period_s,
            dry: priors.coulomb_friction,
            errors: LinkErrors::default(),
            consistency: Consistency::default(),
            now: External::nothing(0),
        })
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.judge.reset();
        self.errors = LinkErrors::default();
        self.consistency = Consistency::default();
        self.now = External::nothing(0);
        self.unsettled = self.settle;
    }

    /// The filters hold something wrong.
    pub fn distrust(&mut self) {
        self.unsettled = self.settle;
        self.judge.test.reset();
    }

    /// At rest here.
    pub fn restart(&mut self, q: f64, carried: f64) {
        let rest = StateVariableFilter::<3>::rest;
        self.last = [q, gravity(&self.link, q), carried, 0.0];
        (self.position, self.gravity, self.carried) = (rest(q), rest(self.last[1]), rest(carried));
        self.measured = rest(0.0);
        self.distrust();
    }

    /// One period: q, what the transmissions do to the link where that is known, and τ_k where it is measured.
    pub fn feed(&mut self, q: f64, carried: Option<f64>, measured: f64) {
        let before = self.last;
        let known = carried.filter(|torque| torque.is_finite());
        let external = if measured.is_finite() { measured } else { 0.0 };
        self.last = [q, gravity(&self.link, q), known.unwrap_or(before[2]), external];
        let channels = [&mut self.position, &mut self.gravity, &mut self.carried, &mut self.measured];
        for (i, channel) in channels.into_iter().enumerate() {
            self.filter.smooth.apply(channel, before[i], self.last[i]);
        }
        self.unsettled -= 1;
        self.known = known.is_some();
        if !self.known {
            self.distrust();
        }
    }

    /// What is said of a sample that was used.
    ///
    /// `valid`: whether the estimate is; `noise`: variance of q's noise, rad².
    pub fn conclude(&mut self, sequence: u64, carried: &Carried, noise: f64, valid: bool) -> External {
        if !self.known {
            self.now = External::nothing(sequence);
            return self.now;
        }
        let link = &self.link;
        let [position, velocity, acceleration] = self.position;
        let c = Coordinates {
            link_position: position,
            link_velocity: velocity,
            link_acceleration: acceleration,
            ..Coordinates::default()
        };
        let own = link.inertia * acceleration + link.damping * velocity + self.gravity[0];
        let own = own + self.effects.iter().map(|element| element.torque(&c)).sum::<f64>();
        let sum = own + self.carried[0];
        let damping = link.damping_std.powi(2) + (carried.stiffness * self.skew).powi(2);
        let (dry, gravity) = (self.dry * self.judge.largest, link.gravity_std.powi(2));
        let prior = [f64::INFINITY, link.inertia_std.powi(2), damping, dry * dry, gravity, gravity];
        let row = self.errors.row(link, self.position);
        self.errors.forget(row[DRY], self.period);
        let row = std::array::from_fn(|i| if prior[i] > 0.0 { row[i] } else { 0.0 }); // 0: known exactly
        let (off, unknown) = self.errors.at(&row, &prior);
        // A reading that is rounded errs alike for as long as it stands: what the spring makes of it is no noise.
        let read = carried.reading + carried.stiffness.powi(2) * noise;
        let white = noise * (link.inertia.powi(2) * self.gains[2] + link.damping.powi(2) * self.gains[1]);
        let around = carried.variance + read + unknown;
        let valid = valid && self.unsettled <= 0 && (sum + around + white).is_finite();
        let (torque, contact) = self.judge.see(sum - off, self.carried[0], around, white, valid);
        let usual = torque.abs() <= BAND_SIGMA * (around + white).sqrt();
        if valid && usual && !contact {
            // Errors of readings last as long as the filter does; that of the curve does not average out at all.
            let curve = carried.variance + (FLOOR * self.judge.largest).powi(2);
            let lasting = (read + white) / self.filter.bandwidth + curve * MEMORY_S;
            self.errors.identify(&row, sum - self.measured[0], lasting / self.period);
        }
        self.now = External {
            sequence,
            status: if valid { status::VALID } else { 0 } | if contact { status::CONTACT } else { 0 },
            torque,
            torque_std: (around + white).sqrt(),
            link_torque: self.measured[0] - own,
            difference: sum - self.measured[0],
        };
        self.consistency.see(&self.now, self.period);
        self.now
    }

    /// rms of the difference and of the link's flexibility torque over some seconds, N·m.
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.consistency.rms()
    }

    /// What was said last, of a sample that was not used.
    #[must_use]
    pub fn carry(&self, sequence: u64) -> External {
        self.now.void(sequence)
    }
}

// -- mode paper ------------------------------------------------------------------------------------

/// K s/(s + K) of one term of y, see `estimator.residuals.first_order`.
#[derive(Clone, Copy, Debug, Default)]
struct Term {
    value: f64,
    last: Option<f64>,
}

impl Term {
    fn update(&mut self, y: f64, pole: f64, span_s: f64) -> f64 {
        let before = self.last.replace(y).unwrap_or(y);
        self.value = pole * self.value + (1.0 - pole) * (y - before) / span_s;
        self.value
    }
}

/// Eq 12 as printed: r = K (p_q + D_q q − ∫(τ_k − g(q) + r)), which obeys eq 13.
///
/// y = M q′ + D_q q − ∫(τ_k − g) is a sum, and K s/(s + K) is linear: each term has its own residual, so that
/// what is uncertain of each is known. τ_k and g are smooth: their integrals are trapezoidal.
#[derive(Clone, Debug)]
pub struct PaperMomentum {
    link: Link,
    k: f64,
    period: f64,
    friction: f64, // of the motor side, as a share of the torque: eq 14 has it in τ_e
    settle: i64,
    unsettled: i64,
    momentum: Term,
    damped: Term,
    fallen: Term,
    pushed: Term,
    integrals: [f64; 2],    // of g and of τ_k
    last: Option<[f64; 3]>, // q, g, τ_k
    noise: NoiseMeter,
    judge: Judge,
    consistency: Consistency,
    now: External,
}

impl PaperMomentum {
    /// See [`LinkMomentum::new`].
    #[must_use]
    pub fn new(model: &Model, settings: &Settings, priors: &Priors, period_s: f64) -> Option<PaperMomentum> {
        let link = model.link?;
        Some(PaperMomentum {
            link,
            k: settings.k_tau,
            period: period_s,
            friction: priors.coulomb_friction,
            settle: (SETTLED / (settings.k_tau * period_s)).ceil() as i64,
            unsettled: 0,
            momentum: Term::default(),
            damped: Term::default(),
            fallen: Term::default(),
            pushed: Term::default(),
            integrals: [0.0; 2],
            last: None,
            noise: NoiseMeter::default(),
            judge: Judge::new(settings, settings.k_tau, period_s),
            consistency: Consistency::default(),
            now: External::nothing(0),
        })
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        self.judge.reset();
        self.consistency = Consistency::default();
        self.now = External::nothing(0);
        self.restart();
    }

    /// Integrals and residuals begin anew.
    pub fn restart(&mut self) {
        for term in [&mut self.momentum, &mut self.damped, &mut self.fallen, &mut self.pushed] {
            *term = Term::default();
        }
        (self.integrals, self.last) = ([0.0; 2], None);
        self.noise.restart();
        self.judge.test.reset();
        self.unsettled = self.settle;
    }

    /// One sample that was used, so many periods after the last one.
    ///
    /// `internal`: r of eq 14 for the whole joint; `balance`: its y; `valid`: whether the estimate is.
    pub fn update(
        &mut self,
        sample: &Sample,
        periods: u32,
        internal: f64,
        balance: f64,
        valid: bool,
    ) -> External {
        let span = self.period * f64::from(periods);
        let q = sample.link_position;
        let tau = if sample.external_torque.is_finite() { sample.external_torque } else { 0.0 };
        let g = gravity(&self.link, q);
        let Some(before) = self.last.replace([q, g, tau]) else {
            // Where y begins; without a measured velocity the momentum begins with the first difference.
            let measured = Some(sample.link_velocity).filter(|velocity| velocity.is_finite());
            self.momentum.last = measured.map(|velocity| self.link.inertia * velocity);
            self.damped.last = Some(self.link.damping * q);
            (self.fallen.last, self.pushed.last) = (Some(0.0), Some(0.0));
            return self.carry(sample.sequence);
        };
        let velocity =
            if sample.link_velocity.is_finite() { sample.link_velocity } else { (q - before[0]) / span };
        self.integrals[0] += 0.5 * span * (g + before[1]);
        self.integrals[1] += 0.5 * span * (tau + before[2]);
        let pole = first_order_pole(self.k, span);
        let (p, damped) = (self.link.inertia * velocity, self.link.damping * q);
        let inertial = self.momentum.update(p, pole, span);
        let viscous = self.damped.update(damped, pole, span);
        let weight = self.fallen.update(self.integrals[0], pole, span);
        let known = self.pushed.update(self.integrals[1], pole, span);
        self.noise.see(p + damped + self.integrals[0] + balance, span);
        self.unsettled -= i64::from(periods);
        let sum = internal + inertial + viscous + weight;
        let link = &self.link;
        let uncertain = (link.inertia_std / link.inertia * inertial).powi(2)
            + (link.damping_std / link.damping.max(TINY) * viscous).powi(2)
            + link.gravity_std.powi(2)
            + (self.friction * internal).powi(2);
        let gain = 2.0 * ((1.0 - pole) / span).powi(2) / (1.0 + pole);
        let white = gain * self.noise.variance(f64::INFINITY);
        let valid = valid && self.unsettled <= 0 && (sum + uncertain + white).is_finite();
        let (torque, contact) = self.judge.see(sum, internal, uncertain, white, valid);
        self.now = External {
            sequence: sample.sequence,
            status: if valid { status::VALID } else { 0 } | if contact { status::CONTACT } else { 0 },
            torque,
            torque_std: (uncertain + white).sqrt(),
            link_torque: known - inertial - viscous - weight,
            difference: sum - known,
        };
        self.consistency.see(&self.now, span);
        self.now
    }

    /// See [`LinkMomentum::consistency`].
    #[must_use]
    pub fn consistency(&self) -> Option<[f64; 2]> {
        self.consistency.rms()
    }

    /// What was said last, of a sample that was not used.
    #[must_use]
    pub fn carry(&self, sequence: u64) -> External {
        self.now.void(sequence)
    }
}

const _: () = assert!(MOTORS == 2);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{Arrangement, Motor, Transmission};

    const T: f64 = 1e-3;

    fn joint(link: Link) -> Model {
        let motor = Motor {
            inertia: 0.1,
            inertia_std: None,
            damping: 0.2,
            transmission: Transmission::Unknown,
            effects: Vec::new(),
        };
        Model {
            arrangement: Arrangement::Single,
            motors: vec![motor],
            link: Some(link),
            link_effects: Vec::new(),
        }
    }

    const FREE: Link = Link {
        inertia: 0.4,
        damping: 0.0,
        gravity: 0.0,
        gravity_phase: 0.0,
        inertia_std: 0.0,
        damping_std: 0.0,
        gravity_std: 0.0,
    };

    const PRIORS: Priors = Priors {
        motor_inertia: 0.05,
        viscous_damping: 0.2,
        viscous_damping_floor: 0.05,
        coulomb_friction: 0.1,
        torque_offset: 0.3,
        deflection_offset: 0.003,
        encoder_delay: 1.0,
    };

    #[test]
    fn a_load_on_a_link_that_turns_one_way_is_not_taken_for_its_friction() {
        let mut momentum = LinkMomentum::new(&joint(FREE), &Settings::default(), &PRIORS, T).unwrap();
        momentum.reset();
        let (load, speed) = (-1.9, 40.0);
        momentum.restart(0.0, load);
        let carried = Carried { torque: load, stiffness: 35.0, ..Carried::default() };
        let mut external = External::nothing(0);
        for k in 1..20_000_u64 {
            momentum.feed(speed * k as f64 * T, Some(load), f64::NAN);
            external = momentum.conclude(k, &carried, 1e-10, k > 200); // after the jump to this speed
        }
        assert!(external.status & status::VALID != 0);
        assert!((external.torque - load).abs() < 0.01 * load.abs(), "{}", external.torque);
        // A skew of one period between the encoders would make as much: that is said.
        assert!(external.torque_std > 0.5 * carried.stiffness * T * speed, "{}", external.torque_std);
    }

    #[test]
    fn a_push_on_a_free_link_rises_as_its_filter_does() {
        // q = ½ (τ/M) t² with τ_e = 0: the residual is w³/(s + w)³ of the push.
        let settings = Settings { contact_torque: Some(0.1), ..Settings::default() };
        let mut momentum = LinkMomentum::new(&joint(FREE), &settings, &PRIORS, T).unwrap();
        momentum.reset();
        momentum.restart(0.0, 0.0);
        for _ in 0..200 {
            momentum.feed(0.0, Some(0.0), f64::NAN);
        }
        let (push, w) = (2.0, settings.external_bandwidth);
        let mut found = None;
        for k in 1..60 {
            let t = f64::from(k) * T;
            momentum.feed(0.5 * push / FREE.inertia * t * t, Some(0.0), f64::NAN);
            let external = momentum.conclude(k as u64, &Carried::default(), 1e-14, true);
            let x = w * t;
            let expected = push * (1.0 - (-x).exp() * (1.0 + x + 0.5 * x * x));
            assert!((external.torque - expected).abs() < 0.01 * push, "{k}: {} {expected}", external.torque);
            assert!(external.difference == external.torque && external.link_torque == -external.torque);
            if found.is_none() && external.status & status::CONTACT != 0 {
                found = Some(k);
            }
        }
        assert!(found.is_some_and(|k| k <= 12), "{found:?}");
    }

    #[test]
    fn an_external_torque_that_is_measured_leaves_no_difference() {
        let settings = Settings::default();
        let mut momentum = LinkMomentum::new(&joint(FREE), &settings, &PRIORS, T).unwrap();
        momentum.reset();
        momentum.restart(0.0, 0.0);
        for k in 1..400 {
            let t = f64::from(k) * T;
            let push = 3.0 * (20.0 * t).sin();
            let q = 3.0 / FREE.inertia * (t / 20.0 - (20.0 * t).sin() / 400.0);
            momentum.feed(q, Some(0.0), push);
            let external = momentum.conclude(k as u64, &Carried::default(), 1e-14, true);
            assert!(external.difference.abs() < 2e-3, "{k}: {}", external.difference);
        }
    }

    #[test]
    fn the_papers_external_residual_obeys_equation_13() {
        // A link held at rest by its transmission against gravity: −r is g through K/(s + K).
        let link = Link { gravity: 6.0, ..FREE };
        let settings = Settings::default();
        let mut momentum = PaperMomentum::new(&joint(link), &settings, &PRIORS, T).unwrap();
        let q: f64 = 0.7;
        let nothing = f64::NAN;
        for k in 0..60u64 {
            let sample = Sample {
                sequence: k,
                motor_position: [q; MOTORS],
                motor_velocity: [0.0; MOTORS],
                motor_torque: [0.0; MOTORS],
                link_position: q,
                link_velocity: 0.0,
                external_torque: nothing,
            };
            let external = momentum.update(&sample, 1, 0.0, 0.0, true);
            if k > 0 {
                let expected = -6.0 * q.sin() * (1.0 - (-settings.k_tau * T * k as f64).exp());
                assert!((external.link_torque - expected).abs() < 1e-9, "{k}");
            }
        }
    }

    #[test]
    fn white_noise_raises_no_more_false_alarms_than_declared() {
        // An hour has 900 000 looks here; asked for 900 alarms, there are about so many, and never twice.
        let mut test = ContactTest::new(900.0, 200.0, T);
        let mut seed = 0x2545_f491_4f6c_dd1d_u64;
        let mut uniform = || {
            seed ^= seed << 13;
            seed ^= seed >> 7;
            seed ^= seed << 17;
            (seed >> 11) as f64 / (1u64 << 53) as f64
        };
        let (mut alarms, mut before) = (0, false);
        for _ in 0..900_000 {
            let normal =
                (-2.0 * uniform().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
            for _ in 0..test.every {
                let now = test.see(1e-3 * normal, 0.0, 1e-3);
                alarms += i32::from(now && !before);
                before = now;
            }
        }
        assert!((300..1200).contains(&alarms), "{alarms}");
    }

    #[test]
    fn what_stays_inside_its_band_is_no_contact() {
        let mut test = ContactTest::new(1.0, 200.0, T);
        for k in 0..20_000 {
            assert!(!test.see(0.95 * (0.001 * f64::from(k)).sin(), 1.0, 0.01));
        }
        assert!((0..20).any(|_| test.see(1.2, 1.0, 0.01)));
        assert!((0..40).any(|_| !test.see(0.5, 1.0, 0.01)));
    }
}
