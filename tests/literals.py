"""Numbers of the estimator, in both languages, and what each of them is.

A choice that might be another number belongs into a table (`estimator.choices`, `estimator.priors`,
`core/src/choices.rs`), with unit and reason. What stands here is a property of mathematics, of a grid that is refined
afterwards, or of rounding.
"""

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

_PLAIN = {0.0, 0.25, 0.5, 0.75, 1.5, *map(float, range(11)), 12.0}  # counts, halves, exponents
_UNITS = {100.0, 1000.0, 3600.0}  # per cent, milli, seconds in an hour
_ROUNDING = 1e-6  # and less, or the inverse and more: keeps rounding or infinity from deciding
_FINITE = 700.0  # exponent that is still a number

OF_FILES = {
    "core/src/student.rs": "series of Student's quantile",
    "core/src/settings.rs": "defaults, each with its meaning and unit in estimator/settings.py",
    "core/src/causes.rs": "the table of causes: amplitudes' priors",
}
REASONS: dict[str, dict[str, str]] = {
    "diagnosis/law_parameters.py": {
        "0.9999 1.0001": "keeps a shape inside its open interval",
        "0.02 1.02 1.1 20.0": "ends of a grid of shapes that is refined afterwards",
        "1.001": "keeps the largest deflection inside the law's reach",
    },
    "diagnosis/candidates.py": {
        "0.04 0.8": "grid of velocities, shares of their rms",
        "0.0002 11.0": "grid of displacements over the range of motion",
        "0.9 0.05 0.95 0.96 0.99 0.01 0.4": "quantiles of what was measured",
        "20.0": "largest exponent that is told from a stop",
    },
    "diagnosis/regression.py": {
        "0.001": "relative change that ends an iteration",
        "0.0001": "likewise, of x",
    },
    "diagnosis/frame.py": {
        "0.45": "of the sampling rate: below half of it",
        "0.01": "quantile of the steps of a reading: one count",
    },
    "diagnosis/search.py": {"1.75": "last point of a grid of delays in octaves"},
    "diagnosis/design_matrix.py": {
        "0.001": "relative step of a difference",
        "0.7": "ln 2: factors of at most two",
    },
    "diagnosis/fourier.py": {"15.0 30.0 60.0": "quintic smooth step, its slope and bend"},
    "filters.py": {"14.0": "time constants until e^-14 is below 1e-6"},
    "gate/causes.py": {"1.3": "a factor this near to a unit's is that unit"},
    "gate/balance.py": {
        "0.002 0.998": "quantiles of what was measured",
        "20.0": "third differences of white noise have 20 times its variance",
        "60.0": "periods in a recording, at least",
    },
    "gate/usable.py": {"0.005": "share of values that change at most: a sensor that is silent"},
    "transmissions.py": {"41.0": "points at which a registered law is compared with its slope"},
    "core/src/sample.rs": {"15.0": "a bit of the status"},
    "core/src/signals.rs": {"6.4": "32/5: correlation time of white noise behind the filter"},
    "core/src/blocks.rs": {"0.98": "keeps the deflection inside the law's reach"},
    "core/src/blocks/solve.rs": {
        "0.0001": "share of the torque: the noise before the first block",
        "0.1": "standard deviations: a shape this near to its start has not moved",
        "0.02": "of the deflection: a zero that is known to this is found again",
    },
    "core/src/deflection.rs": {
        "0.1": "of the largest: an acceleration's change that is never thought to be smaller",
        "20.0": "fifth power of time over 20: variance of integrated white jerk",
    },
    "core/src/external/contact.rs": {"0.05 80.0": "grid of the reference value of a cumulative sum"},
    "core/src/laws.rs": {"0.001": "scale of a difference's step at zero"},
    "core/src/memory.rs": {"0.001": "slope that ends an integral over a stop"},
    "core/src/sample_validator/channels.rs": {
        "0.05 0.1 0.2": "forgetting of running means, and the share that is motion"
    },
}


NUMERIC = {
    "blocks/solve.rs WIDE": "a prior that says nothing",
    "external.rs MEMORY_S": "of others",
    "external.rs TINY": "keeps a division finite",
    "external/contact.rs OVERSHOOT": "of the literature",
    "external/contact.rs UNCORRELATED": "of the filter's correlation",
    "gram.rs PIVOT": "rounding of sums of products",
    "laws.rs EDGE": "keeps an arcsine finite",
    "laws.rs OVERFLOW": "exponent that is still a number",
    "laws.rs STEEPEST": "exponent that is still a number, of a spring",
    "laws.rs STEP": "of central differences: cube root of the rounding",
    "library.rs ABSURD": "one over the rounding",
    "memory.rs REVERSED": "full sliding the other way",
    "memory.rs SLIDING": "the rest is rounding",
    "memory.rs STOP_EXPONENT": "a stop but for 1 %",
    "memory.rs WIDTH": "of others",
    "model_monitor.rs WINDOW_S": "a second, as it is called",
    "noise.rs THIRD": "third differences of white noise have 20 times its variance",
    "paper.rs SIGMA_95": "quantile of the normal distribution",
    "sample_validator/channels.rs ROUNDING": "what arithmetic, or a text of ten digits, leaves of counts that cancel",
    "sample_validator/channels.rs FINEST": "no joint moves by a million counts in a period",
    "sample_validator/channels.rs MOVING": "a change in each of the last five samples is motion, one now and then none",
    "sample_validator/channels.rs SINGLE": "what single precision leaves of them",
    "spring.rs RIDGE": "keeps rounding from deciding between parallel functions",
    "unknowns/starts.rs NARROWEST": "end of a grid of shapes that is refined afterwards",
    "unknowns/starts.rs WIDEST": "the other end",
}


