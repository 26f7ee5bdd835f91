"""PDO mappings: frame by frame, of drives with maps of their own, and of drives that answer in their own way."""

import errno
from collections import Counter
from dataclasses import dataclass

import can
import pytest
from canopenkit import (
    DEVICE_STATE,
    INVALID,
    NO_RTR,
    RANGE,
    READ_ONLY,
    TOO_MANY,
    Slave,
    Wire,
    configure,
    configured,
    drive_objects,
    joint_text,
    signals,
    tpdo,
    u32,
)

from drivelink.canopen.configure import configure_joints
from drivelink.canopen.layout import Signal
from drivelink.errors import BusError, DriveError
from drivelink.jointfile import parse

POSITION, TORQUE, STATUS = 0x60640020, 0x60770010, 0x60410010
VELOCITY = 0x606C0020


def drive(**changes):
    return Slave(5, drive_objects(5), **changes)


def test_the_order_that_all_drives_accept_frame_by_frame():
    wire, _ = configured(drive())
    start = wire.log.index("> 000 80 05")
    assert [line for line in wire.log[start:] if line.startswith(">") and line[6:8] != "40"] == [
        "> 000 80 05",  # NMT: enter pre-operational
        "> 605 23 00 18 01 85 01 00 C0",  # 0x1800:01: invalid (bit 31), bit 30 kept
        "> 605 2F 00 18 02 01 00 00 00",  # 0x1800:02 = 1: at every SYNC
        "> 605 2F 00 1A 00 00 00 00 00",  # 0x1A00:00 = 0: mapping off
        "> 605 23 00 1A 01 20 00 64 60",  # position actual value, 32 bit
        "> 605 23 00 1A 02 10 00 77 60",  # torque actual value, 16 bit
        "> 605 23 00 1A 03 10 00 41 60",  # statusword, 16 bit
        "> 605 2F 00 1A 00 03 00 00 00",  # three objects
        "> 605 23 00 18 01 85 01 00 40",  # valid again
        "> 605 2B 17 10 00 64 00 00 00",  # heartbeat every 100 ms
        "> 000 01 05",  # NMT: start
    ]


def test_one_frame_carries_position_torque_and_statusword_and_a_second_one_what_is_asked_for_besides():
    _, layout = configured(drive(), drive="velocity = true", link="[link.encoder]\ncounts_per_rev = 65536")
    assert (layout.node_id, layout.motor, layout.heartbeat_ms) == (5, 0, 100)
    assert layout.identity == (0x1234, 0x77, 0x10002, 99)
    first, second = layout.tpdos
    assert (first.cob_id, first.length, first.transmission_type, first.number) == (0x185, 8, 1, 1)
    assert second.cob_id == 0x285
    plain = [Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD]
    assert signals(layout) == [plain, [Signal.LINK_POSITION, Signal.MOTOR_VELOCITY]]


@pytest.mark.parametrize("keep_bit_30", [False, True])
@pytest.mark.parametrize("cob", [NO_RTR | 0x185, 0x185])
def test_a_second_start_writes_nothing_and_bit_30_stays_as_the_drive_has_it(keep_bit_30, cob):
    slave = drive(keep_bit_30=keep_bit_30)
    slave.objects[0x1800, 1].value = cob
    configured(slave)
    assert slave.objects[0x1800, 1].value == cob
    before = list(slave.writes)
    wire, _ = configured(slave)
    assert slave.writes == before
    assert [frame for frame in wire.sent if frame[0] == 0] == [(0, b"\x01\x05")]


def test_a_torque_that_cannot_be_mapped_gives_way_to_the_current():
    slave = drive()
    slave.objects[0x6077, 0].mappable = False
    _, layout = configured(slave, drive="torque_constant_nm_a = 0.1")
    torque = layout.tpdos[0].objects[1]
    assert (torque.signal, torque.index) == (Signal.MOTOR_TORQUE, 0x6078)
    # 4 A rated: a count is 4 mA, times 0.1 N·m/A, times gear 50
    assert torque.scale == pytest.approx(0.004 * 0.1 * 50)
    assert any("0x6077:00 cannot be mapped" in finding.text for finding in layout.notices)


def test_a_refused_mapping_is_one_line_with_code_node_and_object_and_put_back_as_it_was():
    slave = drive()
    slave.objects[0x6064, 0].mappable = False
    with pytest.raises(DriveError, match=r"node 5.*0x6064:00.*0x06040041") as error:
        configured(slave)
    assert "\n" not in str(error.value)
    assert slave.objects[0x1800, 1].value == NO_RTR | 0x185
    assert (slave.objects[0x1A00, 0].value, slave.objects[0x1A00, 1].value) == (1, STATUS)


