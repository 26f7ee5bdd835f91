"""Digits of what fit and diagnose write: those that the uncertainty asks for, and all where there is none."""

import numpy as np
import pytest

from drivelink.jointfile import changes_to
from drivelink.jointfile.digits import kept, kept_model
from estimator.model import Effect, JointModel, LinkDynamics, Motor, Transmission


@pytest.mark.parametrize(
    ("value", "std", "written"),
    [
        (0.12499059008611953, 1.6e-4, 0.1249906),
        (1234.5678912, 25.0, 1234.57),
        (6.06e-7, 2.0e-5, 6.1e-7),
        (0.12499059008611953, None, 0.12499059008611953),
        (0.12499059008611953, 0.0, 0.12499059008611953),
        ((1.0 / 3.0, 2.0 / 3.0), (0.01, 1.0), (0.33333, 0.667)),
    ],
)
def test_digits_follow_the_standard_deviation(value, std, written):
    assert kept(value, std) == written


def test_no_combination_of_parameters_loses_more_than_a_thousandth_of_its_deviation():
    std = np.array([0.8123456789, 321.123456789])
    correlation = np.array([[1.0, -0.99999], [-0.99999, 1.0]])
    covariance = correlation * np.outer(std, std)
    exact = (120.12345678901234, 412.12345678901234)
    transmission = Transmission(
        order=2, parameters={"coefficients_nm_rad": exact}, covariance=tuple(map(tuple, covariance.tolist()))
    )
    dry = Effect(
        name="coulomb_friction", parameters={"torque_nm": 0.2512345678}, std={"torque_nm": 0.00123456}
    )
    link = LinkDynamics(inertia_kg_m2=0.4000012077359206, inertia_std_kg_m2=2.9295357651695227e-05)
    motor = Motor(
        inertia_kg_m2=0.12499059008611953,
        inertia_std_relative=1e-3,
        transmission=transmission,
        effects=(dry,),
    )
    changes = changes_to(kept_model(JointModel(arrangement="single", motors=(motor,), link=link)))
    own = changes["motor"][0]
    (error,) = np.array([own["transmission"]["parameters"]["coefficients_nm_rad"]]) - exact
    assert 0.0 < error @ np.linalg.solve(covariance, error) < (2 * 1e-3) ** 2
    assert own["inertia_kg_m2"] == 0.1249906
    assert own["effect"][0]["parameters"] == {"torque_nm": 0.251235}
    assert own["effect"][0]["std"] == {"torque_nm": 0.001235}
    assert changes["link"]["dynamics"]["inertia_kg_m2"] == 0.40000121
    assert changes["link"]["dynamics"]["inertia_std_kg_m2"] == 2.93e-05
