//! Eq 5 of one motor as a row of filtered columns, the only place where it is formed.
//!
//! F τ = B F θ″ + D F θ′ + offset + friction − F f(φ) − …: every column passes the same filters, so their lag
//! cancels. The spring is a curve over [`crate::spring`]'s functions of u = φ over the deflection's size.

mod columns;

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

pub use columns::*;

use crate::choices::{FAR, GROWN, SLOW};
use crate::effects::Declared;
use crate::gram::{COLUMNS, Gram, Row};
use crate::signals::{Channel, Filters, Formed, Lanes};
use crate::spring::{FIRST, Family, TERMS};

const STOP_WIDTHS: [f64; 3] = [0.05, 0.15, 0.45]; // of half the range of u: a memory of one width lies between two, and a wider stop is a spring
const CLIP_WIDTHS: [f64; 4] = [0.05, 0.15, 0.35, 0.65]; // likewise
const CURVE: usize = 2 * TERMS + CLIP_WIDTHS.len() + 2; // columns that are functions of the raw φ
// Columns of lightly filtered signals: dry, soft, load ×2, late, read, stops, sine, cosine, q′.
const OF_LATE: usize = 4;
const OF_READ: usize = OF_LATE + TERMS;
const OF_STOPS: usize = OF_READ + FIRST;
const OF_SINE: usize = OF_STOPS + STOP_WIDTHS.len();
const OF_COSINE: usize = OF_SINE + FIRST;
const FORMED: usize = OF_COSINE + FIRST + 1;

/// What the columns are scaled by, taken from the motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Size {
    /// |φ| of u = 1, rad: the spring's.
    pub deflection: f64,
    /// Half the range of φ, rad: that of memory and the free curve.
    pub range: f64,
    /// Largest |θ′|, rad/s: that of friction.
    pub speed: f64,
}

/// The filtered columns of one motor.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Balance {
    /// What the columns are scaled by; zero before there was motion.
    pub size: Size,
    /// The functions that the spring's curve is a sum of.
    pub family: Family,
    position: Channel,
    torque: Channel,
    light: Lanes<3, CURVE>,
    curve: Lanes<4, CURVE>,
    formed: Lanes<4, FORMED>,
    effects: Formed,
    elastic: Channel,      // declared elastic effects, filtered as the spring's columns
    resting: [Formed; 2], // share in which dry friction may be anything, and what that is of the declared one
    standing: [Formed; 2], // share in which the rounding of θ and q does not change
    waves: [f64; 2],      // sin q and cos q
    stops: [f64; 3],
    last: f64, // φ that the stops have followed
    low: f64,
    high: f64,
    speed: f64,
}

impl Balance {
    /// At rest.
    #[must_use]
    pub fn new(family: Family) -> Balance {
        Balance { family, low: f64::INFINITY, high: f64::NEG_INFINITY, ..Balance::default() }
    }

    /// Forget everything.
    pub fn reset(&mut self) {
        *self = Balance::new(self.family.clone());
    }

    /// Forget how large the motion is.
    pub fn forget_range(&mut self) {
        (self.low, self.high) = (f64::INFINITY, f64::NEG_INFINITY);
    }

    /// As if the joint had been here forever.
    pub fn restart(&mut self, theta: f64, phi: f64, torque: f64) {
        (self.position, self.torque) = (Channel::rest(theta), Channel::rest(torque));
        (self.formed, self.effects, self.elastic) = Default::default();
        (self.resting, self.standing) = Default::default();
        self.rest_curve(phi);
    }

    fn rest_curve(&mut self, phi: f64) {
        let columns = self.curve_columns(phi);
        (self.light, self.curve) = (Lanes::rest(columns), Lanes::rest(columns));
        self.stops = [0.0; 3];
        self.last = phi;
    }

    fn unit(&self, phi: f64) -> f64 {
        if self.size.deflection > 0.0 { phi / self.size.deflection } else { 0.0 }
    }

