"""Data sheets as they are found, and what lely-core answered with two of them. The makers' own files are never shipped."""

import os
from collections import defaultdict
from pathlib import Path

import pytest
from canopen.objectdictionary import datatypes
from canopenkit import Slave, Wire, configure, configured, eds_text, joint_text, sheet_objects

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.eds import load_eds
from drivelink.canopen.layout import Signal
from drivelink.canopen.pdo import describe
from drivelink.errors import DriveError
from drivelink.jointfile import parse

REPOSITORY = Path(__file__).parents[1]
FOLDERS = [os.environ.get("DRIVELINK_EDS"), REPOSITORY / "../shared/data/eds", REPOSITORY / "data/eds"]
REAL = next((sorted(Path(f).iterdir()) for f in FOLDERS if f and Path(f).is_dir()), [])
OURS = sorted((REPOSITORY / "sim/eds").glob("*.eds"))
needs_real = pytest.mark.skipif(not REAL, reason="the makers' EDS files are not here (DRIVELINK_EDS)")

MINIMAL = eds_text(
    "VendorName=Somebody\nVendorNumber=0x1F\nProductNumber=7",
    x1018sub1=(7, ""), x1800sub1=("0x0007", "$NODEID+0x40000180"), x1800sub2=(5, "0x01"), x1A00sub0=(5, 1),
    x1A00sub1=(7, "0x60640020"), x6064=(4, -5),
)  # fmt: skip


def sheet(tmp_path, text, node=None, name="x.eds"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_eds(path, node)


def test_an_eds_file_gives_objects_identity_and_tpdos(tmp_path):
    found = sheet(tmp_path, MINIMAL, 5)
    assert (found.vendor_name, found.vendor_id, found.product_code) == ("Somebody", 0x1F, 7)
    (frame,) = found.tpdos()
    assert (frame.number, frame.cob, frame.transmission_type) == (1, 0x40000185, 1)
    assert frame.entries == ((0x6064, 0, 32),)
    assert not frame.fixed
    assert found.value(0x6064) == 0xFFFFFFFB  # as an unsigned number of its length
    assert found.problems == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (("Somebody", "Gr\xfc\xdfe"), "cp1252"),
        (("ProductNumber=7", "ProductNumber="), "no value for productnumber"),
        (("ProductNumber=7", "ProductNumber=7\nProductNumber=8"), "ProductNumber in [DeviceInfo] twice"),
        (("[6064]", "[1018sub1]\n[6064]"), "[1018sub1] twice"),
        (("DefaultValue=-5", "DefaultValue=minus five"), "6064:00 has a value that is not a number"),
        (("DataType=4", "DataType=0x99"), "6064:00 has an unknown data type"),
        (("[DeviceInfo]", "[Device]"), "no [DeviceInfo]"),
        (("[6064]", "this is nothing\n[6064]"), "neither key nor section"),
    ],
)
def test_what_is_wrong_is_one_line_and_the_rest_is_read(tmp_path, change, problem):
    text = MINIMAL.replace(*change)
    found = sheet(tmp_path, text.encode("cp1252"), 5)
    assert any(problem.lower() in line.lower() for line in found.problems), found.problems
    assert all("\n" not in line for line in found.problems)
    assert found.tpdos()[0].entries == ((0x6064, 0, 32),)


def test_line_ends_case_comments_and_a_byte_order_mark_do_not_matter(tmp_path):
    text = MINIMAL.replace("[1A00sub1]", "[1a00SUB1]").replace("0x60640020", "0x60640020 ; position")
    text = text.replace("DefaultValue", "defaultvalue").replace("\n", "\r\n")
    found = sheet(tmp_path, b"\xef\xbb\xbf" + text.encode(), 5)
    assert found.tpdos()[0].entries == ((0x6064, 0, 32),)
    assert found.problems == []
    roboteq = eds_text(x1800sub1=(7, "$MY_NODE_ID+0x180"), x1801sub1=(7, "0x280+$MY_NODE_ID"))
    found = sheet(tmp_path, roboteq, 5)
    assert (found.value(0x1800, 1), found.value(0x1801, 1)) == (0x185, 0x285)


@pytest.mark.parametrize("made_for", ["stated", "seen"])
def test_a_dcf_made_for_another_node_is_changed_for_ours(tmp_path, made_for):
    text = MINIMAL.replace("DefaultValue=$NODEID+0x40000180", "ParameterValue=0x181")
    if made_for == "stated":
        text += "[DeviceComissioning]\nNodeID=1\n"
    found = sheet(tmp_path, text, 5, "x.dcf")
    assert found.tpdos()[0].cob_id == 0x185
    assert "of node 1: changed for node 5" in found.problems[0]
    assert sheet(tmp_path, text).tpdos()[0].cob_id == 0x181


def test_an_array_written_once_is_all_its_entries(tmp_path):
    text = MINIMAL.replace("[1A00sub0]", "[1A09]").replace("[1A00sub1]", "[1A09x]")
    text += "[1A00]\nParameterName=Map\nObjectType=9\nDataType=7\nAccessType=rw\nCompactSubObj=2\n"
    text = text.replace("ObjectType=9\nDataType=7", "ObjectType=9") + "DefaultValue=0\n[1A00Value]\n"
    text += "NrOfEntries=2\n1=0x60640020\n2=0x60410010\n"
    found = sheet(tmp_path, text, 5)
    assert found.tpdos()[0].entries == ((0x6064, 0, 32), (0x6041, 0, 16))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not an EDS"),
        (b"name = 'elbow'\n", "is not an EDS"),
        (b'<?xml version="1.0"?><ISO15745ProfileContainer/>', "is XML"),
        (bytes(range(256)) * 20, "is not an EDS"),
    ],
)
def test_what_is_no_eds_is_one_line(tmp_path, content, message):
    with pytest.raises(DriveError, match=message) as error:
        sheet(tmp_path, content)
    assert "\n" not in str(error.value)
    with pytest.raises(DriveError, match=r"nowhere\.eds: cannot be read"):
        load_eds(tmp_path / "nowhere.eds")


