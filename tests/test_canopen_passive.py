import random

import pytest
from canopenkit import NO_RTR, Slave, Wire, drive_objects, joint_text, tpdo, u32

from drivelink.canopen import PassiveConfigurator, Signal, configure
from drivelink.canopen.sdo_sniffer import SdoSniffer
from drivelink.errors import DriveError
from drivelink.jointfile import parse

PASSIVE = 'configure = false\nsync = "follow"'
STATED = "counts_per_rev = 16384\nrated_torque_nm = 0.8\ngear_ratio = 50.0"
MAP = """
[[motor.drive.tpdo]]
cob_id = 0x2A5
objects = ["0x6041:00:16", "0x6064:00:32", "0x6077:00:16"]
"""


def signals(layout):
    return [[mapped.signal for mapped in frame.objects] for frame in layout.tpdos]


def passive(text_drive, base=None):
    """The layout of node 5; there is no bus that anything could be sent to."""
    joint = parse(joint_text(drive=text_drive, bus=PASSIVE))
    configurator = PassiveConfigurator([joint], [base] if base else None)
    if configurator.missing:
        raise configurator.missing[5]
    return configurator.layouts[5]


def test_the_joint_files_mapping_is_taken():
    layout = passive(STATED + MAP)
    assert layout.tpdos[0].cob_id == 0x2A5
    assert signals(layout) == [[Signal.STATUSWORD, Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE]]


def test_a_mapping_without_what_is_needed_is_one_line():
    with pytest.raises(DriveError, match=r"node 5 .* sends no motor_torque: TPDO0 = 0x6041:00 \+ 0x6064:00"):
        passive(STATED + MAP.replace(', "0x6077:00:16"', ""))


def test_nothing_known_at_all_is_one_line_that_says_what_would_help():
    with pytest.raises(
        DriveError, match=r"its mapping is not known.*motor\.drive\.tpdo.*eds.*before the master"
    ):
        passive(STATED)


def test_an_unknown_scale_is_one_line():
    with pytest.raises(DriveError, match="counts_per_rev"):
        passive("rated_torque_nm = 0.8" + MAP)


EDS = """
[DeviceInfo]
VendorNumber=0x1F
[1800sub1]
DataType=7
AccessType=rw
DefaultValue=$NODEID+0x180
[1800sub2]
DataType=5
AccessType=rw
DefaultValue=1
[1A00sub0]
DataType=5
AccessType=rw
DefaultValue=2
[1A00sub1]
DataType=7
AccessType=rw
DefaultValue=0x60640020
[1A00sub2]
DataType=7
AccessType=rw
DefaultValue=0x60770010
[608Fsub1]
DataType=7
AccessType=ro
DefaultValue=16384
[608Fsub2]
DataType=7
AccessType=ro
DefaultValue=1
[6076]
DataType=7
AccessType=ro
DefaultValue=800
"""


def test_a_data_sheet_gives_mapping_identifier_and_scale(tmp_path):
    (tmp_path / "drive.eds").write_text(EDS)
    layout = passive('eds = "drive.eds"\ngear_ratio = 50.0', base=tmp_path)
    assert layout.tpdos[0].cob_id == 0x185
    assert layout.tpdos[0].objects[1].scale == pytest.approx(0.0008 * 50)
    assert layout.identity[0] == 0x1F


def exchanged(active, joint):
    """A foreign master's configuration, as a passive listener on the same bus sees it."""
    wire = Wire([active])
    configure(wire, joint)
    frames = []
    for line in wire.log:
        _, cob_id, data = line.split(" ", 2)
        frames.append((int(cob_id, 16), bytes.fromhex(data)))
    return frames


