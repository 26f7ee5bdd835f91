"""The systemd service of a joint: its unit file, and sd_notify(3): ready, stopping, watchdog."""

import ipaddress
import os
import re
import socket
import sys
import sysconfig
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import drivelink
from drivelink.cycle.loop import CycleLoop
from drivelink.errors import UsageError
from drivelink.jointfile import JointFile

UNITS = Path("etc/systemd/system")
NETWORKS = Path("etc/systemd/network")
_HIDDEN = tuple(map(Path, ("/home", "/root", "/run/user", "/tmp", "/var/tmp")))  # by ProtectHome, PrivateTmp
_SERIAL = ("slcan", "serial", "seeedstudio", "robotell")
_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_BARE = re.compile(r"[A-Za-z0-9_./:@+-]+")


@dataclass(frozen=True, slots=True)
class Installation:
    """Files for a joint by their path below the root, and the unit's name."""

    unit: str
    files: dict[Path, str]


def unit_name(joint: str) -> str:
    """Return the unit of a joint.

    Raises:
        UsageError: not a name for systemd.
    """
    if not _NAME.fullmatch(joint):
        raise UsageError(f'joint name: a unit takes letters, digits, ".", "-" and "_", got "{joint}"')
    return f"drivelink@{joint}.service"


def installation(
    joint: JointFile,
    path: Path,
    executable: Path,
    *,
    bus: Sequence[str] = (),
    allow: Sequence[str] = (),
    credentials: Sequence[str] = (),
) -> Installation:
    """Return the files that run a joint as a service.

    Args:
        bus: options of `drivelink run` for another bus than the joint file's.
        allow: addresses beside this machine that may connect, e.g. "10.0.0.0/24".
        credentials: "NAME=FILE": keys that the unit hands to the daemon as
            `/run/credentials/drivelink@JOINT.service/NAME`.

    Raises:
        UsageError: a value that a unit cannot contain.
    """
    unit, path = unit_name(joint.name), path.absolute()
    interface, channel = joint.bus.interface, joint.bus.channel
    _check_bus(interface, channel, path)
    can, serial = interface == "socketcan", interface in _SERIAL
    seen = [f"BindReadOnlyPaths={_plain(p)}" for p in _hidden([path.parent, executable.parent, *_python()])]
    whose, user, kept = "A user of its own", "DynamicUser=yes", kept_in(joint, path)
    if kept is not None:  # its owner keeps, reads and accepts there
        seen.append(f"BindPaths={_plain(kept)}")
        owner = path.parent.stat()
        whose, user = "The joint folder's owner", f"User={owner.st_uid}\nGroup={owner.st_gid}"
    escaped = channel.replace("-", "\\x2d")  # in the name of a unit
    values = {
        "name": joint.name,
        "device": f"sys-subsystem-net-devices-{escaped}.device" if can else "",
        "executable": _plain(executable),
        "joint": " ".join((_plain(path), *map(_plain, bus))),
        "folder": _plain(path.parent),
        "paths": "\n".join(seen),
        "whose": whose,
        "user": user,
        "devices": "DeviceAllow=char-ttyACM rw\nDeviceAllow=char-ttyUSB rw\nSupplementaryGroups=dialout"
        if serial
        else "PrivateDevices=yes",
        "can": "" if serial else "AF_CAN ",
        "addresses": " ".join(("localhost", *map(_address, allow))),
        "credentials": "\n".join(f"LoadCredential={_credential(text)}" for text in credentials),
    }
    text = files("drivelink.systemd").joinpath("unit.service").read_text(encoding="utf-8")
    for key, value in values.items():
        text = text.replace("{{" + key + "}}", value)
    written = {UNITS / unit: re.sub(r"\n{3,}", "\n\n", text)}
    if can:
        written |= _network(channel, joint.bus.bitrate)
    return Installation(unit, written)


def kept_in(joint: JointFile, path: Path) -> Path | None:
    """Return the folder of a joint's black box, which the service writes to; None: it has none."""
    folder = joint.recording.folder
    return None if folder is None else Path(os.path.normpath(path.absolute().parent / folder))


