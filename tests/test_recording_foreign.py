"""Raw logs as other tools write them: what is decoded is what was put in, or a line says what is missing.

The texts and bytes below are made here from the formats' descriptions, not by a library that also reads them.
Each holds two joints, nodes of strangers, remote, extended and error frames, and begins in the middle.
"""

import logging
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from drivelink.errors import DrivelinkError
from drivelink.jointfile import parse
from drivelink.recording import read
from drivelink.recording.playback import open_playback

COUNTS = 65536
CYCLES = 400
BEGIN_S = 1_736_000_000.25


JOINT = """\
name = "{name}"
[[motor]]
inertia_kg_m2 = 0.1
[motor.transmission]
model = "linear"
[motor.drive]
node_id = {node}
counts_per_rev = 65536
rated_torque_nm = 2.0
{tpdos}
[link.encoder]
counts_per_rev = 65536
[bus]
channel = "can0"
configure = false
sync = "follow"
"""


def joint_text(name, node, mapped=True):
    mapping = {0x180: '"0x6064:00:32", "0x60E4:01:32"', 0x280: '"0x6077:00:16"'} if mapped else {}
    tpdos = (
        f"[[motor.drive.tpdo]]\ncob_id = {base + node}\nobjects = [{o}]\n" for base, o in mapping.items()
    )
    return JOINT.format(name=name, node=node, tpdos="".join(tpdos))


class Line(NamedTuple):
    """One frame on the bus."""

    time_s: float
    can_id: int
    data: bytes
    kind: str = "data"  # data, remote, extended, error


def truth(node):
    """(cycles,) counts of motor and link, torque in thousandths of 2 N·m."""
    angle = 0.02 * np.arange(CYCLES) * node
    waves = (9000 * np.sin(angle), 8000 * np.sin(angle - 0.1), 300 * np.cos(angle))
    return tuple(np.round(wave).astype(int) for wave in waves)


def bus():
    signals = {node: truth(node) for node in (1, 5)}
    # In the middle of a cycle.
    lines = [Line(-2e-4, 0x285, struct.pack("<h", 7)), Line(-1e-4, 0x701, b"\x05")]
    for k in range(CYCLES):
        t = k * 1e-3
        lines.append(Line(t, 0x080, b""))
        for node, (motor, link, torque) in signals.items():
            lines.append(Line(t + 1e-4 * node, 0x180 + node, struct.pack("<ii", motor[k], link[k])))
            lines.append(Line(t + 1e-4 * node + 5e-5, 0x280 + node, struct.pack("<h", torque[k])))
        if k % 10 == 0:
            lines.append(Line(t + 7e-4, 0x18A, b"\x01\x02\x03"))  # a stranger
            lines.append(Line(t + 7.1e-4, 0x0081, struct.pack("<HB5x", 0x1000, 1)))
            lines.append(Line(t + 7.2e-4, 0x181, b"", "remote"))
            lines.append(Line(t + 7.3e-4, 0x18FEF100, b"\xff" * 8, "extended"))
            lines.append(Line(t + 7.4e-4, 0, b"", "error"))
    return lines


def spaced(data):
    return data.hex(" ").upper()


def candump(lines, *, width=3):
    out = []
    for t, can_id, data, kind in lines:
        payload = "R" if kind == "remote" else data.hex().upper()
        name = f"{can_id:08X}" if kind == "extended" else f"{can_id:0{width}X}"
        if kind == "error":
            name, payload = "20000004", "0004000000000000"
        out.append(f"({BEGIN_S + t:.6f}) can0 {name}#{payload}\n")
    return "".join(out).encode()


def vector_asc(lines, *, base="hex", stamps="absolute", fd=False):
    out = [
        "date Sat Jan 4 02:13:20.250 pm 2025\r\n",
        f"base {base}  timestamps {stamps}\r\n",
        "internal events logged\r\n",
        "// version 13.0.0\r\n",
        "Begin Triggerblock Sat Jan 4 02:13:20.250 pm 2025\r\n",
        "   0.000000 Start of measurement\r\n",
    ]
    before = begin = lines[0].time_s
    for number, (t, can_id, data, kind) in enumerate(lines):
        stamp = t - begin if stamps == "absolute" else t - before
        before = t
        name = (f"{can_id:X}" if base == "hex" else f"{can_id}") + ("x" if kind == "extended" else "")
        payload = spaced(data) if base == "hex" else " ".join(map(str, data))
        if kind == "error":
            text = "1  ErrorFrame"
        elif kind == "remote":
            text = f"1  {name:15} Rx   r"
        elif fd:
            text = f"CANFD   1 Rx {name:>11}  1 0 {len(data):x} {len(data):>2} {payload}   102203  130 303000 0 0 0 0 0"
        else:
            text = f"1  {name:15} Rx   d {len(data)} {payload}  Length = 122000 BitCount = 63 ID = {can_id}"
        out.append(f"{stamp:11.6f} {text}\r\n")
        if number % 100 == 50:
            passed = stamp if stamps == "absolute" else 0.0
            out.append(f"{passed:11.6f} 1  Statistic: D 100 R 1 XD 1 XR 0 E 1 O 0 B 12.50%\r\n")
    return "".join([*out, "End TriggerBlock\r\n"]).encode("cp1252")


