"""Drives that answer correctly and in their own way: slow states, small maps, fixed parameters, odd answers."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from canopenkit import (
    DEVICE_STATE,
    INVALID,
    NO_RTR,
    READ_ONLY,
    TOO_MANY,
    Slave,
    configured,
    drive_objects,
    signals,
    tpdo,
)

from drivelink.canopen.layout import Signal
from drivelink.errors import DriveError

POSITION, TORQUE, STATUS = 0x60640020, 0x60770010, 0x60410010
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


def test_a_node_that_is_slow_to_be_pre_operational_is_waited_for_and_one_that_never_is_is_named():
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
