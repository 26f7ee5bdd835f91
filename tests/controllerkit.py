"""What the controller's tests share: the example's package, and rigs in lockstep that have identified the springs."""

import math
import sys
from contextlib import contextmanager
from pathlib import Path

EXAMPLE = Path(__file__).parent.parent / "examples" / "controller"
if str(EXAMPLE) not in sys.path:
    sys.path.insert(0, str(EXAMPLE))

from vsacontrol.controller import Controller  # noqa: E402
from vsacontrol.identify import Excitation  # noqa: E402
from vsacontrol.laws import Decoupler  # noqa: E402
from vsacontrol.lockstep import LockstepRig  # noqa: E402
from vsacontrol.phases import Phase, Settings  # noqa: E402
from vsacontrol.plant import Joint, joint_of  # noqa: E402
from vsacontrol.references import WAYPOINTS, Reference  # noqa: E402

from drivelink import jointfile  # noqa: E402
from drivelink.jointfile import JointFile  # noqa: E402

VSA = Joint(
    motor_inertia_kg_m2=(0.0005, 0.0005),
    motor_damping_nm_s_rad=(0.005, 0.005),
    link_inertia_kg_m2=0.003,
    link_damping_nm_s_rad=0.001,
    gravity_nm=0.2943,
)
SPRING = {"k_nm_rad": 0.5, "c": 1.75}

# The springs are declared as they are: these tests are about faults, and an identification takes its time.
QUICK = Settings(identify_s=3.0, again_s=2.0, approach_s=1.0, rest_s=0.2)
GENTLE = Excitation(small_s=0.0, high_nm=0.12)


def declared_text() -> str:
    """The example's joint with its springs declared, so that the estimates are good from the start."""
    text = (EXAMPLE / "joint.toml").read_text(encoding="utf-8")
    known = 'model = "vsa-ii"\nparameters = { k_nm_rad = 0.5, c = 1.75 }'
    return text.replace('model = "vsa-ii"', known)


def declared() -> JointFile:
    return jointfile.parse(declared_text())


@contextmanager
def running(seconds: float = 0.5, channel: str | None = None, settings: Settings = QUICK):
    """A rig in the midst of its reference: the controller has been in phase `run` for so long."""
    joint = declared()
    acting = Decoupler(joint=joint_of(joint))
    controller = Controller(
        joint_of(joint),
        acting,
        Reference(WAYPOINTS["decoupling"]),
        joint.bus.period_s,
        settings=settings,
        excitation=GENTLE,
    )
    rig = LockstepRig(joint, controller, channel=channel)
    try:
        assert rig.run(12.0, until=lambda: controller.phase is Phase.RUN), controller.events
        rig.run(seconds)
        assert controller.phase is Phase.RUN, controller.events
        yield rig
    finally:
        rig.close()


SAFE_WITHIN_S = 0.020


def torque_ended(rig, since_s: float) -> float:
    """Seconds from `since_s` to the frame that took the torque from the last drive, for good; inf: none did."""
    ends = []
    for cob_id in {cob_id for _, cob_id, _ in rig.commands}:
        frames = [(time_s, per_mille) for time_s, cob, per_mille in rig.commands if cob == cob_id]
        last = max(k for k, (_, per_mille) in enumerate(frames) if per_mille)
        ends.append(frames[last + 1][0] - since_s if last + 1 < len(frames) else math.inf)
    return max(ends)


def goes_safe(rig, since_s: float) -> str:
    """Assert that it does, in time, and stays there; the reason."""
    rig.run(0.1)
    assert rig.controller.phase is Phase.SAFE
    assert torque_ended(rig, since_s) <= SAFE_WITHIN_S
    demands = [node.dictionary.find(0x6074, 0).number for node in rig.network.nodes[:2]]
    assert demands == [0, 0]
    return rig.controller.events[-1].reason


def recovers(rig, seconds: float) -> list[Phase]:
    """Assert that it follows its reference again; the phases on the way."""
    before = len(rig.controller.events)
    assert rig.run(seconds, until=lambda: rig.controller.phase is Phase.RUN), rig.controller.events
    return [event.phase for event in rig.controller.events[before:]]
