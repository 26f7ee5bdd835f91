"""benchmarks/world.c, the independent joint in C, beside another integrator and closed forms."""

import shutil
import subprocess
from pathlib import Path

import joints
import numpy as np
import pytest

from estimator import EstimatorSettings, JointModel, Motor, Record, Status, Transmission, make_estimator
from estimator.diagnosis import diagnose

SOURCE = Path(__file__).parent.parent / "benchmarks" / "world.c"


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Run the program: (return code, columns by name, what it says of an error)."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler (cc)")
    program = tmp_path_factory.mktemp("world") / "world"
    flags = ["-O2", "-std=c11", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(["cc", *flags, "-o", program, SOURCE, "-lm"], check=True)

    def run(*settings):
        done = subprocess.run([program, *settings], capture_output=True, text=True, check=False)
        lines = done.stdout.splitlines()
        if done.returncode:
            return done.returncode, {}, done.stderr
        rows = np.array([line.split(",") for line in lines[1:]], float).T
        return 0, dict(zip(lines[0].split(","), rows, strict=True)), done.stderr

    return run


def recorded(c, period_s: float = 1e-3) -> Record:
    """What a drive and an encoder read."""
    return Record(
        period_s=period_s,
        sequence=np.arange(len(c["time_s"])),
        motor_position_rad=c["motor1_position_rad"][:, None],
        motor_torque_nm=c["motor1_torque_nm"][:, None],
        link_position_rad=c["link_position_rad"],
    )


def played(record: Record, motor: Motor):
    """(estimator, stiffness, its standard deviation, whether it is valid)."""
    model = JointModel(arrangement="single", motors=(motor,))
    estimator = make_estimator(model, EstimatorSettings(), record.period_s)
    said = [
        (one.stiffness_nm_rad, one.stiffness_std_nm_rad, int(one.status) & Status.VALID)
        for one in map(estimator.step, record.samples())
    ]
    stiffness, std, valid = np.array(said).T
    return estimator, stiffness, std, valid > 0


EXACT = ("motor_counts=0", "link_bits=0", "seconds=3")


@pytest.mark.parametrize(
    ("spring", "law"),
    [
        (("spring=cubic",), joints.polynomial(np.array([[[150.0, 5000.0]]]))),
        (("spring=vsa-ii", "stiffness=500"), joints.vsa_ii(np.array([[500.0]]), np.array([[1.75]]))),
    ],
    ids=["cubic", "vsa-ii"],
)
def test_the_joint_without_effects_is_that_of_another_integrator(world, spring, law):
    _, c, _ = world(*spring, *EXACT)
    plants = joints.Plants(*law, 0.12, 0.8, 0.45, 0.5, 3.0)
    truth = joints.simulate(plants, c["motor1_torque_nm"][:, None, None], 1e-3)
    for name, expected in (
        ("motor1_position_rad", truth.theta),
        ("link_position_rad", truth.q),
        ("true_flexibility_torque_nm", truth.tau_e),
        ("true_stiffness_nm_rad", truth.sigma),
    ):
        assert np.allclose(c[name], expected.ravel(), rtol=1e-8, atol=1e-8), name


def test_each_effect_leaves_in_the_balance_of_the_motor_what_it_is(world):
    """B θ" + D θ' - τ_e - τ from differences of the columns, at the middle of each period."""

    def loss(*settings):
        _, c, _ = world("torque_noise=0", *EXACT, *settings)
        theta, carried = c["motor1_position_rad"], c["true_flexibility_torque_nm"]
        speed = np.gradient(theta, 1e-3)
        held = (c["motor1_torque_nm"][1:-1] + c["motor1_torque_nm"][:-2]) / 2
        left = 0.12 * np.diff(theta, 2) / 1e-6 + 0.8 * speed[1:-1] - carried[1:-1] - held
        return left[100:], speed[101:-1], carried[101:-1], theta[101:-1]

    left, speed, carried, _ = loss("gear_loss=0.1")
    fast = np.abs(speed) > 0.05
    assert np.allclose(left[fast], -0.1 * np.abs(carried[fast]) * np.sign(speed[fast]), atol=0.01)
    left, speed, _, _ = loss("friction=lugre", "coulomb=0.3")
    fast = np.abs(speed) > 0.4
    assert np.median(np.abs(left[fast] + 0.3 * np.sign(speed[fast]))) < 0.01
    left, _, _, theta = loss("cogging=0.2")
    assert np.allclose(left, -0.2 * np.sin(32 * theta), atol=0.01)


def test_hysteresis_is_a_loop_of_its_amplitude_and_a_gap_carries_nothing(world):
    for law in ("dahl", "bouc-wen"):
        _, c, _ = world(f"hysteresis={law}", "hysteresis_torque=0.4", *EXACT)
        memory = c["true_flexibility_torque_nm"] - c["true_spring_torque_nm"]
        assert 0.35 < memory.max() <= 0.4 + 1e-9
        assert -0.4 - 1e-9 <= memory.min() < -0.35
    _, c, _ = world("backlash=0.01", *EXACT)
    phi = c["link_position_rad"] - c["motor1_position_rad"]
    assert np.all(np.abs(c["true_spring_torque_nm"][np.abs(phi) < 2e-3]) < 0.1)
    far = np.abs(phi) > 0.03
    assert np.allclose(np.abs(c["true_spring_torque_nm"])[far], 150 * (np.abs(phi)[far] - 0.01), rtol=0.03)


@pytest.mark.parametrize("motion", ["multisine", "point-to-point", "hand-guided", "pushes", "harmonic"])
def test_every_motion_moves_the_joint_and_pushes_only_where_somebody_pushes(world, motion):
    _, c, _ = world(f"motion={motion}", "size=1", "top_hz=1", "link_delay=0.003")
    assert np.ptp(c["motor1_position_rad"]) > 0.05
    assert bool(np.any(c["true_external_torque_nm"])) == (motion in ("hand-guided", "pushes"))


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("friktion=lugre", "expected NAME=VALUE"),
        ("friction=wet", "lugre"),
        ("seed=x", "a number"),
        ("period=0", "above 0"),
    ],
)
def test_a_wrong_setting_is_one_line(world, setting, says):
    code, _, error = world(setting)
    assert code == 2 and says in error and error.count("\n") == 1


