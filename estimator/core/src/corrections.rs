//! Corrects a sample for the declared effects of its sensors.

use serde::{Deserialize, Serialize};

use crate::effects::{MotorEffects, link_sum};
use crate::error::Error;
use crate::library::{ABSURD, Coordinates, Element, Place};
use crate::sample::{MOTORS, Sample};

/// The torque that acts, where the reported one is apart from it by a first-order lag of signed time constant.
///
/// T₀ > 0: the reported torque is held from its sample to the next, the acting one follows it with T₀; what
/// acts in a period is its mean. T₀ < 0: the reported torque follows, so the acting one is ahead by its slope.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Lag {
    periods: f64, // T₀ / T
    behind: f64,  // the torque that lags
    reported: f64,
    started: bool,
}

impl Lag {
    fn new(periods: f64) -> Lag {
        Lag { periods, behind: 0.0, reported: 0.0, started: false }
    }

    fn acting(&mut self, reported: f64, after: f64) -> f64 {
        if self.periods == 0.0 || reported.abs() >= ABSURD || reported.is_nan() {
            return reported;
        }
        if !self.started {
            (self.behind, self.reported, self.started) = (reported, reported, true);
        }
        let before = std::mem::replace(&mut self.reported, reported);
        if self.periods < 0.0 {
            return reported - self.periods * (reported - before) / after;
        }
        self.behind = before + (self.behind - before) * (-after / self.periods).exp();
        reported + (self.behind - reported) * -(-1.0 / self.periods).exp_m1() * self.periods
    }
}

/// How many periods each channel waits.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct Waits {
    motor: f64,
    link: f64,
    torque: [f64; MOTORS],
}

/// A sample as perfect sensors would have given it.
#[derive(Clone, Copy, Debug)]
pub struct Corrected {
    /// All channels as of one moment, the latest that all are known of.
    pub aligned: Sample,
    /// Positions and external torque as of the latest moment that these are known of; the torque may be later.
    pub present: Sample,
}

const NOTHING: Sample = Sample {
    sequence: 0,
    motor_position: [f64::NAN; MOTORS],
    motor_velocity: [f64::NAN; MOTORS],
    motor_torque: [f64::NAN; MOTORS],
    link_position: f64::NAN,
    link_velocity: f64::NAN,
    external_torque: f64::NAN,
};

/// What makes a sample one of perfect sensors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Corrections {
    period: f64,
    active: bool,
    reading: Vec<Element>,
    drive: [Vec<Element>; MOTORS],
    offset: [f64; MOTORS],
    lag: [Lag; MOTORS],
    // The torque acts its delay later than reported, the link position is read late: with the largest of
    // these delays as common, motor positions wait that long, the rest what is left of it. In periods.
    delayed: bool,
    aligned: Waits,
    present: Waits,  // the positions wait for each other only
    deflection: f64, // by so much of its wait the deflection's sensor is late
    first: Option<u64>,
    last: u64,
    past: Vec<Sample>,
    newest: usize,
    known: usize,
}

impl Corrections {
    /// Of a joint's motors and of its link.
    ///
    /// # Errors
    /// An effect of the link belongs to a motor.
    pub fn new(motors: &[MotorEffects], link: &[Element], period_s: f64) -> Result<Corrections, Error> {
        link_sum(link)?;
        let at = |place: Place| link.iter().filter(move |element| element.kind.place == place);
        let reading: Vec<Element> = at(Place::LinkReading).copied().collect();
        let sum = |place: Place| at(place).map(|element| element.values[0]).sum::<f64>();
        let deflection_delay = sum(Place::DeflectionDelay);
        let encoder_delay = sum(Place::LinkDelay) + deflection_delay;
        let (mut drive, mut offset, mut delays): ([Vec<Element>; MOTORS], _, _) =
            (Default::default(), [0.0; MOTORS], [0.0; MOTORS]);
        let mut lag = [Lag::new(0.0); MOTORS];
        for (i, motor) in motors.iter().enumerate() {
            drive[i].clone_from(&motor.drive);
            offset[i] = motor.offset;
            delays[i] = motor.delay;
            lag[i] = Lag::new(motor.lag / period_s);
        }
        let common = delays.iter().fold(encoder_delay.max(0.0), |latest, delay| latest.max(-delay));
        let waits = |common: f64| Waits {
            motor: common / period_s,
            link: (common - encoder_delay) / period_s,
            torque: delays.map(|delay| (common + delay).max(0.0) / period_s),
        };
        let (aligned, present) = (waits(common), waits(encoder_delay.max(0.0)));
        let longest = aligned.torque.iter().fold(aligned.motor.max(aligned.link), |a, b| a.max(*b));
        let delayed = encoder_delay != 0.0 || delays.iter().any(|delay| *delay != 0.0);
        Ok(Corrections {
            period: period_s,
            active: delayed
                || !reading.is_empty()
                || motors.iter().any(|m| !m.drive.is_empty() || m.offset != 0.0 || m.lag != 0.0),
            reading,
            drive,
            offset,
            lag,
            delayed,
            aligned,
            present,
            deflection: deflection_delay / period_s,
            first: None,
            last: 0,
            past: vec![NOTHING; longest as usize + 2],
            newest: 0,
            known: 0,
        })
    }

