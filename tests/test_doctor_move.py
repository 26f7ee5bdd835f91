"""`doctor --move`: a person turns the joint, and every wrong sign and scale ends in the line that cures it."""

import io
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
from daemonkit import served

from drivelink.canopen.layout import Signal
from drivelink.cli import main
from drivelink.cli.doctor import _Terminal
from drivelink.doctor.livevalues import Series, values_of
from drivelink.doctor.manualcheck import ByHand, Value, check_by_hand
from drivelink.jointfile import JointFile, load, parse


def once(ask: Callable[..., str], start: str, then: str) -> Callable[..., str]:
    """`ask`, which answers otherwise when it is asked a second time."""
    asked = []

    def answer(text: str, meanwhile: Callable[[], object]) -> str:
        asked.append(text)
        again = text.startswith(start) and asked.count(text) > 1
        return then if again else ask(text, meanwhile)

    return answer


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


def joint(arrangement: str = "single", gear: float = 1.0, axis: str = "rotary") -> JointFile:
    more = "" if arrangement == "single" else SECOND
    return parse(f'axis = "{axis}"\n' + JOINT.format(arrangement=arrangement, gear=gear, more=more))


class HandMovedJoint:
    """A joint whose channels read so many times what is true, and a person who does what is said."""

    def __init__(self, wrong: Mapping[str, float], replies: Mapping[str, str] | None = None) -> None:
        self.wrong, self.replies = wrong, dict(replies or {})
        self.true = {f"motor{i}_{what}": 0.0 for i in (1, 2) for what in ("position", "torque")}
        self.true["link_position"] = 0.0
        self.said: list[str] = []
        self.unread: set[str] = set()
        self.push, self.std = 1.5, 1e-4

    def read(self, seconds: float) -> Mapping[str, Value]:
        read = (name for name in self.true if name not in self.unread)
        return {name: Value(self.wrong.get(name, 1.0) * self.true[name], self.std) for name in read}

    def show(self, text: str) -> None:
        self.said.append(text)

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        meanwhile()
        if text.startswith("Move the joint"):
            for name in ("motor1_position", "motor2_position", "link_position"):
                self.true[name] += 0.051
        elif text.startswith("Turn the joint"):
            for name in ("motor1_position", "motor2_position", "link_position"):
                self.true[name] += math.radians(88.0)  # by eye
        elif text.startswith("Turn motor 2"):
            self.true["motor2_position"] += math.radians(92.0)
        elif text.startswith("Push"):  # the drives hold against it: eqs 4, 5
            for i in (1, 2):
                self.true[f"motor{i}_torque"] -= self.push
        return next((reply for start, reply in self.replies.items() if text.startswith(start)), "")


def checked(
    wrong: Mapping[str, float], arrangement: str = "single", gear: float = 1.0, **replies: str
) -> ByHand:
    rig = HandMovedJoint(wrong, replies)
    return check_by_hand(joint(arrangement, gear), rig.read, rig)


def test_what_is_right_is_ticked_and_nothing_is_to_paste():
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
        ({"motor1_position": -1.0}, 1.0, ["motor[1].drive.direction = -1", "motor[1].drive.torque_direction = 1"]),
        ({"motor1_position": 2.0}, 1.0, ["motor[1].drive.counts_per_rev = 8011"]),  # 176 degrees for 90
        ({"motor1_position": 100.0, "motor1_torque": 0.01}, 1.0, ["motor[1].drive.gear_ratio = 97.78"]),
        ({"motor1_position": 0.02, "motor1_torque": 50.0}, 50.0, ["motor[1].drive.gear_ratio = 0.9778"]),
        ({"link_position": 4.0}, 1.0, ["link.encoder.counts_per_rev = 256300"]),
        ({"motor2_position": -1.0, "motor2_torque": -1.0}, 1.0, ["motor[2].drive.direction = -1"]),
    ],
)  # fmt: skip
def test_each_fault_ends_in_the_line_that_cures_it(wrong, gear, lines):
    done = checked(wrong, "antagonistic" if "motor2_position" in wrong else "single", gear)
    assert {mark.channel for mark in done.marks if mark.good is False} <= set(wrong)
    got = [line.partition(" = ") for line in done.paste]
    want = [line.partition(" = ") for line in lines]
    assert [g[0] for g in got] == [w[0] for w in want]
    for g, w in zip(got, want, strict=True):
        assert float(g[2]) == pytest.approx(float(w[2]), rel=2e-4)
    assert not done.as_dict()["good"]


