//! Which reading is suspected, and why, while readings contradict the model.

use crate::change_detection::SURE;
use crate::isolation::{Change, Verdict};
use crate::sample::MOTORS;
use crate::transmission::TransmissionEstimator;

/// A signal of a joint; motors are counted from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Signal {
    /// θ.
    MotorPosition(usize),
    /// τ.
    MotorTorque(usize),
    /// q.
    LinkPosition,
    /// θ or q: the zero between them.
    Positions(usize),
}

/// What is wrong with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reason {
    /// Larger by this share.
    Scale,
    /// So many seconds late.
    Delay,
    /// By so much, rad or N·m.
    Zero,
    /// By so much a second, rad/s.
    Drift,
    /// No finite number, or none that can be.
    Impossible,
    /// From one sample to the next by more than it can.
    Jumped,
    /// It repeats itself while others move.
    Frozen,
}

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Suspicion {
    /// What is suspected …
    pub signal: Signal,
    /// … of what …
    pub reason: Reason,
    /// … by how much, in the reason's unit …
    pub amount: f64,
    /// … with this standard deviation; NaN where there is no amount.
    pub std: f64,
    /// Whether it explains all that is seen, or is only the likeliest.
    pub explains: bool,
}

impl Suspicion {
    /// Of a sample that cannot be used.
    #[must_use]
    pub fn of_sample(signal: Signal, reason: Reason) -> Suspicion {
        Suspicion { signal, reason, amount: f64::NAN, std: f64::NAN, explains: true }
    }
}

/// The reading that explains best what the balances of a joint leave, while one of them is not explained.
///
/// A motor's own reading leaves the other motor's balance as it is; the link's position is in both.
#[must_use]
pub fn suspected(transmissions: &[TransmissionEstimator]) -> Option<Suspicion> {
    if !transmissions.iter().any(|one| one.doubt().is_some()) {
        return None;
    }
    let mut verdicts: [Option<&Verdict>; MOTORS] = [None; MOTORS];
    for (verdict, one) in verdicts.iter_mut().zip(transmissions) {
        *verdict = one.verdict();
    }
    let evidence = |motor: Option<usize>, change: Change| -> f64 {
        let parts = verdicts.iter().enumerate().filter_map(|(i, verdict)| {
            let own = motor.is_none_or(|motor| motor == i);
            verdict.map(|verdict| verdict.of(if own { change } else { Change::Nothing }).evidence)
        });
        parts.sum()
    };
    let mut best: Option<(f64, usize, Change, bool)> = None;
    for (motor, verdict) in verdicts.iter().enumerate() {
        if verdict.is_none() {
            continue;
        }
        for change in &Change::ALL[1..] {
            let common = matches!(change, Change::LinkScale | Change::LinkDelay | Change::LinkDrift);
            let now = evidence((!common).then_some(motor), *change);
            if best.is_none_or(|(most, ..)| now > most) {
                best = Some((now, motor, *change, common));
            }
        }
    }
    let (most, motor, change, common) = best?;
    // Whose zero drifts shows by the motor's damping alone.
    let other = evidence(None, Change::LinkDrift).min(evidence(Some(motor), Change::MotorDrift));
    let either = change.is_drift() && other > most - SURE;
    let (signal, reason) = match change {
        _ if either => (Signal::Positions(motor), Reason::Drift),
        Change::MotorScale => (Signal::MotorPosition(motor), Reason::Scale),
        Change::MotorDelay => (Signal::MotorPosition(motor), Reason::Delay),
        Change::TorqueScale => (Signal::MotorTorque(motor), Reason::Scale),
        Change::TorqueDelay => (Signal::MotorTorque(motor), Reason::Delay),
        Change::TorqueZero => (Signal::MotorTorque(motor), Reason::Zero),
        Change::LinkScale => (Signal::LinkPosition, Reason::Scale),
        Change::LinkDelay => (Signal::LinkPosition, Reason::Delay),
        Change::PositionZero => (Signal::Positions(motor), Reason::Zero),
        Change::LinkDrift => (Signal::LinkPosition, Reason::Drift),
        Change::MotorDrift => (Signal::MotorPosition(motor), Reason::Drift),
        Change::Nothing | Change::Stiffness | Change::Friction => return None, // of the joint, not of a reading
    };
    let explanation = verdicts[motor]?.of(change);
    let unit = transmissions[motor].unit_of(change);
    // The deflection's drift is counted.
    let unit = if signal == Signal::LinkPosition && change.is_drift() { -unit } else { unit };
    let explains = transmissions.iter().enumerate().all(|(i, one)| {
        let own = common || i == motor;
        one.is_explained_by(if own { change } else { Change::Nothing })
    });
    Some(Suspicion {
        signal,
        reason,
        amount: unit * explanation.amplitude,
        std: unit.abs() * explanation.std,
        explains,
    })
}
