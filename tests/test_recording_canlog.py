"""Raw CAN logs: the variants found in the wild, as annotated lines, and files that a crash cut off."""

import logging
import random
import struct
import time
import zlib
from io import BytesIO

import can
import pytest

from drivelink.errors import RecordingError
from drivelink.jointfile import parse
from drivelink.recording.canlog import CAN_FORMATS, NO_STAMP, LoggedFrame, read_frames
from drivelink.recording.cycles import SyncNumbering, measured_period, numbered_ahead
from drivelink.recording.formats import open_sink
from drivelink.recording.limits import AscText

JOINT = parse('name = "j"\n[[motor]]\ninertia_kg_m2 = 0.1\n[bus]\nchannel = "can0"\n')
FRAME = LoggedFrame(1_436_509_052_249_713_000, 0x181, bytes.fromhex("2A366C2BBA"), "can0")
SYNC = LoggedFrame(1_436_509_052_250_713_000, 0x080, b"", "can0")

A, B, DATA = "(1436509052.249713)", "(1436509052.250713)", "2A 36 6C 2B BA"
LEFT_OUT = f"""# a comment
(1436509052.1) can0 00000181#01
(1436509052.1) can0 181#R
{A} can0 181#2A366C2BBA
(1436509052.25) can0 20000080#0000000000000000
{B} can0 080#
"""
VARIANTS = {  # what each tool writes for FRAME and SYNC
    "candump -L": f"{A} can0 181#2A366C2BBA\n{B} can0 080#\n",
    "candump -L, newer": f"{A} can0 181#2A366C2BBA R\n{B} can0 080# T\n",
    "no brackets": f"{A[1:-1]} can0 181#2A366C2BBA\n{B[1:-1]} can0 080#\n",
    "lower case": f"{A} can0 181#2a366c2bba\n{B} can0 080#\n",
    "dotted bytes": f"{A} can0 181#2A.36.6C.2B.BA\n{B} can0 080#\n",
    "candump -t a": f" {A}  can0  181   [5]  {DATA}\n {B}  can0  080   [0]\n",
    "candump -t a, no brackets": f"{A[1:-1]}  can0  181  [5]  {DATA}\n{B[1:-1]}  can0  080  [0] \n",
    "candump -t a -a": f" {A}  can0  181   [5]  {DATA}            '*6l+.'\n {B}  can0  080   [0]             ''\n",
    "candump -t a -x": f" {A}  can0  RX - -  181   [5]  {DATA}\n {B}  can0  TX - -  080   [0] \n",
    "candump -t A": f" (2015-07-10 06:17:32.249713)  can0  181   [5]  {DATA}\n"
    " (2015-07-10 06:17:32.250713)  can0  080   [0]\n",
    "CAN FD": f"{A} can0 181##12A366C2BBA\n{B} can0 080##0\n",
    "what is not CANopen is left out": LEFT_OUT,
    "CRLF": f"{A} can0 181#2A366C2BBA\r\n{B} can0 080#\r\n",
}


@pytest.mark.parametrize("name", VARIANTS)
def test_each_variant_of_candump_gives_the_same_frames(name, tmp_path):
    path = tmp_path / "x.log"
    path.write_text(VARIANTS[name], newline="")
    assert list(read_frames(path)) == [FRAME, SYNC]


def test_a_log_without_stamps_has_frames_without_them_and_differences_are_added_up(tmp_path, caplog):
    path = tmp_path / "x.log"
    path.write_text(f"  can0  181   [5]  {DATA}\n  can0  080   [0]\n")
    assert [f.stamp_ns for f in read_frames(path)] == [NO_STAMP, NO_STAMP]
    path.write_text("".join(f" (000.000{200 + 600 * (k % 2)})  can0  080   [0]\n" for k in range(20)))
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        stamps = [f.stamp_ns for f in read_frames(path)]
    assert stamps[::2] == [200_000 + 1_000_000 * k for k in range(10)]
    assert "added up" in caplog.text


def test_stamps_in_disorder_are_no_differences(tmp_path):
    """As a busy machine records a bus of several senders: every second frame is stamped before the one before it."""
    stamps = [1_436_509_052_000_000 + 250 * k - 400 * (k % 2) for k in range(3000)]
    path = tmp_path / "x.log"
    path.write_text("".join(f"({s // 10**6}.{s % 10**6:06}) can0 080#\n" for s in stamps))
    assert [f.stamp_ns for f in read_frames(path)] == [1000 * s for s in stamps]


