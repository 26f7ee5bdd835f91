"""Builds simulated world and devices from a joint file.

The truth is one of the paper's cases (`sim.case`), or the joint file's model changed by `sim.parameters`,
plus `sim.effect`. Drives and encoders follow the `drive` and `encoder` sections, so that a daemon with the
same joint file finds what it expects.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import can

from drivelink.errors import JointFileError, UsageError, raised_as
from drivelink.files import open_regular
from drivelink.jointfile import JointFile, MotorSection, SimSection
from estimator.model import LinkDynamics
from sim.canopen.drive import Cia402Drive
from sim.canopen.encoder import Cia406Encoder
from sim.canopen.node import Node
from sim.canopen.profiles import Quirks, profile
from sim.cases import Case, case
from sim.effects import PlantEffect, make, parse
from sim.errors import SimError
from sim.excitation import build
from sim.network import Bench, Network
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring
from sim.sensors import DriveHardware, LinkEncoder
from sim.variation import following, suitable, typical_torque_nm, with_parameters
from sim.world import World as World

# Springs for a joint file without parameters (as `new` writes), by stiffness at rest.
_NATURAL_HZ = 5.0  # sqrt(K/B)/(2 pi) of a soft joint
_STIFFENED_RAD = 0.15  # deflection at which the stiffness of a hardening spring has doubled
_ASSUMED: dict[str, Callable[[float, int], dict[str, float | tuple[float, ...]]]] = {
    "linear": lambda k, _: {"k_nm_rad": k},
    "polynomial": lambda k, order: {
        "coefficients_nm_rad": (k, k / (3.0 * _STIFFENED_RAD**2), *[0.0] * order)[:order]
    },
    "exponential": lambda k, _: {"k_nm_rad": k, "b_per_rad": math.log(2.0) / _STIFFENED_RAD},
    "vsa-ii": lambda k, _: {"k_nm_rad": 2.0 * k / (1.75 - 1.0) ** 2, "c": 1.75},  # the paper's C (eq 20)
}

# World


def world_from_joint(
    joint: JointFile, *, effects: Sequence[str] = (), seed: int | None = None, file: Path | None = None
) -> World:
    """Return the world that a joint file describes, at rest.

    Args:
        effects: "NAME=VALUE" as `sim --effect` takes them, besides those of the file.
        seed: of the sensor noise, instead of `sim.seed`.

    Raises:
        JointFileError: a missing or impossible value.
        UsageError: an effect that does not exist.
    """
    section = joint.sim or SimSection()
    name = section.case
    asked = _asked(effects)
    with raised_as(JointFileError, f"{file or joint.name}: sim", SimError):
        given = case(name) if name else None
        if given and given.plant.arrangement != joint.arrangement:
            raise SimError(f'case "{name}" is {given.plant.arrangement}, this joint is {joint.arrangement}')
        plant = with_parameters(given.plant if given else _plant(joint), section.parameters)
        excitation = build(
            _excitation(section, plant, given, file), len(plant.motors), where="sim.excitation"
        )
        return World(
            plant,
            [_hardware(joint, index, plant, given) for index in range(len(plant.motors))],
            _scale(joint, given),
            excitation=excitation,
            effects=[*_declared(joint, section, given), *asked],
            period_s=joint.bus.period_s,
            seed=section.seed if seed is None else seed,
        )


def alter(world: World, effects: Sequence[str], parameters: Mapping[str, float]) -> None:
    """Make a world another one from now on.

    Args:
        effects: all that it then has, "NAME=VALUE".
        parameters: that it then has, as `[sim] parameters`.

    Raises:
        UsageError: an effect that does not exist.
    """
    world.alter(plant=with_parameters(world.declared, parameters), effects=_asked(effects))


def assumptions(joint: JointFile) -> list[str]:
    """Return assumed values that the joint file does not declare, one line each."""
    if joint.sim is not None and joint.sim.case is not None:
        return []
    lines = []
    for index, motor in enumerate(joint.motor, start=1):
        transmission = motor.transmission
        if transmission.model != "none" and not transmission.parameters and transmission.model in _ASSUMED:
            k = _assumed_stiffness(motor)
            text = f"motor[{index}].transmission has no parameters: simulated with {k:.3g} N·m/rad at rest"
            lines.append(f"{text}, {_NATURAL_HZ:g} Hz with the motor's inertia")
    if joint.link.dynamics is None and not _one_body(joint):
        lines.append("no [link.dynamics]: simulated with twice the first motor's inertia at the link")
    return lines


def _one_body(joint: JointFile) -> bool:
    return joint.motor[0].transmission.model == "none"


def _assumed_stiffness(motor: MotorSection) -> float:
    return motor.inertia_kg_m2 * (2.0 * math.pi * _NATURAL_HZ) ** 2


def _spring(motor: MotorSection, index: int) -> Spring:
    """Return the declared transmission; without parameters one that suits the motor."""
    transmission = motor.transmission
    if transmission.model == "none" or transmission.parameters:
        return Spring(model=transmission.model, parameters=transmission.parameters)
    if transmission.model not in _ASSUMED:
        text = "expected them, no spring is assumed for this model"
        raise SimError(f"motor[{index}].transmission.parameters: {text}")
    k, order = _assumed_stiffness(motor), transmission.order or 2
    return Spring(model=transmission.model, parameters=_ASSUMED[transmission.model](k, order))


def _plant(joint: JointFile) -> JointPlant:
    """Return the declared joint; without link dynamics the link has twice the first motor's inertia.

    The inertia that a rigid joint declares is then that of the whole: next to nothing is left for its link.
    """
    share = 1e-6 if _one_body(joint) else 2.0
    link = joint.link.dynamics or LinkDynamics(inertia_kg_m2=share * joint.motor[0].inertia_kg_m2)
    return JointPlant(
        arrangement=joint.arrangement,
        motors=tuple(
            MotorPlant(
                inertia_kg_m2=motor.inertia_kg_m2,
                viscous_damping_nm_s_rad=motor.viscous_damping_nm_s_rad,
                spring=_spring(motor, index),
            )
            for index, motor in enumerate(joint.motor, start=1)
        ),
        link=LinkPlant(
            inertia_kg_m2=link.inertia_kg_m2,
            viscous_damping_nm_s_rad=link.viscous_damping_nm_s_rad,
            gravity_nm=link.gravity_nm,
            gravity_phase_rad=link.gravity_phase_rad,
        ),
    )


def _declared(joint: JointFile, section: SimSection, given: Case | None) -> list[PlantEffect]:
    """Effects of the file, including the model's if the model is the truth."""
    effects = [make(effect.name, effect.parameters) for effect in section.effect]
    if given is None:
        effects += [
            make(e.name, e.parameters, k) for k, motor in enumerate(joint.motor) for e in motor.effect
        ]
        effects += [make(effect.name, effect.parameters) for effect in joint.link.effect]
    return effects


