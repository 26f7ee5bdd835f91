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


def key(default: Any, about: str, **limits: Any) -> Any:
    """Return the field of a key that may be left out; `limits` as of pydantic's `Field`."""
    return Field(default, description=about, **limits)


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
    transmission_type: int = key(1, "1 to 240: every so many SYNCs; 254, 255: event-driven", ge=0, le=255)
    default: bool = key(False, "the node has this mapping after every start; false: a master writes it")

    @model_validator(mode="after")
    def _objects(self) -> Self:
        for text in self.objects:
            if not re.fullmatch(r"0x[0-9A-Fa-f]{4}:[0-9A-Fa-f]{2}:\d{1,2}", text):
                raise ValueError(f'expected "0xINDEX:SUB:BITS" like "0x6064:00:32", got "{text}"')
        return self


class DriveSection(_Section):
    """The drive of one motor. Values that the drive reports may be left out."""

    node_id: int = Field(ge=1, le=127, description="CANopen node id")
    counts_per_rev: float | None = key(None, "counts per motor revolution (0x608F)", gt=0)
    gear_ratio: float = key(1.0, "motor revolutions per joint revolution (0x6091)", gt=0)
    torque_constant_nm_a: float | None = key(
        None, "torque at the motor shaft per ampere; turns a current into a torque", gt=0
    )
    rated_current_a: float | None = key(None, "unit of 0x6078 is a thousandth of it (0x6075)", gt=0)
    rated_torque_nm: float | None = key(None, "unit of 0x6077 is a thousandth of it (0x6076)", gt=0)
    torque_source: Literal["auto", "torque", "current"] = key(
        "auto", "source of the motor torque: 0x6077, or 0x6078 and the constant"
    )
    current_object: str | None = key(None, 'vendor object for the current, e.g. "0x30D1:02"')
    current_unit_a: float = key(0.001, "amperes per count of current_object", gt=0)
    velocity: bool = key(False, "also map 0x606C (the robust mode differentiates positions itself)")
    velocity_rad_s_per_count: float | None = key(
        None, "unit of 0x606C at the motor shaft, where 0x60A9 does not give it", gt=0
    )
    checks: tuple[Literal["velocity", "current", "following_error"], ...] = key(
        (), "also map these, for cross-checks"
    )
    second_encoder: str | None = key(
        None, 'position of a second encoder of the motor, for a cross-check, e.g. "0x60E4:02"'
    )
    direction: Direction = key(1, "sign of the motor position against the joint's")
    torque_direction: Direction | None = key(None, "sign of the torque; left out: like direction")
    eds: str | None = key(None, "EDS or DCF file, relative to the joint file")
    tpdo: tuple[TpdoSection, ...] = key(
        (), "the mapping, where it is not read from the drive", max_length=512
    )
    heartbeat_ms: int = key(100, "heartbeat requested from the drive; 0: none", ge=0, le=65535)


class EncoderSection(_Section):
    """The link encoder."""

    source: Literal["drive", "cia406"] = key("drive", "wired to a drive (0x60E4), or a node of its own")
    node_id: int | None = key(None, "its node; left out with a drive: the first motor's", ge=1, le=127)
    object: str | None = key(None, 'position object; default "0x60E4:01" or "0x6004:00"')
    counts_per_rev: float | None = key(None, "counts per joint revolution (0x60E6, CiA 406: 0x6501)", gt=0)
    direction: Direction = key(1, "sign against the joint's")
    offset_rad: float = key(0.0, "subtracted from the link position")
    eds: str | None = key(None, "EDS or DCF file, relative to the joint file")
    tpdo: tuple[TpdoSection, ...] = key((), "the mapping, where it is not read from the node", max_length=512)

    @model_validator(mode="after")
    def _node(self) -> Self:
        if self.source == "cia406" and self.node_id is None:
            raise ValueError('node_id: expected the encoder\'s node id with source = "cia406"')
        return self


class MotorSection(_Section):
    """One motor and its transmission, reflected to the joint side."""

    inertia_kg_m2: float = Field(gt=0, description="B of eqs 5, 7, joint side")
    inertia_std_relative: float | None = key(
        None, "relative standard deviation of the inertia; default 0.05", gt=0, le=1
    )
    viscous_damping_nm_s_rad: float = key(0.0, "D_theta of eqs 5, 7, joint side", ge=0)
    viscous_damping_std_nm_s_rad: float | None = key(
        None, "standard deviation of the damping, as `fit` writes it", ge=0
    )
    transmission: Transmission = Field(
        default_factory=Transmission, description="model of the flexibility torque"
    )
    effect: _Effects = key((), "effects the model has been given", max_length=MOST_EFFECTS)
    drive: DriveSection | None = key(None, "needed by run, sim, record and doctor")

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

    encoder: EncoderSection | None = key(None, "the link encoder")
    dynamics: LinkDynamics | None = key(None, "needed for the external torque and residual (eq 12)")
    effect: _Effects = key((), "effects at the link or in its encoder", max_length=MOST_EFFECTS)


