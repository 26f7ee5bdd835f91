"""A few small recordings of small joints, for the tests of the fleet."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import diagnosiskit as kit
import joints

from drivelink.jointfile import parse
from drivelink.recording.formats import open_sink
from estimator.sample import Record, Sample

JOINT = f"""\
name = "{{name}}"
arrangement = "single"
[[motor]]
inertia_kg_m2 = {kit.INERTIA}
viscous_damping_nm_s_rad = {kit.DAMPING}
[motor.transmission]
model = "linear"
[link.dynamics]
inertia_kg_m2 = {kit.LINK_INERTIA}
viscous_damping_nm_s_rad = {kit.LINK_DAMPING}
gravity_nm = {kit.GRAVITY}
"""
SECONDS = 4.0
NAMES = ("elbow", "wrist")


def make_fleet(folder: Path, nights: int = 2) -> Path:
    """FOLDER/joints and FOLDER/recordings of two joints; the second night of the wrist has friction."""
    for night in range(nights):
        world = kit.World([{}, {"coulomb_nm": 0.4} if night % 2 else {}], seed=10 + night, seconds=SECONDS)
        for name, record in zip(NAMES, world.run(), strict=True):
            joints.write_csv(record, folder / "recordings" / f"{name}-2026-01-{night + 5:02d}.csv", 9)
    for name in NAMES:
        path = folder / "joints" / f"{name}.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(JOINT.format(name=name), encoding="utf-8")
    return folder


def write_mcap(record: Record, name: str, path: Path, begin_s: int) -> Path:
    """The record as `drivelink record` writes it: with its joint file in it."""
    text, nothing = JOINT.format(name=name), math.nan
    sink = open_sink(path, parse(text), text)
    assert record.link_position_rad is not None
    columns = (record.motor_position_rad, record.motor_torque_nm, record.link_position_rad)
    for sequence, (theta, torque, link) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        sample = Sample(sequence, tuple(theta), (nothing,), tuple(torque), link, nothing, nothing)
        sink.sample(sample, begin_s * 10**9 + sequence * 10**6)
    sink.close()
    return path


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The folder by http on loopback; its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def ids(folder: Path) -> list[str]:
    """The ids of the rows in a table."""
    from pyarrow import parquet

    """As DuckDB or pandas would see them."""
    parts = sorted(folder.glob("table/*.parquet"))
    return sorted(name for part in parts for name in parquet.read_table(part)["id"].to_pylist())
