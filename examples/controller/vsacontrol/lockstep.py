"""Drives, daemon and controller in one thread on one bus: the same code as in three processes, but
exactly one world period a SYNC and no waiting, so that every run is the same."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import can

from drivelink._core import Tick
from drivelink.daemon.service import Daemon, ServedJoint
from drivelink.demo.simbus import open_sim_bus
from drivelink.demo.simulate import nodes_from_joint, world_from_joint
from drivelink.jointfile import JointFile
from drivelink.pubsub.wire import (
    EstimateMessage,
    ExternalMessage,
    decode_estimate,
    decode_external,
    decode_sample,
)
from estimator.sample import Sample
from sim.faults import Faults
from sim.network import Network
from vsacontrol.controller import Controller
from vsacontrol.drive import wiring_of
from vsacontrol.master import Master
from vsacontrol.phases import Drives

__all__ = ["LockstepRig", "Row"]

_channels = itertools.count()
_STATUS_PERIODS = 250  # as often as the daemon publishes its status


class Row(NamedTuple):
    """One cycle as it was: truth beside target.

    Attributes:
        time_s: bus time.
        phase: of the controller.
        reference_s: time in the reference.
        q: link position, rad, as it is.
        q_wanted: as it should be.
        sigma: total stiffness, N·m/rad, as it is.
        sigma_wanted: as it should be.
        torques: commanded, N·m.
        deflections: phi_1, phi_2 as they are, rad.
    """

    time_s: float
    phase: str
    reference_s: float
    q: float
    q_wanted: float
    sigma: float
    sigma_wanted: float
    torques: tuple[float, float]
    deflections: tuple[float, float]


class LockstepRig:
    """Everything in one thread.

    Args:
        joint: the joint file; its bus is replaced.
        controller: made by the caller.
        torque_nm: the drives' torque limit.
        seed: of the sensors' noise.
        channel: of SocketCAN, which delivers as promptly; None: a virtual bus of its own.

    Attributes:
        now_s: bus time: one period a SYNC, or as it passes without one.
        faults: what can be done to the devices.
        world: the joint as it is.
        last_estimate_s: when an estimate last reached the controller.
        commands: target torques of the drives on the bus, with their time.
        external: the newest external torque.
    """

    def __init__(
        self,
        joint: JointFile,
        controller: Controller,
        *,
        torque_nm: float = 0.4,
        seed: int = 0,
        channel: str | None = None,
    ) -> None:
        bus = joint.bus.model_copy(
            update={
                "interface": "socketcan" if channel else "virtual",
                "channel": channel or f"vsa-lockstep-{next(_channels)}",
                "options": {},
            }
        )
        self.joint = joint.model_copy(update={"bus": bus})
        self.controller = controller
        self.now_s = 0.0
        self.world = world_from_joint(self.joint, seed=seed)
        self._sim_bus = open_sim_bus(bus)
        self.network = Network(
            self._sim_bus, nodes_from_joint(self.joint, self.world), self.world, clock=lambda: self.now_s
        )
        self.faults = Faults(self.network)
        self._bus = can.Bus(interface=bus.interface, channel=bus.channel, ignore_config=True)
        self.master = Master(wiring_of(joint), self._send, limit_nm=torque_nm)
        self._estimates: list[EstimateMessage] = []
        self._samples: list[Sample] = []
        self.external: ExternalMessage | None = None
        self._cycles = 0
        self.cut = False  # zenoh: nothing reaches the controller
        self.last_estimate_s = 0.0
        self.commands: list[tuple[float, int, int]] = []
        self.daemon: Daemon | None = None
        self.start_daemon()

    def start_daemon(self) -> None:
        """A daemon as after `drivelink run`: it configures the nodes and knows nothing of before."""
        self.daemon = Daemon(
            [ServedJoint(joint=self.joint)], publish=False, real_time=False, devices=self.network.poll
        )
        self.daemon.loop.loop_joints[0].sink = self

    def kill_daemon(self) -> None:
        """No SYNC and no estimate from now on, and nobody says goodbye."""
        if self.daemon is not None:
            self.daemon.close()
        self.daemon = None

    def close(self) -> None:
        """Leave nothing behind."""
        self.kill_daemon()
        self._bus.shutdown()
        self._sim_bus.shutdown()

    def put(self, tick: Tick) -> None:
        """The daemon publishes; over the wire's own bytes."""
        self._estimates.append(decode_estimate(tick.estimate_payload))
        if tick.external_payload is not None:
            self.external = decode_external(tick.external_payload)
        if tick.sample_payload is not None:
            self._samples.append(decode_sample(tick.sample_payload).sample)

    def run(
        self,
        seconds: float,
        *,
        until: Callable[[], bool] = lambda: False,
        each: Callable[[Row], object] | None = None,
    ) -> bool:
        """So much bus time, or until the condition holds; whether it did."""
        for _ in range(round(seconds / self.joint.bus.period_s)):
            row = self.step()
            if each is not None:
                each(row)
            if until():
                return True
        return False

    def step(self) -> Row:
        """One period: SYNC if there is a daemon, and what the controller makes of it."""
        self.now_s += self.joint.bus.period_s
        if self.daemon is not None:
            self.daemon.run_lockstep(1)
        else:
            self._without_sync()
        self._receive()
        torques = self._control()
        self.master.poll(self.now_s, may_configure=self.now_s - self.last_estimate_s < 0.01)
        if torques is not None:
            self.master.command(torques, self.now_s)
        return self._row(torques or (0.0, 0.0))

    def _without_sync(self) -> None:
        """A drive's control loop goes on by its own clock."""
        for node in self.network.nodes:
            node.on_control(1)
        self.world.advance(1)
        self.network.poll()

    def _control(self) -> Sequence[float] | None:
        drives = Drives(self.master.enabled, self.master.faulted)
        estimates, self._estimates = self._estimates, []
        samples, self._samples = self._samples, []
        if self.cut or not estimates:
            return self.controller.watch(drives, self.now_s)
        self.last_estimate_s = self.now_s
        if self._cycles % _STATUS_PERIODS == 0 and self.daemon is not None:
            self.controller.set_springs(self._status()["transmissions"])
        self._cycles += 1
        fresh = [s for s in samples if s.sequence == estimates[-1].sequence]
        if not fresh:
            return self.controller.watch(drives, self.now_s)
        return self.controller.cycle(estimates[-1], fresh[-1], drives, self.now_s, external=self.external)

    def _status(self) -> dict[str, Any]:
        assert self.daemon is not None
        return self.daemon.documents()[0]

    def _receive(self) -> None:
        while (message := self._bus.recv(0)) is not None:
            self.master.feed(message.arbitration_id, bytes(message.data), self.now_s)

    def _send(self, cob_id: int, data: bytes) -> None:
        if 0x200 < cob_id <= 0x57F:
            self.commands.append((self.now_s, cob_id, int.from_bytes(data[2:4], "little", signed=True)))
        message = can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)
        self._bus.send(message)

    def _row(self, torques: Sequence[float]) -> Row:
        truth, controller = self.world.truth(), self.controller
        target = controller.reference.at(controller.reference_s)
        return Row(
            self.now_s,
            controller.phase,
            controller.reference_s,
            truth.link_position_rad,
            target.q[0],
            truth.stiffness_nm_rad,
            target.sigma[0],
            (torques[0], torques[1]),
            (truth.motors[0].deflection_rad, truth.motors[1].deflection_rad),
        )