class BusSection(_Section):
    """The CAN bus and the cycle on it."""

    interface: str = key("virtual", "python-can interface: socketcan, slcan, socketcand, virtual, …")
    channel: str = key("drivelink", "python-can channel, e.g. can0")
    bitrate: int = key(1_000_000, "bit/s; the bus load is computed with it", gt=0)
    options: dict[str, Any] = Field(default_factory=dict, description="passed to can.Bus as they are")
    period_s: float = key(
        0.001,
        "communication cycle: one SYNC, one sample; when following and left out: measured",
        ge=1e-4,
        le=1.0,
    )
    sync: Literal["produce", "follow"] = key("produce", "produce SYNC, or follow another master's")
    sync_counter_overflow: int = key(0, "0x1019: 0, or 2 to 240", ge=0, le=240)
    configure: bool = key(True, "configure the nodes; false: passive, never sends a frame")
    sdo_timeout_s: float = key(0.5, "for each SDO transfer", gt=0)
    sdo_retries: int = key(1, "further attempts after an SDO timeout", ge=0)
    read_back_s: float = key(2.0, "between two SDO uploads that check units and mapped values; 0: none", ge=0)

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
    unit: str | float = key("", "of its numbers, or a factor; left out: that of our name")
    sign: Direction = key(1, "against the joint's")


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
    folder: str | None = key(
        None, "where the black box keeps what led to an event; left out: no black box", min_length=1
    )
    keep_s: float = key(60.0, "time before an event that is kept", ge=1.0, le=600.0)
    keep_mib: float = key(1024.0, "disk for it; the oldest is dropped", gt=0.0)
    keep_contacts: bool = key(False, "keep what led to a contact, too")

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

    config: str | None = key(None, "zenoh configuration (JSON5), relative to the joint file")
    subscriber_config: str | None = key(
        None, "that of monitor, record, accept, doctor and the black box; left out: `config`"
    )
    prefix: str = key("drivelink", "first part of every key", pattern=r"^[^*$#?\s/]+(/[^*$#?\s/]+)*$")
    endpoint: str = key("tcp/127.0.0.1:7447", "where subscribers connect, unless config says")


class Ros2Section(_Section):
    """Publishing for ROS 2 nodes with rmw_zenoh."""

    enabled: bool = key(True, "publish JointState, stiffness and diagnostics")
    domain: int = key(0, "ROS_DOMAIN_ID", ge=0, le=232)
    namespace: str = key("", "namespace of the node and its topics")
    distro: Literal["humble", "jazzy", "kilted"] = key("jazzy", "decides the type hashes")
    every: int = key(1, "publish every n-th cycle", ge=1)


class MotionSection(_Section):
    """What a motion that `diagnose --motion` designs may reach; left out: what the recordings reach."""

    position_rad: tuple[float, float] | None = key(
        None, "of each motor: lowest and highest position, at the joint"
    )
    velocity_rad_s: float | None = key(None, "largest amount", gt=0)
    acceleration_rad_s2: float | None = key(None, "largest amount", gt=0)
    torque_nm: float | None = key(None, "largest amount of the motor's torque", gt=0)

    @model_validator(mode="after")
    def _positions(self) -> Self:
        for value in self.position_rad or ():
            require_in_range("position_rad", value)
        if self.position_rad is not None and not self.position_rad[0] < self.position_rad[1]:
            raise ValueError(f"position_rad: expected [lowest, highest], got {list(self.position_rad)}")
        return self


class SimSection(_Section):
    """The simulated world that `sim` and `demo` put on the bus; `run` never reads it."""

    case: Literal["constant", "quadratic", "vsa-ii"] | None = key(None, "one of the paper's cases")
    parameters: dict[str, float] = Field(
        default_factory=dict, description="true values that differ from the model's"
    )
    effect: tuple[Effect, ...] = key((), "effects of the world that the model may not know")
    excitation: dict[str, Any] = Field(default_factory=dict, description="torque of the rig, see reference")
    quirks: str | None = key(None, "vendor profile of the drives")
    seed: int = key(0, "seed of the sensor noise", ge=0)

    @model_validator(mode="after")
    def _parameters(self) -> Self:
        require_parameters(self.parameters)
        return self


class JointFile(_Section):
    """A joint, its drives, its bus and its keys."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", description="part of the key expression")
    arrangement: Arrangement = key("single", "how the transmissions act on the link")
    axis: Literal["rotary", "linear"] = key(
        "rotary", "linear: every rad in a name is a metre, every N·m a newton"
    )
    motor: tuple[MotorSection, ...] = Field(min_length=1, max_length=2, description="one, or two for a VSA")
    link: LinkSection = key(LinkSection(), "the link side")
    bus: BusSection = key(BusSection(), "the CAN bus")
    recording: RecordingSection = key(RecordingSection(), "recordings and the black box")
    estimator: EstimatorSettings = Field(
        default_factory=EstimatorSettings, description="mode, bandwidths, gains"
    )
    zenoh: ZenohSection = key(ZenohSection(), "the zenoh side")
    ros2: Ros2Section | None = key(None, "publish for ROS 2")
    motion: MotionSection = key(MotionSection(), "limits of a designed motion")
    sim: SimSection | None = key(None, "the simulated world")
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
        if twice := {node for node in nodes if nodes.count(node) > 1}:
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
