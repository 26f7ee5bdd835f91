"""What a ROS 2 node with rmw_zenoh would find and receive; rosbags is the independent reading of it."""

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
STORE.register(  # as ros2_control has them
    get_types_from_msg("string[] interface_names\nfloat64[] values", "control_msgs/msg/InterfaceValue")
    | get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values",
        "control_msgs/msg/DynamicJointState",
    )
)
DYNAMIC = "control_msgs::msg::dds_::DynamicJointState_"
STAMP_NS = 1_700_000_000_123_456_789
STATE = "sensor_msgs::msg::dds_::JointState_"
ARRAY = "std_msgs::msg::dds_::Float64MultiArray_"
WRENCH = "geometry_msgs::msg::dds_::WrenchStamped_"
LINKED = "[link.dynamics]\ninertia_kg_m2 = 0.4\n"
DIAGNOSTICS = "diagnostic_msgs::msg::dds_::DiagnosticArray_"


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


def receive(client, key, put):
    subscriber = client.declare_subscriber(key, zenoh.handlers.RingChannel(64))
    return until(lambda: put() or subscriber.try_recv())


@pytest.mark.parametrize("kind", TYPE_HASHES)
def test_type_hashes_are_those_that_rosbags_computes(kind):
    name = kind.replace("::msg::dds_::", "/msg/").rstrip("_")
    assert TYPE_HASHES[kind] == STORE.hash_rihs01(name)


@pytest.mark.parametrize("name", ["e", "el", "elb", "elbo", "elbow", "elbow6", "elbow_7", "elbow_78"])
def test_joint_states_are_the_bytes_that_rosbags_writes_whatever_the_alignment(name):
    payload = joint_state(name)(7, 8, 0.25, 0.5, -1.0)
    message = STORE.deserialize_cdr(payload, "sensor_msgs/msg/JointState")
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7, 8)
    assert message.name == [name]
    assert message.position.tolist() == [0.25]
    assert message.velocity.tolist() == [0.5]
    assert message.effort.tolist() == [-1.0]
    assert bytes(STORE.serialize_cdr(message, message.__msgtype__)) == payload


@pytest.mark.parametrize("transmissions", [0, 1, 2])
def test_stiffness_is_a_labelled_matrix(transmissions):
    numbers = [float(n) for n in range(2 + 2 * transmissions)]
    payload = stiffness_array(transmissions)(*numbers)
    message = STORE.deserialize_cdr(payload, "std_msgs/msg/Float64MultiArray")
    rows, columns = message.layout.dim
    assert rows.label.split(",") == ["joint", "transmission1", "transmission2"][: 1 + transmissions]
    assert columns.label.split(",") == ["stiffness_nm_rad", "stiffness_std_nm_rad"]
    assert (rows.size, rows.stride) == (1 + transmissions, len(numbers))
    assert (columns.size, columns.stride, message.layout.data_offset) == (2, 2, 0)
    assert message.data.tolist() == numbers
    assert bytes(STORE.serialize_cdr(message, message.__msgtype__)) == payload


@pytest.mark.parametrize("transmissions", [0, 1, 2])
@pytest.mark.parametrize("name", ["e", "elbow", "elbow_7"])
def test_stiffness_comes_with_stamp_and_validity_in_the_message_of_ros2_control(name, transmissions):
    numbers = [float(n) for n in range(6 + 3 * transmissions)]
    payload = dynamic_joint_state(name, transmissions)(7, 8, *numbers)
    message = STORE.deserialize_cdr(payload, "control_msgs/msg/DynamicJointState")
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.joint_names) == (7, 8, [name])
    (values,) = message.interface_values
    assert tuple(values.interface_names) == interfaces(transmissions)
    assert values.values.tolist() == numbers
    assert bytes(STORE.serialize_cdr(message, message.__msgtype__)) == payload


