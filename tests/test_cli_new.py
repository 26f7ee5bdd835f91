import errno
import io
import re
import subprocess
import sys

import pytest
from daemonkit import served

from drivelink import jointfile
from drivelink.canopen.newfile import Answers, answers_from_bus, joint_text
from drivelink.canopen.scan import FoundNode
from drivelink.cli import main
from drivelink.errors import DriveError


def made(tmp_path, *arguments, name="elbow.toml"):
    path = tmp_path / name
    assert main(["new", str(path), *arguments]) == 0
    return jointfile.load(path)


def test_without_a_question_the_file_is_valid_and_commented(tmp_path, capsys):
    joint, path = made(tmp_path), tmp_path / "elbow.toml"
    assert (joint.name, joint.motor[0].drive.node_id) == ("elbow", 1)
    said, text = capsys.readouterr().out, path.read_text()
    assert "next: drivelink doctor" in said and "placeholder" in said
    assert text.count("#") > 15 and "PLACEHOLDER" in text  # an inertia that nobody gave
    assert main(["new", str(path)]) == 2  # it is kept unless forced
    assert "--force" in capsys.readouterr().err
    made(tmp_path, "--force", "--inertia", "7")


def test_flags_are_what_the_file_says(tmp_path):
    flags = (
        "--arrangement antagonistic --inertia 0.02 --damping 0.3 --node 3 --node 4 --gear 50 --encoder 9"
        " --interface socketcan --channel can1 --bitrate 500000 --passive --model linear --name wrist"
    )
    joint = made(tmp_path, *flags.split())
    assert joint.name == "wrist"
    assert [motor.drive.node_id for motor in joint.motor] == [3, 4]
    assert joint.motor[1].inertia_kg_m2 == 0.02
    assert joint.motor[1].drive.gear_ratio == 50
    assert joint.motor[0].transmission.model == "linear"
    assert (joint.link.encoder.source, joint.link.encoder.node_id) == ("cia406", 9)
    assert (joint.bus.channel, joint.bus.bitrate) == ("can1", 500_000)
    assert not joint.bus.configure
    assert joint.bus.sync == "follow"


NEW = [
    *((model, "single") for model in ("polynomial", "linear", "exponential", "vsa-ii", "none")),
    *(("polynomial", arrangement) for arrangement in ("antagonistic", "serial")),
]


@pytest.mark.parametrize(("model", "arrangement"), NEW)
def test_sim_accepts_every_new_file_and_says_what_it_assumes(tmp_path, model, arrangement, capsys):
    encoder = "none" if model == "none" else "9"
    made(tmp_path, "--model", model, "--arrangement", arrangement, "--encoder", encoder)
    path = str(tmp_path / "elbow.toml")
    capsys.readouterr()
    assert main(["sim", path, "--interface", "virtual", "--seconds", "0.01"]) == 0
    said = capsys.readouterr()
    assert "ready on virtual" in said.out
    warned = f"{path}: motor[1].transmission has no parameters: simulated with" in said.err
    assert warned == (model != "none")


def test_the_inertia_of_a_data_sheet_goes_through_the_gear(tmp_path, capsys):
    joint = made(tmp_path, "--rotor-inertia", "48.2", "--gear", "100", "--torque-constant", "53.8")
    assert joint.motor[0].inertia_kg_m2 == pytest.approx(48.2e-7 * 100**2)
    assert joint.motor[0].drive.torque_constant_nm_a == pytest.approx(0.0538)
    assert "48.2 g·cm² × 100² = 0.0482 kg·m²" in capsys.readouterr().out
    assert "48.2 g·cm² × 100²" in (tmp_path / "elbow.toml").read_text()


