//! What is said of the joint at a sample.

use super::Robust;
use crate::choices::BRIEF_S;
use crate::deflection::Present;
use crate::reasons::{Reason, Why};
use crate::sample::{Estimate, MOTORS, TransmissionEstimate, joint_estimate, status};
use crate::side::Side;
use crate::suspicion;

impl Robust {
    pub(super) fn conclude(&mut self, sequence: u64, flags: u32) -> Estimate {
        let mut flags = flags;
        let settled = self.live.unsettled <= 0;
        let parts = self.parts(0.0);
        self.sides.iter_mut().for_each(Side::predict);
        for ((balance, part), torque) in self.rigid.iter_mut().zip(&parts).zip(self.live.last.torque) {
            balance.add(part.flexibility_torque, torque, self.period);
        }
        let reasons = self.reasons(&parts, settled);
        let repeats = self.live.refused.is_some_and(|(what, _)| what.reason == suspicion::Reason::Frozen);
        let rejected =
            (repeats || flags & status::INPUT_REJECTED != 0).then(|| Why::new(Reason::Rejected, None));
        flags |= self.usable(reasons.map(|reason| rejected.or(reason)));
        if self.sides.iter().any(Side::has_changed) {
            flags |= status::CHANGED;
        }
        let excited = |side: &Side| side.rigid || side.excited;
        if flags & status::STIFFNESS_VALID != 0 && settled && self.sides.iter().all(excited) {
            flags |= status::OBSERVABLE;
        }
        if self.live.said > 0 {
            self.live.said -= 1;
            flags |= status::RESTARTED;
        }
        if self.momentum.is_some() {
            let valid = flags & status::VALID != 0;
            let carried = self.carried(&self.live.last.present).unwrap_or_default();
            let noise = self.noise_of(0)[1];
            self.live.external =
                self.momentum.as_mut().map(|momentum| momentum.conclude(sequence, &carried, noise, valid));
        }
        let estimate = joint_estimate(self.arrangement, sequence, flags, parts, self.motors);
        self.live.estimate = Some(estimate);
        estimate
    }

    /// What is said where the sample cannot be used: the last estimate, for a while.
    pub(super) fn hold(&mut self, sequence: u64, flags: u32) -> Estimate {
        self.live.external = self.momentum.as_ref().map(|momentum| momentum.latest.repeat(sequence));
        let since = sequence.wrapping_sub(self.live.sequence) as f64 * self.period;
        let rejected = Some(Why::new(Reason::Rejected, None));
        let Some(last) = self.live.estimate else {
            self.live.why = rejected;
            return joint_estimate(self.arrangement, sequence, flags, self.parts(0.0), self.motors);
        };
        let mut flags = flags | last.status & (status::CHANGED | status::RESTARTED);
        let was = |bit: u32| last.status & bit != 0;
        if since > BRIEF_S {
            self.live.why = rejected;
            return Estimate { sequence, status: flags, ..last };
        }
        let parts = self.parts(since);
        let why = self.live.why.filter(|_| !was(status::VALID));
        let reasons = self.reasons(&parts, true);
        flags |= self.usable(reasons) & last.status;
        self.live.why = why.or(self.live.why);
        joint_estimate(self.arrangement, sequence, flags, parts, self.motors)
    }

    /// The bits of what may be used, by why the stiffness and the torque may not; the first reason is why not all may.
    fn usable(&mut self, [stiffness, torque]: [Option<Why>; 2]) -> u32 {
        self.live.why = stiffness.or(torque);
        let bit = |given: bool, bit: u32| if given { bit } else { 0 };
        bit(stiffness.is_none() && self.flexible, status::STIFFNESS_VALID)
            | bit(torque.is_none(), status::TORQUE_VALID)
            | bit(self.live.why.is_none(), status::VALID)
    }

    /// Why the joint's stiffness may not be used, and why its torque may not.
    fn reasons(&self, parts: &[TransmissionEstimate; MOTORS], settled: bool) -> [Option<Why>; 2] {
        let mut found = [None; 2];
        for (i, (side, part)) in self.sides.iter().zip(parts).enumerate() {
            let reasons = side.reasons(part, self.valid_within, settled);
            let left = self.rigid.get(i).and_then(|balance| {
                let noise = [
                    self.live.torque_noise[i].variance(f64::INFINITY),
                    self.noise_of(i)[0] * self.noise_gains[2],
                ];
                balance.unexplained(self.valid_within, noise).map(Reason::Unexplained)
            });
            for (found, reason) in found.iter_mut().zip(reasons.map(|reason| reason.or(left))) {
                *found = found.or(reason.map(|reason| Why {
                    reason,
                    motor: Some(i),
                    changes: side.likely_causes(),
                }));
            }
        }
        found
    }

    /// Each transmission's estimate, so long after the last sample.
    fn parts(&self, since_s: f64) -> [TransmissionEstimate; MOTORS] {
        // What has been waited for the latest channel, declared late or found to be.
        let waited = self.corrections.age_s() + self.alignment.periods.abs() * self.period;
        let behind_s = self.corrections.behind_s();
        let mut parts = [TransmissionEstimate::NOTHING; MOTORS];
        for (i, side) in self.sides.iter().enumerate() {
            let phi = self.live.last.present.deflection(i);
            let present = Present { phi, behind_s, ahead_s: since_s + waited };
            parts[i] = side.estimate(&present, self.filters.delay);
        }
        parts
    }
}
