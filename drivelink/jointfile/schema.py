"""Schema of the joint file; the tables of its reference page are made from it."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal, Self

from annotated_types import Gt
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from drivelink.errors import raised_as
from drivelink.jointfile.columns import COLUMNS, si_factor
from estimator.effects import LIBRARY, elements
from estimator.errors import expected
from estimator.model import (
    Arrangement,
    Effect,
    JointModel,
    LinkDynamics,
    Motor,
    Transmission,
    require_parameters,
)
from estimator.model_monitor import ResidualBaseline, expecting
from estimator.ranges import require_in_range
from estimator.settings import EstimatorSettings
from estimator.transmissions import transmission_model

Direction = Literal[1, -1]
MOST_EFFECTS = 32  # of a motor or the link: each costs time in every cycle


def _known(effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
    for effect in effects:
        if effect.name not in LIBRARY:
            raise ValueError(f'effect "{effect.name}": {expected(effect.name, sorted(LIBRARY))}')
        elements(effect)
    return effects


_Effects = Annotated[tuple[Effect, ...], AfterValidator(_known)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        for name, info in type(self).model_fields.items():
            value = getattr(self, name)
            if isinstance(value, int | float):
                require_in_range(name, value, positive=any(isinstance(one, Gt) for one in info.metadata))
        return self


class TpdoSection(_Section):
    """A TPDO of a node that another master configures."""

    cob_id: int = Field(ge=0x181, le=0x57F, description="identifier of the frame, e.g. 0x181")
    objects: tuple[str, ...] = Field(
        min_length=1,
        max_length=64,
        description='mapped objects in order, "index:subindex:bits", e.g. "0x6064:00:32"',
    )
    transmission_type: int = Field(
        1, ge=0, le=255, description="1 to 240: every so many SYNCs; 254, 255: event-driven"
    )
    default: bool = Field(
        False, description="the node has this mapping after every start; false: a master writes it"
    )

    @model_validator(mode="after")
    def _objects(self) -> Self:
        for text in self.objects:
            if not re.fullmatch(r"0x[0-9A-Fa-f]{4}:[0-9A-Fa-f]{2}:\d{1,2}", text):
                raise ValueError(f'expected "0xINDEX:SUB:BITS" like "0x6064:00:32", got "{text}"')
        return self


class DriveSection(_Section):
    """The drive of one motor. Values that the drive reports may be left out."""

    node_id: int = Field(ge=1, le=127, description="CANopen node id")
    counts_per_rev: float | None = Field(None, gt=0, description="counts per motor revolution (0x608F)")
    gear_ratio: float = Field(1.0, gt=0, description="motor revolutions per joint revolution (0x6091)")
    torque_constant_nm_a: float | None = Field(
        None, gt=0, description="torque at the motor shaft per ampere; turns a current into a torque"
    )
    rated_current_a: float | None = Field(
        None, gt=0, description="unit of 0x6078 is a thousandth of it (0x6075)"
    )
    rated_torque_nm: float | None = Field(
        None, gt=0, description="unit of 0x6077 is a thousandth of it (0x6076)"
    )
    torque_source: Literal["auto", "torque", "current"] = Field(
        "auto", description="source of the motor torque: 0x6077, or 0x6078 and the constant"
    )
    current_object: str | None = Field(None, description='vendor object for the current, e.g. "0x30D1:02"')
    current_unit_a: float = Field(0.001, gt=0, description="amperes per count of current_object")
    velocity: bool = Field(
        False, description="also map 0x606C (the robust mode differentiates positions itself)"
    )
    velocity_rad_s_per_count: float | None = Field(
        None, gt=0, description="unit of 0x606C at the motor shaft, where 0x60A9 does not give it"
    )
    checks: tuple[Literal["velocity", "current", "following_error"], ...] = Field(
        (), description="also map these, for cross-checks"
    )
    second_encoder: str | None = Field(
        None, description='position of a second encoder of the motor, for a cross-check, e.g. "0x60E4:02"'
    )
    direction: Direction = Field(1, description="sign of the motor position against the joint's")
    torque_direction: Direction | None = Field(
        None, description="sign of the torque; left out: like direction"
    )
    eds: str | None = Field(None, description="EDS or DCF file, relative to the joint file")
    tpdo: tuple[TpdoSection, ...] = Field(
        (), max_length=512, description="the mapping, where it is not read from the drive"
    )
    heartbeat_ms: int = Field(100, ge=0, le=65535, description="heartbeat requested from the drive; 0: none")


class EncoderSection(_Section):
    """The link encoder."""

    source: Literal["drive", "cia406"] = Field(
        "drive", description="wired to a drive (0x60E4), or a node of its own"
    )
    node_id: int | None = Field(
        None, ge=1, le=127, description="its node; left out with a drive: the first motor's"
    )
    object: str | None = Field(None, description='position object; default "0x60E4:01" or "0x6004:00"')
    counts_per_rev: float | None = Field(
        None, gt=0, description="counts per joint revolution (0x6501 of CiA 406)"
    )
    direction: Direction = Field(1, description="sign against the joint's")
    offset_rad: float = Field(0.0, description="subtracted from the link position")
    eds: str | None = Field(None, description="EDS or DCF file, relative to the joint file")
    tpdo: tuple[TpdoSection, ...] = Field(
        (), max_length=512, description="the mapping, where it is not read from the node"
    )

    @model_validator(mode="after")
    def _node(self) -> Self:
        if self.source == "cia406" and self.node_id is None:
            raise ValueError('node_id: expected the encoder\'s node id with source = "cia406"')
        return self


class MotorSection(_Section):
    """One motor and its transmission, reflected to the joint side."""

    inertia_kg_m2: float = Field(gt=0, description="B of eqs 5, 7, joint side")
    inertia_std_relative: float | None = Field(
        None, gt=0, le=1, description="relative standard deviation of the inertia; default 0.05"
    )
    viscous_damping_nm_s_rad: float = Field(0.0, ge=0, description="D_theta of eqs 5, 7, joint side")
    viscous_damping_std_nm_s_rad: float | None = Field(
        None, ge=0, description="standard deviation of the damping, as `fit` writes it"
    )
    transmission: Transmission = Field(
        default_factory=Transmission, description="model of the flexibility torque"
    )
    effect: _Effects = Field((), max_length=MOST_EFFECTS, description="effects the model has been given")
    drive: DriveSection | None = Field(None, description="needed by run, sim, record and doctor")

    @model_validator(mode="after")
    def _parameters_can_be(self) -> MotorSection:
        transmission_model(self.transmission)
        return self

    def motor(self) -> Motor:
        """Return the motor of the estimator's model."""
        drive = self.drive
        return Motor(
            inertia_kg_m2=self.inertia_kg_m2,
            viscous_damping_nm_s_rad=self.viscous_damping_nm_s_rad,
            transmission=self.transmission,
            effects=self.effect,
            gear_ratio=drive.gear_ratio if drive and "gear_ratio" in drive.model_fields_set else None,
            inertia_std_relative=self.inertia_std_relative,
            viscous_damping_std_nm_s_rad=self.viscous_damping_std_nm_s_rad,
        )


