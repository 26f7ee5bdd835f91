"""`drivelink record`: what a daemon and a bus say, into a file, with nothing sent to either."""

import json
import signal
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import daemonkit
import pytest
import zenohkit

from drivelink import cli, jointfile
from drivelink.canopen.bus import open_bus
from drivelink.cli.record import _Summary
from drivelink.cycle.sources import CanFrame
from drivelink.monitor.watcher import Watcher
from drivelink.recording import read
from drivelink.recording.canlog import read_frames
from drivelink.recording.formats import open_sink
from drivelink.recording.mapping import joint_of
from drivelink.recording.mcapfile import read_messages
from drivelink.recording.recorder import BusTap, Recorder, ZenohTap


def joint_file(folder, endpoint):
    path = folder / "elbow.toml"
    path.write_text(zenohkit.joint_text("elbow", endpoint, "[bus]\nperiod_s = 0.005\n"))
    return path


def samples_in(path):
    if not path.exists() or not path.stat().st_size:
        return 0
    return sum(message.topic.endswith("/sample") for message in read_messages(path))


def test_a_daemon_is_waited_for_and_recorded_until_sigterm_and_replays(tmp_path, capsys):
    endpoint = zenohkit.free_endpoint()
    path, out = joint_file(tmp_path, endpoint), tmp_path / "r.mcap"
    with zenohkit.process("record", path, "--out", out, "--json") as process:
        assert "no daemon serves elbow yet: waiting" in process.stderr.readline()
        with zenohkit.script("elbow", endpoint):
            zenohkit.until(lambda: samples_in(out) > 150)  # on the disk while it still records
        process.send_signal(signal.SIGTERM)
        text, errors = process.communicate(timeout=60)
    assert process.returncode == 0 and not errors, errors
    document = json.loads(text)  # one object and nothing else
    assert document["file"] == str(out) and document["recorded"]["sample"] > 150
    assert document["recorded"]["estimate"] > 150
    record = read(out, jointfile.load(path))
    assert len(record) > 150 and (record.sequence[1:] - record.sequence[:-1] == 1).all()
    assert set(record.motor_position_rad[:, 0]) == {0.5}
    status = [json.loads(m.data) for m in read_messages(out) if m.topic == "/elbow/status"]
    assert status and status[0]["state"] == "running"
    assert joint_of(out, None).text == path.read_text()
    # One file replays everything: the joint file is in it.
    assert cli.main(["replay", str(out), "--out", str(tmp_path / "e.csv")]) == 0
    assert (tmp_path / "e.csv").read_text().count("\n") == len(record) + 1
    capsys.readouterr()


