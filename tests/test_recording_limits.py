"""Recordings that lie about their size, that are cut, or that are damaged: one line, and little memory."""

import io
import json
import math
import os
import pkgutil
import re
import struct
import time
import zlib
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path

import can
import lz4.frame
import numpy as np
import pytest
import zstandard
from fuzzparsers import JOINT, RECORDINGS, TEXT, frames, held, read_every_way, write_recording

from drivelink._core import JsonNumbers, SyncNumbering
from drivelink.canopen.eds import load_eds
from drivelink.canopen.passivenode import PassiveNode
from drivelink.cli import require_distinct
from drivelink.demo.simulate import world_from_joint
from drivelink.errors import DrivelinkError, RecordingError
from drivelink.jointfile import ZenohSection, load, parse
from drivelink.recording import canframes, corrections, read
from drivelink.recording.canlog import CAN_FORMATS, LoggedFrame, in_order, read_frames
from drivelink.recording.corrections import Gathered
from drivelink.recording.formats import FORMATS, open_sink
from drivelink.recording.mapping import joint_of, side_file
from drivelink.recording.mcapfile import read_messages
from drivelink.recording.playback import open_playback
from estimator.sample import Sample

HEADER = "time_s,motor1_position_rad,motor1_torque_nm,link_position_rad\n"
BOMB = 320 << 20  # bytes that each unpacks to
MAGIC = b"\x89MCAP0\r\n"


@contextmanager
def little_memory(most_mib=220):
    """Less is taken than what is to be read unpacks to, whatever was taken before."""
    peak = lambda: int(re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[1]) >> 10  # noqa: E731
    Path("/proc/self/clear_refs").write_text("5")  # the peak is the present
    before = peak()
    yield
    assert peak() - before < most_mib


@contextmanager
def one_line(match=".", error=RecordingError):
    with pytest.raises(error, match=match) as caught:
        yield
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


@cache
def zstd_bomb(sized):
    out = io.BytesIO()
    with zstandard.ZstdCompressor().stream_writer(out, size=BOMB if sized else -1, closefd=False) as writer:
        for _ in range(BOMB >> 24):
            writer.write(bytes(1 << 24))
    return out.getvalue()


@cache
def lz4_bomb():
    with lz4.frame.LZ4FrameCompressor() as packer:
        parts = [packer.begin(), *(packer.compress(bytes(1 << 24)) for _ in range(BOMB >> 24))]
        return b"".join([*parts, packer.flush()])


def blf_bomb():
    packer = zlib.compressobj(1)
    packed = b"".join([*(packer.compress(bytes(1 << 24)) for _ in range(BOMB >> 24)), packer.flush()])
    container = struct.pack("<H6xL4x", 2, BOMB) + packed
    return BLF_HEAD + struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10) + container


def chunk(compression, packed, size):
    body = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 0x06, len(body)) + body


def mcap_chunk(*records):
    """Packed: so many of a record each."""
    whole = b"".join(count * one for count, one in records)
    return MAGIC + chunk(b"zstd", zstandard.ZstdCompressor().compress(whole), len(whole))


def nothing(size):
    """A record of an unknown kind."""
    return struct.pack("<BQ", 0x80, size - 9) + bytes(size - 9)


def mcap_samples(topic):
    """Each costs as much as two frames; of a joint at rest they have 8 bytes at least, compressed as can be."""
    data = mcap_bytes([(topic, 0, b'{"sequence":0,"status":3}')] * 140_000)
    return data[:8] + nothing(900_009) + data[8:]


def mcap_mappings():
    write, done = "2F001A00{:02d}000000", '{"id": 1409, "data": "60001A0000000000"}'
    asked = (json.dumps({"id": 0x601, "data": write.format(k % 2)}) for k in range(6000))
    told = (text.encode() for one in asked for text in (one, done))
    return mcap_bytes([("can", k * 100_000, data) for k, data in enumerate(told)])


