"""Every channel of a joint through the same filters, a block of periods in one matrix product.

Two stages. The first (G, light) is exact for what each channel is: held torques, smooth positions. What is
nonlinear in velocities (friction and the like) is formed behind it. The second (F, the bandwidth of the
regression) treats everything alike. So F G of every term of the torque balance is aligned with every
other one's, and whatever the two filters do to the signals cancels in the regression.

Both are linear, so N periods of x_k = A x_(k-1) + b0 u_(k-1) + b1 u_k are one product of a constant matrix
with the states and the N + 1 inputs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.filters import StateVariableFilter
from estimator.sample import FloatArray

__all__ = ["LIGHT_ORDER", "FilterBank"]

LIGHT_ORDER = 3  # value, rate and acceleration behind G
_LIGHT_RATIO = 5.0  # bandwidth of G over that of F
_ORDER = 4  # F: up to the third derivative, for the black-box estimator


class FilterBank:
    """Filter states of all channels: `measured` ones pass G and F, `formed` ones F alone.

    Args:
        smooth: number of measured channels that are straight between samples (positions); they come first.
        held: number of those that are held (torques); they come next.
        formed: number of channels that are formed from lightly filtered values.
        bandwidth_rad_s: of F.
        period_s: T.
        block: N, periods that are filtered at once.
    """

    def __init__(
        self, smooth: int, held: int, formed: int, bandwidth_rad_s: float, period_s: float, block: int
    ) -> None:
        self.main = StateVariableFilter(_ORDER, min(bandwidth_rad_s, 0.25 / period_s), period_s)
        self.light = StateVariableFilter(LIGHT_ORDER, _LIGHT_RATIO * self.main.bandwidth_rad_s, period_s)
        self.block = n = block
        self._smooth, self._measured = smooth, smooth + held
        light, hold, main = self.light.smooth, self.light.held, self.main.smooth
        zero = np.zeros(LIGHT_ORDER)
        # Rows of the states that G goes through: values of all periods, then their rates, accelerations.
        path, states = _path(light.advance, light.old, light.new, n)
        held_path, _ = _path(light.advance, hold.old, zero, n)
        along = np.concatenate([path, held_path[:, :, LIGHT_ORDER:]], axis=2)
        self._light = along.transpose(1, 0, 2).reshape(LIGHT_ORDER * n, -1)
        _, states = _path(main.advance, main.old, main.new, n)
        self._main = states
        # Rows: G's states; positions from the last one of the block before on; torques likewise.
        self._G = np.zeros((LIGHT_ORDER + 2 * (n + 1), self._measured))
        self._path = np.zeros((LIGHT_ORDER * n, self._measured))
        # Rows: F's states; its inputs from the last one of the block before on.
        self._F = np.zeros((_ORDER + n + 1, self._measured + formed))
        self._F_next = np.zeros((_ORDER, self._measured + formed))

    @property
    def delay_s(self) -> float:
        """Delay of a slow signal through G and F."""
        return LIGHT_ORDER / self.light.bandwidth_rad_s + _ORDER / self.main.bandwidth_rad_s

    def rest(self, positions: Sequence[float], torques: Sequence[float]) -> None:
        """As if these inputs had been there for ever, and nothing had been formed."""
        n, first = self._smooth, LIGHT_ORDER
        self._G[:] = 0.0
        self._G[0, :n] = self._G[first + self.block, :n] = positions
        self._G[0, n:] = self._G[-1, n:] = torques
        self._F[:] = 0.0
        self._F[0, : self._measured] = self._F[-1, : self._measured] = self._G[0]
        self._F_next[:] = self._F[:_ORDER]

    def pass_light(self, positions: FloatArray, torques: FloatArray) -> FloatArray:
        """One block through G.

        Args:
            positions: (N, smooth). torques: (N, held).

        Returns:
            Values, rates and accelerations at every period, (3, N, measured); overwritten by the next block.
        """
        n, split, states, first = self.block, self._smooth, self._G, LIGHT_ORDER
        states[first, :split] = states[first + n, :split]
        states[first + 1 : first + 1 + n, :split] = positions
        states[first + 1 + n, split:] = states[-1, split:]
        states[first + 2 + n :, split:] = torques
        np.dot(self._light, states, out=self._path)
        states[:first] = self._path[n - 1 :: n]
        return self._path.reshape(LIGHT_ORDER, n, self._measured)

    def pass_main(self, formed: FloatArray) -> None:
        """The same block through F, with the channels that have been formed from it, (N, formed)."""
        n, states = self.block, self._F
        states[_ORDER] = states[_ORDER + n]
        states[_ORDER + 1 :, : self._measured] = self._path[:n]
        states[_ORDER + 1 :, self._measured :] = formed
        np.dot(self._main, states, out=self._F_next)
        states[:_ORDER] = self._F_next

    def outputs(self) -> list[list[float]]:
        """F and its three derivatives of all channels, as (4, channels) nested lists."""
        values: list[list[float]] = self._F_next.tolist()
        return values

    def remember(self, periods: int) -> FloatArray:
        """Impulse responses (7, periods) of all states to a smooth channel, oldest input first."""
        g = np.zeros(LIGHT_ORDER)
        f = np.zeros(_ORDER)
        light, main = self.light.smooth, self.main.smooth
        out = np.empty((LIGHT_ORDER + _ORDER, periods))
        pulse, last, before = 1.0, 0.0, 0.0
        for k in range(periods):
            g = light.advance @ g + light.old * last + light.new * pulse
            f = main.advance @ f + main.old * before + main.new * g[0]
            out[:LIGHT_ORDER, periods - 1 - k], out[LIGHT_ORDER:, periods - 1 - k] = g, f
            pulse, last, before = 0.0, pulse, g[0]
        return out

    def replace(self, first: int, inputs: FloatArray, responses: FloatArray) -> None:
        """Give smooth channels from `first` on another past: inputs (periods, c) that started at rest."""
        count = inputs.shape[1]
        states = responses @ (inputs - inputs[0])
        states[0] += inputs[0]
        states[LIGHT_ORDER] += inputs[0]
        channels = slice(first, first + count)
        self._G[:LIGHT_ORDER, channels] = states[:LIGHT_ORDER]
        self._G[LIGHT_ORDER + self.block, channels] = inputs[-1]
        self._F[:_ORDER, channels] = self._F_next[:, channels] = states[LIGHT_ORDER:]
        self._F[-1, channels] = states[0]


def _path(
    advance: FloatArray, old: FloatArray, new: FloatArray, periods: int
) -> tuple[FloatArray, FloatArray]:
    """x_k = A x_(k-1) + b0 u_(k-1) + b1 u_k for k = 1 … N, from x_0 and u_0 … u_N.

    Returns:
        Matrices of all states, (N, n, n + N + 1), and of the last ones, (n, n + N + 1).
    """
    n = len(advance)
    out = np.zeros((periods, n, n + periods + 1))
    last = np.zeros((n, n + periods + 1))
    last[:, :n] = np.eye(n)
    for k in range(periods):
        last = advance @ last
        last[:, n + k] += old
        last[:, n + k + 1] += new
        out[k] = last
    return out, last
