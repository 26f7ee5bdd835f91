"""`doctor --move`: a person turns the joint, and every wrong sign and scale ends in the line that cures it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import pytest

from drivelink.doctor.byhand import ByHand, Value, check_by_hand
from drivelink.jointfile import JointFile, parse

JOINT = """
name = "elbow"
arrangement = "{arrangement}"
[[motor]]
inertia_kg_m2 = 0.1
[motor.drive]
node_id = 1
counts_per_rev = 4096.0
gear_ratio = {gear}
torque_constant_nm_a = 0.05
{more}
[link.encoder]
counts_per_rev = 65536.0
"""
SECOND = """
[[motor]]
inertia_kg_m2 = 0.1
[motor.drive]
node_id = 2
counts_per_rev = 4096.0
"""


def joint(arrangement: str = "single", gear: float = 1.0) -> JointFile:
    more = "" if arrangement == "single" else SECOND
    return parse(JOINT.format(arrangement=arrangement, gear=gear, more=more))


class Rig:
    """A joint whose channels read so many times what is true, and a person who does what is said."""

    def __init__(self, wrong: Mapping[str, float], replies: Mapping[str, str] | None = None) -> None:
        self.wrong, self.replies = wrong, dict(replies or {})
        self.true = {f"motor{i}_{what}": 0.0 for i in (1, 2) for what in ("position", "torque")}
        self.true["link_position"] = 0.0
        self.said: list[str] = []

    def read(self, seconds: float) -> Mapping[str, Value]:
        return {name: Value(self.wrong.get(name, 1.0) * x, 1e-4) for name, x in self.true.items()}

    def say(self, text: str) -> None:
        self.said.append(text)

    def ask(self, text: str, meanwhile: Callable[[], None]) -> str:
        meanwhile()
        if text.startswith("Turn the joint"):
            for name in ("motor1_position", "motor2_position", "link_position"):
                self.true[name] += math.radians(88.0)  # by eye
        elif text.startswith("Turn motor 2"):
            self.true["motor2_position"] += math.radians(92.0)
        elif text.startswith("Push"):  # the drives hold against it: eqs 4, 5
            for i in (1, 2):
                self.true[f"motor{i}_torque"] -= 1.5
        return next((reply for start, reply in self.replies.items() if text.startswith(start)), "")


def checked(
    wrong: Mapping[str, float], arrangement: str = "single", gear: float = 1.0, **replies: str
) -> ByHand:
    rig = Rig(wrong, replies)
    return check_by_hand(joint(arrangement, gear), rig, rig)


def test_what_is_right_is_ticked_and_nothing_is_to_paste() -> None:
    for arrangement, motors in (("single", 1), ("antagonistic", 2), ("serial", 2)):
        done = checked({}, arrangement)
        ticked = {(mark.channel, mark.what) for mark in done.marks if mark.good}
        assert {
            (f"motor{i + 1}_position", what) for i in range(motors) for what in ("sign", "scale")
        } <= ticked
        assert {("link_position", "sign"), ("link_position", "scale"), ("motor1_torque", "sign")} <= ticked
        assert done.paste == [] and done.as_dict()["good"]


@pytest.mark.parametrize(
    ("wrong", "gear", "lines"),
    [
        ({"link_position": -1.0}, 1.0, ["link.encoder.direction = -1"]),
        ({"motor1_torque": -1.0}, 1.0, ["motor[1].drive.torque_direction = -1"]),
        ({"motor1_position": -1.0, "motor1_torque": -1.0}, 1.0, ["motor[1].drive.direction = -1"]),
        (
            {"motor1_position": -1.0},
            1.0,
            ["motor[1].drive.direction = -1", "motor[1].drive.torque_direction = 1"],
        ),
        ({"motor1_position": 2.0}, 1.0, ["motor[1].drive.counts_per_rev = 8011"]),  # 176 degrees for 90
        ({"motor1_position": 100.0, "motor1_torque": 0.01}, 1.0, ["motor[1].drive.gear_ratio = 97.78"]),
        ({"motor1_position": 0.02, "motor1_torque": 50.0}, 50.0, ["motor[1].drive.gear_ratio = 0.9778"]),
        ({"link_position": 4.0}, 1.0, ["link.encoder.counts_per_rev = 256300"]),
    ],
)
def test_each_fault_ends_in_the_line_that_cures_it(
    wrong: dict[str, float], gear: float, lines: list[str]
) -> None:
    done = checked(wrong, gear=gear)
    got = [line.partition(" = ") for line in done.paste]
    want = [line.partition(" = ") for line in lines]
    assert [g[0] for g in got] == [w[0] for w in want]
    for g, w in zip(got, want, strict=True):
        assert float(g[2]) == pytest.approx(float(w[2]), rel=2e-4)
    assert not done.as_dict()["good"]


def test_a_reversed_motor_of_a_pair_is_named() -> None:
    done = checked({"motor2_position": -1.0, "motor2_torque": -1.0}, "antagonistic")
    assert done.paste == ["motor[2].drive.direction = -1"]
    assert {mark.channel for mark in done.marks if mark.good is False} == {"motor2_position", "motor2_torque"}


def test_a_torque_is_measured_against_a_known_push() -> None:
    assert checked({}, **{"Push": "1.4"}).paste == []
    done = checked({"motor1_torque": 1e3}, **{"Push": "1.5"})
    assert done.paste == ["motor[1].drive.torque_constant_nm_a = 5e-05"]


def test_what_was_not_seen_is_not_ticked() -> None:
    done = checked({}, **{"Turn": "s", "Let": "s"})
    assert done.marks and all(mark.good is None for mark in done.marks)
    done = checked({"motor1_position": 0.0, "motor1_torque": 0.0})
    seen = {mark.channel: mark for mark in done.marks}
    assert seen["motor1_position"].good is None and "did not follow" in seen["motor1_position"].text
    assert seen["motor1_torque"].good is None and "does the drive hold?" in seen["motor1_torque"].text
    assert done.paste == []


def test_an_amount_has_units_and_nonsense_is_asked_again() -> None:
    replies = iter(["lots", "1.536 rad"])

    class Person(Rig):
        def ask(self, text: str, meanwhile: Callable[[], None]) -> str:
            if text.startswith("Turn the joint"):
                reply = next(replies)
                if reply == "lots":
                    return reply
                super().ask(text, meanwhile)
                return reply
            return super().ask(text, meanwhile)

    rig = Person({})
    done = check_by_hand(joint(), rig, rig)
    assert done.paste == [] and "expected an amount like 45, 0.8 rad or 50 mm, got lots" in rig.said