    /// Whether they change anything.
    #[must_use]
    pub fn active(&self) -> bool {
        self.active
    }

    /// Forget delayed samples and the time since the start.
    pub fn reset(&mut self) {
        self.first = None;
        self.known = 0;
        self.lag = self.lag.map(|lag| Lag::new(lag.periods));
    }

    /// By how much the aligned channels are older than the present ones, s.
    #[must_use]
    pub fn behind_s(&self) -> f64 {
        (self.aligned.motor - self.present.motor) * self.period
    }

    /// How old the present positions are, s: they wait for a link that is read late.
    #[must_use]
    pub fn age_s(&self) -> f64 {
        self.present.motor * self.period
    }

    /// The sample as perfect sensors would have given it; `None` until every channel has the past it waits for.
    ///
    /// `restart`: this sample does not go on from the one before.
    pub fn correct(&mut self, sample: &Sample, restart: bool) -> Option<Corrected> {
        if !self.active {
            return Some(Corrected { aligned: *sample, present: *sample });
        }
        if self.first.is_none() {
            self.last = sample.sequence;
        }
        let first = *self.first.get_or_insert(sample.sequence);
        let after = (sample.sequence.wrapping_sub(self.last) as f64).max(1.0);
        self.last = sample.sequence;
        let mut out = Corrected { aligned: *sample, present: *sample };
        if self.delayed {
            if restart {
                self.known = 0;
            }
            self.remember(sample);
            out.aligned = self.delay(sample.sequence, &self.aligned)?;
            out.present = self.delay(sample.sequence, &self.present)?;
        }
        let time = sample.sequence.wrapping_sub(first) as f64 * self.period;
        for (i, elements) in self.drive.iter().enumerate() {
            let torque = out.aligned.motor_torque[i];
            if torque.abs() < ABSURD {
                let c = Coordinates { torque, time, ..Coordinates::default() };
                let acting = torque - elements.iter().map(|e| e.torque(&c)).sum::<f64>();
                out.aligned.motor_torque[i] = self.lag[i].acting(acting, after);
            }
        }
        for one in [&mut out.aligned, &mut out.present] {
            let read = one.link_position;
            if !self.reading.is_empty() && read.abs() < ABSURD {
                one.link_position = read - self.error(read - self.error(read));
            }
            (0..MOTORS).for_each(|i| one.motor_position[i] += self.offset[i]);
        }
        Some(out)
    }

    fn error(&self, link_position: f64) -> f64 {
        let c = Coordinates { link_position, ..Coordinates::default() };
        self.reading.iter().map(|element| element.torque(&c)).sum()
    }

    fn remember(&mut self, sample: &Sample) {
        self.newest = (self.newest + 1) % self.past.len();
        self.past[self.newest] = *sample;
        self.known = (self.known + 1).min(self.past.len());
    }

    /// Each channel as it was before it waited; `None` where that is not known yet.
    fn delay(&self, now: u64, waits: &Waits) -> Option<Sample> {
        let mut out = self.past[self.newest];
        let mix = |old: f64, new: f64, share: f64| if share == 0.0 { old } else { old + share * (new - old) };
        let (a, b, share) = self.at(now, waits.motor)?;
        for i in 0..MOTORS {
            out.motor_position[i] = mix(a.motor_position[i], b.motor_position[i], share);
            out.motor_velocity[i] = mix(a.motor_velocity[i], b.motor_velocity[i], share);
        }
        out.external_torque = mix(a.external_torque, b.external_torque, share);
        for i in 0..MOTORS {
            let (a, b, share) = self.at(now, waits.torque[i])?;
            out.motor_torque[i] = mix(a.motor_torque[i], b.motor_torque[i], share);
        }
        let (a, b, share) = self.at(now, waits.link)?;
        out.link_position = mix(a.link_position, b.link_position, share);
        out.link_velocity = mix(a.link_velocity, b.link_velocity, share);
        if self.deflection != 0.0 {
            // Read was the deflection of then beside the motor's position of a delay later.
            let (a, b, share) = self.at(now, (waits.motor - self.deflection).max(0.0))?;
            out.link_position += out.motor_position[0] - mix(a.motor_position[0], b.motor_position[0], share);
            out.link_velocity += out.motor_velocity[0] - mix(a.motor_velocity[0], b.motor_velocity[0], share);
        }
        Some(out)
    }

