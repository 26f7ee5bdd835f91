"""Publishes a joint as a ROS 2 node for rmw_zenoh, without a bridge.

Keys, attachment and liveliness tokens follow rmw_zenoh 0.12; payloads are XCDR1. Messages of every cycle have
strings of fixed length only, so each is one precompiled struct with padding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from itertools import count
from struct import Struct
from typing import Any

import xxhash
import zenoh

from drivelink._core import Tick
from drivelink.errors import ZenohError
from drivelink.jointfile import JointFile, Ros2Section
from drivelink.pubsub.session import Stream, one_line
from drivelink.pubsub.wire import EXTERNAL_COLUMNS
from estimator.sample import Estimate, External, ExternalStatus, Status

_DIAGNOSTIC_HASH = "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e"
_TYPES = (  # package, message, and the hash of its definition
    ("sensor_msgs", "JointState", "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"),
    ("std_msgs", "Float64MultiArray", "1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f"),
    ("control_msgs", "DynamicJointState", "18024c98a62697680f581108eeed40b28fb4542fa0ac5a8e36f56c62b6813d26"),
    ("diagnostic_msgs", "DiagnosticArray", _DIAGNOSTIC_HASH),
    ("geometry_msgs", "WrenchStamped", "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77"),
)
TYPE_HASHES = {f"{package}::msg::dds_::{name}_": f"RIHS01_{digest}" for package, name, digest in _TYPES}
_HUMBLE_HASH = "TypeHashNotSupported"
_QOS = "::,10:,:,:,,"  # reliable, volatile, keep last 10
_ENCAPSULATION = b"\x00\x01\x00\x00"  # XCDR1, little-endian; alignment counts after it
_ATTACHMENT = Struct("<qqB16s")  # sequence number, UNIX ns, length of the GID, GID
_NS = 1_000_000_000
_VELOCITY_FILTER_S = 0.005  # filter of the differentiated position, without a measured link velocity
_entities = count()
_FLAGS = (
    ("valid", int(Status.VALID)),
    ("observable", int(Status.OBSERVABLE)),
    ("model_alarm", int(Status.MODEL_ALARM)),
)
_FINDING = ("state", "sentence", "recording", "since", "error")  # of it, in the diagnostics
_OK, _WARN, _ERROR, _STALE = range(4)  # levels of diagnostic_msgs/DiagnosticStatus


class Template:
    """An XCDR1 message of fixed length as one struct, packed with the changing numbers."""

    def __init__(self) -> None:
        self._format = "<4s"
        self._offset = 0
        self._values: list[bytes | int | None] = [_ENCAPSULATION]
        self._changing: list[int] = []

    def number(self, code: str, value: int | None = None) -> Template:
        """Return a number of struct code `code`, aligned to its size; None: variable."""
        size = Struct("<" + code).size
        padding = -self._offset % size
        self._format += f"{padding}x{code}" if padding else code
        self._offset += padding + size
        if value is None:
            self._changing.append(len(self._values))
        self._values.append(value)
        return self

    def text(self, text: str) -> Template:
        """Return a string: its length with the final zero, its bytes, the zero."""
        data = text.encode() + b"\0"
        self.number("I", len(data))
        self._format += f"{len(data)}s"
        self._offset += len(data)
        self._values.append(data)
        return self

    def doubles(self, length: int) -> Template:
        """Return a sequence of variable float64."""
        self.number("I", length)
        for _ in range(length):
            self.number("d")
        return self

    def header(self, frame_id: str) -> Template:
        """Return std_msgs/Header with variable stamp."""
        return self.number("i").number("I").text(frame_id)

    def packer(self) -> Any:
        """Return a function from the variable numbers to the message's bytes."""
        packing, values, changing = Struct(self._format).pack, self._values, self._changing

        def message(*numbers: float) -> bytes:
            filled = values.copy()
            for position, number in zip(changing, numbers, strict=True):
                filled[position] = number  # type: ignore[call-overload]
            return packing(*filled)

        return message


