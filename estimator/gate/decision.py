"""Which hypothesis about units, signs, gears and time explains a recording: the one gate before any fit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from weakref import WeakKeyDictionary

import numpy as np

from estimator.choices import choice, log_odds, whole
from estimator.errors import EstimatorError
from estimator.gate.balance import Balance, Fit, Scales
from estimator.gate.causes import Cause, Change, Kind, causes, scales
from estimator.model import JointModel, Motor
from estimator.priors import PRIORS
from estimator.reasons import counted, percent
from estimator.sample import FloatArray, Record
from estimator.transmissions import transmission_model

__all__ = ["Discrepancy", "Judgement", "examine", "judge"]

_TURN = 2.0 * math.pi
_known: WeakKeyDictionary[Record, tuple[JointModel, Judgement]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True, kw_only=True)
class Discrepancy:
    """An error of unit, sign, gear or time in a recording or joint file.

    Attributes:
        kind: "unit", "sign", "gear" or "period".
        what: in words, e.g. "looks like degrees, expected rad".
        changes: true over recorded value, channel by channel: the correction.
        motors: of the joint.
        log_odds: evidence of all corrections together against "as declared", nats.
        left_before: residual rms of the balance over the torque's, as declared.
        left_after: the same after the correction.
        alternatives: other causes that explain the data equally well.
    """

    kind: Kind
    what: str
    changes: tuple[Change, ...]
    motors: int
    log_odds: float
    left_before: float
    left_after: float
    alternatives: tuple[tuple[Change, ...], ...] = ()

    @property
    def subject(self) -> str:
        """The quantity concerned, in words: "motor 1's torque", "the positions"."""
        return _named(self.changes, self.motors)

    def __str__(self) -> str:
        text = _said(self.changes, self.what, self.motors)
        others = [_named(changes, self.motors) for changes in self.alternatives]
        if others := [name for name in dict.fromkeys(others) if name != self.subject]:
            text += f" (or else: {' or '.join(others)}; this motion does not decide)"
        return text


def _said(changes: Sequence[Change], what: str, motors: int) -> str:
    """What is said of a quantity or, in the plural, of several."""
    text = f"{_named(changes, motors)} {what}"
    if len(changes) > 1:
        for one, many in (("looks", "look"), ("has", "have"), ("is", "are"), ("does", "do")):
            text = text.replace(f" {one} ", f" {many} ", 1)
    return text


def _named(changes: Sequence[Change], motors: int) -> str:
    names = [change.channel.partition("_") for change in changes]
    kinds = {kind or whose for whose, _, kind in names}
    whose = [w for w, _, _ in names]
    if kinds == {"position"} and len(names) > 1:
        return "the positions" if "link" in whose else "the motor positions"
    if len(kinds) == 1 and len(names) > 1:
        return f"the motor {kinds.pop()}s"
    words = {"time": "time", "link": "the link position", "deflection": "the link's deflection"}
    if motors == 1:
        words["motor1"] = "the motor"
    parts = []
    for w, _, kind in names:
        who = words.get(w) or f"the {w.replace('motor', 'motor ')}"
        parts.append(f"{who} {kind}" if w.startswith("motor") else who)
    return " and ".join(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class Judgement:
    """What a recording reveals about units, signs, gears and time.

    Attributes:
        findings: errors found; empty also if nothing can be decided.
        undecided: units and signs that this motion does not reveal, in words; empty if there are findings.
        reason: why nothing can be decided at all, or empty.
        left: residual of the corrected balance over the torque.
        inertia: of each motor, as a share of the declared one, where the motion decisively asks for another;
            else empty.
    """

    findings: tuple[Discrepancy, ...] = ()
    undecided: tuple[str, ...] = ()
    reason: str = ""
    left: float = math.nan
    inertia: tuple[float, ...] = ()

    @property
    def remark(self) -> str:
        """What is wrong or cannot be decided, in words; empty if everything is decided and right."""
        if self.findings:
            first, what = self.findings[0], ", and ".join(map(str, self.findings))
            before, after = percent(first.left_before, 0), percent(first.left_after, 1)
            balance = f"the torque balance leaves {before} of the torque as declared"
            return f"{what}: {balance}, {after} with that put right"
        if self.reason:
            return f"units and signs cannot be checked: {self.reason}"
        return f"this motion does not reveal {' or '.join(self.undecided)}" if self.undecided else ""


@dataclass(slots=True)
class _Joint:
    """A recording's balances and prior knowledge of the joint."""

    record: Record
    model: JointModel
    balances: dict[int, Balance]
    counts: dict[int, FloatArray] = field(default_factory=dict)
    least: float = 0.0  # of an error that counts

    def fits(self, found: Sequence[Cause]) -> dict[int, tuple[Scales, Fit]]:
        out = {}
        for i, balance in self.balances.items():
            s = scales(found, i)
            out[i] = (s, balance.fit(s))
        return out

    def evidence(self, found: Sequence[Cause]) -> float:
        """Log posterior, up to a constant: likelihood, and how plausible such a joint is."""
        total = self.likelihood(found) - sum(cause.cost for cause in found)
        for i, (s, fit) in self.fits(found).items():
            total -= self._unusual(i, s, fit) + self._disagrees(i, s)
        period_s = self.record.period_s * scales(found, 0).time
        if self.model.period_s is not None:
            return total - _off(period_s / self.model.period_s, choice("declared_factor"))
        return total - _off(period_s / choice("usual_period"), choice("usual_factor"))

    def likelihood(self, found: Sequence[Cause]) -> float:
        """Log likelihood of the balances, up to a constant."""
        return -sum(
            float(self.counts[i] @ np.log(np.maximum(fit.errors, self.least)))
            for i, (_, fit) in self.fits(found).items()
        )

    def _disagrees(self, i: int, s: Scales) -> float:
        """Cost of a velocity column that is wrong, too, unless it has the corrected position's scale."""
        gain = self.balances[i].velocity_gain
        if gain is None:
            return 0.0
        ratio = s.position / s.time / gain
        right = ratio > 0.0 and abs(math.log(ratio)) < math.log(choice("declared_factor"))
        return 0.0 if right else choice("fault")

    def _unusual(self, i: int, s: Scales, fit: Fit) -> float:
        motor, balance = self.model.motors[i], self.balances[i]
        free = math.isinf(s.inertia)
        B = motor.inertia_kg_m2 * (max(fit.inertia, 1e-9) if free else s.inertia)
        usual, declared = choice("usual_factor"), choice("declared_factor")
        total = _off(abs(s.torque) * balance.torque_rms / B / choice("usual_acceleration"), usual)
        if not free:
            total += _off(fit.inertia, declared ** (1.0 / choice("sure")))
        total += _off(max(abs(s.position) * balance.arc / _TURN, 1.0), usual)
        if not motor.flexible:
            return total
        total += choice("rigid") * math.log(max(fit.deflection, 1e-6))
        if fit.stiffness_nm_rad <= 0.0:
            return total + choice("fault")
        total += _off(math.sqrt(fit.stiffness_nm_rad / B) / (_TURN * choice("usual_frequency")), usual)
        known = _declared_stiffness(motor)
        if known is not None:  # heavy tails: a declared value can be a mere guess
            x = math.log(fit.stiffness_nm_rad / known) / math.log(declared)
            total += 2.0 * math.log1p(x * x / 3.0)
        return total

    def weighed(self, hypotheses: Sequence[tuple[Cause, ...]]) -> list[tuple[float, tuple[Cause, ...]]]:
        """Return the evidence and hypothesis, the best one first."""
        return sorted(((self.evidence(h), h) for h in hypotheses), key=lambda e: -e[0])

    def controlled(self, found: Sequence[Cause]) -> bool:
        """Return whether controllers that see only their motors explain the torques as well
        as these corrections.
        """
        return (
            sum(
                float(self.counts[i] @ np.log(self.balances[i].controlled() / fit.errors))
                for i, (_, fit) in self.fits(found).items()
            )
            < _decisive()
        )

    def left(self, found: Sequence[Cause]) -> float:
        """Return the largest relative residual of the motors' balances."""
        return max(fit.error for _, fit in self.fits(found).values())


