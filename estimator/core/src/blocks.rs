//! What one motor's balance has taught: blocks of rows, and the algebra on their sum.

mod before;
mod changes;
mod family;
mod interval;
mod readout;
mod rows;
mod solve;

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use before::Before;

use crate::balance;
use crate::causes::{Noise, Odds};
use crate::choices::{BLOCK_S, BLOCKS, CONVINCING, EARLY, FEWEST, LOOK_S, TAILS};
use crate::gram::{Frame, Gram, Posterior, Row, UNKNOWNS, Vector, inverse, set};
use crate::model::Motor;
use crate::settings::Priors;
use crate::spring::{Family, Projection};
use crate::student::f_quantile;
use crate::unknowns::{ACTIVE, LATE, SPRING, Spring, ZERO};

/// What a block did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Closed {
    /// It is explained and added.
    Added,
    /// It is not explained by what is known, and left out.
    Unexplained,
    /// Several were not explained: what is known begins with them.
    Begun,
    /// It is not explained after a restart: the zero is not where it was.
    Lost,
    /// What follows is learned with other functions.
    Reformed,
}

/// How noisy readings are.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Readings {
    /// Variance of a row that their white noise makes, (N·m)².
    pub white: f64,
    /// Covariance of the filtered φ and θ″ that it makes, rad², rad²/s², rad²/s⁴.
    pub noise: [[f64; 2]; 2],
    /// What rounding adds to the variance of φ in the row at hand where the positions hardly move, over that of white noise.
    pub rounding: f64,
    /// Half the resolution of the deflection, rad: a reading that cuts off instead of rounding moves its zero by as much.
    pub resolution: f64,
}

/// Blocks of one motor's rows.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Blocks {
    motor: Motor,
    priors: Priors,
    period: f64,
    rows: f64,
    correlated: f64,
    per_block: f64, // probability of a change, before a block
    quick_limit: f64,
    open: Gram,
    filled: f64,                 // rows of it; before friction is known, what of them is motion
    ring: VecDeque<(Gram, f64)>, // with the largest `quick` in each
    waiting: Vec<Gram>,
    scores: Vec<Vector>,
    before: Option<Before>,
    /// The law and its parameters.
    pub spring: Spring,
    projection: Option<Projection>,
    deflection: f64,
    noise: Noise,
    own: f64,         // rms that the chosen unknowns leave
    fluctuation: f64, // variance of the motor's torque
    unexplained: f64, // share of its rms
    torque: f64,      // rms of the transmission's torque
    friction: f64,    // rms of friction and hysteresis
    quick: f64,
    peak: f64,      // of it in the open block
    good: usize,    // blocks in a row that were explained
    doubted: usize, // blocks since the last explained one
    doubting: bool,
    suspected: bool, // the zero, of being elsewhere since a restart
    skipped: u32,    // rows that are still of what was before
    settle: u32,
    fitted: bool, // what the file knows has been held against a block
    lost: bool,   // the zero: it may be anywhere, but for what motion shows
    frame: Option<Frame>,
    #[serde(with = "crate::snapshot::array")]
    residual: Row,
    odds: Option<Odds>,
    /// How noisy the readings are.
    pub readings: Readings,
    /// The least and the largest deflection since they are counted from where they are, rad.
    pub seen: [f64; 2],
    /// The functions that the spring's curve is a sum of.
    pub family: Family,
    located: bool, // the zero, so well that the balance can be linearised
    placed: bool,  // two blocks say where it is
    /// How far a lost zero is from where deflections are counted from, rad; 0: near.
    pub off: f64,
    /// Whether evidence chose a zero that is not the declared one.
    pub moved: bool,
    /// Maximum a posteriori, with its covariance; `None`: not enough motion yet.
    pub posterior: Option<Posterior>,
}

