//! The columns of a row.

use crate::spring::{FIRST, TERMS};

/// F τ, N·m.
pub const TORQUE: usize = 0;
/// Its rate, N·m/s: a torque that is read late.
pub const TORQUE_RATE: usize = 1;
/// F θ″: the inertia, kg·m².
pub const ACCELERATION: usize = 2;
/// F θ′: the damping, N·m·s/rad.
pub const VELOCITY: usize = 3;
/// 1: a constant torque, N·m.
pub const OFFSET: usize = 4;
/// Sign of θ′: dry friction, N·m.
pub const DRY: usize = 5;
/// A softer sign of θ′: friction that grows with speed before it is full, N·m.
pub const SOFT: usize = 6;
/// |b₁| and |b₂| times the sign of θ′: friction of the load, N·m.
pub const LOAD: [usize; 2] = [7, 26];
/// −|u|: a spring that is stiffer to one side, N·m.
pub const UNEVEN: usize = 8;
/// −bₖ: the spring, N·m.
pub const SPRING: std::ops::Range<usize> = 9..9 + TERMS;
/// −bₖ′: a spring whose zero is elsewhere, N·m.
pub const SLOPE: std::ops::Range<usize> = 14..14 + TERMS;
/// −bₖ′ q′: a link position that is read late.
pub const LATE: std::ops::Range<usize> = 19..19 + TERMS;
/// −bₖ′ q, the first ones: a link position of another scale.
pub const READ: std::ops::Range<usize> = 24..24 + FIRST;
/// −(stops of three widths on u): memory of the transmission, N·m.
pub const STOPS: std::ops::Range<usize> = 27..30;
/// −(u clipped at four widths): a spring of any shape, N·m.
pub const CLIPS: std::ops::Range<usize> = 30..34;
/// −u |u|: a spring whose stiffness has a corner at zero, N·m.
pub const CORNER: usize = 34;
/// −bₖ′ sin q, the first ones: a link encoder that is eccentric.
pub const SINE: std::ops::Range<usize> = 35..35 + FIRST;
/// −bₖ′ cos q, likewise.
pub const COSINE: std::ops::Range<usize> = 37..37 + FIRST;
/// The torque's second derivative, N·m/s²: one that is read late by much.
pub const TORQUE_SECOND: usize = 39;
/// −q′: with θ′ the rate of the deflection, for a damping of the transmission.
pub const LINK_RATE: usize = 40;
/// The rate of the sign of θ′: dry friction that changes at another moment, N·m/s.
pub const DRY_RATE: usize = 41;

/// Functions of u, and θ″: their columns, those of their slopes, by what these are multiplied, and 0 or 1.
#[must_use]
pub fn slopes() -> [(usize, usize, f64, usize); TERMS + 2] {
    std::array::from_fn(|k| match k.checked_sub(TERMS) {
        None => (SPRING.start + k, SLOPE.start + k, 1.0, 0),
        Some(0) => (CORNER, UNEVEN, 2.0, 0),
        Some(_) => (ACCELERATION, OFFSET, 1.0, 1),
    })
}
