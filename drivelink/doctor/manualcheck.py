"""`doctor --move`: checks each sign and scale with a person who moves the joint.

drivelink never moves a drive: a person turns or jogs the joint and enters the amount. Positions are compared
with it, torques with the reaction of a holding drive to a push.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any, NamedTuple, Protocol

from drivelink.jointfile import JointFile
from drivelink.recording.corrections import corrections
from estimator.gate import Change

_STILL = 0.1  # of the requested motion: a channel that moves less did not follow
_BY_EYE = 0.15  # relative accuracy of an angle turned by eye
_FRICTION = 2.0  # factor: uncertainty of a torque by friction in the gear and a push by hand
_GEARED = 3.0  # ratios closer to one than this are a scale error, not a gear
_SIGMAS = 5.0  # standard deviations of a difference of two readings that is believed
_AMOUNT = re.compile(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*(\D*)", re.ASCII)  # number, unit


class _Axis(NamedTuple):
    """Units and words for the motion of an axis."""

    verb: str
    asked: float  # default amount, rad or m
    unit: str  # everyday unit as printed after a number; a scale may be wrong by it
    everyday: float  # its value in rad or m
    si: str
    units: Mapping[str, float]  # accepted units in rad or m
    example: str  # amounts
    force: str  # unit of what a motor exerts
    known: str  # formula for a push

    def shown(self, value: float) -> str:
        """Return an amount in the everyday unit and in SI."""
        return f"{value / self.everyday:+.4g}{self.unit} ({value:+.3g} {self.si})"


_DEGREE = math.pi / 180.0
_ROTARY = _Axis(
    verb="Turn",
    asked=math.pi / 2.0,
    unit="°",
    everyday=_DEGREE,
    si="rad",
    units={"": _DEGREE, "°": _DEGREE, "deg": _DEGREE, "rad": 1.0},
    example="45 or 0.8 rad",
    force="N·m",
    known="mass × 9.81 × lever",
)
_LINEAR = _Axis(
    verb="Move",
    asked=0.05,
    unit=" mm",
    everyday=1e-3,
    si="m",
    units={"": 1e-3, "mm": 1e-3, "m": 1.0},
    example="50 or 0.2 m",
    force="N",
    known="mass × 9.81",
)


class Value(NamedTuple):
    """One channel over a short while: mean and standard deviation with rounding, SI at the joint side."""

    mean: float
    std: float


Reader = Callable[[float], Mapping[str, Value]]


class Person(Protocol):
    """The person who moves the joint."""

    def show(self, text: str) -> None:
        """Show a line."""

    def ask(self, text: str, meanwhile: Callable[[], object]) -> str:
        """Ask for an answer; call `meanwhile` repeatedly until it comes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """One sign or scale."""

    channel: str  # e.g. "motor1_position".
    what: str  # "sign" or "scale"
    good: bool | None  # whether it is right; None: not checked
    text: str  # the observation

    def __str__(self) -> str:
        sign = {True: "✓", False: "✗", None: "·"}[self.good]
        return f"{sign} {self.channel.replace('_', ' ').replace('motor', 'motor ')}, {self.what}: {self.text}"


@dataclass(slots=True)
class ByHand:
    """How the checks went."""

    marks: list[Mark] = field(default_factory=list)  # one for each sign and scale
    needed: dict[str, float] = field(default_factory=dict)  # what the channels need
    paste: list[str] = field(default_factory=list)  # the lines for the joint file

    @property
    def good(self) -> bool | None:
        """Whether all checks passed; None: nothing was checked."""
        checked = [mark.good for mark in self.marks if mark.good is not None]
        return all(checked) if checked else None

    def as_dict(self) -> dict[str, Any]:
        """Return the document for `--json`."""
        return {
            "schema": "drivelink.doctor.move/1",
            "good": self.good,
            "marks": [asdict(mark) for mark in self.marks],
            "paste": self.paste,
        }


