"""How makers' drives differ from the strict one, as data, after their manuals, EDS and DCF files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from sim.canopen.dictionary import Item, Object
from sim.canopen.objects import Identity, PdoDefault

__all__ = ["Quirks"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirks:
    """Deviations of one maker's drive from the strict one.

    Attributes:
        name: how the profile is called.
        identity: 0x1008 to 0x1018; None: the device's own.
        missing: objects, or (index, subindex), that do not exist.
        constant: objects that cannot be written.
        defaults: other power-on values, by (index, subindex).
        tpdos: its TPDOs as they are at power-on; None: the device's own.
        extra: vendor objects.
        current_ma: vendor object with the current in mA (i32).
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
    identity: Identity | None = None
    missing: frozenset[int | tuple[int, int]] = frozenset()
    constant: frozenset[int] = frozenset()
    defaults: Mapping[tuple[int, int], int] = field(default_factory=dict)
    tpdos: tuple[PdoDefault, ...] | None = None
    extra: tuple[Object, ...] = ()
    current_ma: tuple[int, int] | None = None
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

    def applied(self, objects: Iterable[Object]) -> Iterator[Object]:
        """The objects as this maker has them."""
        for described in (*objects, *self.extra):
            if described.index in self.missing:
                continue
            items = [
                self._applied(described.index, item)
                for item in described.items
                if (described.index, item.subindex) not in self.missing
            ]
            if len(items) > 1 and items[0].access == "const":  # the highest sub-index that is left
                items[0] = replace(items[0], default=items[-1].subindex)
            yield replace(described, items=tuple(items))

    def _applied(self, index: int, item: Item) -> Item:
        default = self.defaults.get((index, item.subindex), item.default)
        access = "const" if index in self.constant else item.access
        return replace(item, default=default, access=access)