UNPACKED = "at most 64 MiB unpacked, got 320 MiB"
MUCH = {
    "zstd": ("r.mcap", lambda: MAGIC + chunk(b"zstd", zstd_bomb(True), BOMB), UNPACKED),
    "zstd, unsized": ("r.mcap", lambda: MAGIC + chunk(b"zstd", zstd_bomb(False), BOMB), UNPACKED),
    "lz4": ("r.mcap", lambda: MAGIC + chunk(b"lz4", lz4_bomb(), BOMB), UNPACKED),
    "zstd, little": ("r.mcap", lambda: MAGIC + chunk(b"zstd", zstd_bomb(True), 1000), "no samples in it"),
    "unsized, little": ("r.mcap", lambda: MAGIC + chunk(b"zstd", zstd_bomb(False), 1000), "no samples in it"),
    "lz4, little": ("r.mcap", lambda: MAGIC + chunk(b"lz4", lz4_bomb(), 1000), "no samples in it"),
    "zlib": ("r.blf", blf_bomb, "expected containers of at most 64 MiB"),
    "records": ("r.mcap", lambda: mcap_chunk(((10 << 20) // 9, nothing(9))), "one record for each"),
    "bytes": ("r.mcap", lambda: mcap_chunk((60, nothing(1 << 20))), "at most 64 times its size"),
    "frames": ("r.blf", lambda: BLF_HEAD + blf_frames(100) * 1000, "one record for each"),
    "bytes of frames": ("r.blf", lambda: BLF_HEAD + blf_frames(200_000), "32 times"),
    "samples": ("r.mcap", lambda: mcap_samples("sample"), "one record for each"),
    "estimates": ("r.mcap", lambda: mcap_samples("estimate"), "one record for each"),
    "mappings": ("r.mcap", mcap_mappings, "changes of what its nodes send"),
}


@pytest.mark.parametrize("what", MUCH)
def test_a_file_that_unpacks_to_much_is_one_line_and_takes_little_memory(what, tmp_path):
    name, content, said = MUCH[what]
    (path := tmp_path / name).write_bytes(content())
    with little_memory(), one_line(said):
        list(read_messages(path)) if what == "estimates" else read(path, JOINT)


def test_of_many_columns_only_the_known_ones_are_held_and_too_many_are_one_line(tmp_path, caplog):
    path = tmp_path / "r.csv"
    path.write_text(",".join(f"c{k}" for k in range(100_000)) + "," + HEADER + "0," * 100_003 + "0\n")
    with one_line("expected at most 4096 columns, got 100004"):
        read(path, JOINT)
    with path.open("w") as file:
        file.write(",".join(f"c{k}" for k in range(4000)) + "," + HEADER)
        for k in range(2000):
            file.write("text," * 4000 + f"{k * 1e-3:.3f},{k * 0.1},1.0,{k * 0.1}\n")
    with little_memory():
        record = read(path, JOINT)
    assert np.array_equal(record.link_position_rad, np.arange(2000) * 0.1)
    (said,) = [m for m in caplog.messages if "ignored" in m]
    assert said.endswith("c11, … (4000 in all)")


@pytest.mark.parametrize("name", [f"r{ending}" for ending, kind in FORMATS.items() if kind.text])
@pytest.mark.parametrize("begin", [b"", HEADER.encode()])
def test_a_line_without_an_end_is_one_line(name, begin, tmp_path):
    path = tmp_path / name
    path.write_bytes(begin + b"(1.000000) can0 181#" + b"0" * (2 << 20))
    os.truncate(path, BOMB)
    with little_memory(), one_line("at most 1024 KiB"):
        read(path, JOINT)


def test_a_gap_of_a_million_seconds_is_replayed_and_not_fitted(tmp_path):
    path, log = tmp_path / "r.csv", tmp_path / "r.log"
    times = [k * 1e-3 for k in range(500)] + [1e6 + k * 1e-3 for k in range(500)]
    path.write_text(HEADER + "".join(f"{t!r},{t % 1!r},1.0,{t % 1!r}\n" for t in times))
    log_of(log, [(s + (10**15 if k >= 1800 else 0), i, d) for k, (s, i, d) in enumerate(frames(1200))])
    for each, says, least in (
        (path, "expected at most 10000000 periods.*got 1000000500", 1000),
        (log, "at most 100", 1101),
    ):
        with one_line(says):
            read(each, JOINT)
        assert sum(1 for _ in open_playback(each, JOINT, tmp_path)) >= least


# Damage


def log_of(path, wanted):
    sink = open_sink(path, JOINT, TEXT)
    for stamp, can_id, data in wanted:
        sink.frame(stamp, can_id, data)
    sink.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    for suffix in RECORDINGS:
        write_recording(folder / f"r{suffix}")
    return folder


def test_every_bit_of_an_mcap_length_may_be_wrong(whole, tmp_path):
    good, path = (whole / "r.mcap").read_bytes(), tmp_path / "r.mcap"
    at, lengths = 8, []
    while at + 9 <= len(good):
        lengths.append(at + 1)
        at += 9 + struct.unpack_from("<Q", good, at + 1)[0]
    for place in lengths[:12]:
        for bit in range(64):
            data = bytearray(good)
            data[place + bit // 8] ^= 1 << bit % 8
            path.write_bytes(data)
            for _ in read_messages(path):
                pass


@pytest.mark.parametrize("suffix", [s for s, kind in CAN_FORMATS.items() if kind.writer and kind.text])
def test_no_cut_of_a_log_makes_another_frame(suffix, tmp_path, caplog):
    path = tmp_path / f"r{suffix}"
    log_of(path, frames(12))
    good, truth = path.read_bytes(), list(read_frames(path))
    assert len(truth) == 36
    for end in range(len(good) - 240, len(good)):  # three or more lines of each format
        path.write_bytes(good[:end])
        found = list(read_frames(path))
        assert found == truth[: len(found)] and len(found) >= good[:end].count(b"\n") - 40
    path.write_bytes(good[: good.rindex(b"181") + 12])
    caplog.clear()
    list(read_frames(path))
    assert "the last line has no end and is omitted" in caplog.text


def mcap_bytes(messages):
    """An MCAP file of (topic, stamp in ns, data), its messages in compressed chunks."""
    records, numbers = bytearray(), {}
    for topic, stamp, data in messages:
        if topic not in numbers:
            numbers[topic] = len(numbers) + 1
            name = f"/elbow/{topic}".encode()
            body = struct.pack("<HHI", numbers[topic], 0, len(name)) + name
            body += struct.pack("<I", 4) + b"json" + struct.pack("<I", 0)
            records += struct.pack("<BQ", 0x04, len(body)) + body
        body = struct.pack("<HIQQ", numbers[topic], 0, stamp, stamp) + data
        records += struct.pack("<BQ", 0x05, len(body)) + body
    return mcap_chunk((1, bytes(records)))


def mcap_of(path, messages):
    path.write_bytes(mcap_bytes(messages))
    return path


def test_messages_of_others_in_an_mcap_file_are_one_line(tmp_path):
    path = tmp_path / "r.mcap"
    for topic, text in (
        ("sample", b"[" * 50_000),
        ("sample", b'{"time_s": "x", "motor1_position_rad": []}'),
        ("sample", b" " * 100_000 + b"{}"),
        ("sample", b'{"sequence": 0, "x": [[], []]}'),
        ("can", b'{"id": 1e9, "data": "00"}'),
        ("can", b'{"id": 1}'),
        ("mapping", b'{"joint": "elbow", "nodes": [1]}'),
        ("joint", b"[]"),
    ):
        mcap_of(path, [(topic, 0, text)])
        read_every_way(path)
    with pytest.raises(ValueError, match="without others or lists in it"):
        JsonNumbers(("sequence",))(b'{"sequence": 0, "x": [[], []]}')


NUMBERS = "0 -0.0 1.5 1E-7 0.1 1.2345678901234567e-300 123456789012345678901 1e999 5e-324 null NaN -Infinity"
NO_OBJECTS = '{ {"x"} {"x":1 {"x":1}} {"x":} {,} {"x":1,} {"x":"1"} []'


def test_numbers_of_a_message_are_those_that_json_reads():
    for text in [*NUMBERS.split(), repr(1 / 3), "9" * 400]:
        data = f' {{ "other" : "\\"" ,\n"x":{text} , "y":true}} '.encode()
        told = json.loads(data, parse_int=float)["x"]
        found, absent = JsonNumbers(("x", "z"))(data)
        told = math.nan if told is None else told
        assert absent is None and struct.pack("<d", found) == struct.pack("<d", told)
    for text in ["", '{"x":1 2}', *NO_OBJECTS.split()]:
        with pytest.raises(ValueError, match="expected a"):
            JsonNumbers(("x",))(text.encode())


def test_a_reader_of_others_reads_our_logs(whole):
    """The mapping is kept beside a log, so that a log is what its format says, and nothing else."""
    for suffix in (s for s, kind in CAN_FORMATS.items() if kind.writer):
        with can.LogReader(whole / f"r{suffix}") as reader:
            assert sum(1 for _ in reader) == 300


# What a recording carries is not trusted


@pytest.mark.parametrize("name", ["/dev/zero", "/etc/passwd", "../../../../../../etc/passwd", "sheet.eds"])
def test_the_joint_file_in_a_recording_opens_nothing(name, tmp_path):
    (tmp_path / "sheet.eds").write_text("not an EDS: reading it would be an error")
    text = TEXT.replace("node_id = 1\n", f'node_id = 1\neds = "{name}"\n')
    text += f'eds = "{name}"\n[zenoh]\nprefix = "plant"\nconfig = "{name}"\nendpoint = "tcp/192.0.2.1:7447"\n'
    document = json.dumps({"text": text, "folder": "/"}).encode()
    samples = [("can", stamp, f'{{"id":{i},"data":"{d.hex()}"}}'.encode()) for stamp, i, d in frames(600)]
    path = mcap_of(tmp_path / "r.mcap", [("joint", 0, document), *samples])
    carried = joint_of(path, None)
    assert carried.joint.motor[0].drive.eds is None and carried.joint.link.encoder.eds is None
    assert carried.joint.zenoh == ZenohSection(prefix="plant")
    with little_memory():
        assert len(read(path, carried.joint, base_dir=carried.folder)) > 500
    pytest.importorskip("pyarrow")
    fleet = pytest.importorskip("drivelink.fleet.joints")
    assert fleet.carried_joint(path).file == carried.joint


@pytest.mark.parametrize("suffix", [*FORMATS, ".toml", ".eds", "the mapping", "the motion"])
def test_only_regular_files_are_opened(suffix, tmp_path):
    path = tmp_path / f"r{suffix}"
    work = {".toml": lambda: load(path), ".eds": lambda: load_eds(path)}.get(
        suffix, lambda: read(path, JOINT)
    )
    if suffix == "the mapping":  # beside a log
        log_of(tmp_path / "r.log", frames(600))
        path = side_file(tmp_path / "r.log")
        path.unlink(missing_ok=True)
        work = lambda: joint_of(tmp_path / "r.log", None)  # noqa: E731
    if suffix == "the motion":
        played = parse(f'{TEXT}[sim]\nexcitation = {{ kind = "motion", file = "{path}" }}\n')
        work = lambda: world_from_joint(played)  # noqa: E731
    os.mkfifo(path)  # opening it would wait for a writer for ever
    with one_line("expected a regular file", DrivelinkError):
        work()
    path.unlink()
    path.symlink_to("/dev/zero")
    with one_line("expected a regular file", DrivelinkError):
        work()
    path.unlink()
    path.symlink_to(path)  # to itself
    with one_line("no such file|cannot be read.*levels of symbolic links", DrivelinkError):
        require_distinct([path])
        work()


@pytest.mark.parametrize(
    ("topic", "begin"),
    [
        ("joint", b'{"text": ['),
        ("can", b'{"id": 1, "data": ['),
        ("mapping", b'{"joint": "elbow", "nodes": ['),
    ],
)
def test_a_huge_message_is_refused_before_it_is_parsed(topic, begin, tmp_path):
    """15 MiB: less than any file may unpack to; its empty lists would take 400 MiB."""
    messages = [(topic, 0, begin + b"[]," * (5 << 20) + b"[]]}"), ("can", 0, b'{"id": 128, "data": ""}')]
    path = mcap_of(tmp_path / "r.mcap", messages)
    assert path.stat().st_size < 40_000
    with little_memory(300):
        for work in (lambda: joint_of(path, None), lambda: read(path, JOINT)):
            with one_line(error=DrivelinkError):
                work()


def test_sync_frames_after_lost_ones_cost_no_more_than_others():
    """Each was compared with the 64 after it: a megabyte of them took 2.4 s."""
    costs = []
    for step_ns in (1_000_000, 2_000_000):
        numbering, begin = SyncNumbering(1e-3), time.process_time()
        for k in range(20_000):
            numbering.push(LoggedFrame(k * step_ns, 0x080, b"", ""))
        costs.append(time.process_time() - begin)
    assert costs[1] < 3.0 * costs[0]


def test_stamps_that_jump_back_again_and_again_are_two_lines(tmp_path, caplog):
    """Each jump was a line: 80 000 of them for a megabyte."""
    back = [LoggedFrame(10**18 - k * 2 * 10**9, 0x80, b"", "") for k in range(1000)]
    assert len(list(in_order(back, tmp_path))) == 1000
    assert len([text for text in caplog.messages if "jump back" in text]) == 2


def test_frames_are_the_same_whether_drivelink_or_another_tool_wrote_them(tmp_path):
    for data, wrong in (("", 0), ("00ff", 0), ("0", 1), ("00" * 65, 1)):
        for text in ('{"id":%d,"data":"%s"}', '{ "data": "%s", "id": %d }'):
            for can_id in (0, 0x7FF, 0x800):
                words = (can_id, data) if text.index("id") < 5 else (data, can_id)
                path = mcap_of(tmp_path / "r.mcap", [("can", 1, (text % words).encode())])
                with nullcontext() if not wrong and can_id <= 0x7FF else one_line("no frame of drivelink"):
                    (frame,) = canframes._mcap_frames(path)
                    assert frame == (1, can_id, bytes.fromhex(data), "")


BLF_HEAD = struct.pack("<4sL136x", b"LOGG", 144)


def blf_frame(can_id=0x80):
    return struct.pack("<4sHHLLLHHQHBBL8x", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, 0, 1, 0, 0, can_id)


def blf_container(packed, frames_):
    one = struct.pack("<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2, 48 * frames_) + packed
    return one + bytes(len(one) % 4)


def blf_frames(count, can_id=0x80, level=9):
    return blf_container(zlib.compress(blf_frame(can_id) * count, level), count)


def blf_of_objects(path, objects):
    path.write_bytes(BLF_HEAD + b"".join(blf_container(zlib.compress(one, 9), 0) for one in objects))
    return path


def test_a_blf_object_without_a_length_and_one_without_an_end_are_ends(tmp_path, caplog):
    """The first was read for ever; the second was copied for each container."""
    empty = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 0, 99, 2, 0, 0, 0)
    assert len(list(read_frames(blf_of_objects(tmp_path / "r.blf", [blf_frame() * 3 + empty])))) == 3
    assert "broken after 3 frames (expected no object of 0 bytes)" in caplog.text
    endless = empty[:8] + struct.pack("<L", 1 << 31) + empty[12:]
    path = blf_of_objects(tmp_path / "r.blf", [blf_frame() * 3 + endless, *[bytes(1000)] * 10_000])
    before = time.process_time()
    with little_memory():
        assert len(list(read_frames(path))) == 3
    assert time.process_time() - before < 3.0


def test_a_blf_container_that_begins_at_the_limit_unpacks_to_nothing(tmp_path):
    """Its decoder takes 0 bytes as no limit."""
    path, bomb, size = tmp_path / "r.blf", zlib.compress(bytes(BOMB), 9), 400_000
    endless = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 1 << 31, 99, 2, 0, 0, 0)
    fill = zlib.compress(endless.ljust(32 * size + (1 << 20), b"\0"), 9)
    path.write_bytes(BLF_HEAD + blf_container(fill, 0) + blf_container(bomb, 0))
    os.truncate(path, size)
    with little_memory(), one_line("at most 64 MiB"):
        list(read_frames(path))


def test_a_file_with_too_many_frames_is_refused_where_it_has_them(tmp_path):
    """Not after as many as its whole size allows."""
    path, passed = tmp_path / "r.blf", 0
    path.write_bytes(BLF_HEAD + blf_frames(100) * 5000)
    with one_line("one record for each"):
        for passed, _ in enumerate(read_frames(path), 1):  # noqa: B007
            pass
    assert passed < 20_000
    path = mcap_of(tmp_path / "r.mcap", [("can", 0, b'{"id":385,"data":""}')] * 20_000)
    path.write_bytes(path.read_bytes() + bytes(1 << 20))
    with one_line("one record for each"):
        read(path, JOINT)


NO_LAYOUT = {
    "cob_id": 1 << 40,
    "motor": -1,
    "scale": 0.0,
    "bits": 65,
    "modulus": -1,
    "transmission_type": 256,
}


@pytest.mark.parametrize(("key", "value"), [*NO_LAYOUT.items(), ("scale", math.inf)])
def test_a_layout_that_no_node_has_is_one_line(key, value, tmp_path):
    """Its numbers were those that the compiled core takes, or a traceback."""
    mapped = {"signal": "other", "index": 0x6064, "subindex": 0, "bits": 32, "signed": True}
    mapped |= {"scale": 1.0, "modulus": 0}
    tpdo = {"cob_id": 0x181, "transmission_type": 1, "objects": [mapped]}
    node = {"node_id": 1, "motor": 0, "tpdos": [tpdo]}
    next(part for part in (mapped, tpdo, node) if key in part)[key] = value
    path = tmp_path / "r.log"
    path.write_text("c 080#\n")
    side_file(path).write_text(json.dumps({"joint": "elbow", "source": "daemon", "nodes": [node]}))
    with one_line("r.log: its mapping cannot be read"):
        read(path, JOINT)


def test_topics_without_end_take_no_memory(tmp_path):
    """One of 15 MiB with a character that takes four bytes in memory, and so do all others then."""
    path = mcap_of(tmp_path / "r.mcap", [("\U0001f600" + "a" * (15 << 20) + "/can", 0, b"{}")])
    assert path.stat().st_size < 40_000
    with little_memory(60):
        assert list(read_messages(path)) == []


def test_mappings_that_change_without_a_sync_end_at_the_limit_not_at_the_file_s_end(tmp_path, monkeypatch):
    """A megabyte of BLF took 11 s: they were counted at each SYNC only."""
    calls, made = [], PassiveNode.layout
    monkeypatch.setattr(PassiveNode, "layout", lambda node: calls.append(1) or made(node))
    toggled = [line for k in (0, 2) for line in (f"c 601#2F001A000{k}000000\n", "c 581#60001A0000000000\n")]
    path = tmp_path / "r.log"
    path.write_text("c 080#\n" * 8 + "".join(toggled) * 10_000)
    with one_line("changes of what its nodes send"):
        read(path, parse(TEXT + "[bus]\nconfigure = false\n"))
    assert len(calls) < 5000


def test_frames_that_wait_for_a_configuration_to_end_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr("drivelink.recording.canframes._MOST_HELD", 500)
    path = tmp_path / "r.log"
    path.write_text(("c 080#\n" + "c 555#\n" * 99) * 20)
    assert len(canframes.FrameLog(path, JOINT, tmp_path)._head) <= 501


def _mapped(entries):
    return [f"601 2F001A00{entries:02d}000000", "581 60001A0000000000"]


@pytest.mark.parametrize(
    ("what", "again", "passive"),
    [
        ("drivelink.cycle.objectcheck._objects", ["000 0101", "080 "], False),
        ("drivelink.canopen.passivenode.offer", [*_mapped(0), *_mapped(2)], False),
        ("drivelink.cycle.following.PassiveFollower._judge", ["601 4018100100000000"], True),
    ],
)
def test_what_has_not_changed_is_not_worked_out_again(what, again, passive, tmp_path, monkeypatch):
    """For each frame it made a megabyte of node starts, of mappings that change or of requests take 2 s."""
    calls, owner, name = [], *what.rpartition(".")[::2]
    work = pkgutil.resolve_name(owner)
    made = getattr(work, name)
    monkeypatch.setattr(work, name, lambda *a: calls.append(1) or made(*a))
    heard = ["080 "] * 8 + again * 500
    frames = [json.dumps({"id": int(f[:3], 16), "data": f[4:]}).encode() for f in heard]
    path = mcap_of(tmp_path / "r.mcap", [("can", k * 100_000, f) for k, f in enumerate(frames)])
    joint = parse(TEXT + "[bus]\nconfigure = false\n") if passive else JOINT
    with one_line("no complete sample"):
        read(path, joint)
    assert len(calls) < 10


def test_syncs_further_apart_than_any_cycle_are_one_line(tmp_path):
    path = tmp_path / "r.log"
    path.write_text("".join(f"({k * 1_000_000}.0) c 080#\n" for k in range(1, 100)))
    for work in (lambda: read(path, JOINT), lambda: open_playback(path, JOINT, tmp_path)):
        with one_line("SYNCs, period_s: expected 1e-06 to 100 s"):
            work()


@pytest.mark.parametrize(
    ("can_id", "read_of_it", "said"),
    [
        (0x8000_0080, 20_000, "no CAN frame with an 11-bit identifier"),
        (0x181, 100_000, "expected SYNC frames"),
    ],
)
def test_a_log_that_is_none_of_canopen_is_not_read_to_its_end(
    can_id, read_of_it, said, tmp_path, monkeypatch
):
    (tmp_path / "r.blf").write_bytes(BLF_HEAD + blf_frames(5000, can_id, 0) * 30)
    kind, passed = CAN_FORMATS[".blf"], []
    counting = kind._replace(reader=lambda *a: (passed.append(1) or frame for frame in kind.reader(*a)))
    monkeypatch.setitem(CAN_FORMATS, ".blf", counting)
    with one_line(said):
        read(tmp_path / "r.blf", JOINT)
    assert read_of_it <= len(passed) < read_of_it + 5000


@pytest.mark.parametrize(
    ("name", "head", "line"),
    [
        ("r.log", b"(1.0) can0 080#\n", b"can0 RX" + b" " * 16_000 + b"!\n"),
        ("r.asc", b"base hex timestamps absolute\n", b"0.0 CANFD 1 a a " + b"a" * 16_000 + b" \n"),
        ("r.csv", HEADER.encode(), b"0,0,0," + b" " * 60_000 + b"x\n"),
    ],
)
def test_a_long_line_is_read_in_linear_time(name, head, line, tmp_path):
    """In quadratic time each would take minutes."""
    (tmp_path / name).write_bytes(head + line * 60)
    before = time.process_time()
    with pytest.raises(RecordingError):
        read(tmp_path / name, JOINT)
    assert time.process_time() - before < 20.0  # of the processor, not by the wall clock


SAMPLE = '{{"sequence": {}, "time_s": {}, "motor1_position_rad": {}, "motor1_torque_nm": 1.0, "link_position_rad": 0.0}}'


@pytest.mark.parametrize("stamp", [(1 << 63), (1 << 64) - 1])
@pytest.mark.parametrize("topic", ["sample", "can"])
def test_stamps_beyond_64_bits_are_one_line(topic, stamp, tmp_path):
    data = SAMPLE.format(0, 0, 0.0).encode() if topic == "sample" else b'{"id": 128, "data": ""}'
    path = mcap_of(tmp_path / "r.mcap", [(topic, stamp, data)] * 4)
    for frames_ in (False, True):
        with one_line():
            list(open_playback(path, JOINT, tmp_path, frames=frames_))


@pytest.mark.parametrize("last", ["4e12", "9e18", "1e400", "-5", "1e300"])
def test_sequences_and_times_without_end_allocate_nothing(last, tmp_path):
    rows = [SAMPLE.format(k, k * 1e-3, k % 7) for k in range(800)] + [SAMPLE.format(last, last, 2)]
    path = mcap_of(tmp_path / "r.mcap", [("sample", k * 10**6, row.encode()) for k, row in enumerate(rows)])
    gathered = Gathered(JOINT, 1e-3)

    def gather():
        for played in open_playback(path, JOINT, tmp_path):
            gathered.write(played)
        gathered.remarks(live=False)

    with little_memory():
        held(gather)
        held(lambda: read(path, JOINT))


def test_of_gaps_without_end_the_densest_minute_is_judged():
    """A gap after every ten samples: a megabyte took 12 s and 247 MB, packed more than a minute."""
    numbers = [*range(0, 10**6, 1000), *range(10**6, 10**6 + 500), *range(2 * 10**6, 10**7, 1000)]
    samples = [Sample(k, (0.1 * k,), (0.0,), (1.0,), 0.1 * k) for k in numbers]
    record = corrections._record_of(samples, JOINT.model(), 1e-3, 60_000)
    assert record.sequence[-1] - record.sequence[0] < 60_000
    assert np.count_nonzero(np.diff(record.sequence) == 1) == 499