def _asked(effects: Sequence[str]) -> list[PlantEffect]:
    try:
        return [parse(text) for text in effects]
    except SimError as error:
        raise UsageError(f"--effect: {str(error).removeprefix('effect: ')}") from error


def _excitation(
    section: SimSection, plant: JointPlant, given: Case | None, file: Path | None
) -> Mapping[str, Any]:
    """Return the file's table, completed for the case or plant; a motion's file is beside the joint file."""
    table = section.excitation
    if table.get("kind") == "motion":
        path = (Path() if file is None else file.parent) / str(table.get("file", ""))
        with raised_as(SimError, f"sim.excitation.file: {path}: cannot be read"):
            open_regular(path).close()
        return {**following(plant), **table, "file": str(path)}
    if given is not None and table.get("kind") in (None, given.excitation["kind"]):
        return {**given.excitation, **table}
    suited = given.rich if given is not None else suitable(plant)
    if table.get("kind", "rich") == "rich":
        return {**suited, **table}
    kept = ("centring_nm_rad", "centring_nm_s_rad") + (() if table["kind"] == "none" else ("amplitude_nm",))
    return {**{key: suited[key] for key in kept if key in suited}, **table}


def _hardware(joint: JointFile, index: int, plant: JointPlant, given: Case | None) -> DriveHardware:
    """Return the drive of one motor: declared values, completed by the case or by plausible values."""
    drive = joint.motor[index].drive
    assumed = given.drives[index] if given else DriveHardware()
    if drive is None:
        return assumed
    declared = given is None or "gear_ratio" in drive.model_fields_set
    gear = drive.gear_ratio if declared else assumed.gear_ratio
    rated_a = drive.rated_current_a or assumed.rated_current_a
    constant = drive.torque_constant_nm_a
    if constant is None and drive.rated_torque_nm is not None:
        constant = drive.rated_torque_nm / rated_a
    if constant is None:
        rated_nm = assumed.rated_torque_nm * assumed.gear_ratio if given else typical_torque_nm(plant)
        constant = rated_nm / gear / rated_a
    return DriveHardware(
        counts_per_rev=drive.counts_per_rev or assumed.counts_per_rev,
        gear_ratio=gear,
        torque_constant_nm_a=constant,
        rated_current_a=rated_a,
        current_noise_a=0.002 * rated_a,
        direction=drive.direction,
        torque_direction=drive.torque_direction,
    )