@pytest.mark.parametrize(
    ("wrong", "push", "reply", "paste"),
    [
        ({}, 1.5, "1.4", []),
        ({"motor1_torque": 1e3}, 1.5, "1.5", ["motor[1].drive.torque_constant_nm_a = 5e-05"]),
        ({}, -1.5, "-1.4", []),  # a push in the negative direction is typed with its sign
        ({"motor1_torque": -1.0}, -1.5, "-1.4", ["motor[1].drive.torque_direction = -1"]),
    ],
)
def test_a_torque_is_measured_against_a_known_push(wrong, push, reply, paste):
    rig = HandMovedJoint(wrong, {"Push": reply})
    rig.push = push
    assert check_by_hand(joint(), rig.read, rig).paste == paste


def test_what_was_not_seen_is_not_ticked():
    done = checked({}, **{"Turn": "s", "Let": "s"})
    assert done.marks and all(mark.good is None for mark in done.marks)
    assert done.as_dict()["good"] is None
    done = checked({"motor1_position": 0.0, "motor1_torque": 0.0})
    seen = {mark.channel: mark for mark in done.marks}
    assert seen["motor1_position"].good is None and "did not follow" in seen["motor1_position"].text
    assert seen["motor1_torque"].good is None and "does the drive hold?" in seen["motor1_torque"].text
    assert done.paste == []


def test_a_joint_that_does_not_rest_is_told_to_and_nothing_is_said_of_its_scale():
    rig = HandMovedJoint({"link_position": 0.2})
    rig.std = 0.05  # its controller moves it
    done = check_by_hand(joint(), rig.read, rig)
    assert not any(mark.good is not None for mark in done.marks if "position" in mark.channel)
    assert done.paste == [] and any("was not at rest" in said for said in rig.said)


def test_of_two_motors_each_torque_has_its_own_gear_and_what_is_not_read_is_not_judged():
    def pushed(wrong: dict[str, float], unread: str = "") -> ByHand:
        rig = HandMovedJoint(wrong, {"Push": "3.0"})
        rig.unread.add(unread)
        return check_by_hand(joint("antagonistic"), rig.read, rig)

    # The second motor's gear of 100 is not declared: its position reads 100 times as far, its torque a hundredth.
    done = pushed({"motor2_position": 100.0, "motor2_torque": 0.01})
    assert [line.partition(" = ")[0] for line in done.paste] == ["motor[2].drive.gear_ratio"]
    scales = {mark.channel: mark.good for mark in done.marks if mark.what == "scale"}
    assert scales["motor1_torque"] is scales["motor2_torque"] is True

    torques = [
        (m.channel, m.what, m.good) for m in pushed({}, "motor2_torque").marks if "torque" in m.channel
    ]
    assert sorted(torques) == [
        ("motor1_torque", "scale", None), ("motor1_torque", "sign", True), ("motor2_torque", "sign", None),
    ]  # fmt: skip

    done = pushed({"motor1_torque": 30.0})  # one of two is wrong, and nobody knows which
    assert not done.good and done.paste == []
    assert any("in one of them or in both" in mark.text for mark in done.marks)


# The command


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Path]:
    """The joint file of a simulated drive and encoder, served by a thread on a virtual bus."""
    text = JOINT.format(arrangement="single", gear=1.0, more="")
    text = text.replace("[link.encoder]", '[link.encoder]\nsource = "cia406"\nnode_id = 9')
    channel = f"move-{tmp_path.name}"
    path = tmp_path / "elbow.toml"
    path.write_text(
        f'{text}\n[link.dynamics]\ninertia_kg_m2 = 0.2\n[sim.excitation]\nkind = "none"\n[bus]\nchannel = "{channel}"\n'
    )
    with served(load(path)):
        yield path


