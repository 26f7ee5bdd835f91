"""The systemd service: what is written, what systemd says of it, and what is left after uninstall."""

import re
import shutil
import socket
import subprocess
from pathlib import Path

import pytest
from canopenkit import joint_text
from daemonkit import vsa_text

from drivelink import cli
from drivelink.cli import blackbox
from drivelink.jointfile import parse
from drivelink.pubsub.session import FILES
from drivelink.systemd.unit import installation

UNIT = Path("etc/systemd/system/drivelink@elbow.service")
NETWORK = Path("etc/systemd/network/80-drivelink-can0.network")


@pytest.fixture
def joint(tmp_path):
    return written(tmp_path)


def text(interface, channel):
    return joint_text(bus=f'interface = "{interface}"\nchannel = "{channel}"\nbitrate = 500000')


def written(folder, interface="socketcan", channel="can0"):
    path = folder / "elbow.toml"
    path.write_text(text(interface, channel), encoding="utf-8")
    return path


def files_in(root):
    return [path for path in root.rglob("*") if path.is_file()]


def service(*words):
    return cli.main(["service", *map(str, words)])


@pytest.mark.parametrize("moved", [(), ("--channel", "can1")])
def test_install_writes_the_unit_and_the_interface_and_uninstall_leaves_nothing(joint, tmp_path, moved):
    root, channel = tmp_path / "root", moved[1] if moved else "can0"
    for _ in range(2):  # the same again
        assert service("install", joint, "--root", root, *moved) == 0
    unit = (root / UNIT).read_text()
    assert f" run {' '.join([str(joint), *moved])}\n" in unit and f"WorkingDirectory={tmp_path}" in unit
    assert f"After=network.target sys-subsystem-net-devices-{channel}.device" in unit and "{{" not in unit
    network = (root / f"etc/systemd/network/80-drivelink-{channel}.network").read_text()
    assert f"Name={channel}" in network and "BitRate=500000" in network and "RestartSec=100ms" in network
    assert service("uninstall", joint, "--root", root, *moved) == 0
    assert files_in(root) == []
    assert service("install", joint, "--root", root, "--channel", "can 1") == 2


def test_without_systemd_nothing_is_written(joint, monkeypatch, capsys):
    missing = subprocess.CompletedProcess((), 1, "", "no systemd")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    monkeypatch.setattr("subprocess.run", lambda *_, **__: missing)
    monkeypatch.setattr(Path, "write_text", lambda *_, **__: pytest.fail("something was written"))
    assert service("install", joint) == 1
    assert capsys.readouterr().err == "drivelink service: systemctl daemon-reload: no systemd\n"


def test_what_somebody_has_changed_is_replaced_only_when_asked(joint, tmp_path, capsys):
    root = tmp_path / "root"
    service("install", joint, "--root", root)
    (root / UNIT).write_text("mine")
    assert service("install", joint, "--root", root) == 2
    assert "--force replaces it" in capsys.readouterr().err and (root / UNIT).read_text() == "mine"
    assert service("install", joint, "--root", root, "--force") == 0
    assert (root / UNIT).read_text() != "mine"


def test_a_second_joint_on_the_interface_keeps_its_network_file(joint, tmp_path):
    root, other = tmp_path / "root", tmp_path / "knee.toml"
    other.write_text(joint.read_text().replace("elbow", "knee"))
    service("install", joint, "--root", root)
    service("install", other, "--root", root)
    assert service("uninstall", "elbow", "--root", root) == 0
    assert (root / NETWORK).exists() and not (root / UNIT).exists()
    assert service("uninstall", other, "--root", root) == 0
    assert not (root / NETWORK).exists()


def test_a_home_installation_is_let_in_and_keys_come_as_credentials(monkeypatch):
    """The unit sees nothing below /home but these, and they read-only."""
    monkeypatch.setattr("sys.prefix", "/home/eva/venv")
    monkeypatch.setattr("sys.base_prefix", "/home/eva/.pyenv/versions/3.12")
    path = Path("/home/eva/robots/elbow.toml")
    more = {"allow": ["10.0.0.0/24"], "credentials": ["daemon.key=/etc/ssl/private/daemon.key"]}
    made = installation(
        parse(text("slcan", "/dev/ttyACM0")), path, Path("/home/eva/venv/bin/drivelink"), **more
    )
    (unit,) = made.files.values()
    bound = re.findall(r"^BindReadOnlyPaths=(.*)$", unit, re.MULTILINE)
    assert {"/home/eva/venv", "/home/eva/.pyenv/versions/3.12", "/home/eva/robots"} <= set(bound)
    assert "/home/eva/venv/bin" not in bound and "ProtectHome=tmpfs" in unit
    assert "IPAddressAllow=localhost 10.0.0.0/24\n" in unit
    assert "LoadCredential=daemon.key:/etc/ssl/private/daemon.key" in unit
    assert "DeviceAllow=char-ttyACM rw" in unit and "PrivateDevices=yes" not in unit
    assert f"LimitNOFILE={FILES}\n" in unit
    (unit,) = installation(parse(text("slcan", "x")), Path("/tmp/try/elbow.toml"), path).files.values()
    assert "BindReadOnlyPaths=/tmp/try\n" in unit and "PrivateTmp=yes" in unit


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
@pytest.mark.parametrize(("interface", "channel"), [("socketcan", "can0"), ("slcan", "/dev/ttyACM0")])
def test_systemd_finds_the_unit_right_and_little_exposed(tmp_path, interface, channel):
    """At most 1.4 of 10, with what a daemon needs: real-time scheduling, CAN and IP sockets."""
    path = written(tmp_path, interface, channel)
    service("install", path, "--root", tmp_path, "--credential", f"key={path}")
    for words in (["verify", "--man=no"], ["security", "--offline=true", "--threshold=14"]):
        command = ["systemd-analyze", *words, str(tmp_path / UNIT)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
    level = re.search(r"exposure level .*: ([\d.]+)", done.stdout)
    assert level is not None and float(level[1]) <= 1.4


def test_a_black_box_is_written_where_the_joint_file_says(joint, tmp_path):
    """Confined under a user of its own the service could write nowhere: nothing was ever kept."""
    joint.write_text(joint.read_text() + '\n[recording]\nfolder = "kept"\n')
    assert service("install", joint, "--root", tmp_path / "root") == 0
    unit = (tmp_path / "root" / UNIT).read_text()
    assert f"\nBindPaths={tmp_path}/kept\n" in unit and (tmp_path / "kept").is_dir()
    owner = tmp_path.stat()
    command = ["systemd-analyze", "verify", "--man=no", str(tmp_path / "root" / UNIT)]
    assert shutil.which(command[0]) is None or subprocess.run(command, check=False).returncode == 0
    assert f"\nUser={owner.st_uid}\nGroup={owner.st_gid}\n" in unit and "DynamicUser" not in unit


def test_a_service_that_is_stopped_waits_for_its_black_box(tmp_path, monkeypatch):
    """It writes what is pending for up to a minute; the unit's limit is five seconds."""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setattr(
        blackbox, "_start", lambda _command, *, quiet: subprocess.Popen(["cat"], stdin=subprocess.PIPE)
    )
    joint = parse(vsa_text() + '[recording]\nfolder = "kept"\n')
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(5.0)
        with blackbox.black_box(joint, tmp_path / "elbow.toml"):
            pass
        assert manager.recv(100) == b"EXTEND_TIMEOUT_USEC=60000000"
