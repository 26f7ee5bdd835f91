"""Plausible lies of one signal, and true changes of the joint: what is wrong and still called valid?

Health first, then one fault, in lockstep on the project's simulated joints, through the public interface. A fault is
a function of the signal's values from its begin on. Signals are motor position, motor torque and link position; of a
joint with two motors it is the first one's.
"""

import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import onlinekit as kit

from estimator import Estimator, JointModel
from estimator.identify import identify
from estimator.model_monitor import ModelMonitor, ResidualBaseline, measure_baseline
from estimator.sample import Sample, Status

SIGNALS = ("motor", "torque", "link")
SUSPECTS = {  # what `suspected` may call each of them
    "motor": ("motor_position", "motor_or_link_position"),
    "torque": ("motor_torque",),
    "link": ("link_position", "motor_or_link_position"),
}
LOOKED_EVERY = 50  # periods
JOINTS = ("constant", "quadratic", "vsa-ii", "vsa-ii fitted")
STEPS = (0.5, 0.7, 1.4, 2.0, 3.0)  # true changes of the stiffness
FLAGS = int(Status.CHANGED | Status.MODEL_ALARM | Status.INPUT_REJECTED | Status.RESTARTED | Status.GAP)
T = kit.PERIOD_S

Values = np.ndarray
Spoil = Callable[[Values, float, np.random.Generator], Values]  # of values, their largest healthy one, random


class Fault(NamedTuple):
    """A fault: its kind with its size, the signals that it hits, what it does, and when.

    A node that reboots says so at the begin of the fault; some faults are there from the first sample on.
    """

    name: str
    signals: tuple[str, ...]
    spoil: Spoil
    reboots: bool = False
    from_start: bool = False


class Outcome(NamedTuple):
    """Samples from the begin of a fault on: valid ones, of these those whose stiffness is wrong, those of them
    without any flag at all; those with a valid torque, and of these those whose torque is wrong.

    And the signal that was suspected most often; empty: none was.
    """

    samples: int
    valid: int
    wrong: int
    silent: int
    torque_valid: int
    torque: int
    suspected: str = ""

    def names(self, fault: Fault) -> bool:
        return any(self.suspected in SUSPECTS[signal] for signal in fault.signals)


def _gain(x: Values, size: float, rng: np.random.Generator, factor: float) -> Values:
    return factor * x


def _gain_drifts(x: Values, size: float, rng: np.random.Generator, to: float) -> Values:
    return x * np.linspace(1.0, to, len(x))


def _offset(x: Values, size: float, rng: np.random.Generator, share: float) -> Values:
    return x + share * size


def _drift(x: Values, size: float, rng: np.random.Generator, per_s: float) -> Values:
    return x + per_s * T * np.arange(len(x))


def _late(x: Values, size: float, rng: np.random.Generator, periods: int) -> Values:
    return np.concatenate([np.full(periods, x[0]), x[:-periods]])


def _noise(x: Values, size: float, rng: np.random.Generator, share: float) -> Values:
    return x + share * size * rng.normal(size=len(x))


def _counts_from(x: Values, size: float, rng: np.random.Generator, rad: float) -> Values:
    return x - x[0] if rad == 0.0 else x + rad


def _slip(x: Values, size: float, rng: np.random.Generator, share: float, every_s: float) -> Values:
    steps = np.arange(len(x)) // round(every_s / T) if every_s else np.ones(len(x))
    return x + share * size * steps


def _spikes(x: Values, size: float, rng: np.random.Generator, rate: float) -> Values:
    hit = rng.random(len(x)) < rate
    return x + np.where(hit, rng.choice([-1.0, 1.0], len(x)) * size, 0.0)


