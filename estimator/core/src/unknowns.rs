//! The unknowns of a motor's balance: what each adds to a row, its prior, and what they make at a deflection.

mod candidates;
mod prior;
mod reading;
mod starts;

use serde::{Deserialize, Serialize};

pub use candidates::CANDIDATES;
pub use reading::Reading;

use crate::balance;
use crate::choices::REACHED;
use crate::gram::{COLUMNS, Frame, Gram, Matrix, Row, Set, UNKNOWNS, Vector, set};
use crate::laws::{Alpha, Law, PARAMETERS};
use crate::model::{Motor, Transmission};
use crate::spring::{Coefficients, FIRST, NODES, Projection, TERMS};

/// B, kg·m².
pub const INERTIA: usize = 1;
/// D, N·m·s/rad.
pub const DAMPING: usize = 2;
/// A constant torque on the motor, N·m.
pub const OFFSET: usize = 3;
/// Dry friction, N·m.
pub const DRY: usize = 4;
/// The law's parameters, as far from those at which it is linearised.
pub const SPRING: std::ops::Range<usize> = 5..5 + TERMS;
/// Where the deflection's zero is, as far from where it is assumed, rad.
pub const ZERO: usize = 10;
/// By how much the link position is later than was assumed, s.
pub const LATE: usize = 11;
/// By how much the torque is late, s.
pub const TORQUE_LATE: usize = 12;
/// Of its second derivative, s²: half the square of a delay, zero of a lag.
pub const TORQUE_BEND: usize = 13;
/// Dry friction that changes its sign earlier than the filtered velocity, N·m·s.
pub const DRY_LATE: usize = 14;
/// Friction that grows with speed before it is full, N·m.
pub const SOFT: usize = 15;
/// Friction that grows with the load, N·m at the largest deflection.
pub const LOAD: std::ops::Range<usize> = 16..18;
/// Damping of the transmission, N·m·s/rad.
pub const RATE: usize = 18;
/// Memory of the transmission, N·m at half the range.
pub const STOPS: std::ops::Range<usize> = 19..22;
/// A spring of any shape, N·m at half the range.
pub const CLIPS: std::ops::Range<usize> = 22..26;
/// A corner of the stiffness at zero, N·m at the largest deflection.
pub const CORNER: std::ops::Range<usize> = 26..27;
/// A spring that is stiffer to one side: of |φ|, N·m at the largest deflection, and of φ², N·m/rad².
pub const ASYMMETRY: std::ops::Range<usize> = 27..29;
/// What the link encoder reads too little, by sin q and cos q, rad.
pub const ECCENTRIC: std::ops::Range<usize> = 29..31;

/// Those that every joint has.
pub const ACTIVE: Set = (1 << TORQUE_LATE) - 2;

const USUAL: usize = 2; // powers that springs of which nothing is declared have

/// What the priors of zero, shape and delay are measured by.
#[derive(Clone, Copy, Debug)]
pub struct Scale {
    /// Standard deviation of the deflection's zero, rad.
    pub zero_std: f64,
    /// The largest deflection, rad.
    pub deflection: f64,
    /// Of the samples, s.
    pub period_s: f64,
}

/// The law of a spring, with the point at which it is linearised.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Spring {
    /// The law; a spring of which nothing is known is a polynomial.
    pub law: Law,
    /// How many parameters it has.
    pub size: usize,
    /// How many of them there are at least: evidence adds powers to a polynomial.
    pub least: usize,
    series: bool, // of which nothing is declared
    /// Whether `alpha` is of any meaning.
    pub known: bool,
    /// α.
    pub alpha: Alpha,
    linearised: Alpha, // at which its slopes are those of the posterior
    /// Of φ |φ|, N·m/rad²: a corner of the stiffness at zero that a series of odd powers lacks.
    corner: f64,
    /// Where φ is zero, rad: f(φ + zero).
    pub zero: f64,
    declared: bool,
    anchored: bool, // to what is declared
    start: Alpha,
    covariance: Option<Matrix>, // of what is declared, by the unknowns
}