def test_a_hand_that_moves_a_healthy_joint_shows_no_other_inertia(world):
    """The motor's torque is small: inertia and stiffness scaled down alike leave less, and explain nothing."""
    settings = (
        "motion=hand-guided size=8 push=4.42 seed=5121 seconds=20 stiffness=124.45 inertia=0.2483 damping=0.93 "
        "link_inertia=0.89 link_damping=0.058 gravity=0 link_delay=0.0007 motor_counts=65536 link_bits=18"
    )
    _, c, _ = world(*settings.split())
    record = recorded(c)
    motor = Motor(
        inertia_kg_m2=0.2483, viscous_damping_nm_s_rad=0.93, inertia_std_relative=1e-4,
        transmission=Transmission(model="linear", parameters={"k_nm_rad": 124.45}),
    )  # fmt: skip
    found = diagnose(record, JointModel(arrangement="single", motors=(motor,)))
    assert found.verdict == "sufficient", found.effects


def test_the_interval_holds_what_the_shape_of_an_undeclared_effect_may_be_off(world):
    """A gear's losses are nearly, not quite, of the shape that the estimator has for them."""
    settings = "spring=cubic stiffness=120 cubic=3600 gear_loss=0.05 seconds=20 size=7.2 link_bits=18"
    _, c, _ = world(*settings.split())
    motor = Motor(
        inertia_kg_m2=0.12,
        viscous_damping_nm_s_rad=0.8,
        transmission=Transmission(model="polynomial", order=2),
    )
    estimator, stiffness, std, valid = played(recorded(c), motor)
    off = np.abs(stiffness - c["true_stiffness_nm_rad"])[valid]
    assert "load_dependent_friction" in estimator.undeclared()[0] and np.mean(valid) > 0.8
    assert np.mean(off < 1.96 * std[valid]) > 0.95


def test_a_stiff_joint_that_moves_fast_is_not_taken_for_a_soft_one_with_a_late_link(world):
    """Three periods of delay make fifty times the deflection that the spring has."""
    settings = (
        "stiffness=7.6e6 inertia=420 damping=1700 link_inertia=310 link_damping=520 gravity=700 period=0.004 size=3700 "
        "motion=pushes push=1850 seconds=12 seed=3 motor_counts=819200 link_bits=21 torque_noise=20 link_delay=0.012"
    )
    _, c, _ = world(*settings.split())
    elastic = Transmission(model="polynomial", order=2)
    motor = Motor(inertia_kg_m2=420.0, viscous_damping_nm_s_rad=1700.0, transmission=elastic)
    _, stiffness, _, valid = played(recorded(c, 0.004), motor)
    # Noise of the encoders leaves a percent; a spring that holds the delay has a fiftieth of it.
    assert np.all(np.abs(stiffness[-250:] / 7.6e6 - 1.0) < 0.05)
    assert np.all(np.abs(stiffness[valid] / 7.6e6 - 1.0) < 0.2)