    fn curve_columns(&self, phi: f64) -> [f64; CURVE] {
        let mut out = [0.0; CURVE];
        if self.size.deflection == 0.0 {
            return out;
        }
        let terms = self.family.at(self.unit(phi), self.size.deflection);
        out[..2 * TERMS].iter_mut().zip(terms).for_each(|(value, term)| *value = -term);
        for (value, width) in out[2 * TERMS..].iter_mut().zip(CLIP_WIDTHS) {
            let width = width * self.size.range;
            *value = if width > 0.0 { -phi.clamp(-width, width) / self.size.range } else { 0.0 };
        }
        let u = self.unit(phi);
        (out[CURVE - 2], out[CURVE - 1]) = (-u.abs(), -u * u.abs());
        out
    }

    /// How large the motion has been; `usable`: whether this moment counts.
    pub fn observe(&mut self, phi: f64, usable: bool) {
        if usable {
            self.low = self.low.min(phi);
            self.high = self.high.max(phi);
            self.speed = self.speed.max(self.position.light[1].abs());
        }
    }

    /// The least and the largest φ seen, rad.
    #[must_use]
    pub fn seen(&self) -> [f64; 2] {
        [self.low, self.high]
    }

    /// Largest |φ| seen, rad.
    #[must_use]
    pub fn largest(&self) -> f64 {
        if self.high < self.low { 0.0 } else { self.low.abs().max(self.high.abs()) }
    }

    /// Whether a deflection has outgrown what the spring's columns are scaled by.
    #[must_use]
    pub fn outgrown(&self, phi: f64) -> bool {
        phi.abs() > GROWN * self.size.deflection
    }

    /// Scale memory, friction and the free curve by the motion seen so far; the free curve begins anew.
    pub fn fit_widths(&mut self, phi: f64) {
        let range = 0.5 * (self.high - self.low);
        let grown = range > GROWN * self.size.range || self.speed > GROWN * self.size.speed;
        if !grown || range <= 0.0 {
            return;
        }
        (self.size.range, self.size.speed) = (range, self.speed);
        let columns = self.curve_columns(phi);
        for lane in 2 * TERMS..CURVE - 2 {
            for state in self.light.state.iter_mut().chain(&mut self.curve.state) {
                state[lane] = 0.0;
            }
            self.light.state[0][lane] = columns[lane];
            self.curve.state[0][lane] = columns[lane];
            (self.light.last[lane], self.curve.last[lane]) = (columns[lane], columns[lane]);
        }
    }

    /// Scale the spring's columns by this deflection; what is in the filters is scaled with them.
    ///
    /// Returns the factors of a row's columns.
    pub fn grow(&mut self, phi: f64) -> Row {
        let before = self.size.deflection;
        self.size.deflection = phi.abs();
        let mut factors = [1.0; COLUMNS];
        if before == 0.0 {
            self.rest_curve(phi);
            return factors;
        }
        let terms = self.family.factors(before, self.size.deflection);
        factors[SPRING.start..SPRING.start + 2 * TERMS].copy_from_slice(&terms);
        for columns in [LATE, READ, SINE, COSINE] {
            factors[columns.clone()].copy_from_slice(&terms[TERMS..TERMS + columns.len()]);
        }
        LOAD.iter().zip(&terms).for_each(|(column, factor)| factors[*column] = *factor);
        let mut curve = [1.0; CURVE];
        curve[..2 * TERMS].copy_from_slice(&terms);
        let ratio = before / self.size.deflection;
        (factors[UNEVEN], curve[CURVE - 2]) = (ratio, ratio);
        (factors[CORNER], curve[CURVE - 1]) = (ratio * ratio, ratio * ratio);
        self.light.scale(&curve);
        self.curve.scale(&curve);
        let mut formed = [1.0; FORMED];
        formed[2..OF_LATE].copy_from_slice(&terms[..2]);
        formed[OF_LATE..OF_READ].copy_from_slice(&terms[TERMS..]);
        for from in [OF_READ, OF_SINE, OF_COSINE] {
            formed[from..from + FIRST].copy_from_slice(&terms[TERMS..TERMS + FIRST]);
        }
        self.formed.scale(&formed);
        factors
    }

