"""The simulated contents of one bus: worlds, their devices, and a description."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import can

from sim.canopen.drive import Cia402Drive
from sim.canopen.edsfile import node_eds
from sim.canopen.node import Node
from sim.errors import SimError
from sim.network import Network
from sim.world import World


class Bench:
    """Several joints on one bus.

    Raises:
        SimError: two devices have the same node id.
    """

    def __init__(
        self, names: Sequence[str], worlds: Sequence[World], nodes: Sequence[Sequence[Node]]
    ) -> None:
        self._groups = list(zip(names, nodes, strict=True))
        self.worlds = tuple(worlds)
        self.nodes = tuple(node for group in nodes for node in group)
        ids = [node.node_id for node in self.nodes]
        for node_id in ids:
            if ids.count(node_id) > 1:
                raise SimError(f"expected a node id of its own for each device, got {node_id} twice")

    def network(self, bus: can.BusABC) -> Network:
        """Return all devices on a bus."""
        return Network(bus, self.nodes, *self.worlds)

    def serve(self, bus: can.BusABC, stop: threading.Event) -> None:
        """Serve the bus in this thread until `stop` is set."""
        self.network(bus).serve(stop)

    def devices(self) -> dict[str, dict[str, list[int]]]:
        """Return node ids of the drives and encoders, by joint."""
        found: dict[str, dict[str, list[int]]] = {}
        for name, group in self._groups:
            kinds = found.setdefault(name, {"drive": [], "encoder": []})
            for node in group:
                kinds["drive" if isinstance(node, Cia402Drive) else "encoder"].append(node.node_id)
        return found

    def describe(self) -> str:
        """Return joints and node ids, for messages."""
        parts = []
        for name, group in self._groups:
            kinds = (f"{'drive' if isinstance(n, Cia402Drive) else 'encoder'} {n.node_id}" for n in group)
            parts.append(f"{name} ({', '.join(kinds)})")
        return "; ".join(parts)

    def write_eds(self, directory: Path) -> None:
        """Write the EDS file of every device."""
        directory.mkdir(parents=True, exist_ok=True)
        for name, group in self._groups:
            for node in group:
                file = f"{name}-node{node.node_id}.eds"
                (directory / file).write_text(node_eds(file, node), encoding="ascii")