def fixed(slave, *maps):
    """Maps of TPDO1, 2, … that cannot be changed."""
    for number in range(1, 5):
        entries = maps[number - 1] if number <= len(maps) else ()
        slave.objects.update(tpdo(number, NO_RTR | INVALID | 0x80 + 0x100 * number + 5, 255, *entries))
        for subindex in range(9):
            slave.objects[0x19FF + number, subindex].writable = False
    return slave


PLAIN = [Signal.STATUSWORD, Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE]


@pytest.mark.parametrize(
    "maps",
    [
        ((STATUS,), (STATUS, POSITION, TORQUE)),
        ((STATUS,), (STATUS, POSITION), (STATUS, VELOCITY), (TORQUE,)),  # the second statusword is skipped over
    ],
)  # fmt: skip
def test_fixed_maps_that_carry_what_is_needed_are_taken_and_put_together(maps):
    wire, layout = configured(fixed(drive(), *maps))
    given = Counter(signal for frame in signals(layout) for signal in frame)
    assert set(given) >= set(PLAIN) and given[Signal.STATUSWORD] == 1
    assert layout.tpdos[0].cob_id == 0x285
    assert not [write for write in wire.written() if 0x1A00 <= write[1] <= 0x1BFF and write[3]]


@pytest.mark.parametrize(
    ("slave", "said"),
    [
        (
            lambda: fixed(drive(), (STATUS,), (POSITION,)),
            r"motor_torque.*TPDO1 = 0x6041:00; TPDO2 = 0x6064:00",
        ),
        # What reads back decides.
        (lambda: drive(forgets=True), r"does not keep the mapping: motor_position.*TPDO3 = empty"),
        (lambda: drive(silent=True), r"node 5 does not answer.*is it powered"),
    ],
)
def test_a_drive_without_a_mapping_that_serves_is_one_line(slave, said, monkeypatch):
    monkeypatch.setattr("drivelink.canopen.node.BOOT_S", 0.1)
    with pytest.raises(DriveError, match=said):
        configured(slave())
    blind = drive()
    del blind.objects[0x60E4, 1]
    with pytest.raises(
        DriveError, match=r"node 5 \(motor\[1\]\.drive\) gives no link_position: it has no 0x60E4:01"
    ):
        configured(blind, link="[link.encoder]\ncounts_per_rev = 4096")


def test_two_tpdos_with_one_identifier_are_distinguished():
    slave = fixed(drive(), (STATUS,), (), (STATUS, POSITION), (), ())
    slave.objects.update(tpdo(5, NO_RTR | INVALID | 0x385, 1, STATUS, TORQUE))
    for subindex in range(9):
        slave.objects[0x1A04, subindex].writable = False
    _, layout = configured(slave)
    assert sorted(frame.number for frame in layout.tpdos) == [3, 5]
    assert len({frame.cob_id for frame in layout.tpdos}) == 2


def test_a_missing_tpdo_is_skipped_and_beside_another_master_the_unused_ones_are_taken():
    slave = drive()
    for key in [key for key in slave.objects if key[0] in (0x1801, 0x1A01)]:
        del slave.objects[key]
    _, layout = configured(slave, link="[link.encoder]\ncounts_per_rev = 4096")
    assert [frame.number for frame in layout.tpdos] == [1, 3]
    _, layout = configured(drive(), bus='sync = "follow"')
    assert [frame.number for frame in layout.tpdos] == [2]
    assert [frame.number for frame in layout.other_tpdos] == [1]


def test_inhibit_time_event_timer_and_an_identifier_left_over_from_another_node_are_corrected():
    slave = drive()
    for subindex, left_over in ((1, NO_RTR | INVALID | 0x181), (3, 10), (5, 50)):
        slave.objects[0x1800, subindex].value = left_over
    _, layout = configured(slave)
    assert layout.tpdos[0].cob_id == 0x185
    assert slave.objects[0x1800, 3].value == slave.objects[0x1800, 5].value == 0


def test_a_transmission_type_and_a_heartbeat_that_are_refused_are_reported_and_kept():
    slave = drive(refuse={(0x1800, 2): READ_ONLY, (0x1017, 0): READ_ONLY})
    slave.objects[0x1017, 0].value = 500
    _, layout = configured(slave)
    assert (layout.tpdos[0].transmission_type, layout.heartbeat_ms) == (255, 500)
    said = " ".join(finding.text for finding in layout.notices)
    assert "keeps transmission type 255" in said and "keeps its heartbeat of 500 ms" in said


