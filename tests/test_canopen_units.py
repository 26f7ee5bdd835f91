import math
import struct

import pytest
from canopenkit import joint_text

from drivelink.canopen.layout import Signal, object_address, roles
from drivelink.canopen.units import offer
from drivelink.canopen.vendors import GENERIC, VENDORS, velocity_unit_rad_s
from drivelink.errors import JointFileError
from drivelink.jointfile import parse
from drivelink.notice import Severity

MAXON, ELMO, COPLEY = VENDORS[0xFB], VENDORS[0x9A], VENDORS[0xAB]
PLAIN = {(0x608F, 1): 16384, (0x608F, 2): 1, (0x6091, 1): 50, (0x6091, 2): 1, (0x6076, 0): 800}


def offered(reported, vendor=GENERIC, **sections):
    return offer(roles(parse(joint_text(**sections)))[0], reported, vendor)


def scale(result, signal):
    return result.candidates[signal][0].scale


GEAR = "gear_ratio = 50.0"
CURRENT = {key: value for key, value in PLAIN.items() if key != (0x6076, 0)} | {(0x6075, 0): 4000}
# Nanotec's default 0x60A8: tenths of a degree, behind the gear the drive knows
USER = {(0x60A8, 0): 0xFF410000, (0x608F, 1): 2000, (0x608F, 2): 1, (0x6091, 1): 1, (0x6091, 2): 1}
# values of a real EPOS4's DCF: 4.76 A, 107.746 mN·m/A, 0x6076 = 512871 µN·m, gear 26, 3200 counts
EPOS4 = {
    (0x3000, 5): 3200, (0x3001, 1): 4760, (0x3001, 5): 107746, (0x3003, 1): 26, (0x3003, 2): 1, (0x6076, 0): 512871,
}  # fmt: skip
KNOWN_CURRENT = "torque_constant_nm_a = 0.1"
OWN_CURRENT = 'current_object = "0x2100:01"\ncurrent_unit_a = 0.1\ntorque_constant_nm_a = 0.2'
EPOS2 = {(0x2210, 1): 500, (0x6410, 1): 2000}  # pulses a turn; no 0x6075, 0x6076, 0x608F, 0x3000
EPOS2_DRIVE = f"torque_constant_nm_a = 0.03\nrated_current_a = 2.0\n{GEAR}\nvelocity = true"
MOTOR, TORQUE, SPEED = Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.MOTOR_VELOCITY
# What is reported, by whom, what the joint file says, and the scale (and object) of a signal's nth candidate.
SCALES = [
    (PLAIN, GENERIC, "", MOTOR, 0, math.tau / (16384 * 50), None),
    (PLAIN, GENERIC, "", TORQUE, 0, 0.0008 * 50, None),  # a thousandth of 0.8 N·m at the motor, times the gear
    (EPOS4, MAXON, "", MOTOR, 0, math.tau / (3200 * 26), None),
    (EPOS4, MAXON, "", TORQUE, 0, 0.512871 / 1000 * 26, None),
    (EPOS4, MAXON, "", TORQUE, 1, 0.001 * 0.107746 * 26, (0x30D1, 2)),
    # nothing else reported: no such motor has 512 N·m; else the joint file says which of the two it is
    ({**PLAIN, (0x6076, 0): 512871}, MAXON, GEAR, TORQUE, 0, 0.512871 / 1000 * 50, None),
    ({**PLAIN, (0x6076, 0): 513}, MAXON, GEAR, TORQUE, 0, 0.513 / 1000 * 50, None),
    ({**PLAIN, (0x6076, 0): 512}, MAXON, f"rated_torque_nm = 0.51\n{GEAR}", TORQUE, 0, 0.51 / 1000 * 50, None),
    ({**PLAIN, (0x6076, 0): 510}, MAXON, f"rated_torque_nm = 0.00051\n{GEAR}", TORQUE, 0, 0.00051 / 1000 * 50, None),
    # the constant and the current where 0x6076 is missing; Nanotec: 0x6077 is in the torque of the rated current
    (CURRENT, GENERIC, f"{KNOWN_CURRENT}\ntorque_source = 'current'", TORQUE, 0, 0.004 * 0.1 * 50, (0x6078, 0)),
    (CURRENT, GENERIC, KNOWN_CURRENT, TORQUE, 0, 4 * 0.1 / 1000 * 50, (0x6077, 0)),
    (PLAIN, GENERIC, OWN_CURRENT, TORQUE, 0, 0.1 * 0.2 * 50, (0x2100, 1)),  # what is stated comes first
    ({**PLAIN, (0x60A9, 0): 0x00B44700}, GENERIC, "velocity = true", SPEED, 0, math.tau / 60 / 50, None),
    (PLAIN, ELMO, "velocity = true", SPEED, 0, math.tau / 16384 / 50, None),
    (PLAIN, COPLEY, "velocity = true", SPEED, 0, math.tau / 163840 / 50, None),
    (USER, GENERIC, "gear_ratio = 20.0", MOTOR, 0, math.radians(0.1) / 20, None),
    (USER | {(0x6091, 1): 20}, GENERIC, "", MOTOR, 0, math.radians(0.1), None),
    ({**PLAIN, (0x6091, 1): 1}, GENERIC, "gear_ratio = 100.0", MOTOR, 0, math.tau / (16384 * 100), None),
    (EPOS2, MAXON, EPOS2_DRIVE, MOTOR, 0, math.tau / (4 * 500 * 50), None),
    (EPOS2, MAXON, EPOS2_DRIVE, TORQUE, 0, 1e-3 * 0.03 * 50, (0x6078, 0)),  # whatever the rated current is
    (EPOS2, MAXON, EPOS2_DRIVE, SPEED, 0, math.tau / 60 / 50, None),
    # an EPOS4 is not taken for its predecessor
    ({(0x3000, 5): 4096, (0x2210, 1): 500}, MAXON, f"torque_constant_nm_a = 0.03\n{GEAR}", MOTOR, 0, math.tau / (4096 * 50), None),
    ({(0x3000, 5): 4096, (0x2210, 1): 500}, MAXON, f"torque_constant_nm_a = 0.03\n{GEAR}", TORQUE, 0, None, (0x30D1, 2)),
]  # fmt: skip


