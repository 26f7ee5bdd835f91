"""What goes wrong on a bus, as data: one script for the virtual bus in lockstep and for a real SocketCAN.

A `Fault` is a list of (seconds, action, arguments): each action is taken at the SYNC nearest to that time.
What must follow is part of it: what the estimates' flags say, what is said in the log, once, and that
everything is well again without a restart. The actions are methods of `faultstage.Stage`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from estimator.sample import Status

__all__ = ["SCRIPT", "Fault", "Step"]

Step = tuple[float, str, tuple[Any, ...]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that goes wrong, and what must come of it.

    Attributes:
        name: in words.
        steps: what is done, and when, in seconds from the start.
        seconds: how long it is watched before everything must be on its way back.
        flags: each of these is on some estimate.
        gaps: whether there are cycles without a fresh measurement: none of these is VALID.
        valid_throughout: whether no estimate may lose VALID.
        says: regular expressions; each is said exactly once.
        state: what the status says meanwhile.
        counts: {(node id, counter): how often in lockstep}; on a real bus at least once.
        where: "both", "lockstep", "real".
    """

    name: str
    steps: tuple[Step, ...]
    seconds: float = 0.5
    flags: int = 0
    gaps: bool = False
    valid_throughout: bool = False
    says: tuple[str, ...] = ()
    state: str = ""
    counts: dict[tuple[int, str], int] = field(default_factory=dict)
    where: str = "both"


def at(seconds: float, action: str, *arguments: Any) -> Step:
    return (seconds, action, arguments)


MISSING = r"^node 2: frames are missing$"
REBOOTED = r"^node 2 has rebooted$"
STARTED = r"^node 2 is configured again and started$"

