"""The asyncio side of a joint: `drivelink.subscribe_async("elbow")`.

async with drivelink.subscribe_async("elbow") as joint:
    async for estimate in joint:
        use(estimate.stiffness_nm_rad)
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import zenoh

from drivelink.pubsub.clientbase import ENDPOINT, Client
from drivelink.pubsub.names import PATIENCE_S
from drivelink.pubsub.wire import EstimateMessage


class AsyncSubscription(Client):
    """Estimates of one joint for asyncio; see `subscribe_async`."""

    async def wait(self, timeout_s: float | None = None) -> EstimateMessage | None:
        """Return the next cycle: the newest estimate that was not read yet, or None when the time is over."""
        return await self._wait(timeout_s, self._newest)

    async def cycles(self, timeout_s: float | None = None) -> AsyncIterator[EstimateMessage | None]:
        """Yield every estimate in order; None whenever `timeout_s` passed without one. Ends when closed."""
        while not self._closed:
            message = await self._wait(timeout_s, self._oldest)
            if message is not None or not self._closed:
                yield message

    async def __aiter__(self) -> AsyncIterator[EstimateMessage]:
        async for message in self.cycles():
            if message is not None:
                yield message

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave; a second time does nothing."""
        super().close()
        if hasattr(self, "_arrived"):
            self._arrived.set()

    def _declare_estimates(self, key: str) -> zenoh.Subscriber[Any]:
        self._loop = asyncio.get_running_loop()
        self._arrived = asyncio.Event()
        self._loop.call_later(PATIENCE_S + 0.01, self._drain)
        self._inbox: deque[zenoh.Sample] = deque(maxlen=self._depth)
        # indirect=False: in zenoh's thread, which never keeps the process from ending
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        return self._session.declare_subscriber(key, handler)

    def _receive(self, sample: zenoh.Sample) -> None:
        self._inbox.append(sample)
        with suppress(RuntimeError):  # the loop has ended before the subscription
            self._loop.call_soon_threadsafe(self._arrived.set)

    def _pop(self) -> zenoh.Sample | None:
        return self._inbox.popleft() if self._inbox else None

    async def _wait(
        self, timeout_s: float | None, pick: Callable[[], EstimateMessage | None]
    ) -> EstimateMessage | None:
        self._drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while (message := pick()) is None and not self._closed:
                    self._arrived.clear()
                    await self._arrived.wait()
                    self._drain()
                return message
        return None


def subscribe_async(
    joint: str,
    *,
    endpoint: str = ENDPOINT,
    config: str | Path | None = None,
    prefix: str = "drivelink",
    session: zenoh.Session | None = None,
    depth: int = 1024,
    stale_after_s: float | None = None,
) -> AsyncSubscription:
    """Return the same as `subscribe` for asyncio, to be called in a running loop.

    Raises:
        ZenohError: no session can be opened, or a name cannot be part of a key.
    """
    return AsyncSubscription(
        joint,
        endpoint=endpoint,
        config=config,
        prefix=prefix,
        session=session,
        depth=depth,
        stale_after_s=stale_after_s,
    )
