//! One joint from frames to the bytes for zenoh. The one path for live, lockstep and replay.
//!
//! Adds the service's status bits: drive faults, missing frames, stale estimates.

use estimator_core::external::External;
use estimator_core::sample::status::{MODEL_ALARM, OBSERVABLE, RESTARTED, USABLE, VALID};
use estimator_core::sample::{Estimate, Sample};

use crate::assembler::status::{CONTRADICTED, NODE_RESTARTED, STALE, UNTIMED};
use crate::assembler::{Assembler, SYNC_COB_ID};
use crate::wire::{Payload, encode_estimate, encode_external, encode_sample};

/// Why an estimator could not step: never the compiled one, perhaps one that somebody registered.
pub type Failure = Box<dyn std::error::Error + Send + Sync>;

/// What the pipeline needs of an estimator.
pub trait Step: Send {
    /// The estimate at this sample.
    ///
    /// # Errors
    /// The estimator is not ours, and failed.
    fn step(&mut self, sample: &Sample) -> Result<Estimate, Failure>;

    /// Positions may count from anywhere after this.
    ///
    /// # Errors
    /// As for `step`.
    fn lose_zeros(&mut self) -> Result<(), Failure>;

    /// The next sample may not be of its moment: use it, but learn nothing from it.
    ///
    /// # Errors
    /// As for `step`.
    fn distrust(&mut self) -> Result<(), Failure>;

    /// The next sample is later than its period by so many seconds.
    fn delay_next(&mut self, _late_s: f64) {}

    /// Whether the monitor of the model raises the alarm, after this step.
    ///
    /// # Errors
    /// As for `step`.
    fn alarm(&mut self, _sample: &Sample, _estimate: &Estimate) -> Result<bool, Failure> {
        Ok(false)
    }

    /// What the world does to the link, by the last sample; `None`: nothing is declared of the link.
    ///
    /// # Errors
    /// As for `step`.
    fn external(&mut self) -> Result<Option<External>, Failure> {
        Ok(None)
    }
}

/// What a frame leads to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Due {
    /// A sample to be estimated, with the service bits that hold for it, and how late it may be, s.
    Sample(Sample, u32, f64),
    /// A cycle of this number that gave no sample, with its service bits.
    Missed(i64, u32),
}

/// What is published of one cycle.
#[derive(Clone, Copy, Debug)]
pub struct Tick {
    /// Of the cycle; stale where it is the last one carried on.
    pub estimate: Estimate,
    /// What the world does to the link, where that is estimated; valid only where the estimate is.
    pub external: Option<External>,
    /// What it was made from; `None` where it is carried on.
    pub sample: Option<Sample>,
    /// Of the joint.
    pub motors: usize,
    /// UNIX time of its SYNC.
    pub stamp_ns: i64,
    /// Whether the cycle is that of the last SYNC.
    pub current: bool,
}

impl Tick {
    /// The bytes of `<prefix>/<joint>/estimate`.
    #[must_use]
    pub fn estimate_payload(&self) -> Payload {
        let e = &self.estimate;
        let joint = [e.flexibility_torque, e.stiffness, e.stiffness_std];
        encode_estimate(e.sequence, self.stamp_ns as u64, e.status, joint, &e.transmissions[..e.motors])
    }

    /// The bytes of `<prefix>/<joint>/external`.
    #[must_use]
    pub fn external_payload(&self) -> Option<Payload> {
        self.external.map(|external| encode_external(&external, self.stamp_ns as u64))
    }

    /// The bytes of `<prefix>/<joint>/sample`.
    #[must_use]
    pub fn sample_payload(&self) -> Option<Payload> {
        self.sample.map(|sample| encode_sample(&sample, self.motors, self.stamp_ns as u64))
    }
}

/// What goes on from one cycle to the next, the assembler and the estimator aside.
#[derive(Clone, Debug, Default)]
pub struct Pipeline {
    sync_ns: i64,
    sync_before_ns: i64,
    late_s: [f64; 2], // the last SYNC, and the one before
    sequence: i64,
    last: Option<Tick>,
    /// Cycles that gave no sample.
    pub missed: u64,
}