    /// The samples around a time so many periods ago, and the share of the newer one.
    fn at(&self, now: u64, periods: f64) -> Option<(&Sample, &Sample, f64)> {
        let mut newer = &self.past[self.newest];
        for k in 0..self.known {
            let older = &self.past[(self.newest + self.past.len() - k) % self.past.len()];
            let age = now.wrapping_sub(older.sequence) as f64;
            if age >= periods {
                let span = newer.sequence.wrapping_sub(older.sequence) as f64;
                let share = if span > 0.0 { (age - periods) / span } else { 0.0 };
                return Some((older, newer, share));
            }
            newer = older;
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_torque_that_lags_a_ramp_is_late_by_its_time_constant() {
        for after in [1.0, 3.0] {
            let (mut acting, mut reported) = (Lag::new(7.0), Lag::new(-7.0));
            let (mut late, mut early) = (0.0, 0.0);
            for k in 0..400 {
                let torque = f64::from(k) * after;
                (late, early) = (acting.acting(torque, after), reported.acting(torque, after));
            }
            let torque = 399.0 * after;
            // The reported ramp is a stair held for `after` periods: the mean over the first of them.
            let share = (-1f64 / 7.0).exp_m1() / (-after / 7.0).exp_m1();
            assert!((late - (torque - 7.0 * after * share)).abs() < 1e-6);
            assert!((early - (torque + 7.0)).abs() < 1e-6);
        }
    }

    const NOTHING: f64 = f64::NAN;

    fn element(name: &str, values: &[f64]) -> Element {
        Element::new(name, values).unwrap()
    }

    fn corrections(motor: &[Element], link: &[Element]) -> Corrections {
        Corrections::new(&[MotorEffects::new(motor).unwrap()], link, 1e-3).unwrap()
    }

    fn sample(sequence: u64, position: f64, torque: f64, link_position: f64) -> Sample {
        Sample {
            sequence,
            motor_position: [position, NOTHING],
            motor_velocity: [NOTHING; MOTORS],
            motor_torque: [torque, NOTHING],
            link_position,
            link_velocity: NOTHING,
            external_torque: NOTHING,
        }
    }

    fn near(found: &Sample, position: f64, torque: f64, link_position: f64, tolerance: f64) {
        let found = [found.motor_position[0], found.motor_torque[0], found.link_position];
        for (found, expected) in found.into_iter().zip([position, torque, link_position]) {
            assert!((found - expected).abs() < tolerance, "{found} is not {expected}");
        }
    }

    #[test]
    fn what_the_sensors_did_is_undone() {
        let motor = [element("deflection_offset", &[0.05]), element("torque_constant", &[0.1])];
        let link = [element("encoder_scale", &[0.02]), element("encoder_eccentricity", &[0.01, 0.0])];
        let q: f64 = 0.8;
        let read = 1.02 * q + 0.01 * q.sin();
        let corrected = corrections(&motor, &link).correct(&sample(0, 0.5, 2.0, read), false).unwrap();
        // Two steps of a fixed point that contracts by 3 %: off by 3e-2 cubed of the error.
        near(&corrected.aligned, 0.55, 2.2, q, 2e-5);
    }

    #[test]
    fn delays_bring_all_channels_to_the_latest_one() {
        let mut late =
            corrections(&[element("torque_delay", &[0.001])], &[element("encoder_delay", &[0.0025])]);
        let at = |k: u64| sample(k, k as f64, k as f64, k as f64);
        let out: Vec<_> = (0..12).map(|k| late.correct(&at(k), false)).collect();
        // The torque waits 3.5 periods: before, nobody knows what it was.
        assert!(out[..4].iter().all(Option::is_none) && out[4..].iter().all(Option::is_some));
        near(&out[11].unwrap().aligned, 11.0 - 2.5, 11.0 - 3.5, 11.0, 1e-9);
        near(&late.correct(&at(15), false).unwrap().aligned, 12.5, 11.5, 15.0, 1e-9);
    }

    #[test]
    fn a_late_deflection_is_read_beside_the_present_motor() {
        let mut late = corrections(&[], &[element("deflection_delay", &[0.03])]);
        let phi = |k: f64| 0.01 * k;
        let mut out = None;
        for k in 0..100 {
            let (now, then) = (f64::from(k), (f64::from(k) - 30.0).max(0.0));
            out = late.correct(&sample(k as u64, now, now, now + phi(then)), false);
        }
        near(&out.unwrap().aligned, 69.0, 69.0, 69.0 + phi(69.0), 1e-9);
    }

    #[test]
    fn a_torque_that_acts_with_a_lag_is_the_mean_of_what_acts_in_each_period() {
        let mut lag = corrections(&[element("torque_lag", &[0.006])], &[]);
        for k in 0..40 {
            let corrected = lag.correct(&sample(k, 0.0, f64::from(u8::from(k >= 1)), 0.0), false).unwrap();
            // The mean of 1 - exp(-t/T) from (k - 1) to k milliseconds after the step.
            let t = |k: f64| (-k / 6.0).exp();
            let mean = if k == 0 { 0.0 } else { 1.0 - (t(k as f64 - 1.0) - t(k as f64)) * 6.0 };
            near(&corrected.aligned, 0.0, mean, 0.0, 1e-12);
        }
    }

    #[test]
    fn absurd_values_pass_as_they_are() {
        let motor = [element("torque_constant", &[0.1]), element("torque_lag", &[0.006])];
        let mut all = corrections(&motor, &[element("encoder_scale", &[0.02])]);
        for absurd in [f64::INFINITY, -1e300, 1e12] {
            let out = all.correct(&sample(1, absurd, absurd, absurd), false).unwrap().aligned;
            assert!(out.motor_torque[0] == absurd && out.link_position == absurd);
        }
    }
}
