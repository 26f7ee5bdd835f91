"""The daemon's life: what it publishes, how it starts and ends, another model in the running loop."""

import argparse
import math
import os
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from daemonkit import Collector, DaemonRig, Listener, quiet_daemon, rig, running, served, vsa, vsa_text
from zenohkit import free_endpoint, until

from drivelink._core import SYNC_COB_ID
from drivelink.cli import moved
from drivelink.daemon import reload, service
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import network_from_joint
from drivelink.errors import UsageError, ZenohError
from drivelink.jointfile import JointFile, load, load_text, parse
from drivelink.loop import acceptance
from estimator.sample import Estimate, Status

LINK = """
[link.dynamics]
inertia_kg_m2 = 0.003
viscous_damping_nm_s_rad = 0.001
gravity_nm = 0.2943
"""


def daemon(joint: JointFile) -> Daemon:
    return Daemon([ServedJoint(joint=joint)], real_time=False)


@pytest.fixture
def no_thread_left() -> Iterator[None]:
    """Whatever the test starts is gone when it ends."""
    before = set(threading.enumerate())
    yield
    assert {thread.name for thread in set(threading.enumerate()) - before} == set()


def test_the_uptime_is_not_that_of_a_clock_that_was_set(monkeypatch):
    with rig() as made:
        monkeypatch.setattr(time, "time", lambda: 4e9)
        assert made.status["time"] == 4e9 and made.status["uptime_s"] < 3600.0


def test_a_second_daemon_of_the_same_name_is_refused_and_leaves_the_drives_alone():
    joint = vsa(endpoint=free_endpoint())
    # The first one has its name from the start on; it need not run, and so asks no drive anything.
    with served(joint), daemon(joint):
        listener = Listener(joint)
        with pytest.raises(ZenohError, match="another daemon already serves a joint named elbow"):
            daemon(vsa(endpoint=joint.zenoh.endpoint))
        assert not [f for f in listener.frames() if 0x600 <= f[0] < 0x680 or f[0] == 0]
        listener.close()


def test_connections_that_never_say_anything_do_not_hold_up_its_end(monkeypatch):
    """A session waits for them, up to ten seconds; systemd kills after five."""
    waited, over, close, ended = threading.Event(), threading.Event(), service.close_session, []

    def patiently(session):
        close(session)
        waited.set()
        ended.append(over.wait(20))

    monkeypatch.setattr(service, "close_session", patiently)
    monkeypatch.setattr(service, "_CLOSING_S", 0.05)
    joint = vsa(endpoint=free_endpoint())
    with served(joint):
        with daemon(joint):
            pass
        assert waited.wait(60) and not ended
    over.set()


def test_joints_of_one_daemon_share_the_bus():
    one, other = vsa(name="one", channel="a"), vsa(name="other", channel="b")
    with pytest.raises(UsageError, match=r"\[bus\] differs between one and other"):
        Daemon([ServedJoint(joint=one), ServedJoint(joint=other)])
    with pytest.raises(UsageError, match="two joints are named one"):
        Daemon([ServedJoint(joint=one), ServedJoint(joint=one)])


@pytest.mark.usefixtures("no_thread_left")
def test_when_sync_stops_the_estimates_are_stale_and_come_back_with_it():
    joint = vsa()
    follow = vsa(name="guest", channel=joint.bus.channel, bus='sync = "follow"')
    with served(joint) as network:
        listener = Listener(joint)
        stop = threading.Event()
        going = threading.Event()
        going.set()

        def master() -> None:
            while not stop.wait(0.002):
                if going.is_set():
                    listener.send(SYNC_COB_ID)

        maker = threading.Thread(target=master)
        maker.start()
        follower = quiet_daemon(follow)
        pipeline = follower.pipelines[0]
        with running(follower):
            until(lambda: pipeline.estimate and not pipeline.estimate.status & Status.STALE)
            going.clear()
            until(lambda: follower.documents()[0]["state"] == "no SYNC")
            assert pipeline.estimate.status & Status.STALE
            assert not pipeline.estimate.status & Status.VALID
            going.set()
            until(lambda: not pipeline.estimate.status & Status.STALE)
        stop.set()
        maker.join()
        listener.close()
        assert network.syncs > 0