@pytest.mark.parametrize(("status", "valid"), [(Status.VALID, 1.0), (Status.OBSERVABLE, 0.0)])
def test_a_stiffness_says_of_which_moment_it_is_and_whether_it_is_valid(ros2, status, valid):
    publisher, client = ros2()
    put = lambda: publisher.put_cycle(Cycle(estimate(status=status), sample(), stamp_ns=STAMP_NS))  # noqa: E731
    key = f"0/dynamic_joint_states/{DYNAMIC}/{TYPE_HASHES[DYNAMIC]}"
    message = STORE.deserialize_cdr(
        receive(client, key, put).payload.to_bytes(), "control_msgs/msg/DynamicJointState"
    )
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP_NS
    (values,) = message.interface_values
    received = dict(zip(values.interface_names, values.values.tolist(), strict=True))
    assert (received["stiffness_nm_rad"], received["stiffness_std_nm_rad"], received["valid"]) == (
        61.0,
        1.75,
        valid,
    )
    assert received["transmission2_stiffness_nm_rad"] == 31.0


def test_a_cycle_arrives_where_a_ros_node_listens(ros2):
    publisher, client = ros2()
    put = lambda: publisher.put_cycle(Cycle(estimate(), sample(), stamp_ns=STAMP_NS))  # noqa: E731
    state = receive(client, f"0/joint_states/{STATE}/{TYPE_HASHES[STATE]}", put)
    message = STORE.deserialize_cdr(state.payload.to_bytes(), "sensor_msgs/msg/JointState")
    assert message.name == ["elbow"]
    assert (message.position[0], message.velocity[0], message.effort[0]) == (0.25, 0.5, -1.0)
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP_NS
    array = receive(client, f"0/elbow/stiffness/{ARRAY}/{TYPE_HASHES[ARRAY]}", put)
    message = STORE.deserialize_cdr(array.payload.to_bytes(), "std_msgs/msg/Float64MultiArray")
    assert message.data.reshape(3, 2).tolist() == [[61.0, 1.75], [30.0, 1.0], [31.0, 1.5]]


@pytest.mark.parametrize("name", ["e", "el", "elbow", "elbow_7"])
def test_a_wrench_is_the_bytes_that_rosbags_writes_whatever_the_alignment(name):
    payload = wrench(name)(7, 8, -1.5)
    message = STORE.deserialize_cdr(payload, "geometry_msgs/msg/WrenchStamped")
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (7, 8, name)
    torque = message.wrench.torque
    assert (torque.x, torque.y, torque.z, message.wrench.force.z) == (0.0, 0.0, -1.5, 0.0)
    assert bytes(STORE.serialize_cdr(message, message.__msgtype__)) == payload


def stamp_of(message) -> int:
    """The stamp in the attachment of rmw_zenoh, ns."""
    return struct.unpack("<q", message.attachment.to_bytes()[8:16])[0]


def test_the_external_torque_is_a_stamped_wrench_about_z_where_it_is_valid(ros2):
    publisher, client = ros2(link=LINKED)
    key = f"0/elbow/external_torque/{WRENCH}/{TYPE_HASHES[WRENCH]}"
    subscriber = client.declare_subscriber(key, zenoh.handlers.RingChannel(64))

    def put(status=3, stamp_ns=STAMP_NS):
        publisher.put_cycle(Cycle(estimate(), sample(), make_external(5, status), stamp_ns))
        return subscriber.try_recv()

    message = STORE.deserialize_cdr(until(put).payload.to_bytes(), "geometry_msgs/msg/WrenchStamped")
    assert message.wrench.torque.z == 0.05
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == STAMP_NS
    dynamic = client.declare_subscriber(
        f"0/dynamic_joint_states/{DYNAMIC}/{TYPE_HASHES[DYNAMIC]}", zenoh.handlers.RingChannel(64)
    )
    received = until(lambda: put() and dynamic.try_recv())
    (values,) = STORE.deserialize_cdr(
        received.payload.to_bytes(), "control_msgs/msg/DynamicJointState"
    ).interface_values
    named = dict(zip(values.interface_names, values.values.tolist(), strict=True))
    assert (named["external_torque_nm"], named["external_torque_std_nm"]) == (0.05, 0.25)
    assert (named["external_valid"], named["contact"]) == (1.0, 1.0)
    # Of cycles that are not valid, amid others that are: nothing. They arrive in order.
    stamps = [stamp_of(message) for k in range(1, 6) if (message := put(0 if k < 5 else 3, STAMP_NS + k))]
    until(lambda: STAMP_NS + 5 in stamps or stamps.append(stamp_of(until(subscriber.try_recv))))
    assert set(stamps) <= {STAMP_NS, STAMP_NS + 5}


