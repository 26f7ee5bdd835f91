"""TLS, mutual TLS and access control, with the configuration files that are shipped as examples."""

import itertools
import os
import shutil
import subprocess
import time
from pathlib import Path

import pytest
import zenoh
from zenohkit import free_endpoint, make_estimate, make_joint, put_estimate, until

import drivelink
from drivelink._core import encode_estimate
from drivelink.doctor.machine import examine_zenoh
from drivelink.doctor.report import Section
from drivelink.errors import ZenohError
from drivelink.jointfile import JointText
from drivelink.notice import Severity
from drivelink.pubsub.clientbase import joints
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_session

OPEN = ("enabled: true,\n    default", "enabled: false,\n    default")  # without access control
EXAMPLES = Path(__file__).parent.parent / "examples" / "zenoh"


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    if shutil.which("openssl") is None:
        pytest.skip("no openssl command on this machine")
    directory = tmp_path_factory.mktemp("certificates")
    command = ["sh", str(EXAMPLES / "certificates.sh"), str(directory)]
    subprocess.run(command, check=True, capture_output=True, env=os.environ | {"LC_ALL": "C"})
    for name in ("ca.key", "daemon.key", "controller.key"):  # readable by their owner only
        assert (directory / name).stat().st_mode & 0o077 == 0
    return directory


@pytest.fixture
def configure(certificates, tmp_path):
    """A function that gives a shipped configuration with this test's port and certificates, and changes."""
    port = free_endpoint().rpartition(":")[2]

    def configuration(name, *changes):
        text = (EXAMPLES / name).read_text(encoding="utf-8")
        changes = (("0.0.0.0:7447", f"127.0.0.1:{port}"), ("localhost:7447", f"localhost:{port}"), *changes)
        for old, new in (*changes, ("certificates/", f"{certificates}/")):
            text = text.replace(old, new)
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return configuration


@pytest.fixture
def serve():
    """A function that starts a daemon's publisher with a configuration."""
    sessions = []

    def start(config):
        joint = make_joint("elbow", "tcp/127.0.0.1:1", f'config = "{config}"')
        sessions.append(open_session(joint.zenoh, Path()))
        return sessions[-1], JointPublisher(sessions[-1], joint)

    yield start
    for session in sessions:
        close_session(session)


def put_until(publisher, condition):
    sequence = itertools.count(1)
    return until(
        lambda: put_estimate(publisher, make_estimate(next(sequence)), time.time_ns()) or condition()
    )


@pytest.mark.parametrize("kind", ["tls", "mtls"])
def test_a_controller_with_the_right_certificates_receives_everything(configure, serve, kind):
    _, publisher = serve(configure(f"daemon-{kind}.json5"))
    publisher.put_status({"state": "running"})
    with drivelink.subscribe("elbow", config=configure(f"controller-{kind}.json5")) as joint:
        put_until(publisher, lambda: joint.valid)
        assert until(lambda: joint.status) == {"state": "running"}
        assert until(lambda: joint.model)["joint"] == "elbow"
        publisher.close()
        until(lambda: joint.state == "gone")  # liveliness comes through, too


def test_a_joint_file_names_the_configuration_of_its_subscribers(configure, serve):
    daemon, controller = (configure(f"{name}-mtls.json5") for name in ("daemon", "controller"))
    _, publisher = serve(daemon)
    joint = make_joint("elbow", "tcp/127.0.0.1:1", f'config = "{daemon}"\nsubscriber_config = "{controller}"')
    source = JointText(joint=joint, text="", folder=Path(), name="elbow.toml")
    assert joints(config=source.zenoh_config) == ["elbow"]
    section = Section("Zenoh")
    assert examine_zenoh(section, joint, Path()) == ["elbow"]
    assert {finding.severity for finding in section.notices} == {Severity.OK, Severity.INFO}
    publisher.close()


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        pytest.param("tls", [("tls/", "tcp/")], id="without TLS"),
        pytest.param("tls", [("ca.pem", "daemon.pem")], id="with another authority"),
        pytest.param("mtls", [("enable_mtls: true,", ""), ("connect_", "// connect_")], id="without its own"),
    ],
)
def test_nobody_else_gets_in(configure, serve, kind, changes):
    serve(configure(f"daemon-{kind}.json5"))
    config = configure(f"controller-{kind}.json5", *changes, ("timeout_ms: 5000", "timeout_ms: 500"))
    with pytest.raises(ZenohError) as error, drivelink.subscribe("elbow", config=config) as joint:
        assert not joint.received  # a link that is refused only after its handshake
        raise ZenohError("refused")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["tls", "mtls"])