@pytest.mark.parametrize(("reported", "vendor", "drive", "signal", "place", "expected", "address"), SCALES)
def test_a_scale_follows_from_what_is_reported_and_stated(
    reported, vendor, drive, signal, place, expected, address
):
    found = offered(reported, vendor, drive=drive).candidates[signal][place]
    assert expected is None or found.scale == pytest.approx(expected, rel=2e-3)
    assert address is None or found.address == address


def test_what_the_joint_file_states_is_used_and_a_disagreement_names_both_numbers():
    result = offered(PLAIN, drive="counts_per_rev = 4096\ngear_ratio = 100.0\nrated_torque_nm = 0.5", link="")
    assert scale(result, Signal.MOTOR_POSITION) == pytest.approx(math.tau / (4096 * 100))
    texts = [finding.text for finding in result.notices if finding.severity is Severity.WARNING]
    assert len(texts) == 3
    assert any("says 16384 (0x608F), the joint file 4096; 4096 is used" in text for text in texts)
    assert any("says 50 (0x6091), the joint file 100; 100 is used" in text for text in texts)
    assert any("says 0.8 (0x6076), the joint file 0.5; 0.5 is used" in text for text in texts)
    assert all(finding.fix for finding in result.notices)


@pytest.mark.parametrize(
    ("drive", "torque"), [("direction = -1", -1), ("direction = -1\ntorque_direction = 1", 1)]
)
def test_direction_turns_position_and_torque_and_can_be_split(drive, torque):
    result = offered(PLAIN, drive=drive)
    assert scale(result, MOTOR) < 0 < torque * scale(result, TORQUE)


@pytest.mark.parametrize(
    ("reported", "drive", "link", "signal", "said"),
    [
        # Elmo's DCF: resolution 1/1, rated values 0, were never configured
        ({(0x608F, 1): 1, (0x608F, 2): 1, (0x6076, 0): 0, (0x6075, 0): 0}, "", "", MOTOR, "counts_per_rev"),
        ({(0x608F, 1): 1, (0x608F, 2): 1, (0x6076, 0): 0, (0x6075, 0): 0}, "", "", TORQUE, "rated_torque_nm"),
        (PLAIN, "velocity = true", "", SPEED, "velocity_rad_s_per_count"),
        (PLAIN, "", "[link.encoder]", Signal.LINK_POSITION, "counts_per_rev"),
    ],
)  # fmt: skip
def test_a_value_of_unknown_unit_is_missing_and_it_is_said_what_to_state(reported, drive, link, signal, said):
    assert said in offered(reported, drive=drive, link=link).missing[signal]


@pytest.mark.parametrize(
    ("change", "drive", "severities"),
    [
        ({}, "", []),
        ({(0x6091, 1): 1}, "gear_ratio = 100.0", [Severity.INFO]),  # the drive's gear was never configured
        ({(0x607E, 0): 0xC0}, "", [Severity.INFO]),
        ({(0x607E, 0): 0x80}, "", [Severity.INFO, Severity.WARNING]),  # position against velocity
    ],
)
def test_only_what_may_be_wrong_is_a_warning(change, drive, severities):
    assert (
        sorted(notice.severity for notice in offered({**PLAIN, **change}, drive=drive).notices) == severities
    )


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        (0x00B44700, math.tau / 60),  # rpm
        (0xFDB44700, math.tau / 60e3),  # milli rpm
        (0xFAB44700, math.tau / 60e6),  # EPOS4's finest
        (0x00B50300, math.tau / 16384),  # increments per second
        (0xFFB50300, math.tau / 163840),  # Copley's tenths
        (0x00100300, 1.0),  # rad/s
        (0x00410300, math.pi / 180),  # degrees per second
        (0x00B40300, math.tau),  # revolutions per second
        (0x00014700, None),  # metres per minute
        (0x00000000, None),
    ],
)
def test_velocity_units(unit, expected):
    reported = velocity_unit_rad_s(unit, 16384.0)
    assert reported == (None if expected is None else pytest.approx(expected, rel=1e-12))


