"""The controller as a process: estimates over zenoh in, torque over CAN out.

    drivelink sim examples/controller/joint.toml &      # or real drives
    drivelink run examples/controller/joint.toml &      # the daemon
    python examples/controller/run.py examples/controller/joint.toml

It prints each change of phase, and once a second where the joint is and where it goes; with --json, each
change of phase as one line of JSON. Ctrl-C takes the torque away and ends it.
"""

import argparse
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import canopen
import zenoh
from controller import NO_TORQUE, Controller, Cycle, Settings
from drives import Master

from drivelink import jointfile
from drivelink.canopen.bus import open_bus
from drivelink.cycle import realtime
from drivelink.errors import DrivelinkError, ZenohError
from drivelink.pubsub.client import Subscription, subscribe
from drivelink.pubsub.session import close_session, open_client
from drivelink.pubsub.wire import decode_sample
from estimator.sample import Sample

WAIT_S = 0.002  # for an estimate, before the dead man looks again
SHOW_S = 1.0  # from one line about the joint to the next
BUSY_S = 0.1  # while estimates are older, the daemon may be busy with the nodes: nothing is set up


class Process:
    """Controller, drives and estimates, until `done`."""

    def __init__(self, controller: Controller, master: Master, estimates: Subscription, samples: Any) -> None:
        self.controller, self.master, self.estimates, self.samples = controller, master, estimates, samples
        self._sample: Sample | None = None

    def run(self, done: Callable[[], bool]) -> None:
        """Control until `done`, and leave the drives without torque."""
        try:
            while not done():
                self.once()
        finally:
            with suppress(can.CanError, OSError):
                self.master.release()

    def once(self) -> None:
        """Take what has arrived, and command."""
        estimate = self.estimates.wait(WAIT_S)
        while (message := self.samples.try_recv()) is not None:
            with suppress(ZenohError):
                self._sample = decode_sample(message.payload.to_bytes()).sample
        now_s, age_s = time.monotonic(), self.estimates.age_s
        if self.estimates.status:
            self.controller.set_springs(self.estimates.status.get("transmissions", ()))
        cycle = None
        if estimate is not None and self._sample is not None:
            cycle = Cycle(estimate, self._sample, self.estimates.external, age_s)
        torques = self.controller.step(now_s, cycle, **self.master.states)
        with suppress(can.CanError, OSError):  # without a bus estimates get stale, which ends the torque
            self.master.command(torques, now_s)
            if age_s < BUSY_S and torques == NO_TORQUE:
                self.master.set_up(now_s)


class View:
    """What a person sees of a controller; `as_json`: what a program does."""

    def __init__(self, as_json: bool) -> None:
        self._json, self._next_s = as_json, 0.0

    def report(self, phase: str, reason: str, age_s: float) -> None:
        """Print a change of phase."""
        if self._json:
            event = {"phase": phase, "reason": reason, "time_s": time.monotonic(), "age_s": round(age_s, 4)}
            print(json.dumps(event), flush=True)
        else:
            print(f"{time.strftime('%H:%M:%S')} {phase}{reason and ': '}{reason}", flush=True)

    def show(self, controller: Controller) -> None:
        """Print where the joint is, once a second."""
        if not self._json and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + SHOW_S
            print(f"{time.strftime('%H:%M:%S')} {controller.phase:8} {controller}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    default = Settings()
    parser.add_argument("joint", type=Path, metavar="JOINT", help="joint file")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after so many seconds")
    parser.add_argument(
        "--deadline", type=float, default=default.deadline_s, help="oldest estimate to act on, s"
    )
    parser.add_argument(
        "--identify", type=float, default=default.identify_s, help="length of the identification, s"
    )
    parser.add_argument("--torque", type=float, default=default.torque_nm, help="limit, N·m at the joint")
    how = {"choices": ["stop", "retract", "soften"], "default": default.reaction}
    parser.add_argument("--reaction", **how, help="what a contact makes the link do (default: %(default)s)")
    parser.add_argument(
        "--json", action="store_true", help="print changes of phase as JSON, and nothing else"
    )
    args = parser.parse_args()
    joint = jointfile.load(args.joint)
    if joint.arrangement != "antagonistic" or joint.link.dynamics is None:
        parser.error(f'{args.joint}: expected arrangement = "antagonistic" and [link.dynamics]')
    settings = Settings(
        deadline_s=args.deadline, identify_s=args.identify, torque_nm=args.torque, reaction=args.reaction
    )

    view, stopped = View(args.json), list[int]()
    controller = Controller(joint, settings, view.report)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _: stopped.append(received))
    for line in realtime.acquire().lines:
        print(line, file=sys.stderr)
    config = args.joint.parent / joint.zenoh.config if joint.zenoh.config else None
    session = open_client(joint.zenoh.endpoint, config)
    key = f"{joint.zenoh.prefix}/{joint.name}/sample"
    samples = session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
    network = canopen.Network(open_bus(joint.bus)).connect()
    end_s = time.monotonic() + args.seconds
    try:
        with subscribe(joint.name, prefix=joint.zenoh.prefix, session=session) as estimates:
            master = Master(network, joint, settings.torque_nm, 10.0 * settings.deadline_s)
            process = Process(controller, master, estimates, samples)

            def done() -> bool:
                view.show(controller)
                return bool(stopped) or time.monotonic() >= end_s

            process.run(done)
    finally:
        network.disconnect()
        close_session(session)


if __name__ == "__main__":
    logging.getLogger("can").setLevel(logging.CRITICAL)  # socketcand logs every partial read
    try:
        main()
    except DrivelinkError as error:
        sys.exit(f"run.py: {error}")
    except BrokenPipeError:  # `| head`: it has taken the torque away, as by Ctrl-C
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