impl Pipeline {
    /// Take one frame, see [`Assembler::feed`]; of a SYNC its UNIX time, and by how much it was later than that.
    pub fn feed(
        &mut self,
        assembler: &mut Assembler,
        cob_id: u32,
        data: &[u8],
        jump: i64,
        (stamp_ns, late_ns): (i64, i64),
    ) -> Option<Due> {
        if cob_id == SYNC_COB_ID && jump > 0 {
            self.sync_before_ns = std::mem::replace(&mut self.sync_ns, stamp_ns);
            self.late_s = [late_ns as f64 * 1e-9, self.late_s[0]];
        }
        let sample = assembler.feed(cob_id, data, jump);
        self.sequence = assembler.sequence;
        if let Some(sample) = sample {
            let before = usize::from(sample.sequence as i64 != self.sequence);
            let late_s = self.late_s[before].max(assembler.late_s);
            return Some(Due::Sample(sample, assembler.flags, late_s));
        }
        let missed = assembler.missed.take()?;
        self.missed += 1;
        Some(Due::Missed(missed, assembler.flags))
    }

    /// What to publish of a sample's estimate, see [`estimate`].
    pub fn conclude(
        &mut self,
        sample: &Sample,
        motors: usize,
        results: (Estimate, Option<External>),
        stamp_ns: Option<i64>,
    ) -> Tick {
        self.publish(results, Some(*sample), motors, stamp_ns)
    }

    /// The last estimate under a new number: stale, not valid; `None` where there never was one.
    pub fn carry_on(&mut self, sequence: i64, flags: u32, stamp_ns: Option<i64>) -> Option<Tick> {
        let Tick { mut estimate, external, motors, .. } = self.last?;
        estimate.sequence = sequence as u64;
        // None of these is true of an estimate that is carried on.
        estimate.status = estimate.status & !(USABLE | OBSERVABLE | NODE_RESTARTED) | STALE | flags;
        let external = external.map(|external| external.void(estimate.sequence));
        Some(self.publish((estimate, external), None, motors, stamp_ns))
    }

    /// What was published last.
    #[must_use]
    pub fn last(&self) -> Option<&Tick> {
        self.last.as_ref()
    }

    fn publish(
        &mut self,
        (estimate, external): (Estimate, Option<External>),
        sample: Option<Sample>,
        motors: usize,
        stamp_ns: Option<i64>,
    ) -> Tick {
        let (estimate, external) = gated(estimate, external);
        let current = estimate.sequence as i64 == self.sequence;
        let stamp_ns = stamp_ns.unwrap_or(if current { self.sync_ns } else { self.sync_before_ns });
        let tick = Tick { estimate, external, sample, motors, stamp_ns, current };
        self.last = Some(tick);
        tick
    }
}

/// The last gate before the wire: what is not a number is not valid. A rigid transmission has no stiffness.
fn gated(mut estimate: Estimate, external: Option<External>) -> (Estimate, Option<External>) {
    let finite = |torque: f64, stiffness: f64, rigid: bool| {
        torque.is_finite() && (stiffness.is_finite() || (rigid && stiffness.is_nan()))
    };
    let parts = &estimate.transmissions[..estimate.motors];
    let rigid = parts.iter().any(|part| part.deflection.is_nan());
    let sound = finite(estimate.flexibility_torque, estimate.stiffness, rigid)
        && parts.iter().all(|p| finite(p.flexibility_torque, p.stiffness, p.deflection.is_nan()))
        && !estimate.stiffness_std.is_infinite();
    if !sound {
        estimate.status &= !USABLE;
    }
    let valid = estimate.status & VALID != 0;
    let external = external.map(|external| match valid && external.torque.is_finite() {
        true => external,
        false => external.void(external.sequence),
    });
    (estimate, external)
}

