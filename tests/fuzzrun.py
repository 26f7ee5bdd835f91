"""The daemon's own cycle on the bus that lies (`fuzzbus`), and the judge of what it publishes."""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Iterable
from functools import partial
from typing import Any

from daemonkit import vsa_text
from fuzzbus import MIXES, FuzzBus

from drivelink._core import Assembler, JointPipeline, Tick
from drivelink.canopen.configure import configure_joints
from drivelink.canopen.layout import NodeLayout, Signal
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.cycle.loop import CycleLoop, LoopJoint
from drivelink.cycle.pipeline import build
from drivelink.cycle.startup import BusPort
from drivelink.daemon.status import EventLog
from drivelink.daemon.supervision import Supervisor
from drivelink.jointfile import JointFile, parse
from estimator.sample import Estimate, Sample, Status

PERIOD_S = 0.001
FOLLOW = 'configure = false\nsync = "follow"\n'


class WrongValidError(AssertionError):
    """An estimate is VALID, and its sample is not that of its SYNC."""


class Witness:
    """An estimator that believes everything: whatever it is given is VALID."""

    residual_nm = 0.0

    def step(self, sample: Sample) -> Estimate:
        return Estimate(sample.sequence, int(Status.VALID), 0.0, 0.0, 0.0, ())

    def distrust(self) -> None:
        pass

    def lose_zeros(self) -> None:
        pass

    def parameters(self) -> list[dict[str, Any]]:
        return []

    def suspicion(self) -> None:
        return None


class ForeignMaster:
    """The same bus for a daemon that may only listen."""

    def __init__(self, bus: FuzzBus) -> None:
        self.lost_sends = 0
        self.errors: dict[str, int] = {}
        self.receive, self.wait, self.narrow = bus.receive, bus.wait, bus.narrow

    def send(self, cob_id: int, data: bytes) -> None:
        raise AssertionError(f"a passive daemon has sent 0x{cob_id:03X} [{data.hex(' ')}]")


class _Judge:
    """The sink: holds every VALID sample against what the nodes measured at its SYNC."""

    def __init__(self, run: FuzzRun) -> None:
        self._run = run
        self.valid = self.samples = self.unknowable = 0

    def put(self, tick: Tick) -> None:
        estimate, sample = tick.estimate, tick.sample
        if estimate.status & Status.VALID and estimate.status & Status.STALE:
            raise WrongValidError(f"VALID and STALE: {estimate}")
        if sample is None:
            return
        self.samples += 1
        if not estimate.status & Status.VALID:
            return
        self.valid += 1
        if not math.isfinite(estimate.stiffness_nm_rad + estimate.flexibility_torque_nm):
            raise WrongValidError(f"{self._run.where}: VALID and not finite: {estimate}")
        if not self._run.hostile:
            self._judge(sample, Status(estimate.status))

    def _judge(self, sample: Sample, status: Status) -> None:
        run = self._run
        before, due = run.due[-2:] if sample.sequence == run.pipeline.assembler.sequence else run.due[-3:-1]
        # BUS_FAULT says that frames were late: then they are of the cycle before, whose SYNC it may be.
        allowed = range(before, due + 1) if Status.BUS_FAULT in status else range(due, due + 1)
        ticks = run.ticks_of(sample)
        wrong = [name for name, tick in ticks.items() if tick not in allowed]
        if not wrong:
            return
        if all(run.forged(name) for name in wrong):
            self.unknowable += 1
            return
        raise WrongValidError(f"{run.where}: sample of SYNC {due} has values of {ticks}, {status!r}")