class LinkSection(_Section):
    """The link side."""

    encoder: EncoderSection | None = Field(None, description="the link encoder")
    dynamics: LinkDynamics | None = Field(
        None, description="needed for the external torque and residual (eq 12)"
    )
    effect: _Effects = Field((), max_length=MOST_EFFECTS, description="effects at the link or in its encoder")


class BusSection(_Section):
    """The CAN bus and the cycle on it."""

    interface: str = Field(
        "virtual", description="python-can interface: socketcan, slcan, socketcand, virtual, …"
    )
    channel: str = Field("drivelink", description="python-can channel, e.g. can0")
    bitrate: int = Field(1_000_000, gt=0, description="bit/s; the bus load is computed with it")
    options: dict[str, Any] = Field(default_factory=dict, description="passed to can.Bus as they are")
    period_s: float = Field(
        0.001,
        ge=1e-4,
        le=1.0,
        description="communication cycle: one SYNC, one sample; when following and left out: measured",
    )
    sync: Literal["produce", "follow"] = Field(
        "produce", description="produce SYNC, or follow another master's"
    )
    sync_counter_overflow: int = Field(0, ge=0, le=240, description="0x1019: 0, or 2 to 240")
    configure: bool = Field(True, description="configure the nodes; false: passive, never sends a frame")
    sdo_timeout_s: float = Field(0.5, gt=0, description="for each SDO transfer")
    sdo_retries: int = Field(1, ge=0, description="further attempts after an SDO timeout")
    read_back_s: float = Field(
        2.0, ge=0, description="between two SDO uploads that check units and mapped values; 0: none"
    )

    def moved(self, interface: str | None = None, channel: str | None = None) -> BusSection:
        """Return the section with another interface or channel, if given.

        `options` are dropped for another interface.
        """
        changes: dict[str, Any] = {}
        if channel:
            changes["channel"] = channel
        if interface and interface != self.interface:
            changes |= {"interface": interface, "options": {}}
        return self.model_copy(update=changes)


