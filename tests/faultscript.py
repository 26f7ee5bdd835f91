"""What goes wrong on a bus, as data: one script for the virtual bus in lockstep and for a real SocketCAN.

A `Fault` is a list of (seconds, action, arguments): each action is taken at the SYNC nearest to that time.
What must follow is part of it: what the estimates' flags say, what is said in the log, once, and that
everything is well again without a restart. The actions are methods of `faultstage.Stage`.
"""

from dataclasses import dataclass, field
from typing import Any

from estimator.sample import Status

Step = tuple[float, str, tuple[Any, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that goes wrong, and what must come of it."""

    name: str  # in words
    steps: tuple[Step, ...]  # what is done, and when, in seconds from the start
    seconds: float = 0.5  # how long it is watched before everything must be on its way back
    flags: int = 0  # each of these is on some estimate
    # whether there are cycles without a fresh measurement: none of these is VALID; None: by what the
    # devices happen to read
    gaps: bool | None = False
    valid_throughout: bool = False  # whether no estimate may lose VALID
    says: tuple[str, ...] = ()  # regular expressions; each is said exactly once
    state: str = ""  # what the status says meanwhile
    # {(node id, counter): how often in lockstep}; on a real bus at least once
    counts: dict[tuple[int, str], int] = field(default_factory=dict)
    where: str = "both"  # "both", "lockstep", "real"


def at(seconds: float, action: str, *arguments: Any) -> Step:
    return (seconds, action, arguments)


MISSING, REBOOTED = r"^node 2: frames are missing$", r"^node 2 has rebooted$"
STARTED = r"^node 2 is configured again and started$"
GONE, BACK, BUS_FAULT = Status.STALE, Status.STALE | Status.RESTARTED, Status.BUS_FAULT
AGAIN = (REBOOTED, STARTED)


def fault(name: str, *steps: Step, **more: Any) -> Fault:
    return Fault(name=name, steps=steps, **more)


def gap(name: str, *steps: Step, flags: int = GONE, says: tuple[str, ...] = (), **more: Any) -> Fault:
    """Something after which there are cycles without a fresh measurement."""
    return fault(name, *steps, flags=flags, gaps=True, says=says, **more)


def calm(name: str, *steps: Step, **more: Any) -> Fault:
    """Something that costs no estimate its VALID."""
    return fault(name, *steps, valid_throughout=True, **more)


GARBAGE = [
    (i, d)
    for i in (0x082, 0x582, 0x702, 0x000, 0x602, 0x183)
    for d in (b"", b"\xff", b"\x12\x34\x56", b"\xff" * 7)
]
NODE_2_CANNOT, DIFFERENT = r"^node 2 cannot be configured: ", r"^node 2: different frames in one cycle"
HEARTBEAT_LOST, HEARTBEAT_BACK = r"^node 2: heartbeat lost$", r"^node 2: heartbeat is back$"
BUS_LOST = {"says": (r"the bus is lost: ", r"the bus is back$", STARTED), "state": "bus lost", "seconds": 1.0}
STALE = {"state": "stale", "seconds": 1.6}

SCRIPT: tuple[Fault, ...] = (
    gap("a PDO is lost", at(0.1, "mute", 2, 1), flags=Status.GAP | BUS_FAULT | GONE, says=(MISSING,),
        counts={(2, "missing"): 1}),
    gap("PDOs come one SYNC late", at(0.1, "delay", 2, 3), flags=BUS_FAULT, says=(MISSING,), counts={(2, "late"): 1}),
    gap("PDOs of the wrong length", at(0.1, "resize", 2, 5, 3), flags=BUS_FAULT | GONE,
        says=(r"^node 2: frames of the wrong length",), counts={(2, "wrong_length"): 3}),
    calm("a PDO comes twice", at(0.1, "repeat", 2, 4), counts={(2, "duplicate"): 4}),
    calm("the nodes answer in another order", at(0.1, "reverse"), at(0.2, "reverse")),
    gap("a drive does not see some SYNCs", at(0.1, "drop_sync", 5), flags=GONE | Status.GAP, says=(MISSING,)),
    fault("EMCY and fault, and their reset", at(0.1, "emergency", 2, 0x2310, 0x02), at(0.4, "mend", 2),
          flags=Status.DRIVE_FAULT, counts={(2, "emergencies"): 1},
          says=(r"^node 2: EMCY 0x2310 .*overcurrent", r"^node 2 reports a fault$", r"^node 2 reports no fault")),
    gap("heartbeat lost and back", at(0.1, "kill", 2), at(1.0, "revive", 2), flags=BACK, state="stale", seconds=1.5,
        says=(HEARTBEAT_LOST, MISSING, HEARTBEAT_BACK, *AGAIN), counts={(2, "reboots"): 1}),
    gap("a drive reboots", at(0.1, "reboot", 2), flags=BACK, says=AGAIN, counts={(2, "reboots"): 1}),
    gap("a drive reboots, and another master starts it before we have configured it",
        at(0.1, "reboot", 2), at(0.1, "inject", 0x000, b"\x01\x00"), flags=BACK, says=AGAIN),
    gap("a drive reboots, and another master starts that drive before we have configured it",
        at(0.1, "reboot", 2), at(0.1, "inject", 0x000, b"\x01\x02"), flags=BACK, says=AGAIN),
    gap("a foreign master resets the communication of all nodes", at(0.1, "inject", 0x000, b"\x82\x00"), flags=BACK,
        says=AGAIN),
    fault("another master homes a drive", at(0.1, "inject", 0x602, b"\x2f\x60\x60\0\x06\0\0\0"),
          at(1.0, "inject", 0x602, b"\x2f\x60\x60\0\x0a\0\0\0"), seconds=1.5, flags=Status.RESTARTED),
    gap("a drive is stopped by another master", at(0.1, "inject", 0x000, b"\x02\x02"), says=(MISSING, STARTED),
        seconds=1.5),
    gap("SDO timeouts while it is configured again", at(0.1, "reboot", 2), at(0.1, "ignore_sdo", 2, 100), flags=BACK,
        says=(REBOOTED, NODE_2_CANNOT + r".*does not answer: SDO 0x1000:00.*", STARTED), seconds=1.5),
    gap("SDO aborts while it is configured again", at(0.1, "reboot", 2),
        at(0.1, "refuse_sdo", 2, 0x08000022, 10_000), at(1.0, "refuse_sdo", 2, 0x08000022, 0), flags=BACK,
        says=(REBOOTED, NODE_2_CANNOT + r".*0x08000022 \(.+\)", STARTED), seconds=1.5),
    gap("two devices with one node id", at(0.1, "impostor", 2), at(2.0, "banish"), flags=GONE | BUS_FAULT,
        says=(DIFFERENT, STARTED), seconds=2.5),
    # Two answers in a row that are alike do not say which of them is ours: the next SYNC too many costs that cycle.
    fault("another master makes SYNC too", at(0.1, "foreign_sync", 5), gaps=None,
          says=(r"^another master produces SYNC: its cycles are not used",
                r"^the other master stopped producing SYNC")),
    calm("a node babbles", at(0.1, "babble", 0x555, bytes(8), 20), at(0.3, "quiet")),
    gap("a node babbles with the identifier of a drive", at(0.1, "babble_as", 2, 2), at(0.3, "quiet"),
        flags=GONE | BUS_FAULT, says=(DIFFERENT,)),
    fault("garbage on every service identifier of a drive",
          *(at(0.1 + 0.01 * k, "inject", *frame) for k, frame in enumerate(GARBAGE))),
    gap("the cable comes out and is back", at(0.1, "unplug"), at(1.5, "plug"), **STALE,
        says=(MISSING, HEARTBEAT_LOST, HEARTBEAT_BACK, STARTED)),
    gap("the cable comes out, and a drive has lost its supply when it is back", at(0.1, "unplug"),
        at(0.5, "kill", 2), at(0.8, "revive", 2), at(1.5, "plug"), says=(MISSING, STARTED), **STALE),
    gap("the controller is bus-off and starts again", at(0.1, "error_frame", 0x040), at(0.1, "unplug"),
        at(0.4, "plug"), at(0.4, "error_frame", 0x100),
        says=(r"^the CAN controller is bus-off", r"^the CAN controller is on the bus again")),
    gap("the transmit queue is full", at(0.1, "full_queue"), at(0.3, "empty_queue"), where="lockstep",
        says=(r"^the transmit queue is full", r"^the transmit queue drains again")),
    gap("the interface goes down and up", at(0.1, "down"), at(0.8, "up"), where="real", **BUS_LOST),
    gap("the interface is removed and returns", at(0.1, "remove"), at(0.8, "bring"), **BUS_LOST),
    calm("the system's clock is set forward and back", at(0.1, "clock", 3600.0), at(1.6, "clock", -3600.0),
         says=(r"^the system's clock was set by \+3600", r"^the system's clock was set by -3600"), seconds=3.2),
)  # fmt: skip
