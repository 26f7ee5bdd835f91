//! Compares two readings of one quantity.
//!
//! A drive often reports a quantity twice: its velocity beside its position, its current beside its torque, a second
//! encoder, its following error. The second reading is a line of the first, y = s x + l ẋ + o: scale, lag and
//! zero are estimated while both agree. In blocks of [`BLOCK_PERIODS`] the means of both are compared (of a
//! velocity: what it integrates to, and how far the position has come). The last [`WINDOW`] blocks with
//! information in them are tested together: r = y - h x̂ ~ N(0, κ² (I + H P Hᵀ)) in units of what a block is
//! allowed, so rᵀ(I + H P Hᵀ)⁻¹ r / κ² ~ χ² of [`WINDOW`] degrees of freedom. One test finds a changed scale,
//! a stuck or drifting reading, noise and slips alike; [`LIMIT`] states how often it errs.
//!
//! The tolerance of a block is the resolution of both readings, one period between them, and [`SAME`] of the
//! change. Added are the noise observed in health, equal in every block, and κ >= 1 if that does not suffice.

/// Communication periods in one block, at least: longer than the filters in drives.
const BLOCK_PERIODS: i64 = 50;
/// Periods without a reading that a block may have in one go.
const MOST_GAP: i64 = 10;
/// Blocks that are tested together.
pub const WINDOW: usize = 20;
/// Blocks that are learned from before the test begins: the noise from a third of them on, κ from two thirds on.
const FIRST: u32 = 3 * WINDOW as u32;
/// χ² of 20 degrees of freedom is above it once in 10⁹ windows: at 20 blocks/s of motion, once in 1.6 years.
pub const LIMIT: f64 = 83.48;
/// Relative difference between two readings of one quantity that is no fault.
const SAME: f64 = 0.01;
/// Blocks that the line is learned over: a minute of motion at 1 kHz.
const MEMORY: f64 = 1200.0;
/// A block is informative where a reading moves by so many of its standard deviations of rounding.
const TELLS: f64 = 20.0;
/// Standard deviation of a declared scale, relative, before anything is learned; of one that is not declared.
const DECLARED: f64 = 0.05;
const UNDECLARED: f64 = 10.0;
/// Standard deviation of the lag, periods.
const LAG: f64 = 10.0;
/// Standard deviation of a zero that may be anywhere, in units of what a block is allowed.
const ANYWHERE: f64 = 1e6;

type Row = [f64; 3]; // of scale, lag and zero
type Square = [[f64; 3]; 3];

/// Which two readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Position and velocity (0x606C).
    Velocity,
    /// Torque and current: 0x6077 and 0x6078, or the maker's object.
    Current,
    /// Position and a second encoder on the motor's side (0x60E4).
    SecondEncoder,
    /// Demand (0x6062) less position, and following error (0x60F4).
    FollowingError,
}

/// What a check has come to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Not enough motion so far.
    Untested,
    /// Both readings agree.
    Agrees,
    /// They contradict each other.
    Contradicts,
}

#[derive(Clone, Copy, Debug)]
struct Block {
    row: Row,     // in units of what the block is allowed
    value: f64,   // likewise
    allowed: f64, // in the second reading's unit
}

/// One check of one motor.
#[derive(Clone, Debug)]
pub struct CrossCheck {
    /// Which readings.
    pub kind: Kind,
    /// Of which motor, from 0.
    pub motor: usize,
    steps: (f64, f64), // SI per count of both readings
    period: f64,
    // This block.
    first: (f64, f64),
    last: (f64, f64),
    low: (f64, f64),
    high: (f64, f64),
    sums: (f64, f64),
    readings: f64,
    begun: i64, // sequence; -1: not begun
    seen: i64,
    // The last blocks, and what was learned before them.
    window: [Block; WINDOW],
    filled: usize,
    next: usize,
    prior: Row,
    information: Square,
    vector: Row,
    learned: u32,
    weight: f64,
    squares: f64, // of the units of what is allowed
    noise_weight: f64,
    noise_squares: f64,
    /// χ² of the window, compared with [`LIMIT`].
    pub statistic: f64,
    verdict: Verdict,
}

