"""How makers' drives differ from the strict one, after their manuals, EDS and DCF files."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirks:
    """Deviations of one maker's drive from the strict one.

    Attributes:
        name: how the profile is called.
        eds: its shipped EDS file, without the ending: objects, access, power-on values, TPDOs.
        identity: 0x1008 and product code (0x1018:02), where they differ from the EDS file.
        current_ma: vendor object with the current in mA (i32).
        velocity_unit: unit of velocities as in 0x60A9, for a drive without that object.
        velocity_exponents: powers of ten that 0x60A9 accepts.
        second_encoder: subindex of 0x60E4 at which a link encoder is found.
        keep_bit_30: aborts a COB-ID write that changes bit 30.
        fixed_mapping: mapping cannot be written, communication parameters can.
        fixed_pdos: nothing of the PDO parameters can be written.
        mapping_in_preoperational: mapping is refused in operational.
        objects_per_pdo: more are refused.
        toggle_bit_10: statusword bit 10 toggles with each transmitted sample (Beckhoff EL72x1).
        self_starting: enters operational by itself after boot-up.
        keeps_pdos: *reset communication* leaves the PDO parameters as they are.
        boot_s: from a reset to the boot-up message.
    """

    name: str = "strict"
    eds: str = "cia402-drive"
    identity: tuple[str, int] | None = None
    current_ma: tuple[int, int] | None = None
    velocity_unit: int = 0xFDB4_4700  # 0.001 rpm
    velocity_exponents: tuple[int, ...] = tuple(range(-9, 1))
    second_encoder: int = 1
    keep_bit_30: bool = False
    fixed_mapping: bool = False
    fixed_pdos: bool = False
    mapping_in_preoperational: bool = False
    objects_per_pdo: int = 8
    toggle_bit_10: bool = False
    self_starting: bool = False
    keeps_pdos: bool = False
    boot_s: float = 0.0
