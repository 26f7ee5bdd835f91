"""Checks this machine (scheduling, memory, CPU clock, timer), its CAN interface, SYNC on its bus, zenoh."""

import itertools
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.realtime import PRIORITY
from drivelink.doctor.report import Section
from drivelink.errors import ZenohError
from drivelink.jointfile import BusSection, JointFile
from drivelink.notice import Severity
from drivelink.pubsub.clientbase import joints
from drivelink.pubsub.session import FILES, answers, close_session, open_client
from drivelink.recording.recorder import daemon_layouts

_CPU = Path("/sys/devices/system/cpu")
_NEEDED_LOCKED = 256 << 20  # bytes; the daemon's resident size is below
_GOOD_JITTER_US, _BAD_JITTER_US = 150.0, 1000.0
_CAP_SYS_NICE, _CAP_IPC_LOCK = 23, 14


def examine_machine(section: Section, period_s: float, seconds: float) -> None:
    """Examine kernel, rights and timer."""
    kernel = platform.release()
    realtime = Path("/sys/kernel/realtime").exists() or "PREEMPT_RT" in platform.version()
    section.ok("kernel", f"Linux {kernel}" + (", PREEMPT_RT" if realtime else ""))
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    effective = re.search(r"^CapEff:\s*([0-9a-f]+)", status, re.MULTILINE)
    _rights(section, int(effective[1], 16) if effective else 0)
    _governor(section)
    _timer(section, period_s, seconds)


def _rights(section: Section, capabilities: int) -> None:
    """Examine what this user may do."""
    real_time, locked = (resource.getrlimit(r)[0] for r in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK))
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    for subject, limit, least, instead, fine, lacking, line in (
        ("real time", real_time, PRIORITY, _CAP_SYS_NICE, "SCHED_FIFO is allowed",
         f"SCHED_FIFO is not allowed (limit {real_time}, {PRIORITY} is wanted): expect a larger jitter",
         "rtprio 99"),
        ("memory", locked, _NEEDED_LOCKED, _CAP_IPC_LOCK, "can be locked",
         f"only {locked >> 10} KiB may be locked: a page fault may delay a cycle", "memlock unlimited"),
        ("files", files, FILES, None,
         f"{FILES} may be open: idle connections cannot lock subscribers out",
         f"only {files} may be open, {FILES} are wanted: as many idle connections lock new subscribers out",
         f"nofile {FILES}"),
    ):  # fmt: skip
        has = instead is not None and capabilities >> instead & 1
        if limit == resource.RLIM_INFINITY or limit >= least or has:
            section.ok(subject, fine)
        else:
            user = os.environ.get("USER", "USER")
            file = "/etc/security/limits.d/drivelink.conf"
            section.warn(subject, lacking, f"echo '{user} - {line}' | sudo tee -a {file}, then log in again")


def _governor(section: Section) -> None:
    files = _CPU.glob("cpu[0-9]*/cpufreq/scaling_governor")
    governors = {path.read_text(encoding="ascii", errors="replace").strip() for path in files}
    if not governors:
        section.ok("CPU clock", "not managed by this kernel")
    elif governors == {"performance"}:
        section.ok("CPU clock", "governor performance")
    else:
        text = (
            f"governor {', '.join(sorted(governors))}: the CPU clock first has to rise after each idle phase"
        )
        section.warn("CPU clock", text, "sudo cpupower frequency-set -g performance")
    if (os.cpu_count() or 1) < 2:
        section.warn("CPU", "one core only: everything else on it delays the cycle")