def test_the_graph_shows_one_node_with_four_publishers(ros2):
    _, client = ros2('namespace = "robot/arm"\ndomain = 7')
    until(lambda: len(tokens(client, 7)) == 5)
    node, *publishers = sorted(tokens(client, 7), key=lambda key: "/MP/" in key)
    root, domain, zid, node_id, entity_id, kind, *names = node.split("/")
    assert (root, domain, kind, node_id) == ("@ros2_lv", "7", "NN", entity_id)
    assert names == ["%", "%robot%arm", "drivelink_elbow"]
    assert len(publishers) == 4
    assert {key.split("/")[9] for key in publishers} == {
        "%robot%arm%joint_states",
        "%robot%arm%elbow%stiffness",
        "%robot%arm%dynamic_joint_states",
        "%diagnostics",
    }
    for key in publishers:
        parts = key.split("/")
        assert parts[:4] == ["@ros2_lv", "7", zid, node_id]
        assert parts[5:9] == ["MP", "%", "%robot%arm", "drivelink_elbow"]
        assert parts[11] == TYPE_HASHES[parts[10]]
        assert parts[12] == "::,10:,:,:,,"


def test_two_joints_of_one_session_are_two_nodes(ros2):
    _, client = ros2()
    ros2(name="knee")
    until(lambda: len(tokens(client)) == 10)
    identities = [tuple(key.split("/")[2:5]) for key in tokens(client)]
    assert len(set(identities)) == 10


def test_the_attachment_carries_sequence_time_and_the_publishers_identity(ros2):
    publisher, client = ros2()
    put = lambda: publisher.put_cycle(Cycle(estimate(), sample(), stamp_ns=STAMP_NS))  # noqa: E731
    message = receive(client, f"0/joint_states/{STATE}/*", put)
    attachment = message.attachment.to_bytes()
    sequence, stamp_ns, length, gid = struct.unpack("<qqB16s", attachment)
    assert attachment == z_serialize((Int64(sequence), Int64(STAMP_NS), gid)).to_bytes()
    assert (stamp_ns, length) == (STAMP_NS, 16)
    assert sequence >= 1
    (token,) = [key for key in tokens(client) if "/%joint_states" in key]
    digest = xxhash.xxh3_128(token.encode()).digest()  # big-endian: high 64 bits, then low
    assert gid == digest[:7:-1] + digest[7::-1]


def test_diagnostics_come_once_a_second_with_a_level_that_fits_the_status(ros2):
    publisher, client = ros2()
    subscriber = client.declare_subscriber(f"0/diagnostics/{DIAGNOSTICS}/**", zenoh.handlers.RingChannel(64))
    start_ns = 0

    def begin():
        nonlocal start_ns
        start_ns += 10**9
        publisher.put_status({"state": "running"}, start_ns)
        return subscriber.try_recv()

    until(begin)

    def received():
        """The next one after those of the beginning, which may still be under way."""
        return (found := subscriber.try_recv()) and stamp_of(found) > start_ns and found

    expected = [(Status.VALID, 0, "valid"), (Status(0), 1, "not valid yet")]
    expected += [
        (Status.VALID | Status.DRIVE_FAULT, 2, "drive_fault"),
        (Status.VALID | Status.STALE, 3, "no fresh"),
    ]
    expected += [(Status.VALID | Status.MODEL_ALARM, 1, "model_alarm")]
    for number, (status, level, words) in enumerate(expected, 1):
        publisher.put_cycle(Cycle(estimate(status=status), sample(), stamp_ns=STAMP_NS))
        for tenth in range(10):
            now_ns = start_ns + number * 10**9 + tenth * 10**8
            publisher.put_status({"state": "running", "latency": {"p99_us": 80.5}}, now_ns)
        message = STORE.deserialize_cdr(
            until(received).payload.to_bytes(), "diagnostic_msgs/msg/DiagnosticArray"
        )
        (said,) = message.status
        assert said.level == level
        assert said.message.startswith(words)
        assert (said.name, said.hardware_id) == ("drivelink: elbow", "elbow")
        assert {pair.key: pair.value for pair in said.values} == {
            "state": "running",
            "latency.p99_us": "80.5",
        }
        assert bytes(STORE.serialize_cdr(message, message.__msgtype__))
    assert subscriber.try_recv() is None


