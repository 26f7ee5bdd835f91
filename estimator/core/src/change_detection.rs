//! Is the balance explained? One test on normalised innovations, with a declared rate of false alarms.
//!
//! Noise and parameter covariance predict the variance of an innovation. The mean square of a few innovations
//! over it has an F distribution: the numerator's degrees of freedom are the number of independent errors,
//! the denominator's are few, because the noise level is uncertain and model errors (dry friction at a
//! reversal) come in bursts. The limit is its quantile at the declared rate of false alarms, over the
//! filter's correlation time (a step) and over the window of [`crate::isolation`] (small or slow changes).
//! Above it parameters are frozen until the data before the change have left the filters. Then all possible
//! changes are compared: one that explains the new balance within its interval and can be followed is
//! followed; if a reading explains it better, or nothing does, that reading is suspected, and nothing is
//! valid until the reference holds again.

use crate::identification::MEMORY_S;
use crate::isolation::{Change, Explanation, Verdict};
use crate::kalman;
use crate::student::f_quantile;

/// Degrees of freedom of the noise's level over the filters' correlation time; over the window bursts average out, as
/// over the memory of [`crate::kalman`].
pub const TAILS: f64 = 4.0;
/// Over which innovations are averaged: the correlation time of the filters …
pub const UPDATES: usize = 3;
const EXPLAINED: usize = 10; // … and over which they have to be as foreseen before the curve is believed again
const AS_FORESEEN: f64 = 2.0; // mean square, of innovations that are correlated over three updates
const AGAIN: usize = 30; // updates over which the reference has to hold again
const LEAST: f64 = 0.004; // of the torque: no smaller step is called one …
/// … and nothing smaller over the window, in which model errors average out.
pub const LEAST_IN_WINDOW: f64 = 0.002;
const FLUSH_DELAYS: f64 = 2.6; // until less than a thousandth of what was before a change is in the filters
const FOLLOW_S: f64 = 0.6; // after an alarm, in which the change is still being followed
const WINDOW_S: f64 = 2.0; // of the window while all is well …
const LONG_WINDOW_S: f64 = 6.0; // … and while a change is being explained
const LEAST_UPDATES: f64 = 15.0; // in a window that is judged …
const FOLLOWED_S: f64 = 1.0; // … and in one that ends a doubt: less shows no difference
/// Logarithm of the odds, a thousand to one, at which a change is preferred.
pub const SURE: f64 = 6.9;
const QUANTILES: usize = 8; // at 1, 2, 4 … degrees of freedom

