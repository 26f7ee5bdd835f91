"""A CiA 402 drive as a CANopen slave: state machine, torque modes, a second encoder, units in its objects."""

import math
from collections.abc import Callable
from enum import IntEnum
from fractions import Fraction

from sim.canopen.dictionary import Abort, Entry, SdoAbortedError
from sim.canopen.edsfile import data_sheet
from sim.canopen.node import Nmt, Node
from sim.canopen.profiles import Quirks
from sim.sensors import DriveHardware, DriveSignals
from sim.world import World

_FAULT_RESET = 0x80
_QUICK_STOP_STAYS = range(5, 9)  # values of 0x605A with which the drive stays in quick stop active


class PowerState(IntEnum):
    """States, with their statusword bits (0 to 3, 5, 6)."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class StateMachine:
    """Transitions 0 to 16 by controlwords, by faults, and automatic ones."""

    def __init__(self) -> None:
        self.state = PowerState.SWITCH_ON_DISABLED  # the present one
        self.quick_stop_option = 2  # 0x605A
        self._last = 0

    def reset(self) -> None:
        """Enter the state after power-on: transitions 0 and 1."""
        self.state = PowerState.SWITCH_ON_DISABLED
        self._last = 0

    def fault(self) -> None:
        """Enter the fault reaction (transition 13)."""
        if self.state is not PowerState.FAULT:
            self.state = PowerState.FAULT_REACTION

    def step(self) -> None:
        """Perform the automatic transitions of a cycle: end of the fault reaction and of a quick stop."""
        if self.state is PowerState.FAULT_REACTION:
            self.state = PowerState.FAULT
        elif self.state is PowerState.QUICK_STOP_ACTIVE and self.quick_stop_option not in _QUICK_STOP_STAYS:
            self.state = PowerState.SWITCH_ON_DISABLED

    def control(self, word: int) -> bool:
        """Obey a controlword.

        Returns:
            Whether a fault was reset, which needs a rising edge of bit 7.
        """
        rising = word & ~self._last & _FAULT_RESET
        self._last = word
        if self.state is PowerState.FAULT:
            if rising:
                self.state = PowerState.SWITCH_ON_DISABLED
            return bool(rising)
        if self.state is PowerState.FAULT_REACTION or word & _FAULT_RESET:
            return False
        self.state = self._next(word)
        return False

    def _next(self, word: int) -> PowerState:
        state, bits = self.state, word & 0x0F
        if not bits & 0x02:  # disable voltage: transitions 7, 9, 10, 12
            return PowerState.SWITCH_ON_DISABLED
        if not bits & 0x04:  # quick stop: transitions 7, 10, 11
            if state is PowerState.OPERATION_ENABLED:
                return PowerState.QUICK_STOP_ACTIVE
            stays = state in (PowerState.QUICK_STOP_ACTIVE, PowerState.SWITCH_ON_DISABLED)
            return state if stays else PowerState.SWITCH_ON_DISABLED
        if not bits & 0x01:  # shutdown: transitions 2, 6, 8
            return state if state is PowerState.QUICK_STOP_ACTIVE else PowerState.READY_TO_SWITCH_ON
        if state is PowerState.SWITCH_ON_DISABLED:
            return state
        if state is PowerState.QUICK_STOP_ACTIVE:  # transition 16, only by enable operation
            return PowerState.OPERATION_ENABLED if bits & 0x08 else state
        # switch on, enable and disable operation: transitions 3, 4, 5, and 3 with 4 at once
        return PowerState.OPERATION_ENABLED if bits & 0x08 else PowerState.SWITCHED_ON


_PROFILE_TORQUE, _CYCLIC_TORQUE = 4, 10
_MODES = (0, _PROFILE_TORQUE, _CYCLIC_TORQUE)
_HALT = 0x0100
_VOLTAGE, _REMOTE, _TARGET_REACHED, _LIMIT, _FOLLOWS = 0x0010, 0x0200, 0x0400, 0x0800, 0x1000
_TOGGLE = 0x0400
_FAULT_SIGNAL, _DISABLE_VOLTAGE, _QUICK_STOP = 1, 2, 3  # 0x6007
_HEARTBEAT_LOST = 0x8130
_POSITION_REVERSED, _VELOCITY_REVERSED = 0x80, 0x40

# 0x60A9: units of a numerator per radian, and seconds in a denominator.
_RADIAN, _DEGREE, _REVOLUTION, _INCREMENT = 0x10, 0x41, 0xB4, 0xB5
_SECONDS = {0x03: 1.0, 0x47: 60.0}


def _nameplate(drive: DriveHardware) -> dict[tuple[int, int], int]:
    """Power-on values of a drive with its motor, encoder and gear, by (index, subindex)."""
    gear = Fraction(drive.gear_ratio).limit_denominator(1000)
    counts = round(drive.counts_per_rev)
    return {
        (0x6073, 0): round(1e3 * drive.limit_a / drive.rated_current_a),
        (0x6075, 0): max(1, round(drive.rated_current_a * 1e3)),
        (0x6076, 0): max(1, round(drive.rated_torque_nm * 1e3)),
        (0x608F, 1): counts,
        (0x6091, 1): gear.numerator,
        (0x6091, 2): gear.denominator,
        (0x6092, 1): counts * gear.numerator // gear.denominator,
    }


def _limited(value: float, bound: int) -> int:
    return max(-bound, min(bound, round(value)))


class Cia402Drive(Node):
    """One drive of a rig.

    Args:
        link_encoder: whether the encoder at the link is wired to it.
    """

    def __init__(
        self,
        node_id: int,
        rig: World,
        motor: int,
        quirks: Quirks | None = None,
        *,
        link_encoder: bool = False,
    ) -> None:
        self._rig, self._motor, self._wired = rig, motor, link_encoder
        quirks, plate = quirks or Quirks(), _nameplate(rig.drives[motor])
        second = quirks.second_encoder
        values: dict[tuple[int, int], int | str] = {
            **plate,
            (0x60E6, second): round(rig.encoder.counts_per_rev) if link_encoder else 0,
            (0x60EB, second): 1,
        }
        if quirks.identity is not None:
            values |= {(0x1008, 0): quirks.identity[0], (0x1018, 2): quirks.identity[1]}
        self._counts_per_rev = plate[0x608F, 1]
        self._sampled: tuple[Callable[[DriveSignals], None], ...] = ()
        super().__init__(node_id, data_sheet(quirks.eds, frozenset(values.items()), second), quirks)
        self.machine = StateMachine()
        self._torque_unit_nm = plate[0x6076, 0] * 1e-6
        self._current_unit_a = plate[0x6075, 0] * 1e-6
        self._demand = 0.0  # per mille of rated torque
        self._following = self._limiting = self._reached = False
        self._toggle = 0
        self.misread: Callable[[DriveSignals], DriveSignals] | None = None  # a fault of its sensors
        self._link_counts = rig.link_counts()
        self._link_time_s = rig.time_s
        self._bind()

    # Objects

    def _bind(self) -> None:
        live = self.dictionary.optional
        self._position, self._internal = live(0x6064), live(0x6063)
        self._velocity, self._sensor_velocity = live(0x606C), live(0x6069)
        self._torque, self._current = live(0x6077), live(0x6078)
        self._milliampere = live(*(self.quirks.current_ma or (0, 0)))
        second = self.quirks.second_encoder
        self._link, self._link_velocity = live(0x60E4, second), live(0x60E5, second)
        self._status, self._control = live(0x6041), live(0x6040)
        self._mode, self._mode_shown = live(0x6060), live(0x6061)
        self._target, self._offset, self._demanded = live(0x6071), live(0x60B2), live(0x6074)
        self._max_torque, self._slope = live(0x6072), live(0x6087)
        self._polarity, self._velocity_unit = live(0x607E), live(0x60A9)
        if (0x60A9, 0) not in self.dictionary:
            self._velocity_unit.value = self.quirks.velocity_unit
        self._error_code = live(0x603F)
        self._sensors: list[tuple[Callable[[DriveSignals], None], frozenset[Entry]]] = [
            (self._read_position, frozenset({self._position, self._internal})),
            (self._read_velocity, frozenset({self._velocity, self._sensor_velocity})),
            (self._read_torque, frozenset({self._torque})),
            (self._read_current, frozenset({self._current, self._milliampere})),
        ]
        if self._wired:
            self._sensors.append((self._read_link, frozenset({self._link, self._link_velocity})))
        self._control.changed = self._obey
        self._mode.check = self._check_mode
        self._velocity_unit.check = self._check_velocity_unit
        self._velocity_unit.changed = self._take_units
        self._polarity.changed = self._take_units
        live(0x605A).changed = self._take_units
        for entry in (self._status, *(entry for _, entries in self._sensors for entry in entries)):
            entry.refresh = self._measure
        self._take_units()

    def _take_units(self) -> None:
        word, polarity = self._velocity_unit.number, self._polarity.number
        self._velocity_scale = self._units_per_rad_s(word)
        if polarity & _VELOCITY_REVERSED:
            self._velocity_scale = -self._velocity_scale
        self._position_sign = -1 if polarity & _POSITION_REVERSED else 1
        self.machine.quick_stop_option = self.dictionary.optional(0x605A).number

    def _units_per_rad_s(self, word: int) -> float:
        turn = 2.0 * math.pi
        per_radian = {
            _RADIAN: 1.0,
            _DEGREE: 360.0 / turn,
            _REVOLUTION: 1.0 / turn,
            _INCREMENT: self._counts_per_rev / turn,
        }
        exponent = (word >> 24) - (256 if word >> 31 else 0)
        if exponent not in self.quirks.velocity_exponents:
            raise KeyError(exponent)
        return float(per_radian[word >> 16 & 0xFF] * _SECONDS[word >> 8 & 0xFF] * 10.0**-exponent)

    def _check_velocity_unit(self, word: int) -> None:
        try:
            self._units_per_rad_s(word)
        except KeyError:
            raise SdoAbortedError(Abort.INVALID_VALUE) from None

    def _check_mode(self, mode: int) -> None:
        if mode not in _MODES:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    # Control

    def _obey(self) -> None:
        if self.machine.control(self._control.number) and self._error_code.number:
            self.emergency.clear_error(self._error_code.number)
            self._error_code.value = 0

    def fault(self, code: int, register: int = 0, vendor: bytes = b"") -> None:
        """Raise a fault in the drive: EMCY, fault reaction, fault.

        Args:
            code: EMCY error code, e.g. 0x2310 (over-current).
            register: bits of the error register besides bit 0.
        """
        self.machine.fault()
        self._error_code.value = code
        self.emergency.raise_error(code, register, vendor)

    def on_control(self, periods: int) -> None:
        """Control periods begin: pass the active set-point to the rig."""
        self.machine.step()
        self._mode_shown.value = mode = self._mode.number
        self._following = self.machine.state is PowerState.OPERATION_ENABLED and mode in (
            _PROFILE_TORQUE,
            _CYCLIC_TORQUE,
        )
        if not self._following:
            self._demand = 0.0
            self._demanded.value = 0
            held = self.machine.state in (PowerState.QUICK_STOP_ACTIVE, PowerState.OPERATION_ENABLED)
            self._rig.command(self._motor, 0.0 if held else None)
            return
        bound = self._max_torque.number
        wanted = self._target.number + self._offset.number
        target = float(max(-bound, min(bound, wanted)))
        self._limiting = target != wanted
        if mode == _PROFILE_TORQUE:
            if self._control.number & _HALT:
                target = 0.0
            step = self._slope.number * self._rig.period_s * periods
            self._demand = max(self._demand - step, min(self._demand + step, target))
        else:
            self._demand = target
        self._reached = self._demand == target
        self._demanded.value = round(self._demand)
        self._rig.command(self._motor, self._demand * self._torque_unit_nm)

    def on_pdos(self, mapped: frozenset[Entry]) -> None:
        """Update only mapped entries with each sample."""
        self._sampled = tuple(read for read, entries in self._sensors if mapped & entries)

    def on_sample(self) -> None:
        """Read the rig's sensors into the mapped process data."""
        self._toggle ^= _TOGGLE
        signals = self._signals()
        for read in self._sampled:
            read(signals)
        self._status.value = self._statusword()

    def _measure(self) -> None:
        """Read the rig's sensors into all process data, for SDO."""
        signals = self._signals()
        for read, _ in self._sensors:
            read(signals)
        self._status.value = self._statusword()

    def _signals(self) -> DriveSignals:
        signals = self._rig.drive(self._motor)
        return signals if self.misread is None else self.misread(signals)

    def _read_position(self, signals: DriveSignals) -> None:
        counts = signals.position_counts
        self._internal.value = (counts + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        counts *= self._position_sign
        self._position.value = (counts + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000

    def _read_velocity(self, signals: DriveSignals) -> None:
        velocity = _limited(signals.velocity_rad_s * self._velocity_scale, 0x7FFF_FFFF)
        self._velocity.value = self._sensor_velocity.value = velocity

    def _read_torque(self, signals: DriveSignals) -> None:
        self._torque.value = _limited(signals.torque_nm / self._torque_unit_nm, 0x7FFF)

    def _read_current(self, signals: DriveSignals) -> None:
        self._current.value = _limited(signals.current_a / self._current_unit_a, 0x7FFF)
        self._milliampere.value = round(signals.current_a * 1e3)

    def _read_link(self, _signals: DriveSignals) -> None:
        counts, time_s = self._rig.link_counts(), self._rig.time_s
        self._link.value = (counts + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        elapsed_s = time_s - self._link_time_s
        if elapsed_s > 0.0:
            self._link_velocity.value = _limited((counts - self._link_counts) / elapsed_s, 0x7FFF_FFFF)
            self._link_counts, self._link_time_s = counts, time_s

    def _statusword(self) -> int:
        word = self.machine.state | _VOLTAGE | _REMOTE
        if self._following and self.machine.state is PowerState.OPERATION_ENABLED:
            if self._limiting:
                word |= _LIMIT
            if self._mode.value == _CYCLIC_TORQUE:
                word |= _FOLLOWS
            elif self._reached:
                word |= _TARGET_REACHED
        if self.quirks.toggle_bit_10:
            word = word & ~_TOGGLE | self._toggle
        return word

    # NMT

    def on_reset_node(self) -> None:
        """Switch on disabled, no command, power-on units."""
        self.machine.reset()
        self._demand = 0.0
        self._following = False
        self._take_units()
        self._rig.command(self._motor, None)
        self._measure()

    def on_leave_operational(self) -> None:
        """Stop an enabled drive without its master."""
        if self.state in (Nmt.STOPPED, Nmt.INITIALISING):
            self.on_connection_lost()

    def on_connection_lost(self) -> None:
        """React as 0x6007 says, if the drive is enabled."""
        if self.machine.state is not PowerState.OPERATION_ENABLED:
            return
        option = self.dictionary.optional(0x6007).number
        if option == _FAULT_SIGNAL:
            self.fault(_HEARTBEAT_LOST, 0x10)
        elif option == _DISABLE_VOLTAGE:
            self.machine.state = PowerState.SWITCH_ON_DISABLED
        elif option == _QUICK_STOP:
            self.machine.state = PowerState.QUICK_STOP_ACTIVE
