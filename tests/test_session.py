"""Zenoh sessions between real processes: sharing one endpoint, losing one, safe defaults, clean ends."""

import json
import re
import resource
import socket
import subprocess
import sys
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import pytest
import zenoh
import zenohkit
from daemonkit import served, vsa, vsa_text
from zenohkit import LIMIT_S, joint_text, ready, script, until

from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.errors import ZenohError
from drivelink.jointfile import ZenohSection, fingerprint, parse, read_text
from drivelink.pubsub.clientbase import joints
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import FILES, close_session, daemon_config, one_line, open_client, open_session


@pytest.fixture(scope="module")
def three():
    """The endpoint of the daemons a, b and c, which start at once and all ask for it; and their processes."""
    endpoint = zenohkit.free_endpoint()
    with script("a", endpoint) as a, script("b", endpoint) as b, script("c", endpoint) as c:
        ready(a), ready(b), ready(c)
        yield endpoint, (a, b, c)


def plain_client(endpoint):
    """A client as somebody else would write it: no drivelink in it."""
    connect, scouting = {"endpoints": [endpoint]}, {"multicast": {"enabled": False}}
    text = json.dumps({"mode": "client", "connect": connect, "scouting": scouting})
    return zenoh.open(zenoh.Config.from_json5(text))


def hear(session, expected):
    """Wait until all of these joints have been heard, and no other one meanwhile.

    A sample that a daemon sent before it was killed may come late: then that begins anew.
    """
    joints, subscriber = (
        set(),
        session.declare_subscriber("drivelink/*/estimate", zenoh.handlers.RingChannel(64)),
    )

    def exactly():
        while (sample := subscriber.try_recv()) is not None:
            joints.add(str(sample.key_expr).split("/")[1])
        if not joints <= expected:
            joints.clear()
        return joints == expected

    until(exactly)


@pytest.mark.slow
def test_when_the_first_daemon_is_killed_the_others_are_received_again(endpoint):
    with script("a", endpoint) as a:
        ready(a)
        with script("b", endpoint) as b, script("c", endpoint) as c, plain_client(endpoint) as session:
            ready(b), ready(c)
            hear(session, {"a", "b", "c"})
            a.kill()
            a.wait()
            hear(session, {"b", "c"})
            with script("a", endpoint) as again:  # and the dead one may come back
                ready(again)
                hear(session, {"a", "b", "c"})


def test_daemons_that_start_before_any_of_them_listens_still_meet(three):
    with plain_client(three[0]) as session:
        hear(session, {"a", "b", "c"})


def test_nothing_listens_beyond_the_loopback_and_nothing_is_multicast(three):
    endpoint, processes = three
    config = daemon_config(endpoint, listen=True)
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("adminspace/enabled")) is False
    local = set()
    for process in processes:
        proc = Path(f"/proc/{process.pid}")
        inodes = {link.readlink().name for link in (proc / "fd").iterdir() if link.exists()}
        for table in ("tcp", "tcp6", "udp", "udp6"):
            rows = map(str.split, (proc / "net" / table).read_text().splitlines()[1:])
            local |= {row[1].split(":")[0] for row in rows if f"socket:[{row[9]}]" in inodes}
    assert local == {"0100007F"}  # 127.0.0.1 only, UDP included


def test_of_two_daemons_that_start_at_once_with_one_name_one_stays(endpoint):
    with script("elbow", endpoint) as one, script("elbow", endpoint) as other:
        until(lambda: one.poll() is not None or other.poll() is not None)
        stays = other if one.poll() is not None else one
        ready(stays)
        assert stays.poll() is None


@pytest.mark.parametrize(("other", "stays"), [("0", False), ("g", True)])
def test_of_two_daemons_that_have_not_seen_each_other_the_one_with_the_smaller_id_stays(
    other, stays, endpoint, monkeypatch
):
    met = iter([[], [f"drivelink/elbow/alive/{other}"]])
    monkeypatch.setattr(JointPublisher, "_served", lambda _self: next(met))
    refused = pytest.raises(ZenohError, match="another daemon already serves")
    section = ZenohSection(endpoint=endpoint)
    with closing(open_session(section, Path())) as session, nullcontext() if stays else refused:
        JointPublisher(session, parse(joint_text("elbow", endpoint)))


def test_all_daemons_are_met_before_anybody_is_asked(three):
    endpoint, _ = three
    for name in "ac":
        assert joints(endpoint=endpoint) == ["a", "b", "c"]
        with (
            closing(open_session(ZenohSection(endpoint=endpoint), Path())) as session,
            pytest.raises(ZenohError, match=f"another daemon already serves a joint named {name}"),
        ):
            JointPublisher(session, parse(joint_text(name, endpoint)))


