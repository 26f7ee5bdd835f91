"""The simulated devices byte for byte on the wire, and each maker's habits, as a master meets them."""

from contextlib import contextmanager

import numpy as np
import pytest
from daemonkit import rig, vsa_text
from simkit import TRANSCRIPTS, StubRig, play, wired

from drivelink.canopen.layout import Signal
from drivelink.jointfile import parse
from estimator.sample import Status
from sim.canopen.drive import Cia402Drive, StateMachine
from sim.canopen.drive import PowerState as P
from sim.canopen.encoder import Cia406Encoder
from sim.canopen.profiles import PROFILES, profile
from sim.sensors import LinkEncoder

NO_OBJECT, NO_SUBINDEX, READ_ONLY = 0x06020000, 0x06090011, 0x06010002


@contextmanager
def powered(name):
    rig = StubRig()
    with wired(Cia402Drive(1, rig, 0, profile(name), link_encoder=True), rig=rig) as wire:
        wire.booted = wire.power_on()
        yield wire


def abort_of_read(wire, index, subindex=0):
    (answer,) = wire.send(0x601, bytes([0x40, index & 0xFF, index >> 8, subindex, 0, 0, 0, 0]))
    data = bytes.fromhex(answer.split(" ", 1)[1])
    return int.from_bytes(data[4:8], "little") if data[0] == 0x80 else 0


PRE, START, SYNC, RANGE, STATE = "000 80 00", "000 01 00", "080", 0x06090030, 0x08000022
# What each does beside the standard: a frame that is said, an object that is read and its value or abort code (< 0),
# an object that is written with its size, and the abort code or 0.
HABITS: dict[str, list[str | tuple[int, ...]]] = {
    "strict": [
        # 0.05 of 0.1 N·m, 0.5 of 2 A.
        *((0x6077, 0, 500), (0x6078, 0, 250), (0x608F, 1, 4096), (0x6091, 1, 1)),
        *((0x60A9, 0, 0x00100300, 4, 0), (0x606C, 0, 3), (0x607E, 0, 0x40, 1, 0), (0x606C, 0, 0xFFFF_FFFD)),
        (0x60A9, 0, 0x00FF0300, 4, RANGE),
    ],
    "epos4": [
        *(
            (index, 0, -NO_OBJECT)
            for index in (0x6063, 0x6075, 0x6078, 0x607E, 0x608F, 0x6091, 0x1006, 0x1019)
        ),
        *((0x1800, 5, -NO_SUBINDEX), (0x1800, 0, 3), (0x1800, 2, 255), (0x1800, 3, 10)),  # 1 ms
        (0x1005, 0, 0x90, 4, READ_ONLY),
        *((0x30D1, 2, 500), (0x60A9, 0, 0x00B44700), (0x606C, 0, 30)),  # mA, whole rpm
    ],
    "elmo": [(0x60A9, 0, -NO_OBJECT), (0x606C, 0, 2048)],  # half a turn a second of 4096 counts
    # the sensorless position before the link encoder, in counts/s
    "nanotec": [SYNC, (0x60E4, 1, 0), (0x60E4, 2, 7), (0x60E5, 2, 7000), (0x6076, 0, -NO_OBJECT)],
    "copley": [
        *((0x1801, 1, 0xC0000281, 4, 0), (0x1A01, 1, 0x606C0020, 4, 0x06010000), (0x1A01, 0, 0, 1, 0)),
        *((0x1A01, 1, 0x606C0020, 4, 0), (0x606C, 0, 20480)),  # 0.1 counts/s
    ],
    "synapticon": [
        *((0x60A9, 0, 0x00B44700, 4, 0), (0x606C, 0, 30), (0x60A9, 0, 0xFFB44700, 4, 0), (0x606C, 0, 300)),
        *((0x60A9, 0, 0xFDB44700, 4, 0), (0x606C, 0, 30000), (0x60A9, 0, 0xFCB44700, 4, RANGE)),
        *(START, (0x1801, 1, 0xC0000281, 4, 0), (0x1A01, 0, 0, 1, STATE), PRE, (0x1A01, 0, 0, 1, 0)),
    ],
    "roboteq": [  # it refuses to lose bit 30
        *(PRE, (0x1801, 1, 0x80000281, 4, RANGE), (0x1801, 1, 0xC0000281, 4, 0), (0x1801, 2, 1, 1, 0)),
        *((0x1A01, 0, 0, 1, 0), (0x1A01, 1, 0x60640020, 4, 0), (0x1A01, 2, 0x60770010, 4, 0)),
        *((0x1A01, 3, 0x60410010, 4, 0), (0x1A01, 0, 3, 1, 0), (0x1801, 1, 0x40000281, 4, 0)),
    ],
    "fixed-map": [
        *((0x1801, 1, 0xC0000281, 4, 0), (0x1A01, 0, 0, 1, READ_ONLY), (0x1A01, 1, 0x60640020, 4, READ_ONLY)),
        *((0x1A01, k, value) for k, value in enumerate((3, 0x60410010, 0x60640020, 0x60770010))),
    ],
}


