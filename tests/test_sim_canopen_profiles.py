"""Each maker's habits, as a master meets them on the wire."""

from __future__ import annotations

import pytest
from simkit import StubRig, Wire, wired

from sim.canopen.drive import Cia402Drive, DriveData
from sim.canopen.profiles import PROFILES, profile
from sim.errors import SimError

NO_OBJECT, NO_SUBINDEX, READ_ONLY = 0x06020000, 0x06090011, 0x06010002


def drive(rig: StubRig, name: str) -> Cia402Drive:
    return Cia402Drive(1, rig, 0, DriveData(link_counts_per_rev=262144), profile(name))


def abort_of_read(wire: Wire, index: int, subindex: int = 0) -> int:
    (answer,) = wire.send(0x601, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))
    data = bytes.fromhex(answer.split(" ", 1)[1])
    return int.from_bytes(data[4:8], "little") if data[0] == 0x80 else 0


def map_tpdo2(wire: Wire, *, flags: int = 0x40000000) -> list[int]:
    """Standard order; the abort codes."""
    objects = (0x60640020, 0x60770010, 0x60410010)
    return [
        wire.write(1, 0x1801, 1, 0x80000000 | flags | 0x281, 4),
        wire.write(1, 0x1801, 2, 1, 1),
        wire.write(1, 0x1A01, 0, 0, 1),
        *(wire.write(1, 0x1A01, k, word, 4) for k, word in enumerate(objects, start=1)),
        wire.write(1, 0x1A01, 0, 3, 1),
        wire.write(1, 0x1801, 1, flags | 0x281, 4),
    ]


@pytest.mark.parametrize("name", [name for name, quirks in PROFILES.items() if not quirks.fixed_mapping])
def test_the_standard_order_maps_every_profile_and_sync_brings_the_frame(name: str) -> None:
    rig = StubRig()
    with wired(drive(rig, name), rig=rig) as wire:
        wire.power_on()
        wire.wait(2.0)  # for the slow one
        wire.say("000 80 00")  # for the self-starting ones
        assert map_tpdo2(wire) == [0] * 8
        wire.say("000 01 00")
        frames = wire.say("080")
        assert frames[0].startswith("281 ") or frames[1].startswith("281 ")


def test_an_epos4_like_drive_lacks_what_an_epos4_lacks() -> None:
    rig = StubRig()
    with wired(drive(rig, "epos4"), rig=rig) as wire:
        wire.power_on()
        for index in (0x6063, 0x6075, 0x6078, 0x607E, 0x608F, 0x6091, 0x1006, 0x1019):
            assert abort_of_read(wire, index) == NO_OBJECT
        assert abort_of_read(wire, 0x1800, 5) == NO_SUBINDEX
        assert wire.read(1, 0x1800, 0) == 3
        assert wire.read(1, 0x1800, 2) == 255
        assert wire.read(1, 0x1800, 3) == 10  # 1 ms
        assert wire.write(1, 0x1005, 0, 0x90, 4) == READ_ONLY
        assert wire.read(1, 0x30D1, 2) == 500  # mA
        assert wire.read(1, 0x60A9) == 0x00B44700
        assert wire.read(1, 0x606C) == 30  # whole rpm


def test_an_elmo_like_drive_counts_velocity_in_counts_per_second() -> None:
    rig = StubRig()
    with wired(drive(rig, "elmo"), rig=rig) as wire:
        wire.power_on()
        assert abort_of_read(wire, 0x60A9) == NO_OBJECT
        assert wire.read(1, 0x606C) == 2048  # half a turn a second of 4096 counts
        wire.say("000 01 00")
        assert [frame[:3] for frame in wire.say("080")] == ["181", "381"]


def test_a_nanotec_like_drive_has_the_sensorless_position_before_the_link_encoder() -> None:
    rig = StubRig()
    with wired(drive(rig, "nanotec"), rig=rig) as wire:
        wire.power_on()
        wire.say("080")
        assert wire.read(1, 0x60E4, 1) == 0
        assert wire.read(1, 0x60E4, 2) == 7
        assert wire.read(1, 0x60E5, 2) == 7000  # counts/s
        assert abort_of_read(wire, 0x6076) == NO_OBJECT


def test_a_copley_like_drive_wants_the_number_of_objects_zeroed_first() -> None:
    rig = StubRig()
    with wired(drive(rig, "copley"), rig=rig) as wire:
        wire.power_on()
        assert wire.write(1, 0x1801, 1, 0xC0000281, 4) == 0
        assert wire.write(1, 0x1A01, 1, 0x606C0020, 4) == 0x06010000
        assert wire.write(1, 0x1A01, 0, 0, 1) == 0
        assert wire.write(1, 0x1A01, 1, 0x606C0020, 4) == 0
        assert wire.read(1, 0x606C) == 20480  # 0.1 counts/s


