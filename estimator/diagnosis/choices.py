"""Choices of a diagnosis that are neither physics nor priors: one table with reasons.

Priors are in `estimator.priors`. `python benchmarks/constants.py` halves
and doubles each entry of both.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["CHOICES", "Choice", "choice", "least_rows", "whole"]


class Choice(NamedTuple):
    """A chosen number.

    Attributes:
        value: in its unit.
        unit: "" for a plain number.
        meaning: what it sets.
        reason: why this much.
    """

    value: float
    unit: str
    meaning: str
    reason: str


CHOICES: dict[str, Choice] = {
    # How a recording becomes rows.
    "light": Choice(
        4.0, "bandwidths", "bandwidth of the coordinates over the rows'", "friction has harmonics to there"
    ),
    "grid": Choice(
        14.0, "1/period of the bandwidth", "rate of the coordinates", "above twice that of the light filter"
    ),
    "rows": Choice(
        3.0, "1/period of the bandwidth", "rate of the rows", "Nyquist's two, and the filter's skirt"
    ),
    "long": Choice(
        90_000, "points", "grid beyond which it gets coarser", "memory: ten minutes at full rate"
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
    "wider": Choice(4.0, "", "bandwidth over the frequency of that content", "effects have harmonics"),
    "least_bandwidth": Choice(12.0, "Hz", "asked for at least", "slow motions have sharp friction too"),
    "most_bandwidth": Choice(25.0, "Hz", "asked for at most", "above it joints have modes of their own"),
    "sampled": Choice(0.2, "sampling rates", "bandwidth at most", "five samples in a period"),
    "narrowing": Choice(0.75, "", "step by which it is narrowed", "noise halves, with two derivatives"),
    "narrowest": Choice(4.0, "Hz", "bandwidth at least, whatever the noise", "below it nothing is known"),
    # Models and their errors.
    "floor": Choice(0.002, "torque rms", "error that no model gets below", "filters, sampling and rounding"),
    "exact": Choice(
        0.0005, "torque rms", "the same of a healthy joint", "filters and sampling leave 0.03 % of exact data"
    ),
    "law": Choice(
        0.08, "torque of an effect", "error of any textbook law", "friction, play and slip differ by so much"
    ),
    "memory": Choice(
        60, "rows", "longest correlation of errors", "20 periods: what repeats with the motion is none"
    ),
    "least_scale": Choice(
        0.05, "", "torque scale that ends its linearisation", "twenty times off is no scale error"
    ),
    "newton_steps": Choice(6, "", "of a hypothesis that is kept", "three are usual"),
    "rough_steps": Choice(3, "", "of hypotheses that are compared", "what they still gain decides nothing"),
    "converged": Choice(0.02, "standard deviations", "step that ends the iteration", "small beside one"),
    "patient_steps": Choice(
        20, "", "of a healthy joint's fit", "it starts from springs and readings that nobody knows"
    ),
    "fit_periods": Choice(
        30, "periods of the bandwidth", "in a recording, at least", "five rows for each parameter"
    ),
    "sign_noise": Choice(
        5.0, "velocity noise", "over which everyday friction changes its sign", "no row sees it sharper"
    ),
    "shapes": Choice(25, "points", "start of a spring's shape parameter", "an octave in four steps"),
    # Which effects are tried.
    "ripple_periods": Choice(
        2.0, "periods", "of a ripple in the range of motion, at least", "fewer are a bend"
    ),
    "ripples": Choice(900, "", "frequencies of a ripple at most", "time; a gear has fewer"),
    "smoothing": Choice(
        0.05, "largest velocity", "over which a sign may change, at most", "smoother, it is damping"
    ),
    "softer": Choice(5.0, "", "step of the grid of smoothings", "a sign changes as sharply or not"),
    "beam": Choice(3, "hypotheses", "grown at once", "enough for an imitation beside the true effect"),
    "tried": Choice(8, "effects", "tried beside each", "the families of friction and ripple have six"),
    "effects": Choice(5, "effects", "at most", "a joint with more is declared wrongly"),
    # Verdicts.
    "even": Choice(0.05, "probability", "at which another account is an alternative", "one in twenty"),
    "sure": Choice(3.0, "standard deviations", "at which a reading's error is reported", "one in 400"),
    "groups": Choice(
        10, "", "stretches of time, kinds of motion, knots over time", "more say less each, fewer are unsure"
    ),
    "moderation": Choice(
        4.0, "groups", "that the variance of rows as independent as they look counts for",
        "it is right within a factor of three: chi-squared of four degrees of freedom",
    ),
    "held": Choice(3, "in ten groups", "held out of a single recording", "a quarter"),
    "far": Choice(
        10.0, "floor", "what names leave at which something unnamed is missing", "an order of magnitude"
    ),
    "curve": Choice(
        0.6, "what names leave", "left by a free curve reported instead", "else a name says more"
    ),
    "one_sine": Choice(
        1.08, "spectral lines", "of a motion that separates nothing", "one, and what its window leaks"
    ),
    # Free curves.
    "knots": Choice(20, "", "of a spline over one coordinate", "a bump of a twentieth of the range"),
    "harmonics": Choice(15, "", "of a line in time at most", "a push that is short in its period"),
    "curve_width": Choice(3.0, "effect's prior", "prior of a curve's coefficients", "they share the torque"),
}  # fmt: skip


def choice(name: str) -> float:
    """That number."""
    return CHOICES[name].value


def whole(name: str) -> int:
    """That number as an integer."""
    return max(1, round(CHOICES[name].value))


def least_rows() -> int:
    """Fewest rows of a recording: two in each period of the bandwidth."""
    return 2 * whole("fit_periods")
