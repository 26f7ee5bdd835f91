"""`drivelink monitor --foxglove`: a WebSocket client gets described channels, and a joint's estimates live."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from zenohkit import free_endpoint, ready, script

from drivelink.cli import main

pytest.importorskip("foxglove", reason="needs the extra foxglove")
JOINT = 'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.125\n[motor.transmission]\nmodel = "linear"\n[zenoh]\nendpoint = "{}"\n'


class Client:
    """Just enough of RFC 6455, and of Foxglove's protocol."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        head = "GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        head += (
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
        )
        self._socket.sendall(head.encode())
        self._file = self._socket.makefile("rb")
        assert b"101" in self._file.readline()
        while self._file.readline().strip():
            pass

    def send(self, message: dict) -> None:
        text = json.dumps(message).encode()
        assert len(text) < 126
        self._socket.sendall(bytes([0x81, 0x80 | len(text)]) + bytes(4) + text)  # mask of zeros

    def receive(self) -> bytes:
        _, length = self._file.read(2)
        if length >= 126:
            (length,) = struct.unpack(
                ">H" if length == 126 else ">Q", self._file.read(2 if length == 126 else 8)
            )
        return self._file.read(length)

    def close(self) -> None:
        self._file.close()
        self._socket.close()


def test_estimates_come_live_over_a_websocket(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "elbow.toml"
    path.write_text(JOINT.format(endpoint))
    command = [sys.executable, "-m", "drivelink", "monitor", str(path), "--foxglove", "--port", "0"]
    with script("elbow", endpoint) as daemon:
        ready(daemon)
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as bridge:
            try:
                assert bridge.stdout is not None
                client = Client(int(bridge.stdout.readline().rpartition(":")[2].split()[0]))
                channels: dict = {}
                while "/elbow/estimate" not in channels:
                    message = json.loads(client.receive())
                    channels |= {one["topic"]: one for one in message.get("channels", ())}
                schema = json.loads(channels["/elbow/estimate"]["schema"])
                assert schema["properties"]["stiffness_nm_rad"]["unit"] == "N·m/rad"
                wanted = {"id": 7, "channelId": channels["/elbow/estimate"]["id"]}
                client.send({"op": "subscribe", "subscriptions": [wanted]})
                while (data := client.receive())[0] != 1:
                    pass
                assert struct.unpack_from("<I", data, 1) == (7,)
                estimate = json.loads(data[13:])
                assert estimate["stiffness_nm_rad"] == 700.0 and estimate["valid"] is True
                client.close()
            finally:
                bridge.kill()


def test_what_it_needs_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["monitor", "elbow", "--foxglove"]) == 2
    assert "--foxglove: expected a joint file" in capsys.readouterr().err