impl CrossCheck {
    /// A check that has seen nothing.
    ///
    /// `steps`: SI units per count of the first and of the second reading; `period`: s.
    #[must_use]
    pub fn new(kind: Kind, motor: usize, steps: (f64, f64), period: f64) -> CrossCheck {
        let scale = if kind.is_declared() { DECLARED } else { UNDECLARED };
        let zero = if kind.is_declared() { 1.0 } else { ANYWHERE };
        let mut check = CrossCheck {
            kind,
            motor,
            steps: (steps.0.abs(), steps.1.abs()),
            period,
            first: (0.0, 0.0),
            last: (0.0, 0.0),
            low: (0.0, 0.0),
            high: (0.0, 0.0),
            sums: (0.0, 0.0),
            readings: 0.0,
            begun: -1,
            seen: -1,
            window: [Block { row: [0.0; 3], value: 0.0, allowed: 1.0 }; WINDOW],
            filled: 0,
            next: 0,
            prior: [scale.powi(-2), LAG.powi(-2), zero.powi(-2)],
            information: [[0.0; 3]; 3],
            vector: [0.0; 3],
            learned: 0,
            weight: 0.0,
            squares: 0.0,
            noise_weight: 0.0,
            noise_squares: 0.0,
            statistic: 0.0,
            verdict: Verdict::Untested,
        };
        check.reset();
        check
    }

    /// Forget everything: the readings may begin anew.
    pub fn reset(&mut self) {
        (self.begun, self.filled, self.next, self.learned) = (-1, 0, 0, 0);
        (self.weight, self.squares, self.statistic) = (0.0, 0.0, 0.0);
        (self.noise_weight, self.noise_squares) = (0.0, 0.0);
        (self.information, self.vector) = before(&self.prior);
        self.verdict = Verdict::Untested;
    }

    /// What it has come to.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// The scale of the second reading against the first now, and its standard deviation: of the window while both
    /// contradict each other, else as learned.
    #[must_use]
    pub fn scale(&self) -> (f64, f64) {
        let (mut information, mut vector) = (self.information, self.vector);
        if self.verdict == Verdict::Contradicts && self.learned >= FIRST {
            (information, vector) = before(&[UNDECLARED.powi(-2), self.prior[1], self.prior[2]]);
            for block in &self.window[..self.filled] {
                add(&mut information, &mut vector, &block.row, block.value);
            }
        }
        let std = solve(&information, &[1.0, 0.0, 0.0])[0].max(0.0).sqrt();
        (solve(&information, &vector)[0], self.noise() * std)
    }

    /// Both readings at the SYNC of this number; whether that ended a block.
    pub fn add(&mut self, sequence: i64, x: f64, y: f64) -> bool {
        if !(x.is_finite() && y.is_finite()) {
            return false;
        }
        let gap = sequence - self.seen;
        if self.begun < 0 || gap <= 0 || gap > MOST_GAP {
            self.begin(sequence, x, y);
            return false;
        }
        self.seen = sequence;
        if self.kind == Kind::Velocity {
            self.sums.1 += 0.5 * (self.last.1 + y) * gap as f64 * self.period;
        } else {
            self.sums = (self.sums.0 + x, self.sums.1 + y);
        }
        self.readings += 1.0;
        self.last = (x, y);
        self.low = (self.low.0.min(x), self.low.1.min(y));
        self.high = (self.high.0.max(x), self.high.1.max(y));
        let ended = sequence - self.begun >= BLOCK_PERIODS;
        if ended {
            if let Some(block) = self.block() {
                self.judge(block);
            }
            self.begin(sequence, x, y);
        }
        ended
    }