def test_humble_knows_no_type_hashes(ros2):
    publisher, client = ros2('distro = "humble"')
    put = lambda: publisher.put_cycle(Cycle(estimate(), sample(), stamp_ns=STAMP_NS))  # noqa: E731
    assert receive(client, f"0/joint_states/{STATE}/TypeHashNotSupported", put)


def test_every_nth_cycle_only_where_that_is_asked(ros2):
    publisher, client = ros2("every = 10")
    subscriber = client.declare_subscriber(f"0/joint_states/{STATE}/**", zenoh.handlers.RingChannel(64))
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
    for sequence in range(1, 101):
        publisher.put_cycle(
            Cycle(estimate(sequence), sample(sequence, 0.002 * sequence, float("nan")), stamp_ns=STAMP_NS)
        )
    subscriber = client.declare_subscriber(f"0/joint_states/{STATE}/*", zenoh.handlers.RingChannel(64))

    def last():  # those before it may still be under way
        publisher.put_cycle(Cycle(estimate(101), sample(101, 0.202, float("nan")), stamp_ns=STAMP_NS))
        state = subscriber.try_recv()
        message = state and STORE.deserialize_cdr(state.payload.to_bytes(), "sensor_msgs/msg/JointState")
        return message if message and message.position[0] == 0.202 else None

    message = until(last)
    assert message.velocity[0] == pytest.approx(2.0, rel=1e-6)


def test_the_joints_publisher_serves_ros_where_the_joint_file_asks_for_it():
    joint = make_joint("elbow", free_endpoint(), "[ros2]\n")
    session = open_session(joint.zenoh, Path())
    try:
        publisher = JointPublisher(session, joint)
        subscriber = session.declare_subscriber("0/**", zenoh.handlers.RingChannel(64))
        topics: set[str] = set()

        def all_topics() -> bool:  # a late subscriber gets the next cycle
            publisher.put(Cycle(estimate(), sample(), stamp_ns=STAMP_NS))
            publisher.put_status({"state": "running"})
            while (received := subscriber.try_recv()) is not None:
                topics.add(str(received.key_expr).rpartition("/")[0])
            return len(topics) == 4

        until(all_topics)
        assert topics == {
            f"0/joint_states/{STATE}",
            f"0/elbow/stiffness/{ARRAY}",
            f"0/dynamic_joint_states/{DYNAMIC}",
            f"0/diagnostics/{DIAGNOSTICS}",
        }
        publisher.close()
    finally:
        close_session(session)


def test_a_joint_without_the_table_or_with_it_switched_off_is_no_ros_node():
    for table in ("", "[ros2]\nenabled = false\n"):
        joint = make_joint("elbow", free_endpoint(), table)
        session = open_session(joint.zenoh, Path())
        try:
            publisher = JointPublisher(session, joint)
            assert not tokens(session)
            publisher.close()
        finally:
            close_session(session)


def test_when_the_daemon_is_killed_the_example_node_sees_it_and_the_graph_is_empty():
    endpoint = free_endpoint()
    client = open_client(endpoint)
    subscriber = client.declare_subscriber(
        f"0/dynamic_joint_states/{DYNAMIC}/**", zenoh.handlers.RingChannel(64)
    )
    stiffness = ros2_stiffness.Stiffness("elbow")

    def state():
        while (received := subscriber.try_recv()) is not None:
            message = STORE.deserialize_cdr(received.payload.to_bytes(), "control_msgs/msg/DynamicJointState")
            stiffness.receive(message, time.monotonic())
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


@pytest.mark.parametrize(
    ("status", "expected"),
    [(Status.VALID, "live"), (Status.OBSERVABLE, "invalid"), (Status.VALID | Status.MODEL_ALARM, "invalid")],
)
def test_the_example_node_uses_what_is_valid_only(ros2, status, expected):
    publisher, client = ros2()
    put = lambda: publisher.put_cycle(Cycle(estimate(status=status), sample(), stamp_ns=STAMP_NS))  # noqa: E731
    received = receive(client, f"0/dynamic_joint_states/{DYNAMIC}/*", put)
    stiffness = ros2_stiffness.Stiffness("elbow")
    message = STORE.deserialize_cdr(received.payload.to_bytes(), "control_msgs/msg/DynamicJointState")
    stiffness.receive(message, 10.0)
    assert stiffness.state(10.0) == expected
    assert stiffness.state(10.0 + 2 * ros2_stiffness.STALE_S) == "stale"
