"""External torque without a sensor, beside the usual methods, on simulated joints.

    python benchmarks/external.py [--minutes 60] [--errors 0,1,2,5,10] [--joints vsa,sea,hd]

Each joint moves freely for so long; then its link is pushed by steps of 0.25 s, weak and strong ones in turn.
The declared link inertia and gravity are off by so many per cent, and the declaration says so
(`inertia_std_kg_m2`, `gravity_std_nm`). No method knows the springs. drivelink's joint file has the motor's
friction as `diagnose` would have left it, 10 % too low.

- rigid: the momentum observer on motor position and current, motor and link being one body.
- rigid, friction: the same with viscous and Coulomb friction, fitted to the free motion, taken off.
- nominal spring: the link's momentum and a spring as its data sheet has it, 10 % too soft.
- drivelink, threshold: its torque judged as the others' are.
- drivelink: its contact bit, with one false alarm an hour.

All have the same filter. The threshold of all but the last is their largest value in the free
motion: no false alarm in that time.

error: rms of the torque from 60 ms after a push began, over the push; of pushes of a fifth of gravity and
more. smallest: the push from which on nine in ten are found within 20 ms, of those that begin while something
is valid. delay: median over pushes of half of gravity and more. alarms: contacts in the free motion. valid:
share of the free motion in which the torque is valid.
"""

import math
import os
import statistics
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import scene

from drivelink.demo.simulate import world_from_joint
from drivelink.jointfile import JointFile, parse
from estimator import Effect, EstimatorSettings, ExternalStatus, JointModel, Record, make_estimator
from estimator.filters import StateVariableFilter
from sim.plant import MotorPlant

T = 0.001
LEARN_S = 40.0  # free motion before the pushes, in which drivelink estimates the springs
PUSH_S, EVERY_S = 0.25, 1.0
LADDER = [0.004 * 1.35**k for k in range(19)]  # of gravity
EACH = 10
WITHIN_S, SETTLED_S = 0.020, 0.060
FOUND = 0.9
KNOWN = 0.9  # the friction of drivelink's joint file over the true one
NOMINAL = 0.9  # a data sheet's spring over the true one
LARGE, TYPICAL = 0.2, 0.5  # of gravity
BANDWIDTH = EstimatorSettings().external_bandwidth_rad_s

SEA = """name = "sea"
[[motor]]
inertia_kg_m2 = 0.125
viscous_damping_nm_s_rad = 0.8
transmission = { model = "polynomial", order = 2, parameters = { coefficients_nm_rad = [150.0, 1500.0] } }
effect = [{ name = "coulomb_friction", parameters = { torque_nm = 0.75 } }]
[motor.drive]
node_id = 1
counts_per_rev = 4096
rated_current_a = 6.0
gear_ratio = 50.0
torque_constant_nm_a = 0.05
[link]
encoder = { source = "cia406", node_id = 3, counts_per_rev = 131072 }
dynamics = { inertia_kg_m2 = 0.4, viscous_damping_nm_s_rad = 0.1, gravity_nm = 6.0 }
[sim.excitation]
kind = "rich"
low_hz = 0.15
high_hz = 4.0
amplitude_nm = 8.0
centring_nm_rad = 10.0
centring_nm_s_rad = 1.0
"""
HD = """name = "hd"
[[motor]]
inertia_kg_m2 = 1.5
viscous_damping_nm_s_rad = 8.0
transmission = { model = "polynomial", order = 2, parameters = { coefficients_nm_rad = [8000.0, 1.0e8] } }
[[motor.effect]]
name = "stribeck_friction"
parameters = { torque_nm = 5.0, stribeck_nm = 2.0, stribeck_velocity_rad_s = 0.1 }
[[motor.effect]]
name = "load_dependent_friction"
parameters = { coefficient = 0.06 }
[motor.drive]
node_id = 1
counts_per_rev = 4096
rated_current_a = 6.0
gear_ratio = 100.0
torque_constant_nm_a = 0.1
[link]
encoder = { source = "cia406", node_id = 3, counts_per_rev = 1048576 }
dynamics = { inertia_kg_m2 = 2.0, viscous_damping_nm_s_rad = 1.0, gravity_nm = 30.0 }
[sim.excitation]
kind = "rich"
low_hz = 0.15
high_hz = 4.0
amplitude_nm = 40.0
centring_nm_rad = 40.0
centring_nm_s_rad = 10.0
"""
VSA = (scene.ROOT / "drivelink" / "joints" / "vsa-ii.toml").read_text(encoding="utf-8")
RIGS = {
    "vsa": ("VSA-II (the paper's), no friction", VSA),
    "sea": ("SEA, 150 N·m/rad, gear 50", SEA),  # dry friction of 5 % of the rated torque
    "hd": ("harmonic drive, 8000 N·m/rad, gear 100", HD),
}


