"""Results of the cross-checks, in words and for the status key."""

from __future__ import annotations

from typing import Any

from drivelink._core import Assembler

_WORDS = {
    "velocity": "velocity (0x606C)",
    "current": "current",
    "second_encoder": "second encoder",
    "following_error": "following error (0x60F4)",
}


def cross_checks(assembler: Assembler) -> list[dict[str, Any]]:
    """Return all checks that the mapping makes possible.

    {"motor": from 1 on, "check": "velocity" | "current" | "second_encoder" | "following_error", "verdict":
    "untested" | "agrees" | "contradicts", "scale": of the second reading against the first, "std": of that}.
    """
    return [
        {"motor": motor, "check": check, "verdict": verdict, "scale": scale, "std": std}
        for motor, check, verdict, scale, std in assembler.checks
    ]


def contradiction(assembler: Assembler) -> dict[str, Any] | None:
    """Return the reading that a cross-check suspects, in the form of `Estimator.suspicion`; None: none.

    If a second check confirms the position, the other reading is wrong; if two contradict it and none
    confirms it, the position is; otherwise it is undecided.
    """
    checks = cross_checks(assembler)
    failing = [check for check in checks if check["verdict"] == "contradicts"]
    if not failing:
        return None
    failed = failing[0]
    motor, check = failed["motor"], failed["check"]
    of_motor = [c for c in checks if c["motor"] == motor and c["check"] != "current"]
    cleared = check != "current" and any(c["verdict"] == "agrees" for c in of_motor)
    against = [c["check"] for c in of_motor if c["verdict"] == "contradicts"]
    if cleared:
        signal, what = f"motor_{check}", f"{_WORDS[check]} of motor {motor}: it contradicts the position, "
        what += "which another reading confirms"
    elif check != "current" and len(against) > 1:
        signal = "motor_position"
        what = f"position of motor {motor}: {' and '.join(_WORDS[c] for c in against)} contradict it"
    else:
        first = "torque" if check == "current" else "position"
        signal = f"motor_{first}_or_{check}"
        what = f"{first} and {_WORDS[check]} of motor {motor} contradict each other"
    return {
        "signal": signal,
        "motor": motor,
        "reason": "contradicted",
        "amount": failed["scale"] - 1.0,
        "std": failed["std"],
        "explains": True,
        "text": what,
    }