class ColumnSection(_Section):
    """Where one of our columns comes from in a plant's own CSV files."""

    name: str = Field(min_length=1, description="of the column in the file")
    unit: str | float = Field("", description="of its numbers, or a factor; left out: that of our name")
    sign: Direction = Field(1, description="against the joint's")


class RecordingSection(_Section):
    """How recordings are read, and what the black box keeps."""

    scale: dict[str, float] = Field(
        default_factory=dict,
        description="factors of columns, e.g. { link_position_rad = -1, motor1_torque_nm = 0.001 }",
    )
    columns: dict[str, ColumnSection] = Field(
        default_factory=dict,
        description='columns of other names: link_position_rad = { name = "q", unit = "deg", sign = -1 }',
    )
    folder: str | None = Field(
        None,
        min_length=1,
        description="where the black box keeps what led to an event; left out: no black box",
    )
    keep_s: float = Field(60.0, ge=1.0, le=600.0, description="time before an event that is kept")
    keep_mib: float = Field(1024.0, gt=0.0, description="disk for it; the oldest is dropped")
    keep_contacts: bool = Field(False, description="keep what led to a contact, too")

    @model_validator(mode="after")
    def _columns(self) -> Self:
        for key, names in (("scale", self.scale), ("columns", self.columns)):
            if unknown := set(names) - COLUMNS:
                raise ValueError(
                    f'{key}: expected names of columns like "motor1_position_rad", got "{min(unknown)}"'
                )
        for name, column in self.columns.items():
            with raised_as(ValueError, f"columns.{name}.unit", ValueError):
                si_factor(name, column.unit)
        for name, factor in self.scale.items():
            require_in_range("scale", factor)
            if factor == 0.0:
                raise ValueError(f"scale.{name}: expected a factor other than 0")
        return self


class ZenohSection(_Section):
    """Where the estimates go."""

    config: str | None = Field(None, description="zenoh configuration (JSON5), relative to the joint file")
    subscriber_config: str | None = Field(
        None, description="that of monitor, record, accept, doctor and the black box; left out: `config`"
    )
    prefix: str = Field(
        "drivelink", pattern=r"^[^*$#?\s/]+(/[^*$#?\s/]+)*$", description="first part of every key"
    )
    endpoint: str = Field("tcp/127.0.0.1:7447", description="where subscribers connect, unless config says")


class Ros2Section(_Section):
    """Publishing for ROS 2 nodes with rmw_zenoh."""

    enabled: bool = Field(True, description="publish JointState, stiffness and diagnostics")
    domain: int = Field(0, ge=0, le=232, description="ROS_DOMAIN_ID")
    namespace: str = Field("", description="namespace of the node and its topics")
    distro: Literal["humble", "jazzy", "kilted"] = Field("jazzy", description="decides the type hashes")
    every: int = Field(1, ge=1, description="publish every n-th cycle")


