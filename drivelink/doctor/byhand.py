"""`doctor --move`: what to do by hand, and what each sign and scale turns out to be.

drivelink never moves a drive: a person turns the joint, or jogs it with whatever controls it, and says by how
much. Positions are compared with that; a torque by what a drive that holds its position does against a push.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple, Protocol

from drivelink.jointfile import JointFile
from drivelink.recording.gate import corrections
from estimator.gate import Change

__all__ = ["ByHand", "Mark", "Person", "Value", "Values", "check_by_hand"]

_TURN_RAD = math.pi / 2.0
_STILL = 0.1  # of the motion that was asked for: what moves less has not taken part
_BY_EYE = 0.15  # relative: how well an angle is turned by eye
_FRICTION = 2.0  # factor: what friction in a gear and a push by hand leave uncertain of a torque
_GEARED = 3.0  # ratios nearer to one than this are a scale, not a gear
_SIGMAS = 5.0  # standard deviations of the torque's noise that a push has to exceed
_AMOUNT = re.compile(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*(°|deg|rad|mm|m|)", re.ASCII)
_UNITS = {"": math.pi / 180.0, "°": math.pi / 180.0, "deg": math.pi / 180.0, "rad": 1.0, "mm": 1e-3, "m": 1.0}


class Value(NamedTuple):
    """One channel over a short while: mean and standard deviation, SI at the joint side."""

    mean: float
    std: float


class Values(Protocol):
    """Where the channels' values come from."""

    def read(self, seconds: float) -> Mapping[str, Value]:
        """Those of the next seconds: "motor1_position", "motor1_torque", …, "link_position"."""


class Person(Protocol):
    """Who moves the joint."""

    def say(self, text: str) -> None:
        """Show a line."""

    def ask(self, text: str, meanwhile: Callable[[], None]) -> str:
        """Ask for an answer; `meanwhile` is called again and again until it comes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One sign or scale.

    Attributes:
        channel: e.g. "motor1_position".
        what: "sign" or "scale".
        good: whether it is right; None: not checked.
        text: what was seen.
    """

    channel: str
    what: str
    good: bool | None
    text: str

    def __str__(self) -> str:
        sign = {True: "✓", False: "✗", None: "·"}[self.good]
        return f"{sign} {_words(self.channel)}, {self.what}: {self.text}"


@dataclass(slots=True)
class ByHand:
    """How the checks went.

    Attributes:
        marks: one for each sign and scale.
        needed: what the channels need.
        paste: the lines for the joint file.
    """

    marks: list[Mark] = field(default_factory=list)
    needed: dict[str, float] = field(default_factory=dict)
    paste: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """For `--json`."""
        good = all(mark.good is not False for mark in self.marks)
        return {
            "schema": "drivelink.doctor.move/1",
            "good": good,
            "marks": [asdict(mark) for mark in self.marks],
            "paste": self.paste,
        }


def check_by_hand(joint: JointFile, values: Values, person: Person) -> ByHand:
    """Lead a person through the checks.

    Args:
        joint: as it is.
        values: of its channels.
        person: who moves it.

    Raises:
        UsageError: the person has gone.
    """
    done = ByHand()
    person.say("drivelink moves nothing: you do, by hand or with whatever controls the drive.")
    serial = joint.arrangement == "serial"
    together = [f"motor{i + 1}_position" for i in range(1 if serial else len(joint.motor))]
    if joint.link.encoder is not None:
        together.append("link_position")
    _positions(done, values, person, together, "the joint", joint)
    if serial:
        _positions(done, values, person, ["motor2_position"], "motor 2 alone (it sets the stiffness)", joint)
    _torques(done, values, person, joint, together)
    changes = [Change(channel, factor) for channel, factor in done.needed.items()]
    done.paste = [str(one) for one in corrections(joint, changes, live=True)]
    return done


def _positions(
    done: ByHand, values: Values, person: Person, channels: Sequence[str], what: str, joint: JointFile
) -> None:
    watch = _Watch(values)
    person.ask(f"Hold {what} still, then press Enter.", watch.pass_time)
    before = watch.now()
    text = (
        f"Turn {what} by 90° in the positive direction and hold it there, then press Enter; "
        "or type by how much it was turned (45, 0.8 rad, 50 mm), or s to skip."
    )
    asked = _amount(person, text, watch)
    if asked is None:
        for channel in channels:
            _mark(done, person, channel, "sign", None, "skipped")
        return
    after = watch.now()
    for channel in channels:
        if channel not in before or channel not in after:
            _mark(done, person, channel, "sign", None, "not read")
            continue
        _position(done, person, channel, after[channel].mean - before[channel].mean, asked, joint)


def _position(
    done: ByHand, person: Person, channel: str, moved: float, asked: float, joint: JointFile
) -> None:
    seen, ratio = f"{_angle(moved)} for {_angle(asked)}", abs(moved / asked)
    geared = channel != "link_position" and (_is_gear(ratio) or _gear_twice(ratio, channel, joint))
    if ratio < _STILL and not geared:
        _mark(done, person, channel, "sign", None, f"did not follow ({seen}): jog it, or check its cable")
        return
    positive = moved * asked > 0.0
    _mark(
        done, person, channel, "sign", positive, "positive" if positive else "negative: it counts backwards"
    )
    good = abs(ratio - 1.0) <= _BY_EYE
    _mark(done, person, channel, "scale", good, seen if good else f"{seen}: {ratio:.4g} times as far")
    factor = (1.0 if positive else -1.0) / (1.0 if good else ratio)
    if factor != 1.0:
        done.needed[channel] = factor
    if not good and geared:  # a gear is in the torque as well
        done.needed[channel.replace("position", "torque")] = ratio