def test_a_foreign_masters_configuration_is_learnt_by_listening():
    active = Slave(5, drive_objects(5))
    frames = exchanged(active, parse(joint_text()))
    joint = parse(joint_text(drive="", bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
    assert configurator.busy
    for cob_id, data in frames:
        configurator.feed(cob_id, data, 0.0)
    ((node, layout),) = configurator.poll(0.0)
    assert node == 5
    assert not configurator.busy
    # nothing is stated in this joint file: mapping, scale, heartbeat and identity are all in the traffic
    wire = Wire([Slave(5, drive_objects(5))])
    (known,) = configure(wire, parse(joint_text()))
    assert layout.tpdos == known.tpdos
    assert layout.heartbeat_ms == 100
    assert layout.identity == known.identity


def test_a_mapping_that_the_master_changes_in_the_run_is_followed():
    slave = Slave(5, drive_objects(5))
    joint = parse(joint_text(bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
    for cob_id, data in exchanged(slave, parse(joint_text())):
        configurator.feed(cob_id, data, 0.0)
    configurator.poll(0.0)
    wider = parse(joint_text(link="[link.encoder]\ncounts_per_rev = 1000"))
    ended = []
    for cob_id, data in exchanged(slave, wider):
        configurator.feed(cob_id, data, 0.0)
        ended += configurator.poll(0.0)
    assert configurator.layouts[5].tpdos  # never lost meanwhile
    assert all(not isinstance(result, DriveError) for _, result in ended)
    assert any(frame.cob_id == 0x285 for frame in configurator.layouts[5].other_tpdos)


def test_a_download_counts_only_when_the_node_confirms_it():
    listener = SdoSniffer(lambda index, subindex: True)
    listener.request(bytes.fromhex("2b 17 10 00 64 00 00 00"))
    assert listener.values == {}
    listener.response(bytes.fromhex("80 17 10 00 30 00 09 06"))
    listener.response(bytes.fromhex("60 17 10 00 00 00 00 00"))
    assert listener.values == {}
    listener.request(bytes.fromhex("2b 17 10 00 64 00 00 00"))
    listener.response(bytes.fromhex("60 17 10 00 00 00 00 00"))
    assert listener.values == {(0x1017, 0): 100}


def test_segmented_transfers_are_followed_both_ways():
    listener = SdoSniffer(lambda index, subindex: True)
    listener.request(bytes.fromhex("21 01 1a 01 04 00 00 00"))  # download, 4 bytes in segments
    listener.response(bytes.fromhex("60 01 1a 01 00 00 00 00"))
    listener.request(bytes.fromhex("07 20 00 64 60 00 00 00"))  # last segment, 3 bytes unused
    listener.response(bytes.fromhex("20 00 00 00 00 00 00 00"))
    assert listener.values == {(0x1A01, 1): 0x60640020}
    listener.request(bytes.fromhex("40 76 60 00 00 00 00 00"))
    listener.response(bytes.fromhex("41 76 60 00 04 00 00 00"))
    listener.request(bytes.fromhex("60 00 00 00 00 00 00 00"))
    listener.response(bytes.fromhex("07 20 03 00 00 00 00 00"))
    assert listener.values[0x6076, 0] == 800


def test_reset_communication_to_all_is_survived():
    configurator = PassiveConfigurator([parse(joint_text(drive=STATED + MAP, bus=PASSIVE))])
    before = dict(configurator.layouts)
    configurator.feed(0, b"\x82\x00", 0.0)
    configurator.feed(0x705, b"\x00", 0.0)
    assert configurator.poll(0.0) == []
    assert configurator.layouts == before


def test_what_babbles_on_the_bus_neither_raises_nor_fills_the_memory():
    generator = random.Random(3)
    configurator = PassiveConfigurator([parse(joint_text(bus=PASSIVE))])
    for _ in range(30_000):
        cob_id = generator.choice(
            (0x585, 0x605, 0x605, 0x585, 0x000, 0x705, 0x085, generator.randrange(0x800))
        )
        data = bytearray(generator.randbytes(generator.choice((8, 8, 8, generator.randrange(9)))))
        if len(data) == 8 and generator.random() < 0.9:
            data[0] = generator.choice((0x23, 0x2B, 0x2F, 0x60, 0x40, 0x43, 0x21, 0x00, 0x10, 0x20, 0x80))
            data[1:4] = bytes(
                (generator.randrange(3), generator.choice((0x18, 0x1A, 0x60)), generator.randrange(4))
            )
        configurator.feed(cob_id, bytes(data), 0.0)
        configurator.poll(0.0)
    assert len(configurator._nodes[5].listener.values) < 5000


def test_declared_types_are_kept():
    text = STATED + MAP + "transmission_type = 255\n"
    layout = passive(text)
    assert layout.tpdos[0].transmission_type == 255


def test_a_disabled_frame_of_a_data_sheet_is_not_expected():
    objects = drive_objects(5) | tpdo(1, NO_RTR | 1 << 31 | 0x185, 1, 0x60640020, 0x60770010)
    objects[0x6076, 0] = u32(800)
    active = Slave(5, objects)
    joint = parse(joint_text(drive=STATED, bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
    for address, item in active.objects.items():
        if 0x1800 <= address[0] <= 0x1BFF:
            configurator._nodes[5].listener.values[address] = item.value
    configurator._nodes[5].listener.changes += 1
    assert configurator.poll(0.0) == []
    assert configurator.busy


def after(configurator, *frames):
    for cob_id, data in frames:
        configurator.feed(cob_id, data, 0.0)
        configurator.poll(0.0)
    return configurator


BOOT = (0x705, b"\x00")


def test_a_stated_map_holds_until_the_node_restarts_and_one_of_its_own_for_ever():
    joint = parse(joint_text(drive=STATED + MAP, bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
    assert configurator.believed == {5}
    after(configurator, BOOT)
    assert configurator.believed == set()
    assert "default = true in [[motor.drive.tpdo]]" in configurator.doubts[5]
    own = parse(joint_text(drive=STATED + MAP + "default = true\n", bus=PASSIVE))
    assert after(PassiveConfigurator([own]), BOOT, (0, b"\x82\x00"), BOOT).believed == {5}


def test_what_is_overheard_counts_more_than_what_the_joint_file_states():
    joint = parse(joint_text(drive=STATED + MAP + "default = true\n", bus=PASSIVE))
    configurator = PassiveConfigurator([joint])
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
    line = (
        'tpdo = [{ cob_id = 0x185, objects = ["0x6064:00:32", "0x6077:00:16"], transmission_type = 1, '
        "default = true }]"
    ).replace("transmission_type = 1, ", "")
    assert f"in [motor.drive] {line}" in configurator.doubts[5]
    pasted = parse(text.replace("gear_ratio", f"{line}\ngear_ratio"))
    assert PassiveConfigurator([pasted], [tmp_path]).believed == {5}


def test_frames_that_are_heard_of_a_node_whose_map_is_unknown_are_named():
    configurator = PassiveConfigurator([parse(joint_text(drive=STATED, bus=PASSIVE))])
    after(configurator, (0x185, bytes(8)), (0x285, bytes(6)))
    assert "it sends 0x185 (8 bytes), 0x285 (6 bytes)" in str(configurator.missing[5])
