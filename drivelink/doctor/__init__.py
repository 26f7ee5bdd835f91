"""Finds problems of machine, bus and drives, and the fix for each. Changes nothing."""

from pathlib import Path

from drivelink.doctor.datasheet import examine_sheet
from drivelink.doctor.machine import can_interfaces, examine_interface, examine_machine, examine_zenoh
from drivelink.doctor.nodes import examine_bus
from drivelink.doctor.report import Report, Section
from drivelink.jointfile import JointFile

__all__ = ["Report", "Section", "examine", "examine_eds"]

_DEFAULT_PERIOD_S = 0.001
_LONGEST_TIMER_S = 2.0


def examine(joint: JointFile | None, base_dir: Path, seconds: float) -> Report:
    """Run all checks.

    Args:
        joint: the joint file; None: only the machine.
    """
    report = Report()
    period_s = joint.bus.period_s if joint is not None else _DEFAULT_PERIOD_S
    examine_machine(report.section("Machine"), period_s, min(seconds, _LONGEST_TIMER_S))
    section = report.section("CAN interface")
    if joint is None:
        known = can_interfaces()
        text = ", ".join(known) if known else "none of SocketCAN's"
        section.info("interfaces", text, "drivelink doctor JOINT examines bus and drives too")
        return report
    examine_interface(section, joint.bus)
    zenoh = Section("Zenoh")
    examine_bus(report, joint, base_dir, seconds, examine_zenoh(zenoh, joint, base_dir))
    report.sections.append(zenoh)
    return report


def examine_eds(path: Path) -> Report:
    """Return signals that a drive can send, from its EDS or DCF alone.

    Raises:
        DriveError: the file cannot be read at all.
    """
    report = Report(fine="this device gives what is needed")
    examine_sheet(report.section("Data sheet"), path)
    return report
