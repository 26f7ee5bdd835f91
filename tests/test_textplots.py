"""Plots in a terminal: round places on their axes, titles that are whole."""

import pytest

from drivelink.monitor.braille import DotPlot
from drivelink.output.numbers import axis_ticks


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0.112, 0.277, ["0.15", "0.20", "0.25"]),
        (-0.36, 0.49, ["−0.2", "0", "0.2", "0.4"]),
        (-12.0, 0.0, ["−10", "−5", "0"]),
        (-4.1e-4, 4.2e-4, ["−4e−4", "−2e−4", "0", "2e−4", "4e−4"]),
        (1.0, 2.0, ["1.0", "1.5", "2.0"]),
        (119.999, 120.001, ["119.999", "120.000", "120.001"]),
    ],
)
def test_an_axis_has_round_places(low, high, labels):
    assert [label for _, label in axis_ticks(low, high)] == labels


@pytest.mark.parametrize("high", [1.001 * 1.2**k for k in range(60)])
def test_every_axis_has_three_to_eight_places_inside(high):
    for low in (0.0, -high / 3.0, 0.7 * high):
        places = [place for place, _ in axis_ticks(low, high)]
        assert 3 <= len(places) <= 8 and low - 1e-6 * high <= places[0] and places[-1] <= high * 1.000001


def test_labels_stand_at_their_places_and_the_title_is_whole():
    title = "external torque over time, N·m"
    text = DotPlot(37, 13, (-12.0, 0.0), (-4.1e-4, 4.2e-4)).render(title, "s").plain
    head, *rows, below = text.split("\n")
    assert head.strip() == title and all(len(row) <= 37 for row in (head, *rows, below))
    assert rows[5].startswith("     0┤") and below.endswith("0 s")
    at = below.index("−10") + 1
    assert abs(at - (7 + 2.0 / 12.0 * 29)) <= 1.0