def test_an_uncaught_exception_ends_the_process(endpoint):
    with script("elbow", endpoint, "", "raise") as process:
        _, error = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 1
    assert error.endswith("RuntimeError: uncaught\n")


def test_a_client_that_forgets_to_close_ends_too(endpoint):
    code = f"""import atexit, threading
atexit.register(lambda: print([t.name for t in threading.enumerate() if "drivelink" in t.name]))  # called last
import drivelink
joint = drivelink.subscribe("elbow", endpoint="{endpoint}")
joint.wait(0.05); joint.status
raise RuntimeError("uncaught")
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == 1 and done.stderr.endswith("RuntimeError: uncaught\n")
    assert done.stdout == "[]\n"  # a thread that comes out of zenoh now would abort the process


def test_another_program_on_the_endpoint_is_one_line(endpoint, monkeypatch):
    monkeypatch.setattr("drivelink.pubsub.session._MEETING_S", 0.3)
    port = int(endpoint.rpartition(":")[2])
    with socket.create_server(("127.0.0.1", port)), pytest.raises(ZenohError) as error:
        open_session(ZenohSection(endpoint=endpoint), Path())
    assert f"{endpoint}: another program listens there" in str(error.value)


@pytest.mark.parametrize(
    "endpoint", ["nonsense", "tcp", "carrier-pigeon/roof", "tcp/127.0.0.1", "tcp/127.0.0.1:99999"]
)
def test_an_endpoint_that_is_none_is_one_line(endpoint):
    with pytest.raises(ZenohError) as error:
        close_session(open_session(ZenohSection(endpoint=endpoint), Path()))
    assert "\n" not in str(error.value)
    assert endpoint in str(error.value)


@contextmanager
def closing(session):
    yield session
    close_session(session)


@pytest.fixture
def router(endpoint, tmp_path):
    """A function that opens a session with a user's own configuration: a router."""
    (tmp_path / "mine.json5").write_text(
        f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }}, /* a comment */\n'
        '  scouting: { multicast: { enabled: false } }, id: "abcdef0123456789" }'
    )
    return lambda: closing(open_session(ZenohSection(config="mine.json5"), tmp_path))


def test_the_users_configuration_is_passed_through_whole(endpoint, router):
    with router() as session, closing(open_client(endpoint)) as client:
        assert str(session.zid()) == "abcdef0123456789"
        assert until(lambda: [str(zid) for zid in client.info.routers_zid()]) == ["abcdef0123456789"]


@pytest.mark.parametrize("text", [None, "{ mode: ", '{ mode: "spectator" }', "{ no_such_key: 1 }"])
def test_a_configuration_that_cannot_be_used_is_one_line_with_its_file(tmp_path, text):
    if text is not None:
        (tmp_path / "mine.json5").write_text(text)
    with pytest.raises(ZenohError) as error:
        open_session(ZenohSection(config="mine.json5"), tmp_path)
    assert str(tmp_path / "mine.json5") in str(error.value)
    assert "\n" not in str(error.value)
    assert ".rs:" not in str(error.value)


def test_a_joint_file_in_the_place_of_a_configuration_is_one_line_without_its_text(tmp_path):
    (tmp_path / "elbow.toml").write_text(zenohkit.joint_text("elbow", "tcp/127.0.0.1:7447"))
    with pytest.raises(ZenohError) as error:
        open_client("tcp/127.0.0.1:7447", tmp_path / "elbow.toml")
    said = f"{tmp_path / 'elbow.toml'}: expected a zenoh configuration (JSON5): unknown field `"
    assert str(error.value).startswith(said) and str(error.value).endswith("`id`, `metadata`, `mode`, …")
    (tmp_path / "mine.json5").write_text('{\n mode: "spectator" }')
    with pytest.raises(ZenohError, match=r"expected one of `router`, `peer`, `client`, line 2$"):
        open_client("tcp/127.0.0.1:7447", tmp_path / "mine.json5")


def test_where_nobody_answers_the_line_is_ours(endpoint, tmp_path):
    text = f'{{ mode: "client", connect: {{ endpoints: ["{endpoint}"] }} }}'
    (tmp_path / "mine.json5").write_text(text)
    with pytest.raises(ZenohError, match=f"nobody answers at {re.escape(endpoint)}$"):
        open_client(endpoint, tmp_path / "mine.json5")


def test_who_refuses_a_certificate_may_be_there():
    text = one_line(zenoh.ZError("Unable to connect to any of [Single(tls/localhost:7447)]!"))
    assert text == "nobody answers at tls/localhost:7447, or not to this certificate"


