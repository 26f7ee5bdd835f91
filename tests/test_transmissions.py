"""Transmission models: oddness, derivatives, names, registering one more."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import MODELS, EstimatorError, Transmission, register
from estimator.transmissions import transmission_model

ALPHAS = {
    "linear": st.tuples(st.floats(0.01, 1e7)),
    "polynomial": st.lists(st.floats(0.01, 1e3), min_size=1, max_size=5).map(tuple),
    "vsa-ii": st.tuples(st.floats(0.01, 1e3), st.floats(1.05, 2.5)),
    "exponential": st.tuples(st.floats(0.01, 1e3), st.floats(0.1, 10.0)),
}


@pytest.mark.parametrize("name", ALPHAS)
def test_torque_is_odd_and_every_derivative_is_one(name):
    model = MODELS[name]

    @settings(max_examples=40, deadline=None)
    @given(ALPHAS[name], st.floats(0.02, 0.6))
    def check(alpha, phi):
        alpha = np.array(alpha)
        h = 1e-6
        assert model.torque(-phi, alpha) == pytest.approx(-model.torque(phi, alpha), rel=1e-12)
        slope = (model.torque(phi + h, alpha) - model.torque(phi - h, alpha)) / (2 * h)
        size = float(model.stiffness(phi, alpha))
        # Central differences of step h are good to about eps/h = 2e-10 of the function's size.
        assert slope == pytest.approx(size, rel=2e-6)
        for i in range(alpha.size):
            d = np.zeros_like(alpha)
            d[i] = 1e-6 * alpha[i]
            tiny = 1e-9 * size / alpha[i]  # what rounding of the difference leaves
            by_alpha = (model.torque(phi, alpha + d) - model.torque(phi, alpha - d)) / (2 * d[i])
            by_alpha_of_sigma = (model.stiffness(phi, alpha + d) - model.stiffness(phi, alpha - d)) / (
                2 * d[i]
            )
            assert model.jacobian(phi, alpha)[i] == pytest.approx(by_alpha, rel=1e-5, abs=tiny)
            assert model.stiffness_jacobian(phi, alpha)[i] == pytest.approx(
                by_alpha_of_sigma, rel=1e-4, abs=tiny
            )
        torque, stiffness = model.at(phi, alpha.tolist())
        assert (torque, stiffness) == pytest.approx((float(model.torque(phi, alpha)), size), rel=1e-9)

    check()


@pytest.mark.parametrize("name", ALPHAS)
def test_parameters_go_over_names_and_back(name):
    alpha = {"linear": [3.0], "polynomial": [1.0, 2.0, 3.0], "vsa-ii": [0.5, 1.75], "exponential": [2.0, 4.0]}
    model = MODELS[name]
    assert model.alpha(model.parameters(alpha[name])) == pytest.approx(alpha[name])


def test_a_registered_model_is_checked_and_then_found_by_name():
    name = "sinh-for-test"
    model = register(
        name,
        lambda phi, b: np.sinh(b * phi) / b,
        lambda phi, b: np.cosh(b * phi),
        {"b_per_rad": (2.0, 0.1, 50.0)},
    )
    try:
        assert transmission_model(Transmission(model=name)) is model
        assert model.stiffness(0.2, (10.0, 3.0)) == pytest.approx(10.0 * np.cosh(0.6))
        with pytest.raises(EstimatorError, match="taken"):
            register(name, np.sin, np.cos)
    finally:
        del MODELS[name]


@pytest.mark.parametrize(
    ("torque", "stiffness", "what"),
    [
        (lambda phi: phi**2, lambda phi: 2 * phi, "odd"),
        (lambda phi: phi**3, lambda phi: 2 * phi**2, "derivative"),
        (lambda phi, b: phi, lambda phi: 1 + 0 * phi, "arguments"),
    ],
)
def test_what_is_no_transmission_is_refused(torque, stiffness, what):
    with pytest.raises(EstimatorError, match=what):
        register("refused", torque, stiffness)
    assert "refused" not in MODELS


@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("gum", {}),
        ("linear", {"k": 1.0}),
        ("vsa-ii", {"k_nm_rad": 1.0, "c": 0.9}),
        ("linear", {"k_nm_rad": (1.0, 2.0)}),
    ],
)
def test_wrong_names_and_values_are_told(model, parameters):
    with pytest.raises(EstimatorError):
        transmission_model(Transmission(model=model, parameters=parameters))
