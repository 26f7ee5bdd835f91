"""The loop: a recording is diagnosed, its finding published, accepted by a person, and the residual watched."""

import contextlib
import errno
import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import joints
import numpy as np
import pytest
import zenohkit
from test_monitor import STATUS, lines
from zenohkit import until

from drivelink import cli, jointfile
from drivelink.demo.simulate import alter, world_from_joint
from drivelink.errors import JointFileError, RecordingError, UsageError
from drivelink.loop import acceptance, diagnosing, finding
from drivelink.loop.feed import FindingFeed
from drivelink.loop.finding import finding_file, proposal_file
from drivelink.loop.queue import Diagnoses, _of_process, next_due
from drivelink.monitor.view import JointView
from drivelink.monitor.watcher import Watcher
from drivelink.monitor.web import WebView, snapshot
from drivelink.monitor.webaccept import TOKEN_HEADER, WebAcceptance
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.ros2 import Ros2Publisher
from drivelink.recording.sinks import McapSink
from estimator.reasons import percent
from sim.world import record

ELBOW = Path(__file__).parent.parent / "examples" / "elbow.toml"
BEFORE_S, AFTER_S = 4, 5
NAME = "demo-elbow-20260105T081500Z-model-alarm.mcap"
STAMP_NS = 1_767_600_000_000_000_000


def recorded(folder: Path, effects: tuple[str, ...] = (), name: str = NAME, **parameters: float) -> Path:
    """A joint file in a folder, and what its black box keeps of a change after some seconds."""
    path, made = folder / "elbow.toml", folder / "kept" / name
    if not path.exists():
        path.write_text(ELBOW.read_text())
    made.parent.mkdir(exist_ok=True)
    source = jointfile.load_text(path)
    world = world_from_joint(source.joint)
    columns = [record(world, BEFORE_S)]
    world.advance()
    alter(world, effects, parameters)
    columns.append(record(world, AFTER_S))
    joined = {key: np.concatenate([part[key] for part in columns]) for key in columns[0]}
    sink = McapSink(made, source.joint, source.text)
    for sample in joints.of_world(joined).samples():
        sink.sample(sample, STAMP_NS + sample.sequence * 1_000_000)
    sink.close()
    return made


DIAGNOSED: list[diagnosing.Diagnosis] = []  # what was made of the recording with friction


