//! What one motor's balance has taught: blocks of rows, and the algebra on their sum.

use crate::balance::{
    ACCELERATION, CLIPS, DRY, EVEN, LATE, LOAD, OFFSET, POWERS, SOFT, STOPS, TORQUE, VELOCITY, set,
};
use crate::gram::{COLUMNS, Gram, Posterior, Prior, Row, Set, choose, cluster, correlation, student_95};
use crate::laws::Law;
use crate::model::{Motor, Transmission};
use crate::settings::Priors;
use crate::student::f_quantile;

const BLOCK_S: f64 = 0.25; // of motion: longer than the filters' memory, so that blocks are nearly independent
const BLOCKS: usize = 120; // 30 s of motion: what a joint's temperature and load leave as they are
const FEWEST: usize = 8; // blocks before one is held against the others
const PERSISTENT: usize = 4; // blocks in a row that are not explained: the joint is another one
const UNDECLARED: f64 = 0.05; // amplitude of an effect that nobody declared, as a share of the torque
const SPRING: f64 = 10.0; // of the flexibility torque, as a share of the motor's: the data decide

/// One effect that the joint file need not name.
struct Candidate {
    columns: std::ops::Range<usize>,
    name: &'static str,
}

/// The groups of columns that evidence chooses, with the names of `report.json`.
const CANDIDATES: [Candidate; 4] = [
    Candidate { columns: SOFT..SOFT + 1, name: "stribeck_friction" },
    Candidate { columns: LOAD..LOAD + 1, name: "load_dependent_friction" },
    Candidate { columns: STOPS, name: "hysteresis" },
    Candidate { columns: CLIPS, name: "backlash" },
];

/// What a block did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Closed {
    /// It is explained and added.
    Added,
    /// It is not explained by what is known, and left out.
    Unexplained,
    /// Several were not explained: what is known begins with them.
    Begun,
}

/// Blocks of one motor's rows.
#[derive(Clone, Debug)]
pub struct Blocks {
    motor: Motor,
    priors: Priors,
    period: f64,
    powers: Option<usize>,
    rows: f64,
    correlated: f64,
    limit: f64, // of a block's mean square over the usual one, at the declared rate of false alarms
    open: Gram,
    ring: Vec<Gram>,
    oldest: usize,
    waiting: Vec<Gram>,
    variance: f64,
    own: f64, // rms that the chosen columns leave
    scale: f64,
    /// Resolution of the deflection, rad: rounding moves its zero by as much.
    pub resolution: f64,
    /// Whether evidence chose a zero that is not the declared one.
    pub moved: bool,
    /// Maximum a posteriori, with its covariance; `None`: not enough motion yet.
    pub posterior: Option<Posterior>,
}

impl Blocks {
    /// Of a motor; `correlated`: rows that one independent error is worth.
    #[must_use]
    pub fn new(
        motor: &Motor,
        priors: &Priors,
        period_s: f64,
        correlated: f64,
        alarms_per_hour: f64,
    ) -> Blocks {
        let powers = match &motor.transmission {
            Transmission::Elastic { law: Law::Linear, .. } => Some(1),
            Transmission::Elastic { law: Law::Polynomial, order, .. } => order.map(|p| p.min(POWERS.len())),
            _ => None,
        };
        let rows = (BLOCK_S / period_s).round().max(8.0);
        let errors = (rows / correlated).max(1.0); // independent ones in a block
        Blocks {
            motor: motor.clone(),
            priors: *priors,
            period: period_s,
            powers,
            rows,
            correlated,
            limit: f_quantile(errors, FEWEST as f64 * errors, alarms_per_hour * BLOCK_S / 3600.0),
            open: Gram::default(),
            ring: Vec::with_capacity(BLOCKS),
            oldest: 0,
            waiting: Vec::with_capacity(PERSISTENT),
            variance: f64::NAN,
            own: f64::NAN,
            scale: f64::NAN,
            resolution: 0.0,
            moved: false,
            posterior: None,
        }
    }

    /// Forget everything.
    pub fn clear(&mut self) {
        self.ring.clear();
        self.waiting.clear();
        self.open = Gram::default();
        (self.oldest, self.posterior, self.moved) = (0, None, false);
    }

    /// Half a block is a block: what follows is not as what was before.
    pub fn cut(&mut self) {
        self.open = Gram::default();
    }

    /// Whether so little has been learned that it may be learned anew.
    #[must_use]
    pub fn are_few(&self) -> bool {
        self.ring.len() < FEWEST
    }