def judge(record: Record, model: JointModel) -> Judgement:
    """Check units, signs, gear ratios and time of a recording. Every hypothesis is one or two causes. It is
    scored by how well the declared motor inertia (within a factor), any rising transmission curve,
    dissipative friction and small delays explain each motor's torque (eq 5, `Balance`), and by how plausible
    the resulting joint is. A finding beats "as declared" decisively and explains the torque. Without
    findings, every cause that is not decisively less likely than "as declared" is
    listed as undecided: the sign of a link that is held, for example. Where a controller that holds the motor
    explains the torque as well as a finding does, no balance is better than undeclared friction leaves it.
    A recording that a verb and its fit ask about is judged once.

    Args:
        record: the recording.
        model: the joint as declared, with gear ratios and sampling period if known.

    Raises:
        EstimatorError: the recording has other motors than the model.
    """
    if record.motors != len(model.motors):
        raise EstimatorError(
            f"recording: expected {counted(len(model.motors), 'motor')}, got {record.motors}"
        )
    known = _known.get(record)
    if known is None or known[0] != model:
        known = _known[record] = model, _judged(record, model)
    return known[1]


def _judged(record: Record, model: JointModel) -> Judgement:
    """Judge a recording that has the model's motors."""
    if len(record) < whole("samples"):
        return Judgement(reason=f"{len(record)} samples, expected at least {whole('samples')}")
    joint = _Joint(record, model, _balances(record, model))
    if not joint.balances:
        return Judgement(reason="no motor moves and has a torque")
    ratios = [joint.balances[i].ratio if i in joint.balances else None for i in range(len(model.motors))]
    single = causes(model, record.link_position_rad is not None and model.has_deflection, ratios)
    hypotheses: list[tuple[Cause, ...]] = [(), *((cause,) for cause in single)]
    hypotheses += [pair for pair in combinations(single, 2) if not pair[0].channels & pair[1].channels]
    for found in hypotheses:
        joint.fits(found)
    joint.counts = {i: np.minimum(b.independent, choice("independent")) for i, b in joint.balances.items()}
    weighed = joint.weighed(hypotheses)
    if joint.controlled(weighed[0][1]):
        joint.least = PRIORS["coulomb_friction"].std
        weighed = joint.weighed(hypotheses)
    return _decided(joint, weighed, single)