def _timer(section: Section, period_s: float, seconds: float) -> None:
    """Measure how late this process wakes, without the daemon's rights."""
    late_us = []
    period_ns = int(period_s * 1e9)
    deadline = time.monotonic_ns() + period_ns
    end = deadline + int(seconds * 1e9)
    while deadline < end:
        time.sleep(max(0, deadline - time.monotonic_ns()) * 1e-9)
        now = time.monotonic_ns()
        late_us.append((now - deadline) / 1000)
        deadline += period_ns * max(1, (now - deadline) // period_ns + 1)
    p50, p99, worst = np.quantile(late_us, (0.5, 0.99, 1.0), method="higher").tolist()
    section.facts["timer_late_us"] = {"p50": p50, "p99": p99, "max": worst}
    text = f"wakes {p50:.0f}/{p99:.0f}/{worst:.0f} µs late (p50/p99/max of {len(late_us)}, no real time)"
    if worst >= period_s * 1e6 or p99 >= _BAD_JITTER_US:
        section.warn(
            "timer",
            text + f": what is late by a period of {period_s * 1000:g} ms leaves a cycle out",
            "a kernel with PREEMPT_RT, fewer programs beside it, or a longer bus.period_s",
        )
    elif p99 <= _GOOD_JITTER_US:
        section.ok("timer", text)
    else:
        section.info("timer", text)


@dataclass(frozen=True, slots=True, kw_only=True)
class Daemons:
    """Running drivelink daemons of this machine."""

    ours: bool  # whether one of them serves this joint
    others: Sequence[str]  # names of the other joints that are served


def judge_sync(
    section: Section, stamps_s: Sequence[float], bus: BusSection, daemons: Daemons | None = None
) -> None:
    """Check rate and jitter of SYNC.

    Args:
        daemons: running daemons, one of which may produce SYNC.
    """
    if len(stamps_s) < 3:
        if bus.sync == "follow":
            section.error("SYNC", "nobody makes SYNC", 'start the other master, or bus.sync = "produce"')
        else:
            section.ok("SYNC", "not produced yet: drivelink run will produce it")
        return
    gaps = [after - before for before, after in itertools.pairwise(stamps_s)]
    period_s = float(np.quantile(gaps, 0.5, method="higher"))
    deviation_us = [abs(gap - period_s) * 1e6 for gap in gaps]
    p99, worst = float(np.quantile(deviation_us, 0.99, method="higher")), max(deviation_us)
    section.facts["sync"] = {"period_s": period_s, "jitter_us": {"p99": p99, "max": worst}}
    text = f"every {period_s * 1000:.3f} ms, jitter {p99:.0f} µs (p99), {worst:.0f} µs (max)"
    if bus.sync == "produce":
        _judge_producer(section, text, daemons or Daemons(ours=False, others=()))
    elif "period_s" in bus.model_fields_set and abs(period_s - bus.period_s) > 0.02 * bus.period_s:
        text += f", the joint file says {bus.period_s * 1000:g} ms"
        section.error("SYNC", text, f"bus.period_s = {round(period_s, 5):g}")
    else:
        section.ok("SYNC", text)


def _judge_producer(section: Section, text: str, daemons: Daemons) -> None:
    """Who produces the SYNC that this joint is to produce."""
    if daemons.ours:
        section.ok("SYNC", f"{text}, produced by the drivelink daemon that runs")
    elif daemons.others:
        section.warn(
            "SYNC",
            f"{text}: the drivelink daemon of {', '.join(daemons.others)} may make it",
            "joints on one bus go into one command: drivelink run A.toml B.toml; "
            'with another master: bus.sync = "follow"',
        )
    else:
        text += ": another master produces it, no drivelink daemon is alive"
        section.warn("SYNC", text, 'bus.sync = "follow", or stop the other master')


def daemon_mapping(joint: JointFile, base_dir: Path) -> Sequence[NodeLayout]:
    """Return what the running daemon of a passive joint knows of its nodes; () without one."""
    config = _config(joint, base_dir)
    if config is None and not answers(joint.zenoh.endpoint):
        return ()
    try:
        session = open_client(joint.zenoh.endpoint, config)
    except ZenohError:  # reported by `examine_zenoh`
        return ()
    try:
        return daemon_layouts(session, joint, lambda _: None)
    finally:
        close_session(session)


def _config(joint: JointFile, base_dir: Path) -> Path | None:
    named = joint.zenoh.subscriber_config or joint.zenoh.config
    return base_dir / named if named else None


def examine_zenoh(section: Section, joint: JointFile, base_dir: Path) -> list[str]:
    """Check who listens at the endpoint, and whether this joint's key is taken.

    Returns:
        The joints that are served there.
    """
    settings = joint.zenoh
    for name in filter(None, (settings.config, settings.subscriber_config)):
        if not (base_dir / name).is_file():
            section.error("zenoh", f"{name}: there is no such file", "correct [zenoh] in the joint file")
            return []
    config = _config(joint, base_dir)
    where = settings.subscriber_config or settings.config or settings.endpoint
    if config is None and not answers(settings.endpoint):
        section.ok("zenoh", f"{where}: nobody there yet, the daemon will listen there")
        return []
    try:
        names = joints(endpoint=settings.endpoint, config=config, prefix=settings.prefix)
    except ZenohError as error:
        section.error("zenoh", str(error))
        return []
    section.facts["alive"] = [f"{settings.prefix}/{name}/alive" for name in names]
    if not names:
        section.ok("zenoh", f"{where}: reachable, no daemon is alive there")
        return []
    section.ok("zenoh", f"{where}: reachable, alive: {', '.join(names)}")
    if joint.name in names:
        text = f'a daemon for "{joint.name}" runs: a second one would be refused'
        section.info("zenoh", text, f"drivelink monitor {joint.name}")
    return names


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
            "there is no such interface" + (f", only {', '.join(known)}" if known else ""),
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
        text = f"transmit queue of {queue} frames: SYNC may find it full (ENOBUFS)"
        section.warn(name, text, f"sudo ip link set {name} txqueuelen 1000")
    if link.get("mtu", 16) > 16:
        section.info(name, "CAN FD: FD frames are accepted, CANopen uses the classic ones")
    if dropped := link.get("stats64", {}).get("rx", {}).get("dropped", 0):
        section.warn(name, f"{dropped} received frames were dropped since it is up")


def _judge_controller(section: Section, data: dict[str, Any], info: dict[str, Any], bus: BusSection) -> None:
    name, bitrate = bus.channel, data.get("bittiming", {}).get("bitrate", 0)
    down, up = f"sudo ip link set {name} down", f"sudo ip link set {name} up"
    if bitrate and bitrate != bus.bitrate:
        text = f"runs at {bitrate // 1000} kbit/s, the joint file says {bus.bitrate // 1000} kbit/s"
        fix = f"{down} && {up} type can bitrate {bus.bitrate}, or bus.bitrate = {bitrate}"
        section.error(name, text, fix)
    elif bitrate:
        section.ok(name, f"{bitrate // 1000} kbit/s")
    state, counters = data.get("state", "ERROR-ACTIVE"), data.get("berr_counter", {})
    errors = f"error counters: tx {counters.get('tx', 0)}, rx {counters.get('rx', 0)}"
    if state == "ERROR-ACTIVE":
        section.ok(name, f"error-active, {errors}")
    else:
        off = state in ("BUS-OFF", "STOPPED")
        text = f"is {state.lower()}, {errors}: check cable, termination (2 x 120 Ω), bit rate, and that "
        text += "another node is powered"
        severity = Severity.ERROR if off else Severity.WARNING
        section.add(severity, name, text, f"{down} && {up}" if off else "")
    if not data.get("restart_ms"):
        fix = f"{down} && sudo ip link set {name} type can restart-ms 100 && {up}"
        section.warn(name, "does not recover from bus-off by itself", fix)
    if offs := info.get("info_xstats", {}).get("bus_off", 0):
        section.warn(name, f"was bus-off {offs} times since it is up")
