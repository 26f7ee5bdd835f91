"""Each law with the true, the nominal and the estimated spring model: how well does the joint follow?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivelink import jointfile
from drivelink.output.plots import PlotCurve, new_figure, over_time, save
from estimator.sample import FloatArray
from sim.cases import case
from sim.excitation import build
from vsacontrol.controller import Controller
from vsacontrol.laws import ControlLaw, Decoupler, Regulator
from vsacontrol.lockstep import LockstepRig, Row
from vsacontrol.phases import Phase
from vsacontrol.plant import joint_of
from vsacontrol.references import WAYPOINTS, Reference, Waypoint
from vsacontrol.springs import Law, spring

__all__ = ["JOINT", "KNOWLEDGE", "LAWS", "SCENES", "Errors", "Outcome", "draw", "follow", "ratios", "table"]

JOINT = Path(__file__).parent.parent / "joint.toml"
KNOWLEDGE = ("true", "nominal", "estimated")
SCENES = ("quiet", "pushed")
NOMINAL = 0.8  # the nominal model's torque, stiffness and derivatives: 20 % too low
# Nobody knows what pushes the link in the second half: 1 mN·m rms, 0.3 % of the gravity torque's peak.
_PUSH = {"kind": "multisine", "amplitude_nm": 0.0014, "low_hz": 0.2, "high_hz": 2.0, "ramp_s": 0.2}
_BETWEEN = (1.0, 1.0)  # way and rest from the end of the quiet half to the begin of the other, s
_LEAST = 1e-3  # mrad, mN·m/rad: where logarithmic plots end
_SETTLED_S = 1.0  # after the end of a way the regulator is judged
_LIMIT_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A law and what it has to follow.

    Attributes:
        title: for tables and plots.
        waypoints: the reference.
        settled_only: it is judged while the reference rests; a regulator has no more to promise.
    """

    title: str
    waypoints: tuple[Waypoint, ...]
    settled_only: bool


