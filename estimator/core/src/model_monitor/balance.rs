//! The balances with the model's own numbers (eqs 4 and 5).

use super::{BALANCES, CHANNELS, EXTERNAL, LINK, ModelMonitor, TORQUE};
use crate::effects::Coordinates;
use crate::joint_effects::Torques;
use crate::laws::Law;
use crate::sample::{MOTORS, Sample};

impl ModelMonitor {
    /// The balances with the model's own numbers, and the torques they are compared with.
    pub(super) fn balance(&mut self) -> [f64; 2 * BALANCES] {
        let motors = self.motors.len();
        let [q, link_rate, link_acceleration] = self.channels[LINK];
        let at_link = Coordinates {
            link_position: q,
            link_velocity: link_rate,
            link_acceleration,
            time: self.ticks as f64 * self.period,
            ..Coordinates::default()
        };
        let mut each = [Coordinates::default(); MOTORS];
        each.iter_mut().take(motors).enumerate().for_each(|(i, c)| *c = self.coordinates(i, &at_link));
        let torques = each.map(|c| c.flexibility_torque);
        let x: Torques = self.effects.torques(&each[..motors], &at_link);
        let mut raw = [0.0; 2 * BALANCES];
        let external = self.channels[EXTERNAL][0];
        for (i, side) in self.motors.iter().enumerate() {
            let c = &each[i];
            // B θ″ + D θ′ + x_motor − τ_e − x_transmission − τ (eq 5)
            let own = side.inertia * c.acceleration + side.damping * c.velocity;
            raw[i] = own + x.motor[i] - torques[i] - x.transmission[i] - c.torque;
            raw[BALANCES + i] = c.torque;
        }
        let load = self.link.map_or(0.0, |link| {
            let gravity = link.gravity * (q + link.gravity_phase).sin();
            link.inertia * link_acceleration + link.damping * link_rate + gravity
        });
        if self.linked {
            // τ_k − (M q″ + D_q q′ + g(q) + τ_e + x_transmission + x_link) (eqs 4, 6)
            let through: f64 = (0..self.pulls).map(|i| torques[i] + x.transmission[i]).sum();
            raw[motors] = external - load - through - x.link;
            raw[BALANCES + motors] = through;
        } else if !self.flexible {
            raw[0] += load + x.link - external;
        }
        raw
    }

    /// Those of a motor, beside those of the link.
    fn coordinates(&self, i: usize, at_link: &Coordinates) -> Coordinates {
        let side = &self.motors[i];
        let [position, velocity, acceleration] = self.channels[i];
        let [torque, torque_rate, _] = self.channels[TORQUE + i];
        let (deflection, deflection_rate) = if side.flexible {
            (at_link.link_position - position, at_link.link_velocity - velocity)
        } else {
            (0.0, 0.0)
        };
        let at = |(law, alpha): &(Law, Vec<f64>)| law.at(deflection, alpha);
        let (flexibility_torque, stiffness) = side.law.as_ref().map_or((0.0, 0.0), at);
        Coordinates {
            position,
            velocity,
            acceleration,
            deflection,
            deflection_rate,
            flexibility_torque,
            stiffness,
            torque,
            torque_rate,
            ..*at_link
        }
    }

    pub(super) fn inputs_of(&self, sample: &Sample) -> [f64; CHANNELS] {
        let mut channels = [0.0; CHANNELS];
        let motors = self.motors.len();
        channels[..motors].copy_from_slice(&sample.motor_position[..motors]);
        channels[TORQUE..TORQUE + motors].copy_from_slice(&sample.motor_torque[..motors]);
        // Rigid: the link moves with the first motor.
        channels[LINK] = if self.flexible { sample.link_position } else { sample.motor_position[0] };
        if self.link.is_some() && sample.external_torque.is_finite() {
            channels[EXTERNAL] = sample.external_torque;
        }
        channels
    }
}
