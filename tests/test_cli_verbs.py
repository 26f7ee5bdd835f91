"""What every verb has in common: pure JSON where it is asked for, its own usage, the bus by option."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from drivelink import cli
from drivelink.cli import main

BUS_VERBS = ("run", "sim", "record", "doctor", "new")


def parsers() -> dict[str, argparse.ArgumentParser]:
    parser = cli.make_parser(list(cli.VERBS))
    return {verb: cli._verb_parser(parser, verb) for verb in cli.VERBS}


@pytest.mark.parametrize("verb", cli.VERBS)
def test_every_verb_prints_json(verb: str) -> None:
    assert "--json" in parsers()[verb]._option_string_actions


@pytest.mark.parametrize("verb", BUS_VERBS)
def test_every_verb_that_uses_a_bus_takes_it_by_option(verb: str) -> None:
    assert {"--interface", "--channel"} <= parsers()[verb]._option_string_actions.keys()


@pytest.mark.parametrize("verb", cli.VERBS)
def test_an_unknown_option_prints_the_usage_of_its_own_verb(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    positional = {
        "run": ["a"], "sim": ["a"], "record": ["a", "--out", "b.csv"], "replay": ["a"], "fit": ["a"],
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
    assert main(["completion", "bash", "--json"]) == 0
    assert "drivelink" in json.loads(capsys.readouterr().out)["script"]
    assert main(["service", "install", str(joint), "--root", str(tmp_path / "stage"), "--json"]) == 0
    installed = json.loads(capsys.readouterr().out)
    assert installed["unit"] == "drivelink@elbow.service" and not installed["running"]
    assert all(Path(path).is_file() for path in installed["written"])
    assert main(["service", "uninstall", str(joint), "--root", str(tmp_path / "stage"), "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["removed"]) == set(installed["written"])


def test_run_and_sim_say_ready_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
