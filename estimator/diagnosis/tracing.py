"""The whole diagnosis: recording and model in; verdict, effects and errors out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.bandwidth import choose_bandwidth, rough_stiffness, torque_rms, weights
from estimator.diagnosis.curves import FreeCurve, any_time, best_curve, trusting
from estimator.diagnosis.excitation import advice_for, poor
from estimator.diagnosis.frame import Frame, Signals
from estimator.diagnosis.known import declared_corrections
from estimator.diagnosis.locate import places_left, the_place
from estimator.diagnosis.openorder import raised
from estimator.diagnosis.outcome import curve_of, curve_of_free, errors, findings, rivals
from estimator.diagnosis.plausible import doubt
from estimator.diagnosis.regression import Blocks, Rows
from estimator.diagnosis.result import Curve, Diagnosis, Errors, Finding, Series, Verdict
from estimator.diagnosis.search import Found, additions, search
from estimator.diagnosis.select import Selection, Tracer
from estimator.effects import EffectType
from estimator.errors import EstimatorError
from estimator.gate import check, refuse
from estimator.model import JointModel, ParameterValue
from estimator.sample import FloatArray, Record

__all__ = ["diagnose"]

_BLOCKS = 10
_HELD = 3  # blocks held out where there is no recording to validate with
_SKEW = 1.05  # periods: more than one sample is a delay, less an everyday skew
_LEFT = 0.2  # of the error before: a named effect that leaves more may be the wrong one
_CURVE = 0.6  # of the error that named effects leave: what a free curve must come down to
_ALONE = 0.3  # of the error before: several named effects may be an imitation if the best alone leaves more
_AGAINST = 0.25  # share of the blocks that a free curve may fail in
_NEARLY_ALL = 0.02  # squared error that a free curve may leave to be preferred to them in any case
_IMITATED = 1.2  # squared error of a free curve over that of several effects at several places
_LEAST_CURVE = 0.004  # of the torque's rms that a free curve must explain
_NOISY = 2.0  # rms over the noise that effects at the only place may leave, if that place needs a skew
_CLEARLY = 0.5  # and of that, what effects at several places must come down to
_REST = 3.0  # rms of what is left over the expected noise, from which it is not only noise
_REST_NOWHERE = 10.0  # and where the equations do not tell the place
_LEAST_REST = 0.004  # of the torque's rms
_LEAST_NOWHERE = 0.02
_NO_ACCOUNT = 0.5  # of the error before: a named effect that leaves more explains nothing

_READS = ("encoder_delay", "torque_delay", "deflection_offset")

Progress = Callable[[str], None]
_Pair = tuple[Frame, FloatArray, FloatArray]


def diagnose(
    record: Record,
    model: JointModel,
    bandwidth_hz: float | None = None,
    validation: Record | None = None,
    progress: Progress = lambda _: None,
) -> Diagnosis:
    """Trace what a model leaves unexplained to the effect that is missing.

    Args:
        record: the recording.
        model: the joint as it is declared.
        bandwidth_hz: of the filter that all channels share; None: chosen from the data.
        validation: a recording that takes no part in fit and selection; None: blocks are held out.
        progress: told what is being done.

    Returns:
        The diagnosis.

    Raises:
        EstimatorError: the recording does not allow one.
        GateError: units, signs, gear ratio or time of a recording do not fit the joint.
    """
    for each in (record,) if validation is None else (record, validation):
        check(each, model)
    progress("units and signs")
    for each in (record,) if validation is None else (record, validation):
        refuse(each, model)
    progress("bandwidth")
    bandwidth = bandwidth_hz or choose_bandwidth(record, model)
    if not 0.0 < bandwidth <= 0.4 / record.period_s:
        raise EstimatorError(
            f"bandwidth: expected more than 0 and at most {0.4 / record.period_s:g} Hz, got {bandwidth:g}"
        )
    tracer = _tracer(record, model, bandwidth, held=0 if validation is not None else _HELD)
    progress("place")
    place = the_place(places_left(tracer))
    whole = tracer
    if place is not None:
        tracer = tracer.only(place.location, place.motor, place.skew_s)
    rms = torque_rms(record)
    start = Found(tracer, tracer.evaluate(()))
    found = search(tracer, rms, progress)
    if place is not None and place.skew_s and _left(found) > _NOISY:
        progress("other places")
        anywhere = search(whole, rms, progress)
        if _left(anywhere) < _CLEARLY * _left(found):
            tracer, found, start = whole, anywhere, Found(whole, whole.evaluate(()))
    outcome = _Judge(record, validation, start, found, rms, progress, additions(start)).diagnosis()
    higher = raised(model, outcome.effects)
    return outcome if higher is None else diagnose(record, higher, bandwidth, validation, progress)


def _left(found: Found) -> float:
    """rms of what is left over the expected noise."""
    return float(np.sqrt(found.selection.error / int(found.tracer.rows.train.sum())))


def _tracer(record: Record, model: JointModel, bandwidth: float, held: int) -> Tracer:
    signals = Signals(record, bandwidth)
    frame = Frame.make(model, signals, declared_corrections(model))
    if frame.rows < 60:
        raise EstimatorError(
            f"the recording is too short for a bandwidth of {bandwidth:g} Hz: {frame.rows} independent rows"
        )
    blocks = Blocks.make(frame.rows, _BLOCKS, held, spread=frame.linked)
    trust = weights(frame, rough_stiffness(record, model), torque_rms(record))
    smoothing = max(signals.velocity_noise(i) for i in range(len(signals.theta)))
    return Tracer(frame, Rows(blocks, frame.equations, trust), smoothing)


@dataclass(slots=True)
class _Judge:
    """What the search has found, turned into a verdict."""

    record: Record
    validation: Record | None
    start: Found
    found: Found
    torque_rms: float
    progress: Progress
    singles: list[Found]

    def diagnosis(self) -> Diagnosis:
        """Verdict, findings, errors."""
        named = findings(self.found)
        everyday = [f for f in named if self._is_everyday(f, named)]
        aligned = self._aligned(everyday)
        effects = [f for f in named if f not in everyday]
        self.progress("free curves")
        plain = aligned if self.start.tracer.within is None else self.start
        curve = self._unlisted(plain)
        verdict: Verdict = "effect" if effects else "sufficient"
        notes: list[str] = []
        if curve is not None:
            verdict, effects = "unexplained", [self._unlisted_finding(curve)]
            aligned, everyday = plain, [] if plain is self.start else everyday
        elif poor(self.found.tracer.frame):
            notes.append("the motion is hardly more than one sine: many effects look alike in it")
            if not effects or any(f.alternatives for f in effects):
                verdict = "insufficient_excitation"
        notes += self._doubts(effects)
        advice = [line for f in effects for line in advice_for(f.name, f.alternatives)]
        return self._report(verdict, effects, everyday, aligned, curve, advice, notes)

    def _doubts(self, effects: list[Finding]) -> list[str]:
        """What speaks against findings."""
        model = self.start.tracer.frame.model
        first = [next(iter(f.parameters.values()), 0.0) for f in effects]
        doubts = [
            doubt(model, f.name, f.motor, x)
            for f, x in zip(effects, first, strict=True)
            if isinstance(x, float)
        ]
        return [line for line in doubts if line is not None]

    def _is_everyday(self, finding: Finding, named: list[Finding]) -> bool:
        """Skew of up to a sample; a zero between encoders that nothing ties, unless it is all there is."""
        if finding.name in ("encoder_delay", "torque_delay"):
            delay = finding.parameters["delay_s"]
            return isinstance(delay, float) and abs(delay) <= _SKEW * self.record.period_s
        if self.start.tracer.frame.linked or finding.name != "deflection_offset":
            return False
        return any(f.name not in ("deflection_offset", "encoder_delay") for f in named)

    def _aligned(self, everyday: list[Finding]) -> Found:
        """The declared model, with what is everyday taken out of the readings."""
        corrections = self.start.tracer.frame.corrections
        now = self.found.tracer.frame.corrections
        names = {f.name for f in self._findings_of_readings()}
        if "encoder_delay" not in names or any(f.name == "encoder_delay" for f in everyday):
            corrections = replace(corrections, encoder_delay_s=now.encoder_delay_s)
        for finding in everyday:
            motor = finding.motor or 0
            if finding.name == "torque_delay":
                delays = list(corrections.torque_delay_s)
                delays[motor] = now.torque_delay_s[motor]
                corrections = replace(corrections, torque_delay_s=tuple(delays))
            elif finding.name == "deflection_offset":
                offsets = list(corrections.offset_rad)
                offsets[motor] = now.offset_rad[motor]
                corrections = replace(corrections, offset_rad=tuple(offsets))
        if corrections == self.start.tracer.frame.corrections:
            return self.start
        tracer = self.start.tracer.at(corrections)
        return Found(tracer, tracer.evaluate(()))

    def _findings_of_readings(self) -> list[EffectType]:
        return [t.candidate.kind for t in self.found.selection.terms if t.candidate.kind.channel != "torque"]

    def _alignment(self, aligned: Found, everyday: list[Finding]) -> dict[str, float]:
        """What was taken out of the readings as everyday, by channel."""
        now, declared = aligned.tracer.frame.corrections, declared_corrections(aligned.tracer.frame.model)
        pairs = {"link_position_delay_s": now.encoder_delay_s - declared.encoder_delay_s}
        for i in range(len(now.offset_rad)):
            pairs[f"motor{i + 1}_torque_delay_s"] = now.torque_delay_s[i] - declared.torque_delay_s[i]
            pairs[f"motor{i + 1}_deflection_offset_rad"] = now.offset_rad[i] - declared.offset_rad[i]
        for finding in everyday:
            value = next(iter(finding.parameters.values()))
            assert isinstance(value, float)
            motor = (finding.motor or 0) + 1
            if finding.name == "encoder_delay":
                pairs["link_position_delay_s"] = value
            elif finding.name == "torque_delay":
                pairs[f"motor{motor}_torque_delay_s"] = value
            else:
                pairs[f"motor{motor}_deflection_offset_rad"] = value
        return {name: value for name, value in pairs.items() if value != 0.0}

    def _unlisted(self, aligned: Found) -> FreeCurve | None:
        """A free curve, where it does clearly better than all that has a name, or where no name accounts.

        Where something is left that no curve accounts for either, its place is still known: by the
        equations that it leaves alone, or else by the curve that does best.
        """
        tracer, before = aligned.tracer, aligned.selection
        curve = best_curve(tracer, before)
        if curve is None:
            return None
        real = self._real(tracer, before, curve)
        if not real or not self._better(curve.error, before.error):
            if not self._unaccounted(tracer, before.error):
                return None
            if tracer.within is not None and tracer.within[0] == "link" and not real:
                curve = any_time(tracer, before, *tracer.within)
        return trusting(tracer, before, curve)

    def _unaccounted(self, tracer: Tracer, before: float) -> bool:
        """Whether much more than noise is left, and most of it in spite of the effects that were named."""
        left, rows = self.found.selection.error, int(tracer.rows.train.sum())
        known = tracer.within is not None
        scale = self.torque_rms * float(tracer.rows.weight.max())
        share, noise = (_LEAST_REST, _REST) if known else (_LEAST_NOWHERE, _REST_NOWHERE)
        much = left / rows > max(noise, share * scale) ** 2
        if not any(t.candidate.kind.name not in _READS for t in self.found.selection.terms):
            return much
        return much and tracer.frame.linked and bool(np.sqrt(left / before) > _NO_ACCOUNT)

    def _real(self, tracer: Tracer, before: Selection, curve: FreeCurve) -> bool:
        """Whether a free curve explains something, and not in a few blocks only."""
        gain = before.error - curve.error
        least = (_LEAST_CURVE * self.torque_rms * tracer.rows.weight.max()) ** 2
        if gain / tracer.rows.train.sum() < least or gain < 0.15 * before.error:
            return False
        gains = np.maximum(before.fit.cross - curve.selection.fit.cross, 0.0)
        if np.count_nonzero(gains == 0.0) > _AGAINST * len(gains):
            return False
        rest = before.error - float(before.fit.cross[np.argmax(gains)])
        return bool(gain - float(gains.max()) >= 0.1 * rest)

    def _better(self, free: float, before: float) -> bool:
        """Whether a free curve is a better account of the residual than the effects that were named.

        One curve over one coordinate at one place beats several effects at several places that together
        only imitate it, and one effect that leaves much of the error.
        """
        named = self.found.selection.error
        terms = [t for t in self.found.selection.terms if t.candidate.kind.name not in _READS]
        if not terms:
            return not self.found.selection.terms or free < _CURVE**2 * named
        places = {(t.candidate.kind.location, t.candidate.motor) for t in terms}
        if len(places) > 1:
            alone = min((f.selection.error for f in self.singles), default=before)
            imitated = free < _IMITATED * named or free < _NEARLY_ALL * before
            return bool(np.sqrt(alone / before) > _ALONE) and imitated
        return bool(np.sqrt(named / before) > _LEFT) and free < _CURVE**2 * named

    def _unlisted_finding(self, curve: FreeCurve) -> Finding:
        return Finding(
            name="unlisted",
            location=curve.location,
            motor=curve.motor,
            parameters={},
            std={},
            coordinates=curve.coordinates,
            share=1.0 - curve.error / max(self.start.selection.error, 1e-300),
        )

    def _report(
        self,
        verdict: Verdict,
        effects: list[Finding],
        everyday: list[Finding],
        aligned: Found,
        curve: FreeCurve | None,
        advice: list[str],
        notes: list[str],
    ) -> Diagnosis:
        frame = self.found.tracer.frame
        demean = any(frame.flexible) and not frame.linked and not _only_offset(effects)
        train, validation, series, floor = self._errors(aligned, curve, demean)
        scale = self.torque_rms * float(self.start.tracer.rows.weight.max())
        return Diagnosis(
            verdict=verdict,
            bandwidth_hz=frame.signals.bandwidth_hz,
            effects=tuple(effects),
            train=train,
            validation=validation,
            floor_nm=floor,
            transmissions=tuple(self._final_base()),
            alignment=self._alignment(aligned, everyday),
            rivals=tuple(rivals(self.singles if aligned is self.start else additions(aligned), scale)),
            curves=self._curves(effects, aligned, curve),
            series=series,
            advice=tuple(dict.fromkeys(advice)),
            notes=tuple(notes),
        )

    def _final_base(self) -> list[dict[str, ParameterValue]]:
        tracer = self.found.tracer
        return tracer.moved(self.found.selection).parameters(tracer.frame)

    def _left(self, aligned: Found, curve: FreeCurve | None, signals: Signals | None) -> _Pair:
        """What the declared and the augmented model leave, here or on another recording's signals."""
        after = self.found if curve is None else Found(aligned.tracer, curve.selection)
        extra = None if curve is None else curve.columns
        left = []
        for found, more in ((aligned, None), (after, extra)):
            frame = found.tracer.frame
            if signals is not None:
                frame = Frame.make(frame.model, signals, frame.corrections)
            left.append(found.tracer.left(found.selection, more, None if signals is None else frame))
        return frame, left[0], left[1]

    def _errors(
        self, aligned: Found, curve: FreeCurve | None, demean: bool
    ) -> tuple[Errors, Errors, Series, tuple[float, ...]]:
        frame, before, after = self._left(aligned, curve, None)
        index = aligned.tracer.rows.blocks.index
        train = errors(frame, before, after, index >= 0, demean)
        if self.validation is None:
            held = errors(frame, before, after, index < 0, demean)
        else:
            other = self._left(aligned, curve, Signals(self.validation, frame.signals.bandwidth_hz))
            held = errors(*other, np.ones(other[0].rows, dtype=bool), demean)
        keep, rows = frame.signals.keep, frame.rows
        series = Series(
            time_s=np.flatnonzero(keep).astype(np.float64) * frame.signals.narrow.period_s,
            torque_nm=frame.project(frame.motors[0].torque),
            before_nm=before[:rows],
            after_nm=after[:rows],
        )
        motors = after.reshape(frame.equations, -1)[: len(frame.motors)]
        return train, held, series, tuple(float(np.sqrt(np.mean(m**2))) for m in motors)

    def _curves(self, effects: list[Finding], aligned: Found, curve: FreeCurve | None) -> tuple[Curve, ...]:
        if curve is not None:
            return (curve_of_free(aligned, curve),)
        terms = self.found.selection.terms
        made = []
        for finding in effects:
            for k, term in enumerate(terms):
                if term.candidate.key == (finding.name, finding.motor):
                    made.append(curve_of(self.found, k))
        return tuple(made)


def _only_offset(effects: list[Finding]) -> bool:
    return bool(effects) and all(f.name in ("torque_offset", "deflection_offset") for f in effects)