def many_frames(n=3000):
    rng, ids, begin = random.Random(1), (0x080, 0x181, 0x182, 0x18A), 1_700_000_000_000_000_000
    return [
        LoggedFrame(begin + 250_000 * k, ids[k % 4], rng.randbytes(8) if k % 4 else b"", "can0")
        for k in range(n)
    ]


@pytest.mark.parametrize(
    ("suffix", "ended"), [(s, e) for s, kind in CAN_FORMATS.items() if kind.writer for e in (True, False)]
)
def test_what_is_recorded_is_read_back_also_without_its_end(suffix, ended, tmp_path):
    frames, path = many_frames(), tmp_path / f"x{suffix}"
    sink = open_sink(path, JOINT)
    for k, frame in enumerate(frames, 1):
        sink.frame(frame.stamp_ns, frame.can_id, frame.data)
        if k % 1000 == 0:
            sink.flush()
    if ended:
        sink.close()
    back = list(read_frames(path))  # as a kill leaves it
    sink.abandon()
    assert [(f.can_id, f.data) for f in back] == [(f.can_id, f.data) for f in frames]
    first = back[0].stamp_ns - frames[0].stamp_ns  # ASC counts from its start, in microseconds
    assert all(abs(b.stamp_ns - f.stamp_ns - first) < 2000 for b, f in zip(back, frames, strict=True))


def test_of_several_channels_the_configured_one_is_taken(tmp_path):
    path = tmp_path / "x.log"
    lines = [f"({k}.{c}00000) can{c} 18{c}#0{c}\n" for k in range(20) for c in (0, 1)]
    path.write_text("".join(lines))
    assert {f.can_id for f in read_frames(path, configured="can1")} == {0x181}
    assert {f.can_id for f in read_frames(path, channel="can0", configured="can1")} == {0x180}
    with pytest.raises(RecordingError, match=r"channels can0, can1: say which one with --channel"):
        list(read_frames(path, configured="vcan7"))
    with pytest.raises(RecordingError, match=r"no frame of channel can7: expected one of can0, can1"):
        list(read_frames(path, channel="can7"))


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        *(
            ("x.log", content, "expected lines as candump writes them")
            for content in (b"hello\nworld\n", b"")
        ),
        ("x.blf", b"no such thing", "cannot be read as .blf log"),
        ("x.asc", b"", "no CAN frame"),
    ],
)
def test_a_file_that_is_no_log_is_one_clear_line(name, content, line, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=line) as caught:
        list(read_frames(tmp_path / name))
    assert "\n" not in str(caught.value)


def syncs(stamps_ms):
    return [LoggedFrame(round(1e6 * t), 0x080, b"", "can0") for t in stamps_ms]


def jumps(stamps_ms):
    return [jump for _, jump in numbered_ahead(syncs(stamps_ms), 1e-3)]


EVERY_MS = [float(k) for k in range(300)]


@pytest.mark.parametrize(
    ("stamps_ms", "expected"),
    [
        ([5.0] * 5 + EVERY_MS[5:], {}),  # a burst at the very start
        ([*EVERY_MS[:100], *[106.0] * 6, *EVERY_MS[106:]], {}),  # handed over at once
        ([t for t in EVERY_MS if t not in (100, 101, 200)], {100: 3, 198: 2}),  # lost: a gap
        ([*EVERY_MS[:150], 149.2, *EVERY_MS[150:]], {150: 0}),  # one of a second master, not due
        ([k * 1.0002 for k in range(20_000)], {}),  # a clock that drifts
    ],
    ids=["burst", "later", "lost", "not due", "drift"],
)
def test_gaps_are_what_is_lost_and_nothing_else(stamps_ms, expected):
    assert {k: jump for k, jump in enumerate(jumps(stamps_ms)) if jump != 1} == expected


@pytest.mark.parametrize("factor", [1.04, 1.5, 3.0])
def test_a_recorder_numbers_by_the_period_that_sync_has(factor):
    numbering = SyncNumbering(1e-3, measured_period)
    found = [*map(numbering.push, syncs([k * factor for k in range(300)])), *iter(numbering.pop, None)]
    assert [one[1] for one in found if one is not None] == [1] * 300


