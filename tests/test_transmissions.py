"""Transmission models: oddness, derivatives, names, registering one more."""

import joints
import numpy as np
import pytest

from estimator import MODELS, EstimatorError, Status, Transmission, register
from estimator.transmissions import transmission_model

ALPHAS = {"linear": [3.0], "polynomial": [1.0, 2.0, 3.0], "vsa-ii": [0.5, 1.75], "exponential": [2.0, 4.0]}


def slopes(evaluate, alpha):
    """Central differences by each entry of alpha, along a last axis."""
    steps = 1e-6 * np.diag(alpha)
    return np.stack([(evaluate(alpha + d) - evaluate(alpha - d)) / (2 * d.sum()) for d in steps], axis=-1)


@pytest.mark.parametrize("name", [*ALPHAS, "quintic-for-test"])
def test_arrays_of_any_shape_have_torque_stiffness_and_their_slopes(name, quintic):
    """The laws themselves are tested where they are, in `laws.rs`."""
    model, alpha = MODELS[name], np.array(ALPHAS.get(name, [130.0, 25.0, 80.0]))
    phi, h = np.array([[-0.3, -0.01, 0.02], [0.1, 0.2, 0.35]]), 1e-6
    torque, stiffness = model.both(phi, alpha)
    slope = (model.torque(phi + h, alpha) - model.torque(phi - h, alpha)) / (2 * h)
    assert stiffness == pytest.approx(slope, rel=2e-6)
    assert model.torque(-phi, alpha) == pytest.approx(-torque, rel=1e-12)
    by_alpha = slopes(lambda near: model.torque(phi, near), alpha)
    assert model.jacobian(phi, alpha) == pytest.approx(by_alpha, rel=1e-5)
    by_alpha = slopes(lambda near: model.stiffness(phi, near), alpha)
    assert model.stiffness_jacobian(phi, alpha) == pytest.approx(by_alpha, rel=1e-4, abs=1e-6)
    assert model.at(0.2, alpha.tolist()) == pytest.approx((torque[1, 1], stiffness[1, 1]), rel=1e-12)


def test_a_registered_model_is_checked_and_then_found_by_name(quintic):
    model = transmission_model(Transmission(model=quintic))
    assert model is MODELS[quintic]
    assert model.stiffness(0.2, (10.0, 3.0, 5.0)) == pytest.approx(10.0 * (1 + 9 * 0.04 + 25 * 0.0016))
    with pytest.raises(EstimatorError, match="taken"):
        register(quintic, np.sin, np.cos)


@pytest.mark.parametrize(
    ("torque", "stiffness", "bounds", "what"),
    [
        (lambda phi: phi**2, lambda phi: 2 * phi, {}, "odd"),
        (lambda phi: phi**3, lambda phi: 2 * phi**2, {}, "derivative"),
        (lambda phi, b: phi, lambda phi: 1 + 0 * phi, {}, "arguments"),
        (lambda phi, b: b * phi, lambda phi, b: b + 0 * phi, {"b_per_rad": (0.0, 1.0, 9.0)},
         r"b_per_rad: expected \(start, low, high\).*got \(0, 1, 9\)"),
    ],
)  # fmt: skip
def test_what_is_no_transmission_is_refused(torque, stiffness, bounds, what):
    with pytest.raises(EstimatorError, match=what):
        register("refused", torque, stiffness, bounds)
    assert "refused" not in MODELS


@pytest.fixture
def quintic():
    """A model with two nonlinear parameters."""
    register(
        "quintic-for-test",
        lambda phi, a, c: phi + a * phi**3 + c * phi**5,
        lambda phi, a, c: 1 + 3 * a * phi**2 + 5 * c * phi**4,
        {"a": (10.0, 0.0, 1e3), "c": (1.0, 0.0, 1e5)},
    )
    yield "quintic-for-test"
    del MODELS["quintic-for-test"]


@pytest.mark.parametrize(
    "declared",
    [pytest.param({}, marks=pytest.mark.slow), {"k_nm_rad": 130.0, "a": 25.0, "c": 80.0}],
    ids=["from nothing", "declared"],
)
def test_a_registered_model_with_two_shape_parameters_is_estimated_on_line(quintic, declared):
    rng = np.random.default_rng(1)
    n, T = 4500, 1e-3
    torque, stiffness = joints.polynomial(150.0 * np.array([[[1.0, 20.0, 100.0]]]))
    plants = joints.Plants(torque, stiffness, 0.1, 0.5, 0.45, 0.3, 5.0)
    truth = joints.simulate(plants, joints.sweep(rng, n, 1, 1, T, 8.0, 3.0), T)
    noise = rng.normal(0, 0.03, (n, 1))
    how = {"motor_counts": 16384, "link_bits": 17, "velocity_rad_s": None, "torque_noise": noise}
    model = joints.joint_model(0.1, 0.5, model=quintic, order=None, parameters=declared)
    out = joints.estimates(model, joints.record(truth, 0, T, **how))[4000:]
    assert np.all(out[:, 1].astype(int) & Status.VALID)
    assert np.sqrt(np.mean((out[:, 3] / truth.sigma[4000:, 0, 0] - 1) ** 2)) < 2e-3


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("gum", {}),
        ("linear", {"k": 1.0}),
        ("vsa-ii", {"k_nm_rad": 1.0, "c": 0.9}),
        ("linear", {"k_nm_rad": (1.0, 2.0)}),
    ],
)
def test_wrong_names_and_values_are_reported(model, parameters):
    with pytest.raises(EstimatorError):
        transmission_model(Transmission(model=model, parameters=parameters))


@pytest.mark.parametrize("name", ALPHAS)
def test_parameters_go_over_names_and_back(name):
    model = MODELS[name]
    assert model.alpha(model.parameters(ALPHAS[name])) == pytest.approx(ALPHAS[name])
