//! The laws of the physical effects a model may have been given, and what they do to readings and balances.
//!
//! Signs: with x in N·m, B θ″ + D θ′ + x_motor − τ_e(φ) − x_transmission = τ and
//! M q″ + D_q q′ + g(q) + τ_e + x_transmission + x_link = τ_k. x is the sum over an effect's terms, each
//! times its linear parameter. A measured torque has x too much: the torque that acts is τ − x. A reading
//! has its error too much: the true position is the reading less the error. Names, units and meanings of the
//! parameters are in `estimator.effects.library`; here they are values in that order, the linear ones first.

use crate::error::Error;
use crate::sample::{MOTORS, Sample};

/// Parameters of one element, at most.
pub const VALUES: usize = 4;
/// Beyond this nothing is a measurement any more; terms are not evaluated there.
const ABSURD: f64 = 1e9;
/// From this exponent on an element with memory is elastic up to its limit and then slips (Jenkins).
const STOP_EXPONENT: f64 = 50.0;

/// What a term may depend on; SI, all filtered alike.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coordinates {
    /// θ.
    pub position: f64,
    /// θ′.
    pub velocity: f64,
    /// θ″.
    pub acceleration: f64,
    /// φ = q − θ.
    pub deflection: f64,
    /// φ′.
    pub deflection_rate: f64,
    /// τ_e(φ).
    pub flexibility_torque: f64,
    /// σ(φ).
    pub stiffness: f64,
    /// τ.
    pub torque: f64,
    /// τ′.
    pub torque_rate: f64,
    /// q.
    pub link_position: f64,
    /// q′.
    pub link_velocity: f64,
    /// q″.
    pub link_acceleration: f64,
    /// Since the start.
    pub time: f64,
}

impl Coordinates {
    fn sane(&self) -> bool {
        let c = self;
        let motor = [c.position, c.velocity, c.acceleration, c.torque, c.torque_rate, c.time];
        let spring = [c.deflection, c.deflection_rate, c.flexibility_torque, c.stiffness];
        let link = [c.link_position, c.link_velocity, c.link_acceleration];
        motor.iter().chain(&spring).chain(&link).all(|x| x.abs() < ABSURD)
    }
}

macro_rules! kinds {
    ($($variant:ident $name:literal $linear:literal $values:literal),* $(,)?) => {
        /// The kinds of effects; see `estimator.effects.library`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[allow(missing_docs)]
        pub enum Kind { $($variant),* }

        impl Kind {
            /// By its name in joint files.
            #[must_use]
            pub fn named(name: &str) -> Option<Kind> {
                match name { $($name => Some(Kind::$variant),)* _ => None }
            }

            /// Its name in joint files.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self { $(Kind::$variant => $name),* }
            }

            /// How many of its parameters are linear, each weighing one term; they come first.
            #[must_use]
            pub fn terms(self) -> usize {
                match self { $(Kind::$variant => $linear),* }
            }

            /// How many parameters it has.
            #[must_use]
            pub fn values(self) -> usize {
                match self { $(Kind::$variant => $values),* }
            }
        }
    };
}

kinds! {
    CoulombFriction "coulomb_friction" 1 2,
    StribeckFriction "stribeck_friction" 2 4,
    AsymmetricFriction "asymmetric_friction" 2 3,
    PreslidingFriction "presliding_friction" 1 4,
    LoadDependentFriction "load_dependent_friction" 1 2,
    ViscousDamping "viscous_damping" 1 1,
    QuadraticDamping "quadratic_damping" 1 1,
    Cogging "cogging" 2 3,
    TorqueOffset "torque_offset" 1 1,
    TorqueConstant "torque_constant" 1 1,
    TorqueSaturation "torque_saturation" 1 1,
    TorqueDrift "torque_drift" 1 2,
    MotorInertia "motor_inertia" 1 1,
    TorqueDelay "torque_delay" 1 1,
    Hysteresis "hysteresis" 1 4,
    Backlash "backlash" 1 2,
    AsymmetricStiffness "asymmetric_stiffness" 1 1,
    HigherOrderStiffness "higher_order_stiffness" 1 2,
    TransmissionDamping "transmission_damping" 1 1,
    KinematicError "kinematic_error" 2 3,
    DeflectionOffset "deflection_offset" 1 1,
    EncoderEccentricity "encoder_eccentricity" 2 2,
    EncoderDelay "encoder_delay" 1 1,
    EncoderScale "encoder_scale" 1 1,
    Gravity "gravity" 2 2,
    LinkCoulombFriction "link_coulomb_friction" 1 2,
    LinkViscousDamping "link_viscous_damping" 1 1,
    LinkInertia "link_inertia" 1 1,
    Contact "contact" 1 3,
}

