"""`drivelink monitor --foxglove`: a WebSocket client gets described channels, and a joint's estimates live."""

import asyncio
import json
import socket
import struct

import pytest
from zenohkit import free_endpoint, joint_text, process, ready, script

pytest.importorskip("foxglove", reason="needs the extra foxglove")


async def listened(port, topic):
    """A channel, the first message on it, and the topics that are offered."""
    import aiohttp  # takes most of a second

    protocol = ("foxglove.sdk.v1",)
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{port}", protocols=protocol) as connection,
    ):
        channels = {}
        while topic not in channels:
            message = await connection.receive_json()
            channels |= {one["topic"]: one for one in message.get("channels", ())}
        wanted = {"id": 7, "channelId": channels[topic]["id"]}
        await connection.send_json({"op": "subscribe", "subscriptions": [wanted]})
        while (message := await connection.receive()).type is not aiohttp.WSMsgType.BINARY or message.data[
            0
        ] != 1:
            pass
        return channels[topic], message.data, set(channels)


def test_estimates_come_live_over_a_websocket(tmp_path):
    endpoint, path = free_endpoint(), tmp_path / "elbow.toml"
    path.write_text(joint_text("elbow", endpoint))
    with script("elbow", endpoint) as daemon:
        ready(daemon)
        with process("monitor", path, "--foxglove", "--port", "0") as bridge:
            port = int(bridge.stdout.readline().rpartition(":")[2].split()[0])
            channel, data, _ = asyncio.run(asyncio.wait_for(listened(port, "/elbow/estimate"), 60))
            # Published long ago.
            _, model, topics = asyncio.run(asyncio.wait_for(listened(port, "/elbow/model"), 20))
            with process("monitor", path, "--foxglove", "--port", str(port)) as second:
                said = second.stderr.read()
            with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
                client.sendall(b"no handshake\r\n\r\n")
                client.recv(1000)  # it is dropped
            bridge.terminate()
            assert bridge.wait(20) == 0 and bridge.stderr.read() == ""
    assert said.startswith(f"drivelink monitor: --port {port}: cannot be served: Failed to bind port")
    assert topics >= {"/elbow/model", "/elbow/estimate"}
    assert not topics & {"/elbow/can", "/elbow/mapping", "/elbow/joint"}  # nobody sends them
    assert json.loads(channel["schema"])["properties"]["stiffness_nm_rad"]["unit"] == "N·m/rad"
    assert struct.unpack_from("<I", data, 1) == (7,)
    estimate = json.loads(data[13:])
    assert json.loads(model[13:])["joint"] == "elbow"
    assert estimate["stiffness_nm_rad"] == 700.0 and estimate["valid"] is True
