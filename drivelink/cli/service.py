"""`drivelink service install JOINT` and `uninstall`: the daemon of a joint as a systemd service."""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from drivelink import jointfile
from drivelink.cli import add_bus, moved
from drivelink.errors import DrivelinkError, UsageError
from drivelink.systemd.unit import UNITS, installation, kept_in, network_files, unit_name

EPILOG = """\
Writes the unit drivelink@NAME.service, and for a SocketCAN interface the files with which systemd-networkd
sets it up; then enables and starts it. Joint file and program are used where they are: a rewritten joint file
is taken over by the running daemon.

examples:
  sudo drivelink service install elbow.toml                    start now and at every boot
  drivelink service install elbow.toml --root stage            write the files below a folder, start nothing
  sudo drivelink service install elbow.toml --allow 10.0.0.0/24 --credential daemon.key=/etc/keys/daemon.key
  sudo drivelink service install elbow.toml --channel can1     on another interface than the joint file's
  sudo drivelink service uninstall elbow.toml
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    about = "install or uninstall"
    parser.add_argument("action", metavar="ACTION", choices=("install", "uninstall"), help=about)
    parser.add_argument("joint", metavar="JOINT", help="joint file; for uninstall also its name")
    parser.add_argument("--root", type=Path, metavar="DIR", help="write below this folder, and start nothing")
    about = "address that may connect besides this machine; may be repeated"
    parser.add_argument("--allow", action="append", default=[], metavar="ADDRESS", help=about)
    about = "file of a key that zenoh.config names; may be repeated"
    parser.add_argument("--credential", action="append", default=[], metavar="NAME=FILE", help=about)
    add_bus(parser)
    parser.add_argument("--force", action="store_true", help="replace existing files that differ")
    parser.add_argument("--json", action="store_true", help="print what was done as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    root = args.root or Path("/")
    if args.root is None and os.geteuid() != 0:
        raise UsageError("writes below /etc: run it with sudo, or name a folder with --root")
    return _install(args, root) if args.action == "install" else _uninstall(args, root)


def _install(args: argparse.Namespace, root: Path) -> int:
    path = Path(args.joint)
    joint = moved(jointfile.load(path), args)
    asked = {"--interface": args.interface, "--channel": args.channel}
    bus = [word for option, value in asked.items() if value for word in (option, value)]
    made = installation(joint, path, _executable(), bus=bus, allow=args.allow, credentials=args.credential)
    for place, text in made.files.items():
        there = root / place
        if there.exists() and there.read_text(encoding="utf-8") != text and not args.force:
            raise UsageError(f"{there}: exists already and differs; --force replaces it")
    if args.root is None:
        _systemctl("daemon-reload")  # without systemd nothing is written
    if (kept := kept_in(joint, path)) is not None and not kept.exists():
        kept.mkdir(parents=True)
        owner = path.absolute().parent.stat()
        os.chown(kept, owner.st_uid, owner.st_gid)
    for place, text in made.files.items():
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        (root / place).write_text(text, encoding="utf-8")
        if not args.json:
            print(root / place)
    if joint.zenoh.config and not args.allow:
        print("only this machine may connect: --allow ADDRESS lets others in", file=sys.stderr)
    if args.root is None:
        _systemctl("daemon-reload")
        if len(made.files) > 1:
            _systemctl("restart", "systemd-networkd.service")
        _systemctl("enable", "--now", made.unit)
    if args.json:
        _print_json(made.unit, "written", [root / place for place in made.files], args.root is None)
    elif args.root is None:
        print(f"{made.unit} runs: journalctl -fu {made.unit}")
    return 0


def _print_json(unit: str, what: str, files: list[Path], running: bool) -> None:
    print(json.dumps({"unit": unit, what: [str(path) for path in files], "running": running}))


def _uninstall(args: argparse.Namespace, root: Path) -> int:
    name, channel = args.joint, ""
    if name.endswith(".toml"):
        joint = moved(jointfile.load(Path(name)), args)
        name, channel = joint.name, joint.bus.channel
    unit = unit_name(name)
    there = root / UNITS / unit
    if not there.exists():
        raise UsageError(f"{there}: there is no such service")
    if args.root is None:
        _systemctl("disable", "--now", unit)
    there.unlink()
    removed = [there]
    others = any((root / UNITS).glob("drivelink@*.service"))
    for place in network_files(channel) if channel and not others else ():
        if (root / place).exists():
            (root / place).unlink()
            removed.append(root / place)
    if args.root is None:
        _systemctl("daemon-reload")
    if args.json:
        _print_json(unit, "removed", removed, False)
        return 0
    for path in removed:
        print(f"removed {path}")
    return 0


def _executable() -> Path:
    """Return the installed program by its permanent path."""
    beside = Path(sys.executable).with_name("drivelink")
    found = beside if beside.exists() else Path(shutil.which("drivelink") or "")
    if not found.is_file():
        raise UsageError("drivelink is not installed as a program: pip install it, then try again")
    return found.absolute()


def _systemctl(*words: str) -> None:
    """Notify systemd.

    Raises:
        DrivelinkError: systemctl is missing or fails.
    """
    try:
        done = subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise DrivelinkError("systemctl: not on this machine; --root DIR writes the files only") from error
    if done.returncode:
        reason = " ".join(done.stderr.split()) or f"exit status {done.returncode}"
        raise DrivelinkError(f"systemctl {' '.join(words)}: {reason}")
