"""How late is the link encoder? A one-dimensional search over the last seconds, a small piece at a tick.

On a stiff joint one period of delay moves q by more than the transmission deflects, so nothing linear
repairs it: phi has to be formed anew for each candidate. The search is a generator, so that the loop that
owns it never waits for it.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from estimator.filters import StateVariableFilter
from estimator.sample import FloatArray

__all__ = ["DelaySearch"]

_WINDOW_S = 2.0
_LOOKS_S = (2.0, 6.0, 20.0)  # after a start: when it is searched
_LATEST = 3.0  # periods to either side
_ROW_HZ = 100.0
_PIECE = 10  # rows at a tick
_GAIN = 0.8  # the error has to fall to this share, else no delay is assumed
_LATER_GAIN = 0.5  # … to this one once there has been a search
_INERTIA, _DAMPING = 0.05, 0.3  # prior std, relative
_DAMPING_SHARE = 0.02  # of the torque at the largest velocity


class DelaySearch:
    """Collects link position, motor position and torque; now and then looks for the delay between them.

    Args:
        inertia: B. damping: D.
        bandwidth_rad_s: of the filter that the channels pass.
        period_s: T.
    """

    def __init__(self, inertia: float, damping: float, bandwidth_rad_s: float, period_s: float) -> None:
        self._B, self._D, self._T = inertia, damping, period_s
        self._filter = StateVariableFilter(4, bandwidth_rad_s, period_s)
        self._length = round(_WINDOW_S / period_s)
        self._settle = min(self._filter.settling_periods, self._length // 4)
        # Only some rows are wanted, so the filter is applied there as a sum over its past.
        self._smooth = self._filter.impulse(self._settle + 1)[::-1].copy()
        self._held = self._filter.impulse(self._settle + 1, held=True)[::-1].copy()
        self._stride = max(1, round(1.0 / (_ROW_HZ * period_s)))
        self._ring = np.zeros((self._length, 3))
        self.restart()

    def restart(self) -> None:
        """The past is over."""
        self._seen = 0
        self._looks = [round(look / self._T) for look in _LOOKS_S]
        self._job: Iterator[float | None] | None = None
        self.looked = False  # whether there has been a search since the start

    def postpone(self) -> None:
        """The channels have been realigned: collect anew."""
        self._seen = 0
        self._job = None

    @property
    def busy(self) -> bool:
        """Whether a search is going on, and wants `work` to be called at every tick."""
        return self._job is not None

    def see(self, block: FloatArray) -> None:
        """Link position, motor position and torque at consecutive ticks, (n, 3)."""
        if not self._looks:
            return
        at = self._seen % self._length
        room = self._length - at
        self._ring[at : at + len(block)] = block[:room]
        if room < len(block):
            self._ring[: len(block) - room] = block[room:]
        self._seen += len(block)
        if self._job is None and self._seen >= max(self._looks[0], self._length):
            self._looks.pop(0)
            past = np.roll(self._ring, -(self._seen % self._length), axis=0)
            self._job = self._search(past)

    def work(self) -> float | None:
        """A small piece of the search; the delay of the link in periods when it has been found, else None."""
        if self._job is None:
            return None
        try:
            return next(self._job)
        except StopIteration:
            self._job = None
            self.looked = True
            return None

    def _search(self, past: FloatArray) -> Iterator[float | None]:
        q, theta = past[:, 0], past[:, 1]
        _, velocity, acceleration = yield from self._rows(theta, self._smooth, 3)
        (torque,) = yield from self._rows(past[:, 2], self._held, 1)
        balance = self._B * acceleration + self._D * velocity - torque
        size = float(np.std(balance))
        if not size > 0.0 or not np.std(q - theta) > 0.0:
            return
        A = np.stack([balance, balance, acceleration, velocity, np.ones(len(balance))], axis=1)
        rate = float(np.max(np.abs(velocity))) + 1e-12
        prior = np.array([_INERTIA * self._B, _DAMPING * self._D + _DAMPING_SHARE * size / rate, size])
        costs: dict[float, float] = {}

        def look(delay: float) -> Generator[None, None, None]:
            late = _shifted(q, delay)
            yield
            phi = late - theta
            yield
            (first,) = yield from self._rows(phi, self._smooth, 1)
            scaled = phi / (np.abs(phi).max() + 1e-15)
            yield
            cube = scaled * scaled * scaled
            yield
            (third,) = yield from self._rows(cube, self._smooth, 1)
            A[:, 0], A[:, 1] = first, third
            yield
            costs[delay] = _cost(A, balance, prior)
            yield

        for delay in np.arange(-_LATEST, _LATEST + 0.1, 0.5).tolist():
            for _ in look(delay):
                yield None
        step = 0.5
        for _ in range(4):
            best = min(costs, key=costs.__getitem__)
            step *= 0.4
            for delay in (best - step, best + step):
                for _ in look(delay):
                    yield None
        best = min(costs, key=costs.__getitem__)
        gain = _LATER_GAIN if self.looked else _GAIN
        if costs[best] < gain**2 * costs[0.0]:
            yield best

    def _rows(
        self, signal: FloatArray, response: FloatArray, derivatives: int
    ) -> Generator[None, None, FloatArray]:
        """The filtered signal and its derivatives at about 100 rows a second, (derivatives, rows)."""
        windows = sliding_window_view(signal - signal[0], self._settle + 1)[:: self._stride]
        out = np.empty((derivatives, len(windows)))
        for k in range(0, len(windows), _PIECE):
            out[:, k : k + _PIECE] = (windows[k : k + _PIECE] @ response[:, :derivatives]).T
            yield
        out[0] += signal[0]
        return out


def _shifted(signal: FloatArray, periods: float) -> FloatArray:
    """The signal so many periods later, along straight lines; its ends stay where they are."""
    whole = int(np.floor(periods))
    share = periods - whole
    n = len(signal)
    padded = np.empty(n + 8)
    padded[:4], padded[4:-4], padded[-4:] = signal[0], signal, signal[-1]
    later = padded[4 + whole : 4 + whole + n + 1]
    return np.asarray(later[:-1] + share * (later[1:] - later[:-1]))


def _cost(A: FloatArray, y: FloatArray, prior: FloatArray) -> float:
    """Sum of squared errors with the motor's own parameters held near what is declared."""
    gram = A.T @ A
    scale = np.sqrt(gram.diagonal()) + 1e-300
    gram /= scale[:, None] * scale
    noise = 1e-3 * float(y @ y) / len(y)
    held = np.full(5, 1e-12)
    held[2:] += 10.0 * noise / (prior * scale[2:]) ** 2
    gram.ravel()[::6] += held
    error = y - A @ (np.linalg.solve(gram, (y @ A) / scale) / scale)
    return float(error @ error)
