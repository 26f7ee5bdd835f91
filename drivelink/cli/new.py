"""`drivelink new`."""

import argparse
import json
import re
import shutil
import sys
import sysconfig
from collections.abc import Callable, Container
from dataclasses import fields, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import tomlkit

from drivelink.canopen.bus import open_bus
from drivelink.canopen.newfile import Answers, answers_from_bus, joint_text
from drivelink.canopen.scan import ASKED_S, identify_all, scan, shares
from drivelink.cli import add_number
from drivelink.errors import DriveError, DrivelinkError, UsageError
from drivelink.files import check_target, write_whole
from drivelink.jointfile import BusSection, parse

_CASES = ("constant", "quadratic", "vsa-ii")
_ARRANGEMENTS = ("single", "antagonistic", "serial")
_MODELS = ("polynomial", "linear", "exponential", "vsa-ii", "none")

EPILOG = """\
examples:
  drivelink new elbow.toml                            asks what no drive can report
  drivelink new elbow.toml --rotor-inertia 48 --gear 100 --torque-constant 53
  drivelink new elbow.toml --scan --channel can0      node ids and encoder from what answers on the bus
  drivelink new vsa.toml --case vsa-ii                one of the paper's joints, for `sim` and `run`
  drivelink new --examples .                          the examples of the documentation, into ./examples
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("path", nargs="?", type=Path, metavar="PATH", help="default: NAME.toml; -: print it")
    parser.add_argument("--case", choices=_CASES, help="one of the paper's joints, simulated")
    parser.add_argument("--examples", type=Path, metavar="DIR", help="copy the examples into DIR, no more")
    parser.add_argument("--scan", action="store_true", help="take the nodes from what answers on the bus")
    parser.add_argument("--name", help="name of the joint")
    about = f"how the motors act on the joint: {', '.join(_ARRANGEMENTS)}"
    parser.add_argument("--arrangement", choices=_ARRANGEMENTS, metavar="KIND", help=about)
    number = partial(add_number, parser)
    about = "rotor inertia of each motor, g·cm² (data sheet)"
    number("--rotor-inertia", dest="rotor_inertia_gcm2", metavar="G_CM2", help=about)
    about = "instead: inertia of each motor, joint side"
    number("--inertia", dest="inertia_kg_m2", metavar="KG_M2", help=about)
    about = "torque constant of each motor, mN·m/A, if the drive reports no torque"
    number("--torque-constant", dest="torque_constant_mnm_a", metavar="MNM_A", help=about)
    about = "damping of each motor, joint side"
    number("--damping", least=0.0, dest="viscous_damping_nm_s_rad", metavar="NM_S_RAD", help=about)
    about = f"model of the transmission: {', '.join(_MODELS)}"
    parser.add_argument("--model", choices=_MODELS, metavar="MODEL", help=about)
    about = "node ID of a drive; twice for a VSA"
    number("--node", least=1, most=127, whole=True, dest="nodes", action="append", metavar="ID", help=about)
    number("--gear", dest="gear_ratio", metavar="RATIO", help="motor revolutions per joint revolution")
    about = "link encoder: ID of a CiA 406 node"
    parser.add_argument("--encoder", metavar="drive|none|ID", help=about)
    parser.add_argument("--interface", help="python-can interface (default: socketcan)")
    parser.add_argument("--channel", help="python-can channel (default: can0)")
    number("--bitrate", whole=True, help="bit/s (default: 1000000)")
    about = "another master controls the bus"
    parser.add_argument("--passive", action="store_true", default=None, help=about)
    parser.add_argument("--force", action="store_true", help="replace PATH if it exists")
    parser.add_argument("--json", action="store_true", help="print what was made as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Ask for missing answers in a terminal, and write the file."""
    if args.inertia_kg_m2 is not None and args.rotor_inertia_gcm2 is not None:
        raise UsageError("expected either --inertia or --rotor-inertia")
    if args.examples is not None:
        print(f"{_examples(args.examples)} written")
        return 0
    text, name, remarks = _case_text(args) if args.case else _new_text(args)
    if str(args.path) == "-":
        print(json.dumps({"joint": name, "text": text}) if args.json else text, end="\n" if args.json else "")
        return 0
    path = args.path or Path(f"{name}.toml")
    check_target(path, force=args.force)
    write_whole(path, text, force=args.force)
    if args.json:
        document = {"joint": name, "path": str(path), "remarks": remarks, "next": _next(args, path)}
        print(json.dumps(document, ensure_ascii=False))
        return 0
    for remark in remarks:
        print(remark)
    print(f"{path} written; next: {_next(args, path)}")
    return 0


