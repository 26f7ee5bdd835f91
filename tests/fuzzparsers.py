"""Every parser of what others write: good inputs, damage to them, and what may come of it: a result or one line."""

import importlib.util
import json
import random
import struct
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from daemonkit import rig, vsa, vsa_text
from zenohkit import make_estimate, make_external, make_sample

from drivelink._core import encode_estimate, encode_external, encode_sample
from drivelink.canopen.eds import load_eds
from drivelink.canopen.emcy import parse_emergency
from drivelink.canopen.sdo import SdoSniffer
from drivelink.errors import DrivelinkError
from drivelink.jointfile import load, load_text, parse
from drivelink.jointfile.document import changes_to, write_model
from drivelink.monitor.statuslines import external_doubt, status_lines, status_text
from drivelink.pubsub import wire
from drivelink.pubsub.feed import decode_document
from drivelink.pubsub.publisher import describe_model
from drivelink.recording import read
from drivelink.recording.canlog import CAN_FORMATS
from drivelink.recording.columns import parse_column_map
from drivelink.recording.formats import open_sink
from drivelink.recording.mapping import joint_of, layouts_from
from drivelink.recording.playback import open_playback
from estimator.sample import Sample

ROOT = Path(__file__).parents[1]
CORPUS = Path(__file__).parent / "corpus"  # what once failed, a folder for each parser; fuzz.py adds to it
MOST_BYTES = 1 << 20
TEXT = """\
name = "elbow"
[[motor]]
inertia_kg_m2 = 0.1
[motor.transmission]
model = "linear"
[motor.drive]
node_id = 1
counts_per_rev = 65536
rated_torque_nm = 1.0
[[motor.drive.tpdo]]
cob_id = 0x181
objects = ["0x6064:00:32", "0x60E4:01:32"]
[[motor.drive.tpdo]]
cob_id = 0x281
objects = ["0x6077:00:16"]
[link.encoder]
counts_per_rev = 65536
"""
JOINT = parse(TEXT)
RECORDINGS = (".mcap", ".csv", *(ending for ending, kind in CAN_FORMATS.items() if kind.writer))
_FILLING = (
    b"\xff" * 8, b"\0" * 8, b"9" * 8, b"-inf,nan", b"1e999", b"[[", b'{"', b'"', b"\n", b"=", b"0x", b"-1",
)  # fmt: skip
_REPEATED = (
    b"-", b"[", b"{", b"a.", b'"', b"9", b" ", b"\n", b"a=1\n", b"\xc3\xa9", b"[a]\n", b",", b"\x1b[2J",
)  # fmt: skip


def frames(cycles: int) -> list[tuple[int, int, bytes]]:
    """(stamp in ns, identifier, data) of SYNC and one drive."""
    found = []
    for k in range(cycles):
        stamp = 1_700_000_000_000_000_000 + k * 1_000_000
        found.append((stamp, 0x080, b""))
        found.append((stamp + 200_000, 0x181, struct.pack("<ii", 10 * k, 11 * k)))
        found.append((stamp + 400_000, 0x281, struct.pack("<h", 100)))
    return found