def joint_state(name: str) -> Any:
    """Return the packer of a sensor_msgs/JointState: (s, ns, position, velocity, effort) to bytes."""
    template = Template().header("").number("I", 1).text(name)
    return template.doubles(1).doubles(1).doubles(1).packer()


def stiffness_array(transmissions: int) -> Any:
    """Return the packer of std_msgs/Float64MultiArray, (1 + transmissions, 2): stiffness and
    its standard deviation.

    Row 0 is the joint, then one row per transmission; the labels of the dimensions name rows and columns.
    """
    rows = ["joint", *(f"transmission{i + 1}" for i in range(transmissions))]
    columns = ["stiffness_nm_rad", "stiffness_std_nm_rad"]
    template = Template().number("I", 2)
    template.text(",".join(rows)).number("I", len(rows)).number("I", 2 * len(rows))
    template.text(",".join(columns)).number("I", 2).number("I", 2)
    return template.number("I", 0).doubles(2 * len(rows)).packer()


def dynamic_joint_state(name: str, transmissions: int, linked: bool = False) -> Any:
    """Return the packer of a control_msgs/DynamicJointState: (s, ns, *values of `interfaces`) to bytes."""
    template = Template().header("").number("I", 1).text(name).number("I", 1)
    names = interfaces(transmissions, linked)
    template.number("I", len(names))
    for interface in names:
        template.text(interface)
    return template.doubles(len(names)).packer()


def interfaces(transmissions: int, linked: bool = False) -> tuple[str, ...]:
    """Return interfaces of a joint's DynamicJointState: numbers, flags (1 or 0), numbers of
    each transmission.

    Args:
        linked: with declared link dynamics; adds the external torque at the end.
    """
    numbers = ("flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad")
    own = (f"transmission{i + 1}_{number}" for i in range(transmissions) for number in numbers)
    return (*numbers, *(name for name, _ in _FLAGS), *own, *(EXTERNAL_COLUMNS if linked else ()))


def wrench(frame_id: str) -> Any:
    """Return the packer of a geometry_msgs/WrenchStamped, z the joint's axis: (s, ns, torque) to bytes."""
    template = Template().header(frame_id)
    for fixed in (0, 0, 0, 0, 0, None):
        template.number("d", fixed)
    return template.packer()


def _diagnostic_array(
    stamp_ns: int, level: int, name: str, message: str, hardware: str, values: Mapping[str, str]
) -> bytes:
    """diagnostic_msgs/DiagnosticArray with one status."""
    template = Template().header("").number("I", 1).number("B", level)
    template.text(name).text(message).text(hardware).number("I", len(values))
    for key, value in values.items():
        template.text(key).text(value)
    data: bytes = template.packer()(*divmod(stamp_ns, _NS))
    return data


class _Topic:
    """One publisher of the node: its key, its liveliness token, its attachment."""

    def __init__(self, session: zenoh.Session, node: _Node, topic: str, kind: str) -> None:
        type_hash = _HUMBLE_HASH if node.section.distro == "humble" else TYPE_HASHES[kind]
        key = f"{node.section.domain}/{topic.strip('/')}/{kind}/{type_hash}"
        token = f"{node.token(next(_entities), 'MP')}/{_mangle(topic)}/{kind}/{type_hash}/{_QOS}"
        self._gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        self._sequence = 0
        drop = zenoh.CongestionControl.DROP
        publisher = session.declare_publisher(key, congestion_control=drop, express=True)
        self._stream = Stream(publisher)
        self.entities = (publisher, session.liveliness().declare_token(token))

    @property
    def wanted(self) -> bool:
        """Whether there is a subscriber."""
        return self._stream.wanted

    def put(self, payload: bytes, stamp_ns: int) -> None:
        self._sequence += 1
        self._stream.put(payload, _ATTACHMENT.pack(self._sequence, stamp_ns, 16, self._gid))


