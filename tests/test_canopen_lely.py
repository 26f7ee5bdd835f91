"""The configuration against what lely-core 2.4, an independent stack in C, answered with makers' data sheets."""

from collections import defaultdict
from pathlib import Path

import pytest
from canopenkit import configured, joint_text

from drivelink._core import SYNC_COB_ID, Assembler

TRANSCRIPTS = Path(__file__).parent / "transcripts/lely"
COUNTS, TORQUE_COUNTS = 123_456, -321  # that it measured at its SYNC
STATED = "counts_per_rev = 4096\nrated_torque_nm = 1.0\nrated_current_a = 1.0\ntorque_constant_nm_a = 0.1"


class RecordedSlave:
    """A node that answers each request as it once did, and is asked everything that it was asked then."""

    def __init__(self, maker: str) -> None:
        self.left: dict[str, list[list[str]]] = defaultdict(list)
        for line in (TRANSCRIPTS / f"{maker}.txt").read_text(encoding="utf-8").splitlines()[1:]:
            if line.startswith(">"):
                self.left[line].append(answers := [])
            else:
                answers.append(line)

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """A frame in, and what was answered."""
        answers = self.left[f"> {cob_id:03X} {data.hex(' ').upper()}".rstrip()].pop(0)
        return [(int(line[2:5], 16), bytes.fromhex(line[6:])) for line in answers]


@pytest.mark.parametrize("maker", ["epos4", "nanotec"])
def test_what_lely_core_answered_is_configured_and_decoded(maker):
    slave = RecordedSlave(maker)
    _, layout = configured(slave, joint_text(drive=STATED))
    assembler = Assembler((layout,), 1)
    assembler.feed(SYNC_COB_ID, b"")
    (sample,) = [assembler.feed(*answer) for answer in slave.handle(SYNC_COB_ID, b"")]
    assert not any(slave.left.values())
    scales = {str(o.signal): o.scale for tpdo in layout.tpdos for o in tpdo.objects}
    counts = (
        sample.motor_position_rad[0] / scales["motor_position"],
        sample.motor_torque_nm[0] / scales["motor_torque"],
    )
    assert counts == pytest.approx((COUNTS, TORQUE_COUNTS))
    assert {f"{o.index:04X}" for tpdo in layout.tpdos for o in tpdo.objects} == {"6064", "6077", "6041"}
