"""The controller as a process of its own: estimates over zenoh in, CAN frames out."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import can
import zenoh

from drivelink.canopen.bus import open_bus
from drivelink.errors import ZenohError
from drivelink.jointfile import JointFile
from drivelink.pubsub.client import Subscription, subscribe
from drivelink.pubsub.session import close_session, open_client
from drivelink.pubsub.wire import EstimateMessage, decode_sample
from estimator.sample import Sample
from vsacontrol.controller import Controller
from vsacontrol.drive import wiring_of
from vsacontrol.master import Master
from vsacontrol.phases import SAFE_TORQUES, Drives, Settings

__all__ = ["Process"]

_WAIT_S = 0.002  # for an estimate, before the dead-man looks again
_SAMPLE_S = 0.001  # for the sample of an estimate that is here
_REPEAT_S = 0.01  # between frames that only say again that there is to be no torque
_LIVE_S = 0.1  # as long as estimates are not older, the daemon is not busy with the nodes


class Process:
    """Opens the bus and zenoh, and runs a controller until it is stopped.

    Args:
        joint: the joint file that the daemon has, or one that agrees with it.
        folder: where that is.
        controller: what decides.
        settings: limits; the dead-man's time is also that of the drives' watch over this process, tenfold.
        report: gets one line of JSON per change of phase.
    """

    def __init__(
        self, joint: JointFile, folder: Path, controller: Controller, *, settings: Settings, report: TextIO
    ) -> None:
        self._controller = controller
        self._report = report
        self._reported = 0
        self._stopped = False
        self._status: object = None
        self._samples: dict[int, Sample] = {}
        self._bus = open_bus(joint.bus)
        self._session = self._open(joint, folder)
        key = f"{joint.zenoh.prefix}/{joint.name}/sample"
        ring: Any = zenoh.handlers.RingChannel(64)
        self._sampled = self._session.declare_subscriber(key, ring)
        self._estimates: Subscription = subscribe(
            joint.name, prefix=joint.zenoh.prefix, session=self._session, stale_after_s=settings.deadline_s
        )
        self._master = Master(
            wiring_of(joint), self._send, limit_nm=settings.torque_nm, watch_s=10.0 * settings.deadline_s
        )
        self._safe_s = -math.inf
        nodes = [drive.wiring.node_id for drive in self._master.drives]
        self._listen = {base + node for base in (0x080, 0x580, 0x700) for node in nodes}

    def _open(self, joint: JointFile, folder: Path) -> zenoh.Session:
        config = folder / joint.zenoh.config if joint.zenoh.config else None
        return open_client(joint.zenoh.endpoint, config)

    def stop(self) -> None:
        """Make `run` return; from a signal handler."""
        self._stopped = True

    def run(self, done: Callable[[], bool]) -> None:
        """Control until `done` or `stop`, and leave the drives without torque."""
        try:
            while not self._stopped and not done():
                self._once()
        finally:
            for _ in range(2):
                self._master.command(SAFE_TORQUES, time.monotonic())
                time.sleep(_WAIT_S)
            self._master.release()
            self._estimates.close()
            close_session(self._session)
            self._bus.shutdown()

    def _once(self) -> None:
        estimate = self._estimates.wait(_WAIT_S)
        self._receive()
        now_s = time.monotonic()
        drives = Drives(self._master.enabled, self._master.faulted)
        sample = self._sample_of(estimate) if estimate is not None else None
        if estimate is None or sample is None:
            torques = self._controller.watch(drives, now_s)
        else:
            self._take_springs()
            age_s = self._estimates.age_s
            external = self._estimates.external
            torques = self._controller.cycle(estimate, sample, drives, now_s, age_s, external)
        self._command(torques, now_s)
        self._master.poll(now_s, may_configure=self._estimates.age_s < _LIVE_S)
        self._print_events()

    def _command(self, torques: tuple[float, float] | None, now_s: float) -> None:
        """Torques at once; no torque at once too, and then now and again."""
        if torques is None:
            return
        if torques != SAFE_TORQUES:
            self._safe_s = -math.inf
        elif now_s < self._safe_s + _REPEAT_S:
            return
        else:
            self._safe_s = now_s
        self._master.command(torques, now_s)

    def _take_springs(self) -> None:
        status = self._estimates.status
        if status is not None and status is not self._status:
            self._status = status
            self._controller.set_springs(status.get("transmissions", ()))

    def _sample_of(self, estimate: EstimateMessage) -> Sample | None:
        """The sample of the same cycle, which comes a little after the estimate."""
        deadline_s = time.monotonic() + _SAMPLE_S
        while True:
            self._drain_samples()
            sample = self._samples.get(estimate.sequence)
            if sample is not None or time.monotonic() > deadline_s:
                for sequence in [s for s in self._samples if s <= estimate.sequence]:
                    del self._samples[sequence]
                return sample
            time.sleep(5e-5)

    def _drain_samples(self) -> None:
        while (message := self._sampled.try_recv()) is not None:
            with suppress(ZenohError):
                sample = decode_sample(message.payload.to_bytes()).sample
                self._samples[sample.sequence] = sample
        while len(self._samples) > 64:
            del self._samples[next(iter(self._samples))]

    def _receive(self) -> None:
        now_s = time.monotonic()
        with suppress(can.CanError, OSError):
            while (message := self._bus.recv(0)) is not None:
                cob_id = message.arbitration_id
                if cob_id in self._listen or cob_id in self._master.status_ids:
                    self._master.feed(cob_id, bytes(message.data), now_s)

    def _send(self, cob_id: int, data: bytes) -> None:
        """A bus that is away makes the estimates stale, which is what the controller looks at."""
        with suppress(can.CanError, OSError):
            self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def _print_events(self) -> None:
        for event in self._controller.events[self._reported :]:
            self._reported += 1
            line = {
                "phase": event.phase,
                "reason": event.reason,
                "time_s": round(event.time_s, 4),
                "age_s": round(event.age_s, 4),
            }
            print(json.dumps(line), file=self._report, flush=True)
