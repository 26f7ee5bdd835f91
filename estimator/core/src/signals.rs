//! The filtered signals of one motor's balance, and the excitation of their motion.

use crate::filters::StateVariableFilter;
use crate::laws::PARAMETERS;
use crate::linearisation::Linearisation;

/// Basis channels of a law: its slopes by α; the last one carries φ², or ∂g/∂φ.
pub const COLUMNS: usize = PARAMETERS + 1;

const LIGHT_RATIO: f64 = 5.0; // bandwidth of the light filter over that of the main one
const FRICTION_SPEEDS: f64 = 0.02; // of the largest velocity: over which Coulomb friction changes its sign
const LEAST_SPEED: f64 = 1e-12; // rad/s
const PAST_DELAYS: f64 = 5.5; // filter delays that a nonlinear basis is recomputed over

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
    /// G of the signal and its derivatives.
    pub light: [f64; 3],
    /// F G of the signal and its derivatives.
    pub main: [f64; 4],
    last: f64,
}

impl Channel {
    /// As if this input had been there forever.
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
    pub fn held(&mut self, filters: &Filters, now: f64) {
        let before = self.light[0];
        filters.light.held.apply(&mut self.light, self.last, now);
        filters.main.smooth.apply(&mut self.main, before, self.light[0]);
        self.last = now;
    }
}

/// A signal that is formed from lightly filtered ones, and passes F alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct Formed {
    /// F of the signal and its derivatives.
    pub main: [f64; 4],
    last: f64,
}

impl Formed {
    /// One period of a signal that is straight between samples.
    pub fn pass(&mut self, filters: &Filters, now: f64) {
        filters.main.smooth.apply(&mut self.main, self.last, now);
        self.last = now;
    }
}

/// Does the motion reveal the stiffness? From the rate of the deflection, filtered, over its noise.
///
/// The noise of the filtered rate follows from that of the positions; the largest of late counts, as a
/// quantised position at rest has none.
#[derive(Clone, Copy, Debug, Default)]
pub struct Excitation {
    noise: f64,
    square: f64,
    peak: f64,
    before: [f64; 2], // rms and noise at the last update
}

impl Excitation {
    const WINDOW_S: f64 = 0.3; // over which the rate's mean square is taken
    const NOISE_MARGIN: f64 = 5.0;
    const SHARE: f64 = 0.02; // of the largest rate seen: what is slower teaches next to nothing
    const PEAK_S: f64 = 60.0; // how long the largest rate is remembered

    /// Whether a filtered rate of φ is above the noise that it has, over the last moments.
    ///
    /// `usual`: whether the balance was explained at the last update; what was read otherwise is no measure.
    pub fn update(&mut self, rate: f64, noise: f64, usable: bool, usual: bool, dt: f64) -> bool {
        if !usable {
            self.square = 0.0;
            return false;
        }
        let fade = (-dt / Self::PEAK_S).exp();
        let [rms_before, noise_before] = std::mem::take(&mut self.before);
        if usual {
            self.peak = (fade * self.peak).max(rms_before);
            self.noise = (fade * self.noise).max(noise_before);
        } else {
            self.square = self.square.min(self.peak * self.peak);
        }
        self.square += (dt / Self::WINDOW_S).min(1.0) * (rate * rate - self.square);
        let rms = self.square.sqrt();
        self.before = [rms, noise];
        rms > Self::NOISE_MARGIN * self.noise.max(noise) && rms > Self::SHARE * self.peak && rms > 0.0
    }
}

/// The channels of one motor.
#[derive(Clone, Debug)]
pub struct Signals {
    /// θ.
    pub position: Channel,
    /// τ.
    pub torque: Channel,
    /// The columns of the law's linearisation.
    pub basis: [Channel; COLUMNS],
    /// The sign s of θ′, smooth around zero.
    pub friction: Formed,
    /// x, the declared effects.
    pub effects: Formed,
    speed: f64,
    past: Vec<f64>, // deflections of the last ticks, a ring; of a nonlinear law
    newest: usize,
    filled: usize,
    behind: usize, // samples of it that a basis which is being rebuilt has not taken in yet …
    chunk: usize,  // … and how many it takes in at a tick
}

