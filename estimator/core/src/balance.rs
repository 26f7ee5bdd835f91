//! Eq 5 of one motor as a row of filtered columns, the only place where it is formed for [`crate::gram`].
//!
//! F τ = B F θ″ + D F θ′ + offset + friction − Σ k_h F u^(2h−1) − …, u = φ over the deflection's size. Every
//! column passes the same filters, so their lag cancels.

use crate::filters::StateVariableFilter;
use crate::gram::{COLUMNS, Row, Set};
use crate::signals::{Channel, Filters, Formed};

/// F τ, N·m.
pub const TORQUE: usize = 0;
/// F θ″: the inertia, kg·m².
pub const ACCELERATION: usize = 1;
/// F θ′: the damping, N·m·s/rad.
pub const VELOCITY: usize = 2;
/// 1: a constant torque, N·m.
pub const OFFSET: usize = 3;
/// Sign of θ′: dry friction, N·m.
pub const DRY: usize = 4;
/// −u, −u³, …, −u⁹: the spring, N·m.
pub const POWERS: std::ops::Range<usize> = 5..10;
/// −u², −u⁴: a spring whose zero is elsewhere, N·m.
pub const EVEN: std::ops::Range<usize> = 10..12;
/// −q′, −u² q′: a link position that is read late.
pub const LATE: std::ops::Range<usize> = 12..14;
/// A softer sign of θ′: friction that grows with speed before it is full, N·m.
pub const SOFT: usize = 14;
/// |u| times the sign of θ′: friction of the load, N·m.
pub const LOAD: usize = 15;
/// −(stops of three widths on u): memory of the transmission, N·m.
pub const STOPS: std::ops::Range<usize> = 16..19;
/// −(u clipped at five widths): a spring of any shape, N·m.
pub const CLIPS: std::ops::Range<usize> = 19..24;

const FRICTION_SPEED: f64 = 0.02; // of the largest velocity: over which dry friction changes its sign …
const SOFTER: f64 = 10.0; // … and the same of the softer one: between them lie the usual Stribeck speeds
const STOP_WIDTHS: [f64; 3] = [0.1, 0.3, 0.6]; // of half the range of u: a memory of one width lies between two
const CLIP_WIDTHS: [f64; 5] = [0.05, 0.15, 0.3, 0.5, 0.75]; // likewise
const GROWN: f64 = 1.5; // times its size: the columns are scaled anew

/// The bits of some columns.
#[must_use]
pub fn set(columns: std::ops::Range<usize>) -> Set {
    columns.fold(0, |set, column| set | 1 << column)
}

/// What the columns are scaled by, taken from the motion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Size {
    /// Largest |φ|, rad.
    pub deflection: f64,
    /// Half the range of φ, over that.
    pub range: f64,
    /// Largest |θ′|, rad/s.
    pub speed: f64,
}

/// The filtered columns of one motor.
#[derive(Clone, Debug)]
pub struct Balance {
    /// What the columns are scaled by; zero before there was motion.
    pub size: Size,
    position: Channel,
    torque: Channel,
    curve: [Channel; 12], // powers, even powers, clipped
    formed: [Formed; 7],  // dry, soft, load, late by φ², stops
    effects: Formed,
    stops: [f64; 3],
    last: f64,
    low: f64,
    high: f64,
    speed: f64,
}

impl Balance {
    /// At rest.
    #[must_use]
    pub fn new() -> Balance {
        Balance {
            size: Size::default(),
            position: Channel::rest(0.0),
            torque: Channel::rest(0.0),
            curve: [Channel::rest(0.0); 12],
            formed: [Formed::default(); 7],
            effects: Formed::default(),
            stops: [0.0; 3],
            last: 0.0,
            low: f64::INFINITY,
            high: f64::NEG_INFINITY,
            speed: 0.0,
        }
    }

    /// As if the joint had been here forever.
    pub fn restart(&mut self, theta: f64, phi: f64, torque: f64) {
        self.position = Channel::rest(theta);
        self.torque = Channel::rest(torque);
        self.formed = [Formed::default(); 7];
        self.effects = Formed::default();
        self.rest_curve(phi);
    }

    fn rest_curve(&mut self, phi: f64) {
        let columns = self.curve_columns(phi);
        for (channel, value) in self.curve.iter_mut().zip(columns) {
            *channel = Channel::rest(value);
        }
        self.stops = [0.0; 3];
        self.last = self.unit(phi);
    }

    fn unit(&self, phi: f64) -> f64 {
        if self.size.deflection > 0.0 { phi / self.size.deflection } else { 0.0 }
    }

