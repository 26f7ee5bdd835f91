//! The unknowns of one motor's balance from the sum of its blocks: prior, noise, choice.

use super::Blocks;
use super::before::{Before, anywhere};
use crate::balance;
use crate::choices::{EXACT, FEWEST, SURE, USEFUL};
use crate::gram::{
    COLUMNS, Frame, Gram, Posterior, Prior, Reduced, Row, Set, UNKNOWNS, choose, dot, log_evidence, set,
    solve, unknowns,
};
use crate::laws::{Law, PARAMETERS};
use crate::spring::Projection;
use crate::unknowns::{
    ACTIVE, ASYMMETRY, CANDIDATES, CLIPS, DRY, DRY_LATE, ECCENTRIC, LATE, OFFSET, RATE, SPRING, STOPS, Scale,
    Spring, ZERO,
};

const WIDE: f64 = 1e6; // of a prior that says nothing
const STEPS: usize = 3; // of Gauss and Newton's iteration at a block's end

pub(super) const ALONE: usize = CANDIDATES.len() + SPRING.end - SPRING.start; // groups that are not several others

/// All rows as one linearisation has them; `noise`: variance of an independent one.
pub(super) struct Rows<'a> {
    pub(super) frame: &'a Frame,
    pub(super) reduced: &'a Reduced,
    pub(super) total: &'a Gram,
    pub(super) noise: f64,
}

pub(super) type Groups = [Set; ALONE + SPRING.end - SPRING.start];

impl Blocks {
    pub(super) fn prior(&self, total: &Gram, frame: &Frame, zero_std: f64) -> Prior {
        self.prior_after(self.before.as_ref(), &self.spring, total, frame, zero_std)
    }

    /// By what was known before.
    pub(super) fn prior_after(
        &self,
        before: Option<&Before>,
        spring: &Spring,
        total: &Gram,
        frame: &Frame,
        zero_std: f64,
    ) -> Prior {
        let scale = Scale { zero_std, deflection: self.deflection, period_s: self.period };
        let mut prior = spring.prior(&self.motor, &self.priors, total, frame, &scale);
        let Some(before) = before else { return prior };
        for i in unknowns(before.set) {
            prior.precision[i] = before.precision[i];
            prior.mean[i] = before.x[i];
        }
        spring.from_base(&mut prior.mean, before.set);
        prior
    }

    /// Start a law with a shape where the evidence is best: any shape, if none is declared. Of any law that surely bends the
    /// zero may be in the middle of the deflections, as of encoders that count from anywhere.
    fn start(&mut self, total: &Gram, noise: f64) {
        let ([low, high], spring) = (self.seen, &self.spring);
        let (middle, shaped) = (-0.5 * (low + high), !spring.law.shapes().is_empty());
        let projection = Projection::between(&self.family, self.deflection, low, high);
        let scale = Scale { zero_std: 1.0, deflection: self.deflection, period_s: self.period };
        // The evidence of a spring that has these unknowns, the spring with its k, and the variance that it leaves.
        let tried = |mut tried: Spring, asked: Set, noise: f64| {
            let frame = tried.frame(&projection);
            let prior = tried.prior(&self.motor, &self.priors, total, &frame, &scale);
            let found = solve(&frame.reduce(total), frame.set & (asked | 1 << LATE), &prior, noise)?;
            let left = total.quadratic(&frame.residual(&found.x, found.set)) / total.rows;
            tried.alpha[0] = found.x[SPRING.start] + if shaped { tried.alpha[0] } else { 0.0 };
            Some((found.log_evidence, tried, left))
        };
        let (straight, bent) = (set(1..SPRING.start + 1), set(1..SPRING.end));
        let best_at = |zero: f64, noise: f64| {
            let mut from = spring.clone();
            from.zero = zero;
            if !shaped {
                return tried(from, bent, noise);
            }
            let starts = spring.starts((low + zero).abs().max((high + zero).abs()));
            let starts = starts.filter_map(|shape| tried(from.shaped(shape), straight, noise));
            let (_, best, _) =
                starts.filter(|(_, one, _)| one.alpha[0] > 0.0).max_by(|a, b| a.0.total_cmp(&b.0))?;
            let (evidence, _, left) = tried(best.clone(), bent, noise)?; // the shape is one between the starts
            Some((evidence, best, left))
        };
        let left = best_at(middle, noise).map_or(0.0, |(.., left)| left);
        let noise = noise.max(left * self.correlated);
        let (here, there) = (best_at(spring.zero, noise), best_at(middle, noise));
        let line = there
            .as_ref()
            .filter(|_| !shaped)
            .and_then(|(_, there, _)| tried(there.clone(), straight, noise));
        let least = here.iter().chain(&line).map(|(evidence, ..)| evidence + rarity());
        let least = least.fold(f64::NEG_INFINITY, f64::max);
        // Of a series the zero is found within the deflections by moving it.
        let may = !self.lost && (shaped || !self.is_on_both_sides());
        let most = USEFUL.powi(2) * balance::variance(total, balance::TORQUE);
        let found = |(evidence, spring, left): &(f64, Spring, f64)| {
            *evidence > least && *left < most && spring.alpha[0] > 0.0
        };
        if may && there.as_ref().is_some_and(found) {
            self.off = middle;
        } else if let Some((_, found, _)) = here.filter(|_| spring.is_searched()) {
            self.spring.alpha = found.alpha;
            self.spring.known = true;
        }
    }

