"""EMCY messages and statuswords in words (CiA 301, 7.2.7; CiA 402-2, 8.4)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import StrEnum

_EMCY = struct.Struct("<HB5s")

# Error codes of CiA 301 (table 26) and CiA 402-2 (annex); the most specific entry that matches is taken.
_CODES = {
    0x0000: "error reset or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current, device input side",
    0x2200: "current inside the device",
    0x2250: "continuous overcurrent inside the device",
    0x2300: "current, device output side",
    0x2310: "continuous overcurrent",
    0x2311: "continuous overcurrent no. 1",
    0x2312: "continuous overcurrent no. 2",
    0x2320: "short circuit or earth leakage",
    0x2330: "earth leakage",
    0x2340: "short circuit",
    0x2350: "load level (I²t, thermal state)",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3110: "mains overvoltage",
    0x3120: "mains undervoltage",
    0x3130: "phase failure",
    0x3200: "voltage inside the device",
    0x3210: "DC link overvoltage",
    0x3211: "overvoltage no. 1",
    0x3212: "overvoltage no. 2",
    0x3220: "DC link undervoltage",
    0x3221: "undervoltage no. 1",
    0x3222: "undervoltage no. 2",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "device temperature",
    0x4210: "excess temperature of the device",
    0x4220: "too low temperature of the device",
    0x4300: "drive temperature",
    0x4310: "excess temperature of the drive",
    0x5000: "device hardware",
    0x5100: "supply",
    0x5112: "supply, low voltage +24 V",
    0x5113: "supply, low voltage +5 V",
    0x5200: "control hardware",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5441: "contactor",
    0x5500: "data storage",
    0x5530: "non-volatile memory",
    0x6000: "device software",
    0x6010: "software reset (watchdog)",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data set",
    0x6320: "parameter error",
    0x7000: "additional modules",
    0x7100: "power modules",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7200: "measurement circuit",
    0x7300: "sensor",
    0x7303: "resolver 1",
    0x7304: "resolver 2",
    0x7305: "incremental sensor 1",
    0x7306: "incremental sensor 2",
    0x7310: "speed sensor",
    0x7320: "position sensor",
    0x7400: "computation circuit",
    0x7500: "communication",
    0x7600: "data storage, external",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN-ID collision",
    0x8200: "protocol error",
    0x8210: "PDO not processed because of its length",
    0x8220: "PDO length exceeded",
    0x8230: "DAM MPDO not processed",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO timeout",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8400: "velocity control",
    0x8500: "position control",
    0x8600: "positioning control",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "SYNC control",
    0x8A00: "excess deceleration or velocity",
    0x9000: "external error",
    0xF000: "additional functions",
    0xF001: "deceleration",
}
_REGISTER = ("generic", "current", "voltage", "temperature", "communication", "profile", "reserved", "vendor")


@dataclass(frozen=True, slots=True)
class Emergency:
    """An EMCY message.

    Attributes:
        code: error code; 0x00xx resets.
        register: 0x1001.
        vendor: the five bytes of the maker.
    """

    code: int
    register: int
    vendor: bytes

    @property
    def is_reset(self) -> bool:
        """Whether it says that the error is gone."""
        return self.code & 0xFF00 == 0

    def __str__(self) -> str:
        bits = [name for bit, name in enumerate(_REGISTER) if self.register >> bit & 1]
        text = f"EMCY 0x{self.code:04X} ({emergency_text(self.code)})"
        text += f", error register 0x{self.register:02X}" + (f" ({', '.join(bits)})" if bits else "")
        return text + (f", vendor {self.vendor.hex(' ')}" if any(self.vendor) else "")


def emergency_text(code: int) -> str:
    """What an error code means; 0xFFxx is the maker's."""
    if code & 0xFF00 == 0xFF00:
        return "device specific"
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        if code & mask in _CODES and (code & mask or not code & 0xFF00):
            return _CODES[code & mask]
    return "unknown"


def parse_emergency(data: bytes) -> Emergency | None:
    """An EMCY's bytes; None where there are too few to say anything."""
    if len(data) < 2:
        return None
    return Emergency(*_EMCY.unpack(bytes(data[:8]).ljust(8, b"\0")))


class DriveState(StrEnum):
    """States of the power drive system (CiA 402-2, table 30)."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "unknown"


_STATES = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)


def drive_state(statusword: int) -> DriveState:
    """The state in a statusword; bits that toggle or belong to modes are ignored."""
    for mask, value, state in _STATES:
        if statusword & mask == value:
            return state
    return DriveState.UNKNOWN
