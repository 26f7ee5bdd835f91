"""What every verb has in common: pure JSON where it is asked for, errors in a line, its own usage, the bus by option."""

import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from itertools import groupby
from pathlib import Path
from typing import Any

import diagnosiskit
import fleetkit
import joints
import pytest

from drivelink import cli
from drivelink.cli import main
from drivelink.errors import UsageError


def complete(script: Path, words: list[str]) -> set[str]:
    quoted = " ".join(f"'{word}'" for word in words)
    shell = f"source {script}; COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; _shtab_drivelink; "
    shell += 'printf "%s\\n" "${COMPREPLY[@]}"'
    result = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=True)
    return {line.strip() for line in result.stdout.splitlines()}


NAMED = 'name = "{}"\n[[motor]]\ninertia_kg_m2 = 0.1\n'


@pytest.mark.parametrize(
    ("verb", "arguments"),
    [
        ("run", ["{joint}"]),
        ("sim", ["{joint}"]),
        ("record", ["{joint}", "--out", "a.log", "--source", "bus"]),
        ("new", ["other.toml", "--scan"]),
    ],
)
def test_every_verb_that_uses_a_bus_takes_it_by_option(verb, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("drivelink.cli.record._ALIVE_S", 0.1)
    assert main(["new", "elbow.toml", "--interface", "virtual"]) == 0
    capsys.readouterr()
    given = [text.format(joint="elbow.toml") for text in arguments]
    assert main([verb, *given, "--interface", "carrierpigeon", "--channel", "roof"]) == 4
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith(f'drivelink {verb}: bus.interface: python-can has no "carrierpigeon": expected ')


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["run", "none.toml"], 2, "none.toml: cannot be read"),
        (["sim", "none.toml"], 2, "none.toml: cannot be read"),
        (["monitor", "elbow", "--foxglove"], 2, "--foxglove: expected a joint file"),
        (["monitor", "--web", "--json"], 2, "expected either --web or --json"),
        (["record", "none.toml", "--out", "a.csv"], 2, "none.toml: cannot be read"),
        (["keep", "none.toml"], 2, "none.toml: cannot be read"),
        (["accept", "none.toml"], 2, "none.toml: cannot be read"),
        (["monitor", "elbow", "--allow-accept"], 2, "--allow-accept: expected --web and the joint file"),
        (["replay", "none.csv"], 3, "none.csv"),
        (["fit", "none.csv"], 3, "none.csv"),
        (["diagnose", "none.csv"], 3, "none.csv"),
        *(([verb, "there.toml"], 2, "there.toml is a joint file: expected a recording") for verb in ("fit", "diagnose", "replay")),
        (["doctor", "none.toml"], 2, "none.toml: cannot be read"),
        (["service", "install", "none.toml", "--root", "stage"], 2, "none.toml: cannot be read"),
        (["new", "there.toml"], 2, "there.toml"),
        (["completion", "sh"], 2, 'shell "sh": did you mean zsh?'),
        (["fit", "a.csv", "./a.csv"], 2, "given twice: expected another recording"),
        (["diagnose", "a.csv", "--validate", "a.csv"], 2, "given twice: expected another recording"),
        (["doctor", "--eds", "nowhere.eds"], 5, "nowhere.eds"),
        (["doctor", "x.toml", "--eds", "y.eds"], 2, "--eds"),
        (["doctor", "--eds", "y.eds", "--channel", "can0"], 2, "--channel"),
        (["doctor", "--interface", "socketcan"], 2, "--interface"),
        (["record", "elbow.toml", "--out", "a.log", "--source", "bus", "--interface", "socketcan", "--channel", "can77"], 4, "can77"),
        (["sim", "elbow.toml", "--quirks", "acme"], 2, '--quirks "acme": expected one of strict, epos4'),
        (["sim", "elbow.toml", "--quirks", "epos"], 2, '--quirks "epos": did you mean epos4?'),
        (["sim", "elbow.toml", "--effect", "magic=1"], 2, '--effect: effect "magic": expected one of'),
        (["sim", "elbow.toml", "--interface", "socketcan", "--channel", "can77"], 4, "socketcan can77"),
        (["sim", "elbow.toml", "wrist.toml"], 2, "expected the same bus.channel"),
        (["sim", "far.toml"], 4, "port"),
        (["sim", "driveless.toml"], 2, "driveless.toml: motor[1].drive: expected this table"),
        (["fit", "r.csv", "--joint", "linaer.toml"], 2, 'linaer.toml: motor[1]: transmission.model "linaer": did you mean linear?'),
        (["fit", "r.csv", "--joint", "elbow.toml", "--out", "there.toml"], 2, "there.toml: expected a folder, got a file"),
        (["compare", "elbow.toml", "elbow.toml", "--out", "there.toml"], 2, "there.toml: expected a folder, got a file"),
        (["record", "elbow.toml", "--out", "r.xyz"], 3, "expected a name that ends in .mcap"),
        (["record", "elbow.toml", "--out", "none/r.csv"], 2, "there is no folder none"),
        (["new", "none/a.toml", "--case", "constant"], 2, "there is no folder none"),
        (["record", "elbow.toml", "--out", "r.log"], 2, 'bus.interface = "virtual" exists inside one process'),
        (["service", "install", "elbow.toml", "--root", "stage"], 2, "lives inside one process"),
        (["service", "install", "dots.toml", "--root", "stage"], 2, "expected the name of a network interface"),
        (["service", "install", "far.toml", "--root", "stage", "--allow", "everybody"], 2, "expected an address like"),
        (["service", "install", "far.toml", "--root", "stage", "--credential", "key"], 2, "expected NAME=FILE"),
        (["run", "endless.toml"], 6, "zenoh"),
        (["new", "a.toml", "--name", "a b"], 2, "name"),
        (["new", "a.toml", "--encoder", "left"], 2, "--encoder"),
        (["new", "a.toml", "--encoder", "128"], 2, "--encoder"),
        (["new", "a.toml", "--scan", "--passive"], 2, "--passive forbids"),
        (["new", "a.toml", "--encoder", "none"], 2, "--encoder none: expected --model none"),
        (["new", "a.toml", "--model", "none", "--arrangement", "serial"], 2, "expected a flexible one"),
        (["new", "a.toml", "--inertia", "1", "--rotor-inertia", "1"], 2, "--rotor-inertia"),
        (["new", "a.toml", "--rotor-inertia", "48.2"], 2, "--rotor-inertia: expected --gear"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)  # fmt: skip
