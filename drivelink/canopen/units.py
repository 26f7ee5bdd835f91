"""Conversion of counts to SI at the joint side, in this module only.

The joint file has priority; missing values are taken from the drive (0x608F, 0x6091, 0x6075, 0x6076, 0x60A8,
0x60A9 of CiA 402-2, the maker's own objects, 0x6501 of CiA 406). If both disagree, a finding names both
numbers and the one in use.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

from drivelink.canopen import Address
from drivelink.canopen.layout import MappedObject, Offer, Role, Signal, object_address
from drivelink.canopen.vendors import Vendor, angle_unit_rad, velocity_unit_rad_s
from drivelink.jointfile import DriveSection, EncoderSection
from estimator.ranges import range_of

_DRIVE_OBJECTS: tuple[Address, ...] = (
    *((index, subindex) for index in (0x608F, 0x6091, 0x6092) for subindex in (1, 2)),
    *((index, 0) for index in (0x60A8, 0x60A9, 0x6075, 0x6076, 0x607E)),
)
_ENCODER_OBJECTS: tuple[Address, ...] = ((0x6000, 0), (0x6001, 0), (0x6002, 0), (0x6501, 0), (0x6502, 0))
_SCALING = 1 << 2  # of 0x6000, CiA 406: counts per revolution are those of 0x6001

_ERASED = 0xFFFF_FFFF  # of a unit that was never set; as an encoder's range it is that of its word
_SAME = 1e-3  # relative; tables in data sheets are rounded to about that
_MICRO_FROM = 20_000  # 0x6076 of a maker that uses µN·m and mN·m but has no motor of 20 N·m


def unit_objects(role: Role, vendor: Vendor) -> tuple[Address, ...]:
    """Return objects that `offer` needs the values of."""
    wanted: tuple[Address, ...] = ()
    if role.drive is not None:
        wanted += _DRIVE_OBJECTS + vendor.objects()
        if role.drive.second_encoder is not None:
            wanted += _resolution(object_address(role.drive.second_encoder, f"{role.key}.second_encoder"))
    if role.encoder is not None and role.encoder.source == "cia406":
        wanted += _ENCODER_OBJECTS
    elif role.encoder is not None:
        wanted += _resolution(_encoder_address(role.encoder, role.key))
    return wanted


def _resolution(encoder: Address) -> tuple[Address, Address]:
    """Return the objects whose ratio is the counts per revolution of a further encoder (CiA 402-2)."""
    return (0x60E6, encoder[1]), (0x60EB, encoder[1])


def _ratio(reported: Mapping[Address, int], numerator: Address, denominator: Address) -> float | None:
    above, below = reported.get(numerator, 0), reported.get(denominator, 1)
    return above / below if above > 0 and below > 0 else None


def offer(role: Role, reported: Mapping[Address, int], vendor: Vendor) -> Offer:
    """Return signals that a node can send, with their scales."""
    result = Offer()
    reported = {address: value for address, value in reported.items() if value != _ERASED}
    vendor = vendor.generation(reported)
    if role.drive is not None:
        _Drive(role, role.drive, reported, vendor, result).offer()
    if role.encoder is not None:
        _offer_link(role, role.encoder, reported, result)
        if vendor.sensorless == _encoder_address(role.encoder, role.key) and role.encoder.object is None:
            index, subindex = vendor.sensorless
            text = f"0x{index:04X}:{subindex:02X} is {vendor.name}'s sensorless position, no encoder"
            fix = f'link.encoder.object = "0x{index:04X}:{subindex + 1:02X}" for the one wired to it'
            result.warn(role.subject, text, fix)
    return result


class _Drive:
    """Units of one drive."""

    def __init__(
        self, role: Role, drive: DriveSection, reported: Mapping[Address, int], vendor: Vendor, result: Offer
    ) -> None:
        self._role, self._drive, self._vendor = role, drive, vendor
        self._reported, self._result = reported, result

    def offer(self) -> None:
        self._result.candidates[Signal.STATUSWORD] = (
            MappedObject(signal=Signal.STATUSWORD, index=0x6041, subindex=0, bits=16, signed=False),
        )
        gear = self._gear()
        reported, source = self._reported_counts()
        counts = self._choose("counts per motor revolution", "counts_per_rev", reported, source)
        self._position(counts, gear)
        self._torque(gear)
        self._velocity(counts, gear)
        self._following_error()
        self._second_encoder(counts, gear)
        self._polarity()

    def _choose(self, what: str, key: str, reported: float | None, source: str) -> float | None:
        """Return the value of a key; None: neither the joint file nor the drive gives it."""
        stated = getattr(self._drive, key) if key in self._drive.model_fields_set else None
        return _chosen(self._role, self._result, what, f"{self._role.key}: {key}", stated, reported, source)

    def _drive_gear(self) -> tuple[float | None, str]:
        ratio, source = _ratio(self._reported, (0x6091, 1), (0x6091, 2)), "0x6091"
        if ratio is None and self._vendor.gear:
            ratio, source = _ratio(self._reported, *self._vendor.gear), f"0x{self._vendor.gear[0][0]:04X}"
        return ratio, source

    def _gear(self) -> float:
        """Motor revolutions per joint revolution."""
        reported, source = self._drive_gear()
        stated = self._drive.gear_ratio
        if "gear_ratio" not in self._drive.model_fields_set:
            chosen = self._choose("gear ratio", "gear_ratio", reported, source)
            if chosen is None and reported is not None:
                text = f"no possible gear ratio in {source}, set {self._role.key}: gear_ratio"
                self._result.missing[Signal.MOTOR_POSITION] = text
            return stated if chosen is None else chosen
        if reported == 1.0 and stated != 1.0:  # usual: the drive was never configured with its gear
            text = (
                f"gear ratio: the drive says 1 ({source}), the joint file {stated:.6g}; {stated:.6g} is used"
            )
            self._result.info(self._role.subject, text)
            return stated
        self._choose("gear ratio", "gear_ratio", reported, source)
        return stated

    def _reported_counts(self) -> tuple[float | None, str]:
        angle = angle_unit_rad(self._reported.get((0x60A8, 0), 0))
        if angle is not None:  # user units at the output of the drive's gear
            return math.tau / angle / (self._drive_gear()[0] or 1.0), "0x60A8"
        reported = _ratio(self._reported, (0x608F, 1), (0x608F, 2))
        if reported is not None and reported > 1:  # 1/1 is the value of an unconfigured drive
            return reported, "0x608F"
        address = self._vendor.counts_per_rev
        if address and (counts := self._reported.get(address, 0)) > 1:
            return float(counts * self._vendor.counts_factor), f"0x{address[0]:04X}:{address[1]:02X}"
        return None, ""

    def _position(self, counts: float | None, gear: float) -> None:
        if counts is None:
            self._result.missing[Signal.MOTOR_POSITION] = (
                "counts per motor revolution are unknown: the drive reports no possible number (0x608F), "
                f"set {self._role.key}: counts_per_rev"
            )
        if counts is None or Signal.MOTOR_POSITION in self._result.missing:
            return
        scale = self._drive.direction * math.tau / (counts * gear)
        feed = _ratio(self._reported, (0x6092, 1), (0x6092, 2))
        if feed is not None and feed > 1 and not math.isclose(feed, counts * gear, rel_tol=_SAME):
            text = f"feed constant 0x6092 says {feed:.6g} units per shaft revolution, encoder and gear "
            self._result.info(self._role.subject, f"{text}{counts * gear:.6g}; {counts * gear:.6g} is used")
        self._result.candidates[Signal.MOTOR_POSITION] = (
            _object(Signal.MOTOR_POSITION, (0x6064, 0), 32, scale, wraps=True),
        )

    def _rated_torque_unit(self, raw: int) -> float:
        """N·m per count of 0x6076: 1e-3 by CiA 402, 1e-6 with some."""
        if not self._vendor.rated_torque_micro:
            return 1e-3
        evidence = self._drive.rated_torque_nm
        constant, current = self._vendor.torque_constant, self._vendor.nominal_current
        if constant and current and self._reported.get(constant) and self._reported.get(current):
            evidence = self._reported[constant] * 1e-6 * self._reported[current] * 1e-3
        if evidence is None:
            return 1e-6 if raw >= _MICRO_FROM else 1e-3
        return min((1e-3, 1e-6), key=lambda unit: abs(math.log(raw * unit / evidence)))

    def _torque_constant(self, rated_torque: float | None, rated_current: float | None) -> float | None:
        reported, source, address = None, "", self._vendor.torque_constant
        if address and self._reported.get(address):
            reported, source = self._reported[address] * 1e-6, f"0x{address[0]:04X}:{address[1]:02X}"
        chosen = self._choose("torque constant in N·m/A", "torque_constant_nm_a", reported, source)
        if chosen is None and rated_torque and rated_current:
            return rated_torque / rated_current
        return chosen

    def _torque(self, gear: float) -> None:
        drive = self._drive
        direction = drive.torque_direction or drive.direction
        raw = self._reported.get((0x6076, 0), 0)
        reported = raw * self._rated_torque_unit(raw) if raw else None
        rated_torque = self._choose("rated torque in N·m", "rated_torque_nm", reported, "0x6076")
        reported = self._reported.get((0x6075, 0), 0) * 1e-3 or None
        rated_current = self._choose("rated current in A", "rated_current_a", reported, "0x6075")
        constant = self._torque_constant(rated_torque, rated_current)
        if rated_torque is None and constant is not None and rated_current is not None:
            rated_torque = constant * rated_current  # Nanotec: no 0x6076, the torque of the rated current
        own = self._vendor.current
        own_unit = own is not None and own.address == (0x6078, 0)  # and then no rated values either
        candidate = partial(_object, Signal.MOTOR_TORQUE)
        by_torque: list[MappedObject] = []
        by_current: list[MappedObject] = []
        if rated_torque is not None:
            by_torque.append(candidate((0x6077, 0), 16, direction * gear * rated_torque / 1000))
        if constant is not None:
            per_ampere = direction * gear * constant
            if drive.current_object:
                address = object_address(drive.current_object, f"{self._role.key}.current_object")
                by_current.append(candidate(address, 32, per_ampere * drive.current_unit_a))
            if rated_current is not None and not own_unit:
                by_current.append(candidate((0x6078, 0), 16, per_ampere * rated_current / 1000))
            if own is not None:
                by_current.append(candidate(own.address, own.bits, per_ampere * own.unit_a))
        sources = {
            "torque": by_torque,
            "current": by_current,
            "auto": by_current + by_torque if drive.current_object or own_unit else by_torque + by_current,
        }
        chosen = tuple(dict.fromkeys(sources[drive.torque_source]))
        if chosen:
            self._result.candidates[Signal.MOTOR_TORQUE] = chosen
        else:
            self._result.missing[Signal.MOTOR_TORQUE] = (
                "the scale of its torque is unknown: the drive reports no possible rated torque (0x6076) or "
                f"rated current (0x6075), set {self._role.key}: rated_torque_nm, or torque_constant_nm_a and "
                "rated_current_a or current_object"
            )
        if not by_current and rated_torque is not None and not own_unit:
            # Unknown unit: assume that rated current gives rated torque.
            by_current = [candidate((0x6078, 0), 16, direction * gear * rated_torque / 1000)]
        self._check("current", Signal.TORQUE_CHECK, (*by_current, *by_torque))

    def _velocity(self, counts: float | None, gear: float) -> None:
        reported, source = None, "0x60A9"
        if unit := self._reported.get((0x60A9, 0)):
            reported = velocity_unit_rad_s(unit, counts)
        if reported is None and self._vendor.velocity_rad_s is not None:
            reported, source = self._vendor.velocity_rad_s, self._vendor.name
        if reported is None and self._vendor.velocity_counts_s is not None and counts is not None:
            reported, source = self._vendor.velocity_counts_s * math.tau / counts, self._vendor.name
        stated = self._drive.velocity_rad_s_per_count
        asked = self._drive.velocity or "velocity" in self._drive.checks
        if asked:
            chosen = self._choose("velocity unit in rad/s", "velocity_rad_s_per_count", reported, source)
        else:
            chosen = reported if stated is None else stated
        signal = Signal.MOTOR_VELOCITY if self._drive.velocity else Signal.VELOCITY_CHECK
        if chosen is None and asked:
            self._result.missing[signal] = (
                "the unit of 0x606C is unknown: the drive does not report it (0x60A9), "
                f"set {self._role.key}: velocity_rad_s_per_count"
            )
        if chosen is None:
            return
        scale = self._drive.direction * chosen / gear
        objects = (_object(signal, (0x606C, 0), 32, scale),)
        if self._drive.velocity:
            self._result.candidates[signal] = objects
        else:
            self._check("velocity", signal, objects)

    def _check(self, name: str, signal: Signal, objects: tuple[MappedObject, ...]) -> None:
        """Objects for cross-checks: mapped if the joint file asks for it, else read if mapped."""
        objects = tuple(replace(candidate, signal=signal) for candidate in dict.fromkeys(objects))
        if objects:
            asked = name in self._drive.checks or name == "second_encoder"
            (self._result.candidates if asked else self._result.checks)[signal] = objects

    def _following_error(self) -> None:
        """0x60F4 and the demand 0x6062, both in the unit of the position."""
        for position in self._result.candidates.get(Signal.MOTOR_POSITION, ()):
            for signal, index in ((Signal.FOLLOWING_ERROR, 0x60F4), (Signal.POSITION_DEMAND, 0x6062)):
                wraps = signal is Signal.POSITION_DEMAND
                self._check("following_error", signal, (replace(position, index=index, wraps=wraps),))

    def _second_encoder(self, counts: float | None, gear: float) -> None:
        """Another encoder of the motor; its scale and sign are estimated."""
        text = self._drive.second_encoder
        if text is None:
            return
        address = object_address(text, f"{self._role.key}.second_encoder")
        reported = _ratio(self._reported, *_resolution(address))
        per_rev = reported if reported is not None and reported > 1 else counts
        if per_rev is not None:
            scale = self._drive.direction * math.tau / (per_rev * gear)
            encoder = _object(Signal.SECOND_POSITION, address, 32, scale, wraps=True)
            self._check("second_encoder", Signal.SECOND_POSITION, (encoder,))

    def _polarity(self) -> None:
        polarity = self._reported.get((0x607E, 0), 0)
        subject, text = self._role.subject, f"polarity 0x607E is 0x{polarity:02X}: "
        if polarity & 0x80:
            applies = f"direction = {self._drive.direction} applies to what it reports"
            self._result.info(subject, f"{text}the drive itself turns the position's sign; {applies}")
        if bool(polarity & 0x80) != bool(polarity & 0x40):
            fix = "set bits 7 and 6 of 0x607E alike with the maker's tool"
            self._result.warn(subject, f"{text}position and velocity have opposite signs", fix)


def _chosen(
    role: Role, result: Offer, what: str, key: str, stated: float | None, reported: float | None, source: str
) -> float | None:
    """Return the declared value, else the reported one if it is in range; a finding if they disagree."""
    allowed = range_of(key)
    if reported is not None and not allowed.least <= reported <= allowed.most:
        text = f"{what}: the node says {reported:.6g} ({source}), expected {allowed}; it is not used"
        result.warn(role.subject, text, f"{key} = …, or correct {source} in the node")
        return stated
    if stated is not None and reported is not None and not math.isclose(stated, reported, rel_tol=_SAME):
        text = f"{what}: the node says {reported:.6g} ({source}), the joint file {stated:.6g}"
        fix = f"{key} = {reported:.6g}, or leave it out, or correct {source} in the node"
        result.warn(role.subject, f"{text}; {stated:.6g} is used", fix)
    return reported if stated is None else stated


def _object(
    signal: Signal, address: Address, bits: int, scale: float, *, wraps: bool = False
) -> MappedObject:
    index, subindex = address
    return MappedObject(
        signal=signal, index=index, subindex=subindex, bits=bits, signed=True, scale=scale, wraps=wraps
    )


def _encoder_address(encoder: EncoderSection, key: str) -> Address:
    default = "0x6004:00" if encoder.source == "cia406" else "0x60E4:01"
    return object_address(encoder.object or default, f"{key}.object")


def _offer_link(role: Role, encoder: EncoderSection, reported: Mapping[Address, int], result: Offer) -> None:
    """The link position."""
    address = _encoder_address(encoder, "link.encoder")
    if encoder.source == "cia406":
        scaled = reported.get((0x6000, 0), 0) & _SCALING and reported.get((0x6001, 0), 0)
        source = "0x6001" if scaled else "0x6501"
        counts = float(scaled or reported.get((0x6501, 0), 0)) or None
    else:
        above, below = reported.get((0x60E6, address[1]), 0), reported.get((0x60EB, address[1]), 1)
        counts, source = (above / below if above > 1 and below else None), "0x60E6"
    what, key = "link encoder, counts per revolution", "link.encoder: counts_per_rev"
    used = _chosen(role, result, what, key, encoder.counts_per_rev, counts, source)
    if used is None:
        result.missing[Signal.LINK_POSITION] = (
            f"counts per joint revolution are unknown: the node reports no possible number ({source}), "
            "set link.encoder.counts_per_rev"
        )
        return
    result.candidates[Signal.LINK_POSITION] = (
        MappedObject(
            signal=Signal.LINK_POSITION,
            index=address[0],
            subindex=address[1],
            bits=32,
            signed=address[0] != 0x6004,
            scale=encoder.direction * math.tau / used,
            wraps=True,
            offset=encoder.offset_rad,
            modulus=_measuring_range(reported) if encoder.source == "cia406" else 0,
        ),
    )


def _measuring_range(reported: Mapping[Address, int]) -> int:
    """Counts after which an absolute encoder rolls over (CiA 406); 0: at its full length."""
    range_ = reported.get((0x6002, 0), 0)
    if not range_:  # not reported, or the full 32 bits
        range_ = reported.get((0x6501, 0), 0) * reported.get((0x6502, 0), 0)
    return range_ if 1 < range_ < 1 << 32 else 0