/// The estimate at a sample for which these service bits hold, the bits included, and what touches the link.
///
/// # Errors
/// The estimator failed.
pub fn estimate(
    estimator: &mut dyn Step,
    sample: &Sample,
    mut flags: u32,
    late_s: f64,
) -> Result<(Estimate, Option<External>), Failure> {
    if flags & NODE_RESTARTED != 0 {
        estimator.lose_zeros()?;
        flags |= RESTARTED;
    }
    if flags & (UNTIMED | CONTRADICTED) != 0 {
        estimator.distrust()?;
    }
    estimator.delay_next(late_s);
    let mut estimate = estimator.step(sample)?;
    if estimator.alarm(sample, &estimate)? {
        flags |= MODEL_ALARM;
        estimate.status &= !USABLE; // a model that is not sufficient makes no number that may be used
    }
    if flags & CONTRADICTED != 0 {
        estimate.status &= !USABLE; // one of two readings lies, and nobody can say that it is not the one in use
    }
    estimate.status |= flags;
    Ok((estimate, estimator.external()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use estimator_core::sample::{MOTORS, TransmissionEstimate};

    const SAMPLE: Sample = Sample {
        sequence: 5,
        motor_position: [0.1; MOTORS],
        motor_velocity: [f64::NAN; MOTORS],
        motor_torque: [0.0; MOTORS],
        link_position: 0.2,
        link_velocity: f64::NAN,
        external_torque: f64::NAN,
    };

    /// Says always the same, and keeps what it was told.
    struct Fixed {
        stiffness: f64,
        alarm: bool,
        told: Vec<&'static str>,
    }

    impl Step for Fixed {
        fn step(&mut self, sample: &Sample) -> Result<Estimate, Failure> {
            let part = TransmissionEstimate {
                flexibility_torque: 1.0,
                stiffness: self.stiffness,
                stiffness_std: 1.0,
                deflection: 0.1,
                ..TransmissionEstimate::NOTHING
            };
            Ok(Estimate {
                sequence: sample.sequence,
                status: VALID,
                flexibility_torque: 1.0,
                flexibility_torque_std: 0.1,
                stiffness: self.stiffness,
                stiffness_std: 1.0,
                transmissions: [part; MOTORS],
                motors: 1,
            })
        }

        fn lose_zeros(&mut self) -> Result<(), Failure> {
            self.told.push("lose_zeros");
            Ok(())
        }

        fn distrust(&mut self) -> Result<(), Failure> {
            self.told.push("distrust");
            Ok(())
        }

        fn alarm(&mut self, _: &Sample, _: &Estimate) -> Result<bool, Failure> {
            Ok(self.alarm)
        }
    }

    fn run(stiffness: f64, alarm: bool, flags: u32) -> (u32, Vec<&'static str>) {
        let mut fixed = Fixed { stiffness, alarm, told: Vec::new() };
        let results = estimate(&mut fixed, &SAMPLE, flags, 0.0).unwrap();
        (Pipeline::default().conclude(&SAMPLE, 1, results, Some(9)).estimate.status, fixed.told)
    }

    #[test]
    fn service_bits_are_added_and_take_what_may_not_be_used() {
        assert_eq!(run(150.0, false, 0), (VALID, vec![]));
        assert_eq!(
            run(150.0, false, NODE_RESTARTED),
            (VALID | NODE_RESTARTED | RESTARTED, vec!["lose_zeros"])
        );
        assert_eq!(run(150.0, false, UNTIMED), (VALID | UNTIMED, vec!["distrust"]));
        assert_eq!(run(150.0, false, CONTRADICTED), (CONTRADICTED, vec!["distrust"]));
        assert_eq!(run(150.0, true, 0), (MODEL_ALARM, vec![]));
    }

    #[test]
    fn what_is_no_number_is_not_valid() {
        assert_eq!(run(f64::NAN, false, 0).0, 0);
        assert_eq!(run(f64::INFINITY, false, 0).0, 0);
    }

    #[test]
    fn a_cycle_without_a_sample_carries_the_last_estimate_on_stale() {
        let mut pipeline = Pipeline::default();
        assert!(pipeline.carry_on(1, 0, None).is_none());
        let mut fixed = Fixed { stiffness: 150.0, alarm: false, told: Vec::new() };
        let mut results = estimate(&mut fixed, &SAMPLE, 0, 0.0).unwrap();
        results.0.status |= OBSERVABLE;
        pipeline.conclude(&SAMPLE, 1, results, Some(9));
        let tick = pipeline.carry_on(6, 0, Some(10)).unwrap();
        assert_eq!((tick.estimate.sequence, tick.estimate.status, tick.stamp_ns), (6, STALE, 10));
        assert_eq!(tick.estimate.stiffness, 150.0);
        assert!(tick.sample_payload().is_none() && tick.external_payload().is_none());
    }
}