class _Node:
    """The node's part of the liveliness tokens; nodes and their entities are numbered through the process."""

    def __init__(self, session: zenoh.Session, section: Ros2Section, name: str) -> None:
        self.section = section
        self.namespace = "/" + section.namespace.strip("/") if section.namespace.strip("/") else ""
        self._zid = str(session.info.zid())
        self._name = name
        self.id = next(_entities)

    def token(self, entity: int, kind: str) -> str:
        """Return the liveliness key of the node ("NN"), or how that of a publisher ("MP") begins."""
        numbers = f"{self.section.domain}/{self._zid}/{self.id}/{entity}"
        return f"@ros2_lv/{numbers}/{kind}/%/{_mangle(self.namespace)}/{self._name}"


class Ros2Publisher:
    """JointState, stiffness and external torque of every n-th cycle, diagnostics once a second.

    Topics: `<namespace>/joint_states`, `<namespace>/<joint>/stiffness`, `<namespace>/dynamic_joint_states`,
    `/diagnostics`; where link dynamics are declared, `<namespace>/<joint>/external_torque`: a wrench about z
    of the frame `<joint>`, of valid cycles only.

    Args:
        session: the daemon's session, which it does not close.

    Raises:
        ZenohError: zenoh refuses a key.
    """

    def __init__(self, session: zenoh.Session, joint: JointFile) -> None:
        section = joint.ros2 or Ros2Section()
        name = "".join(letter if letter.isalnum() else "_" for letter in joint.name)
        node = _Node(session, section, f"drivelink_{name}")
        self._joint = joint.name
        self._every = section.every
        self._period_s = joint.bus.period_s
        self._entities: list[Any] = []
        try:
            self._entities.append(session.liveliness().declare_token(node.token(node.id, "NN")))
            kinds = tuple(TYPE_HASHES)
            self._states = _Topic(session, node, f"{node.namespace}/joint_states", kinds[0])
            self._stiffness = _Topic(session, node, f"{node.namespace}/{name}/stiffness", kinds[1])
            self._dynamic = _Topic(session, node, f"{node.namespace}/dynamic_joint_states", kinds[2])
            self._diagnostics = _Topic(session, node, "/diagnostics", kinds[3])
            self._wrench = None
            if joint.link.dynamics is not None:
                self._wrench = _Topic(session, node, f"{node.namespace}/{name}/external_torque", kinds[4])
        except zenoh.ZError as error:
            raise ZenohError(f"ros2 of joint {joint.name}: {one_line(error)}") from error
        for topic in (self._states, self._stiffness, self._dynamic, self._diagnostics, self._wrench):
            if topic is not None:
                self._entities.extend(topic.entities)
        self._pack_state = joint_state(joint.name)
        self._pack_stiffness = [stiffness_array(transmissions) for transmissions in range(3)]
        linked = self._wrench is not None
        self._pack_dynamic = [dynamic_joint_state(joint.name, count, linked) for count in range(3)]
        self._pack_wrench = wrench(joint.name)
        self._velocity_rad_s = 0.0
        self._before: tuple[int, float] | None = None
        self._reported_ns: int | None = None
        self.latest: Estimate | None = None  # the newest estimate, for diagnostics
        self.finding: Mapping[str, Any] = {}  # what the newest diagnosis found, or empty

    def put_cycle(self, tick: Tick) -> None:
        """Publish one cycle, to topics with a subscriber; cheap enough for the loop."""
        estimate = self.latest = tick.estimate
        sample, stamp_ns = tick.sample, tick.stamp_ns
        if sample is None:
            return
        position = sample.link_position_rad
        if position != position:  # NaN: the transmission is rigid
            position = sample.motor_position_rad[0]
        velocity = self._velocity(sample.sequence, position, sample.link_velocity_rad_s)
        if estimate.sequence % self._every:
            return
        second, ns = divmod(stamp_ns, _NS)
        if self._states.wanted:
            effort = estimate.flexibility_torque_nm
            self._states.put(self._pack_state(second, ns, position, velocity, effort), stamp_ns)
        touch = _touch(tick.external)
        if self._wrench is not None and self._wrench.wanted and touch[2]:  # valid
            self._wrench.put(self._pack_wrench(second, ns, touch[0]), stamp_ns)
        if self._dynamic.wanted:
            values = [*estimate[2:5], *(float(bool(estimate.status & bit)) for _, bit in _FLAGS)]
            for transmission in estimate.transmissions:
                values += transmission[:3]
            if self._wrench is not None:
                values += touch
            packed = self._pack_dynamic[len(estimate.transmissions)](second, ns, *values)
            self._dynamic.put(packed, stamp_ns)
        if self._stiffness.wanted:
            pairs = [estimate.stiffness_nm_rad, estimate.stiffness_std_nm_rad]
            for transmission in estimate.transmissions:
                pairs += transmission[1:3]
            self._stiffness.put(self._pack_stiffness[len(estimate.transmissions)](*pairs), stamp_ns)

    def put_status(self, status: Mapping[str, Any], stamp_ns: int) -> None:
        """Publish diagnostics, at most once a second.

        Args:
            stamp_ns: UNIX time, ns.
        """
        if self._reported_ns is not None and 0 <= stamp_ns - self._reported_ns < _NS:
            return
        self._reported_ns = stamp_ns
        level, message = _judge(self.latest.status if self.latest else 0)
        said = {key: self.finding[key] for key in _FINDING if key in self.finding}
        values = dict(_flat({**status, "finding": said} if said else status))
        if level != _OK and "sentence" in said:
            message += f"; {said['sentence']}"
        name = f"drivelink: {self._joint}"
        payload = _diagnostic_array(stamp_ns, level, name, message, self._joint, values)
        self._diagnostics.put(payload, stamp_ns)

    def close(self) -> None:
        """Leave the ROS graph; may be called twice."""
        while self._entities:
            with suppress(zenoh.ZError):
                self._entities.pop().undeclare()

    def _velocity(self, sequence: int, position: float, measured: float) -> float:
        """Return the measured velocity, or the position behind a differentiating filter, rad/s."""
        before, self._before = self._before, (sequence, position)
        if measured == measured:  # not NaN
            self._velocity_rad_s = measured
        elif before is not None and sequence > before[0]:
            step_s = (sequence - before[0]) * self._period_s
            share = -math.expm1(-step_s / _VELOCITY_FILTER_S)
            change = (position - before[1]) / step_s - self._velocity_rad_s
            self._velocity_rad_s += share * change if math.isfinite(change) else 0.0
        return self._velocity_rad_s


