"""The configuration against lely-core, an independent stack in C, with makers' data sheets.

What it answers is in `tests/transcripts/lely/`; where the library is, it is asked (`lelykit`), else it is not.
`python tests/test_canopen_lely.py` writes the transcripts anew.
"""

from pathlib import Path

import lelykit
import pytest
from canopenkit import Wire, configure, joint_text

from drivelink._core import SYNC_COB_ID, Assembler
from drivelink.canopen.layout import NodeLayout
from drivelink.jointfile import parse

SHEETS = Path(__file__).parents[1] / "sim/eds"
TRANSCRIPTS = Path(__file__).parent / "transcripts/lely"
NODE, COUNTS, TORQUE_COUNTS = 5, 123_456, -321
MAKERS = ("epos4", "nanotec")
STATED = "counts_per_rev = 4096\nrated_torque_nm = 1.0\nrated_current_a = 1.0\ntorque_constant_nm_a = 0.1"


class RecordedSlave:
    """A node that answers as it once did, as long as it is asked the same."""

    def __init__(self, lines: list[str]) -> None:
        self._lines = lines
        self._next = 0

    def handle(self, cob_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """A frame in, and what was answered."""
        asked = f"> {cob_id:03X} {data.hex(' ').upper()}".rstrip()
        assert asked == self._lines[self._next], f"line {self._next + 1} of the transcript"
        answers = []
        self._next += 1
        while self._next < len(self._lines) and self._lines[self._next].startswith("<"):
            _, answering, *answer = self._lines[self._next].split()
            answers.append((int(answering, 16), bytes.fromhex("".join(answer))))
            self._next += 1
        return answers


def transcript(maker: str) -> list[str]:
    text = (TRANSCRIPTS / f"{maker}.txt").read_text(encoding="utf-8")
    return [line for line in text.splitlines() if not line.startswith("#")]


def asked(slave: RecordedSlave | lelykit.LelySlave) -> tuple[NodeLayout, list[str], tuple[float, float]]:
    """Configure it and make one SYNC: its layout, all frames, position and torque in counts."""
    wire = Wire([slave])  # type: ignore[list-item]
    (layout,) = configure(wire, parse(joint_text(drive=STATED)))
    if isinstance(slave, lelykit.LelySlave):
        slave.put(0x6064, COUNTS, 32)
        slave.put(0x6077, TORQUE_COUNTS, 16)
    assembler = Assembler((layout,), 1)
    assembler.feed(SYNC_COB_ID, b"")
    wire._note(">", SYNC_COB_ID, b"")
    sample = None
    for cob_id, data in slave.handle(SYNC_COB_ID, b""):
        wire._note("<", cob_id, data)
        sample = assembler.feed(cob_id, data) or sample
    assert sample is not None
    scales = {str(o.signal): o.scale for tpdo in layout.tpdos for o in tpdo.objects}
    position = sample.motor_position_rad[0] / scales["motor_position"]
    log = [line.rstrip() for line in wire.log]
    return layout, log, (position, sample.motor_torque_nm[0] / scales["motor_torque"])


@pytest.mark.parametrize("maker", MAKERS)
def test_what_lely_core_answered_is_configured_and_decoded(maker):
    lines = transcript(maker)
    layout, log, counts = asked(RecordedSlave(lines))
    assert log == lines
    assert counts == pytest.approx((COUNTS, TORQUE_COUNTS))
    assert {f"{o.index:04X}" for tpdo in layout.tpdos for o in tpdo.objects} == {"6064", "6077", "6041"}


@pytest.mark.skipif(lelykit.library() is None, reason="no lely-core here")
@pytest.mark.parametrize("sheet", sorted(SHEETS.glob("*.eds")), ids=lambda sheet: sheet.stem)
def test_lely_core_is_configured_with_every_data_sheet_and_answers_as_recorded(sheet):
    if "encoder" in sheet.name:
        pytest.skip("no drive")
    _, log, counts = asked(lelykit.LelySlave(NODE, sheet))
    assert counts == pytest.approx((COUNTS, TORQUE_COUNTS))
    if sheet.stem in MAKERS:
        assert log == transcript(sheet.stem)


def write() -> None:
    """The transcripts, from the library."""
    for maker in MAKERS:
        _, log, _ = asked(lelykit.LelySlave(NODE, SHEETS / f"{maker}.eds"))
        head = f"# lely-core with sim/eds/{maker}.eds as node {NODE}: its configuration, and one SYNC.\n"
        (TRANSCRIPTS / f"{maker}.txt").write_text(head + "\n".join(log) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write()