def test_the_sync_counter_is_written_with_the_period_off():
    slave = drive()
    slave.objects[0x1006, 0].value = 1000
    configured(slave, bus="sync_counter_overflow = 240")
    written = [write for write in slave.writes if write[0] in (0x1006, 0x1019)]
    assert written == [(0x1006, 0, 0), (0x1019, 0, 240), (0x1006, 0, 1000)]


def test_a_drive_that_makes_sync_itself_is_stopped_or_named():
    slave = drive()
    slave.objects[0x1005, 0].value = 0x40000080
    configured(slave)
    assert slave.objects[0x1005, 0].value == 0x80
    constant = drive()
    constant.objects[0x1005, 0] = u32(0x80)  # EPOS4: right, and left alone
    configured(constant)
    constant.objects[0x1005, 0] = u32(0x40000080)
    with pytest.raises(DriveError, match="makes SYNC itself"):
        configured(constant)


def several(*nodes):
    """(drives, the joints of one drive each)."""
    text = joint_text()
    texts = (text.replace("node_id = 5", f"node_id = {n}").replace("elbow", f"joint{n}") for n in nodes)
    return [Slave(node, drive_objects(node)) for node in nodes], [parse(one) for one in texts]


def test_what_the_bus_cannot_carry_and_a_node_of_two_joints_are_refused():
    slaves, joints = several(*range(1, 9))
    with pytest.raises(BusError, match=r"bus load would be 11\d %.*kbit/s of 1000 kbit/s"):
        configure_joints(Wire(slaves), joints)
    with pytest.raises(BusError, match="node 5 is claimed by two joints"):
        configure_joints(Wire([drive()]), [joints[4], joints[4]])


def test_unneeded_frames_are_switched_off_where_the_load_demands_it():
    slaves, joints = several(5, 6, 7, 8)
    for slave in slaves:
        slave.objects[0x1801, 1].value = NO_RTR | 0x280 + slave.node
    configurator = configure_joints(Wire(slaves), joints)
    assert all(not layout.other_tpdos for layout in configurator.layouts.values())
    assert all(slave.objects[0x1801, 1].value & INVALID for slave in slaves)
    # SYNC 55 + 4 frames of 135 bits at 1 kHz, four heartbeats of 65 bits at 10 Hz
    assert configurator.load().bits_per_s == pytest.approx(1000 * (55 + 4 * 135) + 4 * 10 * 65)


class SameIdentifiers(Slave):
    """Refuses other identifiers than it has."""

    def _check_pdo(self, address, item, value):
        changed = address[0] < 0x1A00 and address[1] == 1 and (value ^ item.value) & 0x7FF
        return RANGE if changed else super()._check_pdo(address, item, value)


def test_a_frame_that_shares_its_identifier_with_ours_is_switched_off_whatever_the_load():
    slave = SameIdentifiers(5, drive_objects(5) | tpdo(4, NO_RTR | 0x185, 1, STATUS))
    _, layout = configured(slave)
    assert layout.tpdos[0].cob_id == 0x185 and slave.objects[0x1803, 1].value & INVALID


class Failing(Wire):
    """A bus that every third frame cannot be sent to."""

    def __init__(self, number, text, slaves=()):
        super().__init__(slaves)
        self.error = can.CanOperationError(f"Failed to transmit: {text}", number)
        self.count = 0

    def send(self, msg, timeout=None):
        self.count += 1
        if self.count % 3 == 0:
            raise self.error
        super().send(msg, timeout)


def test_a_full_transmit_queue_costs_time_only_and_an_interface_that_is_down_is_one_line():
    wire = Failing(errno.ENOBUFS, "No buffer space available", [drive()])
    (layout,) = configure(wire, parse(joint_text(bus="sdo_retries = 3")))
    assert layout.tpdos[0].cob_id == 0x185
    with pytest.raises(BusError, match=r"cannot be sent: .*Network is down"):
        configure(Failing(errno.ENETDOWN, "Network is down", [drive()]), parse(joint_text()))
    # By a server that has gone: it is no closed stdout.
    wire.error = BrokenPipeError(errno.EPIPE, "Broken pipe")
    with pytest.raises(BusError, match=r"cannot be sent: Broken pipe"):
        configure(wire, parse(joint_text()))


POSITION_AND_TORQUE = [Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE]


@dataclass
class SlowState(Slave):
    """Refuses to be changed for the first so many writes after it was sent to pre-operational."""

    refusals: int = 3

    def _check_pdo(self, address, item, value):
        if self.refusals > 0:
            self.refusals -= 1
            return DEVICE_STATE
        return super()._check_pdo(address, item, value)