def declared(joint: JointFile, error: float) -> JointModel:
    """The model in drivelink's joint file: springs unknown, friction too low, link off by a share."""
    model, link = joint.model(), joint.link.dynamics
    assert link is not None and model.link is not None
    motors = tuple(
        replace(
            motor,
            transmission=replace(motor.transmission, parameters={}),
            effects=tuple(_too_low(effect) for effect in motor.effects),
        )
        for motor in model.motors
    )
    dynamics = replace(
        model.link,
        inertia_kg_m2=(1.0 + error) * link.inertia_kg_m2,
        gravity_nm=(1.0 + error) * link.gravity_nm,
        inertia_std_kg_m2=error * link.inertia_kg_m2,
        viscous_damping_std_nm_s_rad=error * link.viscous_damping_nm_s_rad,
        gravity_std_nm=error * link.gravity_nm,
    )
    return replace(model, motors=motors, link=dynamics)


def _too_low(effect: Effect) -> Effect:
    """As diagnose finds it: 10 % too low."""
    shapes = {"smoothing_rad_s", "stribeck_velocity_rad_s"}
    scaled = {k: v if k in shapes else KNOWN * v for k, v in effect.parameters.items()}
    return replace(effect, parameters=scaled | {"smoothing_rad_s": 0.01})