def test_the_controllers_certificate_cannot_play_the_daemon(configure, serve, kind):
    """The authority is the right one; the certificate may not serve, and is not good for the host's name."""
    certificate = [(f"daemon.{suffix}", f"controller.{suffix}") for suffix in ("pem", "key")]
    _, publisher = serve(configure(f"daemon-{kind}.json5", *certificate))
    config = configure(f"controller-{kind}.json5", ("timeout_ms: 5000", "timeout_ms: 500"))
    with pytest.raises(ZenohError), drivelink.subscribe("elbow", config=config) as joint:
        for sequence in range(1, 50):
            put_estimate(publisher, make_estimate(sequence), time.time_ns())
            time.sleep(0.01)
        assert not joint.received and joint.status is None and joint.model is None
        raise ZenohError("refused")


@pytest.mark.parametrize("pinned", [True, False])
def test_another_server_of_the_plant_cannot_play_the_daemon(configure, serve, certificates, pinned):
    """Its certificate is of the same authority, may serve, and is good for the same host: only its name differs."""
    shell = (EXAMPLES / "certificates.sh").read_text(encoding="utf-8")
    body = shell[shell.index("new=") : shell.index("openssl req -x509")] + shell[shell.index("issue() {") :]
    body = body[: body.index("issue daemon")] + "issue other serverAuth DNS:other,DNS:localhost"
    subprocess.run(["sh", "-euc", body], cwd=certificates, check=True, capture_output=True)
    certificate = [("daemon.pem", "other.pem"), ("daemon.key", "other.key")]
    _, publisher = serve(configure("daemon-mtls.json5", *certificate))
    change = () if pinned else (OPEN,)
    with drivelink.subscribe("elbow", config=configure("controller-mtls.json5", *change)) as joint:
        if not pinned:  # so the test would see it
            put_until(publisher, lambda: joint.received)
            return
        for sequence in range(1, 50):
            put_estimate(publisher, make_estimate(sequence), time.time_ns())
            time.sleep(0.01)
        assert not joint.received and joint.state == "waiting" and joint.status is None


@pytest.mark.parametrize("controlled", [True, False])
def test_a_controller_can_subscribe_but_not_publish_into_the_daemons_keys(configure, serve, controlled):
    """With access control nothing gets in; without, it does: so the test would see it."""
    change = () if controlled else (OPEN,)
    session, publisher = serve(configure("daemon-mtls.json5", *change))
    heard = session.declare_subscriber(
        "drivelink/**", zenoh.handlers.RingChannel(64), allowed_origin=zenoh.Locality.REMOTE
    )
    with (
        drivelink.subscribe("elbow", config=configure("controller-mtls.json5")) as joint,
        # an intruder with a controller's certificate keeps to no rules of its own
        zenoh.open(zenoh.Config.from_file(configure("controller-mtls.json5", OPEN))) as intruder,
    ):
        put_until(publisher, lambda: joint.valid)
        forged = encode_estimate(make_estimate(999_999), 0)
        for _ in range(20):
            for name in ("estimate", "status", "model"):
                intruder.put(f"drivelink/elbow/{name}", forged)
            time.sleep(0.005)
        if not controlled:
            until(heard.try_recv)
            until(lambda: joint.foreign)
            return
        put_until(publisher, lambda: joint.received > 50)  # whatever was under way has come by now
        assert heard.try_recv() is None
        assert joint.foreign == 0
        assert joint.latest().sequence != 999_999
