"""Profiles of well-known makers' drives, and of devices with one unusual behaviour.

Their objects are in `sim/eds`, after public EDS and DCF files and manuals; names and vendor ids are not the
makers'. Here is what an EDS file cannot express.
"""

from dataclasses import dataclass

from sim.errors import SimError, expected


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirks:
    """Deviations of one maker's drive from the strict one."""

    name: str = "strict"  # how the profile is called
    differs: str = "default: none"  # how, in a few words
    # its shipped EDS file, without the ending: objects, access, power-on values, TPDOs
    eds: str = "cia402-drive"
    # 0x1008 and product code (0x1018:02), where they differ from the EDS file
    identity: tuple[str, int] | None = None
    current_ma: tuple[int, int] | None = None  # vendor object with the current in mA (i32)
    # unit of velocities as in 0x60A9, for a drive without that object
    velocity_unit: int = 0xFDB4_4700  # 0.001 rpm
    velocity_exponents: tuple[int, ...] = tuple(range(-9, 1))  # powers of ten that 0x60A9 accepts
    second_encoder: int = 1  # subindex of 0x60E4 at which a link encoder is found
    keep_bit_30: bool = False  # aborts a COB-ID write that changes bit 30
    fixed_mapping: bool = False  # mapping cannot be written, communication parameters can
    fixed_pdos: bool = False  # nothing of the PDO parameters can be written
    mapping_in_preoperational: bool = False  # mapping is refused in operational
    objects_per_pdo: int = 8  # more are refused
    toggle_bit_10: bool = False  # statusword bit 10 toggles with each transmitted sample (Beckhoff EL72x1)
    self_starting: bool = False  # enters operational by itself after boot-up
    keeps_pdos: bool = False  # *reset communication* leaves the PDO parameters as they are
    boot_s: float = 0.0  # from a reset to the boot-up message


_RPM, _COUNTS_PER_S, _TENTH_COUNTS_PER_S = 0x00B4_4700, 0x00B5_0300, 0xFFB5_0300  # as 0x60A9


def _like(name: str, product_code: int) -> tuple[str, int]:
    return f"drivelink simulated drive, {name}-like", product_code


PROFILES: dict[str, Quirks] = {
    quirks.name: quirks
    for quirks in (
        Quirks(),
        Quirks(name="epos4", eds="epos4", current_ma=(0x30D1, 2), differs=
               "no 0x6063, 0x6075, 0x6078, 0x607E, 0x608F, 0x6091, 0x1006, 0x1019, 0x1800:05; current in "
               "mA at 0x30D1:02; 0x1005 constant; TPDO type 255 with 1 ms inhibit time; whole rpm"),
        Quirks(name="elmo", eds="elmo", velocity_unit=_COUNTS_PER_S,
               differs="velocity in counts/s without 0x60A9; TPDO1 and TPDO3 on with type 1"),
        Quirks(name="nanotec", eds="nanotec", second_encoder=2, differs=
               "0x60E4:01 sensorless, link encoder 0x60E4:02; no 0x6076, 0x6078; eight TPDOs, the first "
               "four event-driven"),
        Quirks(name="copley", eds="copley", velocity_unit=_TENTH_COUNTS_PER_S,
               differs="no second encoder, no polarity; velocity in 0.1 counts/s without 0x60A9"),
        Quirks(name="roboteq", eds="roboteq", velocity_unit=_RPM, keep_bit_30=True, self_starting=True,
               differs="aborts if bit 30 of a COB-ID changes; starts itself; few objects"),
        Quirks(name="synapticon", eds="synapticon", mapping_in_preoperational=True,
               velocity_exponents=(0, -1, -2, -3), differs="mapping in pre-operational only; 0.001 to 1 rpm"),
        Quirks(name="fixed-map", eds="fixed-map", fixed_mapping=True,
               differs="mapping read only: TPDO2 carries statusword, position, torque"),
        Quirks(name="el72x1", identity=_like("EL72x1", 0x7201), toggle_bit_10=True,
               differs="statusword bit 10 toggles"),
        Quirks(name="self-starting", identity=_like("self-starting", 0x0F02), self_starting=True,
               differs="operational after boot-up"),
        Quirks(name="keeps-pdos", identity=_like("PDO-keeping", 0x0F03), keeps_pdos=True,
               differs="*reset communication* keeps the PDOs"),
        Quirks(name="slow-boot", identity=_like("slow-boot", 0x0F04), boot_s=1.5,
               differs="1.5 s from reset to boot-up"),
    )
}  # fmt: skip
"""By name, in the order shown to users."""


def profile(name: str) -> Quirks:
    """Return the profile of that name.

    Raises:
        SimError: there is none.
    """
    if name not in PROFILES:
        raise SimError(f'quirks "{name}": {expected(name, PROFILES)}')
    return PROFILES[name]
