"""Joints that several tests of the world use."""

import math

import numpy as np

from sim.effects import PlantEffect
from sim.excitation import build
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring
from sim.sensors import DriveHardware, LinkEncoder
from sim.world import World, record

LINEAR = Spring(model="linear", parameters={"k_nm_rad": 150.0})
HARDENING = Spring(model="polynomial", parameters={"coefficients_nm_rad": (120.0, 4000.0, 9000.0)})
VSA_II = Spring(model="vsa-ii", parameters={"k_nm_rad": 0.5, "c": 1.75})
EXPONENTIAL = Spring(model="exponential", parameters={"k_nm_rad": 80.0, "b_per_rad": 12.0})
RIGID = Spring(model="none")

# Sensors so fine that only the physics is left: 2^40 counts, no noise, no steps.
PERFECT = DriveHardware(
    counts_per_rev=2.0**40, gear_ratio=50.0, torque_constant_nm_a=0.05, rated_current_a=8.0,
    current_resolution_a=1e-12, velocity_resolution_rad_s=0.0,
)  # fmt: skip
PERFECT_ENCODER = LinkEncoder(counts_per_rev=2.0**40)

EXCITATION = {
    "kind": "multisine", "amplitude_nm": 8.0, "low_hz": 0.3, "high_hz": 6.0, "centring_nm_rad": 10.0,
    "centring_nm_s_rad": 1.0,
}  # fmt: skip


def sea(
    spring: Spring = LINEAR,
    *,
    motors: int = 1,
    damping: float = 0.8,
    gravity: float = 6.0,
    lever: float = 0.0,
) -> JointPlant:
    """A soft joint of usual size; two motors with a lever are serial, without one antagonistic."""
    motor = MotorPlant(inertia_kg_m2=0.125, viscous_damping_nm_s_rad=damping, spring=spring)
    link = LinkPlant(inertia_kg_m2=0.4, viscous_damping_nm_s_rad=damping / 8.0, gravity_nm=gravity)
    if motors == 1:
        return JointPlant(arrangement="single", motors=(motor,), link=link)
    arrangement = "serial" if lever else "antagonistic"
    return JointPlant(arrangement=arrangement, motors=(motor, motor), link=link, lever_per_rad=lever)


def measured(
    plant: JointPlant, *effects: PlantEffect, seconds: float = 4.0, step_s: float | None = None
) -> dict[str, np.ndarray]:
    """A recording of that joint in rich motion, with perfect sensors."""
    drives = (PERFECT,) * len(plant.motors)
    excitation = build(EXCITATION, len(drives))
    world = World(plant, drives, PERFECT_ENCODER, excitation=excitation, effects=effects, plant_step_s=step_s)
    return record(world, seconds)


def energy(plant: JointPlant, state: list[float]) -> float:
    """Kinetic and potential energy (J) of an undamped joint."""
    link, q, v = plant.link, state[0], state[1]
    total = 0.5 * link.inertia_kg_m2 * v * v - link.gravity_nm * math.cos(q + link.gravity_phase_rad)
    for index, motor in enumerate(plant.motors):
        theta, w = state[2 + 2 * index], state[3 + 2 * index]
        total += 0.5 * motor.inertia_kg_m2 * w * w
        if plant.arrangement != "serial":
            total += motor.law().potential(q - theta)
    if plant.arrangement == "serial":
        ratio = 1.0 + plant.lever_per_rad * state[4]
        total += ratio * ratio * plant.motors[0].law().potential(q - state[2])
    return total
