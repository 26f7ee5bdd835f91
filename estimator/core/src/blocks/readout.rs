//! What the blocks have taught.

use super::Blocks;
use crate::balance::Balance;
use crate::choices::{BLOCKS, FEWEST, SURE, UNUSUAL, USEFUL};
use crate::gram::{UNKNOWNS, set};
use crate::unknowns::{
    ASYMMETRY, CANDIDATES, CLIPS, CORNER, LATE, OFFSET, RATE, Reading, SOFT, SPRING, STOPS, TORQUE_LATE, ZERO,
};

impl Blocks {
    /// Delay of the link position, s, and its standard deviation.
    #[must_use]
    pub fn delay(&self) -> Option<(f64, f64)> {
        let known = self.posterior.as_ref()?;
        (known.set & (1 << LATE | 1 << RATE) == 1 << LATE)
            .then(|| (known.x[LATE], known.covariance[LATE][LATE].sqrt()))
    }

    /// The same, and what is believed before any data where it is not told from other effects.
    #[must_use]
    pub fn lateness(&self) -> (f64, f64) {
        self.delay().unwrap_or((0.0, self.priors.encoder_delay * self.period))
    }

    /// By how much the torque is later than was assumed, s, and its standard deviation.
    #[must_use]
    pub fn torque_lateness(&self) -> (f64, f64) {
        let known = self.posterior.as_ref().filter(|known| known.set >> TORQUE_LATE & 1 == 1);
        known.map_or((0.0, 0.0), |known| {
            (known.x[TORQUE_LATE], known.covariance[TORQUE_LATE][TORQUE_LATE].sqrt())
        })
    }

    /// Torque and stiffness at a deflection, with their slopes by the unknowns; `None`: nothing is known.
    #[must_use]
    pub fn at(&self, phi: f64, link_rate: f64, balance: &Balance) -> Option<Reading> {
        match &self.posterior {
            Some(known) => Some(self.spring.at(phi, &known.x, known.set, link_rate, balance)),
            None if self.spring.known => Some(self.spring.at(phi, &[0.0; UNKNOWNS], 0, link_rate, balance)),
            None => None,
        }
    }

    /// Torque on the motor beside the spring's that depends on no memory and no sign, N·m; `rate`: φ′.
    #[must_use]
    pub fn damping_and_offset(&self, rate: f64) -> f64 {
        self.posterior.as_ref().map_or(0.0, |known| known.x[RATE] * rate - known.x[OFFSET])
    }

    /// rms of what the motor's equation leaves where friction is not taken off, N·m; ∞: unknown.
    #[must_use]
    pub fn unmodelled(&self) -> f64 {
        if self.posterior.is_some() { self.own.hypot(self.friction) } else { f64::INFINITY }
    }

    /// rms of the transmission's torque over what is known, N·m; NaN before.
    #[must_use]
    pub fn torque_rms(&self) -> f64 {
        self.torque
    }

    /// Standard deviation of the deflection's zero, rad.
    #[must_use]
    pub fn zero_std(&self) -> f64 {
        self.posterior.as_ref().map_or(0.0, |known| known.covariance[ZERO][ZERO].sqrt())
    }

    /// The constant torque that is the zero's or the reading's where nothing tells which, N·m: by a line that is not
    /// surely bent, beside effects that bend the curve as another zero would, by few rows and none before, or on one
    /// side of a law whose shape nobody declared; 0: a lost zero, or a curve that is the declared one.
    #[must_use]
    pub fn zero_torque(&self, stiffness: f64) -> f64 {
        let Some(known) = self.posterior.as_ref().filter(|_| !self.lost) else { return 0.0 };
        let unsure = self.spring.law.is_polynomial() && !self.is_surely_bent();
        // A line's zero is only moved where its torque is far beyond what a reading is off by: it is no guess then.
        let straight = unsure && !(self.moved && self.spring.is_constant());
        let both_sides = !self.spring.is_searched() || self.is_on_both_sides();
        let before = self.before.as_ref().is_some_and(|before| before.set >> ZERO & 1 == 1);
        let told = both_sides && !self.is_uneven() && (before || self.ring.len() > FEWEST);
        if !straight && told {
            return 0.0;
        }
        known.x[OFFSET].abs().max(if self.moved { (stiffness * self.spring.zero).abs() } else { 0.0 })
    }

    /// Whether a lost zero is where a curve bends that may as well be straight, or of any shape.
    #[must_use]
    pub fn is_zero_guessed(&self) -> bool {
        let told = self.before.as_ref().is_some_and(|before| before.set >> OFFSET & 1 == 1);
        let plain = self.is_surely_bent() && !self.is_uneven();
        self.lost && !told && self.spring.law.is_polynomial() && !plain
    }

    /// Whether a series has a further power that is sure.
    fn is_surely_bent(&self) -> bool {
        let Some(known) = &self.posterior else { return false };
        let std = |power: usize| known.covariance[SPRING.start + power][SPRING.start + power].sqrt();
        (1..self.spring.size).any(|power| self.spring.alpha[power].abs() > SURE * std(power))
    }

    /// Whether effects bend the curve as another zero would.
    fn is_uneven(&self) -> bool {
        let bending = set(STOPS) | set(CLIPS) | set(CORNER) | set(ASYMMETRY);
        let chosen = self.posterior.as_ref().map_or(0, |known| known.set);
        chosen & bending != 0 || self.spring.is_longer(chosen)
    }

    /// rms of what is left of the balance, over that of the measured torque without its mean; NaN before any.
    #[must_use]
    pub fn unexplained(&self) -> f64 {
        self.unexplained
    }

    /// What was left before a change, or before a zero was lost: neither makes the balance noisier.
    pub(super) fn usual_unexplained(&self) -> f64 {
        let before = self.before.as_ref().filter(|_| self.ring.len() < BLOCKS);
        before.map_or(f64::INFINITY, |before| before.unexplained)
    }

    /// Whether the balance leaves less than a useful estimate may, and about what it left before a change, by a law that
    /// reaches as far as the deflections that it was learned from.
    #[must_use]
    pub fn is_explained(&self) -> bool {
        let ([low, high], zero) = (self.seen, self.spring.zero);
        if low < high && (low + zero).abs().max((high + zero).abs()) >= self.spring.reach() {
            return false;
        }
        let usual = self.usual_unexplained().max((self.readings.white / self.fluctuation).sqrt());
        self.unexplained < USEFUL && self.unexplained <= UNUSUAL.sqrt() * usual
    }

    /// rms of what the balance has left over the last moments, N·m.
    #[must_use]
    pub fn misfit(&self) -> f64 {
        if self.posterior.is_some() { self.quick.sqrt() } else { f64::NAN }
    }

    /// Names of the effects that nobody declared and evidence chose; a torque that is late by a part of a period is none,
    /// nor is the moment at which dry friction changes its sign.
    pub fn undeclared(&self) -> impl Iterator<Item = &'static str> {
        let chosen = self.posterior.as_ref().map_or(0, |posterior| posterior.set & !set(TORQUE_LATE..SOFT));
        let named = CANDIDATES.iter().filter(move |c| chosen & set(c.unknowns.clone()) != 0).map(|c| c.name);
        let longer = self.spring.is_longer(chosen).then_some("higher_order_stiffness");
        let elsewhere = self.moved || self.lost && self.before.is_none();
        named.chain(longer).chain(elsewhere.then_some("deflection_offset"))
    }
}
