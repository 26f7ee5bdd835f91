//! Choices of the on-line estimator that are neither physics nor priors: one table, with reasons.
//!
//! `estimator.choices` has it beside its own; `python benchmarks/constants.py` halves and doubles each entry of both.

/// A chosen number.
#[derive(Clone, Copy, Debug)]
pub struct Choice {
    /// Its name.
    pub name: &'static str,
    /// In its unit.
    pub value: f64,
    /// Empty for a plain number.
    pub unit: &'static str,
    /// What it sets.
    pub meaning: &'static str,
    /// Why this much.
    pub reason: &'static str,
}

macro_rules! choices {
    ($($name:ident: $kind:ty = $value:literal, $unit:literal, $meaning:literal, $reason:literal;)*) => {
        $(#[doc = concat!($meaning, ": ", $reason)] pub const $name: $kind = $value;)*

        /// All of them.
        pub const TABLE: &[Choice] = &[$(Choice {
            name: stringify!($name),
            value: $value as f64,
            unit: $unit,
            meaning: $meaning,
            reason: $reason,
        }),*];
    };
}

choices! {
    // Time.
    BLOCK_S: f64 = 0.25, "s", "motion in a block", "longer than the filters' memory: blocks are nearly independent";
    BLOCKS: usize = 100, "blocks", "that are remembered", "25 s: what a joint's temperature and load leave as they are";
    FEWEST: usize = 8, "blocks", "before one is held against the others, and of those that wait", "two seconds of motion";
    CONVINCING: usize = 2, "blocks", "in a row that end a doubt", "one may have had little motion";
    LOOK_S: f64 = 0.03, "s", "between two looks at the motion, and over which rows are held against what is known", "the filters' memory";
    BRIEF_S: f64 = 0.02, "s", "of readings that are left out, stand still or make a contact", "motion goes on as it was";
    GAP_S: f64 = 0.025, "s", "longest gap that is bridged", "a motion of 3 Hz turns by half a radian";
    AHEAD_S: f64 = 0.05, "s", "over which a motion is foreseen, and unmodelled torques last", "a sixth of a period of 3 Hz";
    SAID_S: f64 = 0.5, "s", "for which it is said what was wrong", "two status documents";
    MEAN_S: f64 = 0.3, "s", "over which mean squares of a motion are taken", "a period of a usual motion";
    NOISE_S: f64 = 2.0, "s", "over which noise, jumps and standing still are learned", "several periods of it";
    PEAK_S: f64 = 60.0, "s", "for which the largest motion and torque are remembered", "a pause is shorter";
    SLOW_S: f64 = 10.0, "s", "over which torques are compared", "several periods of a slow motion";
    USUAL_S: f64 = 600.0, "s", "for which the torque of the last motion is remembered", "a joint that stands is judged by it";
    PATIENCE: u32 = 8, "samples", "before a place is believed", "a burst of bad ones is shorter";
    SETTLED: f64 = 4.5, "delays", "of a filter, after which a wrong start is forgotten", "it leaves a thousandth";
    // Filters.
    LIGHT: f64 = 5.0, "", "bandwidth of the light filter over that of the main one", "it bends no motion, and hides counts";
    PLAIN: f64 = 3.0, "", "bandwidth of a deflection's plain filter over that", "a start is forgotten before rows are learned";
    SLOWEST: f64 = 0.5, "", "least bandwidth of the deflection's filter over that", "slower, it lags behind the regression";
    BRIDGED: f64 = 0.4, "rad", "that a filter turns by in a gap that is learned from", "a straight line loses 1 % of the motion";
    LATEST: f64 = 0.4, "periods", "by which a sample may be late", "half a period is another sample";
    STIFF: f64 = 0.3, "", "K T²/B above which the motor's equation is not integrated", "explicit steps are stable to 1";
    DAMPED: f64 = 1.0, "", "(D + D_e) T/B from which it is not either", "from there on explicit steps alternate";
    HIDDEN: f64 = 8.0, "", "of the square of φ‴, over what the main filter shows", "it hides so much at its bandwidth";
    // Noise and errors of the model.
    SURE: f64 = 3.0, "standard deviations", "at which an error is one", "one in 400";
    CLEAR: f64 = 5.0, "", "a rate over its noise that is motion", "noise is then a 25th of its power";
    EXACT: f64 = 3e-4, "torque", "error of a true model", "filters, sampling and rounding leave 0.03 %";
    FLOOR: f64 = 0.002, "torque", "error that no declared model gets below", "the same, and parameters as they are written";
    EARLY: f64 = 0.005, "torque", "noise of rows before any has shown it", "drives know their torque to this";
    TAILS: f64 = 8.0, "degrees of freedom", "of a block's noise", "it varies within a factor of two";
    UNLIKE: f64 = 0.05, "torque of friction, memory and free curve", "error of their laws that nobody declared", "no joint's are quite of our shapes";
    ALIKE: f64 = 0.3, "", "share of a missing effect's errors that all blocks have", "0 is noise, 1 one motion again and again";
    LINK_FLOOR: f64 = 0.001, "torque carried", "error of the curve when the link is identified", "no curve is known better";
    USEFUL: f64 = 0.2, "torque", "left at most by a curve that is used", "a spring carries most of what it explains";
    MOTION: f64 = 0.35, "", "standard deviation of ln(residual²) between two motions", "errors depend on the motion";
    DRIFT: f64 = 1e-4, "1/s", "growth of a stiffness' relative deviation without motion", "temperatures change in minutes";
    DRIFTED: f64 = 0.02, "", "of that at most, and of a spring that is carried over", "a joint does not change more by standing";
    // Doubt.
    EVEN: f64 = 0.05, "probability", "below which another explanation does not count", "one in twenty";
    ACCUSED: f64 = 1000.0, "", "odds at which what is declared is called wrong", "one in 1000";
    UNUSUAL: f64 = 3.0, "", "times what was explained before, that is unusual", "friction comes in bursts";
    FAR: f64 = 10.0, "", "times what has been seen that is no measurement", "an order of magnitude";
    REST: f64 = 0.03, "", "share of what is left without a cause, that the right one may leave", "an effect that bends with the change";
    // Range.
    GROWN: f64 = 1.5, "", "times the range seen that a curve is used over", "beyond it, powers say nothing";
    MARGIN: f64 = 1.02, "", "times the range seen that a law is projected on", "the next motion is a little larger";
    REACHED: f64 = 0.98, "", "of where a law ends", "its slope is finite there";
    SLOW: f64 = 0.02, "largest velocity", "over which dry friction changes its sign, and below which nothing is learned", "Stribeck speeds are faster";
    JUMP_RAD: f64 = 1e-3, "rad", "smallest jump of a position", "acceleration moves a joint less in a period";
    LEVER_RAD: f64 = 0.02, "rad", "by which motor 2 of a serial joint makes another stiffness", "a lever of one radian changes it by 4 %";
    WILD_RAD_S2: f64 = 100.0, "rad/s²", "acceleration of the bare motor below which no torque is a surprise", "small drives reach it";
    TAUGHT_RAD2_S2: f64 = 1e-6, "rad²/s²", "mean square of φ′ from which eq 32 learns", "a count of 13 bits in a second";
    ONE_WAY: f64 = 0.9, "", "mean direction of a motion that goes one way", "less than a twentieth goes back";
    // Contact.
    TOUCH: f64 = 0.05, "torque carried", "least contact, where none is declared", "what bearings take";
    CAP: f64 = 2.0, "thresholds", "that a contact's sum may reach", "a long contact ends as soon as a short one";
}