def check_by_hand(joint: JointFile, read: Reader, person: Person, seconds: float = 0.3) -> ByHand:
    """Guide a person through the checks.

    Args:
        read: returns the channels over the next so many seconds: "motor1_position", …, "link_position".
        seconds: over which a channel at rest is averaged.

    Raises:
        UsageError: nobody answers.
    """
    steps = _Steps(joint, read, person, seconds)
    person.show("drivelink moves nothing: you do, by hand or with whatever controls the drive.")
    serial = joint.arrangement == "serial"
    together = [f"motor{i + 1}_position" for i in range(1 if serial else len(joint.motor))]
    motors = [name.replace("position", "torque") for name in together]
    if joint.link.encoder is not None:
        together.append("link_position")
    steps.positions(together, "the joint")
    if serial:
        steps.positions(["motor2_position"], "motor 2 alone (it sets the stiffness)")
    steps.torques(motors)
    changes = [Change(channel, factor) for channel, factor in steps.done.needed.items()]
    steps.done.paste = [str(one) for one in corrections(joint, changes, live=True)]
    return steps.done


class _Steps:
    """The checks in order."""

    def __init__(self, joint: JointFile, read: Reader, person: Person, seconds: float) -> None:
        self._joint, self._read, self._person = joint, read, person
        self._now = partial(read, seconds)  # the channels at rest
        self._axis = _LINEAR if joint.axis == "linear" else _ROTARY
        self.done = ByHand()  # results so far

    def positions(self, channels: Sequence[str], what: str) -> None:
        """Check positions against a motion of known amount."""
        axis = self._axis
        self._ask(f"Hold {what} still, then press Enter.")
        before = self._now()
        amount = f"{axis.asked / axis.everyday:g}{axis.unit}"
        asked = self._amount(
            f"{axis.verb} {what} by {amount} in the positive direction and hold it there, then press Enter; "
            f"or type by how much it was moved ({axis.example}), or s to skip."
        )
        if asked is None:
            for channel in channels:
                self._mark(channel, "sign", None, "skipped")
            return
        after = self._now()
        for channel in channels:
            if channel in before and channel in after:
                self._position(channel, before[channel], after[channel], asked)
            else:
                self._mark(channel, "sign", None, "not read")

    def _position(self, channel: str, before: Value, after: Value, asked: float) -> None:
        shown, moved = self._axis.shown, after.mean - before.mean
        seen, ratio = f"{shown(moved)} for {shown(asked)}", abs(moved / asked)
        geared = channel != "link_position" and self._is_gear(ratio, int(channel[5]) - 1)
        if ratio < _STILL and not geared:
            self._mark(channel, "sign", None, f"did not follow ({seen}): jog it, or check its cable")
            return
        if _SIGMAS * math.hypot(before.std, after.std) > _BY_EYE * abs(moved):
            self._mark(channel, "sign", None, f"was not at rest ({seen}): end what moves it, hold it still")
            return
        positive = moved * asked > 0.0
        text = "positive" if positive else "negative: it counts backwards"
        self._mark(channel, "sign", positive, text)
        good = abs(ratio - 1.0) <= _BY_EYE
        self._mark(channel, "scale", good, seen if good else f"{seen}: {ratio:.4g} times as far")
        factor = (1.0 if positive else -1.0) / (1.0 if good else ratio)
        if factor != 1.0:
            self.done.needed[channel] = factor
        if not good and geared:  # a gear is in the torque as well
            self.done.needed[channel.replace("position", "torque")] = ratio

    def _is_gear(self, ratio: float, motor: int) -> bool:
        """Return whether a scale is wrong by a gear that is not declared (no unit is so large), or twice."""
        drive = self._joint.motor[motor].drive
        declared = 1.0 if drive is None else drive.gear_ratio
        undeclared = ratio > _GEARED and abs(math.log(ratio * self._axis.everyday)) > _BY_EYE
        return undeclared or (declared > _GEARED and abs(ratio * declared - 1.0) < _BY_EYE)

    def torques(self, channels: Sequence[str]) -> None:
        """Check torques of drives that hold their position against a push."""
        reply = self._ask(
            "Let the drives hold their position, by whatever controls them; drivelink enables none. "
            "Press Enter when they hold, or type s to skip the torques."
        )
        if reply.lower() == "s":
            for channel in channels:
                self._mark(channel, "sign", None, "skipped")
            return
        unit = self._axis.force
        before = self._now()
        pushed = self._torque(
            "Push the joint in its positive direction and keep pushing, then press Enter; or type what you "
            f"push with if you know it ({unit}: {self._axis.known}; negative: in the other direction)."
        )
        after = self._now()
        direction = -1.0 if pushed is not None and pushed < 0.0 else 1.0
        held: dict[str, float] = {}  # against the push, with the scales found so far
        unread = False
        for channel in channels:
            if channel not in before or channel not in after:
                self._mark(channel, "sign", None, "not read")
                unread = True
                continue
            change = after[channel].mean - before[channel].mean
            noise = math.sqrt(2.0) * before[channel].std
            if abs(change) < max(_SIGMAS * noise, 1e-12):
                text = f"no reaction ({change:+.3g} {unit}): does the drive hold?"
                self._mark(channel, "sign", None, text)
                continue
            # The push moves the link ahead of the motor: +tau_e on the motor (eq 5), balanced by the drive.
            good = change * direction < 0.0
            text = "against the push" if good else "with the push: it has the wrong sign"
            self._mark(channel, "sign", good, f"{change:+.3g} {unit} {text}")
            held[channel] = abs(change * self.done.needed.get(channel, 1.0))
            if not good:
                self.done.needed[channel] = -self.done.needed.get(channel, 1.0)
        if pushed is not None and held:
            self._torque_scale(held, abs(pushed), unread)

    def _torque_scale(self, held: Mapping[str, float], pushed: float, unread: bool) -> None:
        """Compare the motors' total torque with a known torque."""
        total, unit, several = sum(held.values()), self._axis.force, len(held) > 1
        ratio = total / pushed
        good = None if unread else 1.0 / _FRICTION <= ratio <= _FRICTION
        text = f"{total:.3g} {unit} for {pushed:.3g} {unit}"
        if unread:
            text += ", without the motor that was not read"
        elif not good:
            which = ", in one of them or in both" if several else ""
            text += f"{' together' if several else ''}: {ratio:.4g} times as much{which}"
        for channel in held:
            self._mark(channel, "scale", good, text)
            if good is False and not several:
                self.done.needed[channel] = self.done.needed.get(channel, 1.0) / ratio

    def _ask(self, text: str) -> str:
        """Ask; channels are read meanwhile to follow counters that roll over."""
        return self._person.ask(text, lambda: self._read(0.05)).strip()

    def _mark(self, channel: str, what: str, good: bool | None, text: str) -> None:
        mark = Mark(channel=channel, what=what, good=good, text=text)
        self.done.marks.append(mark)
        self._person.show(f"  {mark}")

    def _amount(self, text: str) -> float | None:
        """Return the amount of motion, rad or m; None: skipped."""
        axis = self._axis
        while True:
            reply = self._ask(text)
            if not reply:
                return axis.asked
            if reply.lower() == "s":
                return None
            match = _AMOUNT.fullmatch(reply)
            amount = _number(match[1]) * axis.units.get(match[2], math.nan) if match else math.nan
            if math.isfinite(amount) and amount != 0.0:
                return amount
            self._person.show(f"expected an amount like {axis.example}, got {reply}")

    def _torque(self, text: str) -> float | None:
        """Return the torque or force of the push, N·m or N; None: unknown."""
        while True:
            reply = self._ask(text)
            if not reply:
                return None
            torque = _number(reply)
            if math.isfinite(torque) and torque != 0.0:
                return torque
            self._person.show(f"expected a number of {self._axis.force}, got {reply}")


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
