"""What a ROS 2 node with rmw_zenoh would find and receive; rosbags is the independent reading of it."""

import itertools
import math
import struct
import sys
import time
from pathlib import Path

import pytest
import xxhash
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh.ext import Int64, z_serialize
from zenohkit import Cycle, free_endpoint, make_external, make_joint, ready, script, until

from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.ros2 import (
    TYPE_HASHES,
    Ros2Publisher,
    dynamic_joint_state,
    interfaces,
    joint_state,
    stiffness_array,
    wrench,
)
from drivelink.pubsub.session import close_session, open_client, open_session
from estimator.sample import Estimate, Sample, Status, TransmissionEstimate

sys.path.append(str(Path(__file__).parents[1] / "examples"))
import ros2_stiffness

STORE = get_typestore(Stores.ROS2_JAZZY)
DYNAMIC_FIELDS = (
    "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values"
)
STORE.register(  # as ros2_control has them
    get_types_from_msg("string[] interface_names\nfloat64[] values", "control_msgs/msg/InterfaceValue")
    | get_types_from_msg(DYNAMIC_FIELDS, "control_msgs/msg/DynamicJointState")
)
STAMP_NS = 1_700_000_000_123_456_789
DYNAMIC = "control_msgs::msg::dds_::DynamicJointState_"
STATE = "sensor_msgs::msg::dds_::JointState_"
ARRAY = "std_msgs::msg::dds_::Float64MultiArray_"
WRENCH = "geometry_msgs::msg::dds_::WrenchStamped_"
DIAGNOSTICS = "diagnostic_msgs::msg::dds_::DiagnosticArray_"
TOPICS = {kind: f"0/{topic}/{kind}" for kind, topic in (
    (STATE, "joint_states"), (ARRAY, "elbow/stiffness"), (DYNAMIC, "dynamic_joint_states"),
    (WRENCH, "elbow/external_torque"), (DIAGNOSTICS, "diagnostics"),
)}  # fmt: skip


def message_of(kind, payload):
    """A message as rosbags reads it, which writes the same bytes."""
    name = kind.replace("::msg::dds_::", "/msg/").rstrip("_")
    assert TYPE_HASHES[kind] == STORE.hash_rihs01(name)
    message = STORE.deserialize_cdr(payload, name)
    assert bytes(STORE.serialize_cdr(message, message.__msgtype__)) == payload
    return message


