from types import SimpleNamespace

import can
import pytest
from canopenkit import Item, Slave, Wire, drive_objects

from drivelink.canopen.bus import run_program
from drivelink.canopen.guard import ForbiddenFrameError, SilentBus, check_frame
from drivelink.canopen.pdo import read_optional
from drivelink.canopen.sdo import Read, SdoTimeout, Session, Write, abort_text, read_number
from drivelink.errors import BusError, DriveError
from drivelink.jointfile import BusSection


def read(node, index, subindex=0):
    return (yield Read(node, index, subindex))


def write(node, index, subindex, value, size):
    return (yield Write(node, index, subindex, value, size))


def session(program, sent, **options):
    return Session(program, lambda cob_id, data: sent.append((cob_id, data.hex(" "))), **options)


def test_expedited_upload_as_on_the_wire_and_an_object_that_may_be_missing():
    wire = Wire([Slave(5, drive_objects(5))])
    assert run_program(read(5, 0x6076), wire) == (800).to_bytes(4, "little")
    assert wire.log == [
        "> 605 40 76 60 00 00 00 00 00",  # initiate upload 0x6076:00
        "< 585 43 76 60 00 20 03 00 00",  # expedited, 4 bytes: 800 mN·m
    ]
    assert run_program(read_optional(5, 0x1005, 0), wire) == 0x80
    assert run_program(read_optional(5, 0x2FFF, 0), wire) is None


@pytest.mark.parametrize("length", [5, 7, 8, 14, 15, 22])
def test_segmented_upload_is_put_together(length):
    text = bytes(range(65, 65 + length))
    wire = Wire([Slave(5, {(0x1008, 0): Item(text, length)})])
    assert run_program(read(5, 0x1008), wire) == text


def test_an_abort_names_node_object_code_and_text():
    wire = Wire([Slave(5, drive_objects(5))])
    with pytest.raises(DriveError) as error:
        run_program(read(5, 0x2FFF, 1), wire)
    assert str(error.value) == (
        "node 5 refused reading 0x2FFF:01: SDO abort 0x06020000 (Object does not exist)"
    )
    assert abort_text(0x12345678) == "0x12345678"


def test_silence_is_retried_and_then_named():
    sent = []
    running = session(read(5, 0x1000), sent, timeout_s=0.5, retries=1)
    assert not running.poll(0.0)
    assert not running.poll(0.4)
    assert len(sent) == 1
    assert not running.poll(0.6)  # aborted with 0x05040000, and asked again
    assert [data for _, data in sent[1:]] == ["80 00 10 00 00 00 04 05", "40 00 10 00 00 00 00 00"]
    assert running.poll(1.2)
    with pytest.raises(SdoTimeout, match=r"node 5 does not answer: SDO 0x1000:00.* 0.5 s.*2 times"):
        _ = running.result


def test_late_answers_and_other_nodes_are_not_taken_for_ours():
    running = session(read(5, 0x6064), [])
    running.poll(0.0)
    running.feed(0x585, bytes.fromhex("43 76 60 00 20 03 00 00"), 0.0)  # answer to an earlier question
    running.feed(0x586, bytes.fromhex("43 64 60 00 01 00 00 00"), 0.0)  # another node
    running.feed(0x585, b"\x43", 0.0)  # cut short
    running.feed(0x585, bytes.fromhex("60 64 60 00 00 00 00 00"), 0.0)  # confirms a download
    assert not running.done
    running.feed(0x585, bytes.fromhex("43 64 60 00 07 00 00 00"), 0.0)
    assert running.result == b"\x07\0\0\0"


def segment(*, toggle=0, length=7, last=False):
    return bytes([toggle << 4 | (7 - length) << 1 | last]) + b"\xff" * 7


@pytest.mark.parametrize(
    ("declared", "segments", "why", "abort"),
    [
        (4, [segment(length=5)], "more than 4 bytes", "12 00 07 06"),
        (10, [segment(), segment(toggle=1, length=2, last=True)], "9 bytes after declaring 10", "13 00 07 06"),
        (10, [segment(toggle=1)], "a segment out of turn", "00 00 03 05"),
        (9, [segment(length=0)], "a segment without data that is not the last", "10 00 07 06"),
        (None, [segment(toggle=k % 2) for k in range(37)], "more than 256 bytes", "12 00 07 06"),
        (100_000, [], "100000 bytes, expected 256 at most", "12 00 07 06"),
    ],
    ids=["longer than declared", "shorter", "wrong toggle", "empty", "undeclared and endless", "declared too long"],
)  # fmt: skip
def test_an_upload_of_another_length_than_it_should_have_is_aborted(declared, segments, why, abort):
    sent = []
    running = session(read(5, 0x1008), sent)
    running.poll(0.0)
    size = b"\x40" + bytes(7) if declared is None else b"\x41" + bytes(3) + declared.to_bytes(4, "little")
    running.feed(0x585, size[:1] + bytes.fromhex("08 10 00") + size[4:], 0.0)
    for data in segments:
        assert not running.done
        running.feed(0x585, data, 0.0)
    assert sent[-1] == (0x605, f"80 08 10 00 {abort}")
    with pytest.raises(
        DriveError, match=rf"^node 5 answers 0x1008:00 against the protocol: {why}; SDO abort"
    ):
        _ = running.result


