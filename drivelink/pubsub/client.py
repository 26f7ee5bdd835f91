"""The Python side of a joint for a controller: `drivelink.subscribe("elbow")`, or `subscribe_async`.

    with drivelink.subscribe("elbow") as joint:
        while True:
            estimate = joint.wait(timeout_s=0.01)      # the next cycle, or None
            if estimate is not None and estimate.usable and not joint.stale:
                use(estimate.stiffness_nm_rad)

    async with drivelink.subscribe_async("elbow") as joint:
        async for estimate in joint:
            use(estimate.stiffness_nm_rad)

What happens to the daemon is `state`, never an exception.
"""

import asyncio
import atexit
import math
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from typing import Any, Self

import zenoh

from drivelink.pubsub.clientbase import PATIENCE_S, Client, require_timeout
from drivelink.pubsub.feed import WAKE
from drivelink.pubsub.wire import EstimateMessage


class Subscription(Client):
    """Subscribe to the estimates of a joint; the daemon may come later, go, and come back.

    Args:
        joint: its name, as in the joint file.
        endpoint: where a daemon or a router listens.
        config: a zenoh configuration file (JSON5) instead of the endpoint: TLS, access control, scouting.
        prefix: first part of every key, as in the joint file.
        session: an open session to use instead; it stays open.
        depth: estimates kept unread before the oldest is dropped, up to a million.
        stale_after_s: age from which an estimate is stale; None: five periods, at least 20 ms.

    Raises:
        ZenohError: no session can be opened.
        ArgumentError: an argument is wrong: a name that cannot be part of a key, a time below zero.
    """

    def wait(self, timeout_s: float | None = None) -> EstimateMessage | None:
        """Return the newest unread estimate; wait for one if there is none.

        Args:
            timeout_s: longest wait; None: forever; 0 or less: none.

        Returns:
            The estimate, or None after a timeout or when closed.
        """
        return self._wait(timeout_s, self._newest)

    def cycles(self, timeout_s: float | None = None) -> Iterator[EstimateMessage | None]:
        """Yield every estimate in order; None whenever `timeout_s` passed without one. Ends when closed."""
        while not self._closed:
            message = self._wait(timeout_s, self._oldest)
            if message is not None or not self._closed:
                yield message

    def __iter__(self) -> Iterator[EstimateMessage]:
        """Every estimate in order, waiting for each. Ends when closed."""
        return (message for message in self.cycles() if message is not None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the session; a second time does nothing."""
        self._closed = True
        if hasattr(self, "_alarm"):
            self._wake()
            self._alarm.close()
        super().close()

    def _declare_estimates(self, key: str) -> zenoh.Subscriber[Any]:
        self._alarm = _Alarm(self._wake)
        subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(self._depth))
        self._queue = subscriber.handler  # may wait, unlike undeclaring the subscriber
        return subscriber

    def _pop(self) -> zenoh.Sample | None:
        sample: zenoh.Sample | None = self._queue.try_recv()
        return sample

    def _wake(self) -> None:
        here = zenoh.Locality.SESSION_LOCAL
        with suppress(zenoh.ZError):
            self._session.put(self.key + "/estimate", b"", attachment=WAKE, allowed_destination=here)

    def _wait(
        self, timeout_s: float | None, pick: Callable[[], EstimateMessage | None]
    ) -> EstimateMessage | None:
        require_timeout(timeout_s)
        deadline_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        self._drain()
        while (message := pick()) is None:
            if self._closed or time.monotonic() >= deadline_s:
                return None
            self._hint()
            self._alarm.set(min(deadline_s, self._hint_s))
            try:
                sample = self._queue.recv()
                self._admit(sample, time.monotonic_ns())
            except zenoh.ZError:  # closed meanwhile by another thread
                return None
            finally:
                self._alarm.set(math.inf)
        return message


class _Alarm:
    """Ends a blocking receive at its deadline, which zenoh's channels cannot do.

    The thread starts with the first deadline. Moving the deadline later is one assignment, which the thread
    notices when it wakes. It ends before the interpreter does: a daemon thread that comes out of zenoh
    while the interpreter finalizes aborts the process.
    """

    def __init__(self, ring: Callable[[], None]) -> None:
        self._ring = ring
        self._deadline_s = math.inf
        self._wakes_s = math.inf
        self._closed = False
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def set(self, deadline_s: float) -> None:
        """Wake the receiver at this monotonic time; infinity: never."""
        self._deadline_s = deadline_s
        if deadline_s < self._wakes_s:
            with self._changed:
                if self._thread is None and not self._closed:
                    self._thread = threading.Thread(target=self._run, name="drivelink-alarm", daemon=True)
                    self._thread.start()
                    atexit.register(self.close)
                self._changed.notify()

    def close(self) -> None:
        """End the thread; a second time does nothing."""
        atexit.unregister(self.close)
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._closed:
                now_s = time.monotonic()
                if self._deadline_s <= now_s:
                    self._deadline_s = math.inf
                    self._ring()
                self._wakes_s = self._deadline_s
                self._changed.wait(None if self._wakes_s == math.inf else max(0.0, self._wakes_s - now_s))


class AsyncSubscription(Client):
    """Subscribe as `Subscription` does, for asyncio: made in a running loop.

    Raises:
        ZenohError: no session can be opened.
        ArgumentError: an argument is wrong, as for `Subscription`.
    """

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
        """Close the session; a second time does nothing."""
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
        require_timeout(timeout_s)
        self._drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while (message := pick()) is None and not self._closed:
                    self._arrived.clear()
                    await self._arrived.wait()
                    self._drain()
                return message
        return None


subscribe, subscribe_async = Subscription, AsyncSubscription