SCRIPT: tuple[Fault, ...] = (
    Fault(
        name="a PDO is lost",
        steps=(at(0.1, "mute", 2, 1),),
        flags=Status.GAP | Status.BUS_FAULT | Status.STALE,
        gaps=True,
        says=(MISSING,),
        counts={(2, "missing"): 1},
    ),
    Fault(
        name="PDOs come one SYNC late",
        steps=(at(0.1, "delay", 2, 3),),
        flags=Status.BUS_FAULT,
        gaps=True,
        says=(MISSING,),
        counts={(2, "late"): 1},
    ),
    Fault(
        name="PDOs of the wrong length",
        steps=(at(0.1, "resize", 2, 5, 3),),
        flags=Status.BUS_FAULT | Status.STALE,
        gaps=True,
        says=(r"^node 2: frames of the wrong length",),
        counts={(2, "wrong_length"): 3},
    ),
    Fault(
        name="a PDO comes twice",
        steps=(at(0.1, "repeat", 2, 4),),
        valid_throughout=True,
        counts={(2, "duplicate"): 4},
    ),
    Fault(
        name="the nodes answer in another order",
        steps=(at(0.1, "reverse"), at(0.2, "reverse")),
        valid_throughout=True,
    ),
    Fault(
        name="a drive does not see some SYNCs",
        steps=(at(0.1, "drop_sync", 5),),
        flags=Status.STALE | Status.GAP,
        gaps=True,
        says=(MISSING,),
    ),
    Fault(
        name="EMCY and fault, and their reset",
        steps=(at(0.1, "emergency", 2, 0x2310, 0x02), at(0.4, "mend", 2)),
        flags=Status.DRIVE_FAULT,
        says=(
            r"^node 2: EMCY 0x2310 .*overcurrent",
            r"^node 2 reports a fault$",
            r"^node 2 reports no fault",
        ),
        counts={(2, "emergencies"): 1},
    ),
    Fault(
        name="heartbeat lost and back",
        steps=(at(0.1, "kill", 2), at(1.0, "revive", 2)),
        seconds=1.5,
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(r"^node 2: heartbeat lost$", MISSING, r"^node 2: heartbeat is back$", REBOOTED, STARTED),
        state="stale",
        counts={(2, "reboots"): 1},
    ),
    Fault(
        name="a drive reboots",
        steps=(at(0.1, "reboot", 2),),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, STARTED),
        counts={(2, "reboots"): 1},
    ),
    Fault(
        name="a drive reboots, and another master starts it before we have configured it",
        steps=(at(0.1, "reboot", 2), at(0.1, "inject", 0x000, b"\x01\x00")),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, STARTED),
    ),
    Fault(
        name="a drive reboots, and another master starts that drive before we have configured it",
        steps=(at(0.1, "reboot", 2), at(0.1, "inject", 0x000, b"\x01\x02")),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, STARTED),
    ),
    Fault(
        name="a foreign master resets the communication of all nodes",
        steps=(at(0.1, "inject", 0x000, b"\x82\x00"),),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, STARTED),
    ),
    Fault(
        name="a drive is stopped by another master",
        steps=(at(0.1, "inject", 0x000, b"\x02\x02"),),
        flags=Status.STALE,
        gaps=True,
        says=(MISSING, STARTED),
        seconds=1.5,
    ),
    Fault(
        name="SDO timeouts while it is configured again",
        steps=(at(0.1, "reboot", 2), at(0.1, "ignore_sdo", 2, 100)),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, r"^node 2 cannot be configured: .*does not answer: SDO 0x1000:00.*", STARTED),
        seconds=6.0,
    ),
    Fault(
        name="SDO aborts while it is configured again",
        steps=(
            at(0.1, "reboot", 2),
            at(0.1, "refuse_sdo", 2, 0x08000022, 10_000),
            at(3.5, "refuse_sdo", 2, 0x08000022, 0),
        ),
        flags=Status.STALE | Status.RESTARTED,
        gaps=True,
        says=(REBOOTED, r"^node 2 cannot be configured: .*0x08000022 \(.+\)", STARTED),
        seconds=4.0,
    ),
    Fault(
        name="two devices with one node id",
        steps=(at(0.1, "impostor", 2), at(2.0, "banish")),
        seconds=2.5,
        flags=Status.STALE | Status.BUS_FAULT,
        gaps=True,
        says=(r"^node 2: different frames in one cycle", STARTED),
    ),
    Fault(
        name="another master makes SYNC too",
        steps=(at(0.1, "foreign_sync", 5),),
        says=(
            r"^another master produces SYNC: its cycles are not used",
            r"^the other master stopped producing SYNC",
        ),
    ),
    Fault(
        name="a node babbles",
        steps=(at(0.1, "babble", 0x555, bytes(8), 20), at(0.3, "quiet")),
        valid_throughout=True,
    ),
    Fault(
        name="a node babbles with the identifier of a drive",
        steps=(at(0.1, "babble_as", 2, 2), at(0.3, "quiet")),
        flags=Status.STALE | Status.BUS_FAULT,
        gaps=True,
        says=(r"^node 2: different frames in one cycle",),
    ),
    Fault(
        name="garbage on every service identifier of a drive",
        steps=tuple(
            at(0.1 + 0.01 * k, "inject", cob_id, data)
            for k, (cob_id, data) in enumerate(
                (cob_id, data)
                for cob_id in (0x082, 0x582, 0x702, 0x000, 0x602, 0x183)
                for data in (b"", b"\xff", b"\x12\x34\x56", b"\xff" * 7)
            )
        ),
    ),
    Fault(
        name="the cable comes out and is back",
        steps=(at(0.1, "unplug"), at(1.5, "plug")),
        seconds=2.0,
        flags=Status.STALE,
        gaps=True,
        says=(MISSING, r"^node 2: heartbeat lost$", r"^node 2: heartbeat is back$", STARTED),
        state="stale",
    ),
    Fault(
        name="the cable comes out, and a drive has lost its supply when it is back",
        steps=(at(0.1, "unplug"), at(0.5, "kill", 2), at(0.8, "revive", 2), at(1.5, "plug")),
        seconds=2.0,
        flags=Status.STALE,
        gaps=True,
        says=(MISSING, STARTED),
        state="stale",
    ),
    Fault(
        name="the controller is bus-off and starts again",
        steps=(
            at(0.1, "error_frame", 0x040),
            at(0.1, "unplug"),
            at(0.4, "plug"),
            at(0.4, "error_frame", 0x100),
        ),
        flags=Status.STALE,
        gaps=True,
        says=(r"^the CAN controller is bus-off", r"^the CAN controller is on the bus again"),
    ),
    Fault(
        name="the transmit queue is full",
        steps=(at(0.1, "full_queue"), at(0.3, "empty_queue")),
        flags=Status.STALE,
        gaps=True,
        says=(r"^the transmit queue is full", r"^the transmit queue drains again"),
        where="lockstep",
    ),
    Fault(
        name="the interface goes down and up",
        steps=(at(0.1, "down"), at(0.8, "up")),
        seconds=1.0,
        flags=Status.STALE,
        gaps=True,
        says=(r"the bus is lost: ", r"the bus is back$", STARTED),
        state="bus lost",
        where="real",
    ),
    Fault(
        name="the interface is removed and returns",
        steps=(at(0.1, "remove"), at(0.8, "bring")),
        seconds=1.0,
        flags=Status.STALE,
        gaps=True,
        says=(r"the bus is lost: ", r"the bus is back$", STARTED),
        state="bus lost",
    ),
    Fault(
        name="the system's clock is set forward and back",
        steps=(at(0.1, "clock", 3600.0), at(1.6, "clock", -3600.0)),
        seconds=3.2,
        valid_throughout=True,
        says=(r"^the system's clock was set by \+3600", r"^the system's clock was set by -3600"),
    ),
)