def unexplained(estimator: Path) -> Iterator[str]:
    """Numbers without a reason, as "path:line number"."""
    for path in sorted([*estimator.rglob("*.py"), *(estimator / "core" / "src").rglob("*.rs")]):
        name = path.relative_to(estimator).as_posix()
        if name in ("choices.py", "priors.py", "core/src/choices.rs", *OF_FILES) or path.name == "tests.rs":
            continue
        known = {float(x) for numbers in REASONS.get(name, {}) for x in numbers.split()}
        found = _python(path) if path.suffix == ".py" else _rust(path)
        for line, number in found:
            size = abs(number)
            plain = size in _PLAIN | _UNITS | {_FINITE} or size <= _ROUNDING or size >= 1.0 / _ROUNDING
            if not plain and size not in known:
                yield f"{name}:{line} {number:g}"


def untabled(source: Path) -> Iterator[str]:
    """Constants of Rust that are neither in the table of choices nor explained here."""
    for path in sorted(path for path in source.rglob("*.rs") if path.name not in ("choices.rs", "tests.rs")):
        text = path.read_text(encoding="utf-8").split("#[cfg(test)]")[0]
        for name, value in re.findall(r"const (\w+): f64 = (.*);", text):
            if f"{path.relative_to(source)} {name}" not in NUMERIC:
                yield f"{path.relative_to(source)}: {name} = {value}"


def _python(path: Path) -> Iterator[tuple[int, float]]:
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(function, ast.FunctionDef):
            for node in ast.walk(function):
                if isinstance(node, ast.Constant) and type(node.value) in (int, float):
                    yield node.lineno, float(node.value)


def _rust(path: Path) -> Iterator[tuple[int, float]]:
    text = path.read_text(encoding="utf-8").split("#[cfg(test)]")[0]
    for number, line in enumerate(text.splitlines(), 1):
        code = re.sub(r'"[^"]*"', '""', line.split("//")[0])
        if not re.match(r"\s*(pub(\(\w+\))? )?(const|static) ", code):
            for found in re.findall(r"(?<![\w.])\d[\d_]*(?:\.\d+)?(?:e-?\d+)?(?![\w.])", code):
                yield number, float(found.replace("_", ""))


NO_CHOICE = {  # mathematics, units, rounding, and what a format or the literature defines
    "diagnosis.candidates.LAWS": "Dahl's law, Bouc-Wen with equal parts, elastic up to the limit",
    "diagnosis.covariance._FULL": "keeps rounding from dividing by zero",
    "diagnosis.curves._DEGREE": "cubic splines",
    "diagnosis.motion._GENERATIONS": "effort of a search",
    "diagnosis.motion._POPULATION": "effort of a search",
    "diagnosis.motion._STEPS": "of a second-order integrator in a period of the bandwidth",
    "diagnosis.fourier._CUBIC": "least degree whose bend is not constant",
    "driven._NEWTON": "steps, that converge quadratically",
    "driven._PASSES": "of a fixed point whose error falls by the effect's share each time",
    "driven._STEP": "of a difference: square root of the rounding, in rad",
    "flexibility.RELATIVE_STEP": "of central differences: cube root of the rounding",
    "filters._CUBIC": "least degree whose slope is exact to second order",
    "freerun._RESOLVED": "radians of an oscillation in a second-order step: its frequency is 0.04 % off",
    "freerun._SMOOTHED": "samples: the least that average an encoder's rounding, short of the motion's bends",
    "freerun._STEP": "of a difference: square root of the rounding, in rad/s",
    "gate.causes._DEGREE": "unit",
    "gate.causes._MILLI": "unit",
    "gate.balance._RIDGE": "keeps rounding from deciding between parallel columns",
    "gate.decision._TURN": "one revolution",
    "gate.usable._ABSURD": "one over the rounding",
    "model.HIGHEST_ORDER": "of a polynomial in the joint file",
    "model_monitor._LEAST_SECONDS": "that a standard deviation takes",
    "harm._NOTHING": "keeps a ratio finite",
    "model_monitor._NOTHING": "keeps a logarithm finite",
    "sample.SIGMA_95": "quantile of the normal distribution",
}


class Constant(NamedTuple):
    """Where a number stands: module, name, key in a table (None: it is the number itself), value."""

    module: str
    name: str
    key: str | None
    value: float | tuple[float, ...]

    @property
    def label(self) -> str:
        return f"{self.module.removeprefix('estimator.')}.{self.key or self.name}"

    @property
    def table(self) -> Any:
        """What it is an entry of."""
        return getattr(importlib.import_module(self.module), self.name)


def constants(estimator: Path) -> Iterator[Constant]:
    """Choices, in the order of the modules: entries of the tables, and what `NO_CHOICE` does not explain."""
    for path in sorted(estimator.rglob("*.py")):
        parts = path.relative_to(estimator.parent).with_suffix("").parts
        module = ".".join(parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            if not isinstance(node, ast.Assign | ast.AnnAssign) or not isinstance(target, ast.Name):
                continue
            value = getattr(importlib.import_module(module), target.id, None)
            if target.id in ("PRIORS", "CHOICES") and isinstance(value, dict):
                for key, entry in value.items():
                    yield Constant(module, target.id, key, getattr(entry, "std", None) or entry.value)
            elif _number(value) and f"{module.removeprefix('estimator.')}.{target.id}" not in NO_CHOICE:
                yield Constant(module, target.id, None, value)


def _number(value: object) -> bool:
    if type(value) is tuple:
        return bool(value) and all(_number(x) for x in value)
    return isinstance(value, int | float) and not isinstance(value, bool)
