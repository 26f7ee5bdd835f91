"""The paper's three cases (section V) as worlds.

The paper's units are N·mm, N·mm/rad and, for inertias, kg·m·mm; one kg·m·mm is 1e-3 kg·m², as the other two
are 1e-3 of theirs, so that all numbers go over by the same factor.

| quantity | constant, quadratic | VSA-II |
|---|---|---|
| transmission | K = 0.1 N·m/rad; K1 = 0.1, K3 = 0.5 N·m/rad³ | k = 0.5 N·m/rad, C = 1.75, both (eqs 19, 20) |
| B | 0.05 kg·m² | 0.0005 kg·m², assumed |
| M | 0.1 kg·m² | 0.003 kg·m², assumed |
| D_theta, D_q | 0.001, 0.0001 N·m·s/rad | 0.005, 0.001 N·m·s/rad, assumed |
| g(q) | 0.025 sin q N·m | 0.2943 sin q N·m, assumed |
| torque | 0.01 sin 0.1πt N·m | 0.1 sin 0.1πt, 0.1 sin 0.2πt N·m, assumed |

Drives, gears and encoders are assumed in every case: the paper states none. Reasons stand beside the values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim.effects import PlantEffect
from sim.errors import SimError, expected
from sim.excitation import build
from sim.plant import JointPlant, LinkPlant, MotorPlant, Spring
from sim.sensors import RPM_RAD_S, DriveHardware, LinkEncoder
from sim.world import World


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A named case."""

    name: str  # "constant", "quadratic" or "vsa-ii"
    plant: JointPlant
    drives: tuple[DriveHardware, ...]  # one per motor
    encoder: LinkEncoder  # at the link
    excitation: Mapping[str, Any]  # the paper's torque, as a table for `sim.excitation.build`
    rich: Mapping[str, Any]  # a richer torque for the same joint

    def world(
        self,
        *,
        excitation: Mapping[str, Any] | None = None,
        effects: Sequence[PlantEffect] = (),
        seed: int = 0,
    ) -> World:
        """Return the case at rest.

        Args:
            excitation: a table in place of the paper's.
        """
        return World(
            self.plant,
            self.drives,
            self.encoder,
            excitation=build(self.excitation if excitation is None else excitation, len(self.drives)),
            effects=effects,
            seed=seed,
        )


_ENCODER = LinkEncoder()  # 18 bit, a usual absolute encoder
_FINE_RAD_S = 0.001 * RPM_RAD_S  # of the velocity: the finest unit that usual CiA 402 drives offer


def _rich(**numbers: float) -> Mapping[str, Any]:
    return {"kind": "rich", "low_hz": 0.1, **numbers}


def _paper_joint(name: str, spring: Spring) -> Case:
    motor = MotorPlant(inertia_kg_m2=0.05, viscous_damping_nm_s_rad=0.001, spring=spring)
    link = LinkPlant(inertia_kg_m2=0.1, viscous_damping_nm_s_rad=0.0001, gravity_nm=0.025)
    drive = DriveHardware(
        # 17 bit: B is large against the torque (0.2 rad/s² at most), a coarser one hides the acceleration
        counts_per_rev=131072.0,
        gear_ratio=20.0,  # any: the paper's quantities are at the joint already
        torque_constant_nm_a=0.005,  # with the current: rated 0.02 N·m at the joint, twice the peak
        rated_current_a=0.2,
        current_noise_a=0.0004,  # 0.2 % of the rated current, between the 0.1 and 0.5 % of real drives
        velocity_resolution_rad_s=_FINE_RAD_S,
    )
    return Case(
        name=name,
        plant=JointPlant(arrangement="single", motors=(motor,), link=link),
        drives=(drive,),
        encoder=_ENCODER,
        excitation={"kind": "sines", "amplitude_nm": 0.01, "frequency_hz": 0.05},
        rich=_rich(amplitude_nm=0.02, high_hz=2.0, centring_nm_rad=0.02, centring_nm_s_rad=0.03),
    )


def _constant() -> Case:
    """Section V-A."""
    return _paper_joint("constant", Spring(model="linear", parameters={"k_nm_rad": 0.1}))


def _quadratic() -> Case:
    """Section V-B, eq 34."""
    spring = Spring(model="polynomial", parameters={"coefficients_nm_rad": (0.1, 0.5)})
    return _paper_joint("quadratic", spring)


def _vsa_ii() -> Case:
    """Section V-C, eqs 19, 20."""
    spring = Spring(model="vsa-ii", parameters={"k_nm_rad": 0.5, "c": 1.75})
    # a rotor of 12.5 g·cm² behind a gear of 20; damping about 0.3 of critical at the motors
    motor = MotorPlant(inertia_kg_m2=0.0005, viscous_damping_nm_s_rad=0.005, spring=spring)
    # 0.3 kg at 0.1 m: it stays below 45°
    link = LinkPlant(inertia_kg_m2=0.003, viscous_damping_nm_s_rad=0.001, gravity_nm=0.2943)
    drive = DriveHardware(
        counts_per_rev=16384.0,  # 4096 lines, a usual encoder
        gear_ratio=20.0,
        torque_constant_nm_a=0.02,  # with the current: rated 0.2 N·m at the joint
        rated_current_a=0.5,
        current_noise_a=0.001,
        velocity_resolution_rad_s=_FINE_RAD_S,
    )
    return Case(
        name="vsa-ii",
        plant=JointPlant(arrangement="antagonistic", motors=(motor, motor), link=link),
        drives=(drive, drive),
        encoder=_ENCODER,
        # The printed torques lack t, and 10 N·mm does not reach the deflections that the printed polynomials
        # were fitted on; 100 N·mm does.
        excitation={"kind": "sines", "amplitude_nm": 0.1, "frequency_hz": [0.05, 0.1]},
        rich=_rich(amplitude_nm=0.08, high_hz=6.0, centring_nm_rad=0.1, centring_nm_s_rad=0.005),
    )


CASES: Mapping[str, Callable[[], Case]] = {"constant": _constant, "quadratic": _quadratic, "vsa-ii": _vsa_ii}
"""The cases by name."""


def case(name: str) -> Case:
    """Return the case of that name.

    Raises:
        SimError: there is none.
    """
    if name not in CASES:
        raise SimError(f'case "{name}": {expected(name, CASES)}')
    return CASES[name]()