/// Where an effect acts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// x_motor of eq 5.
    Motor,
    /// x_transmission of eqs 4 and 5.
    Transmission,
    /// x_link of eq 4.
    Link,
    /// The motor torque's measurement.
    Drive,
    /// The link encoder's reading.
    Reading,
    /// A delay, or the offset between the encoders: channels are moved, not torques added.
    Channels,
}

/// One element of an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Element {
    /// What it is.
    pub kind: Kind,
    /// Its parameters.
    pub values: [f64; VALUES],
}

impl Kind {
    /// Where it acts.
    #[must_use]
    pub fn place(self) -> Place {
        use Kind as K;
        match self {
            K::TorqueConstant | K::TorqueSaturation | K::TorqueDrift => Place::Drive,
            K::TorqueDelay | K::EncoderDelay | K::DeflectionOffset => Place::Channels,
            K::EncoderEccentricity | K::EncoderScale => Place::Reading,
            K::Hysteresis
            | K::Backlash
            | K::AsymmetricStiffness
            | K::HigherOrderStiffness
            | K::TransmissionDamping
            | K::KinematicError => Place::Transmission,
            K::Gravity | K::LinkCoulombFriction | K::LinkViscousDamping | K::LinkInertia | K::Contact => {
                Place::Link
            }
            _ => Place::Motor,
        }
    }

    /// Whether it belongs to the link or its encoder, not to a motor.
    #[must_use]
    pub fn on_link(self) -> bool {
        matches!(self.place(), Place::Link | Place::Reading) || self == Kind::EncoderDelay
    }

    /// Whether it depends on the path that led here.
    #[must_use]
    pub fn remembers(self) -> bool {
        matches!(self, Kind::PreslidingFriction | Kind::Hysteresis)
    }
}

impl Element {
    /// An element from its kind's parameters in order.
    ///
    /// # Errors
    /// There is no such effect, or it has another number of parameters.
    pub fn new(name: &str, values: &[f64]) -> Result<Element, Error> {
        let kind = Kind::named(name).ok_or_else(|| Error(format!("effect \"{name}\": no such effect")))?;
        if values.len() != kind.values() {
            let expected = kind.values();
            return Err(Error(format!(
                "effect \"{name}\": expected {expected} values, got {}",
                values.len()
            )));
        }
        let mut padded = [0.0; VALUES];
        padded[..values.len()].copy_from_slice(values);
        Ok(Element { kind, values: padded })
    }

    /// Its terms, unweighted; those with a memory have none.
    #[must_use]
    pub fn terms(&self, c: &Coordinates) -> [f64; 2] {
        use Kind as K;
        let v = &self.values;
        let one = |term: f64| [term, 0.0];
        let waves = |periods: f64| {
            let (sine, cosine) = (periods * c.position).sin_cos();
            [sine, cosine]
        };
        match self.kind {
            K::CoulombFriction => one((c.velocity / v[1]).tanh()),
            K::StribeckFriction => {
                let (ratio, sign) = (c.velocity / v[2], (c.velocity / v[3]).tanh());
                [sign, sign * (-ratio * ratio).exp()]
            }
            K::AsymmetricFriction => {
                let sign = (c.velocity / v[2]).tanh();
                [0.5 * (sign + sign.abs()), 0.5 * (sign - sign.abs())]
            }
            K::LoadDependentFriction => one(c.flexibility_torque.abs() * (c.velocity / v[1]).tanh()),
            K::ViscousDamping => one(c.velocity),
            K::QuadraticDamping => one(c.velocity * c.velocity.abs()),
            K::Cogging => waves(v[2]),
            K::TorqueOffset | K::DeflectionOffset => one(1.0),
            K::TorqueConstant => one(-c.torque),
            K::TorqueSaturation => one(c.torque * c.torque * c.torque),
            K::TorqueDrift => one(-c.torque * (1.0 - (-c.time / v[1]).exp())),
            K::MotorInertia => one(c.acceleration),
            K::TorqueDelay => one(c.torque_rate),
            K::Backlash => one(0.5 * ((c.deflection - v[1]).abs() - (c.deflection + v[1]).abs())),
            K::AsymmetricStiffness => one(c.deflection * c.deflection),
            K::HigherOrderStiffness => one(c.deflection.powi(v[1] as i32)),
            K::TransmissionDamping => one(c.deflection_rate),
            K::KinematicError => waves(v[2]).map(|wave| c.stiffness * wave),
            K::EncoderEccentricity | K::Gravity => [c.link_position.sin(), c.link_position.cos()],
            K::EncoderDelay => one(-c.link_velocity),
            K::EncoderScale => one(c.link_position),
            K::LinkCoulombFriction => one((c.link_velocity / v[1]).tanh()),
            K::LinkViscousDamping => one(c.link_velocity),
            K::LinkInertia => one(c.link_acceleration),
            K::Contact => {
                let depth = v[2] * (c.link_position - v[1]);
                one(0.5 * v[2] * (depth + depth.abs()))
            }
            K::PreslidingFriction | K::Hysteresis => [0.0; 2],
        }
    }

