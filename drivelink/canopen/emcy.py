"""EMCY messages, NMT states and statuswords in words (CiA 301, 7.2.7, 7.2.8; CiA 402-2, 8.4)."""

import struct
from dataclasses import dataclass

from canopen.profiles.p402 import State402

_EMCY = struct.Struct("<HB5s")

# Error codes of CiA 301 (table 26) and CiA 402-2 (annex); the most specific entry that matches is taken.
_TABLE = """
0000 error reset or no error; 1000 generic error; 2000 current; 2100 current, device input side;
2200 current inside the device; 2250 continuous overcurrent inside the device;
2300 current, device output side; 2310 continuous overcurrent; 2311 continuous overcurrent no. 1;
2312 continuous overcurrent no. 2; 2320 short circuit or earth leakage; 2330 earth leakage;
2340 short circuit; 2350 load level (I²t, thermal state); 3000 voltage; 3100 mains voltage;
3110 mains overvoltage; 3120 mains undervoltage; 3130 phase failure; 3200 voltage inside the device;
3210 DC link overvoltage; 3211 overvoltage no. 1; 3212 overvoltage no. 2; 3220 DC link undervoltage;
3221 undervoltage no. 1; 3222 undervoltage no. 2; 3300 output voltage; 4000 temperature;
4100 ambient temperature; 4200 device temperature; 4210 excess temperature of the device;
4220 too low temperature of the device; 4300 drive temperature; 4310 excess temperature of the drive;
5000 device hardware; 5100 supply; 5112 supply, low voltage +24 V; 5113 supply, low voltage +5 V;
5200 control hardware; 5300 operating unit; 5400 power section; 5441 contactor; 5500 data storage;
5530 non-volatile memory; 6000 device software; 6010 software reset (watchdog); 6100 internal software;
6200 user software; 6300 data set; 6320 parameter error; 7000 additional modules; 7100 power modules;
7110 brake chopper; 7120 motor; 7121 motor blocked; 7122 motor error or commutation malfunction;
7200 measurement circuit; 7300 sensor; 7303 resolver 1; 7304 resolver 2; 7305 incremental sensor 1;
7306 incremental sensor 2; 7310 speed sensor; 7320 position sensor; 7400 computation circuit;
7500 communication; 7600 data storage, external; 8000 monitoring; 8100 communication;
8110 CAN overrun, objects lost; 8120 CAN in error passive mode; 8130 life guard or heartbeat error;
8140 recovered from bus-off; 8150 CAN-ID collision; 8200 protocol error;
8210 PDO not processed because of its length; 8220 PDO length exceeded; 8230 DAM MPDO not processed;
8240 unexpected SYNC data length; 8250 RPDO timeout; 8300 torque control; 8311 excess torque;
8400 velocity control; 8500 position control; 8600 positioning control; 8611 following error;
8612 reference limit; 8700 SYNC control; 8A00 excess deceleration or velocity; 9000 external error;
F000 additional functions; F001 deceleration
"""
_CODES = {int(row[:4], 16): row[5:] for row in _TABLE.strip().replace("\n", " ").split("; ")}
_REGISTER = ("generic", "current", "voltage", "temperature", "communication", "profile", "reserved", "vendor")


@dataclass(frozen=True, slots=True)
class Emergency:
    """An EMCY message."""

    code: int  # error code; 0x00xx resets
    register: int  # 0x1001
    vendor: bytes  # the five bytes of the maker

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
    """Return what an error code means; 0xFFxx is the maker's."""
    if code & 0xFF00 == 0xFF00:
        return "device specific"
    for mask in (0xFFFF, 0xFFF0, 0xFF00, 0xF000):
        if code & mask in _CODES and (code & mask or not code & 0xFF00):
            return _CODES[code & mask]
    return "unknown"


def parse_emergency(data: bytes) -> Emergency | None:
    """Return an EMCY's bytes; None where there are too few to say anything."""
    if len(data) < 2:
        return None
    return Emergency(*_EMCY.unpack(bytes(data[:8]).ljust(8, b"\0")))


def drive_state(statusword: int) -> str:
    """Return the state in a statusword (CiA 402-2, table 30), whatever toggles or depends on modes."""
    masks = State402.SW_MASK.items()
    return next((name.lower() for name, (mask, value) in masks if statusword & mask == value), "unknown")


NMT_STATES = {0x00: "boot-up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}


def nmt_state(state: int) -> str:
    """Return the state in a heartbeat."""
    return NMT_STATES.get(state, f"0x{state:02X}")