impl Spring {
    /// Of a motor whose transmission deflects.
    #[must_use]
    pub fn new(motor: &Motor) -> Spring {
        let mut alpha = [0.0; PARAMETERS];
        let (law, order, given, written) = match &motor.transmission {
            Transmission::Elastic { law, order, parameters, covariance } => {
                (law.clone(), *order, parameters.as_slice(), covariance.as_deref())
            }
            _ => (Law::Polynomial, None, [].as_slice(), None),
        };
        let n = given.len().min(TERMS);
        alpha[..n].copy_from_slice(&given[..n]);
        if n == 0 {
            alpha[0] = 1.0;
            law.shapes().iter().zip(&mut alpha[1..]).for_each(|(shape, value)| *value = shape.start);
        }
        let (least, size) = match law {
            Law::Linear | Law::Polynomial => (order.unwrap_or(1).max(n).min(TERMS), TERMS),
            _ => (1 + law.shapes().len(), 1 + law.shapes().len()),
        };
        let covariance = written.filter(|_| n == least && n == given.len()).map(|rows| {
            let mut covariance = [[0.0; UNKNOWNS]; UNKNOWNS];
            for (i, row) in rows.chunks_exact(n).enumerate() {
                covariance[SPRING.start + i][SPRING.start..SPRING.start + n].copy_from_slice(row);
            }
            covariance
        });
        let declared = n > 0;
        let series = matches!(law, Law::Polynomial) && !declared && order.is_none();
        Spring {
            law,
            size,
            least,
            series,
            known: declared,
            alpha,
            linearised: alpha,
            corner: 0.0,
            zero: 0.0,
            declared,
            anchored: declared,
            start: alpha,
            covariance,
        }
    }

    /// Back to what is declared.
    pub fn reset(&mut self) {
        (self.alpha, self.zero, self.known, self.anchored) = (self.start, 0.0, self.declared, self.declared);
        (self.linearised, self.corner) = (self.start, 0.0);
    }

    /// It has changed: what is declared is no measure any more.
    pub fn open(&mut self) {
        self.anchored = false;
    }

    /// It may be any that the file declares: what has been learned is no measure any more.
    pub fn forget(&mut self) {
        self.anchored = self.declared;
    }

    /// Whether the file says about what it is.
    #[must_use]
    pub fn is_anchored(&self) -> bool {
        self.anchored
    }

    /// The unknowns of the terms that a series may have.
    #[must_use]
    pub fn shape(&self) -> Set {
        if self.series { set(SPRING) | set(CORNER) } else { set(SPRING) }
    }