@pytest.fixture(scope="module")
def friction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with friction, and its finding, made as the diagnosing process does but not at idle priority."""
    made = recorded(tmp_path_factory.mktemp("friction"), ("coulomb_friction=0.6",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["diagnosing", str(made)])
        for owner, name in ((os, "nice"), (os, "sched_setscheduler"), (signal, "signal")):
            patch.setattr(owner, name, lambda *_: None)
        patch.setattr(diagnosing.logging, "basicConfig", lambda **_: None)
        diagnose = diagnosing.diagnose
        patch.setattr(diagnosing, "diagnose", lambda *how: DIAGNOSED.append(diagnose(*how)) or DIAGNOSED[0])
        assert diagnosing.main() == 0
    return made


def copied(made: Path, folder: Path) -> Path:
    """The joint file of a diagnosed recording and all that belongs to it, in another folder."""
    (folder / "kept").mkdir()
    for path in (made, finding_file(made), proposal_file(made)):
        (folder / "kept" / path.name).write_bytes(path.read_bytes())
    (folder / "elbow.toml").write_text(ELBOW.read_text())
    return folder / "elbow.toml"


def test_the_finding_says_what_since_when_and_the_error_before_and_after(friction):
    found = finding.read(friction)
    assert found is not None and found["state"] == finding.PROPOSED and found["cause"] == "model alarm"
    assert "Coulomb friction (motor)" in found["sentence"]
    assert 0.0 <= BEFORE_S - (found["since"] - STAMP_NS * 1e-9) <= 1.0  # the second in which it came
    (effect,) = found["report"]["effects"]
    value, std = effect["parameters"]["torque_nm"], effect["std"]["torque_nm"]
    assert abs(value - 0.6) < 4.0 * std < 0.1
    assert found["error"]["after_rms_nm"] < 0.25 * found["error"]["before_rms_nm"]
    proposed = jointfile.load(proposal_file(friction))
    origin = proposed.provenance["diagnosis"]  # which the views show once it is accepted
    for when in ("before", "after"):
        assert origin[f"error_{when}_relative"] == pytest.approx(found["error"][f"{when}_relative"])
    motor = proposed.motor[0]  # whose inertia and damping have no deviation
    assert all(x == float(f"{x:.10g}") for x in (motor.inertia_kg_m2, motor.viscous_damping_nm_s_rad))
    assert [one.name for one in proposed.motor[0].effect] == ["deflection_offset", "coulomb_friction"]
    assert {line.partition(":")[0] for line in found["parameters"]} == {
        "Coulomb friction (motor)",
        "transmission",
    }


@pytest.fixture
def pageless(monkeypatch: pytest.MonkeyPatch) -> None:
    """No page is drawn: `friction` has one."""
    monkeypatch.setattr(diagnosing.report, "html_page", lambda *_: "")


@pytest.mark.usefixtures("pageless")
def test_a_softer_spring_is_no_effect_and_is_proposed_all_the_same(tmp_path):
    softer = {"motor1_coefficient1_nm_rad": 108.0, "motor1_coefficient2_nm_rad": 360.0}
    found = diagnosing.make(recorded(tmp_path, **softer))
    assert found["state"] == finding.PROPOSED and found["report"]["effects"] == []
    assert "the joint has changed" in found["sentence"] and "was 120 N·m/rad" in found["parameters"][0]
    fitted = found["report"]["transmissions"][0]["parameters"]["coefficients_nm_rad"]
    assert abs(fitted[0] / 108.0 - 1.0) < 0.02


@pytest.mark.usefixtures("pageless")
def test_what_rises_at_the_very_end_of_a_recording_leaves_all_of_it_to_be_diagnosed(tmp_path, monkeypatch):
    made = recorded(tmp_path)
    monkeypatch.setattr(diagnosing, "since", lambda seconds: (seconds[-3].sequence, seconds[-2].sequence))
    found = diagnosing.make(made)
    assert (found["state"], found["since"]) == (finding.NOTHING, None)


@pytest.mark.usefixtures("pageless")
def test_where_nothing_has_changed_nothing_is_proposed(tmp_path):
    made = recorded(tmp_path)
    found = diagnosing.make(made)
    assert (found["state"], found["since"]) == (finding.NOTHING, None)
    assert f"leaves, {percent(found['error']['after_relative'], 2)} of the torque" in found["sentence"]
    assert not proposal_file(made).exists()
    finding.write(made, found)
    with pytest.raises(RecordingError, match="nothing to accept: The model is sufficient"):
        acceptance.proposal(tmp_path / "elbow.toml")


@pytest.mark.usefixtures("pageless")
def test_what_would_do_harm_is_not_proposed(friction, tmp_path, monkeypatch):
    monkeypatch.setattr(diagnosing, "harm", lambda *_: "it is valid less often")
    monkeypatch.setattr(diagnosing, "diagnose", lambda *_: DIAGNOSED[0])
    made = tmp_path / friction.name
    made.write_bytes(friction.read_bytes())
    found = diagnosing.make(made)
    assert found["state"] == finding.NOTHING and not proposal_file(made).exists()
    assert found["sentence"].endswith("Nothing is proposed: it is valid less often.")


@pytest.mark.usefixtures("pageless")
def test_an_effect_of_the_link_is_proposed_by_the_links_balance_and_the_motor_stays(tmp_path):
    found = diagnosing.make(made := recorded(tmp_path, ("link_coulomb_friction=0.5",)))
    assert found["state"] == finding.PROPOSED and "error of the link torque falls" in found["sentence"]
    before, after = jointfile.load_text(tmp_path / "elbow.toml").joint, jointfile.load(proposal_file(made))
    assert [one.name for one in after.link.effect] == ["link_coulomb_friction"]
    assert after.motor == before.motor


def test_a_full_disk_is_a_line_of_the_diagnosis_too(tmp_path, monkeypatch, caplog):
    def full(path: Path, *_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    (made,) = touch(tmp_path, "081500Z-model-alarm")
    monkeypatch.setattr(sys, "argv", ["diagnosing", str(made)])
    for owner, name in ((os, "nice"), (os, "sched_setscheduler"), (signal, "signal")):
        monkeypatch.setattr(owner, name, lambda *_: None)
    monkeypatch.setattr(finding, "write_whole", full)
    monkeypatch.setattr(
        diagnosing, "make", lambda recording: finding.put(finding.page_file(recording), "page")
    )
    assert diagnosing.main() == 3
    (said,) = [record.getMessage() for record in caplog.records]
    assert said == f"elbow: {finding_file(made)}: cannot be written: No space left on device"


@pytest.mark.parametrize(("state", "level"), [(finding.NOTHING, "INFO"), (finding.PROPOSED, "WARNING")])
def test_a_sufficient_model_is_no_warning_in_the_log(state, level, tmp_path, monkeypatch, caplog):
    made = tmp_path / "elbow-20260105T081500Z-asked.mcap"
    monkeypatch.setattr(sys, "argv", ["diagnosing", str(made)])
    for owner, name in ((os, "nice"), (os, "sched_setscheduler"), (signal, "signal")):
        monkeypatch.setattr(owner, name, lambda *_: None)
    monkeypatch.setattr(diagnosing, "make", lambda recording: finding.begun(recording, state, "so it is"))
    caplog.set_level("INFO")
    assert diagnosing.main() == 0
    assert [record.levelname for record in caplog.records] == [level]


def test_a_diagnosis_is_one_line_in_the_daemons_log(tmp_path):
    """Not also two about the gaps of its recording, of samples and of frames."""
    made, source = tmp_path / "elbow-20260105T081500Z-asked.mcap", jointfile.load_text(ELBOW)
    sink = McapSink(made, source.joint, source.text)
    moved = np.linspace(0.0, 0.1, 40)
    for sample in joints.part(joints.recorded(moved, moved, moved), np.arange(40) % 7 > 0).samples():
        sink.sample(sample, STAMP_NS + sample.sequence * 1_000_000)
    sink.close()
    command = [sys.executable, "-m", "drivelink.loop.diagnosing", str(made)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "not diagnosed" in done.stderr and len(done.stderr.splitlines()) == 1


def touch(folder: Path, *events: str) -> list[Path]:
    paths = [folder / f"elbow-20260105T{event}.mcap" for event in events]
    for path in paths:
        path.write_bytes(b"garbage")
    return paths


def test_ten_alarms_a_minute_make_one_diagnosis(tmp_path):
    alarms = touch(tmp_path, *(f"0815{second:02d}Z-model-alarm" for second in range(0, 60, 6)))
    due = next_due(tmp_path, "elbow")
    assert due == alarms[-1]
    finding.write(due, finding.begun(due, finding.NOTHING, "sufficient"))
    assert next_due(tmp_path, "elbow") is None
    asked, _, later = touch(tmp_path, "081530Z-asked", "081700Z-bus-lost", "081800Z-change")
    assert next_due(tmp_path, "elbow", tried=[later]) == asked  # a person always gets an answer
    assert next_due(tmp_path, "elbow") == later


def test_garbage_and_a_killed_process_are_findings_in_one_line(tmp_path, monkeypatch, caplog):
    first, second = touch(tmp_path, "081500Z-model-alarm", "091500Z-model-alarm")
    diagnoses = Diagnoses(tmp_path, "elbow")
    diagnoses.step()
    assert finding.read(second)["state"] == finding.DIAGNOSING  # the newest first
    diagnoses._process.send_signal(signal.SIGKILL)

    def ended(path: Path) -> dict[str, object] | None:
        diagnoses.step()
        found = finding.read(path)
        return found if found is not None and found["state"] == finding.FAILED else None

    assert "ended with signal 9" in until(lambda: ended(second))["sentence"]
    assert "\n" not in until(lambda: ended(first))["sentence"] and "MCAP" in finding.read(first)["sentence"]
    assert len(caplog.records) == 1
    finding_file(first).write_text("{")  # by a disk that was full
    monkeypatch.setattr(subprocess, "Popen", None)
    diagnoses.step()  # tried already: no end of trying
    diagnoses.close()


def test_accepting_writes_the_file_keeps_the_old_one_and_can_be_undone(friction, tmp_path, capsys):
    path = copied(friction, tmp_path)
    assert cli.main(["accept", str(path)]) == 0  # nobody answers: nothing is done
    shown = capsys.readouterr().out
    assert '+name = "coulomb_friction"' in shown and "N·m before" in shown and "not accepted" in shown
    assert path.read_text() == ELBOW.read_text()
    later = path.parent / "kept" / NAME.replace("-2", "-3", 1)
    later.touch()
    finding.write(
        later, {"schema": finding.SCHEMA, "state": finding.DIAGNOSING, "sentence": "being looked for"}
    )
    offer = acceptance.proposal(path)  # what is still being diagnosed takes its place when it is done
    assert finding.foremost(later.parent, "demo-elbow") == offer.finding  # in the views, too
    finding.write(later, {**offer.finding, "state": finding.NOTHING})
    assert finding.foremost(later.parent, "demo-elbow")["state"] == finding.NOTHING
    later.unlink()
    old = acceptance.accept(offer)
    assert old.read_text() == ELBOW.read_text() and old.name.startswith("elbow-2")
    assert [one.name for one in jointfile.load(path).motor[0].effect][-1] == "coulomb_friction"
    with pytest.raises(RecordingError, match="accepted already; drivelink accept"):
        acceptance.proposal(path)
    accepted = path.read_text() + "# by hand"
    path.write_text(accepted)
    acceptance.undo(path)
    assert path.read_text() == ELBOW.read_text()
    assert [one.read_text() for one in tmp_path.glob("elbow-*-undone.toml")] == [accepted]
    with pytest.raises(UsageError, match="nothing was accepted"):
        acceptance.undo(path)
    finding.write(offer.recording, offer.finding)
    path.write_text(ELBOW.read_text().replace("gear_ratio = 50.0", "gear_ratio = 51.0"))
    edited = path.read_text()
    with pytest.raises(RecordingError, match="has changed since"):
        acceptance.proposal(path)
    with pytest.raises(JointFileError, match="has changed meanwhile"):  # while the person was asked
        acceptance.accept(offer)
    assert path.read_text() == edited


def test_what_was_accepted_and_undone_is_so_even_where_the_disk_has_no_room_for_the_finding(
    friction, tmp_path, monkeypatch
):
    path = copied(friction, tmp_path)
    offer = acceptance.proposal(path)
    full = RecordingError("no space left on device")
    monkeypatch.setattr(finding, "write", lambda *_: (_ for _ in ()).throw(full))
    acceptance.accept(offer)
    assert path.read_text() != ELBOW.read_text()
    acceptance.undo(path)
    assert path.read_text() == ELBOW.read_text()


@pytest.mark.parametrize(
    "damage",
    [
        {},
        {"state": 1},
        {"state": "proposed"},
        {"state": "", "sentence": []},
        *(
            {"state": "proposed", "sentence": "it lacks something", **more}
            for more in ({"error": [1]}, {"report": "x"}, {"report": {"advice": 7}}, {"parameters": 1.5})
        ),
    ],
)
def test_a_damaged_finding_is_none(damage, tmp_path):
    (tmp_path / "elbow.toml").write_text(ELBOW.read_text())
    (tmp_path / "kept").mkdir()
    (made := tmp_path / "kept" / NAME).touch()
    finding_file(made).write_text(json.dumps({"schema": finding.SCHEMA, **damage}))
    with pytest.raises(RecordingError, match="no finding about demo-elbow yet"):
        acceptance.proposal(tmp_path / "elbow.toml")
    assert next_due(tmp_path / "kept", "demo-elbow") == made


def status(residual: float, *, observable: bool = True, alarm: bool = False) -> dict[str, object]:
    judged = {
        "active": alarm,
        "residual_nm": [residual],
        "floor_nm": [0.1],
        "ratio": residual / 0.1,
        "limit": 3.0,
    }
    return {"residual_alarm": judged, "quality": {"observable": observable, "model_alarm": alarm}}


@pytest.mark.parametrize(
    ("residuals", "observable", "fallen", "words"),
    [
        (
            [0.11, 0.12, 0.13, 0.1, 0.14],
            True,
            True,
            "has fallen: for 5 s of motion the new model's own test has allowed it, 1.4 × its baseline in the last one",
        ),
        ([0.11, 0.12, 0.9, 0.1, 0.14, 0.12], True, False, "has not fallen within a minute"),
        ([0.11, 0.12, 0.13, 0.1, 0.14], False, False, "has not moved enough"),
    ],
)
def test_the_residual_has_fallen_when_the_new_models_own_test_allows_it_in_motion(
    residuals, observable, fallen, words, tmp_path
):
    path = tmp_path / "elbow.toml"
    path.write_text(f'{ELBOW.read_text()}[provenance.accepted]\ntime = "now"\n')
    new = {"provenance": {"accepted": {"time": "now"}}}
    trial = acceptance.Trial(path, 0.0)
    assert trial.update(status(0.9, alarm=True), {"provenance": {}}, 1.0) is None and not trial.in_use
    assert trial.update(status(0.9, alarm=True), new, 2.0) is None and trial.in_use
    for k, residual in enumerate(residuals):
        trial.update(status(residual, observable=observable), new, 3.0 + k)
    trial.update(status(residuals[-1], observable=observable), new, 60.0)
    assert trial.fallen is fallen and words in trial.sentence()
    never = acceptance.Trial(path, 0.0)
    assert never.update({}, {}, 60.0) is False and "no daemon" in never.sentence()


def test_after_an_undo_there_is_no_fall_to_wait_for(tmp_path, monkeypatch, capsys):
    path, model = tmp_path / "elbow.toml", {"provenance": {"accepted": {"time": "now"}}}
    accepted = '[provenance.accepted]\ntime = "now"\nbefore = "old.toml"\nrecording = "none"\n'
    path.write_text(ELBOW.read_text() + accepted)
    (tmp_path / "old.toml").write_text(ELBOW.read_text())
    said = iter([model, model, {"provenance": {}}])

    class Live(SimpleNamespace):
        status = status(0.9, alarm=True)
        model = property(lambda _: next(said))

    monkeypatch.setattr("drivelink.cli.accept.subscribe", lambda *_, **__: contextlib.nullcontext(Live()))
    assert cli.main(["accept", str(path), "--undo"]) == 0
    assert capsys.readouterr().out.endswith("the daemon has the old joint file in use again\n")
    assert path.read_text() == ELBOW.read_text()


def test_the_finding_is_published_to_views_queries_and_ros(friction, tmp_path):
    path = copied(friction, tmp_path)
    endpoint = zenohkit.free_endpoint()
    joint = jointfile.parse(f'{path.read_text()}[zenoh]\nendpoint = "{endpoint}"\n[ros2]\n')
    from drivelink.pubsub.session import close_session, open_client, open_session

    session = open_session(joint.zenoh, tmp_path)
    publisher, client = JointPublisher(session, joint), open_client(endpoint)
    watcher, sent = Watcher(client), []
    assert isinstance(publisher._ros2, Ros2Publisher)
    publisher._ros2._diagnostics.put = lambda payload, _: sent.append(payload)
    try:
        feed = FindingFeed(tmp_path / "kept", joint.name, publisher.put_finding)

        def shown() -> object:
            feed.check()
            watcher.poll()
            return watcher.views.get(joint.name) and watcher.views[joint.name].finding

        assert until(shown)["sentence"] == finding.read(friction)["sentence"]
        publisher.put_status(STATUS)
        assert b"finding.sentence" in sent[0] and b"Coulomb friction (motor)" in sent[0]
        view = JointView("elbow", height=24)
        view.status, view.finding = STATUS, watcher.views[joint.name].finding
        assert any("Coulomb friction (motor), error" in line for line in lines(view))
        displayed = snapshot(view, True, {})["finding"]
        assert displayed["state"] == finding.PROPOSED and len(displayed["error"]) == 2
        view.finding = {"state": 3, "sentence": ["?"]}
        assert snapshot(view, True, {})["finding"] is None
    finally:
        watcher.close()
        publisher.close()
        close_session(client)
        close_session(session)


def test_only_the_page_itself_can_accept(friction, tmp_path):
    path = copied(friction, tmp_path)
    nothing = SimpleNamespace(views={"demo-elbow": JointView("demo-elbow")}, alive=set())
    allowed, forbidden = WebView(nothing, 0, WebAcceptance(path)), WebView(nothing, 0)

    def ask(
        web: WebView, action: str, recording: str = NAME, **headers: str
    ) -> tuple[int, dict[str, object]]:
        own = {TOKEN_HEADER: web.acceptance.token if web.acceptance else "", "Origin": web.url.rstrip("/")}
        own |= {k.replace("_", "-"): v for k, v in headers.items()}
        request = urllib.request.Request(web.url + action, json.dumps({"recording": recording}).encode(), own)
        try:
            with urllib.request.urlopen(request) as reply:
                return reply.status, json.load(reply)
        except urllib.error.HTTPError as error:
            return error.code, {}

    try:
        assert ask(forbidden, "accept")[0] == 404
        assert allowed.acceptance.token in urllib.request.urlopen(allowed.url).read().decode()
        evil = "evil.example"
        for headers in ({"X_Drivelink_Token": "guess"}, {"Origin": f"http://{evil}"}, {"Host": evil}):
            assert ask(allowed, "accept", **headers)[0] == 403
        assert ask(allowed, "accept", Content_Length="-1")[0] == 400  # and reads no end of it
        assert "newer finding" in ask(allowed, "accept", "another")[1]["error"]
        assert path.read_text() == ELBOW.read_text()
        assert "coulomb_friction" in ask(allowed, "proposal")[1]["difference"]
        assert "is written" in ask(allowed, "accept")[1]["text"]
        assert "coulomb_friction" in path.read_text()
        shown = json.loads(allowed.event({}))["joints"]["demo-elbow"]
        assert "trial" in shown and not shown["undoable"]  # the daemon has it not yet
        nothing.views["demo-elbow"].model = {"provenance": jointfile.load(path).provenance}
        assert json.loads(allowed.event({}))["joints"]["demo-elbow"]["undoable"]
        assert "as it was" in ask(allowed, "undo")[1]["text"] and path.read_text() == ELBOW.read_text()
    finally:
        allowed.close()
        forbidden.close()


def test_a_diagnosis_that_waits_for_the_processors_says_so(tmp_path, monkeypatch):
    (made,) = touch(tmp_path, "081500Z-model-alarm")
    process = SimpleNamespace(poll=lambda: None, pid=1, kill=MagicMock())
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: process)
    diagnoses, now_s, said = Diagnoses(tmp_path, "elbow"), 100.0, []
    monkeypatch.setattr("drivelink.loop.queue.time.monotonic", lambda: now_s)
    cpu_s = 0.0
    for second in range(60):
        state, gains = [("R", 0.01), ("R", 0.9), ("S", 0.0)][second // 20]
        now_s, cpu_s = now_s + 1.0, cpu_s + gains
        monkeypatch.setattr("drivelink.loop.queue._of_process", lambda _, one=(state, cpu_s): one)
        diagnoses.step()
        said.append(finding.line(finding.read(made) or {}))
    waits = "diagnosis waits: processors busy for 10 s"
    assert said[5] == said[-1] == "what the model may lack is being looked for"
    assert waits in said[12] and waits not in said[25] and len(set(said)) == 2
    assert _of_process(os.getpid())[0] == "R"
    # A process that has said what it found ends late, too: that finding stays.
    finding.write(made, finding.begun(made, finding.NOTHING, "the model is sufficient"))
    monkeypatch.setattr("drivelink.loop.queue._of_process", lambda _: ("R", cpu_s))
    for _ in range(20):
        now_s += 1.0
        diagnoses.step()
    assert finding.line(finding.read(made)) == "the model is sufficient" and not process.kill.called
    now_s += 3600.0  # nor may one take the processors for ever
    diagnoses.step()
    assert process.kill.called


def test_what_lies_in_the_folder_is_no_program(tmp_path):
    path = tmp_path / "elbow.day.csv"
    with open(path, "a", encoding="ascii", opener=finding.open_own):
        assert not path.stat().st_mode & 0o111
