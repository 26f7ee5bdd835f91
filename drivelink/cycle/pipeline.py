"""Makes a joint's pipeline (`drivelink._core.JointPipeline`) from its joint file: live, lockstep, replay."""

import math
from collections.abc import Sequence

from drivelink._core import Assembler, JointPipeline
from drivelink.canopen.layout import NodeLayout
from drivelink.errors import DriveError
from drivelink.jointfile import JointFile
from drivelink.jointfile.apply_diagnosis import make_model_monitor
from estimator import Estimator, make_estimator
from estimator.model_monitor import ModelMonitor
from estimator.sample import Sample

_REHEARSED = 500  # samples: half a second, enough for the first estimates
_HOLD_S, _HOLD_PERIODS = 0.25, 10  # of silence, and at least so many, see `Assembler`


Built = tuple[Estimator, ModelMonitor | None]


def build(joint: JointFile) -> Built:
    """Make estimator and model monitor of a joint."""
    estimator = make_estimator(joint.model(), joint.estimator, joint.bus.period_s)
    return estimator, make_model_monitor(joint)


def make_assembler(joint: JointFile, layouts: Sequence[NodeLayout]) -> Assembler:
    """Make the assembler of a joint file for these layouts.

    Raises:
        DriveError: the layouts lack something that the joint's model needs.
    """
    hold = max(_HOLD_PERIODS, round(_HOLD_S / joint.bus.period_s))
    assembler = Assembler(
        layouts, len(joint.motor), active=joint.bus.configure, hold_periods=hold, period_s=joint.bus.period_s
    )
    if joint.model().has_deflection and not assembler.has_link:
        raise DriveError(
            f"{joint.name}: no frame carries the link position: expected [link.encoder], "
            'or transmission.model = "none"'
        )
    return assembler


def make_pipeline(joint: JointFile, layouts: Sequence[NodeLayout], *, keep: int = 0) -> JointPipeline:
    """Make the pipeline of a joint file for these layouts; arguments as in `JointPipeline`.

    Raises:
        DriveError: the layouts lack something that the joint's model needs.
    """
    return JointPipeline(make_assembler(joint, layouts), *build(joint), keep=keep)


def rehearse(joint: JointFile) -> None:
    """Step an estimator and monitor like this joint's, so that the loop does nothing for the first time.

    Libraries, memory and threads that the first use loads or starts are ready afterwards.
    """
    pipeline = JointPipeline(Assembler((), 0), *build(joint))
    motors = len(joint.motor)
    for k in range(_REHEARSED):
        theta, nothing = tuple(0.01 * math.sin(0.05 * k + i) for i in range(motors)), (math.nan,) * motors
        tick = pipeline.step(Sample(k, theta, nothing, theta, 0.0))
        _ = tick.estimate_payload, tick.sample_payload, tick.external_payload  # made on first access
        _ = tick.estimate, tick.sample, tick.external
    pipeline.carry_on(_REHEARSED)
    pipeline.estimator.parameters()