    /// Whether its torque acts on the link (x_link of eq 4).
    #[must_use]
    pub fn acts_on_link(&self) -> bool {
        self.kind.place() == Place::Link
    }

    /// x of an element without a memory.
    #[must_use]
    pub fn torque(&self, c: &Coordinates) -> f64 {
        let terms = self.terms(c);
        let weighted = self.values[0] * terms[0];
        if self.kind.terms() == 2 { weighted + self.values[1] * terms[1] } else { weighted }
    }

    /// ∂x/∂φ where x depends on the deflection alone, so that the element is a part of the spring.
    #[must_use]
    pub fn spring(&self, phi: f64) -> Option<(f64, f64)> {
        let weight = self.values[0];
        let slope = match self.kind {
            Kind::Backlash => {
                let gap = self.values[1];
                0.5 * ((phi - gap).signum() - (phi + gap).signum())
            }
            Kind::AsymmetricStiffness => 2.0 * phi,
            Kind::HigherOrderStiffness => {
                let power = self.values[1] as i32;
                f64::from(power) * phi.powi(power - 1)
            }
            _ => return None,
        };
        let torque = self.torque(&Coordinates { deflection: phi, ..Coordinates::default() });
        Some((torque, weight * slope))
    }
}

/// Carry the state z of one element with memory over a displacement increment.
///
/// dz/dx = 1 − |z|ⁿ (β sgn(u z) + 1 − β), |z| ≤ 1, with u = dx/d. n = 1, β = 1 is Dahl's law, n ≥ 1, β = 0.5
/// is Bouc-Wen's. With y = z sgn(u) the law is dy/d|u| = (1 − y) k(y); k is taken at the middle of the step,
/// so Dahl's law is exact for any increment.
#[must_use]
pub fn advance(state: f64, increment: f64, exponent: f64, shape: f64) -> f64 {
    let (sign, u) = (1f64.copysign(increment), increment.abs());
    let y = state * sign;
    if exponent >= STOP_EXPONENT {
        let y = y + u;
        return 0.5 * sign * (1.0 + y - (1.0 - y).abs());
    }
    let rate = |y: f64, gap: f64| {
        let slope = 1.0 - y.abs().powf(exponent - 1.0) * (shape * y + (1.0 - shape) * y.abs());
        slope / (gap + 1e-12)
    };
    let gap = 1.0 - y;
    let middle = 1.0 - gap * (-0.5 * u * rate(y, gap)).exp();
    sign * (1.0 - gap * (-u * rate(middle, 1.0 - middle)).exp())
}

/// The elements at one place, with their memories.
#[derive(Clone, Debug, Default)]
pub struct Sum {
    elements: Vec<(Element, f64)>,
}

impl Sum {
    /// Nothing remembered.
    pub fn reset(&mut self) {
        self.elements.iter_mut().for_each(|(_, state)| *state = 0.0);
    }

    /// Whether there is any.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.elements.is_empty()
    }

    /// x at these coordinates, one period after the last ones; 0 where they are absurd or not finite.
    pub fn torque(&mut self, c: &Coordinates, period_s: f64) -> f64 {
        if self.elements.is_empty() || !c.sane() {
            return 0.0;
        }
        let mut total = 0.0;
        for (element, state) in &mut self.elements {
            if !element.kind.remembers() {
                total += element.torque(c);
                continue;
            }
            let rate = if element.kind == Kind::Hysteresis { c.deflection_rate } else { c.velocity };
            let [torque, displacement, exponent, shape] = element.values;
            *state = advance(*state, rate * period_s / displacement, exponent, shape);
            total += torque * *state;
        }
        total
    }
}

