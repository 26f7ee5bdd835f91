"""Whatever arrives during a configuration: no exception but `DriveError`, and always an end."""

import random

import pytest
from canopenkit import Slave, Wire, drive_objects, joint_text

from drivelink.canopen.configure import Configurator
from drivelink.canopen.guard import check_frame
from drivelink.canopen.layout import NodeLayout
from drivelink.errors import DriveError
from drivelink.jointfile import parse

JOINT = parse(joint_text(link="[link.encoder]\ncounts_per_rev = 4096"))


def mutated(generator, data):
    data = bytearray(data)
    for _ in range(generator.randrange(1, 4)):
        if data:
            data[generator.randrange(len(data))] = generator.randrange(256)
    return bytes(data[: generator.choice((8, 8, 8, generator.randrange(9)))])


@pytest.mark.parametrize("seed", range(40))
def test_damaged_answers_end_in_a_layout_or_one_line(seed):
    generator = random.Random(seed)
    damage = generator.choice((0.01, 0.1, 0.5, 1.0))
    wire = Wire([Slave(5, drive_objects(5))])

    def send(cob_id, data):
        check_frame(cob_id, data)
        for slave in wire.slaves:
            for answer_id, answer in slave.handle(cob_id, data):
                wire.put(answer_id, mutated(generator, answer) if generator.random() < damage else answer)

    configurator = Configurator(send, [JOINT])
    configurator.start(5)
    now, ended = 0.0, []
    for _ in range(50_000):
        now += 0.002
        ended += configurator.poll(now)
        if generator.random() < 0.05:
            configurator.feed(generator.choice((0x585, 0x586, 0x705)), generator.randbytes(8), now)
        message = wire.recv()
        if message is not None:
            configurator.feed(message.arbitration_id, bytes(message.data), now)
        if ended:
            break
    ((_, result),) = ended
    assert isinstance(result, NodeLayout | DriveError)
    if isinstance(result, DriveError):
        assert "\n" not in str(result)
    else:
        assert all(frame.length <= 8 for frame in result.tpdos)