LAWS = {
    "regulation": Task(
        title="Regulation, on-line gravity compensation",
        waypoints=WAYPOINTS["regulation"],
        settled_only=True,
    ),
    "decoupling": Task(
        title="Motion-stiffness decoupling, feedback linearization",
        waypoints=WAYPOINTS["decoupling"],
        settled_only=False,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Errors:
    """Root mean square and largest deviation from the reference, of the joint as it really was.

    Attributes:
        q_rms_rad: link position.
        q_max_rad: see there.
        sigma_rms_nm_rad: total stiffness.
        sigma_max_nm_rad: see there.
    """

    q_rms_rad: float
    q_max_rad: float
    sigma_rms_nm_rad: float
    sigma_max_nm_rad: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One run of a reference.

    Attributes:
        law: a key of `LAWS`.
        scene: one of `SCENES`.
        knowledge: which spring model.
        errors: what is judged.
        time_s: (n,) time in the reference.
        q: (n, 2) true and wanted link position.
        sigma: (n, 2) true and wanted stiffness.
    """

    law: str
    scene: str
    knowledge: str
    errors: Errors
    time_s: FloatArray
    q: FloatArray
    sigma: FloatArray


def follow(law: str, knowledge: str, *, seed: int = 0) -> list[Outcome]:
    """Identify, approach, follow the reference in peace, and once more while something pushes the link.

    Args:
        law: a key of `LAWS`.
        knowledge: one of `KNOWLEDGE`.
        seed: of the sensors' noise.

    Returns:
        An outcome for each of `SCENES`.

    Raises:
        RuntimeError: the reference was not followed to its end without an interruption.
    """
    waypoints = LAWS[law].waypoints
    first = waypoints[0]._replace(way_s=_BETWEEN[0], rest_s=_BETWEEN[1])
    reference = Reference([*waypoints, first, *waypoints[1:]])
    quiet_s = Reference(waypoints).length_s
    pushed_s = quiet_s + sum(_BETWEEN)
    file = jointfile.load(JOINT)
    joint = joint_of(file)
    acting: ControlLaw = Decoupler(joint=joint) if law == "decoupling" else Regulator(joint=joint)
    controller = Controller(joint, acting, reference, file.bus.period_s, springs=_springs(knowledge))
    rig = LockstepRig(file, controller, seed=seed)
    rows: list[Row] = []

    def note(row: Row) -> None:
        if row.phase == Phase.RUN:
            rows.append(row)
            if row.reference_s >= pushed_s and rig.world.excitation is not pushing:
                rig.world.excitation = pushing

    pushing = build({"kind": "none", "external": _PUSH}, len(file.motor))
    try:
        rig.run(_LIMIT_S, until=lambda: controller.done, each=note)
    finally:
        rig.close()
    if not controller.done or any(event.phase is Phase.SAFE for event in controller.events):
        raise RuntimeError(f"{law} with the {knowledge} model: {controller.events}")
    halves = ((0.0, quiet_s), (pushed_s, reference.length_s))
    return [
        _outcome((law, scene, knowledge), [row for row in rows if begin <= row.reference_s < end], reference)
        for scene, (begin, end) in zip(SCENES, halves, strict=True)
    ]


def _springs(knowledge: str) -> tuple[Law, ...] | None:
    if knowledge == "estimated":
        return None
    scale = NOMINAL if knowledge == "nominal" else 1.0
    motors = case("vsa-ii").plant.motors
    return tuple(spring(motor.spring.model, motor.spring.parameters, scale) for motor in motors)


def _outcome(names: tuple[str, str, str], rows: Sequence[Row], reference: Reference) -> Outcome:
    law, scene, knowledge = names
    q = np.array([(row.q, row.q_wanted) for row in rows])
    sigma = np.array([(row.sigma, row.sigma_wanted) for row in rows])
    time_s = np.array([row.reference_s for row in rows])
    judged = np.array([not LAWS[law].settled_only or reference.settled(t, _SETTLED_S) for t in time_s])
    off_q, off_sigma = (np.abs(pair[judged, 0] - pair[judged, 1]) for pair in (q, sigma))
    errors = Errors(
        q_rms_rad=math.sqrt(float(np.mean(off_q**2))),
        q_max_rad=float(np.max(off_q)),
        sigma_rms_nm_rad=math.sqrt(float(np.mean(off_sigma**2))),
        sigma_max_nm_rad=float(np.max(off_sigma)),
    )
    begun_s = time_s - time_s[0]
    return Outcome(law=law, scene=scene, knowledge=knowledge, errors=errors, time_s=begun_s, q=q, sigma=sigma)


def ratios(outcomes: Sequence[Outcome]) -> dict[tuple[str, str, str], dict[str, float]]:
    """Errors as multiples of those with the true model, and of the nominal model's as multiples of them."""
    errors = {(o.law, o.scene, o.knowledge): o.errors for o in outcomes}
    found = {}
    for (law, scene, knowledge), own in errors.items():
        true, nominal = errors[law, scene, "true"], errors[law, scene, "nominal"]
        found[law, scene, knowledge] = {
            "q_to_true": own.q_rms_rad / true.q_rms_rad,
            "sigma_to_true": own.sigma_rms_nm_rad / true.sigma_rms_nm_rad,
            "q_nominal_to": nominal.q_rms_rad / own.q_rms_rad,
            "sigma_nominal_to": nominal.sigma_rms_nm_rad / own.sigma_rms_nm_rad,
        }
    return found


def table(outcomes: Sequence[Outcome]) -> str:
    """Markdown: errors, and their ratios to those with the true and with the nominal model."""
    lines = [
        "| law | scene | model | q rms / mrad | q max / mrad | σ rms / mN·m/rad | σ max / mN·m/rad "
        "| q: × true | σ: × true | q: nominal is × | σ: nominal is × |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    compared = ratios(outcomes)
    order = {knowledge: k for k, knowledge in enumerate(KNOWLEDGE)}
    for outcome in sorted(outcomes, key=lambda o: (o.law, SCENES.index(o.scene), order[o.knowledge])):
        own = outcome.errors
        values = (own.q_rms_rad, own.q_max_rad, own.sigma_rms_nm_rad, own.sigma_max_nm_rad)
        cells = [f"{1e3 * value:.3f}" for value in values]
        key = (outcome.law, outcome.scene, outcome.knowledge)
        cells += [f"{ratio:.2f}" for ratio in compared[key].values()]
        lines.append("| " + " | ".join([*key, *cells]) + " |")
    return "\n".join(lines)


def draw(outcomes: Sequence[Outcome], folder: Path) -> list[Path]:
    """One figure a law and scene: position and stiffness against what is wanted, and the deviations."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for law, scene in dict.fromkeys((o.law, o.scene) for o in outcomes):
        runs = [o for o in outcomes if (o.law, o.scene) == (law, scene)]
        figure, axes = new_figure(f"{LAWS[law].title}: {scene}", rows=4, width=8.0, height=2.1)
        for axis, value, name in ((0, "q", "q / rad"), (1, "sigma", "σ / (N·m/rad)")):
            pairs = {o.knowledge: (o.time_s, getattr(o, value)) for o in runs}
            curves = {knowledge: PlotCurve(t, pair[:, 0]) for knowledge, (t, pair) in pairs.items()}
            curves["wanted"] = PlotCurve(runs[0].time_s, getattr(runs[0], value)[:, 1])
            over_time(axes[axis], curves, name)
            off = {
                knowledge: PlotCurve(t, 1e3 * np.abs(pair[:, 0] - pair[:, 1]) + _LEAST)
                for knowledge, (t, pair) in pairs.items()
            }
            over_time(axes[axis + 2], off, f"|error of {name.replace(' / ', '| / m').replace('m(', '(m')}")
            axes[axis + 2].set_yscale("log")
        paths.append(save(figure, folder / f"{law}-{scene}.png"))
    return paths