def test_what_a_verb_cannot_do_is_one_line(
    arguments, status, line, tmp_path, monkeypatch,
    capsys,
):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("drivelink.cli.record._ALIVE_S", 0.1)
    (tmp_path / "there.toml").write_text("# mine\n")
    (tmp_path / "r.csv").touch()
    joint = NAMED + '[motor.drive]\nnode_id = 1\n[link.encoder]\n[sim]\ncase = "constant"\n[bus]\n{}\n'
    texts = {
        "elbow": joint.format("elbow", ""), "wrist": joint.format("wrist", 'channel = "other"'),
        "far": joint.format("far", 'interface = "socketcand"\noptions = { host = "127.0.0.1", port = 70000 }'),
        "dots": joint.format("dots", 'interface = "socketcan"\nchannel = "can0/../x"'),
        "endless": joint.format("endless", '[zenoh]\nendpoint = "nonsense"'),
        "driveless": NAMED.format("driveless"),
        "linaer": NAMED.format("linaer") + '[motor.transmission]\nmodel = "linaer"\n',
    }  # fmt: skip
    for name, text in texts.items():
        (tmp_path / f"{name}.toml").write_text(text)
    before = sorted(tmp_path.iterdir())
    try:
        ended = main(arguments)
    except SystemExit as exit_:  # argparse's own: its usage comes first
        ended = int(exit_.code or 0)
    said = capsys.readouterr()
    lines = [text for text in said.err.splitlines() if not text.startswith(("usage: ", " "))]
    assert (ended, said.out) == (status, "")
    assert len(lines) == 1 and lines[0].startswith(f"drivelink {arguments[0]}: ") and line in lines[0]
    assert (tmp_path / "there.toml").read_text() == "# mine\n" and sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("verb", cli.VERBS)