def test_only_lines_of_an_asc_file_that_say_something_are_looked_at(tmp_path):
    foreign, head = b"\n" * 1000 + b" \r\n// x\nx\n1\n0.1 \n", b"base hex timestamps relative\n"
    text = AscText(BytesIO(foreign + head + foreign + b"0.1 event\n0.2 1 80 Rx d 0\n"), tmp_path / "r.asc")
    found = [text.readline() for _ in range(4)]
    assert found == [head.decode(), "0.100000000 event\n", "0.300000000 1 80 Rx d 0\n", ""]


def test_a_channel_that_ends_like_a_frame_keeps_its_stamp(tmp_path):
    path = tmp_path / "r.log"
    path.write_bytes(b"(1.0) a# 080#\n (2.0)  a#  12  [1]  05\n")
    frames = list(read_frames(path))
    assert [tuple(one) for one in frames[:2]] == [(10**9, 0x80, b"", "a#"), (2 * 10**9, 0x12, b"\5", "a#")]


def test_lines_of_other_tools_cost_no_more_than_frames(tmp_path):
    costs = []
    for lines in (b"c 80#\nc 80#\n", b"c 80#\nx\n"):
        path = tmp_path / "r.log"
        path.write_bytes(lines * 20_000)
        begin = time.process_time()
        assert len(list(read_frames(path))) >= 20_000
        costs.append(time.process_time() - begin)
    assert costs[1] < 1.1 * costs[0]


def test_a_text_with_more_foreign_lines_than_frames_is_no_log(tmp_path):
    path, frame = tmp_path / "r.log", b"(1.0) can0 080#\n"
    path.write_bytes(frame * 100 + b"x\n" * 120)
    assert len(list(read_frames(path))) == 100
    path.write_bytes(frame * 100 + b"x\n" * 500_000)
    with pytest.raises(RecordingError, match="lines as candump writes them, got line 101: 'x'"):
        list(read_frames(path))


def test_blf_objects_are_read_as_python_can_reads_them(tmp_path):
    """Of CAN and CAN FD, with either head and unit, remote, with long identifiers, with zeros left out, others."""
    rng, objects = random.Random(1), b""
    for k in range(400):
        version, kind = k % 2 + 1, (1, 86, 100, 101, 73, 96)[k % 6]
        channel, payload = k % 3 + 1, rng.randbytes(64)
        can_id = rng.choice((0x80, 0x181, 0x7FF, 0x800, 0x8000_0080, 0x8000_0800))
        remote, length = rng.random() < 0.1, rng.choice((0, 1, 7, 8, 12, 64))
        if kind == 100:
            body = struct.pack("<HBBLLBBB5x64s", channel, 128 * remote, 9, can_id, 0, 0, 1, length, payload)
        elif kind == 101:
            further, flags = rng.choice((0, 32 + 8 * (version == 2) + 40 + length)), 0x1000 + 16 * remote
            written = payload[: rng.choice((length, length // 2 if not further else length))]
            body = struct.pack("<BBBxL4xL19xB4x", channel, 9, length, can_id, flags, further) + written
        else:
            body = struct.pack("<HBBL8s", channel, 128 * remote, min(length, 8), can_id, payload).ljust(48)
        head = 32 + 8 * (version == 2)
        stamp = struct.pack("<LHHQ", k % 3, 0, 0, k * 1000).ljust(head - 16, b"\0")
        base = struct.pack("<4sHHLL", b"LOBJ", head, version, head + len(body), kind)
        objects += base + stamp + body + bytes(-len(body) % 4)
    whole = struct.pack("<4sL32x8H88x", b"LOGG", 144, 1970, 1, 4, 1, 0, 1, 0, 500)
    for at in range(0, len(objects), 5000):
        packed = zlib.compress(objects[at : at + 5000])
        whole += struct.pack("<4sHHLLH14x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2) + packed
        whole += bytes(len(packed) % 4)
    path = tmp_path / "r.blf"
    path.write_bytes(whole)
    expected = [
        LoggedFrame(round(m.timestamp * 1e9), m.arbitration_id, bytes(m.data), str(m.channel))
        for m in can.BLFReader(path)
        if not (m.is_remote_frame or m.is_extended_id or m.is_error_frame) and m.arbitration_id <= 0x7FF
    ]
    assert len(expected) > 60
    for channel in dict.fromkeys(one.channel for one in expected):
        assert list(read_frames(path, channel)) == [one for one in expected if one.channel == channel]