def _scale(joint: JointFile, given: Case | None) -> LinkEncoder | None:
    encoder = joint.link.encoder
    assumed = given.encoder if given else LinkEncoder()
    if encoder is None:
        return assumed
    counts = encoder.counts_per_rev or assumed.counts_per_rev
    return LinkEncoder(counts_per_rev=counts, direction=encoder.direction, zero_rad=-encoder.offset_rad)


# Devices


def nodes_from_joint(
    joint: JointFile, world: World, *, quirks: str | None = None, file: Path | None = None
) -> tuple[Node, ...]:
    """Return the drives and the encoder of a joint.

    Args:
        quirks: name of a profile instead of `sim.quirks`.

    Raises:
        JointFileError: a motor without a drive, or an unknown profile in the file.
        UsageError: an unknown profile in `quirks`.
    """
    own = _profile(joint, quirks)
    encoder = joint.link.encoder
    host = None
    if encoder is not None and encoder.source == "drive":
        host = encoder.node_id or (joint.motor[0].drive.node_id if joint.motor[0].drive else None)
        if place := re.fullmatch(r"0x60[Ee]4:(\d+)", encoder.object or ""):
            own = replace(own, second_encoder=int(place[1]))
    nodes: list[Node] = []
    for index, motor in enumerate(joint.motor):
        if motor.drive is None:
            text = "expected this table to simulate it"
            raise JointFileError(f"{file or joint.name}: motor[{index + 1}].drive: {text}")
        number = motor.drive.node_id
        nodes.append(Cia402Drive(number, world, index, own, link_encoder=number == host))
    if encoder is not None and encoder.source == "cia406" and encoder.node_id is not None:
        nodes.append(Cia406Encoder(encoder.node_id, world))
    return tuple(nodes)


def _profile(joint: JointFile, quirks: str | None) -> Quirks:
    try:
        return profile(quirks or (joint.sim.quirks if joint.sim else None) or "strict")
    except SimError as error:
        if quirks:
            raise UsageError(f"--{error}") from error
        raise JointFileError(f"{joint.name}: sim.{error}") from error


def network_from_joint(joint: JointFile, bus: can.BusABC, *, world: World | None = None) -> Network:
    """Return the devices of one joint on a bus, in lockstep (`poll`) or served (`start`)."""
    world = world or world_from_joint(joint)
    return Network(bus, nodes_from_joint(joint, world), world)


def bench_from_joints(
    joints: Sequence[JointFile],
    *,
    effects: Sequence[str] = (),
    quirks: str | None = None,
    seed: int | None = None,
    files: Sequence[Path] = (),
) -> Bench:
    """Return worlds and devices of several joints; arguments as for `world_from_joint`, `nodes_from_joint`.

    Raises:
        JointFileError: a joint file cannot be simulated.
        UsageError: two devices have the same node id, or an argument is wrong.
    """
    paths: Sequence[Path | None] = files or [None] * len(joints)
    named = list(zip(joints, paths, strict=True))
    worlds = [world_from_joint(j, effects=effects, seed=seed, file=path) for j, path in named]
    nodes = [
        nodes_from_joint(j, w, quirks=quirks, file=path) for (j, path), w in zip(named, worlds, strict=True)
    ]
    try:
        return Bench([joint.name for joint in joints], worlds, nodes)
    except SimError as error:
        raise UsageError(str(error)) from error