def test_an_unknown_option_prints_the_usage_of_its_own_verb(verb, capsys):
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


# Of `fit`, `replay`, `diagnose` and what needs processes or a table, see the tests of each.
def test_new_sim_and_service_print_one_object(tmp_path, capsys):
    joint, stage = tmp_path / "elbow.toml", str(tmp_path / "stage")

    def said(*words: str) -> dict[str, Any]:
        assert main([*words, "--json"]) == 0
        (line,) = capsys.readouterr().out.splitlines()
        return json.loads(line)

    made = said("new", str(joint))
    assert made["joint"] == "elbow" and made["path"] == str(joint) and "placeholder" in made["remarks"][0]
    assert "[[motor]]" in said("new", "-")["text"]
    ready = said("sim", str(joint), "--interface", "virtual", "--seconds", "0.1")
    assert ready["event"] == "ready" and ready["devices"] == {"elbow": {"drive": [1], "encoder": []}}
    installed = said("service", "install", str(joint), "--root", stage)
    assert installed["unit"] == "drivelink@elbow.service" and not installed["running"]
    assert all(Path(path).is_file() for path in installed["written"])
    removed = said("service", "uninstall", str(joint), "--root", stage)
    assert set(removed["removed"]) == set(installed["written"])


def test_a_console_without_unicode_gets_the_words_spelt_out(tmp_path, monkeypatch):
    run, joint = tmp_path / "run.csv", tmp_path / "elbow.toml"
    joints.write_csv(diagnosiskit.World([{}], seconds=4.0).run()[0], run)
    joint.write_text(fleetkit.JOINT.format(name="elbow"))
    console = io.TextIOWrapper(io.BytesIO(), encoding="ascii")  # anything else would raise an error
    monkeypatch.setattr(sys, "stdout", console)
    assert main(["fit", str(run), "--joint", str(joint)]) == 0
    console.seek(0)
    said = console.read()
    assert "N*m rms left" in said and "?" not in said
    for drawn, table in groupby(said.splitlines(), lambda line: line.startswith(("|", "+"))):
        assert not drawn or len({len(line) for line in table}) == 1


def test_a_misspelt_verb_choice_or_option_has_the_one_that_is_meant(capsys):
    assert main(["moniter"]) == main(["demo", "--case", "frictoin"]) == 2
    verb, case = capsys.readouterr().err.splitlines()
    assert verb == 'drivelink: VERB "moniter": did you mean monitor?'
    assert case == 'drivelink demo: --case "frictoin": did you mean friction?'
    with pytest.raises(SystemExit):
        main(["sim", "elbow.toml", "--intreface", "socketcand"])
    assert (
        "unrecognized arguments: --intreface socketcand (did you mean --interface?)"
        in capsys.readouterr().err
    )


def test_a_joint_s_name_is_not_its_file(capsys, monkeypatch):
    monkeypatch.setattr("drivelink.pubsub.clientbase.joints", lambda: ["elbow"])
    assert main(["record", "elbow", "--out", "elbow.mcap"]) == main(["keep", "knee"]) == 2
    served, unknown = capsys.readouterr().err.splitlines()
    assert 'a daemon serves "elbow": expected the joint file that it was started with' in served
    assert "expected a joint file, such as elbow.toml" in unknown


def _numeric(verb):
    (verbs,) = cli.make_parser([verb])._subparsers._group_actions
    return [
        a
        for a in verbs.choices[verb]._actions
        if a.option_strings and a.type not in (None, Path, cli.recording_path)
    ]


BEYOND = {"--port": "65536", "--motion-seconds": "3.9", "--node": "128"}