    /// Start a polynomial of which nothing is known with the stiffness that explains the deflection, a late link beside it.
    ///
    /// φ = (B θ″ + D θ′ + friction + offset − τ) / K − late q′. Where a stiff joint moves fast the deflection is mostly
    /// delay: the balance solved for the torque would have nearly no spring, and a delay is nothing without one.
    fn start_by_deflection(&mut self, total: &Gram) {
        let mut frame =
            Frame { left: [0.0; COLUMNS], directions: [[0.0; COLUMNS]; UNKNOWNS], set: set(1..5) };
        frame.left[balance::SPRING.start] = -self.deflection;
        frame.directions[1][balance::TORQUE] = -1.0;
        frame.directions[1][balance::ACCELERATION] = self.motor.inertia;
        frame.directions[1][balance::VELOCITY] = self.motor.damping;
        for (i, column) in (2..).zip([balance::LATE.start, balance::OFFSET, balance::DRY]) {
            frame.directions[i][column] = 1.0;
        }
        let reduced = frame.reduce(total);
        let wide =
            std::array::from_fn(|i| WIDE * (reduced[0][0] / reduced[i][i].max(f64::MIN_POSITIVE)).sqrt());
        let prior = Prior::independent([0.0; UNKNOWNS], &wide);
        let Some(rough) = solve(&reduced, frame.set, &prior, reduced[0][0]) else { return };
        let left = total.quadratic(&frame.residual(&rough.x, rough.set)) / total.rows;
        let Some(found) = solve(&reduced, frame.set, &prior, left * self.correlated) else { return };
        if found.x[1] > SURE * found.covariance[1][1].sqrt() {
            self.spring.alpha = [0.0; PARAMETERS];
            self.spring.alpha[0] = found.x[1].recip();
        }
    }

    /// Where the first blocks' iteration begins.
    fn begin(&mut self, total: &Gram, torque: f64) {
        if self.noise.variance.is_nan() {
            self.noise.variance = 1e-4 * torque;
        }
        let few = self.ring.len() <= FEWEST && self.before.is_none();
        if few || !self.spring.known {
            self.start(total, self.noise.variance * self.correlated);
        }
        if few && !self.spring.is_anchored() && matches!(self.spring.law, Law::Polynomial | Law::Linear) {
            self.start_by_deflection(total);
        }
    }

    /// What the positions' noise adds to the products of the columns.
    fn noise_of_columns(&self, total: &Gram) -> Gram {
        let [[phi, both], [_, acceleration]] = self.readings.noise;
        let both = both / self.deflection;
        total.noise(&balance::slopes(), &[[phi / self.deflection.powi(2), both], [both, acceleration]])
    }

