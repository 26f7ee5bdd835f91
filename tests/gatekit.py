"""Random joints of every kind as they are recorded, and the faults of a first installation.

A joint is drawn from a seed: its bodies, spring, gear, sensors, a rig of some gain that moves it, friction
and other effects that nobody declares, late encoders, and a declared inertia that is up to a fifth off.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache

import joints
import numpy as np

from estimator import JointModel, Motor, Record, Transmission
from sim.effects import PlantEffect, make
from sim.excitation import build
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring
from sim.sensors import DriveHardware, LinkEncoder
from sim.variation import suitable, typical_torque_nm
from sim.world import World, record

KINDS = ("soft", "stiff", "geared", "antagonistic", "serial", "none")
PERIOD_S = 0.001
_NATURAL_HZ = {
    "soft": (1.0, 5.0),
    "stiff": (15.0, 60.0),
    "geared": (8.0, 40.0),
    "antagonistic": (1.0, 6.0),
    "serial": (2.0, 10.0),
    "none": (1.0, 1.0),
}  # fmt: skip


@dataclass(frozen=True)
class Drawn:
    """A joint: what was recorded of it, what is declared, and the gear ratio of each motor."""

    record: Record
    model: JointModel
    gears: tuple[float, ...]


@cache
def draw(kind: str, seed: int, *, effects: bool = True, seconds: float = 8.0, held: bool = False) -> Drawn:
    """The joint of that kind and seed, recorded in a rich motion; with its link held, if asked for."""
    rng = np.random.default_rng((KINDS.index(kind), seed))
    plant, stiffness = _plant(kind, rng)
    link, motors, damping = plant.link, len(plant.motors), plant.motors[0].viscous_damping_nm_s_rad
    torque = typical_torque_nm(plant) * _between(rng, 0.5, 2.0)
    drive = _drive(kind, torque, rng)
    rig = suitable(plant) | {"amplitude_nm": torque, "seed": seed, "low_hz": 0.2}
    rig |= {"high_hz": _between(rng, 3.0, 10.0)}
    gain = _between(rng, 0.3, 3.0)
    rig |= {key: gain * rig[key] for key in ("centring_nm_rad", "centring_nm_s_rad")}
    if held:
        plant = replace(plant, link=replace(link, inertia_kg_m2=1e6 * link.inertia_kg_m2, gravity_nm=0.0))
    world = World(
        plant,
        (drive,) * motors,
        LinkEncoder(
            counts_per_rev=float(2 ** rng.integers(17, 21)), zero_rad=float(rng.uniform(-0.01, 0.01))
        ),
        excitation=build(rig, motors),
        effects=_effects(rng, torque, stiffness, damping) if effects else (),
        period_s=PERIOD_S,
        seed=seed,
    )
    gear, beside = drive.gear_ratio, link.inertia_kg_m2 if kind == "none" else 0.0
    declared = tuple(
        Motor(
            inertia_kg_m2=plant.motors[0].inertia_kg_m2 * float(rng.uniform(0.8, 1.2)) + beside,
            viscous_damping_nm_s_rad=damping,
            gear_ratio=gear if gear > 1.0 else None,
            transmission=Transmission(
                model="none" if kind == "none" or (kind == "serial" and i) else "polynomial"
            ),
        )
        for i in range(motors)
    )
    model = JointModel(arrangement=plant.arrangement, motors=declared, period_s=PERIOD_S)
    recorded = joints.of_world(record(world, seconds), linked=kind != "none")
    return Drawn(recorded, model, (gear,) * motors)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(low * (high / low) ** rng.random())


def _plant(kind: str, rng: np.random.Generator) -> tuple[JointPlant, float]:
    """A joint of that kind, and its stiffness in N·m/rad."""
    motors = 2 if kind in ("antagonistic", "serial") else 1
    inertia = _between(rng, 0.02, 2.0) if kind == "geared" else _between(rng, 5e-4, 0.2)
    stiffness = inertia * (2.0 * math.pi * _between(rng, *_NATURAL_HZ[kind])) ** 2
    damping = 2.0 * _between(rng, 0.01, 0.1) * math.sqrt(stiffness * inertia)
    motor = MotorPlant(
        inertia_kg_m2=inertia, viscous_damping_nm_s_rad=damping, spring=_spring(kind, stiffness, rng)
    )
    link = LinkPlant(
        inertia_kg_m2=inertia * _between(rng, 0.5, 8.0),
        viscous_damping_nm_s_rad=0.1 * damping,
        gravity_nm=stiffness * _between(rng, 0.01, 0.1) if rng.random() < 0.5 else 0.0,
    )
    arrangement = kind if motors == 2 else "single"
    lever = _between(rng, 0.3, 1.0) if kind == "serial" else 0.0
    plant = JointPlant(arrangement=arrangement, motors=(motor,) * motors, link=link, lever_per_rad=lever)
    return plant, stiffness


def _drive(kind: str, torque: float, rng: np.random.Generator) -> DriveHardware:
    gear = {"geared": _between(rng, 50.0, 160.0), "none": 1.0}.get(kind, _between(rng, 5.0, 40.0))
    rated = torque / gear
    return DriveHardware(
        counts_per_rev=float(rng.choice([4096, 16384, 131072])),
        gear_ratio=gear,
        torque_constant_nm_a=0.05,
        rated_current_a=rated / 0.05,
        max_current_a=20.0 * rated / 0.05,
        current_noise_a=rated / 0.05 * _between(rng, 5e-4, 5e-3),
    )


def _spring(kind: str, stiffness: float, rng: np.random.Generator) -> Spring:
    if kind == "none":
        return Spring(model="none")
    if kind in ("stiff", "geared") or rng.random() < 0.4:
        return Spring(model="linear", parameters={"k_nm_rad": stiffness})
    if rng.random() < 0.5:
        return Spring(
            model="exponential", parameters={"k_nm_rad": stiffness, "b_per_rad": float(rng.uniform(2, 8))}
        )
    hardening = stiffness * float(rng.uniform(5.0, 50.0))
    return Spring(model="polynomial", parameters={"coefficients_nm_rad": (stiffness, hardening)})


def _effects(
    rng: np.random.Generator, torque: float, stiffness: float, damping: float
) -> tuple[PlantEffect, ...]:
    """Late channels, and up to two of the effects that a recording is diagnosed for."""
    found = [
        make("encoder_delay", {"delay_s": PERIOD_S * float(rng.uniform(0.0, 4.0))}),
        make("torque_delay", {"delay_s": PERIOD_S * float(rng.uniform(0.0, 3.0))}),
    ]
    size = float(rng.uniform(0.05, 0.25))
    offered: dict[str, Mapping[str, object]] = {
        "coulomb_friction": {"torque_nm": size * torque},
        "stribeck_friction": {"torque_nm": 0.6 * size * torque},
        "asymmetric_friction": {"positive_nm": size * torque},
        "load_dependent_friction": {"coefficient": size},
        "viscous_damping": {"damping_nm_s_rad": damping},
        "cogging": {"sin_nm": 0.3 * size * torque},
        "torque_constant": {"relative_error": -size},
        "torque_offset": {"torque_nm": size * torque},
        "encoder_scale": {"relative_error": 0.02},
    }
    chosen = rng.choice(sorted(offered), size=int(rng.integers(0, 3)), replace=False)
    return (*found, *(make(str(name), offered[str(name)]) for name in chosen))


def faulty(record: Record, factors: Mapping[str, float]) -> Record:
    """The recording with channels multiplied: "motor1_position", "motor1_torque", "link_position", "time"."""
    positions, torques = record.motor_position_rad.copy(), record.motor_torque_nm.copy()
    link, period = record.link_position_rad, record.period_s
    for channel, factor in factors.items():
        motor, _, name = channel.partition("_")
        if channel == "time":
            period = period * factor
        elif channel == "link_position":
            assert link is not None
            link = link * factor
        else:
            (positions if name == "position" else torques)[:, int(motor[-1]) - 1] *= factor
    return replace(
        record, motor_position_rad=positions, motor_torque_nm=torques, link_position_rad=link, period_s=period
    )


def faults(drawn: Drawn) -> dict[str, dict[str, float]]:
    """Every single fault that this joint can have, by name: recorded over true value of each channel."""
    motors, linked = range(1, drawn.record.motors + 1), drawn.record.link_position_rad is not None
    positions = [f"motor{i}_position" for i in motors] + (["link_position"] if linked else [])
    degree = 180.0 / math.pi
    found: dict[str, dict[str, float]] = {
        "positions in degrees": dict.fromkeys(positions, degree),
        "torques in N·mm": {f"motor{i}_torque": 1e3 for i in motors},
        "time in ms": {"time": 1e3},
    }
    for i in motors:
        gear = drawn.gears[i - 1]
        position, torque = f"motor{i}_position", f"motor{i}_torque"
        found[f"motor {i} position reversed"] = {position: -1.0}
        found[f"motor {i} torque reversed"] = {torque: -1.0}
        if linked:
            found[f"motor {i} position in degrees"] = {position: degree}
            found[f"motor {i} position taken for degrees"] = {position: 1.0 / degree}
        if drawn.model.motors[i - 1].flexible and len(motors) > 1:
            found[f"motor {i} reversed"] = {position: -1.0, torque: -1.0}
        if len(motors) > 1:
            found[f"motor {i} torque in N·mm"] = {torque: 1e3}
        if gear > 3.0:
            found[f"motor {i} at the shaft"] = {position: gear, torque: 1.0 / gear}
            found[f"motor {i} position at the shaft"] = {position: gear}
            found[f"motor {i} torque at the shaft"] = {torque: 1.0 / gear}
    if linked:
        found["link in degrees"] = {"link_position": degree}
        found["link reversed"] = {"link_position": -1.0}
    return found


def named_rightly(
    factors: Mapping[str, float], changes: Mapping[str, float], same: Callable[[float, float], bool]
) -> bool:
    """Whether a correction undoes what was done to the channels."""
    keys = {*factors, *changes}
    return all(same(factors.get(key, 1.0) * changes.get(key, 1.0), 1.0) for key in keys)
