"""Joint file to simulated world and devices."""

import math

import pytest

from drivelink.demo.simulate import assumptions, bench_from_joints, nodes_from_joint, world_from_joint
from drivelink.errors import JointFileError, UsageError
from drivelink.jointfile import parse
from sim.canopen.drive import Cia402Drive
from sim.canopen.encoder import Cia406Encoder

SINGLE = """
name = "elbow"
[[motor]]
inertia_kg_m2 = 0.125
viscous_damping_nm_s_rad = 0.8
[motor.transmission]
model = "polynomial"
parameters = { coefficients_nm_rad = [150.0, 400.0] }
[motor.drive]
node_id = 3
counts_per_rev = 4096
gear_ratio = 100.0
direction = -1
[link.encoder]
source = "cia406"
node_id = 9
counts_per_rev = 65536
offset_rad = 0.25
[link.dynamics]
inertia_kg_m2 = 0.4
"""

VSA = """
name = "wrist"
arrangement = "antagonistic"
[[motor]]
inertia_kg_m2 = 0.0005
[motor.drive]
node_id = 1
[[motor]]
inertia_kg_m2 = 0.0005
[motor.drive]
node_id = 2
[link.encoder]
node_id = 2
[sim]
case = "vsa-ii"
"""


def joint(text=SINGLE, extra=""):
    return parse(text + extra)


def test_without_a_case_the_model_is_the_truth():
    world = world_from_joint(joint())
    world.advance(500)
    truth = world.truth()
    phi = truth.motors[0].deflection_rad
    assert phi != 0.0
    assert truth.flexibility_torque_nm == pytest.approx(150.0 * phi + 400.0 * phi**3)
    assert truth.stiffness_nm_rad == pytest.approx(150.0 + 1200.0 * phi**2)


def test_true_values_may_differ_from_the_models():
    values = "motor1_inertia_kg_m2 = 0.2, motor1_coefficient2_nm_rad = 500.0, link_gravity_nm = 6.0"
    plant = world_from_joint(joint(extra=f"[sim]\nparameters = {{ {values} }}")).plant
    assert plant.motors[0].inertia_kg_m2 == 0.2 and plant.link.gravity_nm == 6.0
    assert plant.motors[0].spring.parameters["coefficients_nm_rad"] == (150.0, 500.0)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ("[sim]\nparameters = { motor1_mass = 1.0 }", "elbow: sim: parameters.motor1_mass: unknown"),
        ("[sim]\nparameters = { motor2_inertia_kg_m2 = 1.0 }", "parameters.motor2_inertia_kg_m2: unknown"),
        ("[sim]\nparameters = { link_mass = 1.0 }", "parameters.link_mass: unknown, the link has inertia"),
        ("[sim]\nparameters = { motor1_inertia_kg_m2 = -1.0 }", "expected a finite number > 0"),
        ("[sim]\nexcitation = { kind = 'saw' }", 'sim.excitation.kind "saw": expected one of'),
        ("[sim]\n[[sim.effect]]\nname = 'magic'", 'effect "magic": expected one of'),
        ("[sim]\ncase = 'vsa-ii'", 'elbow: sim: case "vsa-ii" is antagonistic, this joint is single'),
    ],
)
def test_what_cannot_be_simulated_is_one_line(extra, message):
    with pytest.raises(JointFileError) as caught:
        world_from_joint(joint(extra=extra))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_without_parameters_gets_a_spring_and_that_is_said():
    text = SINGLE.replace("parameters = { coefficients_nm_rad = [150.0, 400.0] }", "")
    made = joint(text)
    spring = world_from_joint(made).plant.motors[0].spring.law()
    inertia = made.motor[0].inertia_kg_m2
    assert math.sqrt(spring.stiffness(0.0) / inertia) / (2.0 * math.pi) == pytest.approx(5.0)
    assert spring.stiffness(0.15) == pytest.approx(2.0 * spring.stiffness(0.0))
    assert any("simulated with" in line and "5 Hz" in line for line in assumptions(made))
    assert not any("N·m/rad" in line for line in assumptions(joint()))