    /// One row; what happened where it fills a block.
    pub fn add(&mut self, row: &Row) -> Option<Closed> {
        self.open.add_row(row);
        if self.open.rows < self.rows {
            return None;
        }
        let block = std::mem::take(&mut self.open);
        if !self.explains(&block) {
            self.waiting.push(block);
            if self.waiting.len() < PERSISTENT {
                return Some(Closed::Unexplained);
            }
            self.ring.clear();
            self.oldest = 0;
            let waiting = std::mem::take(&mut self.waiting);
            self.ring.extend(waiting);
            self.waiting.reserve(PERSISTENT);
            self.solve();
            return Some(Closed::Begun);
        }
        self.waiting.clear();
        if self.ring.len() < BLOCKS {
            self.ring.push(block);
        } else {
            self.ring[self.oldest] = block;
            self.oldest = (self.oldest + 1) % BLOCKS;
        }
        self.solve();
        Some(Closed::Added)
    }

    /// Whether a block's mean square is as usual: Fisher's F of it over that of the others and what is not known.
    fn explains(&self, block: &Gram) -> bool {
        let Some(posterior) = &self.posterior else { return true };
        let n = self.ring.len();
        if n < FEWEST {
            return true;
        }
        let misfit = |block: &Gram| block.quadratic(&posterior.residual) / block.rows;
        let usual = self.ring.iter().map(misfit).sum::<f64>() / n as f64;
        let floor = f64::EPSILON * block.rms(TORQUE).powi(2);
        misfit(block) < self.limit * (usual + floor + posterior.predicted(block) / block.rows)
    }

    /// Which columns there are, and how they are believed before any data.
    ///
    /// `zero`: standard deviation of the deflection's zero, as a share of the deflection.
    fn prior(&self, total: &Gram, zero: f64) -> Prior {
        let mean = total.at(TORQUE, OFFSET) / total.rows;
        let torque = (total.rms(TORQUE).powi(2) - mean * mean).max(f64::MIN_POSITIVE).sqrt();
        let share = |column: usize, share: f64| share * torque / total.rms(column).max(1e-12);
        let mut prior = Prior { mean: [0.0; COLUMNS], std: [0.0; COLUMNS] };
        for column in 1..COLUMNS {
            prior.std[column] = share(column, UNDECLARED);
        }
        let inertia = self.motor.inertia_std.unwrap_or(self.priors.motor_inertia);
        (prior.mean[ACCELERATION], prior.std[ACCELERATION]) =
            (self.motor.inertia, inertia * self.motor.inertia);
        prior.mean[VELOCITY] = self.motor.damping;
        prior.std[VELOCITY] = self.priors.viscous_damping * self.motor.damping
            + share(VELOCITY, self.priors.viscous_damping_floor);
        prior.std[OFFSET] = self.priors.torque_offset * torque + mean.abs();
        prior.std[DRY] = self.priors.coulomb_friction * torque;
        for column in POWERS {
            prior.std[column] = share(column, SPRING);
        }
        // A zero that is off by δ adds δ f′(φ).
        for (k, column) in EVEN.enumerate() {
            let power = POWERS.start + 1 + k;
            let known = self.posterior.as_ref().map_or(0.0, |known| known.coefficient(power).abs());
            let amplitude = if known > 0.0 { known } else { share(power, 1.0) };
            prior.std[column] = (2 * k + 3) as f64 * zero * amplitude;
        }
        // A delay of one period times the stiffness, as large as it was or as the torque lets it be.
        for (k, column) in LATE.enumerate() {
            let power = POWERS.start + k;
            let known = self.posterior.as_ref().map_or(0.0, |known| known.coefficient(power).abs());
            let stiffness = if known > 0.0 { known } else { share(power, 1.0) } / self.scale;
            prior.std[column] = (2 * k + 1) as f64
                * self.priors.encoder_delay
                * self.period
                * stiffness.max(f64::MIN_POSITIVE);
        }
        prior
    }

