"""An open polynomial order is raised by what the diagnosis finds; a declared one is not."""

import pytest

from estimator.diagnosis.openorder import raised
from estimator.diagnosis.result import Finding
from estimator.model import JointModel, Motor, Transmission


def joint(transmission: Transmission) -> JointModel:
    return JointModel(arrangement="single", motors=(Motor(inertia_kg_m2=0.1, transmission=transmission),))


def stiffening(power: float) -> Finding:
    values = {"coefficient": 400.0, "power": power}
    return Finding(name="higher_order_stiffness", location="transmission", motor=0, parameters=values, std={})


@pytest.mark.parametrize(("power", "order"), [(3.0, 2), (5.0, 3)])
def test_an_open_order_follows_the_power_that_was_found(power, order):
    model = raised(joint(Transmission(model="polynomial")), [stiffening(power)])
    assert model is not None
    assert model.motors[0].transmission.order == order


@pytest.mark.parametrize(
    ("transmission", "found"),
    [
        (Transmission(model="polynomial", order=1), [stiffening(3.0)]),
        (Transmission(model="polynomial", parameters={"coefficients_nm_rad": (150.0,)}), [stiffening(3.0)]),
        (Transmission(model="vsa-ii"), [stiffening(3.0)]),
        (Transmission(model="polynomial"), []),  # nothing to raise it for
    ],
)
def test_what_the_joint_file_says_is_left_and_the_effect_stays_an_effect(transmission, found):
    assert raised(joint(transmission), found) is None