def test_an_upload_that_goes_on_for_ever_ends_in_bounded_time():
    running = session(read(5, 0x1008), [], timeout_s=0.5, retries=1)
    now_s, k = 0.0, 0
    while not running.poll(now_s):
        if k % 2 == 0 and now_s in (0.0, 2.0):
            running.feed(0x585, bytes.fromhex("40 08 10 00 00 00 00 00"), now_s)
        running.feed(0x585, segment(toggle=k % 2, length=1), now_s)  # always just before its timeout
        now_s, k = now_s + 0.4, k + 1
        assert now_s < 10.0
    with pytest.raises(DriveError, match=r"^node 5 does not "):
        _ = running.result


def test_a_number_of_more_bytes_than_any_has_is_not_taken():
    wire = Wire([Slave(5, {(0x6076, 0): Item(b"\xff" * 400, 400)})])
    assert run_program(read_optional(5, 0x6076, 0), wire) is None
    with pytest.raises(DriveError, match="400 bytes, expected 8 at most"):
        run_program(read_number(5, 0x6076, 0), wire)


FORBIDDEN = {
    "mode": "605 2f 60 60 00 0a", "target position": "605 23 7a 60 00 0a", "vendor object": "605 23 00 20 01 0a",
    "store parameters": "605 23 10 10 01 73", "RPDO mapping": "605 23 00 16 01 10",
    "segmented download": "605 21 17 10 00 08", "RPDO": "205 0f 00", "NMT reset": "000 81 05",
    "NMT stop": "000 02 05", "TIME": "100 00", "heartbeat": "705 05",
    **{f"write to {index:04X}": f"605 2b {index & 0xFF:02x} {index >> 8:02x} 00 0f"
       for index in (0x6040, 0x6060, 0x6071, 0x607A, 0x60FF, 0x2000, 0x1010, 0x1600, 0x1400)},
}  # fmt: skip


@pytest.mark.parametrize("frame", FORBIDDEN.values(), ids=FORBIDDEN)
def test_nothing_that_could_move_a_drive_leaves(frame):
    data = bytes.fromhex(frame[4:])
    with pytest.raises(ForbiddenFrameError):
        check_frame(int(frame[:3], 16), data.ljust(8, b"\0") if frame.startswith("605") else data)


def test_what_configures_may_leave_and_no_program_writes_an_object_of_the_profile():
    for frame in (
        "080", "080 01", "000 01 05", "000 80 05", "605 40 40 60 00 00 00 00 00",  # reading moves nothing
        "605 23 00 1a 01 20 00 64 60", "605 80 00 10 00 00 00 04 05",
    ):  # fmt: skip
        check_frame(int(frame[:3], 16), bytes.fromhex(frame[3:]))
    sent = []
    with pytest.raises(ForbiddenFrameError):
        session(write(5, 0x6040, 0, 0, 2), sent).poll(0.0)
    assert sent == []


def test_a_silent_bus_sends_nothing():
    virtual = {"interface": "virtual", "channel": "silent"}
    with can.Bus(**virtual) as bus, can.Bus(**virtual) as other:
        silent = SilentBus(bus)
        with pytest.raises(BusError, match="passive"):
            silent.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert other.recv(0.02) is None
        other.send(can.Message(arbitration_id=0x181, is_extended_id=False))
        assert silent.recv(0.5).arbitration_id == 0x181


def test_a_bus_that_never_rests_keeps_no_request_from_its_timeout():
    """A device that babbles without end held up the start for ever."""
    babble = can.Message(arbitration_id=0x181, data=bytes(8), is_extended_id=False)
    bus = SimpleNamespace(send=lambda _frame: None, recv=lambda _timeout: babble)
    with pytest.raises(SdoTimeout):
        run_program(read(5, 0x6076), bus, BusSection(sdo_timeout_s=0.05))


def test_what_python_can_says_of_a_bus_that_fails_is_one_line():
    def recv(_timeout):
        raise can.CanOperationError("Failed to receive: 'zz'  Traceback (most recent call last):\n  File …\n")

    with pytest.raises(BusError, match=r"^the bus cannot be read: Failed to receive: 'zz'$"):
        run_program(read(5, 0x6076), SimpleNamespace(send=lambda _frame: None, recv=recv))
