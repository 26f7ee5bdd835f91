"""Says in sentences what a diagnosis found."""

from drivelink.output.numbers import Units, number
from estimator.diagnosis import Curve, Diagnosis, Finding, advice_for
from estimator.effects import in_words
from estimator.reasons import percent

# probabilities at which an effect is missing, and at which it has a name
SURE, _LIKELY = 0.9, 0.3


def free_curve(outcome: Diagnosis) -> Curve | None:
    """Return the curve of what the library does not have, if it was fitted."""
    return next((c for c in outcome.curves if c.name == "unlisted"), None)


def sentence(outcome: Diagnosis) -> str:
    """Return the verdict in one sentence."""
    error, held = "the torque balance's error on held-out data", outcome.validation
    lower = held.after_rms_nm < held.before_rms_nm
    fall = f"{error} falls from {percent(held.before_relative, 2)} to {percent(held.after_relative, 2)}"
    if outcome.verdict == "effect":
        return f"{lacks(outcome)}: {fall}."
    names = " and ".join(title_of(finding, outcome) for finding in outcome.effects)
    if outcome.verdict == "unexplained":
        where = outcome.effects[0]
        over = " and ".join(name.replace("_", " ") for name in where.coordinates)
        by = "a free curve" if free_curve(outcome) else "what was tried"
        if lower:
            what = f"something at {_at(where, outcome)} that is not in the library, a function of {over}"
            return f"The model lacks {what}: with {by} {fall}."
        left = percent(outcome.train.before_relative, 2)
        return (
            f"The model lacks something at {_at(where, outcome)} in the data that were fitted, {left} of "
            f"their torque, but {by} over {over} does not lower {error}, {percent(held.before_relative, 2)}: "
            "it may be in the former alone."
        )
    if outcome.verdict == "insufficient_excitation":
        said = f" (it might be {names})" if names else ""
        return f"The motion does not reveal what could be missing{said}: record a richer one."
    left = percent(outcome.validation.after_relative, 2)
    return f"The model is sufficient: what it leaves, {left} of the torque, belongs to no effect."


def lacks(outcome: Diagnosis) -> str:
    """Return what is missing, said as surely as it is known."""
    sure = [title_of(f, outcome) for f in outcome.effects if f.probability >= SURE]
    likely = [_likely(f, outcome) for f in outcome.effects if _LIKELY <= f.probability < SURE]
    nameless = [f for f in outcome.effects if f.probability < _LIKELY]
    unsure = sorted({_at(f, outcome) for f in nameless})
    said = []
    if sure:
        said.append(f"The model lacks {' and '.join(sure)}")
    if likely:
        said.append(f"most likely {'' if sure else 'the model lacks '}{' and '.join(likely)}")
    if unsure:
        about = (line for f in nameless for line in advice_for(f.name, f.alternatives))
        to_do = next(about, "record another motion, faster, slower and wider")
        said.append(f"something at {' and '.join(unsure)} has no likely name yet ({to_do})")
    text = "; ".join(said)
    return text[0].upper() + text[1:]


def _likely(finding: Finding, outcome: Diagnosis) -> str:
    """Return a likely effect and what else it may be; one of several, where another is no less likely."""
    own = f"{title_of(finding, outcome)} ({finding.probability:.2f})"
    if not finding.alternatives:
        return own
    behind = round(max(finding.alternative_probabilities), 2) < round(finding.probability, 2)
    return f"{own}, else {others_of(finding)}" if behind else f"one of {own}, {others_of(finding)}"


def unexplained(outcome: Diagnosis, units: Units | None = None) -> str:
    """Return the remaining error in one sentence."""
    unit = (units or Units(False)).shown("N·m")
    left = outcome.validation
    share = percent(left.after_relative, 2)
    text = f"{share} of the torque ({number(left.after_rms_nm, 3)} {unit} rms) stays unexplained"
    if outcome.verdict == "unexplained":
        free = " even with a free curve, which has no name in the library" if free_curve(outcome) else ""
        return f"{text}{free}."
    if outcome.verdict == "insufficient_excitation":
        return f"{text}; this motion does not reveal whether anything is missing."
    return f"{text}: noise, or effects too small to be separated from it in these data."


def title_of(finding: Finding, outcome: Diagnosis) -> str:
    """Return an effect in words, with its place."""
    if finding.name == "unlisted":
        return f"an unlisted effect at {_at(finding, outcome)}"
    return f"{in_words(finding.name)} ({_place(finding, outcome)})"


def others_of(finding: Finding) -> str:
    """Return the alternatives of an effect, with their probabilities."""
    pairs = zip(finding.alternatives, finding.alternative_probabilities, strict=True)
    return ", ".join(f"{in_words(name)} ({p:.2f})" for name, p in pairs)


def _place(finding: Finding, outcome: Diagnosis) -> str:
    """Return its location, with the motor's number where there are two."""
    several = len(outcome.transmissions) > 1 and finding.motor is not None
    return f"{finding.location} {(finding.motor or 0) + 1}" if several else finding.location


def _at(finding: Finding, outcome: Diagnosis) -> str:
    """Return its location after "at"."""
    place = _place(finding, outcome)
    return place if place[-1].isdigit() else f"the {place}"
