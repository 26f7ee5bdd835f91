"""What the controller in lockstep stands on: devices in the daemon's thread, and `transmissions` in the status."""

import itertools
import json

import can
import controllerkit as kit
import pytest
from vsacontrol.lockstep import LockstepRig
from vsacontrol.springs import spring, springs_of

from drivelink.cycle.framesource import PumpedBus
from drivelink.cycle.sources import open_source
from drivelink.jointfile import JointFile

_channels = itertools.count()


class OtherBus:
    """A bus that python-can knows and the daemon has no quick way to read."""

    def __init__(self, bus: can.BusABC) -> None:
        self.send, self.recv = bus.send, bus.recv


class Echo:
    """A device that answers each frame with the same data under the next identifier."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self.due: list[int] = []

    def __call__(self) -> None:
        while (message := self._bus.recv(0)) is not None:
            self._say(message.arbitration_id + 1, bytes(message.data))
        for cob_id in self.due:
            self._say(cob_id, b"")
        self.due.clear()

    def _say(self, cob_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))


@pytest.fixture
def pumped():
    channel = f"pumped-{next(_channels)}"
    ends = [can.Bus(interface="virtual", channel=channel) for _ in range(2)]
    echo = Echo(ends[1])
    source = open_source(OtherBus(ends[0]), echo)
    assert isinstance(source, PumpedBus)
    yield source, echo
    for end in ends:
        end.shutdown()


def test_devices_in_this_thread_have_answered_when_send_returns(pumped):
    source, _ = pumped
    source.send(0x101, b"\x01\x02")
    assert source.wait(0.0)  # nothing else has been called since: the answer came within `send`
    assert [(f.cob_id, f.data) for f in source.take()] == [(0x102, b"\x01\x02")]
    assert source.take() == []


def test_what_is_due_without_being_asked_for_comes_with_take(pumped):
    source, echo = pumped
    echo.due.append(0x181)
    assert not source.wait(0.0)
    assert [f.cob_id for f in source.take()] == [0x181]


def transmissions(joint: JointFile, seconds: float) -> list:
    """The status's entry after so much bus time, over the wire's own JSON."""
    law = kit.Decoupler(joint=kit.VSA)
    controller = kit.Controller(kit.VSA, law, kit.Reference(kit.WAYPOINTS["decoupling"]), 1e-3)
    rig = LockstepRig(joint, controller)
    try:
        rig.run(seconds)
        return json.loads(json.dumps(rig.daemon.documents()[0]))["transmissions"]
    finally:
        rig.close()


def test_the_status_says_each_transmission_as_a_control_law_needs_it():
    entries = transmissions(kit.declared(), 1.0)
    assert [entry["model"] for entry in entries] == ["vsa-ii", "vsa-ii"]
    for entry in entries:
        assert set(entry["parameters"]) == set(entry["std"]) == set(kit.SPRING)
        for name, true in kit.SPRING.items():
            assert 0.0 < entry["std"][name] < 0.1 * true
            assert entry["parameters"][name] == pytest.approx(true, abs=5.0 * entry["std"][name])
    laws = springs_of(entries)
    assert laws is not None
    for law, entry in zip(laws, entries, strict=True):  # in the order of the motors
        assert law(0.4) == spring("vsa-ii", entry["parameters"])(0.4)


def test_the_status_of_an_unknown_joint_gives_the_controller_nothing_to_steer_by():
    joint = kit.jointfile.load(kit.EXAMPLE / "joint.toml")
    assert springs_of(transmissions(joint, 0.02)) is None
