"""The two stages of the fault script: all in one thread on the virtual bus, and in real time on any bus."""

import subprocess
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import can
from daemonkit import quiet_daemon
from faultstage import Stage

import drivelink.daemon.buswatch
from drivelink.canopen.bus import open_bus
from drivelink.demo.simbus import open_sim_bus
from drivelink.errors import BusError
from drivelink.jointfile import BusSection, JointFile
from estimator.sample import Status


class LockstepStage(Stage):
    """Everything in one thread on the virtual bus; time is the number of cycles."""

    exact = True
    late_syncs = 0

    def __init__(self, joint: JointFile, patch: Callable[..., None]) -> None:
        super().__init__(joint, open_sim_bus(joint.bus))
        self._patch = patch
        self._open = True
        patch(drivelink.daemon.buswatch, "open_bus", self._reopened)
        self.daemon = quiet_daemon(joint, devices=self.network.poll)
        self._begin()

    def _reopened(self, section: BusSection) -> can.BusABC:
        if not self._open:
            raise BusError("there is no such interface")
        return open_bus(section)

    def run(self, seconds: float) -> None:
        if self.document()["state"] == "bus lost":
            time.sleep(0.05)  # it is opened again in a thread
        for _ in range(round(seconds / self.joint.bus.period_s)):
            self.act()
            self.truth.unseen = True  # until the devices see its SYNC
            self.daemon.run_lockstep(1)

    def compare(self, what: str, found: int, expected: int) -> None:
        assert found == expected, what

    def remove(self) -> None:
        self._open = False
        self.daemon._port.bus.shutdown()

    def bring(self) -> None:
        self._open = True

    def full_queue(self) -> None:
        source = self.daemon.loop.source

        def send(_cob_id: int, _data: bytes) -> None:
            source.lost_sends += 1

        source.send = send  # type: ignore[method-assign]

    def empty_queue(self) -> None:
        del self.daemon.loop.source.send

    def clock(self, step_s: float) -> None:
        before = time.time_ns
        self._patch(time, "time_ns", lambda: before() + round(step_s * 1e9))


class _Wire(can.BusABC):
    """The devices' end of an interface that may go away: silent meanwhile, and back with it."""

    def __init__(self, section: BusSection) -> None:
        self._section = section
        self._inner: can.BusABC | None = open_sim_bus(section)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        try:
            if self._inner is None:
                self._inner = open_sim_bus(self._section)
            return self._inner.recv(timeout)
        except (can.CanError, OSError, BusError):
            self.shutdown()
            time.sleep(timeout or 0.0)
            return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self._inner is None:
            raise can.CanOperationError("the interface is away")
        self._inner.send(msg, timeout)

    def shutdown(self) -> None:
        inner, self._inner = self._inner, None
        if inner is not None:
            with suppress(can.CanError, OSError):
                inner.shutdown()


class RealStage(Stage):
    """Daemon and devices in threads of their own on a SocketCAN interface that this test may take away.

    Where the devices have a thread of their own, whether every frame is in time is not asserted, nor what the
    estimator makes of those that are not: well is a daemon whose estimates are made of fresh measurements, and
    that has nothing to say but that frames are missing.
    """

    patience_s = 60.0
    of_the_machine = frozenset({"too slow"})  # others use it too: cycles left out are said, and survived

    def __init__(self, joint: JointFile, *, together: bool = False) -> None:
        """Begin; `together`: the devices live in the daemon's thread, so that they are as prompt as drives."""
        super().__init__(joint, _Wire(joint.bus))
        self._together = together
        devices = self._serve if together else None
        if not together:
            self.network.start()
        self.daemon = quiet_daemon(joint, devices=devices)
        self._begin()
        self._thread = threading.Thread(target=self.daemon.run)
        self._thread.start()

    def close(self) -> None:
        self.daemon.stop()
        self._thread.join(60.0)
        self.network.stop()
        super().close()

    @property
    def well(self) -> bool:
        if self._together:
            return super().well
        pipeline, late = self.loop_joint.pipeline, ("missing ", "conflicting ")
        return (
            pipeline.estimate is not None
            and pipeline.sample is not None
            and not pipeline.estimate.status & (Status.STALE | Status.DRIVE_FAULT)
            and all(key.startswith(late) for key in self.daemon.events.active)
            and self.document()["state"] == "running"
        )

    def run(self, seconds: float) -> None:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if not self._together:
                self.act()
            time.sleep(0.003)  # this thread must not take the daemon's time

    def _serve(self) -> None:
        """The devices' turn in the daemon's thread; what is done to them is done there, and not amid it."""
        self.act()
        self.network.poll()

    def _ip(self, *arguments: str) -> None:
        subprocess.run(["ip", "link", *arguments], check=True)

    def down(self) -> None:
        self._ip("set", self.joint.bus.channel, "down")

    def up(self) -> None:
        self._ip("set", self.joint.bus.channel, "up")

    def remove(self) -> None:
        self._ip("del", self.joint.bus.channel)

    def bring(self) -> None:
        self._ip("add", self.joint.bus.channel, "mtu", "72", "type", "vcan")
        self.up()

    def clock(self, step_s: float) -> None:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + step_s)
