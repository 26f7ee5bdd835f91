import errno
import os
import pty
import socket
import threading
import tty

import can
import pytest
from canopenkit import Slave, configure, drive_objects, joint_text

from drivelink.canopen.bus import interface_is_up, open_bus, receive_buffer_frames
from drivelink.canopen.layout import (
    MappedObject,
    NodeLayout,
    Signal,
    TpdoLayout,
    bus_load,
    check_capacity,
    frame_bits,
)
from drivelink.errors import BusError
from drivelink.jointfile import BusSection, parse


def opened(**keys):
    return open_bus(BusSection(**keys))


def has_af_can():
    try:
        socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def test_the_virtual_bus_keeps_the_senders_stamps():
    with opened(channel="stamps") as one, can.Bus(interface="virtual", channel="stamps") as other:
        other.send(can.Message(arbitration_id=0x181, data=b"\1", is_extended_id=False))
        assert one.recv(0.5).data == b"\1"


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({"interface": "soketcan"}, r'python-can has no "soketcan", expected "socketcan"\?'),
        ({"interface": "zzzz"}, "expected .*slcan.*virtual"),
        ({"interface": "slcan", "channel": "/dev/nowhere"}, "slcan /dev/nowhere cannot be opened"),
        (
            {"interface": "socketcand", "channel": "can0", "options": {"host": 7}},
            "expected bus.options = .*host",
        ),
        (
            {"interface": "udp_multicast", "channel": "no address"},
            "udp_multicast no address cannot be opened",
        ),
    ],
)
def test_what_cannot_be_opened_is_one_line(keys, expected):
    with pytest.raises(BusError, match=expected) as error:
        opened(**keys)
    assert "\n" not in str(error.value)


def test_socketcand_that_is_not_there_is_one_line():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(BusError, match="nobody listens there") as error:
        opened(interface="socketcand", channel="can0", options={"host": "127.0.0.1", "port": port})
    assert "\n" not in str(error.value)


def test_a_socketcan_interface_that_is_missing_names_the_remedy():
    with pytest.raises(BusError) as error:
        opened(interface="socketcan", channel="vcan77")
    text = str(error.value)
    if has_af_can():
        assert "there is no such interface" in text
        assert "ip link add vcan77 type vcan" in text
    else:
        assert "this kernel has no SocketCAN" in text
    assert "\n" not in text


class Adapter:
    """A serial CAN adapter at the other end of a pseudo terminal, speaking slcan, with one drive behind it."""

    def __init__(self, slave):
        self._slave = slave
        self._master, follower = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(follower)
        self.name = os.ttyname(follower)
        self._follower = follower
        self.commands = []
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self):
        os.close(self._follower)
        self._thread.join(2.0)
        os.close(self._master)

    def _serve(self):
        buffer = b""
        while True:
            try:
                buffer += os.read(self._master, 4096)
            except OSError:  # the other end is closed
                return
            *lines, buffer = buffer.split(b"\r")
            for line in lines:
                self._line(line.decode())

    def _line(self, line):
        if line[:1] != "t":
            self.commands.append(line)
            return
        cob_id, data = int(line[1:4], 16), bytes.fromhex(line[5:])
        for answer_id, answer in self._slave.handle(cob_id, data):
            os.write(self._master, f"t{answer_id:03X}{len(answer)}{answer.hex().upper()}\r".encode())


def test_a_drive_behind_a_serial_adapter_is_configured():
    slave = Slave(5, drive_objects(5))
    adapter = Adapter(slave)
    text = joint_text(bus="").replace("sdo_timeout_s = 0.02", "sdo_timeout_s = 1.0")
    bus = open_bus(
        BusSection(
            interface="slcan", channel=adapter.name, bitrate=500_000, options={"sleep_after_open": 0.0}
        )
    )
    try:
        (layout,) = configure(bus, parse(text))
    finally:
        bus.shutdown()
        adapter.close()
    assert layout.tpdos[0].cob_id == 0x185
    assert slave.state == 5
    assert "S6" in adapter.commands  # 500 kbit/s
    assert "O" in adapter.commands


def test_a_passive_serial_adapter_is_opened_listen_only():
    adapter = Adapter(Slave(5, {}))
    section = BusSection(
        interface="slcan",
        channel=adapter.name,
        configure=False,
        sync="follow",
        options={"sleep_after_open": 0.0},
    )
    open_bus(section).shutdown()
    adapter.close()
    assert "L" in adapter.commands