    /// The unknowns from all blocks.
    pub(super) fn solve(&mut self) {
        if self.reform() {
            return;
        }
        let mut total = Gram::default();
        self.ring.iter().for_each(|(block, _)| total.add(block, 1.0));
        let torque = balance::variance(&total, balance::TORQUE).max(f64::MIN_POSITIVE);
        self.begin(&total, torque);
        if self.off != 0.0 || !self.is_located(&total) {
            return;
        }
        self.fit_projection();
        let Some(projection) = self.projection.clone() else { return };
        let (from, zero) = (self.spring.clone(), if self.lost { self.deflection } else { self.near() });
        let of_columns = self.noise_of_columns(&total);
        for step in 0..STEPS {
            let frame = self.spring.frame(&projection);
            let reduced = frame.reduce_noisy(&total, &of_columns);
            let mut prior = self.prior(&total, &frame, zero);
            if step == 0 {
                let elsewhere = self.prior(&total, &frame, self.deflection);
                self.measure(&frame, &reduced, &elsewhere, &total);
            }
            let noise = self.noise.variance * self.noise.correlated;
            let rows = Rows { frame: &frame, reduced: &reduced, total: &total, noise };
            if let Some((other, spring)) = self.anew(&rows, &prior) {
                (self.before, self.spring) = (Some(other), spring);
                prior = self.prior(&total, &frame, zero);
            }
            let Some((mut chosen, moved)) = self.choose(&rows, &prior) else { return };
            let used = if moved { self.prior(&total, &frame, self.deflection) } else { prior };
            let own = self.leave(&frame, &chosen, &total, torque);
            let before = chosen.x;
            self.spring.move_by(&before, self.deflection);
            if step + 1 < STEPS && is_far(&chosen) && !self.spring.is_settled() {
                continue;
            }
            self.friction = frame.rms(&total, &chosen, shaped());
            let omitted = self.omitted(&rows, &chosen, &used);
            let attenuated = self.attenuated(&rows, &chosen);
            self.widen(&frame, &mut chosen, &used, noise, own);
            let more = omitted.iter().flatten().zip(attenuated.iter().flatten());
            let entries = chosen.covariance.iter_mut().flatten().zip(more);
            entries.for_each(|(v, (omitted, attenuated))| *v += omitted + attenuated);
            self.torque = self.spring.torque_rms(&projection, &total, self.lost);
            self.place_zero(moved, before[ZERO], &from, &chosen);
            (self.posterior, self.frame) = (Some(chosen), Some(frame));
            break;
        }
    }

    /// Standard deviation of the declared zero, rad.
    pub(super) fn near(&self) -> f64 {
        self.priors.deflection_offset * self.deflection + self.readings.resolution
    }

    /// What the chosen unknowns leave of the rows; its variance, (N·m)². `torque`: variance of the motor's.
    fn leave(&mut self, frame: &Frame, chosen: &Posterior, total: &Gram, torque: f64) -> f64 {
        self.residual = frame.residual(&chosen.x, chosen.set);
        let own = total.quadratic(&self.residual) / total.rows;
        self.own = own.sqrt().max(EXACT * total.rms(balance::TORQUE));
        let usual = self.motor.fit_rms.map_or(0.0, |(_, torque)| torque); // little motion is no worse model
        (self.fluctuation, self.unexplained) = (torque, self.own / torque.sqrt().max(usual));
        own
    }