/// The effects of one motor and its transmission.
#[derive(Clone, Debug, Default)]
pub struct MotorEffects {
    /// x_motor.
    pub motor: Sum,
    /// x_transmission.
    pub transmission: Sum,
    drive: Vec<Element>,
    springs: Vec<Element>,
    /// The offset between the encoders, rad.
    pub offset: f64,
    delay: f64,
}

impl MotorEffects {
    /// Sorted by where they act.
    ///
    /// # Errors
    /// One belongs to the link.
    pub fn new(elements: &[Element]) -> Result<MotorEffects, Error> {
        let mut sorted = MotorEffects::default();
        for element in elements {
            let kind = element.kind;
            if kind.on_link() {
                return Err(Error(format!("effect \"{}\": expected it under [[link.effect]]", kind.name())));
            }
            match kind.place() {
                Place::Drive => sorted.drive.push(*element),
                Place::Channels if kind == Kind::DeflectionOffset => sorted.offset += element.values[0],
                Place::Channels => sorted.delay += element.values[0],
                Place::Transmission => sorted.transmission.elements.push((*element, 0.0)),
                _ => sorted.motor.elements.push((*element, 0.0)),
            }
            if element.spring(0.0).is_some() {
                sorted.springs.push(*element);
            }
        }
        Ok(sorted)
    }

