"""What every verb has in common: pure JSON where it is asked for, errors in a line, its own usage, the bus by option."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import diagnosiskit as kit
import fleetkit
import numpy as np
import pytest

from drivelink import cli
from drivelink.cli import main


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fleetkit.make_fleet(tmp_path_factory.mktemp("verbs"), nights=1)


# `demo`, `run`, `monitor`, `record`, `fleet` and `doctor` need processes or a table: see the tests of each.
@pytest.mark.parametrize("verb", ["fit", "replay", "diagnose"])
def test_with_json_a_verb_prints_one_object_and_nothing_else(
    verb: str,
    fleet: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    run, joint = fleet / "recordings" / "elbow-2026-01-05.csv", fleet / "joints" / "elbow.toml"
    assert main([verb, str(run), "--joint", str(joint), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    if verb == "fit":
        (found,) = document["transmissions"]
        assert found["parameters"]["k_nm_rad"] == pytest.approx(kit.STIFFNESS, rel=0.01)
    elif verb == "replay":
        assert document["cycles"] == 1000 * fleetkit.SECONDS
    else:
        assert document["verdict"] == "sufficient"


@pytest.mark.parametrize(
    ("verb", "arguments"),
    [
        ("run", ["{joint}"]),
        ("sim", ["{joint}"]),
        ("record", ["{joint}", "--out", "a.log", "--source", "bus"]),
        ("new", ["other.toml", "--scan"]),
    ],
)
def test_every_verb_that_uses_a_bus_takes_it_by_option(
    verb: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "elbow.toml", "--interface", "virtual"]) == 0
    capsys.readouterr()
    given = [text.format(joint="elbow.toml") for text in arguments]
    assert main([verb, *given, "--interface", "carrierpigeon", "--channel", "roof"]) == 4
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f'drivelink {verb}: bus.interface: python-can has no "carrierpigeon", expected ')


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["demo", "--seconds", "0"], 2, "argument --seconds: expected a number of seconds > 0, got 0"),
        (["run", "none.toml"], 2, "none.toml: cannot be read"),
        (["sim", "none.toml"], 2, "none.toml: cannot be read"),
        (["monitor", "--web", "--json"], 2, "expected either --web or --json"),
        (["record", "none.toml", "--out", "a.csv"], 2, "none.toml: cannot be read"),
        (["keep", "none.toml"], 2, "none.toml: cannot be read"),
        (["accept", "none.toml"], 2, "none.toml: cannot be read"),
        (["monitor", "elbow", "--allow-accept"], 2, "--allow-accept: expected --web and the joint file"),
        (["replay", "none.csv"], 3, "none.csv"),
        (["fit", "none.csv"], 3, "none.csv"),
        (["diagnose", "none.csv"], 3, "none.csv"),
        (["fleet", "none/*.csv", "--joints", "none"], 2, "there is no none"),
        (["doctor", "none.toml"], 2, "none.toml: cannot be read"),
        (["service", "install", "none.toml", "--root", "stage"], 2, "none.toml: cannot be read"),
        (["new", "there.toml"], 2, "there.toml"),
        (["completion", "sh"], 2, "invalid choice: 'sh'"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_what_a_verb_cannot_do_is_one_line(
    arguments: list[str], status: int, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.toml").write_text("# mine\n")
    try:
        ended = main(arguments)
    except SystemExit as exit_:  # argparse's own: its usage comes first
        ended = int(exit_.code or 0)
    said = capsys.readouterr()
    lines = [text for text in said.err.splitlines() if not text.startswith(("usage: ", " "))]
    assert (ended, said.out) == (status, "")
    assert len(lines) == 1 and lines[0].startswith(f"drivelink {arguments[0]}: ") and line in lines[0]
    assert (tmp_path / "there.toml").read_text() == "# mine\n"


@pytest.mark.parametrize("verb", cli.VERBS)
def test_an_unknown_option_prints_the_usage_of_its_own_verb(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    positional = {
        "run": ["a"], "sim": ["a"], "record": ["a", "--out", "b.csv"], "keep": ["a"], "replay": ["a"], "fit": ["a"],
            "accept": ["a"], "dbc": ["a"], "compare": ["a", "b"],
        "diagnose": ["a"], "fleet": ["a"], "service": ["install", "a"], "completion": ["bash"],
    }  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main([verb, *positional.get(verb, []), "--no-such-option"])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"usage: drivelink {verb} ")
    assert "unrecognized arguments: --no-such-option" in said


def test_new_completion_and_service_print_one_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = tmp_path / "elbow.toml"
    assert main(["new", str(joint), "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["joint"] == "elbow" and made["path"] == str(joint) and "placeholder" in made["remarks"][0]
    assert main(["new", "-", "--json"]) == 0
    assert "[[motor]]" in json.loads(capsys.readouterr().out)["text"]
    assert main(["service", "install", str(joint), "--root", str(tmp_path / "stage"), "--json"]) == 0
    installed = json.loads(capsys.readouterr().out)
    assert installed["unit"] == "drivelink@elbow.service" and not installed["running"]
    assert all(Path(path).is_file() for path in installed["written"])
    assert main(["service", "uninstall", str(joint), "--root", str(tmp_path / "stage"), "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["removed"]) == set(installed["written"])


def test_sim_says_ready_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joint = tmp_path / "elbow.toml"
    assert main(["new", str(joint), "--interface", "virtual"]) == 0
    capsys.readouterr()
    assert main(["sim", str(joint), "--seconds", "0.1", "--json"]) == 0
    (ready,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert ready["event"] == "ready" and ready["devices"] == {"elbow": {"drive": [1], "encoder": []}}


def test_record_takes_another_bus(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joint = tmp_path / "elbow.toml"
    assert main(["new", str(joint)]) == 0
    capsys.readouterr()
    out = str(tmp_path / "elbow.log")
    assert main(["record", str(joint), "--out", out, "--source", "bus", "--channel", "can77"]) == 4
    assert "can77" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["fit", "a.csv", "./a.csv"], ["diagnose", "a.csv", "--validate", "a.csv"]])
def test_no_recording_validates_itself(words, capsys):
    assert main(words) == 2
    assert "given twice: expected another recording" in capsys.readouterr().err


def test_a_console_without_unicode_gets_the_words_spelt_out(tmp_path: Path) -> None:
    joint = tmp_path / "j.toml"
    joint.write_text('name = "j"\n[[motor]]\ninertia_kg_m2 = 0.1\n[motor.transmission]\nmodel = "linear"\n')
    time_s = np.arange(4000) * 0.002
    table = np.column_stack((time_s, np.sin(5 * time_s), 3 * np.cos(4 * time_s), 1.01 * np.sin(5 * time_s)))
    header = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad"
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header=header, comments="")
    command = [sys.executable, "-m", "drivelink", "fit", str(tmp_path / "r.csv"), "--joint", str(joint)]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert "Traceback" not in done.stderr and "N*m rms left" in done.stdout and done.stdout.isascii()


def test_a_model_that_does_not_exist_is_an_error_of_the_joint_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    joint = tmp_path / "j.toml"
    joint.write_text('name = "j"\n[[motor]]\ninertia_kg_m2 = 0.1\n[motor.transmission]\nmodel = "linaer"\n')
    assert cli.main(["fit", "r.csv", "--joint", str(joint)]) != 0
    assert f"{joint}: motor[1]: transmission.model: expected one of linear" in capsys.readouterr().err