def write_recording(path: Path) -> Path:
    """One short recording in the format of its ending."""
    sink = open_sink(path, JOINT, TEXT)
    for k, (stamp, can_id, data) in enumerate(frames(100)):
        if can_id == 0x080:
            sink.sample(Sample(k // 3, (0.1 * k,), (0.0,), (1.0,), 0.1 * k), stamp)
        sink.frame(stamp, can_id, data)
        if k % 50 == 49:
            sink.flush()
    sink.close()
    return path


def read_every_way(path: Path) -> None:
    for work in (
        lambda: read(path, JOINT),
        lambda: sum(1 for _ in open_playback(path, JOINT, path.parent)),
        lambda: sum(1 for _ in open_playback(path, JOINT, path.parent, frames=True)),
        lambda: joint_of(path, None),
    ):
        held(work)


def _document(path: Path) -> None:
    try:
        layouts_from(path.read_bytes(), "elbow")
    except ValueError as error:
        raise DrivelinkError(str(error)[:600]) from error  # its callers name the file


def _sdo(path: Path) -> None:
    sniffer, data = SdoSniffer(lambda _index, _subindex: True, 0.1), path.read_bytes()
    for k in range(0, len(data) - 9, 9):
        (sniffer.request, sniffer.response)[data[k] & 1](data[k + 1 : k + 9], k * 0.001)
    assert len(sniffer.values) + len(sniffer.disputed) <= 2 * len(data)


def _written_again(path: Path) -> None:
    """As `fit --write` and `accept` do."""
    source = load_text(path)
    write_model(source, path.with_name("again.toml"), changes_to(source.joint.model()), force=True)


def _views(path: Path) -> None:
    """A document of a daemon in each role, as the views show it."""
    document = decode_document(path.read_bytes())
    for one in (document, document | {"schema": "drivelink.finding/1"}):
        shown = "".join(line.plain for line in status_lines(one, 80, one, one))
        shown += status_text(one, one, one) + external_doubt(one, valid=False)
        assert not any(ord(c) < 32 or 0x7F <= ord(c) < 0xA0 for c in shown), repr(shown)


def _fleet_table(path: Path) -> None:
    from drivelink.fleet.storage import Store
    from drivelink.fleet.table import FOLDER, read_rows

    with TemporaryDirectory() as folder:
        store = Store(folder)
        store.write(f"{FOLDER}/part.parquet", path.read_bytes())
        read_rows(store)


def _table_seed() -> bytes:
    from drivelink.fleet.table import SCHEMA, _bytes, pa

    row = {"id": "a", "recording": "r.mcap", "digest": "d", "size_bytes": 1, "status": "ok"}
    return _bytes(pa.Table.from_pylist([{**row, "written": 0, "effects": ["backlash"]}] * 3, schema=SCHEMA))


def _of_bytes(take: Callable[[bytes], object], path: Path) -> object:
    return take(path.read_bytes())


_TAKE: dict[str, Callable[[Path], object]] = {
    "joint file": load,
    "written joint file": _written_again,
    "document": _views,
    **({"fleet table": _fleet_table} if importlib.util.find_spec("pyarrow") else {}),
    "eds": lambda path: load_eds(path, node_id=1).tpdos(),
    "column map": lambda path: parse_column_map(path.read_text(errors="replace").splitlines()),
    "mapping": _document,
    "sdo": _sdo,
    "emergency": partial(_of_bytes, parse_emergency),
    "estimate": partial(_of_bytes, wire.decode_estimate),
    "external": partial(_of_bytes, wire.decode_external),
    "sample": partial(_of_bytes, wire.decode_sample),
    **dict.fromkeys(RECORDINGS, read_every_way),
}
PARSERS = tuple(_TAKE)


@cache
def seeds(parser: str) -> tuple[bytes, ...]:
    if parser in RECORDINGS:
        with TemporaryDirectory() as folder:
            return (write_recording(Path(folder, f"r{parser}")).read_bytes(),)
    if parser == "eds":
        return tuple(path.read_bytes() for path in sorted((ROOT / "sim" / "eds").iterdir()))
    if parser.endswith("joint file"):
        files = sorted((ROOT / "drivelink" / "joints").iterdir())
        return (*(path.read_bytes() for path in files), vsa_text().encode())
    if parser == "document":
        with rig(joint := vsa()) as made:
            made.run(50)
            return json.dumps(made.status).encode(), json.dumps(describe_model(joint)).encode()
    if parser == "fleet table":
        return (_table_seed(),)
    node = {"node_id": 1, "motor": 0, "tpdos": [{"number": 1, "cob_id": 385, "objects": []}]}
    return {
        "column map": (b"q=link_position_rad:deg\nm=motor1_position_rad:-2.5",),
        "mapping": (json.dumps({"joint": "elbow", "source": "daemon", "nodes": [node]}).encode(),),
        "sdo": (bytes.fromhex("00402f60000000000001432f60000000008000" * 4),),
        "emergency": (bytes.fromhex("1023010000000000"),),
        "estimate": tuple(encode_estimate(make_estimate(k, motors=k), 1) for k in (1, 2)),
        "external": (encode_external(make_external(1), 1),),
        "sample": (encode_sample(make_sample(1), 1),),
    }[parser]


def damaged(good: bytes, rng: random.Random) -> bytes:
    """Bytes flipped, cut, doubled, replaced, or one thing repeated up to `MOST_BYTES` times."""
    data = bytearray(good)
    for _ in range(rng.randrange(1, 4)):
        at, kind = rng.randrange(len(data) + 1), rng.randrange(6)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = data[rng.randrange(len(data) + 1) :][: rng.randrange(1, 200)]
        elif kind == 3:
            filling = rng.choice(_FILLING)
            data[at : at + rng.choice((0, len(filling)))] = filling
        elif kind == 4:
            del data[at : at + rng.randrange(1, 100)]
        else:
            one = rng.choice(_REPEATED)
            data[at:at] = one * (2 ** rng.randrange(21) // len(one))
    return bytes(data[:MOST_BYTES])


def held(work: Callable[[], object]) -> None:
    """Only a line may come of it, without anything a terminal obeys."""
    try:
        work()
    except DrivelinkError as error:
        text = str(error)
        assert len(text) < 1000 and not any(ord(c) < 32 or 0x7F <= ord(c) < 0xA0 for c in text), repr(
            text[:900]
        )


def take(parser: str, data: bytes, folder: Path) -> None:
    """Give an input to a parser.

    Raises:
        Exception: whatever a parser must not raise.
    """
    suffix = {"joint file": ".toml", "written joint file": ".toml", "eds": ".eds"}.get(
        parser, parser if parser in RECORDINGS else ".bin"
    )
    path = folder / f"r{suffix}"
    path.write_bytes(data)
    held(lambda: _TAKE[parser](path))
