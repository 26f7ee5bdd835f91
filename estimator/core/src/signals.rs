//! The filtered signals of one motor's balance, and the excitation of their motion.

use serde::{Deserialize, Serialize};

use crate::choices::{CLEAR, LIGHT, MEAN_S, PEAK_S, SLOW};
use crate::filters::StateVariableFilter;

/// The two filters that every channel passes, F G.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
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
        let light = StateVariableFilter::<3>::new(LIGHT * main.bandwidth, period_s);
        Filters { light, main, delay: 3.0 / light.bandwidth + 4.0 / main.bandwidth }
    }

    /// Σh² of a signal and its derivatives behind both filters: the variances of white noise of variance one.
    #[must_use]
    pub fn noise_gains(&self, period_s: f64) -> [f64; 3] {
        let (mut channel, mut squares) = (Channel::rest(0.0), [0.0; 3]);
        for k in 0..(12.0 * self.delay / period_s).ceil() as usize {
            channel.smooth(self, if k == 0 { 1.0 } else { 0.0 });
            squares.iter_mut().zip(channel.main).for_each(|(square, h)| *square += h * h);
        }
        squares
    }

    /// |F| at a frequency, rad/s.
    #[must_use]
    pub fn gain(&self, frequency: f64) -> f64 {
        (1.0 + (frequency / self.main.bandwidth).powi(2)).powi(-2)
    }

    /// Rows that the filters make of one independent error: the length of their impulse response over a period.
    #[must_use]
    pub fn correlated_rows(&self, period_s: f64) -> f64 {
        // White noise through w⁴/(s + w)⁴ has the correlation time 2 ∫ρ dt = 32/(5 w).
        (6.4 / (self.main.bandwidth * period_s)).max(1.0)
    }
}

/// A measured signal: its values behind G and behind F G, with their derivatives.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Channel {
    /// G of the signal and its derivatives.
    pub light: [f64; 3],
    /// F G of the signal and its derivatives.
    pub main: [f64; 4],
    last: f64,
    before: f64, // the last
}

impl Channel {
    /// As if this input had been there forever.
    #[must_use]
    pub fn rest(value: f64) -> Channel {
        Channel { light: [value, 0.0, 0.0], main: [value, 0.0, 0.0, 0.0], last: value, before: value }
    }

    /// One period of a signal that is straight between samples.
    #[inline]
    pub fn smooth(&mut self, filters: &Filters, now: f64) {
        let before = self.light[0];
        filters.light.smooth.apply(&mut self.light, self.last, now);
        filters.main.smooth.apply(&mut self.main, before, self.light[0]);
        self.last = now;
    }

    /// One period of a signal that is held between samples, with what straight lines take off all others, 1 − (ωT)²/12
    /// of a motion at ω, by Numerov's weights.
    #[inline]
    pub fn held(&mut self, filters: &Filters, now: f64) {
        let (before, mean) = (self.light[0], (self.before + 10.0 * self.last + now) / 12.0);
        filters.light.held.apply(&mut self.light, mean, now);
        filters.main.smooth.apply(&mut self.main, before, self.light[0]);
        (self.before, self.last) = (self.last, now);
    }
}

/// A signal that is formed from lightly filtered ones, and passes F alone.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Excitation {
    noise: f64,
    square: f64,
    peak: f64,
    before: [f64; 2], // rms and noise at the last update
}

impl Excitation {
    /// Whether a filtered rate of φ is above the noise that it has, over the last moments.
    ///
    /// `usual`: whether the balance was explained at the last update; what was read otherwise is no measure.
    pub fn update(&mut self, rate: f64, noise: f64, usable: bool, usual: bool, dt: f64) -> bool {
        if !usable {
            self.square = 0.0;
            return false;
        }
        let fade = (-dt / PEAK_S).exp();
        let [rms_before, noise_before] = std::mem::take(&mut self.before);
        if usual {
            self.peak = (fade * self.peak).max(rms_before);
            self.noise = (fade * self.noise).max(noise_before);
        } else {
            self.square = self.square.min(self.peak * self.peak);
        }
        self.square += (dt / MEAN_S).min(1.0) * (rate * rate - self.square);
        let rms = self.square.sqrt();
        self.before = [rms, noise];
        rms > CLEAR * self.noise.max(noise) && rms > SLOW * self.peak && rms > 0.0
    }
}

