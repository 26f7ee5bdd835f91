import weakref

import pytest
from canopenkit import eds_text, joint_text, signals

from drivelink._core import Assembler
from drivelink.canopen.layout import Signal
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.sdo import SdoSniffer, written_object
from drivelink.cycle.following import PassiveFollower
from drivelink.cycle.objectcheck import _Node
from drivelink.errors import DriveError
from drivelink.jointfile import parse

PASSIVE = 'configure = false\nsync = "follow"'
STATED = "counts_per_rev = 16384\nrated_torque_nm = 0.8\ngear_ratio = 50.0"
MAP = """
[[motor.drive.tpdo]]
cob_id = 0x2A5
objects = ["0x6041:00:16", "0x6064:00:32", "0x6077:00:16"]
"""


def passive(text_drive, base=None):
    """The layout of node 5; there is no bus that anything could be sent to."""
    joint = parse(joint_text(drive=text_drive, bus=PASSIVE))
    configurator = PassiveConfigurator([joint], [base] if base else None)
    if configurator.missing:
        raise configurator.missing[5]
    return configurator.layouts[5]


@pytest.mark.parametrize(
    ("drive", "said"),
    [
        (STATED + MAP.replace(', "0x6077:00:16"', ""), r"node 5 .* sends no motor_torque: TPDO0 = 0x6041:00 \+ 0x6064:00"),
        (STATED, r"its mapping is not known: expected its master to write.*motor\.drive\.tpdo.*eds"),
        ("rated_torque_nm = 0.8" + MAP, "counts_per_rev"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_one_line_that_says_what_would_help(drive, said):
    with pytest.raises(DriveError, match=said):
        passive(drive)


EDS = eds_text(
    "VendorNumber=0x1F", x1800sub1=(7, "$NODEID+0x180"), x1800sub2=(5, 1), x1A00sub0=(5, 2),
    x1A00sub1=(7, "0x60640020"), x1A00sub2=(7, "0x60770010"), x608Fsub1=(7, 16384), x608Fsub2=(7, 1), x6076=(7, 800),
)  # fmt: skip


TIMEOUT_S = 0.5


WRITE, DONE, REFUSED = ">2b17100064000000", "<6017100000000000", "<8017100030000906"
ASKED, TOLD, LIE = ">4076600000000000", "<4376600020030000", "<4376600088130000"
NO_SUCH, MASTER_ENDS = "<8076600000000206", ">8017100000000405"
BEGUN = f"{ASKED} <4176600004000000"  # an answer in segments
PARTS, LAST = f"{BEGUN} >6000000000000000", "<0720030000000000"
NAME = (
    ">4008100000000000 <4108100010000000 >6000000000000000 <0041424344454647 "
    ">7000000000000000 <1041424344454647 >6000000000000000 <0B41420000000000"
)
# Number 33 of a block's segments looks like the begin of a download.
BLOCK = ">c2001a0104000000 <a0001a017f000000 >21001a0102030405 >a200000000000000"
UNMAP, READ_MAP = ">2f001a0000000000 <60001a0000000000", ">40001a0100000000 <43001a0120006460"
KEPT, UNIT, MAPPED = {(0x1017, 0): 100}, {(0x6076, 0): 800}, {(0x1A00, 1): 0x60640020}
NO_MAP, OF_UNIT, OF_WRITE, OF_MAP = {(0x1A00, 0): 0}, {(0x6076, 0)}, {(0x1017, 0)}, {(0x1A00, 1)}
TRANSFERS = [
    # What is heard (">" of the master, "<" of the node, "1": a second), values, disputed, how many unasked;
    # None where it does not matter.
    (WRITE, {}, set(), 0),
    (f"{WRITE} {REFUSED}", {}, set(), 0),
    (f"{WRITE} {DONE}", KEPT, set(), 0),
    (">2f001a0000 <60001a00", NO_MAP, set(), 0),  # fewer than eight bytes, as some nodes take them
    ("< > >40", {}, set(), 0),
    (">21011a0104000000 <60011a0100000000 >0720006460000000 <2000000000000000", {(0x1A01, 1): 0x60640020}, set(), 0),
    (f"{PARTS} {LAST}", UNIT, set(), 0),
    # An answer that belongs to no request is ignored.
    (LIE, {}, set(), 1),
    (DONE, {}, set(), 1),
    (f"{ASKED} 1 {LIE}", {}, set(), 1),  # long ago
    (f"{WRITE} 1 {DONE}", {}, set(), 1),
    (f">4075600000000000 {LIE}", {}, set(), 1),  # for another object
    (f"{ASKED} <6076600000000000", {}, set(), 1),  # a download's confirmation
    (f"{ASKED} {LAST}", {}, set(), 1),  # a segment of a transfer that has none
    (f"{PARTS} <1720030000000000", {}, set(), 1),  # the wrong toggle bit
    (f"{BEGUN} {LAST}", {}, set(), 1),  # a segment before it is asked for
    (f"{BEGUN} >7000000000000000 <1720030000000000", {}, set(), 1),  # asked for out of order
    (f"{WRITE} {MASTER_ENDS} {DONE}", {}, OF_WRITE, 1),
    # Two different answers to one request dispute the object until it is read again.
    (f"{ASKED} {LIE} {TOLD}", None, OF_UNIT, None),
    (f"{ASKED} {TOLD} {LIE}", None, OF_UNIT, None),
    (f"{ASKED} {LIE} {NO_SUCH}", None, OF_UNIT, None),  # the node has no such object
    (f"{ASKED} {NO_SUCH} {LIE}", None, OF_UNIT, None),
    (f"{PARTS} <0788130000000000 {LAST}", None, OF_UNIT, None),
    (f"{ASKED} {LIE} {TOLD} {ASKED} {TOLD}", UNIT, set(), None),
    (f"{ASKED} {TOLD} {TOLD}", UNIT, set(), None),  # the same again is no dispute
    # A download that is given up may have been made.
    (f"{WRITE} {MASTER_ENDS}", None, OF_WRITE, None),
    (f"{WRITE} {ASKED}", None, OF_WRITE, None),
    (f"{WRITE} {ASKED} {WRITE} {DONE}", KEPT, set(), 0),
    (f"{WRITE} {REFUSED} {ASKED}", {}, set(), 0),
    # Long and block transfers of others are no forgeries; a block download leaves its object disputed.
    (NAME, {}, set(), 0),
    (">c0501f0100000000 <a4501f017f000000", {}, None, 0),
    (BLOCK, {}, OF_MAP, 0),
    (f"{BLOCK} >c100000000000000 <a100000000000000", {}, OF_MAP, 0),
    (f"{BLOCK} >c100000000000000 <a100000000000000 {READ_MAP}", MAPPED, set(), 0),
    # One that is refused or given up hides no other write: the node is mapped anew at once.
    (f">c2501f0100010000 <80501f0122000106 {UNMAP}", NO_MAP, None, 0),
    (f">c2501f0100010000 >80501f0100000405 {UNMAP}", NO_MAP, None, 0),
]  # fmt: skip


@pytest.mark.parametrize(("frames", "values", "disputed", "unasked"), TRANSFERS)
def test_refused_forged_and_disputed_transfers_are_told_from_those_that_count(
    frames, values, disputed, unasked
):
    listener, now_s = SdoSniffer(lambda index, subindex: True, TIMEOUT_S), 0.0
    for frame in frames.split():
        now_s += frame == "1"
        if frame != "1":
            say = listener.request if frame[0] == ">" else listener.response
            say(bytes.fromhex(frame[1:]), now_s)
    found = (listener.values, listener.disputed, listener.unasked)
    expected = (values, disputed, unasked)
    assert all(one is None or one == other for one, other in zip(expected, found, strict=True)), found


def test_the_object_of_a_write_is_named_however_short_its_frame():
    assert written_object(bytes.fromhex("2310100173")) == (0x1010, 1)
    assert written_object(b"") is None


def after(configurator, *frames):
    for cob_id, data in frames:
        configurator.feed(cob_id, data, 0.0)
        configurator.poll(0.0)
    return configurator


BOOT = (0x705, b"\x00")


def owned():
    """A listener to a node whose joint file states its own default map."""
    return PassiveConfigurator([parse(joint_text(drive=STATED + MAP + "default = true\n", bus=PASSIVE))])


def test_a_stated_map_holds_until_the_node_restarts_and_one_of_its_own_for_ever():
    joint = parse(joint_text(drive=STATED + MAP, bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
    assert configurator.believed == {5}
    after(configurator, BOOT)
    assert configurator.believed == set()
    assert "default = true in [[motor.drive.tpdo]]" in configurator.doubts[5]
    assert configurator.poll(0.0) == [] and configurator.layouts[5].tpdos
    assert after(owned(), BOOT, (0, b"\x82\x00"), BOOT).believed == {5}


def test_a_map_of_its_own_is_doubted_after_what_nobody_heard_until_a_restart_is_heard():
    configurator = owned()
    configurator.lose_sight([5], "frames were lost")
    configurator.poll(0.0)
    assert configurator.believed == set()
    assert configurator.doubts[5].endswith("writes or reads back the mapping, or the node starts anew")
    assert after(configurator, BOOT).believed == {5}


@pytest.mark.parametrize("index", ["10", "11"])
@pytest.mark.parametrize("command", ["23", "c2"])
def test_after_parameters_were_stored_or_restored_a_stated_default_is_none(index, command):
    configurator = owned()
    after(configurator, (0x605, bytes.fromhex(f"{command} {index} 10 01 73 61 76 65")))
    assert configurator.believed == {5}  # until the node starts with what was stored
    after(configurator, BOOT)
    assert configurator.believed == set()
    assert "parameters were stored or restored (0x1010, 0x1011)" in configurator.doubts[5]


@pytest.mark.parametrize("address", ["18 10 02", "20 10 01"])
def test_another_identity_or_date_of_configuration_ends_all_trust(address):
    configurator = owned()

    def read(value: str) -> None:
        request = bytes.fromhex(f"40 {address} 00000000")
        after(configurator, (0x605, request), (0x585, bytes.fromhex(f"43 {address} {value}")))

    read("01000000")
    read("01000000")
    assert configurator.believed == {5}
    read("02000000")
    assert configurator.believed == set()
    assert "another identity or date of configuration" in configurator.doubts[5]


def test_what_is_overheard_counts_more_than_what_the_joint_file_states():
    configurator = owned()
    after(configurator, (0x605, bytes.fromhex("23 02 18 01 a5 02 00 80")))  # TPDO3 has that identifier: off
    assert configurator.believed == set()  # it is being changed, or it is not: nobody knows before the answer
    after(configurator, (0x585, bytes.fromhex("60 02 18 01 00 00 00 00")))
    assert configurator.believed == set()
    for place, entry in enumerate((0x60770010, 0x60410010, 0x60640020), start=1):
        request = bytes.fromhex("23 02 1a") + bytes([place]) + entry.to_bytes(4, "little")
        after(configurator, (0x605, request), (0x585, b"\x60" + request[1:4] + bytes(4)))
    on = bytes.fromhex("23 02 18 01 a5 02 00 00")
    after(configurator, (0x605, on), (0x585, b"\x60" + on[1:4] + bytes(4)))
    assert configurator.believed == {5}
    assert signals(configurator.layouts[5])[0][0] is Signal.MOTOR_TORQUE


def test_a_data_sheets_map_is_offered_and_not_believed(tmp_path):
    (tmp_path / "drive.eds").write_text(EDS)
    text = joint_text(drive='eds = "drive.eds"\ngear_ratio = 50.0', bus=PASSIVE)
    configurator = PassiveConfigurator([parse(text)], [tmp_path])
    assert configurator.believed == set()
    line = 'tpdo = [{ cob_id = 0x185, objects = ["0x6064:00:32", "0x6077:00:16"], default = true }]'
    assert f"in [motor.drive] {line}" in configurator.doubts[5]
    pasted = parse(text.replace("gear_ratio", f"{line}\ngear_ratio"))
    assert PassiveConfigurator([pasted], [tmp_path]).believed == {5}


def test_frames_that_are_heard_of_a_node_whose_map_is_unknown_are_named():
    configurator = PassiveConfigurator([parse(joint_text(drive=STATED, bus=PASSIVE))])
    after(configurator, (0x185, bytes(8)), (0x285, bytes(6)))
    assert "it sends 0x185 (8 bytes), 0x285 (6 bytes)" in str(configurator.missing[5])


def test_frames_of_a_node_with_a_map_of_its_own_are_used_again_after_its_restart():
    configurator = owned()
    assembler = Assembler((configurator.layouts[5],), 1, active=False)
    follower = PassiveFollower(configurator, {5: assembler}, dict(configurator.layouts))
    used = []
    for cob_id, data in ((0x80, b""), (0x2A5, bytes(8)), BOOT, (0x80, b""), (0x2A5, bytes(8)), (0x80, b"")):
        used.append(assembler.feed(cob_id, data) is not None)
        follower.feed(cob_id, data, 0.0)
    assert used == [False, True, False, False, True, False]


def test_what_followed_a_node_is_freed_with_the_last_reference_to_it():
    """Compiled code held what held it: each configuration of a node cost 10 kB for ever."""
    configurator = owned()
    assembler = Assembler((configurator.layouts[5],), 1, active=False)
    checked = _Node(configurator.layouts[5], 0.1, assembler, lambda _sequence, _most: (), 1, 0)
    checked.sniffer.request(bytes.fromhex("4064600000000000"), 0.0)
    left = [weakref.ref(checked), weakref.ref(configurator._nodes[5])]
    del configurator, checked
    assert [one() for one in left] == [None, None]


def test_a_master_that_writes_a_unit_again_and_again_fills_no_log(caplog):
    configurator = PassiveConfigurator([parse(joint_text(drive=STATED + MAP, bus=PASSIVE))])
    for k in range(100):
        configurator.feed(0x605, bytes.fromhex("23766000") + (1000 + k).to_bytes(4, "little"), 0.0)
        configurator.feed(0x585, bytes.fromhex("6076600000000000"), 0.0)
        configurator.poll(0.0)
    assert "(0x6076)" in caplog.text and 0 < len(caplog.messages) <= 16
