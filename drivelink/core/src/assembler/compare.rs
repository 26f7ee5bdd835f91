//! Which readings of one quantity a joint's frames carry, and whether they contradict each other.

use super::Assembler;
use super::status::CONTRADICTED;
use crate::cross_check::{CrossCheck, Kind, spoils};
use crate::frames::target;
use crate::layout::Signal;

impl Assembler {
    /// Which readings of one quantity are mapped.
    pub(super) fn arrange_checks(&mut self) {
        let fields: Vec<(usize, f64)> = self
            .decoders
            .iter()
            .flat_map(|decoder| &decoder.fields)
            .map(|field| (field.target, field.scale))
            .collect();
        self.checks.clear();
        self.contradicted = 0;
        for motor in 0..self.motors {
            let step = |signal| {
                let place = target(signal, Some(motor), self.motors);
                fields.iter().find(|(target, _)| Some(*target) == place).map(|(_, scale)| *scale)
            };
            let (position, torque) = (step(Signal::MotorPosition), step(Signal::MotorTorque));
            let velocity = step(Signal::MotorVelocity).or(step(Signal::VelocityCheck));
            let demand = step(Signal::PositionDemand).and(position);
            for (kind, first, second) in [
                (Kind::Velocity, position, velocity),
                (Kind::Current, torque, step(Signal::TorqueCheck)),
                (Kind::SecondEncoder, position, step(Signal::SecondPosition)),
                (Kind::FollowingError, demand, step(Signal::FollowingError)),
            ] {
                if let (Some(first), Some(second)) = (first, second) {
                    self.checks.push(CrossCheck::new(kind, motor, (first, second), self.period));
                }
            }
        }
    }

    /// Hold the readings of the cycle that ends against each other, where all of them are of it.
    pub(super) fn cross_check(&mut self) {
        if self.checks.is_empty() || self.open || self.spoiled || self.untimed > 0 || self.sequence < 0 {
            return;
        }
        let (motors, mut ended) = (self.motors, false);
        for check in &mut self.checks {
            let motor = check.motor;
            let now = |signal| {
                let place = target(signal, Some(motor), motors)?;
                (self.answered[place] == self.sequence).then_some(self.values[place])
            };
            let position = now(Signal::MotorPosition);
            let (first, second) = match check.kind {
                Kind::Velocity => (position, now(Signal::MotorVelocity).or(now(Signal::VelocityCheck))),
                Kind::Current => (now(Signal::MotorTorque), now(Signal::TorqueCheck)),
                Kind::SecondEncoder => (position, now(Signal::SecondPosition)),
                Kind::FollowingError => {
                    let demand = now(Signal::PositionDemand);
                    (demand.zip(position).map(|(demand, is)| demand - is), now(Signal::FollowingError))
                }
            };
            if let (Some(first), Some(second)) = (first, second) {
                ended |= check.add(self.sequence, first, second);
            }
        }
        if ended {
            let spoilt = (0..motors).any(|motor| spoils(&self.checks, motor));
            self.contradicted = if spoilt { CONTRADICTED } else { 0 };
        }
    }
}