impl Blocks {
    /// Of a motor; `correlated`: rows that one independent error is worth; `settle`: rows after which the filters have
    /// forgotten what was before.
    #[must_use]
    pub fn new(
        motor: &Motor,
        priors: &Priors,
        period_s: f64,
        correlated: f64,
        settle: u32,
        alarms_per_hour: f64,
    ) -> Blocks {
        let (rows, spring) = ((BLOCK_S / period_s).round().max(8.0), Spring::new(motor));
        let errors = (rows / correlated).max(1.0); // independent ones in a block
        Blocks {
            motor: motor.clone(),
            priors: *priors,
            period: period_s,
            rows,
            correlated,
            per_block: (alarms_per_hour * BLOCK_S / 3600.0).clamp(1e-12, 0.5),
            quick_limit: f_quantile(1.0, FEWEST as f64 * errors, alarms_per_hour * LOOK_S / 3600.0),
            open: Gram::default(),
            filled: 0.0,
            ring: VecDeque::with_capacity(BLOCKS),
            waiting: Vec::with_capacity(FEWEST),
            scores: Vec::with_capacity(BLOCKS),
            before: None,
            projection: None,
            deflection: 0.0,
            noise: Noise { variance: f64::NAN, correlated, tails: TAILS },
            own: f64::NAN,
            fluctuation: f64::NAN,
            unexplained: f64::NAN,
            torque: f64::NAN,
            friction: 0.0,
            quick: 0.0,
            peak: 0.0,
            good: 0,
            doubted: 0,
            doubting: false,
            suspected: false,
            skipped: 0,
            settle,
            fitted: false,
            lost: false,
            frame: None,
            residual: [0.0; crate::gram::COLUMNS],
            odds: None,
            readings: Readings::default(),
            seen: [0.0; 2],
            family: Family::of(Some(&spring.law)),
            located: true,
            placed: true,
            off: 0.0,
            moved: false,
            posterior: None,
            spring,
        }
    }

    /// Forget everything but what is declared.
    pub fn clear(&mut self) {
        self.spring.reset();
        self.forget_rows();
        (self.before, self.lost) = (None, false);
    }

    /// Forget rows and what they have taught: they are of other moments. A lost zero stays lost.
    pub fn relearn(&mut self) {
        let (lost, located) = (self.lost, self.located);
        self.clear();
        if lost {
            (self.lost, self.located, self.posterior) = (true, located, None);
        }
    }

    /// What is known from the file alone, of deflections that are read elsewhere and late as usual; `None`: it says
    /// nothing of its precision.
    fn declared(&self) -> Option<Posterior> {
        let mut covariance = self.spring.declared_covariance()?;
        covariance[ZERO][ZERO] = self.near().hypot(self.motor.zero_std).powi(2);
        covariance[LATE][LATE] = (self.priors.encoder_delay * self.period).powi(2);
        let known = set(SPRING.start..SPRING.start + self.spring.least) | 1 << ZERO | 1 << LATE;
        Some(Posterior::believed(known, [0.0; UNKNOWNS], covariance))
    }

    fn forget_rows(&mut self) {
        self.ring.clear();
        self.waiting.clear();
        self.take_open();
        (self.posterior, self.frame) = (self.declared(), None);
        (self.skipped, self.fitted) = (0, false);
        (self.moved, self.located, self.placed) = (false, true, true);
        self.end_doubt();
        self.unform();
        (self.noise.variance, self.own, self.quick) = (f64::NAN, f64::NAN, 0.0);
        self.torque = self.motor.fit_rms.map_or(f64::NAN, |(_, usual)| usual);
        self.unexplained = if self.posterior.is_some() { 0.0 } else { f64::NAN };
    }

    /// What follows is not of the same moments: half a block is a block, fewer rows wait for more. A restart is judged
    /// by what follows it alone.
    pub fn close_early(&mut self) {
        if self.suspected {
            self.take_open();
        } else if self.open.rows >= 0.5 * self.rows {
            let block = self.take_open();
            self.close(block);
        }
        self.quick = 0.0;
    }

    /// Whether so little has been learned that it may be learned anew.
    #[must_use]
    pub fn are_few(&self) -> bool {
        self.ring.len() < FEWEST
    }

    /// What the last rows say of all causes; `None`: they are explained.
    #[must_use]
    pub fn odds(&self) -> Option<&Odds> {
        self.odds.as_ref()
    }

