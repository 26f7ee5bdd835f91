"""Assigns signals to TPDOs, without sending anything.

Preferred is one frame with position, torque and statusword, so that a sample is atomic; other signals go into
a second one. Fixed mappings that carry the needed signals are used as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from drivelink.canopen.layout import MappedObject, Signal
from drivelink.canopen.pdo import Tpdo, describe
from drivelink.canopen.roles import Role
from drivelink.errors import DriveError

FRAME_BITS = 64

# Position and torque first: they must belong to the same instant.
_ORDER = (
    Signal.MOTOR_POSITION,
    Signal.MOTOR_TORQUE,
    Signal.STATUSWORD,
    Signal.LINK_POSITION,
    Signal.MOTOR_VELOCITY,
    Signal.TORQUE_CHECK,
    Signal.VELOCITY_CHECK,
    Signal.SECOND_POSITION,
    Signal.FOLLOWING_ERROR,
    Signal.POSITION_DEMAND,
)
CHECKS = _ORDER[5:]
OPTIONAL = (Signal.MOTOR_VELOCITY, Signal.STATUSWORD, *CHECKS)

Available = Mapping[Signal, Sequence[MappedObject]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """One TPDO and its assigned objects."""

    tpdo: Tpdo  # as it is in the node
    objects: tuple[MappedObject, ...] | None  # objects to map in order; None: keep its mapping


def pack(objects: Iterable[MappedObject], most: int = FRAME_BITS) -> list[tuple[MappedObject, ...]]:
    """Return the frames of at most eight bytes and `most` objects, first fit, in the order of importance."""
    frames: list[list[MappedObject]] = []
    for candidate in sorted(objects, key=lambda candidate: _ORDER.index(candidate.signal)):
        for frame in frames:
            if len(frame) < most and sum(other.bits for other in frame) + candidate.bits <= FRAME_BITS:
                frame.append(candidate)
                break
        else:
            frames.append([candidate])
    return [tuple(frame) for frame in frames]


def unused(wanted: Available, objects: Sequence[MappedObject]) -> tuple[MappedObject, ...]:
    """Return objects that do not serve a signal already: an object does not check itself."""
    used = {candidates[0].address for candidates in wanted.values() if candidates}
    return tuple(candidate for candidate in objects if candidate.address not in used)


def assign(
    role: Role, available: Available, tpdos: Sequence[Tpdo], *, prefer_unused: bool
) -> tuple[Assignment, ...]:
    """Assign signals to TPDOs.

    Args:
        available: for each signal wanted, the objects the node has for it, best first.
        prefer_unused: prefer disabled TPDOs, because another master may rely on the enabled ones.

    Raises:
        DriveError: a needed signal cannot be mapped; the message shows the mappings.
    """
    wanted = {signal: list(candidates) for signal, candidates in available.items() if candidates}
    result = _free(list(wanted.items()), tpdos, prefer_unused)
    if result is not None:
        return result
    kept: list[Assignment] = []
    fixed = [tpdo for tpdo in tpdos if tpdo.fixed]
    while wanted:
        best = max(fixed, key=lambda tpdo: len(_carried(tpdo, wanted)), default=None)
        carried = _carried(best, wanted) if best is not None else []
        if best is None or not carried:
            break
        fixed.remove(best)
        kept.append(Assignment(tpdo=best, objects=None))
        for signal in carried:
            del wanted[signal]
    rest = _free(list(wanted.items()), tpdos, prefer_unused)
    if rest is None:
        needed = [(signal, objects) for signal, objects in wanted.items() if signal not in OPTIONAL]
        rest = _free(needed, tpdos, prefer_unused)
    if rest is None:
        raise DriveError(_cannot(role, wanted, tpdos))
    return tuple(kept) + rest


def _free(
    wanted: Sequence[tuple[Signal, Sequence[MappedObject]]], tpdos: Sequence[Tpdo], prefer_unused: bool
) -> tuple[Assignment, ...] | None:
    """Assign all signals to TPDOs that carry them or can be mapped; None if there are too few."""
    left = list(tpdos)
    result, unplaced = [], []
    most = min((tpdo.most for tpdo in tpdos if not tpdo.fixed), default=FRAME_BITS)
    for frame in pack((candidates[0] for _, candidates in wanted), most):
        entries = {(*candidate.address, candidate.bits) for candidate in frame}
        carrying = [tpdo for tpdo in left if entries <= set(tpdo.entries)]
        # Prefer the one that is sent at every SYNC already.
        ready = min(
            carrying, key=lambda t: (not t.enabled or t.transmission_type != 1, t.number), default=None
        )
        if ready is None:
            unplaced.append(frame)
        else:
            left.remove(ready)
            result.append(Assignment(tpdo=ready, objects=None))
    usable = [tpdo for tpdo in left if not tpdo.fixed]
    if len(unplaced) > len(usable):
        return None
    if prefer_unused:
        usable.sort(key=lambda tpdo: (tpdo.enabled, tpdo.number))
    result += [Assignment(tpdo=tpdo, objects=frame) for tpdo, frame in zip(usable, unplaced, strict=False)]
    return tuple(result)


def _carried(tpdo: Tpdo, wanted: Mapping[Signal, Sequence[MappedObject]]) -> list[Signal]:
    mapped = {(index, subindex) for index, subindex, _ in tpdo.entries}
    return [
        signal for signal, objects in wanted.items() if any(object_.address in mapped for object_ in objects)
    ]


def _cannot(role: Role, wanted: Available, tpdos: Sequence[Tpdo]) -> str:
    lacking = ", ".join(
        f"{signal} (" + " or ".join(f"0x{c.address[0]:04X}:{c.address[1]:02X}" for c in candidates) + ")"
        for signal, candidates in wanted.items()
        if signal not in OPTIONAL
    )
    return f"{role.subject} refuses the mapping and none of its TPDOs carries {lacking}: {describe(tpdos)}"


def choose_cob_id(node: int, tpdo: Tpdo, taken: set[int]) -> int:
    """Return the identifier for a TPDO: its own if usable, else the predefined one, else a free one.

    Args:
        tpdo: the TPDO; a DCF may have given it another node's identifier.
        taken: identifiers that other TPDOs on this bus have.

    Raises:
        DriveError: no identifier is left.
    """
    predefined = 0x80 + 0x100 * tpdo.number + node if tpdo.number <= 4 else 0
    own = tpdo.cob_id
    candidates = [own] if 0x181 <= own <= 0x57F and own & 0x7F == node else []
    candidates += [predefined] if predefined else []
    candidates += [own] if 0x181 <= own <= 0x57F and not 0x181 <= own <= 0x4FF else []
    candidates += [0x80 + 0x100 * number + node for number in (4, 3, 2, 1)]
    for candidate in candidates:
        if candidate not in taken:
            return candidate
    raise DriveError(f"node {node}: no identifier is free for its TPDO{tpdo.number}")
