"""`drivelink dbc`: another tool decodes the joint's frames to the values that drivelink publishes."""

import pytest

from drivelink.cli import main
from drivelink.jointfile import parse
from drivelink.recording.formats import open_sink
from drivelink.recording.mapping import mapping_document

cantools = pytest.importorskip("cantools", reason="needs the extra dbc")
from drivelink.canopen.layout import MappedObject, NodeLayout, Signal, TpdoLayout  # noqa: E402

TEXT = 'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.1\n[motor.transmission]\nmodel = "linear"\n'
POSITION = MappedObject(
    signal=Signal.MOTOR_POSITION, index=0x6064, subindex=0, bits=32, signed=True, scale=1e-3
)
CURRENT = MappedObject(
    signal=Signal.MOTOR_TORQUE, index=0x6077, subindex=0, bits=16, signed=True, scale=-0.25
)
OTHER = MappedObject(signal=Signal.OTHER, index=0x6041, subindex=0, bits=16, signed=False)
LAYOUT = NodeLayout(node_id=3, motor=0, tpdos=(TpdoLayout(cob_id=0x183, objects=(POSITION, CURRENT, OTHER)),))


def test_a_recordings_frames_are_decoded_in_si(tmp_path, capsys):
    path, out = tmp_path / "r.mcap", tmp_path / "elbow.dbc"
    sink = open_sink(path, parse(TEXT), TEXT)
    sink.mapping(mapping_document("elbow", [LAYOUT], TEXT, daemon=True), 10**18)
    sink.close()
    assert main(["dbc", str(path), "--out", str(out)]) == 0
    decoded = cantools.database.load_file(out).decode_message(
        0x183, (-1500).to_bytes(4, "little", signed=True) + b"\x08\0\x27\x06"
    )
    assert decoded == {"motor1_position": pytest.approx(-1.5), "motor1_torque": -2.0, "object_6041_00": 0x627}
    assert "(0.001,0.0)" in out.read_text()  # no -0.0
    assert main(["dbc", str(path), "--out", str(out)]) != 0  # never replaced unasked


def test_a_joint_without_a_known_mapping_is_one_line(tmp_path, capsys):
    joint = tmp_path / "elbow.toml"
    joint.write_text(TEXT + '[zenoh]\nendpoint = "tcp/127.0.0.1:1"\n')
    assert main(["dbc", str(joint)]) != 0
    assert "expected the mapping of its nodes" in capsys.readouterr().err.splitlines()[-1]
    (table := tmp_path / "elbow.csv").touch()
    assert main(["dbc", str(table)]) != 0
    assert "expected a joint file, or a recording that carries one" in capsys.readouterr().err
