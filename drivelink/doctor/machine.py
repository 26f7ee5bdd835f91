"""Checks kernel and permissions: scheduling, locked memory, CPU clock, timer."""

from __future__ import annotations

import os
import platform
import resource
import time
from pathlib import Path

from drivelink.doctor.report import Section
from drivelink.notice import Severity
from drivelink.pubsub.session import FILES

_CPU = Path("/sys/devices/system/cpu")
_NEEDED_LOCKED = 256 << 20  # bytes; the daemon's resident size is below
_GOOD_JITTER_US, _BAD_JITTER_US = 150.0, 1000.0
_CAP_SYS_NICE, _CAP_IPC_LOCK = 23, 14


def examine_machine(section: Section, period_s: float, seconds: float) -> None:
    """Examine kernel, rights and timer."""
    kernel = platform.release()
    realtime = Path("/sys/kernel/realtime").exists() or "PREEMPT_RT" in platform.version()
    section.ok("kernel", f"Linux {kernel}" + (", PREEMPT_RT" if realtime else ""))
    capabilities = _capabilities()
    _scheduling(section, capabilities)
    _memory(section, capabilities)
    _files(section)
    _governor(section)
    _timer(section, period_s, seconds)


def _capabilities() -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii", errors="replace").splitlines():
        if line.startswith("CapEff:"):
            return int(line.split()[1], 16)
    return 0


def _scheduling(section: Section, capabilities: int) -> None:
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    if limit == resource.RLIM_INFINITY or limit >= 80 or capabilities >> _CAP_SYS_NICE & 1:
        section.ok("real time", "SCHED_FIFO is allowed")
    else:
        section.say(
            Severity.WARNING,
            "real time",
            f"SCHED_FIFO is not allowed (limit {limit}, 80 is wanted): expect a larger jitter",
            f"echo '{_user()} - rtprio 99' | sudo tee -a /etc/security/limits.d/drivelink.conf, "
            "then log in again",
        )


def _memory(section: Section, capabilities: int) -> None:
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if limit == resource.RLIM_INFINITY or limit >= _NEEDED_LOCKED or capabilities >> _CAP_IPC_LOCK & 1:
        section.ok("memory", "can be locked")
    else:
        section.say(
            Severity.WARNING,
            "memory",
            f"only {limit >> 10} KiB may be locked: a page fault may delay a cycle",
            f"echo '{_user()} - memlock unlimited' | sudo tee -a /etc/security/limits.d/drivelink.conf, "
            "then log in again",
        )


def _files(section: Section) -> None:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if limit == resource.RLIM_INFINITY or limit >= FILES:
        section.ok("files", f"{FILES} may be open: connections that say nothing lock no subscriber out")
    else:
        section.say(
            Severity.WARNING,
            "files",
            f"only {limit} may be open, {FILES} are wanted: as many connections lock new subscribers out",
            f"echo '{_user()} - nofile {FILES}' | sudo tee -a /etc/security/limits.d/drivelink.conf, "
            "then log in again",
        )


def _user() -> str:
    return os.environ.get("USER", "USER")


def _governor(section: Section) -> None:
    governors = set()
    for path in _CPU.glob("cpu[0-9]*/cpufreq/scaling_governor"):
        governors.add(path.read_text(encoding="ascii", errors="replace").strip())
    if not governors:
        section.ok("CPU clock", "not managed by this kernel")
    elif governors == {"performance"}:
        section.ok("CPU clock", "governor performance")
    else:
        section.say(
            Severity.WARNING,
            "CPU clock",
            f"governor {', '.join(sorted(governors))}: the CPU clock first has to rise after each idle phase",
            "sudo cpupower frequency-set -g performance",
        )
    cores = os.cpu_count() or 1
    if cores < 2:
        section.say(Severity.WARNING, "CPU", "one core only: everything else on it delays the cycle")


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
    if p99 <= _GOOD_JITTER_US:
        section.ok("timer", text)
    elif p99 < min(_BAD_JITTER_US, period_s * 1e6):
        section.say(Severity.INFO, "timer", text)
    else:
        section.say(
            Severity.WARNING,
            "timer",
            text + f": more than a period of {period_s * 1000:g} ms allows",
            "a kernel with PREEMPT_RT, fewer programs beside it, or a longer bus.period_s",
        )


def percentile(values: list[float], fraction: float) -> float:
    """Return the given quantile of the values."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))]
