"""Checks this machine (scheduling, memory, CPU clock, timer), SYNC on its bus, and zenoh by a subscriber."""

from __future__ import annotations

import itertools
import os
import platform
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivelink.canopen.layout import NodeLayout
from drivelink.cycle.realtime import PRIORITY
from drivelink.doctor.report import Section
from drivelink.errors import ZenohError
from drivelink.jointfile import BusSection, JointFile
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
    _rights(section, _capabilities())
    _governor(section)
    _timer(section, period_s, seconds)


def _capabilities() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0


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
         f"{FILES} may be open: connections that say nothing lock no subscriber out",
         f"only {files} may be open, {FILES} are wanted: as many connections lock new subscribers out",
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
    governors = set()
    for path in _CPU.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        governors.add(path.read_text(encoding="ascii", errors="replace").strip())
    if not governors:
        section.ok("CPU clock", "not managed by this kernel")
    elif governors == {"performance"}:
        section.ok("CPU clock", "governor performance")
    else:
        section.warn(
            "CPU clock",
            f"governor {', '.join(sorted(governors))}: the CPU clock first has to rise after each idle phase",
            "sudo cpupower frequency-set -g performance",
        )
    cores = os.cpu_count() or 1
    if cores < 2:
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
    p50, p99, worst = percentile(late_us, 0.5), percentile(late_us, 0.99), max(late_us)
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


def percentile(values: list[float], fraction: float) -> float:
    """Return the given quantile of the values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]


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
    period_s = percentile(gaps, 0.5)
    deviation_us = [abs(gap - period_s) * 1e6 for gap in gaps]
    p99, worst = percentile(deviation_us, 0.99), max(deviation_us)
    section.facts["sync"] = {"period_s": period_s, "jitter_us": {"p99": p99, "max": worst}}
    text = f"every {period_s * 1000:.3f} ms, jitter {p99:.0f} µs (p99), {worst:.0f} µs (max)"
    if bus.sync == "produce":
        _judge_producer(section, text, daemons or Daemons(ours=False, others=()))
    elif "period_s" in bus.model_fields_set and abs(period_s - bus.period_s) > 0.02 * bus.period_s:
        section.error(
            "SYNC",
            f"{text}, the joint file says {bus.period_s * 1000:g} ms",
            f"bus.period_s = {round(period_s, 5):g}",
        )
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
        section.warn(
            "SYNC",
            f"{text}: another master produces it, no drivelink daemon is alive",
            'bus.sync = "follow", or stop the other master',
        )


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
        section.info(
            "zenoh",
            f'a daemon for "{joint.name}" runs: a second one would be refused',
            f"drivelink monitor {joint.name}",
        )
    return names