def _decided(
    joint: _Joint, weighed: list[tuple[float, tuple[Cause, ...]]], single: Sequence[Cause]
) -> Judgement:
    """The judgement, from the hypotheses' evidence: the best one, unless another inertia explains as much."""
    best, found = weighed[0]
    declared = joint.evidence(())
    odds, before, after = best - declared, joint.left(()), joint.left(found)
    if after**2 > choice("halved") * before**2:  # most of what is left has no cause here
        odds -= joint.likelihood(found) - joint.likelihood(())
    excuse = max(e for e, h in weighed if h and all(cause.kind == "inertia" for cause in h))
    blamed = tuple(cause for cause in found if cause.kind != "inertia")
    certain = best - excuse >= _decisive() or all(cause.kind in ("unit", "gear", "period") for cause in found)
    if odds < _decisive() or not (blamed and certain) or after > choice("unexplained"):
        if found and not blamed and odds >= _decisive():
            return _another_inertia(joint, weighed, after)
        if before > choice("unexplained"):
            reason = f"the motion explains {percent(1.0 - before, 0)} of the torque"
            if before > 1.0:
                left = percent(before, 0)
                reason = f"what is declared leaves {left} of the torque: is it a recording of this joint?"
            return Judgement(reason=reason, left=before)
        return Judgement(undecided=_undecided(joint, single, declared), left=before)
    even = -log_odds(choice("even"))
    alike = [
        h
        for e, h in weighed[1:]
        if best - e < (_decisive() if any(c.kind == "inertia" for c in h) else even) and len(h) == len(found)
    ]
    findings = [
        _finding(found, found.index(one), alike, odds, before, after, joint.record.motors) for one in blamed
    ]
    return Judgement(findings=tuple(findings), left=after)


