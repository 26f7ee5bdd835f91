"""How often `diagnose` names what the simulated joint carries, on random joints from published seeds.

    python benchmarks/diagnosis_seeds.py [--seeds N] [--seconds S] [--effects NAME,… | --pairs]

Every joint, motion and effect is drawn from its seed: soft joints of 80 to 220 N·m/rad with encoders and
torque noise as drives have them, effects of 3 to 30 % of the torque. The world is `sim`, which shares no code
with the estimator. Listed: named first, or an alternative with a probability of 0.1 or more. Wrong and
certain: a name that the joint does not carry, with a probability above 0.9.
"""

from collections.abc import Iterator, Sequence

import numpy as np
import scene
from scene import joints

from drivelink.demo.simulate import world_from_joint
from drivelink.jointfile import JointFile, parse
from estimator.diagnosis import Finding, diagnose
from estimator.effects import LIBRARY
from estimator.sample import Record
from sim.world import record

JOINT = """
name = "bench"
arrangement = "single"
[[motor]]
inertia_kg_m2 = {inertia}
viscous_damping_nm_s_rad = {damping}
transmission = {{ model = "linear", parameters = {{ k_nm_rad = {stiffness} }} }}
drive = {{ node_id = 1, counts_per_rev = 16384, gear_ratio = 50 }}
[link]
encoder = {{ source = "cia406", node_id = 2, counts_per_rev = 131072 }}
[link.dynamics]
inertia_kg_m2 = {link}
viscous_damping_nm_s_rad = 0.1
gravity_nm = {gravity}
[sim]
seed = {seed}
effect = [{effect}]
[sim.excitation]
kind = "rich"
seed = {seed}
amplitude_nm = {torque}
centring_nm_rad = {centring}
centring_nm_s_rad = {brake}
"""


def sizes(
    torque: float, stiffness: float, share: float, rng: np.random.Generator
) -> dict[str, dict[str, float]]:
    """Parameters of each effect so that it takes about that share of the torque."""
    x, angle = share * torque, share * torque / stiffness
    waves = {"periods_per_rev": float(rng.integers(12, 30))}
    return {
        "coulomb_friction": {"torque_nm": x},
        "stribeck_friction": {"torque_nm": x, "stribeck_nm": 0.8 * x, "stribeck_velocity_rad_s": 0.25},
        "asymmetric_friction": {"positive_nm": 1.5 * x, "negative_nm": 0.6 * x},
        "presliding_friction": {"torque_nm": x, "displacement_rad": 0.04},
        "load_dependent_friction": {"coefficient": 1.5 * share},
        "viscous_damping": {"damping_nm_s_rad": x},
        "quadratic_damping": {"damping_nm_s2_rad2": x},
        "cogging": {"sin_nm": x, "cos_nm": 0.5 * x, **waves},
        "torque_offset": {"torque_nm": x},
        "torque_constant": {"relative_error": share},
        "torque_saturation": {"coefficient_per_nm2": 0.3 * share / torque**2},
        "torque_drift": {"relative_change": 1.5 * share, "time_constant_s": 6.0},
        "motor_inertia": {"inertia_kg_m2": 0.4 * share},
        "torque_delay": {"delay_s": 0.0025 + 0.01 * share},
        "torque_lag": {"time_constant_s": 0.003 + 0.02 * share},
        "back_driving_loss": {"coefficient": 1.5 * share},
        "hysteresis": {"torque_nm": x, "displacement_rad": 0.01},
        "backlash": {"stiffness_nm_rad": stiffness, "half_gap_rad": angle},
        "asymmetric_stiffness": {"coefficient_nm_rad2": share * stiffness**2 / torque},
        "higher_order_stiffness": {"coefficient": share * stiffness**3 / torque**2, "power": 3.0},
        "transmission_damping": {"damping_nm_s_rad": 2.0 * x},
        "kinematic_error": {"sin_rad": angle, "cos_rad": 0.5 * angle, **waves},
        "deflection_offset": {"offset_rad": angle},
        "encoder_eccentricity": {"sin_rad": angle, "cos_rad": 0.7 * angle},
        "encoder_delay": {"delay_s": 0.0025 + 0.01 * share},
        "deflection_delay": {"delay_s": 0.005 + 0.2 * share},
        "encoder_scale": {"relative_error": 0.3 * share},
        "gravity": {"sin_nm": 2.0 * x, "cos_nm": 0.5 * x},
        "link_coulomb_friction": {"torque_nm": x},
        "link_viscous_damping": {"damping_nm_s_rad": x},
        "link_inertia": {"inertia_kg_m2": 0.4 * share},
        "contact": {"stiffness_nm_rad": 10.0 * x, "position_rad": 0.1},
    }