    fn curve_columns(&self, phi: f64) -> [f64; 12] {
        let u = self.unit(phi);
        let mut out = [0.0; 12];
        for (h, value) in out[..5].iter_mut().enumerate() {
            *value = -u.powi(2 * h as i32 + 1);
        }
        (out[5], out[6]) = (-u * u, -u.powi(4));
        for (value, width) in out[7..].iter_mut().zip(CLIP_WIDTHS) {
            let width = width * self.size.range;
            *value = -u.clamp(-width, width);
        }
        out
    }

    /// How large the motion has been since the last call of `scale`; `usable`: whether this moment counts.
    pub fn observe(&mut self, phi: f64, usable: bool) {
        if usable {
            self.low = self.low.min(phi);
            self.high = self.high.max(phi);
            self.speed = self.speed.max(self.position.light[1].abs());
        }
    }

    /// Whether the motion has outgrown what the columns are scaled by.
    #[must_use]
    pub fn outgrown(&self) -> bool {
        let (size, seen) = (&self.size, self.seen());
        seen.deflection > GROWN * size.deflection
            || seen.range * seen.deflection > GROWN * size.range * size.deflection
            || seen.speed > GROWN * size.speed
    }

    /// Largest |φ| seen, rad.
    #[must_use]
    pub fn largest(&self) -> f64 {
        self.seen().deflection
    }

    fn seen(&self) -> Size {
        let deflection = self.low.abs().max(self.high.abs());
        if !(deflection > 0.0 && deflection.is_finite()) {
            return Size::default();
        }
        Size { deflection, range: 0.5 * (self.high - self.low) / deflection, speed: self.speed }
    }

    /// Scale the columns by the motion seen so far; they begin anew.
    pub fn scale(&mut self, phi: f64) {
        self.size = self.seen();
        self.formed = [Formed::default(); 7];
        self.rest_curve(phi);
    }

    /// One period. `effect`: torque of the declared effects, N·m.
    pub fn feed(
        &mut self,
        filters: &Filters,
        theta: f64,
        phi: f64,
        torque: f64,
        link: &Channel,
        effect: f64,
    ) {
        self.position.smooth(filters, theta);
        self.torque.held(filters, torque);
        self.effects.pass(filters, effect);
        if self.size.deflection == 0.0 {
            return;
        }
        let columns = self.curve_columns(phi);
        for (channel, value) in self.curve.iter_mut().zip(columns) {
            smooth(channel, filters, value);
        }
        let rate = self.position.light[1];
        let u = self.unit(link.light[0] - self.position.light[0]);
        let speed = FRICTION_SPEED * self.size.speed;
        let sign = (rate / speed).tanh();
        let (step, range) = (u - self.last, self.size.range);
        self.last = u;
        for (stop, width) in self.stops.iter_mut().zip(STOP_WIDTHS) {
            *stop = (*stop + step).clamp(-width * range, width * range);
        }
        let [a, b, c] = self.stops;
        let now =
            [sign, (rate / (SOFTER * speed)).tanh(), u.abs() * sign, -u * u * link.light[1], -a, -b, -c];
        for (formed, value) in self.formed.iter_mut().zip(now) {
            pass(formed, filters, value);
        }
    }

    /// The row of this moment.
    #[must_use]
    pub fn row(&self, link: &Channel) -> Row {
        let mut row: Row = [0.0; COLUMNS];
        row[TORQUE] = self.torque.main[0] - self.effects.main[0];
        row[ACCELERATION] = self.position.main[2];
        row[VELOCITY] = self.position.main[1];
        row[OFFSET] = 1.0;
        for (column, channel) in POWERS.chain(EVEN).chain(CLIPS).zip(&self.curve) {
            row[column] = channel.main[0];
        }
        row[LATE.start] = -link.main[1];
        let formed = [DRY, SOFT, LOAD, LATE.start + 1].into_iter().chain(STOPS);
        for (column, formed) in formed.zip(&self.formed) {
            row[column] = formed.main[0];
        }
        row
    }