def vector_blf(lines):
    """Objects of the header's version 1 in containers that are not packed; one object reaches into the next."""
    objects = b""
    for t, can_id, data, kind in lines:
        if kind == "error":
            body, number = struct.pack("<HHL", 1, 0, 0), 2
        else:
            flags = 0x80 if kind == "remote" else 0
            marked = can_id | (0x80000000 if kind == "extended" else 0)
            body, number = struct.pack("<HBBL8s", 1, flags, len(data), marked, data), 1
        stamp = round((t - lines[0].time_s) * 1e9)
        head = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 32 + len(body), number, 2, 0, 0, stamp)
        objects += head + body
    out = bytearray()
    for at in range(0, len(objects), 5000):
        part = objects[at : at + 5000]
        out += struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(part), 10)
        out += struct.pack("<H6xL4x", 0, len(part)) + part
        out += b"\0" * (len(part) % 4)
    times = struct.pack("<8H", 2025, 1, 6, 4, 14, 13, 20, 250)
    header = struct.pack("<4sLBBBBBBBBQQLL", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, 144 + len(out), 0, 0, 0)
    return (header + times * 2).ljust(144, b"\0") + bytes(out)


TOOLS: dict[str, tuple[str, Callable[[list[Line]], bytes]]] = {
    "candump -L": (".log", candump),
    "ASC, absolute stamps": (".asc", vector_asc),
    "ASC, relative stamps": (".asc", lambda lines: vector_asc(lines, stamps="relative")),
    "ASC, decimal": (".asc", lambda lines: vector_asc(lines, base="dec")),
    "ASC, CAN FD": (".asc", lambda lines: vector_asc(lines, fd=True)),
    "BLF": (".blf", vector_blf),
}  # fmt: skip


@pytest.mark.parametrize(("tool", "node"), [*((tool, 1) for tool in TOOLS), ("BLF", 5)])
def test_what_a_tool_wrote_is_decoded_as_it_was(tool, node, tmp_path):
    suffix, write = TOOLS[tool]
    path = tmp_path / f"r{suffix}"
    path.write_bytes(write(bus()))
    record = read(path, parse(joint_text("a", node)))
    motor, link, torque = truth(node)
    assert len(record) == CYCLES and np.array_equal(np.diff(record.sequence), np.ones(CYCLES - 1))
    scale = 2.0 * math.pi / COUNTS
    # The first counts of an incremental encoder are its zero as they are: nothing is subtracted.
    assert record.motor_position_rad[:, 0] == pytest.approx(motor * scale, rel=1e-12, abs=1e-15)
    assert record.link_position_rad == pytest.approx(link * scale, rel=1e-12, abs=1e-15)
    assert record.motor_torque_nm[:, 0] == pytest.approx(torque * 2e-3, rel=1e-12, abs=1e-15)
    assert record.period_s == 1e-3


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, -2.5, 1e6])
def test_a_clock_that_is_set_makes_a_gap_and_loses_nothing(jump_s, tmp_path, caplog):
    path, half = tmp_path / "r.log", CYCLES // 2 * 1e-3 - 1e-4
    lines = [line._replace(time_s=line.time_s + (jump_s if line.time_s > half else 0)) for line in bus()]
    path.write_bytes(candump(lines))
    with caplog.at_level(logging.WARNING, "drivelink.recording"):
        played = list(open_playback(path, parse(joint_text("a", 1)), tmp_path))
    samples = [one.tick.sample for one in played if one.tick.sample]
    motor = truth(1)[0] * 2.0 * math.pi / COUNTS
    assert [one.motor_position_rad[0] for one in samples] == pytest.approx(
        motor.tolist(), rel=1e-12, abs=1e-15
    )
    steps = np.diff([one.sequence for one in samples])
    expected = jump_s * 1e3 + 1 if jump_s > 0 else 1000
    assert np.count_nonzero(steps != 1) == 1
    # 200 SYNCs with stamps in microseconds give the period to 1e-4 of it.
    assert steps.max() == pytest.approx(expected, rel=1e-4, abs=2)
    assert jump_s > 0 or "the stamps jump back by" in caplog.text


@pytest.mark.parametrize(
    ("without", "mapped", "said"),
    [
        ((), False, ("mapping", "tpdo")),
        ((0x080,), True, ("SYNC frames (0x080)", "record")),
        ((0x181, 0x281), True, ("0x181 of node 1", "got none")),
    ],
)
def test_what_is_missing_is_one_line_that_says_how_to_give_it(without, mapped, said, tmp_path):
    path = tmp_path / "r.log"
    path.write_bytes(candump([line for line in bus() if line.can_id not in without]))
    with pytest.raises(DrivelinkError) as caught:
        read(path, parse(joint_text("a", 1, mapped)))
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in said), text


@pytest.mark.parametrize(
    ("name", "command"), [("r.mf4", "asammdf"), ("r.trc", "can_logconvert r.trc r.trc.log")]
)
def test_a_file_in_another_format_is_one_line_with_the_command_that_converts_it(
    name, command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    for work in (read, lambda path, joint: open_playback(path, joint, tmp_path)):
        with pytest.raises(
            DrivelinkError, match=f"{name}: not a format of recordings; to convert it: .*{command}"
        ):
            work(Path(name), parse(joint_text("a", 1)))