def test_a_recording_of_nothing_is_an_error(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("drivelink.cli.record._ALIVE_S", 0.1)
    path, out = joint_file(tmp_path, zenohkit.free_endpoint()), tmp_path / "r.csv"
    assert cli.main(["record", str(path), "--out", str(out), "--seconds", "0.2"]) == 3
    said = capsys.readouterr()
    assert "nothing was recorded; expected a daemon that serves elbow" in said.err and not said.out
    assert not out.exists()


class InRealTime:
    """A bus in lockstep, with the stamps that one in real time would have given."""

    def __init__(self, source):
        self._source = source
        self._syncs = 0
        self.wait = source.wait

    def receive(self):
        frames = []
        for cob_id, data, _ in self._source.receive():
            self._syncs += cob_id == 0x080
            frames.append(CanFrame(cob_id, data, 1_700_000_000_000_000_000 + self._syncs * 1_000_000))
        return frames


def test_a_bus_is_recorded_by_listening_only(tmp_path):
    """Samples by the mapping that is heard, or that the daemon publishes; without the link's they cannot be made."""
    joint, taps, silent = daemonkit.vsa(), {}, []
    blind = joint.model_copy(update={"link": joint.link.model_copy(update={"encoder": None})})
    with ExitStack() as stack:

        def listen(name, of=joint, **how):
            bus, sink = open_bus(joint.bus), open_sink(tmp_path / name, joint)
            bus.send = lambda *_: silent.append(name)
            tap = BusTap(bus, of, sink, tmp_path, **how)
            tap._source = InRealTime(tap._source)
            stack.callback(bus.shutdown)
            taps[name] = (tap, sink, stack.enter_context(Recorder(sink, [tap])))

        def run(cycles):
            for _ in range(cycles):
                rig.run(1)
                for tap, *_ in taps.values():
                    tap.poll()

        for name in ("heard.mcap", "heard.csv", "heard.log"):
            listen(name)
        listen("blind.mcap", blind)
        with daemonkit.rig(joint) as rig:
            run(20)
            # The mapping is no longer on the bus.
            listen("late.csv", layouts=list(rig.daemon.layouts.values()))
            run(150)
            samples = [sample.motor_position_rad for sample, _ in rig.collector.samples]
        _, sink, recorder = taps["blind.mcap"]
        printed = _Summary(tmp_path / "blind.mcap", recorder).text()
        for *_, each in taps.values():
            each.run(lambda: True)
    assert not silent
    assert "no samples: " in printed and "no frame carries the link position" in printed
    assert sink.counts["frame"] >= 150 * 4 and not sink.counts.get("sample")
    assert sum(frame.can_id == 0x080 for frame in read_frames(tmp_path / "heard.log")) == 170
    for name, least in (("heard.mcap", 168), ("heard.csv", 168), ("late.csv", 148)):
        # The first cycle's SYNC may come before the mapping is at rest.
        found = [tuple(row) for row in read(tmp_path / name, joint).motor_position_rad.tolist()]
        # The last sample is recorded when its cycle has ended.
        assert len(found) >= least and found == samples[len(samples) - len(found) :][: len(found)], name


def test_estimates_that_were_lost_on_the_way_are_said(tmp_path, monkeypatch):
    monkeypatch.setattr("drivelink.recording.recorder.follow_document", MagicMock())
    joint = jointfile.load(Path(jointfile.__file__).parents[1] / "joints" / "vsa-ii.toml")
    session: Any = MagicMock()
    with Recorder(sink := open_sink(tmp_path / "a.mcap", joint, ""), []) as recorder:
        recorder.taps.append(tap := ZenohTap(session, joint, sink))
        for kind, numbers in (("sample", (5, 6, 7, 8, 9)), ("estimate", (5, 8, 9, 3, 4))):  # and began again
            for number in numbers:
                tap._count(kind, number, 2)
        summary = _Summary(tmp_path / "a.mcap", recorder)
        assert summary.text().endswith("s, 2 cycles without estimate")
        assert {k: n for k, n in summary.document().items() if k.startswith("cycles_without")} == {
            "cycles_without_sample": 0,
            "cycles_without_estimate": 2,
        }


def test_a_daemon_that_fell_silent_is_said(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr("drivelink.recording.recorder.time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr("drivelink.recording.recorder.follow_document", MagicMock())
    joint = jointfile.load(Path(jointfile.__file__).parents[1] / "joints" / "vsa-ii.toml")
    session: Any = MagicMock()
    with Recorder(sink := open_sink(tmp_path / "a.mcap", joint, ""), []) as recorder:
        recorder.taps.append(tap := ZenohTap(session, joint, sink))
        tap._streams, tap._take = [("estimate", stream := MagicMock())], MagicMock()
        tap._identity = MagicMock(refused=0)
        for after_s, silent in ((0.0, ""), (0.9, ""), (3.0, "3"), (0.5, "3"), (2.0, "5")):
            now[0] += after_s
            text = _Summary(tmp_path / "a.mcap", recorder).text()
            assert text.endswith(f"nothing from the daemon for {silent} s" if silent else "in 0 s")
            stream.try_recv.side_effect = [MagicMock(), None]
            tap.poll()


@pytest.mark.parametrize("what", ["recorder", "bus", "monitor"])
def test_what_comes_faster_than_it_is_used_keeps_nobody_from_flushing_and_ending(what, tmp_path, monkeypatch):
    """As on a machine that has other things to do: record and the black box did not even end by SIGTERM."""
    for module in ("recording.recorder", "monitor.watcher"):
        monkeypatch.setattr(f"drivelink.{module}.follow_document", MagicMock())
    monkeypatch.setattr("drivelink.recording.recorder._REST_S", 0.05)  # of what waits at the end
    came, session, joint = count(), MagicMock(), daemonkit.vsa()
    message = SimpleNamespace(source_info=None)

    def more(*_):
        assert next(came) < 500_000, "it never ends"
        return message

    with Recorder(sink := open_sink(tmp_path / "a.mcap", joint, ""), []) as recorder:
        if what == "bus":
            tap = BusTap(session, joint, sink, None)
            tap._source = MagicMock(wait=more, receive=lambda: [CanFrame(1, b"", 1)] * 64)
        else:
            tap = ZenohTap(session, joint, sink) if what == "recorder" else Watcher(session)
            tap._streams = [("estimate", MagicMock(try_recv=more))]
            monkeypatch.setattr(type(tap), "_take", lambda *_: None)
        tap.poll()
        if what != "monitor":
            recorder.taps.append(tap)
            recorder.run(lambda: next(came) > 2_000)