def _held(x: Values, size: float, rng: np.random.Generator, periods: int) -> Values:
    return x[np.arange(len(x)) // periods * periods]


def faults() -> Iterator[Fault]:
    for signal in SIGNALS:
        one = (signal,)
        yield Fault(
            "frozen with noise", one, lambda x, size, rng: x[0] + 1e-4 * size * rng.normal(size=len(x))
        )
        yield Fault("stuck", one, lambda x, size, rng: np.full_like(x, x[0]))
        for per_s in (0.01, 0.1) if signal != "torque" else ():
            yield Fault(f"drift {per_s:g} rad/s", one, partial(_drift, per_s=per_s))
        for share in (0.02, 0.1, -0.1, 0.25):
            yield Fault(f"offset {share:.0%}", one, partial(_offset, share=share))
        for factor in (0.75, 0.9, 1.1, 1.25):
            yield Fault(f"gain {factor:g}", one, partial(_gain, factor=factor))
        if signal == "torque":
            yield Fault("ramps by 20 %", one, lambda x, size, rng: x + np.linspace(0.0, 0.2 * size, len(x)))
        yield Fault("gain drifts to 1.25", one, partial(_gain_drifts, to=1.25))
        yield Fault("sign", one, partial(_gain, factor=-1.0))
        for periods in (1, 3, 10):
            yield Fault(f"late by {periods}", one, partial(_late, periods=periods))
        for rate in (1e-3, 1e-2, 0.1):
            yield Fault(f"spikes {rate:g}", one, partial(_spikes, rate=rate))
        yield Fault("noise 1 %", one, partial(_noise, share=0.01))
        yield Fault("steps of 2 %", one, lambda x, size, rng: np.round(x / (0.02 * size)) * 0.02 * size)
        yield Fault("every 10th", one, partial(_held, periods=10))
        if signal != "torque":
            yield Fault("every 50th", one, partial(_held, periods=50))
            yield Fault("zero off by 0.1 rad", one, partial(_counts_from, rad=0.1), from_start=True)
            for rad in (0.0, 0.1, 2.6):
                where = f"{rad:g} rad further on" if rad else "zero"
                yield Fault(
                    f"reboots, counts from {where}", one, partial(_counts_from, rad=rad), reboots=True
                )
            yield Fault("slips once", one, partial(_slip, share=0.1, every_s=0.0))
            yield Fault("slips each second", one, partial(_slip, share=0.02, every_s=1.0))
    yield Fault("late by 3", ("motor", "torque"), partial(_late, periods=3))
    yield Fault("gain 0.9", ("motor", "link"), partial(_gain, factor=0.9))
    yield Fault("gain 1.1", ("torque", "link"), partial(_gain, factor=1.1))
    yield Fault("offset 10%", ("motor", "torque"), partial(_offset, share=0.1))
    yield Fault("late by 10", ("torque", "link"), partial(_late, periods=10))
    yield Fault("noise 1 %", SIGNALS, partial(_noise, share=0.01))


FAULTS = tuple(faults())
LADDERS: dict[str, tuple[str, tuple[float, ...], tuple[str, ...], Callable[[float], Spoil]]] = {
    # kind: (its size, sizes from small to large, signals, what a size does)
    "scale": ("{:.1%}", (0.01, 0.02, 0.05, 0.1, 0.25), SIGNALS, lambda s: partial(_gain, factor=1.0 + s)),
    "scale drifts, in 8 s": (
        "{:.1%}", (0.01, 0.02, 0.05, 0.1, 0.25), SIGNALS, lambda s: partial(_gain_drifts, to=1.0 + s)),
    "offset, of the largest value": (
        "{:.1%}", (0.001, 0.003, 0.01, 0.03, 0.1), SIGNALS, lambda s: partial(_offset, share=s)),
    "drift": (
        "{:g} rad/s", (1e-4, 3e-4, 1e-3, 3e-3, 1e-2), ("motor", "link"), lambda s: partial(_drift, per_s=s)),
    "late": ("{:g} periods", (1, 2, 3, 5, 10), SIGNALS, lambda s: partial(_late, periods=int(s))),
    "noise, of the largest value": (
        "{:.2%}", (1e-4, 3e-4, 1e-3, 3e-3, 1e-2), SIGNALS, lambda s: partial(_noise, share=s)),
}  # fmt: skip


@lru_cache(maxsize=8)
def _healthy(name: str, seconds: float, seed: int) -> kit.Motion:
    return kit.motion(name, seconds, seed=seed)


@lru_cache(maxsize=2)
def _fitted(name: str) -> tuple[JointModel, ResidualBaseline]:
    """As `fit --write` leaves it: fitted and calibrated on another run, with its model's baseline."""
    motion = kit.motion(name, 20.0, seed=99)
    record = kit.recorded(motion.samples)
    declared = kit.declared(name, parameters={})
    model = identify(record, declared).model
    return model, measure_baseline(record, model)


def _spoilt(samples: list[Sample], begin: int, fault: Fault, seed: int) -> list[Sample]:
    rng = np.random.default_rng([seed, zlib.crc32(f"{fault.name} {fault.signals}".encode())])
    begin = 0 if fault.from_start else begin
    motor, torque, link = (
        np.array(values, float)
        for values in zip(
            *((s.motor_position_rad[0], s.motor_torque_nm[0], s.link_position_rad) for s in samples),
            strict=True,
        )
    )
    columns = {"motor": motor, "torque": torque, "link": link}
    for x in (columns[signal] for signal in fault.signals):
        x[begin:] = fault.spoil(x[begin:].copy(), float(np.max(np.abs(x[:begin]), initial=0.0)), rng)
    return samples[:begin] + [
        s._replace(
            motor_position_rad=(float(motor[k]), *s.motor_position_rad[1:]),
            motor_torque_nm=(float(torque[k]), *s.motor_torque_nm[1:]),
            link_position_rad=float(link[k]),
        )
        for k, s in enumerate(samples[begin:], begin)
    ]


def outcome(joint: str, fault: Fault | None, health_s: float, fault_s: float, seed: int = 0) -> Outcome:
    """Health, then the fault (None: more health)."""
    name = joint.removesuffix(" fitted")
    motion = _healthy(name, health_s + fault_s, seed)
    begin = round(health_s / T)
    samples = motion.samples if fault is None else _spoilt(motion.samples, begin, fault, seed)
    restarted = begin if fault is not None and fault.reboots else None
    return _count(*_estimates(joint, samples, begin, restarted), motion, begin)


def errors(
    joint: str, fault: Fault, health_s: float, fault_s: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """From the begin of a fault on: which samples are valid, and the relative error of the stiffness."""
    motion, begin = _healthy(joint, health_s + fault_s, seed), round(health_s / T)
    estimates, _ = _estimates(joint, _spoilt(motion.samples, begin, fault, seed), len(motion.samples))
    return estimates.valid[begin:], np.abs(
        estimates.stiffness_nm_rad[begin:] / motion.stiffness_nm_rad[begin:] - 1.0
    )


def stepped(
    joint: str, factor: float, health_s: float, after_s: float, seed: int = 0
) -> tuple[Outcome, float]:
    """A true change of the stiffness; also the share of the last two seconds in which it is followed.

    That is: within 5 %, and valid, or, where a fitted file says what the joint was, with the model alarm.
    """
    name = joint.removesuffix(" fitted")
    motion = kit.motion(name, health_s + after_s, seed=seed, step=(health_s, factor))
    begin = round(health_s / T)
    estimates, suspected = _estimates(joint, motion.samples, begin)
    end = slice(-round(2.0 / T), None)
    off = np.abs(estimates.stiffness_nm_rad[end] / motion.stiffness_nm_rad[end] - 1.0)
    said = int(Status.VALID | (Status.MODEL_ALARM if joint != name else 0))
    followed = float(np.mean((estimates.status[end] & said > 0) & (off < 0.05)))
    return _count(estimates, suspected, motion, begin), followed


def _estimates(
    joint: str, samples: list[Sample], begin: int, restarted: int | None = None
) -> tuple[kit.Estimates, str]:
    """The estimates from the samples, and whom the estimator suspected most often from `begin` on.

    `restarted`: place of the first sample after a node has begun anew.
    """
    suspects: Counter[str] = Counter()

    def look(k: int, estimator: Estimator) -> None:
        if k >= begin and k % LOOKED_EVERY == 0 and (suspicion := estimator.suspicion()) is not None:
            suspects[suspicion["signal"]] += 1

    name = joint.removesuffix(" fitted")
    if joint == name:
        model, monitor = kit.declared(name), None
    else:
        model, baseline = _fitted(name)
        monitor = ModelMonitor(model, T, baseline)
    estimates, _ = kit.play(model, samples, model_monitor=monitor, look=look, restarted=restarted)
    return estimates, suspects.most_common(1)[0][0] if suspects else ""


def _count(estimates: kit.Estimates, suspected: str, motion: kit.Motion, begin: int) -> Outcome:
    wrong = kit.wrong(estimates, motion.stiffness_nm_rad)[begin:]
    silent = wrong & (estimates.status[begin:] & FLAGS == 0)
    torque = kit.wrong_torque(estimates, motion.torque_nm)[begin:]
    valid = estimates.valid[begin:], estimates.torque_valid[begin:]
    counts = (int(which.sum()) for which in (valid[0], wrong, silent, valid[1], torque))
    return Outcome(len(wrong), *counts, suspected)


def unnoticed(
    joint: str, kind: str, signal: str, *, health_s: float, fault_s: float, seed: int = 0
) -> tuple[float, float]:
    """The largest size of a fault up to which nothing is said of it, and the stiffness's relative error then.

    Nothing is said where every sample is valid and without a flag. 0, 0: even the smallest size is noticed.
    """
    _, sizes, _, spoil = LADDERS[kind]
    motion, begin = _healthy(joint, health_s + fault_s, seed), round(health_s / T)
    truth, last = motion.stiffness_nm_rad[begin:], (0.0, 0.0)
    for size in sizes:
        samples = _spoilt(motion.samples, begin, Fault(kind, (signal,), spoil(size)), seed)
        estimates, _ = _estimates(joint, samples, len(samples))
        if not np.all(estimates.valid[begin:] & (estimates.status[begin:] & FLAGS == 0)):
            break
        last = size, float(np.max(np.abs(estimates.stiffness_nm_rad[begin:] / truth - 1.0)))
    return last


def garbled(
    joint: str,
    share: float,
    positions: bool,
    *,
    health_s: float,
    garbage_s: float,
    after_s: float,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Valid and wrong samples, from the end of a time on in which readings had some of their bits turned.

    A `share` of the samples is hit, each signal of it with a probability of a half: the torques, or (`positions`)
    all of them.
    """
    motion, rng = _healthy(joint, health_s + garbage_s + after_s, seed), np.random.default_rng(seed)
    begin, end = round(health_s / T), round((health_s + garbage_s) / T)
    most = max(abs(torque) for sample in motion.samples for torque in sample.motor_torque_nm)
    angle = 2.0 * np.pi / 2**16

    def turned(value: float, count: float) -> float:
        if rng.random() < 0.5:
            return value
        bits = np.bitwise_or.reduce(1 << rng.integers(0, 16, 3))
        return float(np.int16(np.uint16((round(value / count) & 0xFFFF) ^ int(bits)))) * count

    samples = list(motion.samples)
    for k in (k for k in range(begin, end) if rng.random() < share):
        s = samples[k]
        s = s._replace(motor_torque_nm=tuple(turned(value, 1e-3 * most) for value in s.motor_torque_nm))
        if positions:
            motors = tuple(turned(value, angle) for value in s.motor_position_rad)
            s = s._replace(motor_position_rad=motors, link_position_rad=turned(s.link_position_rad, angle))
        samples[k] = s
    estimates, _ = _estimates(joint, samples, len(samples))
    return estimates.valid[end:], kit.wrong(estimates, motion.stiffness_nm_rad)[begin:]
