"""A few small recordings of small joints, for the tests of the fleet."""

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import diagnosiskit as kit
import joints

from drivelink.jointfile import parse
from drivelink.recording.formats import open_sink
from estimator.sample import Record

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


def make_fleet(folder: Path) -> Path:
    """FOLDER/joints and FOLDER/recordings of two joints; the second night of the wrist has friction."""
    for night in range(2):
        world = kit.World([{}, {"coulomb_nm": 0.4} if night else {}], seed=10 + night, seconds=SECONDS)
        for name, record in zip(NAMES, world.run(), strict=True):
            joints.write_csv(record, folder / "recordings" / f"{name}-2026-01-{night + 5:02d}.csv", 9)
    for name in NAMES:
        path = folder / "joints" / f"{name}.toml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(JOINT.format(name=name), encoding="utf-8")
    return folder


def write_mcap(record: Record, name: str, path: Path, begin_s: int) -> Path:
    """The record as `drivelink record` writes it: with its joint file in it."""
    text = JOINT.format(name=name)
    sink = open_sink(path, parse(text), text)
    for sample in record.samples():
        sink.sample(sample, begin_s * 10**9 + sample.sequence * 10**6)
    sink.close()
    return path


def row(digest: str = "a", joint: str | None = "elbow", **more: Any) -> dict[str, Any]:
    return {
        "id": f"{digest}-{joint}", "joint": joint, "digest": digest, "recording": f"{digest}.csv", "size_bytes": 1,
        "stamp": "s", "status": "done", "version": "1", "accepted_model": "m", "transmission": 1,
        "time": datetime(2026, 1, 1, tzinfo=UTC),
    } | more  # fmt: skip


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
    """The ids of the rows in a table, as DuckDB or pandas would see them."""
    from pyarrow import parquet

    parts = sorted(folder.glob("table/*.parquet"))
    return sorted(name for part in parts for name in parquet.read_table(part)["id"].to_pylist())
