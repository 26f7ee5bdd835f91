import pytest

from drivelink.canopen.emcy import drive_state, emergency_text, parse_emergency


@pytest.mark.parametrize(
    ("of", "code", "text"),
    [
        *((emergency_text, *row) for row in (
            (0x0000, "error reset or no error"), (0x2310, "continuous overcurrent"),
            (0x2315, "continuous overcurrent"),  # the group it belongs to
            (0x3210, "DC link overvoltage"), (0x4310, "excess temperature of the drive"),
            (0x7305, "incremental sensor 1"), (0x8130, "life guard or heartbeat error"),
            (0x8240, "unexpected SYNC data length"), (0x8611, "following error"),
            (0x5999, "device hardware"), (0xFF12, "device specific"), (0xA000, "unknown"),
        )),
        *((drive_state, *row) for row in (
            (0x0000, "not ready to switch on"), (0x0250, "switch on disabled"), (0x0231, "ready to switch on"),
            (0x0233, "switched on"), (0x0637, "operation enabled"),
            (0x0237, "operation enabled"),  # bit 10 toggles on some drives: no other state
            (0x0217, "quick stop active"), (0x021F, "fault reaction active"), (0x0218, "fault"),
        )),
    ],
)  # fmt: skip
def test_error_codes_and_statuswords_have_words(of, code, text):
    assert of(code) == text


def test_an_emcy_is_decoded_with_its_register_and_the_makers_bytes():
    message = parse_emergency(bytes.fromhex("10 23 03 01 02 00 00 00"))
    assert message is not None
    assert (message.code, message.register, message.vendor) == (0x2310, 0x03, b"\x01\x02\0\0\0")
    assert not message.is_reset
    assert str(message) == (
        "EMCY 0x2310 (continuous overcurrent), error register 0x03 (generic, current), vendor 01 02 00 00 00"
    )
    assert parse_emergency(bytes(8)).is_reset
    assert parse_emergency(b"\x10\x23").code == 0x2310  # short: it says what it can
    assert parse_emergency(b"\x10") is parse_emergency(b"") is None
