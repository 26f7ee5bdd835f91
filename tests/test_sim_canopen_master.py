"""An independent master (python-canopen) with our EDS files against the simulated devices."""

import itertools
import threading
from contextlib import contextmanager
from dataclasses import replace

import can
import canopen
import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable
from canopen.sdo.exceptions import SdoAbortedError
from simkit import StubRig

from drivelink.canopen.bus import interface_is_up
from sim.canopen.drive import Cia402Drive
from sim.canopen.edsfile import eds_directory
from sim.canopen.encoder import Cia406Encoder
from sim.canopen.profiles import PROFILES, profile
from sim.network import Network
from sim.sensors import DriveHardware

_channels = itertools.count()
PATIENCE_S = 5.0  # only ever waited for when something is broken


BUSES = [
    "virtual",
    pytest.param(
        "socketcan",
        marks=[
            pytest.mark.socketcan,
            pytest.mark.skipif(not interface_is_up("vcan0"), reason="no SocketCAN vcan0 here"),
        ],
    ),
]


@contextmanager
def mastered(*nodes, rig, interface="virtual"):
    """A served network and a master on the same bus."""
    channel = f"master-{next(_channels)}" if interface == "virtual" else "vcan0"
    with can.Bus(interface=interface, channel=channel) as device_end:
        network = Network(device_end, nodes, rig)
        master = canopen.Network()
        master.NOTIFIER_CYCLE = 0.02  # how long its thread takes to end
        master.connect(interface=interface, channel=channel)
        network.start()
        try:
            yield master
        finally:
            network.stop()
            master.disconnect()


def device(eds, rig):
    """What an EDS file describes."""
    quirks = EDS[eds]
    return Cia402Drive(1, rig, 0, profile(quirks)) if quirks else Cia406Encoder(1, rig)


def remote(master, eds="cia402-drive.eds"):
    node = master.add_node(1, str(eds_directory() / eds))
    node.sdo.RESPONSE_TIMEOUT = PATIENCE_S
    return node


def variables(od):
    for described in (described for described in od.values() if described.index >= 0x1000):
        if isinstance(described, ODVariable):
            yield described
        elif isinstance(described, ODRecord | ODArray):
            yield from described.subindices.values()


EDS = {
    "cia402-drive.eds": "strict",
    "cia406-encoder.eds": None,
    **{f"{name}.eds": name for name, quirks in PROFILES.items() if quirks.eds == name},
}


@pytest.mark.parametrize("eds", EDS)
def test_every_object_of_the_eds_is_served_with_its_type_and_default(eds):
    rig, served = StubRig(), set()
    node = device(eds, rig)
    assert node.eds(eds) == (eds_directory() / eds).read_text(encoding="ascii")
    assert {path.name for path in eds_directory().glob("*.eds")} == set(EDS)
    with mastered(node, rig=rig) as master:
        peer = remote(master, eds)
        for variable in variables(peer.object_dictionary):
            served.add((variable.index, variable.subindex))
            if variable.index == 0x1003 and variable.subindex:
                with pytest.raises(SdoAbortedError) as aborted:
                    peer.sdo.upload(variable.index, variable.subindex)
                assert aborted.value.code == 0x08000024
                continue
            data = peer.sdo.upload(variable.index, variable.subindex)
            if variable.data_type in canopen.objectdictionary.datatypes.INTEGER_TYPES:
                assert len(data) * 8 == len(variable), variable.name
            if not variable.pdo_mappable and variable.default is not None:
                assert variable.decode_raw(data) == variable.default, variable.name
    assert served == {(entry.item.index, entry.item.subindex) for entry in node.dictionary}


def test_an_eds_file_has_the_nameplate_of_its_device():
    rig = StubRig(DriveHardware(counts_per_rev=8192, gear_ratio=50 / 3))
    node = Cia402Drive(1, rig, 0, replace(profile("epos4"), second_encoder=3), link_encoder=True)
    text = node.eds("elbow.eds")
    assert "FileName=elbow.eds" in text and "ProductName=drivelink simulated drive, EPOS4-like" in text
    assert "[60E4sub3]\nParameterName=Additional position actual value, sensor 3" in text
    strict = Cia402Drive(1, rig, 0).eds("elbow.eds")
    assert "[608Fsub1]" in strict and "DefaultValue=0x2000" in strict.split("[608Fsub1]")[1][:160]


@pytest.mark.parametrize("interface", BUSES)
def test_a_master_maps_saves_reads_back_and_receives(interface):
    rig = StubRig()
    with mastered(device("cia402-drive.eds", rig), rig=rig, interface=interface) as master:
        peer = remote(master)
        peer.nmt.state = "PRE-OPERATIONAL"
        peer.tpdo.read()
        peer.rpdo.read()
        peer.tpdo[1].clear()
        for name in (0x6064, 0x6077, 0x6041):
            peer.tpdo[1].add_variable(name)
        peer.tpdo[1].trans_type = 1
        peer.tpdo[1].enabled = True
        peer.tpdo.save()
        peer.tpdo.read()
        assert [variable.index for variable in peer.tpdo[1].map] == [0x6064, 0x6077, 0x6041]
        got = threading.Event()
        values: list[int] = []

        def received(pdo):
            values[:] = [variable.raw for variable in pdo]
            got.set()

        peer.tpdo[1].add_callback(received)
        peer.nmt.state = "OPERATIONAL"
        master.sync.transmit()
        assert got.wait(PATIENCE_S)
        assert values[0] % 100 == 0  # the rig's position is a multiple of 100
        assert values[1:] == [500, 0x0250]


def test_an_emergency_reaches_the_master_and_its_history():
    rig = StubRig()
    node = device("cia402-drive.eds", rig)
    with mastered(node, rig=rig) as master:
        peer = remote(master)
        peer.sdo[0x1000].raw  # noqa: B018 - the drive is up
        arrived = threading.Event()
        peer.emcy.add_callback(lambda _emergency: arrived.set())
        node.fault(0x2310, 0x02, b"\x01\x02")
        assert arrived.wait(PATIENCE_S)
        emergency = peer.emcy.log[-1]
        assert (emergency.code, emergency.register, emergency.data[:2]) == (0x2310, 0x03, b"\x01\x02")
        assert peer.sdo[0x1003][1].raw == 0x0201_2310
        assert peer.sdo[0x603F].raw == 0x2310
        master.sync.transmit()
        while peer.sdo[0x6041].raw & 0x4F != 0x08:  # fault reaction ends with a control cycle
            master.sync.transmit()
        peer.sdo[0x6040].raw = 0x80
        assert (peer.emcy.log[-1].code, peer.emcy.log[-1].register) == (0, 0)  # before the SDO response
        assert peer.sdo[0x6041].raw & 0x4F == 0x40