def _touch(external: External | None) -> tuple[float, ...]:
    """Return the values of the external torque's interfaces."""
    if external is None:
        return (math.nan, math.nan, 0.0, 0.0)
    valid, contact = (bool(external.status & bit) for bit in (ExternalStatus.VALID, ExternalStatus.CONTACT))
    return (external.external_torque_nm, external.external_torque_std_nm, float(valid), float(contact))


def _mangle(name: str) -> str:
    """Return a ROS name as one chunk of a zenoh key; an empty one is %."""
    return name.replace("/", "%") or "%"


def _judge(status: int) -> tuple[int, str]:
    """Diagnostic level and message for the status bits of an estimate."""
    flags = Status(status & sum(Status))
    faults = flags & (Status.DRIVE_FAULT | Status.BUS_FAULT)
    alarms = flags & (Status.MODEL_ALARM | Status.INPUT_REJECTED | Status.CHANGED)
    words = ", ".join(str(bit.name).lower() for bit in faults | alarms)
    if faults:
        return _ERROR, words
    if flags & Status.STALE:
        return _STALE, "no fresh measurements"
    if not flags & Status.VALID:
        return _WARN, words or "not valid yet"
    return (_WARN, words) if alarms else (_OK, "valid")


def _flat(document: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested values as pairs of texts, keys joined by dots."""
    pairs: list[tuple[str, str]] = []
    for key, value in document.items():
        name = f"{prefix}{key}"
        pairs += _flat(value, name + ".") if isinstance(value, Mapping) else [(name, str(value))]
    return pairs
