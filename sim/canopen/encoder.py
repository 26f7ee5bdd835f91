"""A CiA 406 encoder as a CANopen slave."""

from dataclasses import replace

from sim.canopen.dictionary import Abort, SdoAbortedError
from sim.canopen.edsfile import data_sheet
from sim.canopen.node import Node
from sim.canopen.profiles import Quirks
from sim.world import World

SCALING, REVERSED = 0x04, 0x01  # bits of 0x6000

_FASTEST = 0x7FFF
_OPERATING_BITS = SCALING | REVERSED


class Cia406Encoder(Node):
    """The encoder at the link.

    Args:
        range_counts: where the position rolls over, 2 to 2**32.
    """

    sends_on_change = False  # CiA 406: the asynchronous TPDO goes by the cyclic timer

    def __init__(
        self, node_id: int, scale: World, quirks: Quirks | None = None, *, range_counts: int = 1 << 32
    ) -> None:
        self._scale, self._range_counts = scale, range_counts
        self._counts_per_rev = counts = round(scale.encoder.counts_per_rev)
        plate: dict[tuple[int, int], int | str] = {
            (0x6001, 0): counts,
            (0x6002, 0): min(0xFFFF_FFFF, range_counts),
            (0x6501, 0): counts,
            (0x6502, 0): min(0xFFFF, max(1, range_counts // counts)),
        }
        quirks = replace(quirks or Quirks(), eds="cia406-encoder")
        super().__init__(node_id, data_sheet(quirks.eds, frozenset(plate.items())), quirks)
        find = self.dictionary.find
        self._position, self._speed = find(0x6004, 0), find(0x6030, 1)
        self._offset, self._preset = find(0x6509, 0), find(0x6003, 0)
        self._operating, self._status = find(0x6000, 0), find(0x6500, 0)
        self._units, self._range = find(0x6001, 0), find(0x6002, 0)
        self._cyclic, self._event = find(0x6200, 0), find(0x1800, 5)
        self._last = scale.link_counts()
        self._last_s = scale.time_s
        self._watch()

    def _watch(self) -> None:
        self._position.refresh = self._speed.refresh = self._measure
        self._preset.check = self._check_preset
        self._preset.changed = self._take_preset
        self._operating.check = self._check_operating
        self._operating.changed = self._take_operating
        self._units.check = self._check_units
        self._range.check = self._check_range
        self._cyclic.changed = self._take_cyclic

    def _check_preset(self, value: int) -> None:
        if value >= self._modulus:
            raise SdoAbortedError(Abort.TOO_HIGH)

    def _check_operating(self, value: int) -> None:
        if value & ~_OPERATING_BITS:
            raise SdoAbortedError(Abort.INVALID_VALUE)

    def _check_units(self, value: int) -> None:
        if not 1 <= value <= self._counts_per_rev:
            raise SdoAbortedError(Abort.TOO_HIGH if value else Abort.TOO_LOW)

    def _check_range(self, value: int) -> None:
        if not 2 <= value <= min(0xFFFF_FFFF, self._range_counts):
            raise SdoAbortedError(Abort.TOO_HIGH if value > 1 else Abort.TOO_LOW)

    @property
    def _modulus(self) -> int:
        if self._operating.number & SCALING and self._range.number != 0xFFFF_FFFF:
            return self._range.number
        return self._range_counts

    def _raw(self, counts: int) -> int:
        if self._operating.number & REVERSED:
            counts = -counts
        if self._operating.number & SCALING:
            counts = counts * self._units.number // self._counts_per_rev
        return counts

    def _take_operating(self) -> None:
        self._status.value = self._operating.value
        self._measure()

    def _take_preset(self) -> None:
        """Set the offset (0x6509) so that the present position reads as the preset value."""
        offset = (self._preset.number - self._raw(self._scale.link_counts())) % self._modulus
        self._offset.value = offset - (1 << 32) if offset > 0x7FFF_FFFF else offset
        self._measure()

    def _take_cyclic(self) -> None:
        """The cyclic timer is the event timer of TPDO1 (CiA 406, 0x6200)."""
        self._event.write(self._cyclic.number)

    def on_sample(self) -> None:
        """Read the scale."""
        self._measure()

    def _measure(self) -> None:
        counts, time_s = self._scale.link_counts(), self._scale.time_s
        self._position.value = (self._raw(counts) + self._offset.number) % self._modulus
        elapsed_s = time_s - self._last_s
        if elapsed_s > 0.0:
            speed = round((self._raw(counts) - self._raw(self._last)) / elapsed_s)
            self._speed.value = max(-_FASTEST, min(_FASTEST, speed))
            self._last, self._last_s = counts, time_s

    def on_reset_node(self) -> None:
        """Restore the power-on scaling."""
        self._take_operating()
