"""Profiles of well-known makers' drives, and of devices with one unusual behaviour.

Their objects are in `sim/eds`, after public EDS and DCF files and manuals; names and vendor ids are not the
makers'. Here is what an EDS file cannot express.
"""

from __future__ import annotations

from sim.canopen.quirks import Quirks
from sim.errors import SimError

_RPM, _COUNTS_PER_S, _TENTH_COUNTS_PER_S = 0x00B4_4700, 0x00B5_0300, 0xFFB5_0300  # as 0x60A9


def _like(name: str, product_code: int) -> tuple[str, int]:
    return f"drivelink simulated drive, {name}-like", product_code


PROFILES: dict[str, Quirks] = {
    quirks.name: quirks
    for quirks in (
        Quirks(),
        Quirks(name="epos4", eds="epos4", current_ma=(0x30D1, 2)),
        Quirks(name="elmo", eds="elmo", velocity_unit=_COUNTS_PER_S),
        Quirks(name="nanotec", eds="nanotec", second_encoder=2),
        Quirks(name="copley", eds="copley", velocity_unit=_TENTH_COUNTS_PER_S),
        Quirks(name="roboteq", eds="roboteq", velocity_unit=_RPM, keep_bit_30=True, self_starting=True),
        Quirks(
            name="synapticon",
            eds="synapticon",
            mapping_in_preoperational=True,
            velocity_exponents=(0, -1, -2, -3),
        ),
        Quirks(name="fixed-map", eds="fixed-map", fixed_mapping=True),
        Quirks(name="el72x1", identity=_like("EL72x1", 0x7201), toggle_bit_10=True),
        Quirks(name="self-starting", identity=_like("self-starting", 0x0F02), self_starting=True),
        Quirks(name="keeps-pdos", identity=_like("PDO-keeping", 0x0F03), keeps_pdos=True),
        Quirks(name="slow-boot", identity=_like("slow-boot", 0x0F04), boot_s=1.5),
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