@pytest.mark.parametrize("name", HABITS)
def test_a_drive_has_its_makers_habits(name):
    with powered(name) as wire:
        for step in HABITS[name]:
            if isinstance(step, str):
                wire.say(step)
            elif len(step) == 5:
                assert wire.write(1, *step[:4]) == step[4], step
            elif step[2] < 0:
                assert abort_of_read(wire, *step[:2]) == -step[2], step
            else:
                assert wire.read(1, *step[:2]) == step[2], step


def test_a_roboteq_like_drive_starts_itself():
    with powered("roboteq") as wire:
        assert wire.booted == ["701 00", "181 50 02"]


def test_bit_10_toggles_with_each_sample_and_not_with_sdo_reads():
    with powered("el72x1") as wire:
        wire.say("000 01 00")
        words = []
        for _ in range(4):
            (parts,) = [frame.split() for frame in wire.say("080") if frame.startswith("281")]
            words.append(int(parts[8] + parts[7], 16) & 0x0400)
            wire.read(1, 0x6041)
        assert words in ([0, 0x400, 0, 0x400], [0x400, 0, 0x400, 0])


@pytest.mark.parametrize(("name", "kept"), [("strict", False), ("keeps-pdos", True)])
def test_reset_communication_restores_pdos_or_keeps_them(name, kept):
    with powered(name) as wire:
        mapped = lambda: [wire.read(1, 0x1A01, k) for k in range(4)]  # noqa: E731
        before = mapped()
        for entry in (
            (0x1801, 1, 0xC0000281, 4),
            (0x1A01, 0, 0, 1),
            (0x1A01, 1, 0x606C0020, 4),
            (0x1A01, 0, 1, 1),
        ):
            wire.write(1, *entry)
        changed = mapped()
        wire.say("000 82 00")
        assert mapped() == (changed if kept else before) != (before if kept else changed)
        wire.say("000 81 00")
        assert mapped() == before


def test_stored_parameters_survive_a_reset_and_restored_defaults_end_them():
    save, load = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")
    with powered("strict") as wire:
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


def test_a_slow_device_boots_in_its_own_time():
    with powered("slow-boot") as wire:
        assert wire.booted == []
        assert wire.wait(1.4) == []
        assert wire.say("601 40 00 10 00 00 00 00 00") == []
        assert wire.wait(0.2) == ["701 00"]


def device(name, rig):
    if name == "encoder":
        rig.encoder = LinkEncoder(counts_per_rev=65536)
        return Cia406Encoder(1, rig, range_counts=65536 * 4096)
    return Cia402Drive(1, rig, 0, link_encoder=True)


@pytest.mark.parametrize("transcript", sorted(path.stem for path in TRANSCRIPTS.glob("*.txt")))
def test_the_device_answers_as_written(transcript):
    rig = StubRig()
    with wired(device(transcript, rig), rig=rig) as wire:
        assert play(wire, TRANSCRIPTS / f"{transcript}.txt") > 3


WORDS = (0x06, 0x07, 0x0F, 0x00, 0x02)  # shutdown, switch on, enable operation, disable voltage, quick stop
STATES = {
    "D": P.SWITCH_ON_DISABLED, "R": P.READY_TO_SWITCH_ON, "S": P.SWITCHED_ON, "O": P.OPERATION_ENABLED,
    "Q": P.QUICK_STOP_ACTIVE,
}  # fmt: skip

TABLE = {  # where each of WORDS leads from a state
    (STATES[state], word): STATES[following]
    for state, row in {"D": "RDDDD", "R": "RSODD", "S": "RSODD", "O": "RSODQ", "Q": "QQODQ"}.items()
    for word, following in zip(WORDS, row, strict=True)
}


def machine(state):
    made = StateMachine()
    made.state = state
    return made


@pytest.mark.parametrize(("state", "word"), TABLE)
def test_a_controlword_leads_where_the_standard_says(state, word):
    made = machine(state)
    made.control(word)
    assert made.state is TABLE[state, word]


def test_quick_stop_ends_disabled_or_stays_as_its_option_says():
    for option in range(9):
        made = machine(P.QUICK_STOP_ACTIVE)
        made.quick_stop_option = option
        made.step()
        assert made.state is (P.QUICK_STOP_ACTIVE if option >= 5 else P.SWITCH_ON_DISABLED), option


@pytest.mark.parametrize("quirks", PROFILES)
def test_every_makers_drive_is_configured_and_its_frames_decode(quirks):
    text = vsa_text().replace("[motor.drive]", "[motor.drive]\ncounts_per_rev = 8192\nrated_current_a = 4.0")
    with rig(parse(f'{text}quirks = "{quirks}"\n')) as made:
        world, truth = made.network._worlds[0], []
        for _ in range(200):
            made.run(1)
            truth.append([motor.position_rad for motor in world.truth().motors])
        mapped = {
            o.signal for node in (1, 2) for tpdo in made.daemon.layouts[node].tpdos for o in tpdo.objects
        }
        assert {Signal.MOTOR_POSITION, Signal.MOTOR_TORQUE, Signal.STATUSWORD} <= mapped
        assert not any(e.status & Status.STALE for e, _ in made.collector.estimates[2:])
        measured = np.array([sample.motor_position_rad for sample, _ in made.collector.samples])
        assert np.ptp(measured[:, 0]) > 0.01
        assert measured[-150:-2] == pytest.approx(np.array(truth)[-150:-2], abs=2e-3)