    fn begin(&mut self, sequence: i64, x: f64, y: f64) {
        (self.begun, self.seen) = (sequence, sequence);
        (self.first, self.last, self.low, self.high) = ((x, y), (x, y), (x, y), (x, y));
        (self.sums, self.readings) = ((0.0, 0.0), 0.0);
    }

    /// The block that ends now, in units of what it is allowed; `None` where it is not informative.
    fn block(&self) -> Option<Block> {
        let periods = (self.seen - self.begun) as f64;
        let spread = (self.high.0 - self.low.0, self.high.1 - self.low.1);
        let (x, y, slope, rounding, moved);
        if self.kind == Kind::Velocity {
            (x, y) = (self.last.0 - self.first.0, self.sums.1);
            // A first-order filter of time constant l leaves out l times the change of what it gives: exactly.
            slope = (self.last.1 - self.first.1) * self.period;
            // Both ends of the way; a velocity that is rounded always the same way, or cut off.
            let far = self.steps.1 * periods * self.period;
            rounding = (2.0 * self.steps.0.powi(2) / 12.0 + far.powi(2) / 3.0).sqrt();
            moved = x.abs().max(y.abs());
        } else {
            (x, y) = (self.sums.0 / self.readings, self.sums.1 / self.readings);
            slope = (self.last.1 - self.first.1) / periods;
            rounding = ((self.steps.0.powi(2) + self.steps.1.powi(2)) / 12.0).sqrt();
            moved = spread.0.max(spread.1);
        }
        if rounding <= 0.0 || moved <= TELLS * rounding {
            return None;
        }
        let change = match self.kind {
            Kind::Velocity => x,
            Kind::Current => x.abs().max(spread.0),
            Kind::SecondEncoder | Kind::FollowingError => spread.0,
        };
        let noise = if self.noise_weight > 0.0 { self.noise_squares / self.noise_weight } else { 0.0 };
        let allowed = (rounding.powi(2) + (SAME * change).powi(2) + slope.powi(2) + noise).sqrt();
        let row = [x / allowed, slope / allowed, rounding / allowed];
        Some(Block { row, value: y / allowed, allowed })
    }

    fn judge(&mut self, block: Block) {
        let leaves = std::mem::replace(&mut self.window[self.next], block);
        let full = self.filled == WINDOW;
        self.next = (self.next + 1) % WINDOW;
        self.filled = (self.filled + 1).min(WINDOW);
        self.statistic = self.chi_squared();
        if full && (self.learned < FIRST || self.verdict != Verdict::Contradicts) {
            self.learn(&leaves);
        }
        self.verdict = if self.learned < FIRST {
            Verdict::Untested
        } else if self.statistic > LIMIT || self.is_scaled_wrong() {
            Verdict::Contradicts
        } else {
            Verdict::Agrees
        };
    }

    /// A scale that is declared on both sides is one.
    fn is_scaled_wrong(&self) -> bool {
        if !self.kind.is_declared() {
            return false;
        }
        let scale = solve(&self.information, &self.vector)[0];
        let std = solve(&self.information, &[1.0, 0.0, 0.0])[0].max(0.0).sqrt();
        (scale - 1.0).abs() > DECLARED + 5.0 * self.noise() * std
    }

    fn chi_squared(&self) -> f64 {
        let line = solve(&self.information, &self.vector);
        let (mut information, mut vector, mut total) = (self.information, [0.0; 3], 0.0);
        for block in &self.window[..self.filled] {
            let left = block.value - dot(&block.row, &line);
            add(&mut information, &mut vector, &block.row, left);
            total += left * left;
        }
        (total - dot(&vector, &solve(&information, &vector))).max(0.0) / self.noise().powi(2)
    }

    /// κ.
    fn noise(&self) -> f64 {
        ((self.squares + 1.0) / (self.weight + 1.0)).max(1.0).sqrt()
    }

