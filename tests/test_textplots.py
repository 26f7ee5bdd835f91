"""Text in a terminal: plots with round places on their axes and whole titles, names in natural order."""

import itertools

import pytest

from drivelink.monitor.braille import DotPlot
from drivelink.monitor.statuslines import shape
from drivelink.output.numbers import axis_ticks
from drivelink.plaintext import natural


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


@pytest.mark.parametrize("columns", range(12, 60))
def test_labels_below_are_evenly_apart_or_fewer(columns):
    below = DotPlot(columns + 7, 13, (-0.41, 0.43), (0.0, 1.0)).render("", "rad").plain.split("\n")[-1]
    *labels, unit = below.split()
    values = [float(label.replace("−", "-")) for label in labels]
    apart = {round(b - a, 6) for a, b in itertools.pairwise(values)}
    assert unit == "rad" and len(apart) <= 1 and len(below) <= columns + 7


@pytest.mark.parametrize("rows", range(7, 20))
def test_labels_beside_are_whole_rows_and_evenly_apart(rows):
    for low, high in ((0.132, 0.217), (-0.07, 0.09), (1e-5, 2.9e-5), (119.4, 163.0), (-4e-4, 0.0)):
        *shown, _ = DotPlot(40, rows + 2, (0.0, 1.0), (low, high)).render("").plain.split("\n")[1:]
        at = [k for k, row in enumerate(shown) if "┤" in row]
        assert len(at) >= 3 and len({b - a for a, b in itertools.pairwise(at)}) == 1, (low, high, shown)


def test_nodes_and_joints_are_in_natural_order():
    names = ["10", "2", "1"]
    said = [f"node {name}: frames are missing" for name in names]
    shown = shape({"nodes": {name: {} for name in names}, "conditions": said})
    assert [node.id for node in shown.nodes] == ["1", "2", "10"]
    assert shown.wrong == ("nodes 1, 2, 10: frames are missing",)
    assert sorted(["b-10", "b-2", "2", "b-02b", "b"], key=natural) == ["2", "b", "b-2", "b-02b", "b-10"]