    /// Whether a torque has to be formed at all.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.motor.is_empty() && self.transmission.is_empty()
    }

    /// x_motor and x_transmission of eq 5.
    pub fn balance(&mut self, c: &Coordinates, period_s: f64) -> (f64, f64) {
        (self.motor.torque(c, period_s), self.transmission.torque(c, period_s))
    }

    /// (torque, stiffness) of what depends on the deflection alone: part of what the transmission transmits.
    #[must_use]
    pub fn spring(&self, phi: f64) -> (f64, f64) {
        self.springs
            .iter()
            .filter_map(|element| element.spring(phi))
            .fold((0.0, 0.0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }
}

/// What makes a sample one of perfect sensors.
#[derive(Clone, Debug)]
pub struct Corrections {
    period: f64,
    active: bool,
    reading: Vec<Element>,
    drive: [Vec<Element>; MOTORS],
    offset: [f64; MOTORS],
    // The torque acts its delay later than reported, the link position is read late: with the largest of
    // these delays as common, motor positions wait that long, the rest what is left of it. In periods.
    delayed: bool,
    motor: f64,
    link: f64,
    torque: [f64; MOTORS],
    first: Option<u64>,
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
        let (mut reading, mut encoder_delay) = (Vec::new(), 0.0);
        for element in link {
            if !element.kind.on_link() {
                let name = element.kind.name();
                return Err(Error(format!("effect \"{name}\": expected it under [[motor.effect]]")));
            }
            match element.kind.place() {
                Place::Reading => reading.push(*element),
                Place::Channels => encoder_delay += element.values[0],
                _ => {}
            }
        }
        let (mut drive, mut offset, mut delays): ([Vec<Element>; MOTORS], _, _) =
            (Default::default(), [0.0; MOTORS], [0.0; MOTORS]);
        for (i, motor) in motors.iter().enumerate() {
            drive[i].clone_from(&motor.drive);
            offset[i] = motor.offset;
            delays[i] = motor.delay;
        }
        let common = delays.iter().fold(encoder_delay.max(0.0), |latest, delay| latest.max(-delay));
        let torque = delays.map(|delay| (common + delay) / period_s);
        let (motor, late) = (common / period_s, (common - encoder_delay) / period_s);
        let longest = torque.iter().fold(motor.max(late), |a, b| a.max(*b));
        let delayed = encoder_delay != 0.0 || delays.iter().any(|delay| *delay != 0.0);
        let nothing = Sample {
            sequence: 0,
            motor_position: [f64::NAN; MOTORS],
            motor_velocity: [f64::NAN; MOTORS],
            motor_torque: [f64::NAN; MOTORS],
            link_position: f64::NAN,
            link_velocity: f64::NAN,
            external_torque: f64::NAN,
        };
        Ok(Corrections {
            period: period_s,
            active: !link.is_empty()
                || motors.iter().any(|m| !m.drive.is_empty() || m.offset != 0.0 || m.delay != 0.0),
            reading,
            drive,
            offset,
            delayed,
            motor,
            link: late,
            torque,
            first: None,
            past: vec![nothing; longest as usize + 2],
            newest: 0,
            known: 0,
        })
    }

    /// Forget delayed samples and the time since the start.
    pub fn reset(&mut self) {
        self.first = None;
        self.known = 0;
    }

    /// The sample as perfect sensors would have given it.
    pub fn correct(&mut self, sample: &Sample) -> Sample {
        if !self.active {
            return *sample;
        }
        let first = *self.first.get_or_insert(sample.sequence);
        let mut out = if self.delayed { self.delay(sample) } else { *sample };
        let read = out.link_position;
        if !self.reading.is_empty() && read.abs() < ABSURD {
            out.link_position = read - self.error(read - self.error(read));
        }
        let time = sample.sequence.wrapping_sub(first) as f64 * self.period;
        for (i, elements) in self.drive.iter().enumerate() {
            let torque = out.motor_torque[i];
            if torque.abs() < ABSURD {
                let c = Coordinates { torque, time, ..Coordinates::default() };
                out.motor_torque[i] = torque - elements.iter().map(|e| e.torque(&c)).sum::<f64>();
            }
            out.motor_position[i] += self.offset[i];
        }
        out
    }

    fn error(&self, link_position: f64) -> f64 {
        let c = Coordinates { link_position, ..Coordinates::default() };
        self.reading.iter().map(|element| element.torque(&c)).sum()
    }

    fn delay(&mut self, sample: &Sample) -> Sample {
        self.newest = (self.newest + 1) % self.past.len();
        self.past[self.newest] = *sample;
        self.known = (self.known + 1).min(self.past.len());
        let mut out = *sample;
        let (a, b, share) = self.at(sample.sequence, self.motor);
        let mix = |old: f64, new: f64, share: f64| if share == 0.0 { old } else { old + share * (new - old) };
        for i in 0..MOTORS {
            out.motor_position[i] = mix(a.motor_position[i], b.motor_position[i], share);
            out.motor_velocity[i] = mix(a.motor_velocity[i], b.motor_velocity[i], share);
        }
        out.external_torque = mix(a.external_torque, b.external_torque, share);
        for i in 0..MOTORS {
            let (a, b, share) = self.at(sample.sequence, self.torque[i]);
            out.motor_torque[i] = mix(a.motor_torque[i], b.motor_torque[i], share);
        }
        let (a, b, share) = self.at(sample.sequence, self.link);
        out.link_position = mix(a.link_position, b.link_position, share);
        out.link_velocity = mix(a.link_velocity, b.link_velocity, share);
        out
    }

    /// The samples around a time so many periods ago, and the share of the newer one.
    fn at(&self, now: u64, periods: f64) -> (&Sample, &Sample, f64) {
        let mut newer = &self.past[self.newest];
        for k in 0..self.known {
            let older = &self.past[(self.newest + self.past.len() - k) % self.past.len()];
            let age = now.wrapping_sub(older.sequence) as f64;
            if age >= periods {
                let span = newer.sequence.wrapping_sub(older.sequence) as f64;
                let share = if span > 0.0 { (age - periods) / span } else { 0.0 };
                return (older, newer, share);
            }
            newer = older;
        }
        (newer, newer, 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dahl_friction_is_exact_for_any_increment() {
        assert!((advance(0.2, 3.0, 1.0, 1.0) - (1.0 - 0.8 * (-3f64).exp())).abs() < 1e-9);
        assert!((advance(0.4, -0.3, 80.0, 1.0) - 0.1).abs() < 1e-12);
        assert!((advance(0.4, 5.0, 80.0, 1.0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn springs_have_the_slope_of_their_torque() {
        let elements = [
            Element::new("backlash", &[30.0, 0.05]),
            Element::new("asymmetric_stiffness", &[4.0]),
            Element::new("higher_order_stiffness", &[7.0, 5.0]),
        ];
        for element in elements.map(Result::unwrap) {
            for phi in [-0.2, -0.02, 0.03, 0.3] {
                let h = 1e-6;
                let torque = |phi: f64| element.spring(phi).unwrap().0;
                let slope = (torque(phi + h) - torque(phi - h)) / (2.0 * h);
                assert!((element.spring(phi).unwrap().1 - slope).abs() < 1e-6 * slope.abs().max(1.0));
            }
        }
    }

    #[test]
    fn a_wrong_number_of_values_is_one_line() {
        let error = Element::new("cogging", &[1.0]).unwrap_err();
        assert_eq!(error.to_string(), "effect \"cogging\": expected 3 values, got 1");
    }
}