    /// Whether rows are not explained by what is known.
    #[must_use]
    pub fn is_doubting(&self) -> bool {
        self.doubting
    }

    /// Whether motion alone tells where the zero between the encoders is.
    #[must_use]
    pub fn is_lost(&self) -> bool {
        self.lost
    }

    /// Whether two blocks have not yet said where the zero is, or fewer than an interval needs are all that tells of the
    /// spring or of a lost zero.
    #[must_use]
    pub fn is_unconfirmed(&self) -> bool {
        let nothing_before = self.before.is_none() && !self.spring.is_anchored();
        !self.placed
            || self.ring.len() < FEWEST && (nothing_before || self.lost && !self.spring.is_constant())
    }

    /// Whether nothing has been learned, and no zero has been lost.
    #[must_use]
    pub fn knows_nothing(&self) -> bool {
        self.posterior.is_none() && !self.lost
    }

    /// Whether enough is known to hold rows against it.
    #[must_use]
    pub fn is_reference(&self) -> bool {
        let before = self.before.as_ref().is_some_and(|before| !self.lost || before.knows_spring());
        self.frame.is_some() && (self.ring.len() >= FEWEST || before || self.fitted)
    }

    fn close(&mut self, block: Gram) -> Closed {
        if self.frame.is_none() && self.posterior.is_some() {
            self.believe(&block);
        }
        if self.is_unexplained(&block) {
            if !self.doubting {
                return self.begin_doubt();
            }
            if self.suspected {
                self.end_doubt();
                return Closed::Lost;
            }
            self.good = 0;
            self.waiting.push(block);
            return self.decide();
        }
        if self.suspected {
            return self.bear_out(block);
        }
        self.good += 1;
        self.push(block);
        if self.doubting && self.good < CONVINCING {
            return Closed::Unexplained;
        }
        if self.doubts_latest() {
            return self.decide();
        }
        self.end_doubt();
        self.solve();
        if self.lost && self.located && self.off == 0.0 && !self.is_explained() {
            self.lose_zero(); // it was located wrongly
        }
        Closed::Added
    }

    /// What the file knows is held against the first block.
    fn believe(&mut self, block: &Gram) {
        let Some(projection) = self.projection.clone() else { return };
        let frame = self.spring.frame(&projection);
        let prior = self.prior(block, &frame, self.near().hypot(self.motor.zero_std));
        let known = frame.set & ACTIVE;
        let covariance = inverse(&prior.precision, known);
        self.noise.variance = self.early(block);
        self.own = self.noise.variance.sqrt();
        self.residual = frame.residual(&prior.mean, known);
        self.torque = self.spring.torque_rms(&projection, block, self.lost);
        self.posterior = Some(Posterior::believed(known, prior.mean, covariance));
        (self.frame, self.fitted) = (Some(frame), true);
    }

    /// Variance of a row's noise before rows have shown it, (N·m)².
    fn early(&self, rows: &Gram) -> f64 {
        // An error of the model grows with the torque.
        let (left, torque) = self.motor.fit_rms.unwrap_or((0.0, f64::INFINITY));
        let fitted = left * (rows.rms(balance::TORQUE) / torque).max(1.0);
        (EARLY * EARLY * balance::variance(rows, balance::TORQUE)).max(fitted * fitted)
    }

    fn push(&mut self, block: Gram) {
        if self.ring.len() == BLOCKS {
            self.ring.pop_front();
        }
        self.ring.push_back((block, std::mem::take(&mut self.peak)));
    }

    /// Whether it is still to be told where positions count from since a restart.
    #[must_use]
    pub fn is_suspected(&self) -> bool {
        self.suspected
    }
}

/// A VSA-II of the unit tests.
#[cfg(test)]
fn declared() -> Blocks {
    let transmission = crate::model::Transmission::Elastic {
        law: crate::laws::Law::VsaII,
        order: None,
        parameters: vec![0.5, 1.75],
        covariance: None,
    };
    let motor = Motor::bare(5e-4, 5e-3, transmission);
    Blocks::new(&motor, &Priors::USUAL, 1e-3, 100.0, 75, 1.0)
}