    fn learn(&mut self, block: &Block) {
        let line = solve(&self.information, &self.vector);
        let left = block.value - dot(&block.row, &line);
        let expected = 1.0 + dot(&block.row, &solve(&self.information, &block.row));
        let keep = 1.0 - 1.0 / MEMORY;
        let square = left * left / expected;
        if self.learned >= FIRST / 3 {
            // Of all blocks alike: too much where motion scatters more, but never a few that happen to agree.
            self.noise_weight = keep * self.noise_weight + 1.0;
            self.noise_squares = keep * self.noise_squares + square * block.allowed.powi(2);
        }
        if self.learned >= FIRST / 3 * 2 {
            self.weight = keep * self.weight + 1.0;
            self.squares = keep * self.squares + square;
        }
        for i in 0..3 {
            for j in 0..3 {
                self.information[i][j] *= keep;
            }
            self.information[i][i] += (1.0 - keep) * self.prior[i]; // never less than before anything was learned
            self.vector[i] *= keep;
        }
        self.vector[0] += (1.0 - keep) * self.prior[0];
        add(&mut self.information, &mut self.vector, &block.row, block.value);
        self.learned = self.learned.saturating_add(1);
    }
}

impl Kind {
    /// Whether both readings have one unit by declaration.
    fn is_declared(self) -> bool {
        matches!(self, Kind::Velocity | Kind::FollowingError)
    }

    /// As the service names the second reading.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Kind::Velocity => "velocity",
            Kind::Current => "current",
            Kind::SecondEncoder => "second_encoder",
            Kind::FollowingError => "following_error",
        }
    }
}

/// Whether any of these checks of one motor leaves no doubt that a reading the estimate is made of may lie.
///
/// Where one check of the position fails and another one passes, the position is right and the other reading wrong.
#[must_use]
pub fn spoils(checks: &[CrossCheck], motor: usize) -> bool {
    let is = |check: &CrossCheck, verdict| check.motor == motor && check.verdict == verdict;
    let of_position = |check: &&CrossCheck| check.kind != Kind::Current;
    let torque = checks.iter().any(|check| check.kind == Kind::Current && is(check, Verdict::Contradicts));
    let position = checks.iter().filter(of_position).any(|check| is(check, Verdict::Contradicts));
    let cleared = checks.iter().filter(of_position).any(|check| is(check, Verdict::Agrees));
    torque || position && !cleared
}

/// Information and vector of a scale of one, no lag, no zero, before anything is learned.
fn before(prior: &Row) -> (Square, Row) {
    let mut information = [[0.0; 3]; 3];
    for i in 0..3 {
        information[i][i] = prior[i];
    }
    (information, [prior[0], 0.0, 0.0])
}

fn dot(a: &Row, b: &Row) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn add(information: &mut Square, vector: &mut Row, row: &Row, value: f64) {
    for i in 0..3 {
        for j in 0..3 {
            information[i][j] += row[i] * row[j];
        }
        vector[i] += row[i] * value;
    }
}

/// The solution of a symmetric positive definite system (LDLᵀ).
fn solve(matrix: &Square, vector: &Row) -> Row {
    let d0 = matrix[0][0];
    let (l10, l20) = (matrix[1][0] / d0, matrix[2][0] / d0);
    let d1 = matrix[1][1] - l10 * l10 * d0;
    let l21 = (matrix[2][1] - l20 * l10 * d0) / d1;
    let d2 = matrix[2][2] - l20 * l20 * d0 - l21 * l21 * d1;
    let y1 = vector[1] - l10 * vector[0];
    let y2 = vector[2] - l20 * vector[0] - l21 * y1;
    let z2 = y2 / d2;
    let z1 = y1 / d1 - l21 * z2;
    [vector[0] / d0 - l10 * z1 - l20 * z2, z1, z2]
}

#[cfg(test)]
mod tests;