@pytest.mark.parametrize("path", [*REAL, *OURS], ids=lambda path: path.name)
def test_every_makers_file_loads_and_ours_without_a_word(path):
    found = load_eds(path, 5)
    assert all(len(line) < 200 and "\n" not in line for line in found.problems)
    for frame in found.tpdos():
        assert frame.cob_id & 0x7F in (0, 5)
        assert sum(bits for _, _, bits in frame.entries) <= 64
    if path in OURS:
        assert found.problems == [] and found.tpdos()
        return
    assert len(found.objects) > 100 and found.vendor_id
    assert found.objects[0x6064, 0].data_type == datatypes.INTEGER32


STATED = "counts_per_rev = 4096\nrated_torque_nm = 1.0\nvelocity_rad_s_per_count = 0.001"


@needs_real
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.name)
def test_a_strict_slave_with_a_makers_dictionary_is_configured(path):
    """Its writes, its access rights, its mappable objects, its fixed maps: as the file has them."""
    slave = Slave(5, sheet_objects(load_eds(path, 5), 5), keep_bit_30=True)
    wire = Wire([slave])
    joint = parse(joint_text(drive=STATED))
    if "faulhaber" in path.name:  # a drive whose fixed maps have no position: it says so
        with pytest.raises(DriveError, match=r"motor_torque|motor_position"):
            configure(wire, joint)
        return
    (layout,) = configure(wire, joint)
    given = {mapped.signal for frame in layout.tpdos for mapped in frame.objects}
    assert {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD} <= given
    assert all(frame.transmission_type == 1 for frame in layout.tpdos)
    assert slave.state == 5
    for frame in layout.tpdos:  # what we will decode is what the slave really has
        mapping = 0x19FF + frame.number
        has = [slave.objects[mapping, n].value for n in range(1, slave.objects[mapping, 0].value + 1)]
        assert has == [o.index << 16 | o.subindex << 8 | o.bits for o in frame.objects]


def test_a_map_that_the_eds_file_lacks_is_unknown_and_not_empty(tmp_path):
    maps: dict[str, tuple[int, str | int]] = {}
    for number, count in enumerate(("", 0, 2)):
        maps |= {f"x{0x1800 + number:X}sub1": (7, 0x180 + number), f"x{0x1A00 + number:X}sub0": (5, count)}
        maps[f"x{0x1A00 + number:X}sub1"] = (7, "")
    tpdos = sheet(tmp_path, eds_text(**maps)).tpdos()
    assert describe(tpdos) == "TPDO1 = unknown; TPDO2 = empty; TPDO3 = unknown"


def test_compact_arrays_and_numbers_without_end_are_bounded(tmp_path):
    arrays = "".join(f"[{k:x}]\nCompactSubObj=254\n" for k in range(0x1000, 0x1100))
    with pytest.raises(DriveError, match="expected at most 20000 objects, got more"):
        sheet(tmp_path, MINIMAL + arrays)
    for number in ("0x" + "f" * 100_000, "9" * 100_000):
        found = sheet(tmp_path, MINIMAL.replace("-5", number))
        assert found.value(0x6064) is None
        assert "6064:00 has a value that is not a number" in found.problems[0]


TRANSCRIPTS = Path(__file__).parent / "transcripts/lely"
COUNTS, TORQUE_COUNTS = 123_456, -321  # that it measured at its SYNC
TO_LELY = "counts_per_rev = 4096\nrated_torque_nm = 1.0\nrated_current_a = 1.0\ntorque_constant_nm_a = 0.1"


class RecordedSlave:
    """A node that answers each request as it once did, and is asked everything that it was asked then."""

    def __init__(self, maker: str) -> None:
        self.left: dict[str, list[list[str]]] = defaultdict(list)
        for line in (TRANSCRIPTS / f"{maker}.txt").read_text(encoding="utf-8").splitlines()[1:]:
            if line.startswith(">"):
                self.left[line].append(answers := [])
            else:
                answers.append(line)

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        answers = self.left[f"> {cob_id:03X} {data.hex(' ').upper()}".rstrip()].pop(0)
        return [(int(line[2:5], 16), bytes.fromhex(line[6:])) for line in answers]


@pytest.mark.parametrize("maker", ["epos4", "nanotec"])
def test_what_lely_core_answered_is_configured_and_decoded(maker):
    slave = RecordedSlave(maker)
    _, layout = configured(slave, joint_text(drive=TO_LELY))
    assembler = Assembler((layout,), 1)
    assembler.feed(SYNC_COB_ID, b"")
    (sample,) = [assembler.feed(*answer) for answer in slave.handle(SYNC_COB_ID, b"")]
    assert not any(slave.left.values())
    scales = {str(o.signal): o.scale for tpdo in layout.tpdos for o in tpdo.objects}
    counts = (
        sample.motor_position_rad[0] / scales["motor_position"],
        sample.motor_torque_nm[0] / scales["motor_torque"],
    )
    assert counts == pytest.approx((COUNTS, TORQUE_COUNTS))
    assert {f"{o.index:04X}" for tpdo in layout.tpdos for o in tpdo.objects} == {"6064", "6077", "6041"}