    /// The noise is what all unknowns together leave, the zero anywhere; it decides how many of them there are.
    fn measure(&mut self, frame: &Frame, reduced: &Reduced, prior: &Prior, total: &Gram) {
        let floor = (EXACT * total.rms(balance::TORQUE)).powi(2);
        if self.before.is_some() && self.ring.len() < FEWEST {
            return; // it is as noisy as it was
        }
        // What few rows leave is less than their noise, as they are fitted: at first no less is assumed than usual.
        let floor = if self.ring.len() < FEWEST { floor.max(self.early(total)) } else { floor };
        // What was found a block ago is near enough to begin with.
        let passes = if self.ring.len() > FEWEST { 1 } else { 2 };
        for _ in 0..passes {
            let noise = self.noise.variance * self.noise.correlated;
            let Some(whole) = solve(reduced, frame.set, prior, noise) else { return };
            let residual = frame.residual(&whole.x, whole.set);
            self.noise.variance = (total.quadratic(&residual) / total.rows).max(floor);
            if self.ring.len() < FEWEST {
                continue;
            }
            self.score(frame, &residual, whole.set);
            let (mut seen, mut foreseen) = ([0.0; UNKNOWNS], [0.0; UNKNOWNS]);
            for i in unknowns(whole.set) {
                seen[i] = self.scores.iter().map(|score| score[i] * score[i]).sum();
                foreseen[i] = self.noise.variance * reduced[i][i];
            }
            let active = || unknowns(whole.set & ACTIVE);
            let ratio = active().map(|i| seen[i] / foreseen[i].max(f64::MIN_POSITIVE)).sum::<f64>();
            self.noise.correlated = (ratio / active().count().max(1) as f64).max(self.correlated);
        }
    }

    pub(super) fn score(&mut self, frame: &Frame, residual: &Row, of: Set) {
        self.scores.clear();
        for (block, _) in &self.ring {
            let image = block.times(residual);
            let mut score = [0.0; UNKNOWNS];
            unknowns(of).for_each(|i| score[i] = dot(&image, &frame.directions[i]));
            self.scores.push(score);
        }
    }

    /// The unknowns that there are without a choice, and the groups that evidence adds.
    pub(super) fn groups(&self, frame: &Frame) -> (Set, Groups) {
        let mut groups = Groups::default();
        let mut base = frame.set & (ACTIVE | self.before.as_ref().map_or(0, |before| before.set));
        for (group, candidate) in groups.iter_mut().zip(&CANDIDATES) {
            *group = set(candidate.unknowns.clone());
        }
        let (least, size) = (self.spring.least, self.spring.size);
        base &= !set(SPRING.start + least..SPRING.end);
        // Terms of an open series are chosen together: one may stand for another.
        let corner = self.spring.shape() & !set(SPRING);
        groups[ALONE - 1] = corner;
        for (i, more) in (least + 1..=size).enumerate() {
            let terms = set(SPRING.start..SPRING.start + more);
            groups[CANDIDATES.len() + i] = terms;
            groups[ALONE + i] = if corner == 0 { 0 } else { terms | corner };
        }
        if self.lost && self.spring.is_constant() && !self.spring.is_open() {
            // What depends on where the zero is says nothing while no motion tells.
            groups.iter_mut().filter(|group| **group & !anywhere() != 0).for_each(|group| *group = 0);
        }
        if !self.is_on_both_sides() {
            // A spring that is stiffer to the other side is another curve.
            groups.iter_mut().filter(|group| **group == set(ASYMMETRY)).for_each(|group| *group = 0);
        }
        (base, groups)
    }

    /// Whether the transmission has been bent to both sides.
    pub(super) fn is_on_both_sides(&self) -> bool {
        self.seen[0] < 0.0 && 0.0 < self.seen[1]
    }

    /// The unknowns that evidence chooses, and whether the zero is anywhere.
    fn choose(&self, rows: &Rows, prior: &Prior) -> Option<(Posterior, bool)> {
        let Rows { frame, reduced, total, noise } = *rows;
        let (base, mut groups) = self.offered(frame);
        let found = self.chosen(reduced, base, &groups, prior, noise)?;
        if self.ring.len() >= FEWEST && !self.lost && frame.set >> ZERO & 1 == 1 {
            // The zero is where it is declared, or anywhere in the range: then it makes the constant torque.
            let elsewhere = self.prior(total, frame, self.deflection);
            groups[ALONE - 1..].fill(0); // a corner is at the declared zero
            let constant = set(OFFSET..DRY);
            let instead = self.chosen(reduced, base & !constant, &groups, &elsewhere, noise)?;
            let bare = log_evidence(reduced, found.set & !constant, prior, noise);
            let odds = instead.log_evidence - found.log_evidence.max(bare);
            if odds > self.rarer(&instead, &found) {
                let other = solve(reduced, instead.set | constant, &elsewhere, noise)?;
                if self.is_seen(&other) {
                    return Some((other, true));
                }
            }
        }
        Some((found, false))
    }