def _examples(folder: Path) -> Path:
    """Copy the examples that came with the wheel or the checkout; the folder made.

    Raises:
        UsageError: they are not installed, or the folder is there already.
        DrivelinkError: they cannot be written; nothing of them is left.
    """
    shipped = Path(sysconfig.get_path("data"), "share", "drivelink", "examples")
    source = next((p for p in (shipped, Path(__file__).parents[2] / "examples") if p.is_dir()), None)
    target = folder / "examples"
    if source is None:
        raise UsageError("--examples: expected them beside the installation, there are none")
    if target.exists():
        raise UsageError(f"--examples: {target} is there already")
    try:
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("target", "__pycache__"))
    except shutil.Error as error:  # of every file; the first is enough
        shutil.rmtree(target, ignore_errors=True)
        _, file, why = error.args[0][0]  # "[Errno 28] No space left on device: 'from' -> 'to'"
        raise DrivelinkError(f"{file}: {why.partition('] ')[2].partition(': ')[0]}") from error
    return target


def _next(args: argparse.Namespace, path: Path) -> str:
    if not args.case:
        return f"drivelink doctor {path}"
    here = "" if args.interface else " --interface socketcand"  # a virtual bus ends at its process
    return f"drivelink sim {path}{here}, and in another terminal drivelink run {path}{here}"


def _case_text(args: argparse.Namespace) -> tuple[str, str, list[str]]:
    """Return a copy of the shipped joint file with its comments, changed by the options."""
    source = resources.files("drivelink") / "joints" / f"{args.case}.toml"
    document: Any = tomlkit.parse(source.read_text(encoding="utf-8"))
    if args.name:
        document["name"] = args.name
    for key in ("interface", "channel", "bitrate"):
        if (value := getattr(args, key)) is not None:
            document["bus"][key] = value
    text = tomlkit.dumps(document)
    return text, parse(text, "these answers").name, []


def _new_text(args: argparse.Namespace) -> tuple[str, str, list[str]]:
    options = {one.name: getattr(args, one.name, None) for one in fields(Answers)}
    given = {name: value for name, value in options.items() if value is not None}
    if args.path is not None and args.path.stem and str(args.path) != "-":
        given.setdefault("name", args.path.stem)
    _encoder(given.get("encoder", "drive"))
    answers = Answers(**given)
    if args.scan:
        answers = _scanned(answers)
    elif sys.stdin.isatty() and str(args.path) != "-" and not args.json:
        _ask(answers, given)
    _require_possible(answers)
    if answers.rotor_inertia_gcm2 is not None and answers.gear_ratio is None:
        raise UsageError(
            "--rotor-inertia: expected --gear, whose square reflects it to the joint; 1 for a direct drive"
        )
    text = joint_text(answers)
    remarks = [f"motor inertia at the joint: {answers.conversion}"] if answers.conversion else []
    if answers.joint_inertia_kg_m2 is None:
        remarks.append(
            "motor.inertia_kg_m2 is a placeholder: set --rotor-inertia (g·cm²) and --gear, or --inertia"
        )
    return text, answers.name, remarks


def _require_possible(answers: Answers) -> None:
    if answers.motors > 1 and answers.model == "none":
        raise UsageError(f"transmission: expected a flexible one of {answers.arrangement} motors, got none")
    if answers.encoder == "none" and answers.model != "none":
        raise UsageError(f"--encoder none: expected --model none, as {answers.model} needs a link encoder")