def _is_gear(ratio: float) -> bool:
    """Whether a scale is off by a gear that is not declared: by so much, and not by degrees."""
    return ratio > _GEARED and abs(math.log(math.radians(ratio))) > _BY_EYE


def _gear_twice(ratio: float, channel: str, joint: JointFile) -> bool:
    """Whether a motor moves less by the gear that is declared for it."""
    drive = joint.motor[int(channel[5]) - 1].drive
    return drive is not None and drive.gear_ratio > _GEARED and abs(ratio * drive.gear_ratio - 1.0) < _BY_EYE


def _torques(done: ByHand, values: Values, person: Person, joint: JointFile, together: Sequence[str]) -> None:
    channels = [name.replace("position", "torque") for name in together if name.startswith("motor")]
    watch = _Watch(values)
    text = (
        "Let the drives hold their position, by whatever controls them; drivelink enables none. "
        "Press Enter when they hold, or type s to skip the torques."
    )
    if person.ask(text, watch.pass_time).strip().lower() == "s":
        for channel in channels:
            _mark(done, person, channel, "sign", None, "skipped")
        return
    before = watch.now()
    text = (
        "Push the joint in its positive direction and keep pushing, then press Enter; "
        "or type the torque if you know it (N·m: mass × 9.81 × lever)."
    )
    pushed = _torque(person, text, watch)
    after = watch.now()
    reaction = 0.0
    for channel in channels:
        if channel not in before or channel not in after:
            _mark(done, person, channel, "sign", None, "not read")
            continue
        change = after[channel].mean - before[channel].mean
        if abs(change) < max(_SIGMAS * before[channel].std, 1e-12):
            _mark(
                done, person, channel, "sign", None, f"no reaction ({change:+.3g} N·m): does the drive hold?"
            )
            continue
        # The push turns the link ahead of the motor: +tau_e on the motor (eq 5), which the drive balances.
        good = change < 0.0
        _mark(done, person, channel, "sign", good, f"{change:+.3g} N·m against the push" if good
              else f"{change:+.3g} N·m with the push: it has the wrong sign")  # fmt: skip
        reaction += abs(change)
        if not good:
            done.needed[channel] = -done.needed.get(channel, 1.0)
    if pushed is not None and reaction > 0.0:
        _torque_scale(done, person, channels, reaction, pushed)


def _torque_scale(
    done: ByHand, person: Person, channels: Sequence[str], reaction: float, pushed: float
) -> None:
    """The motors' torques together against a torque that is known."""
    known = abs(done.needed.get(channels[0], 1.0))  # what a gear that was found changes of it
    ratio = reaction * known / abs(pushed)
    good = 1.0 / _FRICTION <= ratio <= _FRICTION
    for channel in channels:
        text = f"{reaction * known:.3g} N·m for {abs(pushed):.3g} N·m"
        _mark(done, person, channel, "scale", good, text if good else f"{text}: {ratio:.4g} times as much")
        if not good:
            done.needed[channel] = done.needed.get(channel, 1.0) / ratio


class _Watch:
    """Reads on while a person moves, so that counters that roll over are followed."""

    def __init__(self, values: Values) -> None:
        self._values = values

    def pass_time(self) -> None:
        """A short while."""
        self._values.read(0.05)

    def now(self) -> Mapping[str, Value]:
        """The channels at rest."""
        return self._values.read(0.3)


def _mark(done: ByHand, person: Person, channel: str, what: str, good: bool | None, text: str) -> None:
    mark = Mark(channel=channel, what=what, good=good, text=text)
    done.marks.append(mark)
    person.say(f"  {mark}")


def _amount(person: Person, text: str, watch: _Watch) -> float | None:
    """By how much something was turned, rad or m; None: skipped."""
    while True:
        reply = person.ask(text, watch.pass_time).strip()
        if not reply:
            return _TURN_RAD
        if reply.lower() == "s":
            return None
        match = _AMOUNT.fullmatch(reply)
        try:
            amount = float(match[1]) * _UNITS[match[2]] if match else 0.0
        except ValueError:
            amount = 0.0
        if amount and math.isfinite(amount):
            return amount
        person.say(f"expected an amount like 45, 0.8 rad or 50 mm, got {reply}")


def _torque(person: Person, text: str, watch: _Watch) -> float | None:
    """A torque in N·m; None where it is not known."""
    while True:
        reply = person.ask(text, watch.pass_time).strip()
        if not reply:
            return None
        try:
            torque = float(reply)
        except ValueError:
            torque = math.nan
        if math.isfinite(torque) and torque != 0.0:
            return torque
        person.say(f"expected a torque in N·m, got {reply}")


def _words(channel: str) -> str:
    return channel.replace("_", " ").replace("motor", "motor ")


def _angle(value: float) -> str:
    return f"{math.degrees(value):+.4g}° ({value:+.3g})"