def joint_of(names: Sequence[str], seed: int) -> tuple[JointFile, JointFile]:
    """The joint as it is declared, and as it is, with these effects; the seed stands for them too."""
    order = sorted(LIBRARY)
    rng = np.random.default_rng([seed, *(order.index(name) for name in names)] if names else [seed, 99])
    stiffness, share = rng.uniform(80.0, 220.0), np.exp(rng.uniform(np.log(0.03), np.log(0.3)))
    torque = 0.12 * stiffness
    link = rng.uniform(0.2, 0.6)
    values = {
        "inertia": rng.uniform(0.08, 0.25),
        "damping": rng.uniform(0.3, 1.2),
        "stiffness": stiffness,
        "link": link,
        "gravity": rng.uniform(2.0, 7.0),
        "seed": seed,
        "torque": torque,
        "centring": 3.0 * torque,
        "brake": 0.5 * float(np.sqrt(3.0 * torque * link)),
    }
    effects = []
    for name in names:
        parameters = sizes(0.5 * torque, stiffness, float(share), rng)[name]
        inside = ", ".join(f"{key} = {value!r}" for key, value in parameters.items())
        effects.append(f'{{ name = "{name}", parameters = {{ {inside} }} }}')
    text = {key: float(v) if key != "seed" else v for key, v in values.items()}
    return parse(JOINT.format(effect="", **text)), parse(JOINT.format(effect=", ".join(effects), **text))


def measured(joint: JointFile, seconds: float, effects: Sequence[str] = ()) -> Record:
    """A recording of the joint's world, with further effects."""
    columns = record(world_from_joint(joint, effects=effects), seconds)
    return joints.of_world(columns, period_s=joint.bus.period_s)


LIKELY, CERTAIN = 0.1, 0.9


def listed(effects: Sequence[Finding]) -> set[str]:
    """The names in a diagnosis, and the alternatives that are likely enough."""
    names = {effect.name for effect in effects}
    for effect in effects:
        pairs = zip(effect.alternatives, effect.alternative_probabilities, strict=True)
        names |= {name for name, probability in pairs if probability >= LIKELY}
    return names


def wrong_and_certain(effects: Sequence[Finding], real: Sequence[str]) -> list[str]:
    """The names in a diagnosis that are stated as certain and are not real."""
    listed = [e for e in effects if e.name != "unlisted" and e.name not in real]
    return [e.name for e in listed if e.probability > CERTAIN]


PAIRS = [
    "coulomb_friction+gravity",
    "cogging+link_coulomb_friction",
    "hysteresis+motor_inertia",
    "viscous_damping+backlash",
    "torque_offset+encoder_delay",
    "coulomb_friction+kinematic_error",
    "torque_lag+link_inertia",
    "back_driving_loss+contact",
    "higher_order_stiffness+encoder_eccentricity",
]


def judged(name: str, seed: int, seconds: float) -> scene.Row:
    """One recording made and diagnosed; counts are of its effects."""
    real = () if name == "clean" else tuple(name.split("+"))
    declared, joint = joint_of(real, seed)
    outcome = diagnose(measured(joint, seconds), declared.model())
    names = [effect.name for effect in outcome.effects]
    likely, places = listed(outcome.effects), {effect.location for effect in outcome.effects}
    clean = not real and outcome.verdict == "sufficient"
    return {
        "seed": seed,
        "found": names or [outcome.verdict],
        "named": sum(each in names for each in real) + clean,
        "first": int(set(names[: len(real)]) == set(real)) if real else int(clean),
        "listed": sum(each in likely for each in real) + clean,
        "located": sum(LIBRARY[each].location in places for each in real) + clean,
        "surplus": sum(each not in real for each in names),
        "certain": wrong_and_certain(outcome.effects, real),
        "after_over_before": outcome.validation.after_rms_nm / outcome.validation.before_rms_nm,
    }


def rows(args) -> Iterator[scene.Row]:
    """One row an effect or pair."""
    for name in PAIRS if args.pairs else args.effects:
        each = [judged(name, seed, args.seconds) for seed in range(args.first, args.first + args.seeds)]
        counts = {
            key: sum(one[key] for one in each) for key in ("named", "first", "listed", "located", "surplus")
        }
        else_found = {", ".join(one["found"]) for one in each if not one["first"]}
        yield {
            "effect": name,
            **counts,
            "of": len(each) * len(name.split("+")),
            "recordings": len(each),
            "else": "; ".join(sorted(else_found)) or None,
            "certain": ", ".join(sorted({wrong for one in each for wrong in one["certain"]})) or None,
            "left": float(np.median([one["after_over_before"] for one in each])),
            "each": each,
        }


def total(found: list[scene.Row]) -> str:
    """All rows together, clean joints apart."""
    real = [row for row in found if row["effect"] != "clean"]
    of = sum(row["of"] for row in real)
    said = [f"{key} {sum(row[key] for row in real)}/{of}" for key in ("named", "listed", "located")]
    certain = sum(len(one["certain"]) for row in found for one in row["each"])
    left = float(np.median([one["after_over_before"] for row in real for one in row["each"]] or [np.nan]))
    return (
        f"{', '.join(said)}, surplus {sum(row['surplus'] for row in real)}, wrong and certain {certain}, "
        f"held-out error after/before: median {left:.3f}"
    )


if __name__ == "__main__":
    scene.main(
        __doc__,
        rows,
        {
            "effect": "{effect}",
            "named first": "{first}/{recordings}",
            "named": "{named}/{of}",
            "listed": "{listed}/{of}",
            "located": "{located}/{of}",
            "surplus": "{surplus}",
            "else found": "{else}",
            "wrong and certain": "{certain}",
        },
        scene.Option("--seeds", 2, "recordings of each effect"),
        scene.Option("--first", 0, "seed of the first of them"),
        scene.Option("--seconds", 20.0, "length of a recording"),
        scene.Option("--effects", ["clean", *LIBRARY]),
        scene.Option("--pairs", False, "pairs of effects instead"),
        after=total,
    )