@pytest.mark.parametrize("verb", cli.VERBS)
def test_a_number_that_cannot_be_is_one_line_in_every_verb(verb):
    for action in _numeric(verb):
        assert "add_number" in action.type.__qualname__, f"{action.option_strings}: its range is not declared"
        (option,) = action.option_strings
        zero = [] if option in ("--port", "--seed", "--damping") else ["0"]
        beyond = "3601" if (verb, option) == ("doctor", "--seconds") else BEYOND.get(option, "nan")
        for wrong in ("nan", "inf", "-1", "-1e9", "", "x", beyond, *zero):
            with pytest.raises(UsageError, match=f"^{option}: expected a .*number .*, got {wrong}$"):
                action.type(wrong)


def test_ctrl_c_while_an_error_is_said_ends_without_a_traceback(monkeypatch, tmp_path):
    def pressed(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "_fail", pressed)
    assert main(["run", str(tmp_path / "nosuch.toml")]) == 130


def test_zsh_has_its_script_and_the_manual_page_every_verb_and_exit_status(capsys):
    assert cli.main(["completion", "zsh"]) == 0
    assert "replay" in capsys.readouterr().out
    page = (Path(__file__).parent.parent / "packaging" / "drivelink.1").read_text(encoding="utf-8")
    for verb, summary in cli.VERBS.items():
        assert f".B {verb}\n{summary.replace('-', chr(92) + '-')}\n" in page
    reference = (Path(__file__).parent.parent / "docs" / "reference" / "commands.md").read_text(
        encoding="utf-8"
    )
    statuses = re.findall(r"^\| (\d+) \| (.+) \|$", reference, re.MULTILINE)
    assert statuses
    for status, text in statuses:
        assert f".B {status}\n{text.replace('`', '').replace('-', chr(92) + '-')}\n" in page


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_verbs_options_and_choices(tmp_path, capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "drivelink.bash"
    script.write_text(capsys.readouterr().out)
    assert set(cli.VERBS) <= complete(script, ["drivelink", ""])
    assert "--publish" in complete(script, ["drivelink", "replay", "--"])
    assert complete(script, ["drivelink", "demo", "--case", ""]) >= {"constant", "quadratic", "vsa-ii"}


@pytest.mark.parametrize("arguments", [["new", "-", "--case", "constant"], ["completion", "bash"]])
def test_output_that_cannot_be_written_is_one_line_and_a_failure(arguments):
    run = "import sys; from drivelink.cli import main; sys.exit(main(sys.argv[1:]))"
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", run, *arguments], stdout=full, stderr=subprocess.PIPE, text=True
        )
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done
    assert done.stderr.endswith(": standard output: No space left on device\n")


def test_closed_outputs_are_no_traceback():
    for closed, said in ((">&-", b""), ("2>&-", b"drivelink"), (">&- 2>&-", b"")):
        run = ["sh", "-c", f"exec {sys.executable} -m drivelink --version {closed}"]
        done = subprocess.run(run, capture_output=True, timeout=60)
        assert done.returncode == 0 and done.stdout.startswith(said) and done.stderr == b"", done


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_results_are_written_also_where_the_reader_of_what_is_printed_has_gone(tmp_path, options):
    elbow = str(Path(__file__).parent.parent / "examples" / "elbow.toml")
    reader, writer = os.pipe()
    os.close(reader)
    run = [sys.executable, "-m", "drivelink", "compare", elbow, elbow, "--out", str(tmp_path), *options]
    done = subprocess.run(run, stdout=writer, stderr=subprocess.PIPE, timeout=120)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"") and (tmp_path / "comparison.json").exists(), done


def test_an_interrupt_while_modules_are_loaded_prints_no_traceback(tmp_path):
    stub = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / "argparse.py").write_text(stub)
    path = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    ended = subprocess.run([sys.executable, "-m", "drivelink"], env=path, capture_output=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (-signal.SIGINT, b"")
    (tmp_path / "argparse.py").unlink()
    # Ignored, as behind `&` in a script.
    (tmp_path / "json.py").write_text(f"{stub}import sys\nsys.exit(7)\n")
    behind = ["sh", "-c", f"trap '' INT; exec {sys.executable} -m drivelink"]
    assert subprocess.run(behind, env=path, capture_output=True, timeout=60).returncode == 7
