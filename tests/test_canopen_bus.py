"""Opening a bus, its load, and what EMCY and statuswords say."""

import errno

import can
import pytest

from drivelink.canopen.bus import interface_is_up, open_bus
from drivelink.canopen.emcy import drive_state, emergency_text, parse_emergency
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout, bus_load, frame_bits
from drivelink.errors import BusError
from drivelink.jointfile import BusSection


def opened(**keys):
    return open_bus(BusSection(**keys))


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"interface": "soketcan"}, r'python-can has no "soketcan": did you mean socketcan\?'),
        ({"interface": "zzzz"}, "expected .*slcan.*virtual"),
        ({"interface": "slcan", "channel": "/dev/nowhere"}, "slcan /dev/nowhere cannot be opened"),
        ({"interface": "socketcand", "channel": "can0", "options": {"host": 7}}, "expected bus.options = .*host"),
        ({"interface": "udp_multicast", "channel": "no address"}, "udp_multicast no address cannot be opened"),
        ({"interface": "socketcand", "channel": "can0", "options": {"host": "127.0.0.1", "port": 1}}, "nobody listens there .drivelink sim"),
        ({"interface": "socketcan", "channel": "vcan77"}, "ip link add vcan77 type vcan|this kernel has no SocketCAN"),
    ],
)  # fmt: skip
def test_what_cannot_be_opened_is_one_line(keys, expected):
    with pytest.raises(BusError, match=expected) as error:
        opened(**keys)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("number", "expected"),
    [(errno.EPERM, "permission denied"), (errno.ENETDOWN, "is down"), (errno.EIO, "cannot")],
)
def test_errors_of_the_system_are_distinguished(number, expected, monkeypatch):
    def refuse(**_):
        raise can.CanInitializationError("cannot") from OSError(number, "Input/output error")

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(BusError, match=expected):
        opened()
    assert interface_is_up("lo") and not interface_is_up("vcan77")


def layout(node, *tpdos, heartbeat_ms=0, others=()):
    return NodeLayout(node_id=node, motor=0, tpdos=tpdos, heartbeat_ms=heartbeat_ms, other_tpdos=others)


def frame(cob_id, bits=64, transmission_type=1, inhibit_s=0.0):
    mapped = MappedObject(signal=Signal.OTHER, index=0x6064, subindex=0, bits=bits, signed=True)
    return TpdoLayout(
        cob_id=cob_id, objects=(mapped,), transmission_type=transmission_type, inhibit_s=inhibit_s
    )


def test_every_kind_of_frame_is_counted_at_its_rate():
    def load(*layouts, **bus):
        return bus_load(layouts, BusSection(**bus))

    assert load(layout(1, frame(0x181)), bitrate=1_000_000).fraction == pytest.approx(0.19)
    two = load(*(layout(n, frame(0x180 + n)) for n in (1, 2)), bitrate=1_000_000)
    assert two.fraction == pytest.approx(0.325)
    others = (
        frame(0x281, transmission_type=4), frame(0x381, 16, transmission_type=255, inhibit_s=0.01),
        frame(0x481, 16, transmission_type=254),
    )  # fmt: skip
    every = layout(1, frame(0x181), heartbeat_ms=100, others=others)
    expected = 1000 * 65 + 1000 * 135 + 250 * 135 + 100 * frame_bits(2) + 1000 * frame_bits(2) + 10 * 65
    made = load(every, bitrate=500_000, sync_counter_overflow=240)
    assert made.bits_per_s == pytest.approx(expected)


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