    /// The same as far as so many blocks can tell: few rows show noise as effects; powers are one of a line.
    pub(super) fn offered(&self, frame: &Frame) -> (Set, Groups) {
        let (base, mut groups) = self.groups(frame);
        if self.ring.len() < FEWEST {
            let effects = if self.spring.is_line() { groups.len() } else { CANDIDATES.len() };
            groups[..effects].fill(0);
        }
        (base, groups)
    }

    /// By how much rarer one explanation with a further cause is than another, before any data: ln of the odds.
    pub(super) fn rarer(&self, instead: &Posterior, found: &Posterior) -> f64 {
        let effects = |of: &Posterior| {
            let chosen = CANDIDATES.iter().filter(|one| set(one.unknowns.clone()) & of.set != 0).count();
            chosen as f64 + f64::from(self.spring.is_longer(of.set))
        };
        (1.0 + effects(instead) - effects(found)) * rarity()
    }

    /// The unknowns of these groups that evidence chooses.
    pub(super) fn chosen(
        &self,
        reduced: &Reduced,
        base: Set,
        groups: &Groups,
        prior: &Prior,
        noise: f64,
    ) -> Option<Posterior> {
        let of = |groups: &Groups| {
            let found = choose(reduced, base, groups, self.spring.shape(), prior, noise);
            solve(reduced, found, prior, noise)
        };
        let found = of(groups)?;
        let wrong = self.impossible(&found);
        if wrong == 0 {
            return Some(found);
        }
        of(&groups.map(|group| if group & wrong == 0 { group } else { 0 }))
    }

    /// Unknowns whose values no joint has: a transmission's damping that drives beside a motor's that is declared, an
    /// eccentricity that no mounting leaves.
    pub(super) fn impossible(&self, found: &Posterior) -> Set {
        let size = found.x[ECCENTRIC].iter().map(|x| x * x).sum::<f64>().sqrt();
        let drives = self.motor.damping > 0.0 && found.x[RATE] < 0.0;
        let of = |wrong: bool, unknowns| if wrong { found.set & set(unknowns) } else { 0 };
        of(drives, RATE..RATE + 1) | of(size > self.priors.encoder_eccentricity, ECCENTRIC)
    }

    /// Whether a zero that has moved can be told from another curve: one whose law is open only where deflections reach as
    /// far beyond it to either side. That of a straight line is a constant torque.
    fn is_seen(&self, found: &Posterior) -> bool {
        let ([low, high], spring) = (self.seen, &self.spring);
        let moved = spring.zero + found.x[ZERO];
        let straight = spring.is_line() && !spring.is_longer(found.set);
        let open = spring.law.is_polynomial() && !spring.is_anchored() && !straight;
        !open || 2.0 * moved.abs() < high.min(-low)
    }
}

/// Whether the law was linearised elsewhere than where it was found.
fn is_far(found: &Posterior) -> bool {
    let far = |i: usize| found.x[i].abs() > 0.1 * found.covariance[i][i].sqrt();
    SPRING.chain([ZERO]).any(|i| found.set >> i & 1 == 1 && far(i))
}

/// ln of the odds against a further cause before any data: as many are held against one another.
pub(super) fn rarity() -> f64 {
    (Groups::default().len() as f64).ln()
}

/// Unknowns whose shapes no joint has quite: friction, memory, the free curve.
fn shaped() -> Set {
    set(DRY..SPRING.start) | set(DRY_LATE..RATE) | set(STOPS) | set(CLIPS)
}