def test_the_second_encoder_takes_its_resolution_from_the_drive_if_it_reports_it():
    link = "[link.encoder]"
    result = offered({**PLAIN, (0x60E6, 1): 65536, (0x60EB, 1): 1}, link=link)
    assert scale(result, Signal.LINK_POSITION) == pytest.approx(math.tau / 65536)
    result = offered({**PLAIN, (0x60E6, 1): 65536}, link=link + "\ncounts_per_rev = 1000")
    assert scale(result, Signal.LINK_POSITION) == pytest.approx(math.tau / 1000)
    assert "65536" in result.notices[-1].text and "1000" in result.notices[-1].text


@pytest.mark.parametrize("text", ["60E4:01:32", "0x60E4:zz", "x", "0x0:1", ""])
def test_a_wrong_object_is_one_line(text):
    with pytest.raises(JointFileError, match=r"link\.encoder\.object"):
        object_address(text, "link.encoder.object")


@pytest.mark.parametrize(
    ("address", "signal"),
    [
        ((0x608F, 1), Signal.MOTOR_POSITION),
        ((0x6501, 0), Signal.LINK_POSITION),
        ((0x6076, 0), Signal.MOTOR_TORQUE),
    ],
)
def test_a_unit_of_an_erased_memory_is_not_known(address, signal):
    """An encoder of 4294967295 counts was one that never moves: half of the stiffness was missing, valid."""
    text = joint_text(link='[link.encoder]\nsource = "cia406"\nnode_id = 9')
    told = {(0x608F, 1): 4096, (0x608F, 2): 1, (0x6501, 0): 4096, (0x6076, 0): 1000, address: 0xFFFFFFFF}
    found = [offer(role, told, GENERIC) for role in roles(parse(text))]
    assert [one for one in found if signal in one.missing] and not [
        one for one in found if signal in one.candidates
    ]


@pytest.mark.parametrize(
    ("address", "signal", "key"),
    [
        ((0x608F, 1), Signal.MOTOR_POSITION, "motor[1].drive: counts_per_rev"),
        ((0x6091, 1), Signal.MOTOR_POSITION, "motor[1].drive: gear_ratio"),
        ((0x6501, 0), Signal.LINK_POSITION, "link.encoder: counts_per_rev"),
        ((0x6076, 0), Signal.MOTOR_TORQUE, "motor[1].drive: rated_torque_nm"),
    ],
)
@pytest.mark.parametrize("value", [0.01, 1.0, 65536.0])
def test_the_bits_of_a_float_are_no_unit(value, address, signal, key):
    """A link encoder of 1.2e9 counts, the bits of 131072.0: the stiffness was 49 % off, valid."""
    (bits,) = struct.unpack("<I", struct.pack("<f", value))
    told = {**PLAIN, (0x6501, 0): 4096, address: bits}
    link = '[link.encoder]\nsource = "cia406"\nnode_id = 9'
    found = [offer(role, told, GENERIC) for role in roles(parse(joint_text(link=link)))]
    (said,) = [one for result in found for one in result.notices if "it is not used" in one.text]
    assert said.fix.startswith(f"{key} = …, or correct 0x{address[0]:04X}")
    assert not [result for result in found if signal in result.candidates]


@pytest.mark.parametrize(
    ("reported", "counts", "modulus"),
    [
        ({(0x6501, 0): 8192}, 8192, 0),  # revolutions unknown: the full length
        ({(0x6501, 0): 8192, (0x6502, 0): 1}, 8192, 8192),  # single turn
        ({(0x6501, 0): 8192, (0x6502, 0): 4096, (0x6002, 0): 1 << 25}, 8192, 1 << 25),
        ({(0x6501, 0): 1 << 18, (0x6502, 0): 1 << 14, (0x6002, 0): 0xFFFFFFFF}, 1 << 18, 0),  # all 32 bits
        ({(0x6501, 0): 8192, (0x6000, 0): 4, (0x6001, 0): 3600, (0x6002, 0): 36000}, 3600, 36000),  # scaled
        ({(0x6501, 0): 8192, (0x6000, 0): 0, (0x6001, 0): 3600, (0x6502, 0): 1}, 8192, 8192),  # scaling off
    ],
)
def test_absolute_encoders_report_resolution_and_where_they_start_again(reported, counts, modulus):
    text = joint_text(link='[link.encoder]\nsource = "cia406"\nnode_id = 9\ndirection = -1\noffset_rad = 0.5')
    (candidate,) = offer(roles(parse(text))[1], reported, GENERIC).candidates[Signal.LINK_POSITION]
    assert candidate.scale == pytest.approx(-math.tau / counts)
    assert (candidate.modulus, candidate.offset, candidate.signed) == (modulus, 0.5, False)
