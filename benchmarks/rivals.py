"""What `drivelink run` is measured against: the textbook way, and the floor."""

import io
import json
import struct
import time
from collections.abc import Mapping

import can
import canopen
import numpy as np
import zenoh
from rig import AnsweringBus, Devices

from drivelink._core import SYNC_COB_ID, LatencyHistogram, encode_estimate
from drivelink.canopen.layout import NodeLayout, Signal
from drivelink.cycle.realtime import Alarm
from drivelink.cycle.sources import open_source
from drivelink.jointfile import JointFile
from estimator.sample import Estimate, TransmissionEstimate
from sim.canopen.node import Node

_ENCODING = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.REAL_TIME,
    "express": True,
}


class NumpyPaper:
    """Eqs 14, 28, 32, 33 with numpy state, one array element per motor, as one writes it from the paper."""

    def __init__(self, joint: JointFile) -> None:
        settings = joint.estimator
        self.B = np.array([motor.inertia_kg_m2 for motor in joint.motor])
        self.D = np.array([motor.viscous_damping_nm_s_rad for motor in joint.motor])
        self.T = joint.bus.period_s
        self.k_tau, self.k_r, self.k_max = settings.k_tau_rad_s, settings.k_r_s2_rad2, settings.k_max
        self.k_1, self.k_2 = settings.k_sigma_1_rad2_s2, settings.k_sigma_2_rad_s
        m = len(self.B)
        self.theta = self.q = None
        self.integral_tau, self.integral_r = np.zeros(m), np.zeros(m)
        self.slope, self.slope_rate = np.zeros(m), np.zeros(m)
        self.stiffness = np.zeros(m)

    def step(self, theta: np.ndarray, tau: np.ndarray, q: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Torque, stiffness and deflection of each transmission."""
        if self.theta is None:
            self.theta, self.q = theta, q
        omega, q_rate = (theta - self.theta) / self.T, (q - self.q) / self.T
        self.theta, self.q = theta, q
        momentum = self.B * omega + self.D * theta
        residual = self.k_tau * (momentum - self.integral_tau - self.integral_r)
        self.integral_tau = self.integral_tau + self.T * tau
        self.integral_r = self.integral_r + self.T * residual
        self.slope_rate = self.slope_rate + self.T * (
            self.k_1 * (residual - self.slope) - self.k_2 * self.slope_rate
        )
        self.slope = self.slope + self.T * self.slope_rate
        phi, rate = q - theta, q_rate - omega
        gain = np.minimum(self.k_r, self.k_max / np.maximum(rate**2, 1e-12))
        self.stiffness = self.stiffness + gain * (self.slope_rate * rate - self.stiffness * rate**2)
        return residual, self.stiffness, phi


class Textbook:
    """canopen's notifier and PDO callbacks, `.raw` reads, numpy state, JSON on zenoh.

    Args:
        joint: the joint.
        devices: its simulated devices, for their EDS.
        layouts: how they send.
        session: to publish on.
    """

    name = "textbook: canopen, numpy, JSON"

    def __init__(
        self, joint: JointFile, devices: list[Node], layouts: Mapping[int, NodeLayout], session: zenoh.Session
    ) -> None:
        self.work, self.late = LatencyHistogram(), LatencyHistogram()  # canopen's own thread makes SYNC
        self.cycles = 0
        self._joint = joint
        self._estimator = NumpyPaper(joint)
        self._publisher = session.declare_publisher("bench/textbook", **_ENCODING)
        self._network = canopen.Network()
        self._maps: dict[int, canopen.pdo.base.PdoMap] = {}
        self._layouts = layouts
        self._arrived: set[int] = set()
        for device in devices:
            eds = io.StringIO(device.eds("node.eds"))
            eds.name = "node.eds"
            node = self._network.add_node(device.node_id, canopen.import_od(eds, device.node_id))
            self._map(node, layouts[device.node_id])

    def _map(self, node: canopen.RemoteNode, layout: NodeLayout) -> None:
        (tpdo,) = layout.tpdos
        pdo = node.tpdo[tpdo.number]
        pdo.clear()
        for mapped in tpdo.objects:
            pdo.add_variable(mapped.index, mapped.subindex)
        pdo.cob_id, pdo.enabled = tpdo.cob_id, True
        pdo.add_callback(lambda _map, node_id=layout.node_id: self._on_pdo(node_id))
        self._maps[layout.node_id] = pdo

    def _on_pdo(self, node_id: int) -> None:
        since = time.monotonic_ns()
        self._arrived.add(node_id)
        if len(self._arrived) < len(self._maps):
            return
        self._arrived.clear()
        self.cycles += 1
        theta, tau, q = np.zeros(2), np.zeros(2), 0.0
        for node, layout in self._layouts.items():
            for variable, mapped in zip(self._maps[node], layout.tpdos[0].objects, strict=True):
                value = variable.raw * mapped.scale - mapped.offset
                if mapped.signal is Signal.MOTOR_POSITION:
                    theta[layout.motor] = value
                elif mapped.signal is Signal.MOTOR_TORQUE:
                    tau[layout.motor] = value
                elif mapped.signal is Signal.LINK_POSITION:
                    q = value
        torque, stiffness, phi = self._estimator.step(theta, tau, q)
        message = {
            "sequence": self.cycles,
            "stamp_ns": time.time_ns(),
            "flexibility_torque_nm": float(torque.sum()),
            "stiffness_nm_rad": float(stiffness.sum()),
            "transmissions": [
                {"flexibility_torque_nm": t, "stiffness_nm_rad": s, "deflection_rad": p}
                for t, s, p in zip(torque.tolist(), stiffness.tolist(), phi.tolist(), strict=True)
            ],
            "sample": {"theta": theta.tolist(), "tau": tau.tolist(), "q": q},
        }
        self._publisher.put(json.dumps(message))
        self.work.add(time.monotonic_ns() - since)

    def run(self, seconds: float, devices: Devices) -> None:
        """Make SYNC and let the callbacks do the rest."""
        bus = AnsweringBus(self._joint.bus.channel, devices)
        self._network.bus = bus
        self._network.notifier = can.Notifier(bus, self._network.listeners, self._network.NOTIFIER_CYCLE)
        for pdo in self._maps.values():
            pdo.subscribe()
        self._network.sync.start(self._joint.bus.period_s)
        time.sleep(seconds)
        self._network.sync.stop()
        self._network.disconnect()

    def close(self) -> None:
        """Take the key off zenoh."""
        self._publisher.undeclare()


class Floor:
    """A bare loop: SYNC, receive, unpack, put the same bytes; no estimator, no bookkeeping."""

    name = "floor: unpack and put, no estimator"

    def __init__(self, joint: JointFile, layouts: Mapping[int, NodeLayout], session: zenoh.Session) -> None:
        self.work, self.late = LatencyHistogram(), LatencyHistogram()
        self.cycles = 0
        self._joint = joint
        self._formats = {layout.tpdos[0].cob_id: struct.Struct("<ihH") for layout in layouts.values()}
        for layout in layouts.values():
            if layout.motor is None:
                self._formats[layout.tpdos[0].cob_id] = struct.Struct("<i")
        self._publishers = [
            session.declare_publisher(f"bench/floor/{name}", **_ENCODING) for name in ("estimate", "sample")
        ]
        one = TransmissionEstimate(1.0, 2.0, 3.0, 4.0)
        self._payload = encode_estimate(Estimate(0, 3, 1.0, 2.0, 3.0, (one, one)), 0)

    def run(self, seconds: float, devices: Devices) -> None:
        """The loop."""
        bus = can.Bus(interface="virtual", channel=self._joint.bus.channel)
        source, alarm, clock = open_source(bus, devices.poll), Alarm(), time.monotonic_ns
        period = round(self._joint.bus.period_s * 1e9)
        end = clock() + round(seconds * 1e9)
        deadline = clock() + period
        while deadline < end:
            self.late.add(clock() - deadline + period)
            source.send(SYNC_COB_ID, b"")
            got = 0
            while got < len(self._formats) and source.wait(max(deadline - clock(), 0) * 1e-9):
                since = clock()
                for cob_id, data, _ in source.receive():
                    if cob_id in self._formats:
                        self._formats[cob_id].unpack_from(data)
                        got += 1
            if got == len(self._formats):
                estimate, sample = self._publishers
                estimate.put(self._payload)
                sample.put(self._payload[:72])
                self.work.add(clock() - since)
                self.cycles += 1
            alarm.sleep_until(deadline)
            deadline += period * max(1, (clock() - deadline) // period)
        bus.shutdown()

    def close(self) -> None:
        """Take the keys off zenoh."""
        for publisher in self._publishers:
            publisher.undeclare()