@dataclass
class SmallMaps(Slave):
    """Takes so many objects in a TPDO."""

    most: int = 2
    at_count: bool = False

    def _check_map(self, index, subindex, value):
        if (subindex == 0 and value > self.most) or (subindex > self.most and not self.at_count):
            return TOO_MANY
        return super()._check_map(index, subindex, value)


class Frozen(Slave):
    """Nothing of its PDO parameters can be written."""

    def _check_pdo(self, address, item, value):
        return READ_ONLY if 0x1800 <= address[0] <= 0x1BFF else 0


class OddAnswers(Slave):
    """Does not say how many bytes of an answer count, nor which object an abort is of."""

    def _sdo(self, data):
        answer = super()._sdo(data)
        if answer and answer[0] & 0xE3 == 0x43:
            answer = b"\x42" + answer[1:]
        if answer and answer[0] == 0x80:
            answer = b"\x80" + bytes(3) + answer[4:]
        return answer


def test_a_node_that_is_slow_to_be_pre_operational_is_waited_for_and_one_that_never_is_is_named(monkeypatch):
    monkeypatch.setattr("drivelink.canopen.mapping._STATE_S", 0.4)
    slave = SlowState(5, drive_objects(5))
    assert signals(configured(slave)[1]) == [[*POSITION_AND_TORQUE, Signal.STATUSWORD]]
    assert slave.refusals == 0
    with pytest.raises(DriveError, match=r"^node 5 refuses the mapping.*0x1800:01 answers 0x08000022 \("):
        configured(SlowState(5, drive_objects(5), refusals=10_000))


def two_places():
    """A drive whose maps have two places each."""
    objects = drive_objects(5)
    for number in range(1, 5):
        objects |= tpdo(number, NO_RTR | INVALID | 0x80 + 0x100 * number + 5, 255, slots=2)
        for position in range(3, 9):
            objects.pop((0x19FF + number, position), None)
    return objects


@pytest.mark.parametrize(
    "slave",
    [
        SmallMaps(5, drive_objects(5) | tpdo(1, NO_RTR | 0x185, 255)),
        SmallMaps(5, drive_objects(5) | tpdo(1, NO_RTR | 0x185, 255), at_count=True),
        Slave(5, two_places()),
    ],
    ids=["refuses the third", "refuses the count", "has two places"],
)
def test_maps_of_two_objects_are_filled_and_the_rest_goes_into_the_next(slave):
    _, layout = configured(slave)
    assert signals(layout) == [POSITION_AND_TORQUE, [Signal.STATUSWORD]]
    assert any("TPDO1 takes 2 objects" in finding.text for finding in layout.notices)


@pytest.mark.parametrize("transmission_type", [1, 2, 255])
def test_a_pdo_that_cannot_be_changed_at_all_is_taken_as_it_is_unless_it_is_off(transmission_type):
    objects = drive_objects(5) | tpdo(1, 0x185, transmission_type, STATUS, POSITION, TORQUE)
    _, layout = configured(Frozen(5, objects))
    (frame,) = layout.tpdos
    assert (frame.cob_id, frame.transmission_type, frame.length) == (0x185, transmission_type, 8)
    warned = any(f"keeps transmission type {transmission_type}" in finding.text for finding in layout.notices)
    assert warned == (transmission_type != 1)
    objects = drive_objects(5) | tpdo(1, INVALID | 0x185, transmission_type, STATUS, POSITION, TORQUE)
    with pytest.raises(DriveError, match=r"^node 5 .*0x1800:01: SDO abort 0x06010002"):
        configured(Frozen(5, objects))


def test_odd_answers_and_counted_empty_places_are_understood():
    objects = drive_objects(5) | tpdo(1, NO_RTR | 0x185, 255, *[0] * 8)
    del objects[0x60A9, 0], objects[0x607E, 0]
    _, layout = configured(OddAnswers(5, objects))
    assert signals(layout) == [[*POSITION_AND_TORQUE, Signal.STATUSWORD]]
    assert [mapped.bits for mapped in layout.tpdos[0].objects] == [32, 16, 16]


def test_a_node_that_falls_silent_on_one_object_is_not_called_unpowered():
    class Deaf(Slave):
        def _sdo(self, data):
            return b"" if data[1:3] == b"\xa8\x60" else super()._sdo(data)

    with pytest.raises(DriveError, match=r"SDO 0x60A8:00, .* it has answered before: bus.sdo_timeout_s = "):
        configured(Deaf(5, drive_objects(5)))