def _check_bus(interface: str, channel: str, path: Path) -> None:
    """Check that a service can use the bus.

    Raises:
        UsageError: it exists inside one process, or its name is none of an interface.
    """
    if interface == "virtual":
        raise UsageError(
            f'{path}: bus.interface = "virtual" lives inside one process: expected a bus, e.g. "socketcan"'
        )
    if interface == "socketcan" and not re.fullmatch(r"[A-Za-z0-9_.-]{1,15}", channel):
        raise UsageError(f'{path}: bus.channel: expected the name of a network interface, got "{channel}"')


def network_files(channel: str) -> tuple[Path, ...]:
    """Return the possible paths of a CAN interface's network files."""
    return tuple(NETWORKS / f"80-drivelink-{channel}.{kind}" for kind in ("network", "netdev"))


def _network(channel: str, bitrate: int) -> dict[Path, str]:
    """Configuration of the interface for systemd-networkd: bit rate, restart after bus-off."""
    network, netdev = network_files(channel)
    head = "# Written by `drivelink service install`.\n"
    if channel.startswith("vcan"):
        return {
            netdev: f"{head}[NetDev]\nName={channel}\nKind=vcan\n",
            network: f"{head}[Match]\nName={channel}\n\n[Link]\nRequiredForOnline=no\n",
        }
    can = f"[CAN]\nBitRate={bitrate}\nRestartSec=100ms\n"
    return {network: f"{head}[Match]\nName={channel}\n\n[Link]\nRequiredForOnline=no\n\n{can}"}


def _python() -> Iterable[Path]:
    """Directories of Python and the package."""
    package = Path(drivelink.__file__).resolve().parent.parent
    return Path(sys.prefix), Path(sys.base_prefix), Path(sysconfig.get_paths()["purelib"]), package


def _hidden(places: Iterable[Path]) -> list[Path]:
    """Distinct paths that the unit would not see, none inside another."""
    below = {place.resolve() for place in places} | set(places)
    below = {place for place in below if any(home in place.parents for home in _HIDDEN)}
    return sorted(place for place in below if not below & set(place.parents))


def _plain(word: Path | str) -> str:
    """Return a path or an option for a unit, where spaces and percent signs are special."""
    if not _BARE.fullmatch(str(word)):
        raise UsageError(f"{word}: expected no spaces and special characters for a unit")
    return str(word)


def _address(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text, strict=False))
    except ValueError as error:
        raise UsageError(f"--allow: expected an address like 10.0.0.7 or 10.0.0.0/24, got {text}") from error


def _credential(text: str) -> str:
    name, equals, file = text.partition("=")
    if not equals or not _NAME.fullmatch(name) or not file:
        raise UsageError(f"--credential: expected NAME=FILE, got {text}")
    return f"{name}:{_plain(Path(file).absolute())}"


_LEAST_SHARE = 0.5  # of the cycles that are due


def notify(*lines: str) -> bool:
    """Send lines such as "READY=1"; return whether systemd listens."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]  # an abstract socket
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
            out.setblocking(False)
            out.sendto("\n".join(lines).encode(), address)
    except OSError:
        return False
    return True


def watchdog_period_s() -> float | None:
    """Return the interval of "WATCHDOG=1", a quarter of systemd's timeout, s; None: no watchdog."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    try:
        allowed_us = int(os.environ["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return None
    return allowed_us * 0.25e-6 if allowed_us > 0 else None


class Watchdog:
    """Feeds systemd's watchdog while the loop makes its cycles.

    A loop that skips most of them, because something else holds the interpreter or the processor, is not fed.
    """

    def __init__(self, loop: CycleLoop) -> None:
        self._loop = loop
        self._before = self._now()

    def check(self) -> bool:
        """Tell systemd of the progress since the last call; return whether there was enough."""
        before, self._before = self._before, self._now()
        due = (self._before[0] - before[0]) / self._loop.period_ns
        missed = self._before[1] - before[1]
        progress = missed <= (1.0 - _LEAST_SHARE) * due
        if progress:
            notify("WATCHDOG=1")
        return progress

    def _now(self) -> tuple[int, int]:
        """Time, ns, and periods that were skipped, or read too late, by this process."""
        return time.monotonic_ns(), self._loop.overruns + self._loop.behind