    fn solve(&mut self) {
        let mut total = Gram::default();
        self.ring.iter().for_each(|block| total.add(block, 1.0));
        let powers = self.powers.unwrap_or(1);
        let mut base =
            set(ACCELERATION..DRY + 1) | set(POWERS.start..POWERS.start + powers) | 1 << LATE.start;
        if powers > 1 {
            base |= 1 << (LATE.start + 1) | set(EVEN.start..(EVEN.start + powers - 1).min(EVEN.end));
        }
        let mut groups: [Set; 8] = [0; 8];
        let mut n = 0;
        for candidate in &CANDIDATES {
            groups[n] = set(candidate.columns.clone());
            n += 1;
        }
        if self.powers.is_none() {
            for more in 2..=POWERS.len() {
                groups[n] = set(POWERS.start..POWERS.start + more);
                n += 1;
            }
        }
        let mut prior = self.prior(&total, self.priors.deflection_offset + self.resolution / self.scale);
        // The noise is what all columns together leave; it decides how many of them there are.
        let mut noise = if self.variance > 0.0 { self.variance } else { 1e-4 * total.rms(TORQUE).powi(2) };
        let floor = f64::EPSILON * total.rms(TORQUE).powi(2);
        if self.powers.is_none() {
            base |= set(EVEN);
        }
        let all = base | groups[..n].iter().fold(0, |all, group| all | group);
        let mut correlated = self.correlated;
        for _ in 0..2 {
            let Some(whole) = crate::gram::solve(&total, all, &prior, noise * correlated) else { return };
            noise = (total.quadratic(&whole.residual) / total.rows).max(floor);
            if self.ring.len() >= FEWEST {
                correlated = correlation(&whole, &self.ring, noise).max(self.correlated);
            }
        }
        let Some(mut found) = choose(&total, base, &groups[..n], &prior, noise * correlated) else { return };
        // The zero is where it is declared, or anywhere in the range.
        let elsewhere = self.prior(&total, 1.0);
        if let Some(other) = choose(&total, base, &groups[..n], &elsewhere, noise * correlated) {
            self.moved = other.log_evidence > found.log_evidence + ((n + 1) as f64).ln();
            if self.moved {
                (found, prior) = (other, elsewhere);
            }
        }
        let own = (total.quadratic(&found.residual) / total.rows).max(floor);
        // What the chosen columns leave beyond the noise is an error of the model: scores of blocks hold it.
        if !cluster(&mut found, &self.ring, &prior, noise * correlated) {
            let freedom = (self.ring.len() as f64).max(3.0);
            let wider = own / noise * (student_95(freedom) / student_95(1e9)).powi(2);
            found.covariance.iter_mut().flatten().for_each(|v| *v *= wider);
        }
        (self.variance, self.own) = (noise, own.sqrt());
        self.posterior = Some(found);
    }

    /// The columns are of another size from now on.
    pub fn rescale(&mut self, deflection: f64) {
        self.clear();
        (self.scale, self.variance) = (deflection, f64::NAN);
    }

    /// Delay of the link position, s, and its standard deviation.
    #[must_use]
    pub fn delay(&self) -> Option<(f64, f64)> {
        let posterior = self.posterior.as_ref()?;
        let stiffness = posterior.coefficient(POWERS.start) / self.scale;
        let std = posterior.covariance[LATE.start][LATE.start].sqrt();
        (stiffness > 0.0).then(|| (posterior.coefficient(LATE.start) / stiffness, std / stiffness))
    }

    /// Constant torque on the motor, N·m.
    #[must_use]
    pub fn offset(&self) -> f64 {
        self.posterior.as_ref().map_or(0.0, |known| known.coefficient(OFFSET))
    }

    /// rms of what the motor's equation leaves where friction is not taken off, N·m; ∞: unknown.
    #[must_use]
    pub fn unmodelled(&self) -> f64 {
        let friction = |known: &Posterior| known.coefficient(DRY).hypot(known.coefficient(SOFT));
        self.posterior.as_ref().map_or(f64::INFINITY, |known| self.own.hypot(friction(known)))
    }

    /// rms of what is left of the balance, over the rms of the measured torque without its mean.
    #[must_use]
    pub fn unexplained(&self) -> f64 {
        let Some(posterior) = &self.posterior else { return f64::NAN };
        let mut total = Gram::default();
        self.ring.iter().for_each(|block| total.add(block, 1.0));
        let mean = total.at(TORQUE, OFFSET) / total.rows;
        (total.quadratic(&posterior.residual) / (total.at(TORQUE, TORQUE) - total.rows * mean * mean)).sqrt()
    }

    /// Names of the effects that nobody declared and evidence chose.
    pub fn undeclared(&self) -> impl Iterator<Item = &'static str> {
        let chosen = self.posterior.as_ref().map_or(0, |posterior| posterior.set);
        let named = CANDIDATES.iter().filter(move |c| chosen & set(c.columns.clone()) != 0).map(|c| c.name);
        named.chain(self.moved.then_some("deflection_offset"))
    }
}
