"""A recording's messages, live on foxglove-sdk's WebSocket server: `pip install drivelink-vsa[foxglove]`."""

from __future__ import annotations

from typing import Any

from drivelink.errors import UsageError
from drivelink.jointfile import JointFile
from drivelink.recording.messages import SCHEMA_NAMES, TOPICS, message_schema
from drivelink.recording.sinks import MessageSink


class FoxgloveSink(MessageSink):
    """Serves each topic to Foxglove Studio and PlotJuggler, on loopback.

    Args:
        port: of the server; 0: any.

    Raises:
        UsageError: foxglove-sdk is not installed, or the port is taken.
    """

    wants = frozenset({"sample", "estimate", "external", "document"})

    def __init__(self, joint: JointFile, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise UsageError("--foxglove: pip install 'drivelink-vsa[foxglove]'") from error
        self.counts = dict.fromkeys(sorted(self.wants), 0)
        self.set_up(joint)
        context = self._context = foxglove.Context()  # channels close with it
        try:
            self._server: Any = foxglove.start_server(
                name="drivelink", host="127.0.0.1", port=port, context=context
            )
        except (OSError, RuntimeError) as error:
            raise UsageError(f"--port {port}: cannot be served: {error}") from error
        self.port: int = self._server.port  # where it listens
        self._channels = {}
        for topic in TOPICS:
            name = SCHEMA_NAMES.get(topic, f"drivelink.{topic}")
            schema = foxglove.Schema(
                name=name, encoding="jsonschema", data=message_schema(topic, len(joint.motor))
            )
            self._channels[topic] = foxglove.Channel(
                f"/{joint.name}/{topic}", schema=schema, message_encoding="json", context=context
            )

    def flush(self) -> None:
        """Do nothing: every message is sent at once."""

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    abandon = close

    def _put(self, topic: str, stamp_ns: int, data: bytes) -> None:
        self._channels[topic].log(data, log_time=stamp_ns)
