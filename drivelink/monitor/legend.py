"""What the lines of a live view in the terminal mean, of those that it has."""

from rich.table import Table

_NUMBERS = (
    ("stiffness", "of the joint, N·m/rad, ± half its 95 % interval"),
    ("torque", "of the transmission, N·m, ± half its 95 % interval"),
)
_DEFLECTION = "φ = q − θ of each transmission, rad"


def joint_legend(*, motors: int, external: bool, truth: bool) -> Table:
    """Return the legend of one joint's view.

    Args:
        motors: number of transmissions.
        external: whether the view has the external torque.
        truth: whether it has the truth of a simulation.
    """
    several = motors > 1
    touch = ("external", "torque on the link, N·m, ± half its 95 % interval")
    curve = "● now, dotted: 95 % band, grey dots: the model"
    return _table(
        *_NUMBERS,
        *([touch] if external else []),
        ("deflection", _DEFLECTION + ("; each: its stiffness, N·m/rad" if several else "")),
        ("curve", curve + ("; cyan: motor 1, magenta: motor 2" if several else "")),
        ("over time", "grey: not valid" + ("; yellow: truth of the simulation" if truth else "")),
        ("cycle", "missed: SYNCs left out; p99: 99th percentiles of a cycle's work, of the answer "
         "to SYNC, and of how late SYNC is"),
        ("nodes", "what each CANopen node is; load of bus and processor"),
        ("residual", "torque that the model leaves; a bar is half full at its baseline (of fit)"),
        ("look here", "what is wrong now, and what to do"),
        ("finding", "of the newest diagnosis"),
        ("valid", "the numbers may be used; not valid: do not control on them"),
        ("observable", "the motion reveals the stiffness; else it is held, and its interval widens"),
        *([("contact", "something touches the link")] if external else []),
    )  # fmt: skip


def joints_legend() -> Table:
    """Return the legend of the table of joints."""
    return _table(
        *_NUMBERS,
        ("deflection", _DEFLECTION),
        ("last seconds", "of the stiffness"),
        ("state", "running: the numbers may be used; else what is wrong, red where they may not be used"),
    )


def _table(*rows: tuple[str, str]) -> Table:
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_column(no_wrap=True, style="bold")
    table.add_column()
    for label, meaning in rows:
        table.add_row(label, meaning)
    return table