def _encoder(text: str) -> str:
    if text in ("drive", "none") or (text.isdecimal() and 1 <= int(text) <= 127):
        return text
    raise UsageError(f'--encoder: expected "drive", "none" or a node id from 1 to 127, got "{text}"')


def _scanned(answers: Answers) -> Answers:
    if answers.passive:
        raise UsageError("--scan asks the nodes, --passive forbids it: give --node instead")
    section = BusSection(interface=answers.interface, channel=answers.channel, bitrate=answers.bitrate)
    with open_bus(section) as bus:
        ids, _ = scan(bus)
        found, left = identify_all(bus, section, ids, next(shares(1)))
    if left:
        raise DriveError(
            f"{section.channel}: {len(ids)} nodes answer, {len(left)} of them were not asked what they are "
            f"for want of time ({ASKED_S:g} s): give --node instead of --scan"
        )
    return answers_from_bus(answers, found)


_QUESTIONS = {  # by the key of `Answers`
    "name": "Name of the joint",
    "arrangement": f"Arrangement of the motors: {', '.join(_ARRANGEMENTS)}",
    "gear_ratio": "Gear ratio: motor revolutions per joint revolution, 1 for a direct drive",
    "rotor_inertia_gcm2": "Rotor inertia of the motor, g·cm² (its data sheet)",
    "torque_constant_mnm_a":
        "Torque constant of the motor, mN·m/A (its data sheet; Enter: the drive reports its torque)",
    "viscous_damping_nm_s_rad": "Motor damping at the joint side, N·m·s/rad (0: not known)",
    "model": f"Transmission: {', '.join(_MODELS)}",
    "interface": "CAN interface (python-can)",
    "channel": "Channel",
    "nodes": "Node id of the drive of motor",
    "encoder": "Link encoder: drive, none, or node id of a CiA 406 encoder",
}  # fmt: skip


def _ask(answers: Answers, known: Container[str]) -> None:
    """Ask for each missing answer; Enter keeps the default."""
    try:
        for key, question in _QUESTIONS.items():
            if key in known or (key == "rotor_inertia_gcm2" and "inertia_kg_m2" in known):
                continue
            if key == "nodes":
                motors = range(1, answers.motors + 1)
                answers.nodes = [_asked(f"{question} {motor}", motor, _check(key)) for motor in motors]
                continue
            needed = key in ("gear_ratio", "rotor_inertia_gcm2")  # no drive reports them
            check = _fitting(answers, key, _encoder if key == "encoder" else _check(key))
            setattr(answers, key, _asked(question, getattr(answers, key), check, needed=needed))
            if key == "rotor_inertia_gcm2":
                print(f"  at the joint: {answers.conversion}")
    except EOFError:
        raise UsageError("the questions were not answered; options answer them, too: --help") from None


def _check(option: str) -> Callable[[str], Any]:
    """Return what makes a value of the text that an option may be given."""
    parser = argparse.ArgumentParser()
    configure(parser)
    action = next(one for one in parser._actions if one.dest == option)

    def check(reply: str) -> Any:
        if action.choices is not None and reply not in action.choices:
            raise UsageError(f"expected {', '.join(action.choices)}, got {reply}")
        return action.type(reply) if callable(action.type) else reply

    return check


def _fitting(answers: Answers, key: str, check: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a check that also refuses what contradicts the earlier answers."""

    def fits(reply: str) -> Any:
        value = check(reply)
        _require_possible(replace(answers, **{key: value}))
        return value

    return fits


def _asked(question: str, default: Any, check: Callable[[str], Any], *, needed: bool = False) -> Any:
    """Ask until the reply is valid; an empty line is the default, if any."""
    while True:
        reply = input(f"{question}: " if default is None else f"{question} [{default}]: ").strip()
        if not reply and not needed:
            return default
        if not reply:
            print("expected a number: there is no default for it")
            continue
        try:
            return check(reply)
        except UsageError as error:
            print(re.sub(r"^--[^:]+: ", "", str(error)))  # who is asked has given no option