    /// Slopes of the transmission's torque and of its stiffness by the coefficients, at a deflection.
    #[must_use]
    pub fn slopes(&self, phi: f64, set: Set) -> (Row, Row) {
        let (u, unit) = (self.unit(phi), self.size.deflection.recip());
        let (mut torque, mut stiffness) = ([0.0; COLUMNS], [0.0; COLUMNS]);
        let has = |column: usize| set >> column & 1 == 1;
        for (h, column) in POWERS.enumerate().filter(|(_, column)| has(*column)) {
            let power = 2 * h as i32;
            torque[column] = u.powi(power + 1);
            stiffness[column] = f64::from(power + 1) * u.powi(power) * unit;
        }
        for (h, column) in EVEN.enumerate().filter(|(_, column)| has(*column)) {
            let power = 2 * h as i32 + 2;
            torque[column] = u.powi(power);
            stiffness[column] = f64::from(power) * u.powi(power - 1) * unit;
        }
        for (column, width) in CLIPS.zip(CLIP_WIDTHS).filter(|(column, _)| has(*column)) {
            let width = width * self.size.range;
            torque[column] = u.clamp(-width, width);
            stiffness[column] = if u.abs() < width { unit } else { 0.0 };
        }
        for (column, stop) in STOPS.zip(self.stops).filter(|(column, _)| has(*column)) {
            torque[column] = stop;
        }
        (torque, stiffness)
    }

    /// Filtered θ′, rad/s.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.position.main[1]
    }

    /// Filtered θ‴, rad/s³.
    #[must_use]
    pub fn jerk(&self) -> f64 {
        self.position.main[3]
    }

    /// Lightly filtered θ and its derivatives.
    #[must_use]
    pub fn light(&self) -> &[f64; 3] {
        &self.position.light
    }

    /// Lightly filtered τ, N·m.
    #[must_use]
    pub fn light_torque(&self) -> f64 {
        self.torque.light[0]
    }
}

impl Default for Balance {
    fn default() -> Balance {
        Balance::new()
    }
}

/// One channel: a call, not a copy of the filters for each column.
#[inline(never)]
fn smooth(channel: &mut Channel, filters: &Filters, now: f64) {
    channel.smooth(filters, now);
}

/// One formed signal, likewise.
#[inline(never)]
fn pass(formed: &mut Formed, filters: &Filters, now: f64) {
    formed.pass(filters, now);
}

/// Rows that the filters make of one independent error: the length of their impulse response over a period.
#[must_use]
pub fn correlated_rows(main: &StateVariableFilter<4>, period_s: f64) -> f64 {
    // White noise through w⁴/(s + w)⁴ has the correlation time 2 ∫ρ dt = 32/(5 w).
    (6.4 / (main.bandwidth * period_s)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A joint on a sine whose torque is known in closed form: the row's columns add up to zero.
    #[test]
    fn the_row_of_a_known_joint_is_a_balance() {
        let (period, filters) = (1e-3, Filters::new(60.0, 1e-3));
        let (inertia, damping, k1, k3) = (0.1, 0.5, 100.0, 4000.0);
        let w = 7.0;
        let at = |t: f64| (0.5 * (w * t).sin(), 0.4 * (w * t + 0.2).sin());
        let torque = |t: f64| {
            let (theta, q) = at(t);
            let (rate, acceleration) = (0.5 * w * (w * t).cos(), -w * w * theta);
            let phi = q - theta;
            inertia * acceleration + damping * rate - k1 * phi - k3 * phi.powi(3)
        };
        let mut balance = Balance::new();
        let mut link = Channel::rest(0.0);
        let mut left: f64 = 0.0;
        let mut largest: f64 = 0.0;
        for k in 0..6000 {
            let t = f64::from(k) * period;
            let (theta, q) = at(t);
            if k == 1000 {
                balance.scale(q - theta);
            }
            link.smooth(&filters, q);
            // The mean over a period is what a held torque of this value amounts to.
            balance.feed(&filters, theta, q - theta, torque(t + 0.5 * period), &link, 0.0);
            balance.observe(q - theta, true);
            if k > 2000 {
                let (row, size) = (balance.row(&link), balance.size.deflection);
                let sum = inertia * row[ACCELERATION]
                    + damping * row[VELOCITY]
                    + k1 * size * row[POWERS.start]
                    + k3 * size.powi(3) * row[POWERS.start + 1];
                left = left.max((row[TORQUE] - sum).abs());
                largest = largest.max(row[TORQUE].abs());
            }
        }
        assert!(left < 2e-4 * largest, "{left} of {largest}");
    }

    #[test]
    fn a_stop_remembers_which_way_it_came() {
        let filters = Filters::new(60.0, 1e-3);
        let mut balance = Balance::new();
        let mut link = Channel::rest(0.0);
        for k in 0..4000 {
            let q = 0.01 * (f64::from(k) * 3e-3).sin();
            link.smooth(&filters, q);
            balance.feed(&filters, 0.0, q, 0.0, &link, 0.0);
            balance.observe(q, true);
            if k == 3000 {
                balance.scale(q);
            }
        }
        let all = set(STOPS);
        assert!(balance.slopes(0.0, all).0[STOPS.start].abs() > 0.05);
        assert_eq!(balance.slopes(0.0, 0).0, [0.0; COLUMNS]);
    }
}
