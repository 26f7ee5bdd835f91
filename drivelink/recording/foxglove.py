"""Foxglove and PlotJuggler: layouts for a joint's MCAP recordings, and its messages live.

The live server is foxglove-sdk's: `pip install drivelink-vsa[foxglove]`.
"""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from drivelink.errors import UsageError
from drivelink.files import write_whole
from drivelink.jointfile import JointFile
from drivelink.recording.messages import SCHEMA_NAMES, message_schema
from drivelink.recording.sinks import MessageSink

_COLOURS = ("#0072b2", "#9ec9e2", "#9ec9e2", "#d55e00", "#009e73")


def _plots(motors: int) -> list[tuple[str, str, list[str]]]:
    """(title, topic, fields) of each plot; the first field is emphasised."""
    numbers = range(1, motors + 1)
    band = ["stiffness_nm_rad", "stiffness_low_nm_rad", "stiffness_high_nm_rad"]
    return [
        ("Stiffness and its band of 95 %", "estimate", band),
        ("Flexibility torque", "estimate", ["flexibility_torque_nm"]),
        ("Deflection", "estimate", [f"motor{i}_deflection_rad" for i in numbers]),
        ("Motor torque", "sample", [f"motor{i}_torque_nm" for i in numbers]),
        ("Positions", "sample", ["link_position_rad", *(f"motor{i}_position_rad" for i in numbers)]),
        ("Valid, observable", "estimate", ["valid", "observable"]),
    ]


def write_layouts(joint: JointFile, folder: Path) -> list[Path]:
    """Write `foxglove.json` and `plotjuggler.xml`.

    Raises:
        OSError: they cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plots = _plots(len(joint.motor))
    made = {"foxglove.json": _foxglove(joint.name, plots), "plotjuggler.xml": _plotjuggler(joint.name, plots)}
    for name, text in made.items():
        write_whole(folder / name, text, force=True)
    return [folder / name for name in made]


def _foxglove(joint: str, plots: Sequence[tuple[str, str, list[str]]]) -> str:
    panels = {
        f"Plot!{number}": {
            "title": title,
            "paths": [
                {
                    "value": f"/{joint}/{topic}.{field}",
                    "label": field,
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                    "color": colour,
                }
                for field, colour in zip(fields, _COLOURS, strict=False)
            ],
            "showXAxisLabels": True,
            "showYAxisLabels": True,
            "showLegend": True,
            "legendDisplay": "floating",
            "isSynced": True,
            "xAxisVal": "timestamp",
        }
        for number, (title, topic, fields) in enumerate(plots)
    }
    document: dict[str, Any] = {"configById": panels, "globalVariables": {}, "userNodes": {}}
    document |= {"playbackConfig": {"speed": 1}, "layout": _column(list(panels))}
    return json.dumps(document, indent=1) + "\n"


def _column(panels: list[str]) -> object:
    """Stack panels of equal height."""
    first, *others = panels
    if not others:
        return first
    split = {"direction": "column", "splitPercentage": round(100.0 / len(panels), 1)}
    return {"first": first, "second": _column(others), **split}


def _plotjuggler(joint: str, plots: Sequence[tuple[str, str, list[str]]]) -> str:
    root = ElementTree.Element("root")
    window = ElementTree.SubElement(root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"})
    tab = ElementTree.SubElement(window, "Tab", containers="1", tab_name=joint)
    container = ElementTree.SubElement(tab, "Container")
    sizes = ";".join([f"{1 / len(plots):.4f}"] * len(plots))
    splitter = ElementTree.SubElement(
        container, "DockSplitter", count=str(len(plots)), orientation="-", sizes=sizes
    )
    for title, topic, fields in plots:
        area = ElementTree.SubElement(splitter, "DockArea", name=title)
        plot = ElementTree.SubElement(area, "plot", mode="TimeSeries", style="Lines")
        ElementTree.SubElement(plot, "limitY")
        for field, colour in zip(fields, _COLOURS, strict=False):
            ElementTree.SubElement(plot, "curve", color=colour, name=f"/{joint}/{topic}/{field}")
    ElementTree.SubElement(window, "currentTabIndex", index="0")
    ElementTree.SubElement(root, "use_relative_time_offset", enabled="1")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


class FoxgloveSink(MessageSink):
    """Serves each topic to Foxglove Studio and PlotJuggler, on loopback.

    The newest document of a topic is sent again whenever a client subscribes to it, as zenoh does.

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
            raise UsageError("--foxglove: needs its SDK: pip install 'drivelink-vsa[foxglove]'") from error
        self.counts = dict.fromkeys(sorted(self.wants), 0)
        self.set_up(joint)
        context = self._context = foxglove.Context()  # channels close with it
        listener: Any = self  # has what a server without further capabilities calls of a ServerListener
        try:
            self._server: Any = foxglove.start_server(
                name="drivelink", host="127.0.0.1", port=port, context=context, server_listener=listener
            )
        except (OSError, RuntimeError) as error:
            reason = str(error).removeprefix("FoxgloveError: ")
            raise UsageError(f"--port {port}: cannot be served: {reason}") from error
        self.port: int = self._server.port  # where it listens
        self._newest: dict[str, tuple[int, bytes]] = {}  # documents by topic: stamp and content

        @cache
        def channel(topic: str) -> Any:
            name = SCHEMA_NAMES.get(topic, f"drivelink.{topic}")
            content = message_schema(topic, len(joint.motor))
            schema = foxglove.Schema(name=name, encoding="jsonschema", data=content)
            path = f"/{joint.name}/{topic}"
            return foxglove.Channel(path, schema=schema, message_encoding="json", context=context)

        self._channel = channel  # of a topic, offered from its first message on

    def on_subscribe(self, _client: object, channel: Any) -> None:
        """Send what a client has missed; foxglove-sdk calls this in a thread of its own."""
        topic = channel.topic.rpartition("/")[2]
        if newest := self._newest.get(topic):
            self._put(topic, *newest)

    def on_unsubscribe(self, _client: object, channel: Any) -> None:
        """Do nothing; foxglove-sdk asks for it."""

    def document(self, name: str, payload: bytes, stamp_ns: int) -> None:
        """Send a document, and keep it for clients to come."""
        self._newest[name] = stamp_ns, payload
        super().document(name, payload, stamp_ns)

    def flush(self) -> None:
        """Do nothing: every message is sent at once."""

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    abandon = close

    def _put(self, topic: str, stamp_ns: int, data: bytes) -> None:
        self._channel(topic).log(data, log_time=stamp_ns)