def stamp_in(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def values_in(message):
    (values,) = message.interface_values
    return dict(zip(values.interface_names, values.values.tolist(), strict=True))


def estimate(sequence=1, status=Status.VALID):
    transmissions = (TransmissionEstimate(9.0, 30.0, 1.0, 0.3), TransmissionEstimate(-10.0, 31.0, 1.5, -0.3))
    return Estimate(sequence, int(status), -1.0, 61.0, 1.75, transmissions)


def sample(sequence=1, position=0.25, velocity=0.5):
    return Sample(sequence, (0.1, 0.2), (0.0, 0.0), (1.0, 2.0), position, velocity)


@pytest.fixture
def ros2():
    """A function that opens a joint with this [ros2] table; and a client of its endpoint."""
    endpoint = free_endpoint()
    sessions = []
    publishers = []  # what is dropped leaves the graph

    def start(table="", name="elbow", link=""):
        joint = make_joint(name, endpoint, f"{link}[ros2]\n{table}")
        if not sessions:
            sessions.append(open_session(joint.zenoh, Path()))
            sessions.append(open_client(endpoint))
            until(lambda: sessions[1].info.peers_zid())
        publishers.append(Ros2Publisher(sessions[0], joint))
        return publishers[-1], sessions[1]

    yield start
    for session in reversed(sessions):
        close_session(session)


def tokens(client, domain=0):
    return sorted(
        str(reply.ok.key_expr)
        for reply in client.liveliness().get(f"@ros2_lv/{domain}/**", timeout=2.0)
        if reply.ok
    )


def receive(client, kind, put):
    subscriber = client.declare_subscriber(
        f"{TOPICS[kind]}/{TYPE_HASHES[kind]}", zenoh.handlers.RingChannel(64)
    )
    return message_of(kind, until(lambda: put() or subscriber.try_recv()).payload.to_bytes())


def putting(publisher, **how):
    return lambda: publisher.put_cycle(Cycle(estimate(**how), sample(), stamp_ns=STAMP_NS))


@pytest.mark.parametrize("name", ["e", "el", "elb", "elbo", "elbow", "elbow6", "elbow_7", "elbow_78"])
def test_messages_are_the_bytes_that_rosbags_writes_whatever_the_alignment(name):
    message = message_of(STATE, joint_state(name)(7, 8, 0.25, 0.5, -1.0))
    assert (stamp_in(message), message.name) == (7 * 10**9 + 8, [name])
    assert [x.tolist() for x in (message.position, message.velocity, message.effort)] == [
        [0.25],
        [0.5],
        [-1.0],
    ]
    message = message_of(WRENCH, wrench(name)(7, 8, -1.5))
    torque = message.wrench.torque
    assert (stamp_in(message), message.header.frame_id) == (7 * 10**9 + 8, name)
    assert (torque.x, torque.y, torque.z, message.wrench.force.z) == (0.0, 0.0, -1.5, 0.0)
    for transmissions in (0, 1, 2):
        numbers = [float(n) for n in range(6 + 3 * transmissions)]
        message = message_of(DYNAMIC, dynamic_joint_state(name, transmissions)(7, 8, *numbers))
        assert (stamp_in(message), message.joint_names) == (7 * 10**9 + 8, [name])
        assert values_in(message) == dict(zip(interfaces(transmissions), numbers, strict=True))


@pytest.mark.parametrize("transmissions", [0, 1, 2])
def test_stiffness_is_a_labelled_matrix(transmissions):
    numbers = [float(n) for n in range(2 + 2 * transmissions)]
    message = message_of(ARRAY, stiffness_array(transmissions)(*numbers))
    rows, columns = message.layout.dim
    assert rows.label.split(",") == ["joint", "transmission1", "transmission2"][: 1 + transmissions]
    assert columns.label.split(",") == ["stiffness_nm_rad", "stiffness_std_nm_rad"]
    assert (rows.size, rows.stride) == (1 + transmissions, len(numbers))
    assert (columns.size, columns.stride, message.layout.data_offset) == (2, 2, 0)
    assert message.data.tolist() == numbers


# The bits of an estimate, whether its stiffness is called valid, and what the example node makes of it.
@pytest.mark.parametrize(
    ("status", "valid", "state"),
    [
        (Status.VALID, 1.0, "live"),
        (Status.OBSERVABLE, 0.0, "invalid"),
        (Status.VALID | Status.MODEL_ALARM, 1.0, "invalid"),
    ],
)
def test_a_stiffness_says_of_which_moment_it_is_and_whether_it_is_valid(ros2, status, valid, state):
    publisher, client = ros2()
    message = receive(client, DYNAMIC, putting(publisher, status=status))
    named = values_in(message)
    assert stamp_in(message) == STAMP_NS and named["valid"] == valid
    assert (named["stiffness_nm_rad"], named["stiffness_std_nm_rad"]) == (61.0, 1.75)
    assert named["transmission2_stiffness_nm_rad"] == 31.0
    stiffness = ros2_stiffness.Stiffness("elbow")
    stiffness.receive(message, 10.0)
    assert stiffness.state(10.0) == state
    assert stiffness.state(10.0 + 2 * ros2_stiffness.STALE_S) == "stale"


def stamp_of(message):
    """The stamp in the attachment of rmw_zenoh, ns."""
    return struct.unpack("<q", message.attachment.to_bytes()[8:16])[0]


def test_the_external_torque_is_a_stamped_wrench_about_z_where_it_is_valid(ros2):
    publisher, client = ros2(link="[link.dynamics]\ninertia_kg_m2 = 0.4\n")
    subscriber = client.declare_subscriber(f"{TOPICS[WRENCH]}/*", zenoh.handlers.RingChannel(64))

    def put(status=3, stamp_ns=STAMP_NS):
        publisher.put_cycle(Cycle(estimate(), sample(), make_external(5, status), stamp_ns))
        return subscriber.try_recv()

    message = message_of(WRENCH, until(put).payload.to_bytes())
    assert (message.wrench.torque.z, stamp_in(message)) == (0.05, STAMP_NS)
    named = values_in(receive(client, DYNAMIC, lambda: put() and None))
    assert (named["external_torque_nm"], named["external_torque_std_nm"]) == (0.05, 0.25)
    assert (named["external_valid"], named["contact"]) == (1.0, 1.0)
    # Of cycles that are not valid, amid others that are: nothing. They arrive in order.
    stamps = [stamp_of(message) for k in range(1, 6) if (message := put(0 if k < 5 else 3, STAMP_NS + k))]
    until(lambda: STAMP_NS + 5 in stamps or stamps.append(stamp_of(until(subscriber.try_recv))))
    assert set(stamps) <= {STAMP_NS, STAMP_NS + 5}


def test_the_graph_shows_one_node_with_four_publishers(ros2):
    _, client = ros2('namespace = "robot/arm"\ndomain = 7')
    until(lambda: len(tokens(client, 7)) == 5)
    node, *publishers = sorted((key.split("/") for key in tokens(client, 7)), key=lambda parts: "MP" in parts)
    root, domain, zid, node_id, entity_id, kind, *names = node
    assert (root, domain, kind, node_id) == ("@ros2_lv", "7", "NN", entity_id)
    assert names == ["%", "%robot%arm", "drivelink_elbow"]
    topics = ("joint_states", "elbow%stiffness", "dynamic_joint_states")
    assert {parts[9] for parts in publishers} == {
        "%diagnostics",
        *(f"%robot%arm%{topic}" for topic in topics),
    }
    for parts in publishers:
        assert parts[:4] == ["@ros2_lv", "7", zid, node_id]
        assert parts[5:9] == ["MP", "%", "%robot%arm", "drivelink_elbow"]
        assert (parts[11], parts[12]) == (TYPE_HASHES[parts[10]], "::,10:,:,:,,")
    ros2("domain = 7\ndistro = 'humble'", name="knee")  # another node, which knows no type hashes
    until(lambda: len(tokens(client, 7)) == 10)
    assert len({tuple(key.split("/")[2:5]) for key in tokens(client, 7)}) == 10
    assert sum("/TypeHashNotSupported/" in key for key in tokens(client, 7)) == 4


def test_the_attachment_carries_sequence_time_and_the_publishers_identity(ros2):
    publisher, client = ros2()
    subscriber = client.declare_subscriber(f"{TOPICS[STATE]}/*", zenoh.handlers.RingChannel(64))
    put = putting(publisher)
    attachment = until(lambda: put() or subscriber.try_recv()).attachment.to_bytes()
    sequence, stamp_ns, length, gid = struct.unpack("<qqB16s", attachment)
    assert attachment == z_serialize((Int64(sequence), Int64(STAMP_NS), gid)).to_bytes()
    assert (stamp_ns, length) == (STAMP_NS, 16) and sequence >= 1
    (token,) = [key for key in tokens(client) if "/%joint_states" in key]
    digest = xxhash.xxh3_128(token.encode()).digest()  # big-endian: high 64 bits, then low
    assert gid == digest[:7:-1] + digest[7::-1]


DIAGNOSED = (  # bits, level, begin of the message
    (Status.VALID, 0, "valid"), (Status(0), 1, "not valid yet"), (Status.VALID | Status.DRIVE_FAULT, 2, "drive_fault"),
    (Status.VALID | Status.STALE, 3, "no fresh"), (Status.VALID | Status.MODEL_ALARM, 1, "model_alarm"),
)  # fmt: skip


def test_diagnostics_come_once_a_second_with_a_level_that_fits_the_status(ros2):
    publisher, client = ros2()
    subscriber = client.declare_subscriber(f"{TOPICS[DIAGNOSTICS]}/**", zenoh.handlers.RingChannel(64))
    seconds = itertools.count(1)

    def begin():
        publisher.put_status({"state": "running"}, next(seconds) * 10**9)
        return subscriber.try_recv()

    until(begin)
    start_ns = next(seconds) * 10**9

    def received():
        """The next one after those of the beginning, which may still be under way."""
        return (found := subscriber.try_recv()) and stamp_of(found) > start_ns and found

    for number, (status, level, words) in enumerate(DIAGNOSED, 1):
        putting(publisher, status=status)()
        for tenth in range(10):
            now_ns = start_ns + number * 10**9 + tenth * 10**8
            publisher.put_status({"state": "running", "latency": {"p99_us": 80.5}}, now_ns)
        (said,) = message_of(DIAGNOSTICS, until(received).payload.to_bytes()).status
        assert said.level == level and said.message.startswith(words)
        assert (said.name, said.hardware_id) == ("drivelink: elbow", "elbow")
        assert {pair.key: pair.value for pair in said.values} == {
            "state": "running",
            "latency.p99_us": "80.5",
        }
    assert subscriber.try_recv() is None


def test_every_nth_cycle_only_where_that_is_asked(ros2):
    publisher, client = ros2("every = 10")
    subscriber = client.declare_subscriber(f"{TOPICS[STATE]}/**", zenoh.handlers.RingChannel(64))
    stamps = set()

    def put():
        for sequence in range(1, 41):
            publisher.put_cycle(Cycle(estimate(sequence), sample(sequence), stamp_ns=sequence))
        while (message := subscriber.try_recv()) is not None:
            stamps.add(stamp_of(message))
        return {10, 20, 30, 40} <= stamps

    until(put)
    assert stamps == {10, 20, 30, 40}


def test_a_velocity_that_is_not_measured_is_the_filtered_change_of_position(ros2):
    """A steady 2 rad/s comes out to the filter's settling, e^-20 after 100 ms."""
    publisher, client = ros2()
    put = lambda k: publisher.put_cycle(Cycle(estimate(k), sample(k, 0.002 * k, math.nan), stamp_ns=STAMP_NS))  # noqa: E731
    for sequence in range(1, 101):
        put(sequence)
    subscriber = client.declare_subscriber(f"{TOPICS[STATE]}/*", zenoh.handlers.RingChannel(64))

    def last():  # those before it may still be under way
        put(101)
        state = subscriber.try_recv()
        message = state and message_of(STATE, state.payload.to_bytes())
        return message if message and message.position[0] == 0.202 else None

    assert until(last).velocity[0] == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(
    ("table", "served"), [("", False), ("[ros2]\nenabled = false\n", False), ("[ros2]\n", True)]
)
def test_the_joints_publisher_serves_ros_where_the_joint_file_asks_for_it(table, served):
    joint = make_joint("elbow", free_endpoint(), table)
    session = open_session(joint.zenoh, Path())
    try:
        publisher = JointPublisher(session, joint)
        assert bool(tokens(session)) == served
        subscriber, topics = session.declare_subscriber("0/**", zenoh.handlers.RingChannel(64)), set()

        def all_topics():  # a late subscriber gets the next cycle
            publisher.put(Cycle(estimate(), sample(), stamp_ns=STAMP_NS))
            publisher.put_status({"state": "running"})
            while (received := subscriber.try_recv()) is not None:
                topics.add(str(received.key_expr).rpartition("/")[0])
            return len(topics) == 4

        if served:
            until(all_topics)
            assert topics == {topic for kind, topic in TOPICS.items() if kind != WRENCH}
        publisher.close()
    finally:
        close_session(session)


def test_when_the_daemon_is_killed_the_example_node_sees_it_and_the_graph_is_empty():
    endpoint = free_endpoint()
    client = open_client(endpoint)
    subscriber = client.declare_subscriber(f"{TOPICS[DYNAMIC]}/**", zenoh.handlers.RingChannel(64))
    stiffness = ros2_stiffness.Stiffness("elbow")

    def state():
        while (received := subscriber.try_recv()) is not None:
            stiffness.receive(message_of(DYNAMIC, received.payload.to_bytes()), time.monotonic())
        return stiffness.state(time.monotonic())

    try:
        assert state() == "stale"
        for _ in range(2):  # it comes back, too
            with script("elbow", endpoint, "[ros2]\n") as daemon:
                ready(daemon)
                until(lambda: state() == "live" and stiffness.value_nm_rad(time.monotonic()) == 700.0)
                assert len(tokens(client)) == 5
                daemon.kill()  # SIGKILL
                until(lambda: state() == "stale")
                assert stiffness.value_nm_rad(time.monotonic()) == ros2_stiffness.FALLBACK_NM_RAD
                until(lambda: not tokens(client))  # `ros2 topic info` counts no publisher
    finally:
        close_session(client)
