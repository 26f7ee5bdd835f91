"""The power drive system's state machine (CiA 402-2, 8.4; IEC 61800-7-201)."""

from __future__ import annotations

from enum import IntEnum

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
        """Take the automatic transitions of a cycle: end of the fault reaction and of a quick stop."""
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