impl Signals {
    /// At rest; `nonlinear`: whether the law has shape parameters; `every`: ticks between two equations.
    #[must_use]
    pub fn new(filters: &Filters, period_s: f64, every: usize, nonlinear: bool) -> Signals {
        let past = if nonlinear { (PAST_DELAYS * filters.delay / period_s).ceil() as usize } else { 0 };
        Signals {
            position: Channel::rest(0.0),
            torque: Channel::rest(0.0),
            basis: [Channel::rest(0.0); COLUMNS],
            friction: Formed::default(),
            effects: Formed::default(),
            speed: LEAST_SPEED,
            past: vec![0.0; past],
            newest: 0,
            filled: 0,
            behind: 0,
            chunk: 2 + past / (every / 2).max(1),
        }
    }

    /// Forget how fast it has been, and the effects.
    pub fn reset(&mut self) {
        (self.speed, self.effects) = (LEAST_SPEED, Formed::default());
    }

    /// As if the motor had been here forever; the basis is another matter, see `rest_basis`.
    pub fn restart(&mut self, theta: f64, torque: f64) {
        self.position = Channel::rest(theta);
        self.torque = Channel::rest(torque);
        self.friction = Formed::default();
        self.effects = Formed::default();
        self.filled = 0;
    }

    /// As if the deflection had been this forever.
    pub fn rest_basis(&mut self, law: &Linearisation, phi: f64) {
        self.behind = 0;
        let mut columns = [0.0; COLUMNS];
        law.columns(phi, &mut columns);
        for (channel, value) in self.basis.iter_mut().zip(columns) {
            *channel = Channel::rest(value);
        }
    }

    /// One period of the deflection, through as many basis channels as a law ever has here.
    pub fn feed_basis(&mut self, filters: &Filters, law: &Linearisation, phi: f64, slots: usize) {
        if !self.past.is_empty() {
            self.newest = (self.newest + 1) % self.past.len();
            self.past[self.newest] = phi;
            self.filled = (self.filled + 1).min(self.past.len());
        }
        if self.behind > 0 {
            self.behind += 1;
            return self.catch_up(filters, law, self.chunk);
        }
        let mut columns = [0.0; COLUMNS];
        law.columns(phi, &mut columns);
        for i in (0..slots).chain([PARAMETERS]) {
            self.basis[i].smooth(filters, columns[i]);
        }
    }

    /// One period of the motor; `usable`: whether its velocity counts.
    pub fn feed_motor(&mut self, filters: &Filters, theta: f64, torque: f64, usable: bool) {
        self.position.smooth(filters, theta);
        self.torque.held(filters, torque);
        let rate = self.position.light[1];
        if usable {
            self.speed = self.speed.max(rate.abs());
        }
        self.friction.pass(filters, (rate / (FRICTION_SPEEDS * self.speed)).tanh());
    }

    /// Whether the past is known for as long as the filters remember; never for a law without a shape.
    #[must_use]
    pub fn has_past(&self) -> bool {
        !self.past.is_empty() && self.filled == self.past.len()
    }

    /// Give the basis channels the past that they would have had with the law linearised where it is now.
    ///
    /// They are of use again at the next equation: until then a part is done at every tick.
    pub fn rebuild_basis(&mut self, filters: &Filters, law: &Linearisation) {
        self.behind = self.past.len();
        let mut columns = [0.0; COLUMNS];
        law.columns(self.past[(self.newest + 1) % self.past.len()], &mut columns);
        for (channel, value) in self.basis.iter_mut().zip(columns) {
            *channel = Channel::rest(value);
        }
        self.behind -= 1;
        self.catch_up(filters, law, self.chunk);
    }

    /// Take in so many of the samples that the basis is behind.
    pub fn catch_up(&mut self, filters: &Filters, law: &Linearisation, most: usize) {
        let (length, mut columns) = (self.past.len(), [0.0; COLUMNS]);
        for _ in 0..most.min(self.behind) {
            law.columns(self.past[(self.newest + 1 + length - self.behind) % length], &mut columns);
            for i in (0..law.size).chain([PARAMETERS]) {
                self.basis[i].smooth(filters, columns[i]);
            }
            self.behind -= 1;
        }
    }
}