class MotionSection(_Section):
    """What a motion that `diagnose --motion` designs may reach; left out: what the recordings reach."""

    position_rad: tuple[float, float] | None = Field(
        None, description="of each motor: lowest and highest position, at the joint"
    )
    velocity_rad_s: float | None = Field(None, gt=0, description="largest amount")
    acceleration_rad_s2: float | None = Field(None, gt=0, description="largest amount")
    torque_nm: float | None = Field(None, gt=0, description="largest amount of the motor's torque")

    @model_validator(mode="after")
    def _positions(self) -> Self:
        for value in self.position_rad or ():
            require_in_range("position_rad", value)
        if self.position_rad is not None and not self.position_rad[0] < self.position_rad[1]:
            raise ValueError(f"position_rad: expected [lowest, highest], got {list(self.position_rad)}")
        return self


class SimSection(_Section):
    """The simulated world that `sim` and `demo` put on the bus; `run` never reads it."""

    case: Literal["constant", "quadratic", "vsa-ii"] | None = Field(
        None, description="one of the paper's cases"
    )
    parameters: dict[str, float] = Field(
        default_factory=dict, description="true values that differ from the model's"
    )
    effect: tuple[Effect, ...] = Field((), description="effects of the world that the model may not know")
    excitation: dict[str, Any] = Field(default_factory=dict, description="torque of the rig, see reference")
    quirks: str | None = Field(None, description="vendor profile of the drives")
    seed: int = Field(0, ge=0, description="seed of the sensor noise")

    @model_validator(mode="after")
    def _parameters(self) -> Self:
        require_parameters(self.parameters)
        return self


class JointFile(_Section):
    """A joint, its drives, its bus and its keys."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", description="part of the key expression")
    arrangement: Arrangement = Field("single", description="how the transmissions act on the link")
    axis: Literal["rotary", "linear"] = Field(
        "rotary", description="linear: every rad in a name is a metre, every N·m a newton"
    )
    motor: tuple[MotorSection, ...] = Field(min_length=1, max_length=2, description="one, or two for a VSA")
    link: LinkSection = Field(LinkSection(), description="the link side")
    bus: BusSection = Field(BusSection(), description="the CAN bus")
    recording: RecordingSection = Field(RecordingSection(), description="recordings and the black box")
    estimator: EstimatorSettings = Field(
        default_factory=EstimatorSettings, description="mode, bandwidths, gains"
    )
    zenoh: ZenohSection = Field(ZenohSection(), description="the zenoh side")
    ros2: Ros2Section | None = Field(None, description="publish for ROS 2")
    motion: MotionSection = Field(MotionSection(), description="limits of a designed motion")
    sim: SimSection | None = Field(None, description="the simulated world")
    provenance: dict[str, Any] = Field(
        default_factory=dict,
        description="written by fit and diagnose: when and from what the model was fitted",
    )

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        expected = 1 if self.arrangement == "single" else 2
        if len(self.motor) != expected:
            raise ValueError(
                f"motor: expected {expected} [[motor]] with "
                f'arrangement = "{self.arrangement}", got {len(self.motor)}'
            )
        nodes: list[int | None] = [m.drive.node_id for m in self.motor if m.drive]
        if self.link.encoder and self.link.encoder.source == "cia406":
            nodes.append(self.link.encoder.node_id)
        twice = {node for node in nodes if nodes.count(node) > 1}
        if twice:
            raise ValueError(
                f"node_id: expected a node id of its own for each device, got {twice.pop()} twice"
            )
        return self

    def timed(self, period_s: float) -> JointFile:
        """Return the joint with another period of SYNC, s."""
        return self.model_copy(update={"bus": self.bus.model_copy(update={"period_s": period_s})})

    def model(self) -> JointModel:
        """Return the estimator's model of this joint."""
        entry = self.provenance.get("floor")
        declared = JointModel(
            arrangement=self.arrangement,
            motors=tuple(section.motor() for section in self.motor),
            link=self.link.dynamics,
            link_effects=self.link.effect,
            period_s=self.bus.period_s if "period_s" in self.bus.model_fields_set else None,
        )
        return expecting(declared, ResidualBaseline.from_dict(entry) if isinstance(entry, dict) else None)