    /// One period of what is read.
    pub fn read(&mut self, filters: &Filters, theta: f64, torque: f64) {
        self.position.smooth(filters, theta);
        self.torque.held(filters, torque);
    }

    /// The same period of what is formed of it.
    pub fn feed(&mut self, filters: &Filters, phi: f64, link: &Channel, declared: &Declared) {
        self.effects.pass(filters, declared.formed);
        self.elastic.smooth(filters, declared.elastic);
        if self.size.deflection == 0.0 {
            return;
        }
        let before = self.light.state[0];
        self.light.smooth(&filters.light, self.curve_columns(phi));
        self.curve.last = before;
        self.curve.smooth(&filters.main, self.light.state[0]);
        let rate = self.position.light[1];
        let phi = link.light[0] - self.position.light[0];
        let u = self.unit(phi);
        let slopes = self.family.at(u, self.size.deflection);
        let [first, second] = [slopes[TERMS], slopes[TERMS + 1]];
        let speed = (SLOW * self.size.speed).max(f64::MIN_POSITIVE);
        let sign = (rate / speed).tanh();
        let resting = 1.0 - sign * sign;
        self.resting[0].pass(filters, resting);
        self.resting[1].pass(filters, (resting * declared.at_rest).max(declared.changing));
        let step = (phi - self.last) / self.size.range.max(f64::MIN_POSITIVE);
        self.last = phi;
        for (stop, width) in self.stops.iter_mut().zip(STOP_WIDTHS) {
            *stop = (*stop + step).clamp(-width, width);
        }
        let [a, b, c] = self.stops;
        let [q, q_rate] = [link.light[0], link.light[1]];
        let soft = (rate / (FAR * speed)).tanh();
        let load = [slopes[0].abs() * sign, slopes[1].abs() * sign];
        let (sine, cosine) = q.sin_cos();
        self.waves = [sine, cosine];
        let mut now = [0.0; FORMED];
        now[..OF_LATE].copy_from_slice(&[sign, soft, load[0], load[1]]);
        now[OF_LATE..].iter_mut().zip(&slopes[TERMS..]).for_each(|(late, slope)| *late = -slope * q_rate);
        for (from, signal) in [(OF_READ, q), (OF_SINE, sine), (OF_COSINE, cosine)] {
            (now[from], now[from + 1]) = (-first * signal, -second * signal);
        }
        now[OF_STOPS..OF_SINE].copy_from_slice(&[-a, -b, -c]);
        now[FORMED - 1] = -q_rate;
        self.formed.smooth(&filters.main, now);
    }

    /// The same period of what rounding does. A reading that goes through its counts evenly is wrong by a wave, one a count.
    pub fn feed_rounding(&mut self, filters: &Filters, link_rate: f64, noise: [f64; 2]) {
        let rates = [self.position.light[1], link_rate];
        for ((standing, rate), noise) in self.standing.iter_mut().zip(rates).zip(noise) {
            let wave = TAU * rate / (12.0 * noise).sqrt().max(f64::MIN_POSITIVE);
            standing.pass(filters, filters.gain(wave));
        }
    }

    /// Variance of the filtered φ that rounding makes beyond what white noise does, rad²; `noise`: of θ and q; `white`: what the
    /// filters leave of that.
    #[must_use]
    pub fn rounding(&self, noise: [f64; 2], white: f64) -> f64 {
        let more = |(standing, noise): (&Formed, f64)| noise * (standing.main[0].powi(2) - white).max(0.0);
        self.standing.iter().zip(noise).map(more).sum()
    }