def test_errors_of_the_system_are_distinguished(monkeypatch):
    for number, expected in (
        (errno.EPERM, "permission denied"),
        (errno.ENETDOWN, "is down"),
        (errno.EIO, "Input"),
    ):

        def refuse(number=number, **_):
            raise can.CanInitializationError("cannot") from OSError(number, "Input/output error")

        monkeypatch.setattr(can, "Bus", refuse)
        with pytest.raises(BusError, match=expected if number != errno.EIO else "cannot"):
            opened()


def test_an_interface_is_up_or_not():
    assert interface_is_up("lo")
    assert not interface_is_up("vcan77")


@pytest.mark.socketcan
@pytest.mark.skipif(not interface_is_up("vcan0"), reason="no vcan0 here")
def test_on_socketcan_a_stalled_reader_loses_nothing_of_half_a_second():
    with (
        opened(interface="socketcan", channel="vcan0") as one,
        opened(interface="socketcan", channel="vcan0") as other,
    ):
        assert receive_buffer_frames(one) >= 4000
        for k in range(4000):
            other.send(
                can.Message(arbitration_id=0x181, data=k.to_bytes(2, "little"), is_extended_id=False), 1.0
            )
        got = [int.from_bytes(one.recv(1.0).data, "little") for _ in range(4000)]
        assert got == list(range(4000))


@pytest.mark.socketcan
@pytest.mark.skipif(not interface_is_up("vcan0"), reason="no vcan0 here")
def test_on_socketcan_fd_frames_are_accepted():
    with (
        opened(interface="socketcan", channel="vcan0") as one,
        opened(interface="socketcan", channel="vcan0") as other,
    ):
        other.send(can.Message(arbitration_id=0x181, data=bytes(24), is_fd=True, is_extended_id=False))
        message = one.recv(1.0)
        assert message.is_fd
        assert len(message.data) == 24


@pytest.mark.parametrize(("data_bytes", "bits"), [(0, 55), (1, 65), (8, 135)])
def test_frames_on_the_wire_with_worst_stuffing(data_bytes, bits):
    assert frame_bits(data_bytes) == bits


def layout(node, *tpdos, heartbeat_ms=0, others=()):
    return NodeLayout(node_id=node, motor=0, tpdos=tpdos, heartbeat_ms=heartbeat_ms, other_tpdos=others)


def frame(cob_id, bits=64, transmission_type=1, inhibit_s=0.0):
    mapped = MappedObject(signal=Signal.OTHER, index=0x6064, subindex=0, bits=bits, signed=True)
    return TpdoLayout(
        cob_id=cob_id, objects=(mapped,), transmission_type=transmission_type, inhibit_s=inhibit_s
    )


def test_one_drive_takes_a_fifth_of_the_bus_and_two_a_third():
    one = bus_load([layout(1, frame(0x181))], BusSection(period_s=0.001, bitrate=1_000_000))
    two = bus_load(
        [layout(n, frame(0x180 + n)) for n in (1, 2)], BusSection(period_s=0.001, bitrate=1_000_000)
    )
    assert one.fraction == pytest.approx(0.19)
    assert two.fraction == pytest.approx(0.325)


def test_every_kind_of_frame_is_counted_at_its_rate():
    load = bus_load(
        [
            layout(
                1,
                frame(0x181),
                heartbeat_ms=100,
                others=(
                    frame(0x281, transmission_type=4),
                    frame(0x381, 16, transmission_type=255, inhibit_s=0.01),
                    frame(0x481, 16, transmission_type=254),
                ),
            )
        ],
        BusSection(bitrate=500_000, sync_counter_overflow=240),
    )
    expected = 1000 * 65 + 1000 * 135 + 250 * 135 + 100 * frame_bits(2) + 1000 * frame_bits(2) + 10 * 65
    assert load.bits_per_s == pytest.approx(expected)


def test_more_than_the_bit_rate_carries_is_refused_with_a_period_that_fits():
    load = bus_load([layout(1, frame(0x181))], BusSection(period_s=0.001, bitrate=125_000))
    with pytest.raises(BusError, match=r"152%.*190 kbit/s of 125 kbit/s.*2.2 ms \(bus.period_s\)"):
        check_capacity(load, 0.001)
    check_capacity(bus_load([layout(1, frame(0x181))], BusSection(period_s=0.0022, bitrate=125_000)), 0.0022)
