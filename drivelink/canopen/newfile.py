"""Text of a commented joint file, from a few answers or from the nodes on the bus."""

from dataclasses import dataclass, field

from drivelink.canopen.scan import FoundNode
from drivelink.canopen.vendors import vendor_of
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile, parse

_GCM2 = 1e-7  # kg·m² a g·cm²
_PLACEHOLDER = 0.1  # kg·m², where the inertia is not known


@dataclass(slots=True, kw_only=True)
class Answers:
    """Answers for a new joint file."""

    name: str = "joint"  # of the joint
    arrangement: str = "single"  # single, antagonistic or serial
    inertia_kg_m2: float | None = None  # of each motor, joint side; None: unknown, a placeholder is written
    rotor_inertia_gcm2: float | None = None  # of each motor, from its data sheet; requires the gear ratio
    torque_constant_mnm_a: float | None = None  # likewise; None: the drive reports a torque
    viscous_damping_nm_s_rad: float = 0.0  # of each motor, joint side; 0: unknown
    model: str = "polynomial"  # of the transmission
    nodes: list[int] = field(default_factory=list)  # node ids of the drives, motor by motor
    gear_ratio: float | None = None  # motor revolutions per joint revolution; None: read from the drive
    encoder: str = "drive"  # "drive", "none", or the node id of a CiA 406 encoder
    interface: str = "socketcan"  # python-can's
    channel: str = "can0"  # python-can's
    bitrate: int = 1_000_000  # bit/s
    passive: bool = False  # another master configures the drives and produces SYNC
    remarks: dict[int, str] = field(default_factory=dict)  # comments by node

    @property
    def motors(self) -> int:
        """How many."""
        return 1 if self.arrangement == "single" else 2

    @property
    def joint_inertia_kg_m2(self) -> float | None:
        """Inertia of each motor at the joint side, given or from the data sheet."""
        if self.inertia_kg_m2 is not None or self.rotor_inertia_gcm2 is None or self.gear_ratio is None:
            return self.inertia_kg_m2
        return self.rotor_inertia_gcm2 * _GCM2 * self.gear_ratio**2

    @property
    def conversion(self) -> str:
        """The conversion of the inertia in words; empty if it was given at the joint side."""
        inertia = self.joint_inertia_kg_m2
        if inertia is None or self.inertia_kg_m2 is not None:
            return ""
        return f"{self.rotor_inertia_gcm2:g} g·cm² × {self.gear_ratio:g}² = {inertia:.6g} kg·m²"


def joint_text(answers: Answers) -> str:
    """Return the text of the file, validated.

    Raises:
        JointFileError: an answer is invalid.
    """
    nodes = list(answers.nodes)
    free = (node for node in range(1, 128) if node not in nodes)
    while len(nodes) < answers.motors:
        nodes.append(next(free))
    meaning = _ARRANGEMENTS.get(answers.arrangement, "")
    parts = [_HEAD.format(name=answers.name, arrangement=answers.arrangement, meaning=meaning)]
    parts += [_motor(answers, index, node) for index, node in enumerate(nodes[: answers.motors])]
    bus = {key: getattr(answers, key) for key in ("interface", "channel", "bitrate")}
    parts += [_link(answers), _BUS.format(**bus, master=_PASSIVE if answers.passive else _ACTIVE), _ZENOH]
    text = "\n".join(parts)
    parse(text, "these answers")
    return text


_ARRANGEMENTS = {
    "single": "one motor behind one transmission",
    "antagonistic": "two motors pull against each other (eqs 9, 11)",
    "serial": "a second motor sets the stiffness",
}
_HEAD = """\
# A joint of drivelink: what it is, how it is reached, where its estimates go.
# Check it, the bus and the drives with `drivelink doctor`, then `drivelink run`.
name = "{name}"  # part of the key: drivelink/{name}/estimate
arrangement = "{arrangement}"  # {meaning}
"""
_MOTOR = """\
[[motor]]  # motor {number}
inertia_kg_m2 = {inertia:.6g}  # joint side: {origin}
viscous_damping_nm_s_rad = {damping:g}  # joint side{unknown}
[motor.transmission]
model = "{model}"  # form of the flexibility torque; "none" if rigid
# order = 2  # of a polynomial; left out: chosen from the data
[motor.drive]
node_id = {node}{remark}
{gear}
# counts_per_rev = 16384  # at the motor; left out: the drive's (0x608F)
# rated_torque_nm = 0.5  # left out: the drive's (0x6076)
{constant}
# direction = -1  # where the motor counts against the joint
# eds = "drive.eds"  # only needed where the drive may not be asked (configure = false)
"""
_LINK = """\
[link]
[link.encoder]
{encoder}
# direction = -1
# [link.dynamics]  # makes external torques visible (eq 12)
# inertia_kg_m2 = 0.4
"""
_BUS = """\
[bus]
interface = "{interface}"  # any of python-can's
channel = "{channel}"
bitrate = {bitrate}
period_s = 0.001  # one SYNC, one sample, one estimate
{master}
"""
_PASSIVE = """\
configure = false  # never send a frame: another master is in charge
sync = "follow\""""
_ACTIVE = """\
# sync = "follow"  # where another master makes SYNC
# configure = false  # never send a frame: another master configures the drives"""
_ZENOH = """\
[zenoh]
# endpoint = "tcp/127.0.0.1:7447"  # where subscribers connect
# config = "zenoh.json5"  # instead: a zenoh configuration of your own
"""