def test_a_certificate_that_is_missing_is_one_line_with_its_key(tmp_path):
    text = '{ transport: { link: { tls: { root_ca_certificate: "nosuch/ca.pem" } } } }'
    (tmp_path / "mine.json5").write_text(text)
    with pytest.raises(ZenohError, match=r"link\.tls\.root_ca_certificate: .*there is no nosuch/ca\.pem$"):
        open_session(ZenohSection(config="mine.json5"), tmp_path)


def test_where_a_router_was_no_daemon_takes_its_place(endpoint, router):
    with ExitStack() as stack:
        with router():
            daemon = stack.enter_context(closing(open_session(ZenohSection(endpoint=endpoint), Path())))
            until(lambda: daemon.info.routers_zid())
        until(lambda: not daemon.info.routers_zid())
        with router():  # fails if the endpoint is taken
            until(lambda: daemon.info.routers_zid())


def test_a_daemon_says_that_its_router_is_lost_and_back(endpoint, router):
    joint = vsa(endpoint=endpoint)
    with ExitStack() as stack:
        stack.enter_context(served(joint))
        with router():
            daemon = stack.enter_context(Daemon([ServedJoint(joint=joint)], real_time=False))
        until(lambda: "zenoh router is lost" in daemon.events.active.get("router", ""))
        with router():
            until(lambda: not daemon.events.active)
    assert [event["text"] for event in daemon.events.recent()][-1] == "the zenoh router is back"


def test_of_two_daemons_that_a_router_joins_later_each_says_that_there_is_another(endpoint, router, tmp_path):
    alone = '{ mode: "peer", scouting: { multicast: { enabled: false } }, '
    wait = f'connect: {{ endpoints: ["{endpoint}"], timeout_ms: -1, exit_on_failure: false }} }}'
    (tmp_path / "alone.json5").write_text(alone + wait)
    joint = vsa().model_copy(update={"zenoh": ZenohSection(config="alone.json5")})
    with ExitStack() as stack:
        stack.enter_context(served(joint))
        (path := tmp_path / "j.toml").write_text(vsa_text(), encoding="utf-8")
        known = fingerprint(read_text(path))
        daemon = stack.enter_context(
            Daemon([ServedJoint(joint=joint, path=path, fingerprint=known)], real_time=False)
        )
        session = stack.enter_context(closing(open_session(joint.zenoh, tmp_path)))
        rival = JointPublisher(session, joint)  # neither sees the other
        assert not daemon.events.active
        with router():
            (text,) = until(lambda: list(daemon.events.active.values()))
            assert text.startswith("another daemon serves a joint named elbow, too")
            assert not daemon.events.of("wrist").active  # that of another joint on the bus
            rival.close()
            until(lambda: not daemon.events.active)
            assert daemon.events.recent()[-1]["text"] == "no other daemon serves a joint named elbow any more"


def test_connections_that_say_nothing_lock_no_subscriber_out(three):
    """Each waits for its handshake; more than may wait at a time would make a subscriber wait, too."""
    endpoint, daemons = three
    idle, (mine, permitted) = 1200, resource.getrlimit(resource.RLIMIT_NOFILE)
    for daemon in daemons:
        limits = Path(f"/proc/{daemon.pid}/limits").read_text(encoding="ascii")
        files = next(line for line in limits.splitlines() if line.startswith("Max open files"))
        assert int(files.split()[3]) >= min(8192, permitted if permitted > 0 else 8192)
    waiting = json.loads(daemon_config(endpoint, listen=True).get_json("transport/unicast"))
    assert idle < waiting["accept_pending"] < FILES
    assert waiting["accept_timeout"] == 2000  # ms; zenoh's own ten seconds would keep their files
    host, port = endpoint.removeprefix("tcp/").split(":")
    with ExitStack() as stack:
        for _ in range(min(idle, mine - 200)):
            last = stack.enter_context(socket.create_connection((host, int(port))))
        with open_client(endpoint) as session:
            hear(session, {"a", "b", "c"})
        last.settimeout(LIMIT_S)
        assert last.recv(1) == b""


@pytest.mark.parametrize("command", [["run", "elbow.toml", "--interface", "socketcand"], ["monitor"]])
def test_where_too_few_files_may_be_open_it_is_one_line_before_zenoh(command, tmp_path):
    """Zenoh ended the process by a backtrace."""
    (tmp_path / "elbow.toml").write_text(vsa_text())
    ran = subprocess.run(
        ["sh", "-c", 'ulimit -n 20; exec "$@"', "sh", sys.executable, "-m", "drivelink", *command],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert (ran.returncode, ran.stderr.count("\n")) == (6, 1), ran.stderr
    assert "open files: expected a limit of at least 64, got 20: ulimit -n 8192" in ran.stderr
