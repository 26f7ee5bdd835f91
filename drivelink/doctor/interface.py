"""Checks the CAN interface: existence, state, bit rate, errors."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

from drivelink.doctor.report import Section
from drivelink.jointfile import BusSection
from drivelink.notice import Severity

_GOOD_QUEUE = 100  # frames; the kernel's default of 10 is full with two cycles of a VSA


def can_interfaces() -> list[str]:
    """Return SocketCAN interfaces of this machine."""
    return [name for name, link in _links().items() if link.get("link_type") == "can"]


def examine_interface(section: Section, bus: BusSection) -> None:
    """Check the interface of a joint file without opening it."""
    if bus.interface == "virtual":
        section.info(
            "virtual",
            "exists inside one process only: no other program can join it",
            "for two processes: sudo modprobe vcan && sudo ip link add vcan0 type vcan && "
            'sudo ip link set vcan0 up; or interface = "socketcand", which drivelink sim serves',
        )
        return
    if bus.interface != "socketcan":
        section.info(bus.interface, f"{bus.channel}: the system has no information on such an interface")
        return
    if shutil.which("ip") is None:
        section.warn(bus.channel, "`ip` is missing: state unknown", "sudo apt install iproute2")
        return
    link = _links().get(bus.channel)
    if link is None:
        known = can_interfaces()
        section.error(
            bus.channel,
            "there is no such interface" + (f"; there is {', '.join(known)}" if known else ""),
            f"sudo ip link add {bus.channel} type vcan && sudo ip link set {bus.channel} up"
            if bus.channel.startswith("vcan")
            else "plug it in, load its driver, or correct bus.channel",
        )
        return
    judge_link(section, link, bus)


def _links() -> dict[str, dict[str, Any]]:
    """Return the system's network interfaces, by name."""
    command = ["ip", "-json", "-details", "-statistics", "link", "show"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        links = json.loads(done.stdout or "[]")
    except (OSError, subprocess.TimeoutExpired, json.JSONDecodeError):
        return {}
    return {link["ifname"]: link for link in links if link}


def judge_link(section: Section, link: dict[str, Any], bus: BusSection) -> None:
    """Check the output of `ip -json -details -statistics link show`."""
    name = bus.channel
    info = link.get("linkinfo", {})
    data = info.get("info_data", {})
    virtual = info.get("info_kind") == "vcan"
    section.facts.update(
        state=data.get("state"),
        txqueuelen=link.get("txqlen"),
        bitrate=data.get("bittiming", {}).get("bitrate"),
    )
    if link.get("link_type") != "can":
        section.error(name, "is not a CAN interface", "correct bus.channel")
        return
    kind = "" if virtual else f" type can bitrate {bus.bitrate} restart-ms 100"
    if "UP" not in link.get("flags", []):
        section.error(name, "is down", f"sudo ip link set {name} up{kind}")
        return
    section.ok(name, "is up" + (", virtual (no bit rate, no errors)" if virtual else ""))
    if not virtual:
        _judge_controller(section, data, info, bus)
    queue = link.get("txqlen", 0)
    if queue < _GOOD_QUEUE:
        section.warn(
            name,
            f"transmit queue of {queue} frames: SYNC may find it full (ENOBUFS)",
            f"sudo ip link set {name} txqueuelen 1000",
        )
    if link.get("mtu", 16) > 16:
        section.info(name, "CAN FD: FD frames are accepted, CANopen uses the classic ones")
    dropped = link.get("stats64", {}).get("rx", {}).get("dropped", 0)
    if dropped:
        section.warn(name, f"{dropped} received frames were dropped since it is up")


def _judge_controller(section: Section, data: dict[str, Any], info: dict[str, Any], bus: BusSection) -> None:
    name = bus.channel
    bitrate = data.get("bittiming", {}).get("bitrate", 0)
    if bitrate and bitrate != bus.bitrate:
        section.error(
            name,
            f"runs at {bitrate // 1000} kbit/s, the joint file says {bus.bitrate // 1000} kbit/s",
            f"sudo ip link set {name} down && sudo ip link set {name} up type can bitrate {bus.bitrate}, "
            f"or bus.bitrate = {bitrate}",
        )
    elif bitrate:
        section.ok(name, f"{bitrate // 1000} kbit/s")
    state = data.get("state", "ERROR-ACTIVE")
    counters = data.get("berr_counter", {})
    errors = f"error counters: tx {counters.get('tx', 0)}, rx {counters.get('rx', 0)}"
    if state == "ERROR-ACTIVE":
        section.ok(name, f"error-active, {errors}")
    else:
        severity = Severity.ERROR if state in ("BUS-OFF", "STOPPED") else Severity.WARNING
        section.add(
            severity,
            name,
            f"is {state.lower()}, {errors}: check cable, termination (2 x 120 Ω), bit rate, and that "
            "another node is powered",
            f"sudo ip link set {name} down && sudo ip link set {name} up"
            if severity is Severity.ERROR
            else "",
        )
    if not data.get("restart_ms"):
        section.warn(
            name,
            "does not recover from bus-off by itself",
            f"sudo ip link set {name} down && sudo ip link set {name} type can restart-ms 100 && "
            f"sudo ip link set {name} up",
        )
    offs = info.get("info_xstats", {}).get("bus_off", 0)
    if offs:
        section.warn(name, f"was bus-off {offs} times since it is up")