/// What is to be done with what has been learned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Action {
    /// Nothing.
    GoOn,
    /// The filters hold the time after a change only: follow it from the reference on.
    OpenUp,
    /// The reference holds again.
    Restore,
    /// This change explains all, and is a parameter's.
    Accept(Change),
    /// No one change explains the window: what has been seen is of the past.
    LookAgain,
    /// Nothing explains it: begin anew.
    Relearn,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct ChangeDetection {
    dt: f64,
    flush_s: f64,
    limit_square: f64,
    limits: [f64; QUANTILES],
    odds: f64, // logarithm of those, for a reading against none, that outweigh how rare that is
    squares: [(f64, f64); EXPLAINED], // innovation² and what was foreseen, newest first
    known: usize,
    // What the reference leaves, by itself and where the suspect explains it, squared, over what is foreseen.
    again: [[f64; 2]; AGAIN], // newest first
    seen_again: usize,
    phase: Phase,
    verdict: Option<Verdict>,
    explained_by: Option<Change>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Phase {
    Explained,
    Flushing { left_s: f64 },
    Following { since_s: f64 },
}

/// An innovation and what was foreseen of it, in units of the torque.
#[derive(Clone, Copy, Debug)]
pub struct Innovation {
    /// y − h x.
    pub value: f64,
    /// h P h'.
    pub predicted_variance: f64,
    /// s².
    pub noise: f64,
    /// What the reference leaves, by itself and where the suspect explains it, squared, over what is foreseen.
    pub of_reference: Option<[f64; 2]>,
}

impl ChangeDetection {
    /// For updates dt_s apart, of filters that delay a slow signal by `delay_s`.
    #[must_use]
    pub fn new(false_alarms_per_hour: f64, dt_s: f64, delay_s: f64) -> ChangeDetection {
        let in_an_hour = false_alarms_per_hour / 3600.0;
        let mut limits = [0.0; QUANTILES];
        for (i, limit) in limits.iter_mut().enumerate() {
            *limit = f_quantile(2f64.powi(i as i32), kalman::TAILS, in_an_hour * WINDOW_S);
        }
        ChangeDetection {
            dt: dt_s,
            flush_s: FLUSH_DELAYS * delay_s,
            limit_square: f_quantile(1.0, TAILS, in_an_hour * dt_s),
            limits,
            odds: SURE - (in_an_hour * WINDOW_S).min(1.0).ln(),
            squares: [(0.0, 0.0); EXPLAINED],
            known: 0,
            again: [[0.0; 2]; AGAIN],
            seen_again: 0,
            phase: Phase::Explained,
            verdict: None,
            explained_by: None,
        }
    }

    /// Nothing has been seen yet.
    pub fn reset(&mut self) {
        (self.known, self.seen_again) = (0, 0);
        self.phase = Phase::Explained;
        (self.verdict, self.explained_by) = (None, None);
    }

    /// The filters hold something wrong: what has been seen does not go on.
    pub fn pause(&mut self) {
        (self.known, self.seen_again) = (0, 0);
    }

    /// Equations that the window is to hold.
    #[must_use]
    pub fn window(&self) -> f64 {
        let seconds = if self.phase == Phase::Explained { WINDOW_S } else { LONG_WINDOW_S };
        (seconds / self.dt).max(2.0 * LEAST_UPDATES)
    }

    /// Largest misfit that usual noise has in a window of so many independent equations.
    #[must_use]
    pub fn limit(&self, equations: f64) -> f64 {
        let place = equations.max(1.0).log2().min((QUANTILES - 1) as f64);
        let (low, high) = (place.floor() as usize, place.ceil() as usize);
        self.limits[low] + (place - low as f64) * (self.limits[high] - self.limits[low])
    }

    /// One innovation, and what the window says; `settled`: whether there is a curve to be held against.
    pub fn watch(&mut self, now: &Innovation, verdict: Option<Verdict>, settled: bool) -> Action {
        self.verdict = verdict;
        if let Phase::Flushing { left_s } = &mut self.phase {
            *left_s -= self.dt;
            if *left_s > 0.0 {
                return Action::GoOn;
            }
            self.phase = Phase::Following { since_s: 0.0 };
            (self.known, self.seen_again) = (0, 0);
            return Action::OpenUp;
        }
        self.squares.copy_within(..EXPLAINED - 1, 1);
        self.squares[0] = (now.value * now.value, now.noise + now.predicted_variance);
        self.known = (self.known + 1).min(EXPLAINED);
        if let Some(square) = now.of_reference {
            self.again.copy_within(..AGAIN - 1, 1);
            self.again[0] = square;
            self.seen_again = (self.seen_again + 1).min(AGAIN);
        }
        if let Phase::Following { since_s } = self.phase {
            self.phase = Phase::Following { since_s: since_s + self.dt };
            return self.follow(since_s + self.dt);
        }
        if settled && (self.steps() || self.creeps()) {
            self.phase = Phase::Flushing { left_s: self.flush_s };
            self.explained_by = None;
        }
        Action::GoOn
    }

    /// Whether the last innovations are beyond what noise does.
    fn steps(&self) -> bool {
        let (square, foreseen) = self.mean(UPDATES);
        self.known >= UPDATES && self.is_step(square, foreseen)
    }

    /// Whether the square of an innovation is beyond what noise does.
    #[must_use]
    pub fn is_step(&self, square: f64, foreseen: f64) -> bool {
        square > self.limit_square * foreseen + LEAST * LEAST
    }

    /// Whether the reference leaves more of the window than noise does, or a reading that is not what it was
    /// makes what is more than foreseen so much more probable that this outweighs how rare it is (as false
    /// alarms are).
    fn creeps(&self) -> bool {
        self.judged().is_some_and(|verdict| {
            let healthy = verdict.of(Change::Nothing).evidence;
            let reading = verdict.best(Change::is_reading);
            !self.explains(verdict, Change::Nothing)
                || verdict.of(Change::Nothing).misfit > AS_FORESEEN
                    && reading.is_some_and(|change| verdict.of(change).evidence > healthy + self.odds)
        })
    }

    fn judged(&self) -> Option<&Verdict> {
        self.verdict.as_ref().filter(|verdict| verdict.updates >= LEAST_UPDATES)
    }

    fn explains(&self, verdict: &Verdict, change: Change) -> bool {
        verdict.of(change).misfit <= self.limit(verdict.equations)
    }

    /// A change is being followed: has it been explained, and by what?
    fn follow(&mut self, since_s: f64) -> Action {
        if self.verdict.is_none() {
            // There is no reference to hold it against.
            if since_s > FOLLOW_S && self.is_as_foreseen() {
                self.phase = Phase::Explained;
            }
            return Action::GoOn;
        }
        if self.holds_again() {
            return self.end(Action::Restore);
        }
        let Some(verdict) = self.judged() else { return Action::GoOn };
        let best = verdict.best(|change| change != Change::Nothing);
        let explained_by = best.filter(|change| self.explains(verdict, *change));
        let followed = verdict.best(Change::is_parameter);
        let reading = verdict.best(Change::is_reading);
        let evidence = |change: Option<Change>| change.map_or(f64::NEG_INFINITY, |c| verdict.of(c).evidence);
        // What was learned holds, unless a reading that is not what it was makes the window more probable.
        let foreseen = |change: Change| verdict.of(change).misfit <= AS_FORESEEN;
        if verdict.updates * self.dt < FOLLOWED_S {
            return Action::GoOn;
        }
        if foreseen(Change::Nothing) && evidence(Some(Change::Nothing)) + SURE > evidence(reading) {
            return self.end(Action::Restore);
        }
        let preferred = evidence(followed) > evidence(reading) + SURE;
        if let (Some(change), true) = (followed.filter(|change| foreseen(*change)), preferred) {
            if change != Change::Stiffness || self.is_as_foreseen() {
                return self.end(Action::Accept(change));
            }
        }
        let seen_s = verdict.updates * self.dt;
        self.explained_by = explained_by;
        if since_s > MEMORY_S && explained_by.is_none() {
            return self.end(Action::Relearn);
        }
        if explained_by.is_none() && seen_s > WINDOW_S {
            return Action::LookAgain;
        }
        Action::GoOn
    }

    /// Whether the reference has held of late, where the suspect, if it is the likelier, did not.
    fn holds_again(&self) -> bool {
        let [held, suspected] = [0, 1].map(|i| self.again.iter().map(|one| one[i]).sum::<f64>());
        let Some(verdict) = &self.verdict else { return false };
        let independent = verdict.equations / verdict.updates.max(1.0);
        let likelier = verdict
            .best(|change| change != Change::Nothing)
            .is_some_and(|change| verdict.of(change).evidence > verdict.of(Change::Nothing).evidence + SURE);
        let disproven = !likelier || 0.5 * independent * (suspected - held) > SURE;
        self.seen_again == AGAIN && held <= AS_FORESEEN * AGAIN as f64 && disproven
    }

    /// What explains the window best so far, and how.
    #[must_use]
    pub fn suspect(&self) -> Option<(Change, Explanation)> {
        let verdict = self.doubt()?;
        let change = verdict.best(|change| change != Change::Nothing)?;
        Some((change, *verdict.of(change)))
    }

    fn end(&mut self, action: Action) -> Action {
        self.phase = Phase::Explained;
        self.explained_by = None;
        (self.known, self.seen_again) = (0, 0);
        action
    }

    /// Whether the last innovations are as noise and parameters foresee.
    fn is_as_foreseen(&self) -> bool {
        let (square, foreseen) = self.mean(EXPLAINED);
        self.known == EXPLAINED && square <= AS_FORESEEN * (foreseen + LEAST * LEAST)
    }

    fn mean(&self, updates: usize) -> (f64, f64) {
        let count = updates.min(self.known).max(1);
        let sum = self.squares[..count].iter().fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
        (sum.0 / count as f64, sum.1 / count as f64)
    }

    /// Whether the joint has changed and is being followed.
    #[must_use]
    pub fn changed(&self) -> bool {
        self.phase != Phase::Explained
    }

    /// Whether what is estimated explains the balance.
    #[must_use]
    pub fn explained(&self) -> bool {
        match self.phase {
            Phase::Explained => true,
            Phase::Flushing { .. } => false,
            Phase::Following { .. } => self.verdict.is_none() && self.is_as_foreseen(),
        }
    }

    /// What the window says while a change has not been explained.
    #[must_use]
    pub fn doubt(&self) -> Option<&Verdict> {
        if matches!(self.phase, Phase::Following { .. }) { self.judged() } else { None }
    }

    /// Whether a change leaves no more of the window than noise does; true where nothing is said of it.
    #[must_use]
    pub fn is_explained_by(&self, change: Change) -> bool {
        self.judged().is_none_or(|verdict| self.explains(verdict, change))
    }

    /// What the window says of all changes.
    #[must_use]
    pub fn verdict(&self) -> Option<&Verdict> {
        self.judged()
    }

    /// Whether the filters hold nothing from before a change.
    #[must_use]
    pub fn may_learn(&self) -> bool {
        !matches!(self.phase, Phase::Flushing { .. })
    }

    /// Whether innovations are noise: not while a change is followed.
    #[must_use]
    pub fn may_learn_noise(&self) -> bool {
        self.phase == Phase::Explained
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn quiet(value: f64) -> Innovation {
        Innovation { value, predicted_variance: 0.0, noise: 1e-4, of_reference: None }
    }

    #[test]
    fn a_step_raises_the_alarm_and_its_end_is_explained() {
        let mut changes = ChangeDetection::new(1.0, 0.03, 0.08);
        for _ in 0..100 {
            assert!(changes.watch(&quiet(0.01), None, true) == Action::GoOn && !changes.changed());
        }
        let mut opened = 0;
        for _ in 0..12 {
            opened += i32::from(changes.watch(&quiet(0.3), None, true) == Action::OpenUp);
        }
        assert!(opened == 1 && changes.changed());
        for _ in 0..60 {
            changes.watch(&quiet(0.01), None, true);
        }
        assert!(!changes.changed() && changes.explained());
    }
}
