"""Choices that are neither physics nor priors: one table with reasons for both languages.

Those that the on-line estimator makes too are written in `estimator/core/src/choices.rs`; priors are in
`estimator.priors`. `python benchmarks/constants.py` halves and doubles each entry of all three.
"""

import math
from statistics import NormalDist
from typing import NamedTuple

from estimator import _core


class Choice(NamedTuple):
    """A chosen number."""

    value: float  # in its unit
    unit: str  # "" for a plain number
    meaning: str  # what it sets
    reason: str  # why this much


ON_LINE = {row[0].lower(): Choice(*row[1:]) for row in _core.CHOICES}
CHOICES: dict[str, Choice] = {
    **ON_LINE,
    # How a recording becomes rows.
    "harmonics": Choice(
        4.0, "", "bandwidth of what repeats, over its frequency", "friction has harmonics to there"
    ),
    "skirt": Choice(
        0.5, "bandwidths", "beyond the bandwidth before a low-pass hides all", "there it leaves 4 %"
    ),
    "edge": Choice(
        3.0, "periods of the bandwidth", "left out at ends and gaps",
        "what is beyond the ends comes through the filter with exp(-2 pi sin(pi/16) t): 2.5 % after three",
    ),
    "bridged": Choice(3, "periods", "longest gap that a line bridges", "short of the motion's own bends"),
    "order": Choice(8, "", "order of the low-pass's magnitude", "steep; its ringing ends within the edge"),
    "tail": Choice(
        0.6, "Nyquist frequencies", "above it a spectrum is noise", "drives filter below half their rate"
    ),
    # The bandwidth, where it is not given.
    "content": Choice(0.98, "", "share of the torque's power that is the motion", "all but the noise"),
    "least_bandwidth": Choice(12.0, "Hz", "asked for at least", "slow motions have sharp friction too"),
    "most_bandwidth": Choice(25.0, "Hz", "asked for at most", "above it joints have modes of their own"),
    "narrowest": Choice(4.0, "Hz", "bandwidth at least, whatever the noise", "below it nothing is known"),
    # Models and their errors.
    "law": Choice(
        0.08, "torque of an effect", "error of any textbook law", "friction, play and slip differ by so much"
    ),
    "memory": Choice(
        60, "rows", "longest correlation of errors", "20 periods: what repeats with the motion is none"
    ),
    "least_scale": Choice(
        0.05, "", "torque scale that ends its linearisation", "twenty times off is no scale error"
    ),
    "newton_steps": Choice(20, "", "of a hypothesis that is kept, at most", "three are usual"),
    "rough_steps": Choice(3, "", "of hypotheses that are compared", "what they still gain decides nothing"),
    "converged": Choice(0.02, "standard deviations", "step that ends the iteration", "small beside one"),
    "fit_periods": Choice(
        30, "periods of the bandwidth", "in a recording, at least", "five rows for each parameter"
    ),
    # Which effects are tried.
    "ripple_periods": Choice(
        2.0, "periods", "of a ripple in the range of motion, at least", "fewer are a bend"
    ),
    "ripples_each": Choice(3, "", "ripples of one kind at one motor", "once and twice a turn, and the teeth"),
    "ripples": Choice(900, "", "frequencies of a ripple at most", "time; a gear has fewer"),
    "smoothing": Choice(
        0.05, "largest velocity", "over which a sign may change, at most", "smoother, it is damping"
    ),
    "slips": Choice(
        0.25, "range of motion", "of a law with memory at most", "it slips both ways; else a spring"
    ),
    "softer": Choice(5.0, "", "step of the grid of smoothings", "a sign changes as sharply or not"),
    "beam": Choice(3, "hypotheses", "grown at once", "enough for an imitation beside the true effect"),
    "tried": Choice(8, "effects", "tried beside each", "the families of friction and ripple have six"),
    # Verdicts.
    "groups": Choice(
        10, "", "stretches of time, kinds of motion, knots over time", "more say less each, fewer are unsure"
    ),
    "moderation": Choice(
        4.0, "groups", "that the variance of rows as independent as they look counts for",
        "it is right within a factor of three: chi-squared of four degrees of freedom",
    ),
    "bootstraps": Choice(200, "", "of the blocks that weigh models", "probabilities to a few per cent"),
    "curve": Choice(
        0.6, "what names leave", "left by a free curve reported instead", "else a name says more"
    ),
    "harm": Choice(
        0.05, "error", "that a written model may leave beyond the declared one's",
        "what is held out differs from the rest by more",
    ),
    "unseen": Choice(
        0.25, "recording", "held out to see what a written model does", "most of it is to make the model"
    ),
    "horizon": Choice(
        1.0, "s", "of a free run that judges a model", "without position control a longer one drifts"
    ),
    "one_sine": Choice(
        1.08, "spectral lines", "of a motion that separates nothing", "one, and what its window leaks"
    ),
    # The motion to record next.
    "motion_rivals": Choice(6, "models", "told apart by a motion, at most", "pairs of them are fitted: time"),
    "motion_uneven": Choice(
        0.7, "", "logarithm by which a sine is faster or slower than others, at most",
        "twice or half: what nobody thought of shows too",
    ),
    "motion_begin": Choice(
        0.02, "of its end", "how slowly a motion begins, at least",
        "friction shows in slow ones, springs in fast ones",
    ),
    "motion_taper": Choice(
        0.08, "of the length", "in which a motion sets out, and in which it comes back", "a second of twelve"
    ),
    "motion_smoothing": Choice(0.05, "s", "of a motion whose reach is a limit", "shorter than its bends"),
    "motion_margin": Choice(0.95, "torque's limit", "that a motion needs", "no drive follows exactly"),
    "least_link": Choice(0.01, "motor's inertia", "of an undeclared link, at least", "it is above 0"),
    # Curves.
    "points": Choice(
        20, "", "that resolve a range: of a coordinate, of a parameter that is searched",
        "a bump of a twentieth of the range; an octave in four steps",
    ),
    "curve_width": Choice(3.0, "effect's prior", "prior of a curve's coefficients", "they share the torque"),
    # The gate: whether a recording is usable.
    "samples": Choice(300, "", "in a recording at least", "a few for each of the balance's columns"),
    "gaps": Choice(0.2, "samples", "that may be missing", "more is no gap but another sampling rate"),
    # The gate: the balance under a hypothesis about units and signs.
    "falloff": Choice(2, "", "order of its filters beyond their two derivatives", "noise falls off with it"),
    "bands": Choice(5, "", "each with an error of its own", "friction is slow, inertia is fast"),
    "band_ratio": Choice(3.0, "", "of neighbouring bandwidths", "an octave and a half"),
    "band_noise": Choice(
        0.1, "acceleration power", "in the widest band that may be noise", "it biases the inertia by as much"
    ),
    "pieces": Choice(8, "", "straight ones of the spring's curve", "a hardening spring is a parabola to 1 %"),
    "gate_rows": Choice(2000, "", "of each band", "more add nothing about scales"),
    "gate_floor": Choice(0.01, "torque rms", "error of any balance", "models of this kind close no better"),
    "independent": Choice(
        30.0, "samples", "that a band counts for at most", "errors repeat in every period of a motion"
    ),
    "unexplained": Choice(0.8, "torque rms", "left at most by a finding", "it has to explain something"),
    "halved": Choice(0.5, "squared error", "left by a finding that is told by it", "most of it is explained"),
    # The gate: what installations and joints are like.
    "fault": Choice(4.0, "nats", "against each fault", "one installation in fifty has it"),
    "free_ratio": Choice(
        6.0, "nats", "more against a gear ratio that is fitted", "decades at a few per cent of resolution"
    ),
    "free_inertia": Choice(
        2.7, "nats", "more against a declared inertia that is off by any factor", "within 2.5, of six decades"
    ),
    "declared_factor": Choice(
        3.0, "", "by which a declared number is off at most", "more is a rotor's inertia, a gear or a unit"
    ),
    "rigid": Choice(
        8.0, "samples", "weight of the deflection's size", "transmissions deflect little against the motion"
    ),
    "usual_acceleration": Choice(30.0, "rad/s²", "rms torque over inertia", "from robots to small drives"),
    "usual_frequency": Choice(10.0, "Hz", "of a motor on its spring", "from soft actuators to stiff gears"),
    "usual_period": Choice(0.003, "s", "of sampling", "from 1 kHz to 100 Hz"),
    "usual_factor": Choice(
        8.0, "", "standard deviation of the three, and of arcs beyond a turn", "none decides alone"
    ),
}  # fmt: skip


def choice(name: str) -> float:
    """Return that number."""
    return CHOICES[name].value


def whole(name: str) -> int:
    """Return that number as an integer."""
    return max(1, round(CHOICES[name].value))


def least_rows() -> int:
    """Return the fewest rows of a recording: two in each period of the bandwidth."""
    return 2 * whole("fit_periods")


def rate() -> float:
    """Return samples behind a low-pass in each period of its bandwidth: Nyquist's two up to
    the end of its skirt.
    """
    return 2.0 * (1.0 + choice("skirt"))


def chance() -> float:
    """Return the probability that a correct reading is `sure` standard deviations or more off."""
    return 2.0 * NormalDist().cdf(-choice("sure"))


def log_odds(probability: float) -> float:
    """Return the logarithm of the odds, in nats."""
    return math.log(probability / (1.0 - probability))
