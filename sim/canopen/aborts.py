"""SDO abort codes (CiA 301, 7.2.4.3.17); `canopen.SdoAbortedError` carries one to the client."""

from __future__ import annotations

from enum import IntEnum

from canopen.sdo.exceptions import SdoAbortedError

__all__ = ["Abort", "SdoAbortedError"]


class Abort(IntEnum):
    """The codes that a simulated device answers with, besides those of canopen's server."""

    TIMEOUT = 0x05040000
    COMMAND = 0x05040001  # client/server command specifier not valid
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    DATA_TRANSFER = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024