/// Signals side by side through one filter; what they were at the last sample.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Lanes<const N: usize, const L: usize> {
    #[serde(with = "crate::snapshot::rows")]
    /// Of the filter, signal by signal within each of its orders.
    pub state: [[f64; L]; N],
    #[serde(with = "crate::snapshot::array")]
    /// What went in at last.
    pub last: [f64; L],
}

impl<const N: usize, const L: usize> Default for Lanes<N, L> {
    fn default() -> Lanes<N, L> {
        Lanes::rest([0.0; L])
    }
}

impl<const N: usize, const L: usize> Lanes<N, L> {
    /// As if they had had these values for ever.
    #[must_use]
    pub fn rest(values: [f64; L]) -> Lanes<N, L> {
        let mut state = [[0.0; L]; N];
        state[0] = values;
        Lanes { state, last: values }
    }

    /// One period.
    pub fn smooth(&mut self, filter: &StateVariableFilter<N>, now: [f64; L]) {
        filter.smooth.apply_lanes(&mut self.state, &self.last, &now);
        self.last = now;
    }

    /// Each signal times a factor.
    pub fn scale(&mut self, factors: &[f64; L]) {
        for values in self.state.iter_mut().chain([&mut self.last]) {
            values.iter_mut().zip(factors).for_each(|(value, factor)| *value *= factor);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T: f64 = 1e-3;

    #[test]
    fn a_ramp_is_late_by_the_filters_delay_and_keeps_its_slope() {
        let filters = Filters::new(60.0, T);
        let (mut channel, mut formed) = (Channel::rest(0.0), Formed::default());
        let slope = 2.0;
        for k in 1..4000 {
            channel.smooth(&filters, slope * T * f64::from(k));
            formed.pass(&filters, slope * T * f64::from(k));
        }
        let now = slope * T * 3999.0;
        assert!((now - channel.light[0] - slope * 3.0 / filters.light.bandwidth).abs() < 1e-9);
        assert!((now - channel.main[0] - slope * filters.delay).abs() < 1e-9);
        assert!((now - formed.main[0] - slope * 4.0 / filters.main.bandwidth).abs() < 1e-9);
        assert!((channel.main[1] - slope).abs() < 1e-9 && channel.main[2].abs() < 1e-6);
    }

    #[test]
    fn a_torque_that_is_held_acts_from_its_sample_on_and_one_at_rest_stays() {
        let filters = Filters::new(60.0, T);
        let (mut held, mut rest) = (Channel::rest(0.0), Channel::rest(3.0));
        held.held(&filters, 1.0);
        assert!(held.main[0] < 1e-9); // it acts from now on
        for _ in 0..2000 {
            held.held(&filters, 1.0);
            rest.smooth(&filters, 3.0);
        }
        assert!((held.main[0] - 1.0).abs() < 1e-9 && (rest.main[0] - 3.0).abs() < 1e-9);
    }

    #[test]
    fn a_mass_that_a_held_torque_moves_accelerates_by_it() {
        let (period, w) = (4e-3, 15.0);
        let filters = Filters::new(60.0, period);
        let (mut position, mut torque) = (Channel::rest(0.0), Channel::rest(0.0));
        let (mut theta, mut rate, mut worst) = (0.0, 0.0, 0.0_f64);
        for k in 0..2000 {
            let now = (w * period * f64::from(k)).sin();
            position.smooth(&filters, theta);
            torque.held(&filters, now);
            theta += period * (rate + 0.5 * period * now);
            rate += period * now;
            if k > 200 {
                worst = worst.max((position.main[2] - torque.main[0]).abs());
            }
        }
        assert!(worst < 1e-4, "{worst} of 1 is lost"); // straight lines take (w T)²/12 off positions: 3e-4
    }

    #[test]
    fn the_gain_of_white_noise_is_that_of_the_impulse_response() {
        let filters = Filters::new(60.0, T);
        let gains = filters.noise_gains(T);
        // F alone, (w/(s + w))^4: 5 w/32 times the period; G before it takes a little.
        let main = 5.0 / 32.0 * 60.0 * T;
        assert!(gains[0] < main && gains[0] > 0.9 * main, "{} is not below {main}", gains[0]);
    }

    #[test]
    fn motion_is_what_is_above_its_noise() {
        let swing = |noise: f64, usable: bool| {
            let mut excitation = Excitation::default();
            (0..2000).fold(false, |_, k| {
                let rate = (10.0 * T * f64::from(k)).sin();
                excitation.update(rate, noise, usable, true, T)
            })
        };
        assert!(swing(0.01, true));
        assert!(!swing(0.5, true));
        assert!(!swing(0.01, false));
    }
}