@pytest.fixture
def reloadable(tmp_path: Path) -> Iterator[DaemonRig]:
    path = tmp_path / "elbow.toml"
    path.write_text(f'{vsa_text()}[recording]\nfolder = "kept"\n', encoding="utf-8")
    made = DaemonRig(load(path), path)
    yield made
    made.close()


def rewrite(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


IN_USE = "elbow.toml: the model in it is now in use"
NOT_YET = "elbow.toml: edited, not in use yet"


def test_accepting_a_model_and_undoing_it_lose_no_cycle(reloadable, tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "load_apart", load)  # by a process: test_jointfile.py
    monkeypatch.setattr(reload, "_EVERY_S", 0.05)
    made, path = reloadable, tmp_path / "elbow.toml"
    made.run(3000)  # until the model in use has shown itself valid
    syncs, source, estimates = made.network.syncs, load_text(path), list[Estimate]()
    old = made.loop_joint.pipeline.estimator

    def exchanged() -> bool:
        estimates.extend(made.run(10))
        return made.loop_joint.pipeline.estimator is not old

    rewrite(path, "k_nm_rad = 0.5", "k_nm_rad = wrong")
    made.daemon.reload()
    until(lambda: estimates.extend(made.run(20)) or any("the model stays as it is" in e for e in made.events))
    assert not exchanged()  # a file with an error leaves the model as it is
    path.write_text(source.text, encoding="utf-8")
    better = tmp_path / "better.toml"
    better.write_text(source.text.replace("k_nm_rad = 0.5", "k_nm_rad = 0.51"), encoding="utf-8")
    (tmp_path / "kept").mkdir()
    recording = tmp_path / "kept" / "elbow-20260105T081500Z-model-alarm.mcap"
    acceptance.accept(acceptance.Proposal(source, recording, {}, load_text(better)))
    until(exchanged)
    assert acceptance.accepted_at(made.daemon._reloaders[0]._joint)
    old = made.loop_joint.pipeline.estimator
    acceptance.undo(path)
    until(exchanged)
    estimates += made.run(50)
    sequences = [estimate.sequence for estimate in estimates]
    assert len(sequences) == made.network.syncs - syncs
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    assert not any(estimate.status & Status.STALE for estimate in estimates)
    assert all(estimate.status & Status.VALID for estimate in estimates)
    assert IN_USE in made.events


def test_a_reload_for_which_the_system_has_no_thread_is_made_when_it_has(reloadable, tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "_EVERY_S", 0.0)
    (reloader,) = reloadable.daemon._reloaders
    rewrite(tmp_path / "elbow.toml", "= 0.5,", "= 0.51,")
    with pytest.MonkeyPatch.context() as full, pytest.raises(RuntimeError, match="no more"):
        full.setattr(threading.Thread, "start", lambda _: (_ for _ in ()).throw(RuntimeError("no more")))
        reloader.check()
    reloader.check()
    until(lambda: reloader._ready is not None)


def test_the_new_model_comes_into_use_even_where_its_thread_gets_no_time(reloadable, tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "_PATIENCE", 50)
    monkeypatch.setattr(reload, "_PAUSE_S", 60.0)  # five steps, and never another one
    made = reloadable
    made.run(1000)
    old = made.loop_joint.pipeline.estimator
    rewrite(tmp_path / "elbow.toml", "= 0.5,", "= 0.51,")
    (reloader,) = made.daemon._reloaders
    reloader.check()
    until(lambda: reloader._ready is not None)
    behind = len(made.loop_joint.pipeline.history)
    estimates = made.run(2 * 50 + behind)  # while it waits 50 more samples come; then two steps for each
    assert made.loop_joint.pipeline.estimator is not old
    assert not any(estimate.status & Status.STALE for estimate in estimates)
    assert IN_USE in made.events


def test_another_period_of_the_master_begins_anew_with_the_model_in_use(reloadable, monkeypatch):
    made = reloadable
    made.run(100)
    (before,) = made.daemon.pipelines
    changed = made.joint.model_copy(update={"provenance": {"a": "reloaded"}})
    monkeypatch.setattr(made.daemon._reloaders[0], "_joint", changed)
    periods = iter([0.002])

    def paced(loop: object) -> None:
        assert loop is made.daemon.loop
        for period_s in periods:
            made.daemon._supervisor.bus.on_period(period_s)
            return

    monkeypatch.setattr("drivelink.daemon.service.realtime.run", paced)
    made.daemon.run()
    (pipeline,) = made.daemon.pipelines
    assert pipeline is not before and made.daemon.loop.period_ns == 2_000_000
    assert made.daemon._joints[0].joint is changed
    assert "SYNC comes every 2 ms, not 1 ms: estimates begin anew with it" in made.events
    made.daemon.run_lockstep(50)
    status = made.daemon.documents()[0]
    assert (status["period_s"], status["estimates"], status["conditions"]) == (0.002, 50, [])


def test_a_flood_of_reloads_begins_one_in_a_while_and_forgets_none(reloadable, monkeypatch):
    now_s = 1000.0
    begun: list[float] = []
    clock = SimpleNamespace(monotonic=lambda: now_s, sleep=time.sleep)
    made = reloadable
    monkeypatch.setattr(reload, "time", clock)
    (reloader,) = made.daemon._reloaders
    monkeypatch.setattr(
        reloader, "_prepare", lambda _asked: begun.append(now_s) or setattr(reloader, "_thread", None)
    )
    for k in range(300):  # 30 a second, for ten seconds
        now_s = 1000.0 + k / 30
        reloader.request()
        reloader.check()
        while reloader._thread is not None:
            pass
    assert 9 <= len(begun) <= 11
    now_s += 10.0
    reloader.check()  # the last request is still there
    while reloader._thread is not None:
        pass
    assert begun[-1] == now_s


def taken(reloader: reload.Reloader) -> None:
    """Have the joint file read, as far as the exchange."""
    reloader._next_s = 0.0
    reloader.check()
    until(lambda: reloader._thread is None or reloader._ready is not None)


def test_what_needs_a_restart_is_said_beside_what_the_daemon_was_started_with(tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "load_apart", load)
    path, options = tmp_path / "elbow.toml", argparse.Namespace(interface=None, channel="elsewhere")
    text = f'{vsa_text()}[recording]\nfolder = "kept"\n'
    path.write_text(text, encoding="utf-8")
    with rig(moved(load(path), options), path, move=partial(moved, args=options)) as made:
        (reloader,) = made.daemon._reloaders
        changed = text.replace('"kept"', '"box"').replace("node_id = 3", "node_id = 4")
        said = "elbow.toml: recording, link.encoder changed, which requires a restart of the daemon"
        for content, stands in ((changed, [said]), (text, [])):
            path.write_text(content, encoding="utf-8")
            taken(reloader)
            until(lambda: made.run(20) and reloader._thread is None)
            assert made.status["conditions"] == stands
        assert made.events == [NOT_YET, said, IN_USE, IN_USE]


def test_whether_a_joint_file_is_in_use_is_told_by_its_text(reloadable, tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "load_apart", load)
    path, (reloader,) = tmp_path / "elbow.toml", reloadable.daemon._reloaders
    text = path.read_text(encoding="utf-8")
    rewrite(path, "= 0.5,", "= 0.6,")  # while the daemon was starting
    taken(reloader)
    assert reloadable.status["conditions"] == [NOT_YET]
    until(lambda: reloadable.run(20) and reloader._thread is None)
    assert reloadable.status["conditions"] == [] and reloader._joint == load(path)
    stamps = path.stat()
    rewrite(path, "= 0.6,", "= 0.7,")  # of the same size, and then with the same time
    os.utime(path, ns=(stamps.st_atime_ns, stamps.st_mtime_ns))
    taken(reloader)
    assert reloadable.status["conditions"] == [NOT_YET]
    path.write_text(text, encoding="utf-8")  # a second edit before the first is in use
    until(lambda: reloadable.run(20) and reloader._thread is None)
    taken(reloader)
    until(lambda: reloadable.run(20) and reloader._thread is None)
    assert reloader._joint == load(path) and reloadable.events == [NOT_YET, IN_USE, IN_USE, IN_USE]
    path.touch()
    taken(reloader)
    assert reloader._thread is None and reloadable.status["conditions"] == []
    for content in ("name", text):
        path.write_text(content, encoding="utf-8")
        taken(reloader)
    assert reloadable.events[-1] == "elbow.toml: as it is in use again"


def test_a_joint_file_that_is_gone_or_none_leaves_the_model_as_it_is(reloadable, tmp_path, monkeypatch):
    monkeypatch.setattr(reload, "load_apart", load)
    made, path, before = reloadable, tmp_path / "elbow.toml", (tmp_path / "elbow.toml").read_bytes()
    (reloader,) = made.daemon._reloaders
    old = made.loop_joint.pipeline.estimator
    path.unlink()
    taken(reloader)
    path.mkdir()
    taken(reloader)
    path.rmdir()
    named = before.replace(b'"elbow"', b'"wrist"')
    for content in (
        b"",
        os.urandom(999),
        before + b"#" + bytes(300 << 10),
        before.replace(b"sdo_timeout_s = 0.1", b"bitrate = " + b"9" * 400),
        before[: len(before) // 2],
        named,
    ):
        path.write_bytes(content)
        taken(reloader)
        assert len(made.run(20)) == 20 and made.loop_joint.pipeline.estimator is old
    said = [text for text in made.events if text != NOT_YET]
    assert len(said) == 8 and "name: expected elbow, as it was at the start" in said[-1]
    assert all(text.startswith("the model stays as it is: ") and "elbow.toml" in text for text in said)
    path.write_bytes(before + b"\n")
    with monkeypatch.context() as broken:
        broken.setattr(reloader, "_build", lambda _joint: 1 // 0)
        taken(reloader)
    refused = "the model stays as it is: integer division or modulo by zero"
    assert made.events[-1] == refused and list(made.daemon.events.active.values()) == [refused]  # till mended
    path.write_bytes(before + b"\n\n")
    taken(reloader)
    until(lambda: made.run(20) and made.loop_joint.pipeline.estimator is not old)
    assert not made.daemon.events.active


SINGLE = """
name = "wrist"
[[motor]]
inertia_kg_m2 = 0.05
viscous_damping_nm_s_rad = 0.001
[motor.transmission]
model = "linear"
[motor.drive]
node_id = 11
gear_ratio = 20.0
torque_constant_nm_a = 0.005
[link.encoder]
source = "drive"
[bus]
channel = "{channel}"
period_s = 0.002
[sim]
case = "constant"
"""


@contextmanager
def two_joints() -> Iterator[Daemon]:
    elbow = vsa(bus="period_s = 0.002")
    wrist = parse(SINGLE.format(channel=elbow.bus.channel))
    joints = (elbow, wrist.model_copy(update={"bus": elbow.bus, "zenoh": elbow.zenoh}))
    with ExitStack() as stack:
        buses = [stack.enter_context(open_sim_bus(elbow.bus)) for _ in joints]
        networks = [network_from_joint(joint, bus) for joint, bus in zip(joints, buses, strict=True)]

        def devices() -> None:
            for network in networks:
                network.poll()

        yield stack.enter_context(quiet_daemon(*joints, devices=devices))


class Broken:
    """An estimator with a mistake in it."""

    residual_nm = flexibility_torque_std_nm = 0.0

    def step(self, _sample: object) -> None:
        raise ZeroDivisionError("float division by zero")

    def suspicion(self) -> None:
        return None

    def parameters(self) -> list[object]:
        return []

    undeclared = friction = parameters


def test_an_exception_in_one_joint_takes_that_one_to_a_fault_and_the_others_go_on():
    with two_joints() as made:
        made.run_lockstep(100)
        elbow, wrist = made.loop.loop_joints
        sound = wrist.pipeline.estimator
        wrist.pipeline.exchange(Broken(), None)
        collector = wrist.sink = Collector()
        made.run_lockstep(200)
        first, second = made.documents()
        assert (first["state"], first["estimates"]) == ("running", 300)
        assert (second["state"], second["estimates"]) == ("fault", 100)
        assert any("wrist: no estimates since ZeroDivisionError" in c for c in second["conditions"])
        made.events.of("wrist").begin("missing 11", "node 11: frames are missing")
        made.events.of("elbow").begin("missing 1", "node 1: frames are missing")
        made.events.of("elbow").report("wrist: is what the elbow says")
        made.loop.on_fault("wrist", ValueError("of the wrist"))
        made.events.report("the transmit queue is full")
        for document, own, other in zip(made.documents(), (1, 11), (11, 1), strict=True):
            said = document["conditions"] + [event["text"] for event in document["events"]]
            assert f"node {own}: frames are missing" in said and "the transmit queue is full" in said
            assert f"node {other}: frames are missing" not in said
            assert any("wrist: no estimates" in text for text in said) is (own == 11)
            assert ("wrist: is what the elbow says" in said) is (own == 1)
            assert ("wrist: ValueError: of the wrist" in said) is (own == 11)
        assert len(collector.estimates) == 199  # one for each cycle after that of the exception
        assert [e.sequence for e, _ in collector.estimates] == list(range(100, 299))
        assert all(e.status & Status.STALE and not e.status & Status.VALID for e, _ in collector.estimates)
        wrist.pipeline.exchange(sound, None)  # as a joint file written again does it
        made.run_lockstep(100)
        assert made.documents()[1]["state"] == "running"
        assert elbow.estimates == 400


def test_the_status_says_how_well_the_torque_is_known():
    with rig() as made:
        assert math.isnan(made.status["flexibility_torque_std_nm"])
        made.run(6000)
        (world,) = made.network._worlds
        for _ in range(20):
            estimate, std = made.run(50)[-1], made.status["flexibility_torque_std_nm"]
            assert estimate.status & Status.TORQUE_VALID
            assert 0.0 < std < 0.02  # the joint's torques reach 0.1
            assert abs(estimate.flexibility_torque_nm - world.truth().flexibility_torque_nm) < 4.0 * std


class Full:
    """A sink without a session."""

    def put(self, _tick: object) -> None:
        raise RuntimeError("no session")


def task() -> None:
    raise ValueError("a task's own")


def test_two_joints_share_a_bus_and_its_sync_and_what_goes_wrong_beside_the_cycle_is_said():
    with two_joints() as made:
        made.loop.loop_joints[0].sink = Full()
        made.loop.housekeeping.every(0.01, task)
        made.loop.listeners[0x181] = lambda *_: {}["nothing"]
        made.run_lockstep(600)
        first, second = made.documents()
        assert (first["joint"], second["joint"]) == ("elbow", "wrist")
        assert first["estimates"] == second["estimates"] == 600
        assert set(second["nodes"]) == {"11"}
        assert {pipeline.estimate.sequence for pipeline in made.pipelines} == {599}
        assert [len(pipeline.estimate.transmissions) for pipeline in made.pipelines] == [2, 1]
        assert first["bus"]["load"] == second["bus"]["load"] > 0.3
        said = " ".join(event["text"] for event in made.events.recent())
        for text in (
            "elbow: RuntimeError: no session",
            "housekeeping: ValueError: a task's own",
            "frame 0x181: KeyError",
        ):
            assert text in said


def test_the_status_has_the_external_torque_where_the_link_is_declared():
    with rig() as made:
        made.run(10)
        assert made.status["external"] is None
    with rig(parse(vsa_text() + LINK)) as made:
        made.run(10)
        begin = made.status["external"]
        assert (begin["valid"], begin["contact"]) == (False, False) and math.isnan(begin["torque_nm"])
