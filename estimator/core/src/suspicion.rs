//! Which reading is suspected, and why, while readings contradict the model.

use serde::{Deserialize, Serialize};

use crate::causes::{Cause, Odds, TABLE};
use crate::choices::{ACCUSED, UNUSUAL};
use crate::sample::MOTORS;

/// A signal of a joint; motors are counted from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Reason {
    /// Larger by this share.
    Scale,
    /// So many seconds late.
    Delay,
    /// By so much, rad or N·m.
    Zero,
    /// No finite number, or none that can be.
    Impossible,
    /// From one sample to the next by more than it can.
    Jumped,
    /// It repeats itself while others move.
    Frozen,
}

/// See the module.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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

    /// The reading that explains best what the balances of a joint leave, while one of them is not explained.
    ///
    /// `sides`: what the causes say of each motor's balance; `None`: it is explained. A motor's own reading leaves
    /// the other motor's balance as it is; the link's position is in both.
    #[must_use]
    pub fn of<'a>(sides: impl Iterator<Item = Option<&'a Odds>>) -> Option<Suspicion> {
        let mut odds: [Option<&Odds>; MOTORS] = [None; MOTORS];
        let mut motors = 0;
        for one in sides.take(MOTORS) {
            odds[motors] = one;
            motors += 1;
        }
        let log = |motor: usize, cause: Cause| match odds[motor] {
            Some(odds) => odds.log[cause as usize],
            None if cause == Cause::Nothing => 0.0,
            None => -2.0 * ACCUSED.ln(), // explained
        };
        let mut best: Option<(f64, usize, Cause)> = None;
        for motor in (0..motors).filter(|motor| odds[*motor].is_some()) {
            for cause in TABLE
                .iter()
                .map(|entry| entry.cause)
                .filter(|cause| !matches!(cause, Cause::Nothing | Cause::Noise))
            {
                let common = matches!(cause, Cause::LinkScale | Cause::LinkDelay);
                let of = |i: usize| log(i, if i == motor || common { cause } else { Cause::Nothing });
                let now: f64 = (0..motors).map(of).sum();
                if now.is_finite() && best.is_none_or(|(most, ..)| now > most) {
                    best = Some((now, motor, cause));
                }
            }
        }
        let (_, motor, cause) = best?;
        let (signal, reason) = match cause {
            Cause::MotorScale => (Signal::MotorPosition(motor), Reason::Scale),
            Cause::MotorDelay => (Signal::MotorPosition(motor), Reason::Delay),
            Cause::TorqueScale => (Signal::MotorTorque(motor), Reason::Scale),
            Cause::TorqueDelay => (Signal::MotorTorque(motor), Reason::Delay),
            Cause::TorqueZero => (Signal::MotorTorque(motor), Reason::Zero),
            Cause::LinkScale => (Signal::LinkPosition, Reason::Scale),
            Cause::LinkDelay => (Signal::LinkPosition, Reason::Delay),
            Cause::PositionZero => (Signal::Positions(motor), Reason::Zero),
            _ => return None, // of the joint, not of a reading
        };
        let found = odds[motor]?.of(cause);
        Some(Suspicion {
            signal,
            reason,
            amount: found.amplitude,
            std: found.std,
            explains: found.misfit < UNUSUAL,
        })
    }
}