@contextmanager
def typed(*lines: str) -> Iterator[None]:
    """Somebody at the terminal types these lines, then goes."""
    read, write = os.pipe()
    os.write(write, "".join(f"{line}\n" for line in lines).encode())
    os.close(write)
    with os.fdopen(read) as stdin, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdin", stdin)
        yield


def test_the_command_leads_through_the_steps_and_says_what_was_not_checked(bench, capsys):
    command = ["doctor", str(bench), "--move", "--seconds", "0.05"]
    with typed("", "", "", "1.5"):  # nobody moves the simulated joint
        assert main(command) == 1
    said = capsys.readouterr().out
    for text in (
        "> Hold the joint still",
        "> Turn the joint by 90°",
        "> Push the joint",
        "0 checked and right",
    ):
        assert text in said
    assert "· motor 1 position, sign: did not follow" in said
    with typed("", "s", "s"):
        assert main([*command, "--json"]) == 1
    both = capsys.readouterr()
    document = json.loads(both.out)  # alone on stdout
    assert document["schema"] == "drivelink.doctor.move/1"
    assert document["good"] is None and document["paste"] == []
    assert "> Hold the joint still" in both.err
    with typed():
        assert main(command) == 2
    assert capsys.readouterr().err == "drivelink doctor: --move: nobody answers: run it in a terminal\n"


def test_a_reading_is_as_uncertain_as_its_count_and_two_counts_are_no_reaction_to_a_push():
    series = Series([0.0, 0.1], [0.24, 0.24], [0.0, 0.0], step=0.12)
    read = values_of({(Signal.MOTOR_TORQUE, 0): series})["motor1_torque"]
    assert read.mean == 0.24 and read.std == pytest.approx(0.12 / math.sqrt(12.0))
    rig = HandMovedJoint({})
    rig.std, rig.push = read.std, 0.24
    done = check_by_hand(joint(), rig.read, rig)
    (mark,) = (mark for mark in done.marks if mark.channel == "motor1_torque")
    assert mark.good is None and "no reaction" in mark.text and "motor1_torque" not in done.needed


def test_a_linear_axis_is_moved_in_millimetres_and_pushed_in_newtons():
    rig = HandMovedJoint({})
    done = check_by_hand(joint(axis="linear"), rig.read, rig)
    assert done.good and done.paste == []
    assert any("+51 mm (+0.051 m) for +50 mm (+0.05 m)" in line for line in rig.said)
    assert any("-1.5 N against the push" in line for line in rig.said)
    rig = HandMovedJoint({"link_position": 1e3}, {"Move": "0.051 m"})  # counts taken for millimetres
    done = check_by_hand(joint(axis="linear"), rig.read, rig)
    assert done.paste == ["link.encoder.counts_per_rev = 6.5536e+07"]
    rig = HandMovedJoint({}, {"Move": "90 deg"})
    rig.ask = once(rig.ask, "Move", "51")  # type: ignore[method-assign]
    assert check_by_hand(joint(axis="linear"), rig.read, rig).good
    assert "expected an amount like 50 or 0.2 m, got 90 deg" in rig.said


@pytest.mark.parametrize("terminal", [True, False])
def test_a_line_is_folded_between_words_on_a_terminal_and_whole_elsewhere(terminal, monkeypatch):
    for name, value in {"COLUMNS": "40", "TERM": "xterm"}.items():
        monkeypatch.setenv(name, value)
    out = io.StringIO()
    monkeypatch.setattr(out, "isatty", lambda: terminal)
    text = "Turn the joint by 90° in the [positive] direction and hold it there."
    _Terminal(out).show(text)
    lines = out.getvalue().rstrip("\n").split("\n")
    assert " ".join(map(str.rstrip, lines)) == text and (max(map(len, lines)) <= 40) == terminal