def pushes(scale: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Begin (s) and size (N·m) of each push, in an order of its own."""
    rng = np.random.default_rng(seed)
    sizes = rng.permutation(np.repeat(LADDER, EACH)) * scale * rng.choice([-1.0, 1.0], len(LADDER) * EACH)
    begins = LEARN_S + EVERY_S * np.arange(len(sizes)) + rng.uniform(0.0, 0.4, len(sizes))
    return np.round(begins / T) * T, sizes


def simulate(joint: JointFile, seconds: float, seed: int, pushed: bool) -> Record:
    n, world = round(seconds / T), world_from_joint(joint, seed=seed)
    if pushed:
        assert joint.link.dynamics is not None and world.excitation is not None
        profile = np.zeros(n)
        for begin, size in zip(*pushes(joint.link.dynamics.gravity_nm, seed), strict=True):
            at = round(begin / T)
            profile[at : at + round(PUSH_S / T)] = size
        world.excitation = replace(
            world.excitation, external=lambda t: float(profile[min(n - 1, round(t / T))])
        )
    m = world.motors
    theta, tau, q = np.empty((n, m)), np.empty((n, m)), np.empty(n)
    for k in range(n):
        if k:
            world.advance()
        for i, drive in enumerate(world.drives):
            signals = world.drive(i)
            theta[k, i] = signals.position_counts / drive.counts_per_rad
            tau[k, i] = signals.current_a * drive.joint_torque_per_ampere
        q[k] = world.link_counts() / world.encoder.counts_per_rad
    return scene.joints.recorded(theta, tau, q, T)


def ours(model: JointModel, motion: Record) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """drivelink's external torque, whether it is valid, and its contact bit."""
    estimator = make_estimator(model, EstimatorSettings(contact_torque_nm=0.0), T)
    torque, status = np.empty(len(motion)), np.zeros(len(motion), dtype=np.int64)
    for k, sample in enumerate(motion.samples()):
        estimator.step(sample)
        estimated = estimator.external
        assert estimated is not None
        torque[k], status[k] = estimated.external_torque_nm, estimated.status
    return torque, status & int(ExternalStatus.VALID) > 0, status & int(ExternalStatus.CONTACT) > 0


def link_side(model: JointModel, q: np.ndarray) -> np.ndarray:
    """F of M q" + D_q q' + g(q)."""
    link = model.link
    assert link is not None
    F = StateVariableFilter(3, BANDWIDTH, T)
    _, rate, acceleration = F.apply(q, 2)
    (gravity,) = F.apply(link.gravity_nm * np.sin(q))
    return link.inertia_kg_m2 * acceleration + link.viscous_damping_nm_s_rad * rate + gravity


def rigid(model: JointModel, motion: Record, compensated: bool) -> np.ndarray:
    """The momentum observer of a rigid joint: motor and link are one body where the motor is."""
    F = StateVariableFilter(3, BANDWIDTH, T)
    total = link_side(model, motion.motor_position_rad.mean(axis=1))
    for i, motor in enumerate(model.motors):
        _, rate, acceleration = F.apply(motion.motor_position_rad[:, i], 2)
        (torque,) = F.apply(motion.motor_torque_nm[:, i], held=True)
        total += motor.inertia_kg_m2 * acceleration + motor.viscous_damping_nm_s_rad * rate - torque
        if compensated:
            fast = 0.02 * np.max(np.abs(rate))
            columns = np.stack([np.tanh(rate / fast), rate, np.ones(len(rate))], axis=1)
            free = slice(round(5.0 / T), round(LEARN_S / T))
            weights, *_ = np.linalg.lstsq(columns[free], total[free], rcond=None)
            total -= columns @ weights
    return total


def nominal(model: JointModel, motion: Record, motors: Sequence[MotorPlant]) -> np.ndarray:
    """The link's momentum and a data sheet's springs."""
    F = StateVariableFilter(3, BANDWIDTH, T)
    assert motion.link_position_rad is not None
    total = link_side(model, motion.link_position_rad)
    for i, motor in enumerate(motors):
        law = motor.law()
        phi = motion.link_position_rad - motion.motor_position_rad[:, i]
        (torque,) = F.apply(NOMINAL * np.array([law.torque(x) for x in phi.tolist()]))
        total += torque
    return total


def judge(g: float, estimated: np.ndarray, contact: np.ndarray, seed: int) -> dict[str, float]:
    """Error where a value is valid (else NaN), smallest push, delay; gravity g in N·m."""
    errors, delays = [], []
    found: dict[float, list[bool]] = {size: [] for size in LADDER}
    for begin, size in zip(*pushes(g, seed), strict=True):
        at, share = round(begin / T), abs(size) / g
        rung = min(LADDER, key=lambda x: abs(x - share))
        if not np.isfinite(estimated[at]):
            continue
        seen = np.flatnonzero(contact[at : at + round(PUSH_S / T)])
        late = seen[0] * T if len(seen) and not contact[at] else math.inf
        found[rung].append(late <= WITHIN_S)
        if share >= LARGE:
            window = slice(at + round(SETTLED_S / T), at + round(PUSH_S / T))
            off = (estimated[window] - size)[np.isfinite(estimated[window])] / size
            errors += (off**2).tolist()
        if share >= TYPICAL:
            delays.append(late)
    smallest = math.inf
    for rung in reversed(LADDER):
        if sum(found[rung]) < FOUND * len(found[rung]):
            break
        smallest = rung
    return {
        "error": math.sqrt(statistics.fmean(errors)),
        "smallest": smallest,
        "delay_ms": 1e3 * statistics.median(delays),
    }


def measure(name: str, minutes: float, errors: list[float], seed: int = 1) -> list[dict[str, Any]]:
    title, text = RIGS[name]
    joint = parse(text)
    assert joint.link.dynamics is not None
    g, springs = joint.link.dynamics.gravity_nm, world_from_joint(joint).plant.motors
    free = simulate(joint, LEARN_S + 60.0 * minutes, seed, pushed=False)
    motion = simulate(joint, LEARN_S + EVERY_S * (len(LADDER) * EACH + 1), seed + 1, pushed=True)
    rows: list[dict[str, Any]] = []
    after = slice(round(LEARN_S / T), None)
    for error in errors:
        model = declared(joint, 0.01 * error)
        torque, valid, contact = ours(model, free)
        pushed, sound, touched = ours(model, motion)
        pushed = np.where(sound, pushed, np.nan)
        methods: dict[str, dict[str, Any]] = {"drivelink": judge(g, pushed, touched, seed + 1)}
        methods["drivelink"] |= {
            "valid": float(np.mean(valid[after])),
            "alarms": int(np.count_nonzero(np.diff(contact[after].astype(int)) > 0)),
        }
        for method, quiet, estimated in (
            ("drivelink, threshold", np.where(valid, torque, np.nan), pushed),
            ("rigid", rigid(model, free, False), rigid(model, motion, False)),
            ("rigid, friction", rigid(model, free, True), rigid(model, motion, True)),
            ("nominal spring", nominal(model, free, springs), nominal(model, motion, springs)),
        ):
            threshold = float(np.nanmax(np.abs(quiet[after])))
            methods[method] = judge(g, estimated, np.abs(estimated) > threshold, seed + 1)
        common = {"joint": title, "error_percent": error, "alarms": None, "valid": None}
        rows += [common | {"method": method, **values} for method, values in methods.items()]
    return rows


def rows(args) -> Iterator[scene.Row]:
    errors = [float(text) for text in args.errors]
    with ProcessPoolExecutor(args.jobs) as pool:
        for run in [pool.submit(measure, name, args.minutes, errors) for name in args.joints]:
            yield from run.result()


if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        {
            "joint": "{joint}",
            "model / %": "{error_percent:g}",
            "method": "{method}",
            "error": "{error:.1%}",
            "smallest, of gravity": "{smallest:.1%}",
            "delay / ms": "{delay_ms:.0f}",
            "alarms": "{alarms}",
            "valid": "{valid:.1%}",
        },
        scene.Option("--minutes", 60.0, "of free motion"),
        scene.Option("--errors", ["0", "1", "2", "5", "10"], "of declared inertia and gravity, per cent"),
        scene.Option("--joints", list(RIGS)),
        scene.Option("--jobs", os.cpu_count() or 1),
    )