def test_questions_are_asked_where_somebody_can_answer(tmp_path, monkeypatch, capsys):
    questions = []
    text = "duble,antagonistic,-3,,50,,heavy,48.2,,,none,,socketcan,can3,200,7,8,none,drive"
    replies = iter(text.split(","))

    def answer(question):
        questions.append(question)
        return next(replies)

    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", answer)
    joint = made(tmp_path)
    assert joint.arrangement == "antagonistic"
    assert sum("g·cm²" in question for question in questions) == 3  # Enter and words are no inertia
    assert joint.motor[0].inertia_kg_m2 == pytest.approx(48.2e-7 * 50**2)
    out = capsys.readouterr().out
    assert "48.2 g·cm² × 50² = 0.01205 kg·m²" in out
    # What contradicts an earlier answer is asked again, and throws none away.
    assert "transmission: expected a flexible one" in out and "\nexpected --model none" in out
    assert "--gear" not in out and "--encoder" not in out  # nobody has given an option
    assert joint.bus.channel == "can3"
    assert [motor.drive.node_id for motor in joint.motor] == [7, 8]


def test_the_bus_is_asked_who_is_there(tmp_path, request):
    channel = request.node.name
    described = made(tmp_path, "--case", "vsa-ii", "--channel", channel, name="sim.toml")
    with served(described):
        joint = made(tmp_path, "--scan", "--interface", "virtual", "--channel", channel)
    assert joint.arrangement == "antagonistic"
    assert [motor.drive.node_id for motor in joint.motor] == [1, 2]
    assert joint.link.encoder.node_id == 10
    assert "CiA 402 (drive)" in (tmp_path / "elbow.toml").read_text()


def test_a_bus_without_a_drive_is_one_line_and_names_of_devices_cannot_break_the_file():
    with pytest.raises(
        DriveError, match=r"no CiA 402 drive answers on socketcan can0; heard: node 4 \(CiA 401"
    ):
        answers_from_bus(Answers(), [FoundNode(node_id=4, device_type=0x00010191)])
    found = [FoundNode(node_id=4, device_type=0x00020192, name='x"\n[evil]\x07\x00')]
    joint = jointfile.parse(joint_text(answers_from_bus(Answers(), found)))
    assert joint.motor[0].drive.node_id == 4


def test_the_examples_are_copied_once(tmp_path, capsys):
    assert main(["new", "--examples", str(tmp_path)]) == 0
    for page in (tmp_path / "examples").rglob("*.md"):  # beside it is no checkout
        links = re.findall(r"\]\(([^):]+)\)", page.read_text(encoding="utf-8"))
        assert all((page.parent / link).exists() for link in links), links
    script = [sys.executable, str(tmp_path / "examples" / "close_the_loop.py"), "--help"]
    assert subprocess.run(script, cwd=tmp_path, capture_output=True, timeout=60).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["examples"]  # a folder of that name is not made
    assert main(["new", "--examples", str(tmp_path)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_examples_on_a_full_disk_are_one_line_and_none(tmp_path, monkeypatch, capsys):
    def full(source, target, **_):
        raise OSError(errno.ENOSPC, "No space left on device", source, None, target)

    monkeypatch.setattr("shutil.copyfile", full)
    assert main(["new", "--examples", str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"drivelink new: {tmp_path}/examples/")
    assert line.endswith(": No space left on device")
    assert not list(tmp_path.iterdir())


def test_every_line_that_is_commented_out_is_valid_too(tmp_path):
    """Removing a `#` gives a joint file, not an error."""
    text = joint_text(Answers(nodes=[3]))
    for line in text.splitlines():
        if line.startswith("# ") and " = " in line and "config" not in line and "eds" not in line:
            jointfile.parse(text.replace(line, line[2:], 1) if "inertia" not in line else text)


def test_questions_left_unanswered_are_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    assert main(["new", str(tmp_path / "elbow.toml")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("encoder", ["drive", "9"])
def test_no_resolution_is_made_up_that_would_go_before_what_the_encoder_reports(tmp_path, encoder):
    assert made(tmp_path, "--inertia", "1", "--encoder", encoder).link.encoder.counts_per_rev is None