def left_open(joint: JointFile, text: str) -> bool:
    """Return whether a joint file still has the placeholder of an inertia."""
    return "PLACEHOLDER" in text and any(motor.inertia_kg_m2 == _PLACEHOLDER for motor in joint.motor)


def _motor(answers: Answers, index: int, node: int) -> str:
    gear, meaning = answers.gear_ratio, "motor revolutions per joint revolution"
    default = f"# gear_ratio = 1.0  # {meaning}; left out: the drive's (0x6091), else 1"
    inertia, origin = answers.joint_inertia_kg_m2, "rotor inertia times gear ratio squared"
    if inertia is None:
        inertia, origin = _PLACEHOLDER, f"PLACEHOLDER, put in yours: {origin}"
    constant = answers.torque_constant_mnm_a
    return _MOTOR.format(
        number=index + 1,
        inertia=inertia,
        origin=answers.conversion or origin,
        damping=answers.viscous_damping_nm_s_rad,
        unknown="" if answers.viscous_damping_nm_s_rad else "; not known: fit finds it",
        model=answers.model,
        node=node,
        remark=_remark(answers, node),
        gear=default if gear is None else f"gear_ratio = {gear:g}  # {meaning}",
        constant="# torque_constant_nm_a = 0.05  # where the torque has to come from the current"
        if constant is None
        else f"torque_constant_nm_a = {constant * 1e-3:.6g}  # at the shaft: {constant:g} mN·m/A",
    )


def _remark(answers: Answers, node: int) -> str:
    return f"  # {answers.remarks[node]}" if node in answers.remarks else ""


def _link(answers: Answers) -> str:
    if answers.encoder == "none":
        return "[link]\n# no link encoder: only with a rigid transmission\n"
    encoder, known = 'source = "drive"  # second encoder of the first drive, 0x60E4:01\n', "drive's (0x60E6)"
    if answers.encoder != "drive":
        node, known = int(answers.encoder), "encoder's (0x6501)"
        encoder = 'source = "cia406"  # an encoder that is a node of its own\n'
        encoder += f"node_id = {node}{_remark(answers, node)}\n"
    encoder += f"# counts_per_rev = 65536  # per joint revolution; left out: the {known}"
    return _LINK.format(encoder=encoder)


def answers_from_bus(answers: Answers, found: list[FoundNode]) -> Answers:
    """Add the data of the nodes on the bus.

    Raises:
        DriveError: there is no drive.
    """
    drives = [node for node in found if node.device_type is not None and node.device_type & 0xFFFF == 402]
    encoders = [node for node in found if node.device_type is not None and node.device_type & 0xFFFF == 406]
    if not drives:
        heard = ", ".join(f"node {node.node_id} ({node.profile})" for node in found) or "nobody"
        raise DriveError(f"no CiA 402 drive answers on {answers.interface} {answers.channel}; heard: {heard}")
    if not answers.nodes:
        answers.nodes = [node.node_id for node in drives][:2]
        if len(answers.nodes) == 2 and answers.arrangement == "single":
            answers.arrangement = "antagonistic"
    if encoders and answers.encoder == "drive":
        answers.encoder = str(encoders[0].node_id)
    for node in found:
        maker = vendor_of(node.identity[0]).name or f"vendor 0x{node.identity[0]:X}"
        name = "".join(letter for letter in node.name if letter.isprintable())
        answers.remarks[node.node_id] = f"{name + ', ' if name else ''}{node.profile}, {maker}"
    return answers