class FuzzRun:
    """A configured joint on a bus that lies.

    Args:
        seed: of everything that is drawn.
        hostile: see the module.
        passive: somebody else makes SYNC and has configured the nodes; hostile, and nothing may be sent.
        real: step the real estimator, not one that believes everything.
        overflow: of the SYNC counter.
    """

    def __init__(self, seed: int, *, hostile=False, passive=False, real=False, overflow=0) -> None:
        self.hostile = hostile or passive
        self.seed = seed
        self.joint: JointFile = parse(vsa_text(bus=FOLLOW if passive else ""))
        self.bus = FuzzBus(random.Random(seed), hostile=self.hostile)
        port = BusPort(self.bus.wire)
        self.configurator = configure_joints(port, [parse(vsa_text())])
        layouts = tuple(self.configurator.layouts.values())
        self._scales = _scales(layouts)
        estimator = build(self.joint)[0] if real else Witness()
        self.pipeline = JointPipeline(Assembler(layouts, 2, active=not passive), estimator)
        self.judge = _Judge(self)
        loop_joint = LoopJoint("fuzzed", self.pipeline, self.judge)
        source: Any = ForeignMaster(self.bus) if passive else self.bus
        how = {
            "period_s": PERIOD_S,
            "produce": not passive,
            "world_steps": True,
            "counter_overflow": overflow,
        }
        self.loop = CycleLoop(source, [loop_joint], **how)
        port.loop = self.loop
        silent = logging.getLogger("fuzzed")
        silent.disabled = True
        self.events = EventLog(silent, clock=lambda: self.loop.clock() * 1e-9)
        watching = PassiveConfigurator([self.joint]) if passive else self.configurator
        self.supervisor = Supervisor(self.loop, {loop_joint: layouts}, self.events, watching)
        self.loop.on_fault = _reraise  # whatever the daemon would survive is a failure here
        self.loop.housekeeping.urgent.append(self.supervisor.step)
        self.loop.housekeeping.every(0.05, self.supervisor.check)
        self.due = [0, 0, 0]  # SYNCs of the last three cycles, as the nodes count
        self._passive = passive
        self._stamp_ns = 0

    @property
    def where(self) -> str:
        return f"seed {self.seed}, cycle {self.loop.cycles}"

    def summary(self) -> str:
        kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(self.bus.kinds.items()))
        return (
            f"seed {self.seed}: {self.bus.frames} frames in {self.loop.cycles} cycles ({kinds}); "
            f"{self.judge.valid} VALID, of these {self.judge.unknowable} with a forged frame nobody could detect"
        )

    def ticks_of(self, sample: Sample) -> dict[str, float]:
        """The SYNC that each value of a sample was taken at."""
        first, second = self._scales["motor1"], self._scales["motor2"]
        return {
            "motor1": (round(sample.motor_position_rad[0] / first) - 1000) / 3,
            "motor2": (round(sample.motor_position_rad[1] / second) - 2000) / 3,
            "link": (round(sample.link_position_rad / self._scales["link"]) - 7) / 5,
        }

    def run(self, frames: int) -> None:
        """Run until so many frames have reached the daemon, restless and calm by turns.

        Raises:
            WrongValidError: see there.
        """
        bus, draw = self.bus, random.Random(self.seed + 1)
        end = bus.frames + frames
        while bus.frames < end:
            bus.rate, bus.mix = draw.choice((0.001, 0.01, 0.1, 0.5)), draw.choice(MIXES)
            for _ in range(draw.randrange(1, 300)):
                self.cycle()
            bus.rate = 0.0
            for _ in range(draw.randrange(200)):
                self.cycle()

    def cycle(self) -> None:
        self._stamp_ns += self.loop.period_ns
        self.due = [*self.due[1:], self.bus.tick + 1]
        if not self._passive:
            self.loop.run_lockstep(1, self._stamp_ns)
            return
        self.loop.clock = partial(int, self._stamp_ns)
        self.bus.lead(self._stamp_ns)
        self.loop.receive()
        self.loop.housekeeping.run(self._stamp_ns, self.loop.period_ns)

    def forged(self, name: str) -> bool:
        """Whether a frame that looks like that of this value was forged in this cycle or the one before."""
        node = {"motor1": 1, "motor2": 2, "link": 3}[name]
        frames = {(t.cob_id, t.length) for t in self.configurator.layouts[node].tpdos}
        return any(frames & forged for forged in self.bus.forged)


def _scales(layouts: Iterable[NodeLayout]) -> dict[str, float]:
    scales = {}
    for layout in layouts:
        for mapped in (mapped for frame in layout.tpdos for mapped in frame.objects):
            if mapped.signal is Signal.MOTOR_POSITION:
                scales[f"motor{(layout.motor or 0) + 1}"] = mapped.scale
            elif mapped.signal is Signal.LINK_POSITION:
                scales["link"] = mapped.scale
    return scales


def _reraise(_where: str, error: Exception) -> None:
    raise error
