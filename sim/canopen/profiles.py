"""Profiles of well-known makers' drives, and of devices with one unusual behaviour.

The object lists follow public EDS and DCF files and manuals; names and vendor ids are not the makers'.
"""

from __future__ import annotations

from sim.canopen.dictionary import DataType, Item
from sim.canopen.objects import Identity, PdoDefault, mapping, record, var
from sim.canopen.quirks import Quirks
from sim.errors import SimError

__all__ = ["PROFILES", "profile"]

_STATUS, _SHOWN_MODE = (0x6041, 0, 16), (0x6061, 0, 8)
_POSITION, _VELOCITY, _TORQUE = (0x6064, 0, 32), (0x606C, 0, 32), (0x6077, 0, 16)
_RPM, _MILLI_RPM = 0x00B4_4700, 0xFDB4_4700
_COUNTS_PER_S, _TENTH_COUNTS_PER_S = 0x00B5_0300, 0xFFB5_0300


def _identity(like: str, product_code: int) -> Identity:
    return Identity(name=f"drivelink simulated drive, {like}-like", product_code=product_code)


def _without(first: int, subindices: tuple[int, ...], count: int = 4) -> frozenset[tuple[int, int]]:
    return frozenset((first + n, subindex) for n in range(count) for subindex in subindices)


_EPOS4 = Quirks(
    name="epos4",
    identity=_identity("EPOS4", 0x0E04),
    missing=frozenset({0x1006, 0x1007, 0x1015, 0x1019, 0x1029, 0x6063, 0x6069, 0x6072, 0x6073, 0x6074})
    | frozenset({0x6075, 0x6078, 0x6079, 0x607E, 0x6087, 0x6088, 0x608F, 0x6091, 0x6092, 0x605D})
    | frozenset({0x60E6, 0x60EB})
    | _without(0x1800, (5, 6))
    | _without(0x1400, (5,)),
    constant=frozenset({0x1005, 0x1014}),
    defaults={(0x60A9, 0): _RPM},
    tpdos=(
        PdoDefault(base=0x180, inhibit=10, mapping=mapping(_STATUS)),
        PdoDefault(base=0x280, inhibit=10, enabled=False, mapping=mapping(_STATUS, _SHOWN_MODE)),
        PdoDefault(base=0x380, inhibit=10, enabled=False, mapping=mapping(_STATUS, _POSITION)),
        PdoDefault(base=0x480, inhibit=10, enabled=False, mapping=mapping(_STATUS, _VELOCITY)),
    ),
    extra=(
        record(
            0x30D1,
            "Current actual values",
            (
                Item(subindex=1, name="Current actual value averaged", type=DataType.INTEGER32, pdo=True),
                Item(subindex=2, name="Current actual value", type=DataType.INTEGER32, pdo=True),
            ),
        ),
    ),
    current_ma=(0x30D1, 2),
)

_ELMO = Quirks(
    name="elmo",
    identity=_identity("Elmo", 0x0E10),
    missing=frozenset({0x1019, 0x1007, 0x60A8, 0x60A9, 0x60E6, 0x60EB}) | _without(0x1800, (6,)),
    defaults={(0x60A9, 0): _COUNTS_PER_S},
    tpdos=(
        PdoDefault(base=0x180, type=1, mapping=mapping(_STATUS, _SHOWN_MODE)),
        PdoDefault(base=0x280, type=255),
        PdoDefault(base=0x380, type=1, mapping=mapping(_VELOCITY, _POSITION)),
        PdoDefault(base=0x480, type=255),
    ),
)

_NANOTEC = Quirks(
    name="nanotec",
    identity=_identity("Nanotec", 0x0C14),
    missing=frozenset({0x1006, 0x6069, 0x6076, 0x6078, 0x6079}),
    defaults={(0x60A9, 0): _RPM},
    tpdos=(
        PdoDefault(base=0x180, mapping=mapping(_STATUS, _SHOWN_MODE)),
        PdoDefault(base=0x280, mapping=mapping(_POSITION), inhibit=10),
        PdoDefault(base=0x380, mapping=mapping((0x6044, 0, 16)), inhibit=10),
        PdoDefault(base=0x480, mapping=mapping((0x60FD, 0, 32)), inhibit=10),
        *(PdoDefault(base=base, enabled=False) for base in (0x180, 0x280, 0x380, 0x480)),
    ),
    extra=(var(0x6044, "vl velocity actual value", DataType.INTEGER16, pdo=True),),
    second_encoder=2,
)

_COPLEY = Quirks(
    name="copley",
    identity=_identity("Copley", 0x0C0B),
    missing=frozenset({0x1007, 0x6063, 0x6078, 0x607E, 0x60A8, 0x60A9, 0x60E4, 0x60E5, 0x60E6, 0x60EB})
    | _without(0x1800, (6,)),
    defaults={(0x60A9, 0): _TENTH_COUNTS_PER_S},
)

_ROBOTEQ = Quirks(
    name="roboteq",
    identity=_identity("Roboteq", 0x0B0B),
    missing=frozenset({0x1006, 0x1007, 0x1019, 0x1029, 0x6063, 0x6069, 0x6074, 0x6075, 0x6078, 0x6079})
    | frozenset({0x607E, 0x608F, 0x6091, 0x6092, 0x60A8, 0x60A9, 0x60E4, 0x60E5, 0x60E6, 0x60EB, 0x60B2})
    | _without(0x1800, (3, 6)),
    defaults={(0x60A9, 0): _RPM},
    keep_bit_30=True,
    self_starting=True,
)

_SYNAPTICON = Quirks(
    name="synapticon",
    identity=_identity("Synapticon", 0x0501),
    missing=frozenset({0x6069, 0x6078, 0x60E5, 0x1006}),
    defaults={(0x60A9, 0): _RPM},
    mapping_in_preoperational=True,
    velocity_exponents=(0, -1, -2, -3),
)

_FIXED = Quirks(
    name="fixed-map",
    identity=_identity("fixed-map", 0x0F01),
    fixed_mapping=True,
    defaults={(0x60A9, 0): _MILLI_RPM},
    tpdos=(
        PdoDefault(base=0x180, type=255, mapping=mapping(_STATUS)),
        PdoDefault(base=0x280, type=1, mapping=mapping(_STATUS, _POSITION, _TORQUE)),
        PdoDefault(base=0x380, type=1, enabled=False, mapping=mapping((0x60E4, 1, 32), _VELOCITY)),
    ),
)

PROFILES: dict[str, Quirks] = {
    quirks.name: quirks
    for quirks in (
        Quirks(),
        _EPOS4,
        _ELMO,
        _NANOTEC,
        _COPLEY,
        _ROBOTEQ,
        _SYNAPTICON,
        _FIXED,
        Quirks(name="el72x1", identity=_identity("EL72x1", 0x7201), toggle_bit_10=True),
        Quirks(name="self-starting", identity=_identity("self-starting", 0x0F02), self_starting=True),
        Quirks(name="keeps-pdos", identity=_identity("PDO-keeping", 0x0F03), keeps_pdos=True),
        Quirks(name="slow-boot", identity=_identity("slow-boot", 0x0F04), boot_s=1.5),
    )
}
"""By name, in the order shown to users."""


def profile(name: str) -> Quirks:
    """The profile of that name.

    Raises:
        SimError: there is none.
    """
    if name not in PROFILES:
        raise SimError(f'quirks: expected one of {", ".join(PROFILES)}, got "{name}"')
    return PROFILES[name]
