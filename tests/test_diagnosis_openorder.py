"""An open polynomial order is raised by what the diagnosis finds; a declared one is not."""

import pytest

from estimator.diagnosis.openorder import raised
from estimator.diagnosis.result import Finding
from estimator.model import JointModel, Motor, Transmission


def joint(transmission: Transmission) -> JointModel:
    return JointModel(arrangement="single", motors=(Motor(inertia_kg_m2=0.1, transmission=transmission),))


def stiffening(power: float) -> Finding:
    return Finding(
        name="higher_order_stiffness",
        location="transmission",
        motor=0,
        parameters={"coefficient": 400.0, "power": power},
        std={},
    )


@pytest.mark.parametrize(("power", "order"), [(3.0, 2), (5.0, 3)])
def test_an_open_order_follows_the_power_that_was_found(power: float, order: int) -> None:
    model = raised(joint(Transmission(model="polynomial")), [stiffening(power)])
    assert model is not None
    assert model.motors[0].transmission.order == order


@pytest.mark.parametrize(
    "transmission",
    [
        Transmission(model="polynomial", order=1),
        Transmission(model="polynomial", parameters={"coefficients_nm_rad": (150.0,)}),
        Transmission(model="vsa-ii"),
    ],
)
def test_what_the_joint_file_says_is_left_and_the_effect_stays_an_effect(transmission: Transmission) -> None:
    assert raised(joint(transmission), [stiffening(3.0)]) is None


def test_without_a_stiffening_there_is_nothing_to_raise() -> None:
    assert raised(joint(Transmission(model="polynomial")), []) is None
