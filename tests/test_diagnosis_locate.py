"""The equations that a signal leaves alone say where it comes from, whatever its law."""

from __future__ import annotations

import diagnosiskit as kit
import numpy as np
import pytest

from estimator.diagnosis.frame import Corrections, Frame, Signals
from estimator.diagnosis.locate import places_left, the_place
from estimator.diagnosis.regression import Blocks, Rows
from estimator.diagnosis.select import Tracer
from estimator.sample import Record

PLACES: dict[str, tuple[dict[str, float], str | None]] = {
    "coulomb": ({"coulomb_nm": 0.4}, "motor"),
    "bump": ({"bump_nm": 1.0}, "motor"),
    "hysteresis": ({"hysteresis_nm": 0.6, "hysteresis_rad": 0.01}, "transmission"),
    "gravity": ({"gravity_nm": 0.8}, "link"),
    "push": ({"push_nm": 2.0}, "link"),
    "skewed": ({"late_s": 0.0007, "coulomb_nm": 0.4}, "motor"),
    "clean": ({}, None),
    "two": ({"coulomb_nm": 0.4, "gravity_nm": 0.8}, None),
}


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    return dict(zip(PLACES, kit.World([case[0] for case in PLACES.values()]).run(), strict=True))


def _tracer(record: Record, linked: bool = True) -> Tracer:
    frame = Frame.make(kit.model(linked=linked), Signals(record, 12.0), Corrections.none(1))
    # Weights of 1 / 0.02 N·m: what the quantised encoders and the torque's noise leave behind the filter.
    rows = Rows(Blocks.make(frame.rows, 10, 0), frame.equations, np.full(frame.equations, 50.0))
    return Tracer(frame, rows, 0.01)


@pytest.mark.parametrize("case", PLACES)
def test_the_place_of_an_effect_is_found_before_its_name(case: str, records: dict[str, Record]) -> None:
    place = the_place(places_left(_tracer(records[case])))
    assert (place.location if place else None) == PLACES[case][1]


def test_an_everyday_skew_does_not_hide_the_place(records: dict[str, Record]) -> None:
    place = the_place(places_left(_tracer(records["skewed"])))
    assert place is not None
    assert place.skew_s == pytest.approx(0.0007, abs=1e-4)


def test_without_the_links_equation_there_is_nothing_to_compare(records: dict[str, Record]) -> None:
    assert places_left(_tracer(records["coulomb"], linked=False)) == []


def test_blocks_are_spread_over_the_recording() -> None:
    blocks = Blocks.make(3000, 10, 3, spread=True)
    for name in range(-1, 10):
        rows = np.flatnonzero(blocks.index == name)
        assert rows.min() < 1000 and rows.max() >= 2000
    assert len(np.unique(blocks.index)) == 11