    /// The row of this moment.
    #[must_use]
    pub fn row(&self) -> Row {
        let mut row: Row = [0.0; COLUMNS];
        let [torque, rate, second, _] = self.torque.main;
        (row[TORQUE], row[TORQUE_RATE], row[TORQUE_SECOND]) = (torque - self.declared()[0], rate, second);
        row[ACCELERATION] = self.position.main[2];
        row[VELOCITY] = self.position.main[1];
        row[OFFSET] = 1.0;
        let curve = &self.curve.state[0];
        row[SPRING.start..SPRING.start + 2 * TERMS].copy_from_slice(&curve[..2 * TERMS]);
        row[CLIPS].copy_from_slice(&curve[2 * TERMS..CURVE - 2]);
        (row[UNEVEN], row[CORNER]) = (curve[CURVE - 2], curve[CURVE - 1]);
        row[DRY_RATE] = self.formed.state[1][0];
        let formed = &self.formed.state[0];
        let places = [DRY, SOFT, LOAD[0], LOAD[1]];
        let ranges = LATE.chain(READ).chain(STOPS).chain(SINE).chain(COSINE).chain([LINK_RATE]);
        for (column, value) in places.into_iter().chain(ranges).zip(formed) {
            row[column] = *value;
        }
        row
    }

    /// The share of a row, 0 to 1, in which the motor stood, and the declared dry friction in it, N·m: there it is anything
    /// up to what it is in motion.
    #[must_use]
    pub fn resting(&self) -> [f64; 2] {
        self.resting.map(|one| one.main[0])
    }

    /// What the columns of memory and of a free curve are at a deflection: (torque, stiffness) by column.
    #[must_use]
    pub fn extras(&self, phi: f64) -> (Row, Row) {
        let (mut torque, mut stiffness) = ([0.0; COLUMNS], [0.0; COLUMNS]);
        let range = self.size.range;
        if range > 0.0 {
            for (column, width) in CLIPS.zip(CLIP_WIDTHS) {
                let width = width * range;
                torque[column] = phi.clamp(-width, width) / range;
                stiffness[column] = if phi.abs() < width { range.recip() } else { 0.0 };
            }
            for (column, stop) in STOPS.zip(self.stops) {
                torque[column] = stop;
            }
        }
        (torque, stiffness)
    }

    /// Variance of σ inside a piece of the free curve, (N·m/rad)²; `clips`: its columns' amplitudes, `stiffness`: σ there.
    ///
    /// A curve of which only the mean slope of a piece is known, and that lies between its neighbours' slopes m and M,
    /// varies by (M − s)(s − m) at most (Bhatia and Davis, "A better bound on the variance", American Mathematical
    /// Monthly 107(4), 2000); a gap's edge does. In the middle no slope is below 0.
    #[must_use]
    pub fn within_piece(&self, phi: f64, clips: &[f64], stiffness: f64) -> f64 {
        let range = self.size.range;
        let Some(k) = CLIP_WIDTHS.iter().position(|width| phi.abs() < width * range) else { return 0.0 };
        let outwards = -clips[k] / range;
        let inwards = if k == 0 { -stiffness.max(0.0) } else { clips[k - 1] / range };
        (-outwards * inwards).max(0.0)
    }

    /// sin q and cos q.
    #[must_use]
    pub fn waves(&self) -> [f64; 2] {
        self.waves
    }

    /// Filtered θ′, rad/s.
    #[must_use]
    pub fn rate(&self) -> f64 {
        self.position.main[1]
    }

    /// Filtered τ and its derivatives.
    #[must_use]
    pub fn torque(&self) -> &[f64; 4] {
        &self.torque.main
    }

    /// Filtered θ and the filtered declared effects, with their derivatives.
    #[must_use]
    pub fn filtered(&self) -> (&[f64; 4], [f64; 4]) {
        (&self.position.main, self.declared())
    }

    fn declared(&self) -> [f64; 4] {
        std::array::from_fn(|k| self.effects.main[k] - self.elastic.main[k])
    }

    /// Lightly filtered θ and its derivatives.
    #[must_use]
    pub fn light(&self) -> &[f64; 3] {
        &self.position.light
    }

    /// Lightly filtered τ and its derivatives.
    #[must_use]
    pub fn light_torque(&self) -> &[f64; 3] {
        &self.torque.light
    }
}

/// Variance of a column's fluctuation around its mean.
#[must_use]
pub fn variance(gram: &Gram, column: usize) -> f64 {
    let mean = gram.at(column, OFFSET) / gram.rows;
    (gram.rms(column).powi(2) - mean * mean).max(0.0)
}

#[cfg(test)]
mod tests;
