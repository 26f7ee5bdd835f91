"""Array least squares: linear, nonlinear, projected: the same answer by every way."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator import MODELS, EstimatorError
from estimator.leastsquares import fit_alpha, fit_polynomial, fit_projected, polynomial_columns


@settings(max_examples=20, deadline=None)
@given(st.floats(0.1, 500.0), st.floats(1.2, 2.0))
def test_vsa_ii_is_found_from_far_away_by_projection_and_by_damped_steps(k, c):
    model = MODELS["vsa-ii"]
    phi = np.linspace(-0.5, 0.5, 300)
    torque = model.torque(phi, (k, c))
    assert fit_projected(model, phi, torque).alpha == pytest.approx([k, c], rel=1e-5)
    assert fit_alpha(model, phi, torque, np.array([0.2 * k, 1.1])).alpha == pytest.approx([k, c], rel=1e-5)


def test_the_printed_undamped_step_diverges_from_the_papers_start_and_says_so():
    model = MODELS["vsa-ii"]
    phi = np.linspace(-0.45, 0.45, 300)
    with pytest.raises(EstimatorError, match="diverged"), np.errstate(all="ignore"):
        fit_alpha(model, phi, model.torque(phi, (0.5, 1.75)), np.array([0.1, 1.1]), damped=False)


@pytest.mark.parametrize("rule", ["bic", "cross-validation"])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e6])
def test_order_rules_know_no_units(rule, scale):
    rng = np.random.default_rng(4)
    phi = rng.uniform(-1, 1, 2000)
    torque = scale * (phi + 0.5 * phi**3 + 0.01 * rng.normal(size=2000))
    assert fit_polynomial(polynomial_columns(phi, 5), torque, rule).alpha.size == 2