def _another_inertia(joint: _Joint, weighed: list[tuple[float, tuple[Cause, ...]]], left: float) -> Judgement:
    """That the motors' inertia is another than declared, and what else explains as much."""
    best, found = weighed[0]
    each = {
        i: f.inertia * (1.0 if math.isinf(s.inertia) else s.inertia)
        for i, (s, f) in joint.fits(found).items()
    }
    factors = each.values()
    text = f"the motion asks for {' and '.join(f'{x:.2g}' for x in factors)} times the declared inertia"
    others = [h[0] for e, h in weighed if best - e < _decisive() and len(h) == 1 and h[0].kind != "inertia"]
    motors = joint.record.motors
    listed = " or ".join(_said(one.changes, one.what, motors) for one in others)
    asked = tuple(each[i] if scales(found, i).inertia != 1.0 else 1.0 for i in range(motors))
    return Judgement(reason=f"{text} (or else: {listed})" if listed else text, left=left, inertia=asked)


def _undecided(joint: _Joint, single: Sequence[Cause], declared: float) -> tuple[str, ...]:
    """Units and signs that the likelihood alone does not decide."""
    doubtful: dict[str, list[str]] = {}
    for cause in single:
        if cause.kind in ("unit", "sign") and declared - joint.evidence((cause,)) - cause.cost < _decisive():
            kinds = doubtful.setdefault(_named(cause.changes, joint.record.motors), [])
            kinds += [cause.kind] if cause.kind not in kinds else []
    return tuple(f"the {' and '.join(sorted(kinds))} of {name}" for name, kinds in doubtful.items())


def examine(record: Record, model: JointModel) -> list[Discrepancy]:
    """Return the findings of `judge`."""
    return list(judge(record, model).findings)


def _finding(
    found: tuple[Cause, ...],
    number: int,
    alike: list[tuple[Cause, ...]],
    odds: float,
    before: float,
    after: float,
    motors: int,
) -> Discrepancy:
    cause, rest = found[number], set(found) - {found[number]}
    others = [next(iter(set(h) - rest)).changes for h in alike if len(set(h) - rest) == 1]
    return Discrepancy(
        kind=cause.kind,
        what=cause.what,
        changes=cause.changes,
        motors=motors,
        log_odds=odds,
        left_before=before,
        left_after=after,
        alternatives=tuple(dict.fromkeys(others)),
    )


def _balances(record: Record, model: JointModel) -> dict[int, Balance]:
    """The balances of the motors that move and have a torque."""
    found = {}
    for i, motor in enumerate(model.motors):
        lever = 0 if model.arrangement == "serial" and i == 1 else None
        theta, tau = record.motor_position_rad[:, i], record.motor_torque_nm[:, i]
        if np.nanstd(theta) > 0.0 and np.nanstd(tau) > 0.0:
            found[i] = Balance(record, i, motor, lever)
    return found


def _declared_stiffness(motor: Motor) -> float | None:
    law = transmission_model(motor.transmission)
    if law is None or not motor.transmission.parameters:
        return None
    try:
        k = float(law.stiffness(np.zeros(1), law.alpha(motor.transmission.parameters))[0])
    except (AttributeError, EstimatorError, KeyError, TypeError):
        return None
    return k if k > 0.0 else None


def _decisive() -> float:
    """Log odds at which a finding is certain, nats."""
    return math.log(choice("accused"))


def _off(ratio: float, factor: float) -> float:
    """Cost in nats of a ratio that is log-normal around one."""
    return 0.5 * (math.log(max(ratio, 1e-30)) / math.log(factor)) ** 2