    /// Whether nothing is declared of it, not even an order.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.series
    }

    /// Whether these unknowns hold more powers than are declared.
    #[must_use]
    pub fn is_longer(&self, of: Set) -> bool {
        !self.series && of & set(SPRING.start + self.least..SPRING.end) != 0
    }

    /// α of this law alone.
    #[must_use]
    pub fn parameters(&self) -> &[f64] {
        &self.alpha[..self.size]
    }

    /// Largest |φ| of the law, rad.
    #[must_use]
    pub fn reach(&self) -> f64 {
        if self.law.is_polynomial() { f64::INFINITY } else { self.law.reach(&self.alpha[1..self.size]) }
    }

    /// Whether the balance is linear in α.
    fn is_linear(&self) -> bool {
        self.law.shapes().is_empty()
    }

    /// Whether its stiffness is one number: its zero is then a constant torque.
    #[must_use]
    pub fn is_constant(&self) -> bool {
        self.law.is_polynomial() && self.alpha[1..].iter().all(|power| *power == 0.0)
    }

    /// Whether it is declared as a straight line: more powers are then an effect.
    #[must_use]
    pub fn is_line(&self) -> bool {
        matches!(self.law, Law::Linear)
    }

    /// Whether one solution is final: the balance is linear in its parameters, and its zero is where it was.
    #[must_use]
    pub fn is_settled(&self) -> bool {
        self.is_linear() && self.zero == 0.0
    }

    /// The largest deflection that any start of it has, rad.
    #[must_use]
    pub fn widest_reach(&self, deflection: f64) -> f64 {
        let own = if self.known { self.reach() } else { f64::INFINITY };
        if own > deflection { own } else { f64::INFINITY }
    }

    /// Count values of the law's parameters and of the zero from where they are linearised.
    pub fn from_base(&self, values: &mut Vector, of: Set) {
        let base = self.base();
        for (i, unknown) in SPRING.enumerate().filter(|(_, unknown)| of >> unknown & 1 == 1) {
            values[unknown] -= base[i];
        }
        if of >> ZERO & 1 == 1 {
            values[ZERO] -= self.zero;
        }
    }

    /// Covariance that the file states of the law's parameters; `None`: none, or it holds no more.
    #[must_use]
    pub fn declared_covariance(&self) -> Option<Matrix> {
        self.covariance.filter(|_| self.anchored)
    }

    /// α that the deviations are counted from.
    fn base(&self) -> Alpha {
        if self.is_linear() { [0.0; PARAMETERS] } else { self.alpha }
    }

    /// Move to the parameters that a solution has found; what cannot be is cut off. `size`: of the columns, rad.
    pub fn move_by(&mut self, x: &Vector, size: f64) {
        let base = self.base();
        for (i, unknown) in SPRING.enumerate().take(self.size) {
            self.alpha[i] = base[i] + x[unknown];
        }
        let shapes = self.law.shapes();
        for (shape, (value, before)) in shapes.iter().zip(self.alpha[1..].iter_mut().zip(&base[1..])) {
            let near = (0.5 * (before - shape.low), 2.0 * (before - shape.low)); // one step of an iteration
            *value = value.clamp(shape.low + near.0, (shape.low + near.1).min(shape.high));
        }
        self.linearised = self.alpha;
        if !shapes.is_empty() {
            self.linearised = base;
            // What was found is a torque; k depends on the shape, along a line that is not straight.
            let (n, ends) =
                (self.size, [&base, &self.alpha].map(|alpha| self.law.reach(&alpha[1..self.size])));
            let phi = size.min(REACHED * ends[0].min(ends[1]));
            let mut slopes = [0.0; PARAMETERS];
            self.law.jacobian(phi, &base[..n], &mut slopes[..n]);
            let moved: f64 = slopes[..n].iter().zip(&x[SPRING]).map(|(slope, x)| slope * x).sum();
            let torque = self.law.at(phi, &base[..n]).0 + moved;
            self.alpha[0] = 1.0;
            self.alpha[0] = torque / self.law.at(phi, self.parameters()).0;
        }
        self.zero += x[ZERO];
        self.corner = x[CORNER.start] / size.powi(2);
        self.known = true;
    }

    /// What each unknown adds to a row.
    #[must_use]
    pub fn frame(&self, projection: &Projection) -> Frame {
        let mut frame = Frame { left: [0.0; COLUMNS], directions: [[0.0; COLUMNS]; UNKNOWNS], set: 0 };
        frame.left[balance::TORQUE] = 1.0;
        let plain = [
            (INERTIA, balance::ACCELERATION),
            (DAMPING, balance::VELOCITY),
            (OFFSET, balance::OFFSET),
            (DRY, balance::DRY),
            (DRY_LATE, balance::DRY_RATE),
            (SOFT, balance::SOFT),
            (RATE, balance::VELOCITY),
            (RATE, balance::LINK_RATE),
            (ASYMMETRY.start, balance::UNEVEN),
            (CORNER.start, balance::CORNER),
        ];
        let own = STOPS.zip(balance::STOPS).chain(CLIPS.zip(balance::CLIPS)).chain(LOAD.zip(balance::LOAD));
        for (unknown, column) in plain.into_iter().chain(own) {
            frame.directions[unknown][column] = 1.0;
        }
        let nodes = projection.nodes();
        let mut rows = [[0.0; TERMS]; NODES];
        let alpha = self.parameters();
        for (phi, row) in nodes.iter().zip(&mut rows) {
            self.law.jacobian(phi + self.zero, alpha, &mut row[..self.size]);
        }
        frame.directions[TORQUE_LATE][balance::TORQUE_RATE] = -1.0;
        frame.directions[TORQUE_BEND][balance::TORQUE_SECOND] = -1.0;
        for (i, unknown) in SPRING.enumerate().take(self.size) {
            let column: [f64; NODES] = std::array::from_fn(|k| rows[k][i]);
            place(&mut frame.directions[unknown], &projection.fit(&column), 1.0);
        }
        if !self.is_linear() {
            place(&mut frame.left, &self.torque(projection), -1.0);
        }
        place(&mut frame.directions[ASYMMETRY.end - 1], &projection.of(|phi| phi * phi), 1.0);
        let (slope, first) = self.slope(projection);
        let moved = projection.of(|phi| self.law.at(phi + self.zero, alpha).1);
        place(&mut frame.directions[ZERO], &moved, 1.0);
        frame.directions[LATE] = late(&slope, balance::LATE.start);
        for (unknown, columns) in ECCENTRIC.zip([balance::SINE, balance::COSINE]) {
            frame.directions[unknown] = late(&first, columns.start);
        }
        frame.set = set(1..UNKNOWNS) & !set(SPRING.start + self.size..SPRING.end);
        if !self.series {
            frame.set &= !set(CORNER);
        }
        if slope.iter().all(|s| *s == 0.0) {
            frame.set &= !(1 << ZERO | 1 << LATE | set(ECCENTRIC));
        }
        frame
    }

    /// τ_e and σ of the law, whose zero may be elsewhere, and of the corner, which stays where it is declared.
    #[must_use]
    pub fn curve(&self, phi: f64) -> (f64, f64) {
        let (torque, stiffness) = self.law.at(phi + self.zero, self.parameters());
        (torque + self.corner * phi * phi.abs(), stiffness + 2.0 * self.corner * phi.abs())
    }

    /// τ_e as a sum of the family's functions.
    #[must_use]
    pub fn torque(&self, projection: &Projection) -> Coefficients {
        projection.of(|phi| self.curve(phi).0)
    }

    /// rms of τ_e over some rows, N·m; `lost`: the zero, and with it the mean.
    #[must_use]
    pub fn torque_rms(&self, projection: &Projection, rows: &Gram, lost: bool) -> f64 {
        let mut direction = [0.0; COLUMNS];
        place(&mut direction, &self.torque(projection), 1.0);
        let mean = if lost { rows.times(&direction)[balance::OFFSET] / rows.rows } else { 0.0 };
        (rows.quadratic(&direction) / rows.rows - mean * mean).max(0.0).sqrt()
    }

    /// φ σ as a sum of the family's functions.
    #[must_use]
    pub fn turn(&self, projection: &Projection) -> Coefficients {
        projection.of(|phi| phi * self.curve(phi).1)
    }

    /// σ as a sum of the family's slopes, and of the first ones alone.
    #[must_use]
    pub fn slope(&self, projection: &Projection) -> ([f64; TERMS], [f64; FIRST]) {
        projection.of_slopes(|phi| self.curve(phi).1)
    }
}

fn place(row: &mut Row, coefficients: &Coefficients, sign: f64) {
    let columns = row[balance::SPRING.start..].iter_mut();
    columns.zip(coefficients).for_each(|(column, value)| *column += sign * value);
}

/// σ times a signal of the link, from the column `from` on.
#[must_use]
pub fn late(slope: &[f64], from: usize) -> Row {
    let mut row = [0.0; COLUMNS];
    row[from..from + slope.len()].copy_from_slice(slope);
    row
}