def test_a_roboteq_like_drive_refuses_to_lose_bit_30_and_starts_itself() -> None:
    rig = StubRig()
    with wired(drive(rig, "roboteq"), rig=rig) as wire:
        assert wire.power_on() == ["701 00", "181 50 02"]
        wire.say("000 80 00")
        assert wire.write(1, 0x1801, 1, 0x80000281, 4) == 0x06090030
        assert map_tpdo2(wire) == [0] * 8


def test_a_synapticon_like_drive_maps_in_preoperational_only_and_has_four_velocity_units() -> None:
    rig = StubRig()
    with wired(drive(rig, "synapticon"), rig=rig) as wire:
        wire.power_on()
        for unit, expected in ((0x00B44700, 30), (0xFFB44700, 300), (0xFDB44700, 30000)):
            assert wire.write(1, 0x60A9, 0, unit, 4) == 0
            assert wire.read(1, 0x606C) == expected
        assert wire.write(1, 0x60A9, 0, 0xFCB44700, 4) == 0x06090030
        wire.say("000 01 00")
        assert wire.write(1, 0x1801, 1, 0xC0000281, 4) == 0
        assert wire.write(1, 0x1A01, 0, 0, 1) == 0x08000022
        wire.say("000 80 00")
        assert wire.write(1, 0x1A01, 0, 0, 1) == 0


def test_a_fixed_map_stays_and_carries_what_is_needed() -> None:
    rig = StubRig()
    with wired(drive(rig, "fixed-map"), rig=rig) as wire:
        wire.power_on()
        assert wire.write(1, 0x1801, 1, 0xC0000281, 4) == 0
        assert wire.write(1, 0x1A01, 0, 0, 1) == READ_ONLY
        assert wire.write(1, 0x1A01, 1, 0x60640020, 4) == READ_ONLY
        assert [wire.read(1, 0x1A01, k) for k in range(4)] == [3, 0x60410010, 0x60640020, 0x60770010]


def test_bit_10_toggles_with_each_sample_and_not_with_sdo_reads() -> None:
    rig = StubRig()
    with wired(drive(rig, "el72x1"), rig=rig) as wire:
        wire.power_on()
        wire.say("000 01 00")
        words = []
        for _ in range(4):
            frames = [frame for frame in wire.say("080") if frame.startswith("281")]
            words.append(int(frames[0].split()[8] + frames[0].split()[7], 16) & 0x0400)
            wire.read(1, 0x6041)
        assert words in ([0, 0x400, 0, 0x400], [0x400, 0, 0x400, 0])


@pytest.mark.parametrize(("name", "kept"), [("strict", False), ("keeps-pdos", True)])
def test_reset_communication_restores_pdos_or_keeps_them(name: str, kept: bool) -> None:
    rig = StubRig()
    with wired(drive(rig, name), rig=rig) as wire:
        wire.power_on()
        before = [wire.read(1, 0x1A01, k) for k in range(4)]
        wire.write(1, 0x1801, 1, 0xC0000281, 4)
        wire.write(1, 0x1A01, 0, 0, 1)
        wire.write(1, 0x1A01, 1, 0x606C0020, 4)
        wire.write(1, 0x1A01, 0, 1, 1)
        changed = [wire.read(1, 0x1A01, k) for k in range(4)]
        wire.say("000 82 00")
        assert [wire.read(1, 0x1A01, k) for k in range(4)] == (changed if kept else before)
        wire.say("000 81 00")
        assert [wire.read(1, 0x1A01, k) for k in range(4)] == before


def test_stored_parameters_survive_a_reset_and_restored_defaults_end_them() -> None:
    save, load = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
    rig = StubRig()
    with wired(drive(rig, "strict"), rig=rig) as wire:
        wire.power_on()
        wire.write(1, 0x1017, 0, 100, 2)
        wire.write(1, 0x6072, 0, 500, 2)
        assert wire.write(1, 0x1010, 2, save, 4) == 0  # communication only
        assert wire.read(1, 0x1010, 2) == 1
        wire.say("000 81 00")
        assert (wire.read(1, 0x1017), wire.read(1, 0x6072)) == (100, 3000)
        assert wire.write(1, 0x1011, 1, load, 4) == 0
        assert wire.read(1, 0x1017) == 100  # until the next reset
        wire.say("000 81 00")
        assert wire.read(1, 0x1017) == 0


def test_a_slow_device_boots_in_its_own_time() -> None:
    rig = StubRig()
    with wired(drive(rig, "slow-boot"), rig=rig) as wire:
        assert wire.power_on() == []
        assert wire.wait(1.4) == []
        assert wire.say("601 40 00 10 00 00 00 00 00") == []
        assert wire.wait(0.2) == ["701 00"]


def test_an_unknown_profile_is_one_line_with_the_known_ones() -> None:
    with pytest.raises(SimError, match=r"expected one of strict, epos4, .*got \"acme\""):
        profile("acme")