def test_effects_come_from_the_file_the_model_and_the_command_line():
    extra = "[sim]\n[[sim.effect]]\nname = 'torque_offset'\nparameters = { torque_nm = 0.1 }"
    plain = world_from_joint(joint())
    offset = world_from_joint(joint(extra=extra))
    asked = world_from_joint(joint(), effects=["torque_offset=0.1"])
    for world in (plain, offset, asked):
        world.advance(50)
    assert offset.truth() == asked.truth() != plain.truth()
    with pytest.raises(UsageError, match="--effect"):
        world_from_joint(joint(), effects=["magic=1"])


def test_the_devices_report_what_the_joint_file_says():
    """Positions on the bus are the joint's through gear, direction and offset."""
    world = world_from_joint(joint())
    drive, encoder = nodes_from_joint(joint(), world)
    assert isinstance(drive, Cia402Drive) and isinstance(encoder, Cia406Encoder)
    assert (drive.node_id, encoder.node_id) == (3, 9)
    assert drive.dictionary.find(0x608F, 1).value == 4096
    assert [drive.dictionary.find(0x6091, k).value for k in (1, 2)] == [100, 1]
    assert encoder.dictionary.find(0x6501, 0).value == 65536
    world.advance(300)
    truth = world.truth()
    counts, link = (
        int.from_bytes(node.dictionary.find(index, 0).upload(), "little", signed=True)
        for node, index in ((drive, 0x6064), (encoder, 0x6004))
    )
    # Half a count of each encoder, at the joint.
    assert -counts * 2 * math.pi / 409600 == pytest.approx(truth.motors[0].position_rad, abs=8e-6)
    assert link * 2 * math.pi / 65536 - 0.25 == pytest.approx(truth.link_position_rad, abs=5e-5)


def test_a_case_brings_its_drives_and_the_file_overrides_them():
    world = world_from_joint(joint(VSA))
    assert world.drives[0].gear_ratio == 20.0
    wired = [node.dictionary.find(0x60E6, 1).value for node in nodes_from_joint(joint(VSA), world)]
    assert wired == [0, 262144]  # the link encoder, to the drive that the file names
    text = VSA.replace("node_id = 1\n", "node_id = 1\ngear_ratio = 50.0\n")
    assert world_from_joint(joint(text)).drives[0].gear_ratio == 50.0


def test_quirks_come_from_the_file_or_the_command_line():
    file = joint(VSA + 'quirks = "epos4"\n')
    world = world_from_joint(file)
    assert nodes_from_joint(file, world)[0].quirks.name == "epos4"
    assert nodes_from_joint(file, world, quirks="elmo")[0].quirks.name == "elmo"
    with pytest.raises(UsageError, match="--quirks"):
        nodes_from_joint(file, world, quirks="acme")
    with pytest.raises(JointFileError, match=r"sim\.quirks"):
        nodes_from_joint(joint(VSA + 'quirks = "acme"\n'), world)


def test_two_joints_share_a_bus_and_each_node_has_its_data_sheet():
    bench = bench_from_joints([joint(), joint(VSA)])
    assert bench.describe() == "elbow (drive 3, encoder 9); wrist (drive 1, drive 2)"
    nodes = ("elbow-node3", "elbow-node9", "wrist-node1", "wrist-node2")
    assert set(bench.eds()) == {f"{node}.eds" for node in nodes}
    with pytest.raises(UsageError, match="got 1 twice"):
        bench_from_joints([joint(VSA), joint(VSA)])


def test_a_rigid_joint_is_simulated_with_the_inertia_that_it_declares():
    rigid = parse('name = "axis"\n[[motor]]\ninertia_kg_m2 = 0.002\n[motor.transmission]\nmodel = "none"\n')
    world = world_from_joint(rigid)
    world.advance(2000)
    assert abs(world.truth().link_position_rad) > 0.01  # it moves
    plant = world.plant
    whole = plant.motors[0].inertia_kg_m2 + plant.link.inertia_kg_m2
    assert whole == pytest.approx(0.002, rel=1e-5) and assumptions(rigid) == []
