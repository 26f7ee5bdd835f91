"""Checks the bus: nodes, their identity and TPDOs, SYNC and its jitter."""

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import can

from drivelink.canopen.bus import open_bus, run_program
from drivelink.canopen.eds import load_eds
from drivelink.canopen.guard import SilentBus
from drivelink.canopen.layout import COMFORTABLE, NodeLayout, Role, Signal, TpdoLayout, bus_load, roles
from drivelink.canopen.node import NodeSurvey, survey_node
from drivelink.canopen.passive import PassiveConfigurator
from drivelink.canopen.pdo import (
    CHECKS,
    Available,
    assign,
    decode,
    describe,
    entry_text,
    read_optional,
    unused,
)
from drivelink.canopen.scan import FoundNode, Traffic, identify, identify_all, listen, scan, shares
from drivelink.canopen.vendors import vendor_of
from drivelink.doctor.datasheet import (
    asked_signals,
    curious,
    report_checks,
    report_sync_counter,
    velocity_as_check,
)
from drivelink.doctor.livevalues import Asked, Heard, record_of
from drivelink.doctor.machine import Daemons, daemon_mapping, judge_sync
from drivelink.doctor.motion import judge_motion, judge_record
from drivelink.doctor.report import Report, Section
from drivelink.errors import BusError, DriveError, JointFileError
from drivelink.jointfile import BusSection, JointFile
from drivelink.notice import Severity
from estimator.reasons import percent


def examine_bus(
    report: Report, joint: JointFile, base_dir: Path, seconds: float, served: Sequence[str] = ()
) -> None:
    """Run all checks that need an open bus. Reads only; listens only if the joint file is passive.

    Args:
        report: receives a section for the bus and one per node.
        served: joints of running daemons, one of which may produce SYNC.
    """
    section = report.section("Bus")
    daemons = Daemons(ours=joint.name in served, others=[name for name in served if name != joint.name])
    try:
        with open_bus(joint.bus) as bus:
            if joint.bus.configure:
                _ask(report, section, bus, joint, base_dir, seconds, daemons)
            else:
                _overhear(report, section, SilentBus(bus), joint, base_dir, seconds, daemons)
    except (BusError, DriveError, JointFileError) as error:
        section.error(joint.bus.channel, str(error))


def _ask(
    report: Report,
    section: Section,
    bus: can.BusABC,
    joint: JointFile,
    base_dir: Path,
    seconds: float,
    daemons: Daemons,
) -> None:
    found, _ = scan(bus)
    traffic = listen(bus, seconds)
    _judge_traffic(section, traffic, joint.bus, daemons)
    mine = {role.node_id: role for role in roles(joint, base_dir)}
    others = [node for node in sorted(set(found) | set(traffic.heartbeats)) if node not in mine]
    ends = shares(len(mine) + 1)
    if not found:
        fix = "power the drives; check cable, termination, bit rate and node ids"
        section.error(joint.bus.channel, "no node answers or sends", fix)
    layouts, surveys = [], {}
    for role in mine.values():
        if role.node_id in found:
            own = report.section(f"Node {role.node_id}")
            survey, planned = _examine_node(own, bus, joint, role, traffic, next(ends))
            layouts += [planned] if planned else []
            if survey is not None:
                surveys[own.title] = survey
        else:
            text = f"({role.key}) does not answer" + (f", only {_list(others)}" if others else "")
            section.error(role.subject, text, f"power it, or correct {role.key}.node_id")
    _name_others(section, bus, joint.bus, others, next(ends))
    _judge_load(section, layouts, joint.bus)
    if surveys:
        _watch_motion(report, bus, joint, surveys, seconds)


def _name_others(
    section: Section, bus: can.BusABC, settings: BusSection, others: Sequence[int], end_s: float
) -> None:
    """Say what else is on the bus."""
    found, left = identify_all(bus, settings, others, end_s)
    for node in found:
        section.info(f"node {node.node_id}", f"{_describe_node(node)}, not in the joint file")
    if left:
        section.warn(f"{len(left)} more", f"not in the joint file, not asked for want of time: {_list(left)}")


def _watch_motion(
    report: Report, bus: can.BusABC, joint: JointFile, surveys: Mapping[str, NodeSurvey], seconds: float
) -> None:
    """Check the channels during a motion, per node and together; by title of the nodes' sections."""
    sections = {section.title: section for section in report.sections}
    nodes = list(surveys.values())
    together = report.section("Units and signs")
    try:
        readings = run_program(Asked(nodes).program(seconds), bus, joint.bus)
    except DriveError as error:
        together.error(joint.name, str(error))
        return
    moving = False
    for title, survey in surveys.items():
        if survey.role.motor is not None:
            moving |= judge_motion(sections[title], survey, readings)
    if moving:
        linked = joint.model().has_deflection
        judge_record(together, joint, record_of(readings, len(joint.motor), linked))


def _list(nodes: Sequence[int]) -> str:
    return ", ".join(f"node {node}" for node in nodes)


def _describe_node(node: FoundNode) -> str:
    if node.device_type is None:
        return node.profile
    vendor, product, revision, _ = node.identity
    maker = vendor_of(vendor).name or f"vendor 0x{vendor:X}"
    named = f"{node.name}, " if node.name else ""
    return f"{named}{node.profile}, {maker}, product 0x{product:X}, revision 0x{revision:X}"


def _examine_node(
    section: Section, bus: can.BusABC, joint: JointFile, role: Role, traffic: Traffic, end_s: float
) -> tuple[NodeSurvey | None, NodeLayout | None]:
    """Check one node of the joint: identity, and its frames as they would be configured."""
    subject = role.subject
    try:
        node = identify(bus, joint.bus, role.node_id, end_s)
        state = traffic.heartbeats.get(role.node_id, "no heartbeat")
        if node.device_type is not None:
            section.ok(subject, f"{_describe_node(node)}, {state}")
        survey = run_program(survey_node(curious(role)), bus, joint.bus, end_s=end_s)
    except DriveError as error:
        section.error(subject, str(error))
        return None, None
    wanted = 402 if role.motor is not None else 406
    if node.device_type and node.device_type & 0xFFFF not in (wanted, 402):
        section.warn(role.subject, f"is {node.profile}, {role.key} wants a CiA {wanted} device")
    _judge_eds(section, role, node)
    section.notices += survey.offer.notices
    planned = _judge_mapping(section, role, survey)
    with suppress(DriveError):
        if run_program(read_optional(role.node_id, 0x1019, 0), bus, joint.bus) is not None:
            report_sync_counter(section, joint.bus)
    return survey, planned


def _judge_eds(section: Section, role: Role, node: FoundNode) -> None:
    if role.eds is None:
        return
    try:
        sheet = load_eds(role.eds, role.node_id)
    except DriveError as error:
        section.error(role.subject, str(error), f"correct {role.key}.eds")
        return
    said = (sheet.vendor_id, sheet.product_code)
    is_ = node.identity[:2]
    if any(a and b and a != b for a, b in zip(said, is_, strict=True)):
        section.warn(
            role.subject,
            f"{role.eds.name} is of vendor 0x{said[0]:X}, product 0x{said[1]:X}; "
            f"the node says 0x{is_[0]:X}, 0x{is_[1]:X}",
            f"correct {role.key}.eds, or leave it out: a drive that answers needs none",
        )
    else:
        section.ok(role.subject, f"{role.eds.name} matches its identity")
    for problem in sheet.problems:
        section.info(role.eds.name, problem)


def _judge_mapping(section: Section, role: Role, survey: NodeSurvey) -> NodeLayout | None:
    """Compare the present mapping with the one that would be configured."""
    available = velocity_as_check(survey.available)
    asked = asked_signals(role)
    wanted = {s: objects for s, objects in available.items() if s not in CHECKS}
    if role.drive is not None and role.drive.velocity:
        wanted[Signal.MOTOR_VELOCITY] = survey.available.get(Signal.MOTOR_VELOCITY, ())
    wanted |= {s: unused(wanted, objects) for s, objects in available.items() if s in asked}
    enabled = [tpdo for tpdo in survey.tpdos if tpdo.enabled]
    section.info(role.subject, f"sends {describe(enabled)}")
    if not _has_all(section, role, survey, wanted):
        return None
    try:
        plan = assign(role, wanted, survey.tpdos, prefer_unused=False)
    except DriveError as error:
        section.error(role.subject, str(error))
        return None
    now = {mapped.signal for layout in decode(enabled, wanted) for mapped in layout.objects}
    if all(signal in now for signal, objects in wanted.items() if objects):
        section.ok(role.subject, "its mapping carries everything that is needed")
    else:
        parts = [f"TPDO{one.tpdo.number} = {' + '.join(map(entry_text, one.entries))}" for one in plan]
        section.info(role.subject, f"will be configured to send {'; '.join(parts)}", "drivelink run does it")
    sensorless = vendor_of(survey.identity[0]).sensorless
    if any(o.address == sensorless for o in available.get(Signal.SECOND_POSITION, ())):
        del available[Signal.SECOND_POSITION]
    report_checks(section, role, wanted, available, survey.tpdos)
    tpdos = tuple(
        TpdoLayout(cob_id=0x181, objects=a.objects) if a.objects is not None else decode([a.tpdo], wanted)[0]
        for a in plan
    )
    planned = {assignment.tpdo.number for assignment in plan}
    others = decode([tpdo for tpdo in enabled if tpdo.number not in planned], {})
    return NodeLayout(node_id=role.node_id, motor=role.motor, tpdos=tpdos, other_tpdos=others)


def _has_all(section: Section, role: Role, survey: NodeSurvey, wanted: Available) -> bool:
    """Return whether the node has an object for each signal that is needed; say those that it lacks."""
    complete = True
    for signal, candidates in wanted.items():
        if not candidates:
            offered = survey.offer.candidates.get(signal, ())
            tried = [f"0x{c.address[0]:04X}:{c.address[1]:02X}" for c in offered] or ["object for it"]
            needed = signal not in (Signal.STATUSWORD, *CHECKS)
            severity = Severity.ERROR if needed else Severity.WARNING
            section.add(severity, role.subject, f"gives no {signal}: it has no {', '.join(tried)}")
            complete = complete and severity is not Severity.ERROR
    for signal, reason in survey.offer.missing.items():
        if signal is not Signal.MOTOR_VELOCITY:
            section.error(role.subject, reason)
            complete = False
    return complete


def _judge_load(section: Section, layouts: Sequence[NodeLayout], bus: BusSection) -> None:
    if not layouts:
        return
    load = bus_load(layouts, bus)
    section.facts["bus_load"] = load.fraction
    text = f"the cycle needs {percent(load.fraction, 0)} of {bus.bitrate // 1000} kbit/s, worst case"
    if load.fraction <= COMFORTABLE:
        section.ok("bus load", text)
    else:
        fits_ms = bus.period_s * load.fraction / COMFORTABLE * 1000
        severity = Severity.ERROR if load.fraction > 1 else Severity.WARNING
        section.add(severity, "bus load", text, f"bus.period_s = {fits_ms / 1000:.2g}, or fewer signals")


def _overhear(
    report: Report,
    section: Section,
    bus: SilentBus,
    joint: JointFile,
    base_dir: Path,
    seconds: float,
    daemons: Daemons,
) -> None:
    """Check a passive bus by listening."""
    configurator = PassiveConfigurator([joint], [base_dir])
    if learnt := daemon_mapping(joint, base_dir) if daemons.ours else ():
        configurator.adopt(learnt)
        nodes = _list([layout.node_id for layout in learnt])
        section.ok("mapping", f"{nodes}: as the running daemon knows it")
    heard = Heard(joint, configurator)
    traffic = listen(bus, seconds, heard.feed)
    _judge_traffic(section, traffic, joint.bus, daemons)
    configurator.poll(time.monotonic())  # with the frames that were heard
    for error in configurator.missing.values():
        section.error(joint.bus.channel, str(error))
    if configurator.missing and not daemons.ours:
        section.info("mapping", f"no daemon of {joint.name} runs that could be asked for it")
    for node, doubt in configurator.doubts.items():
        section.warn(f"node {node}", doubt)
    for node, layout in configurator.layouts.items():
        section.notices += layout.notices
        for tpdo in layout.tpdos:
            count, length = traffic.counts.get(tpdo.cob_id, 0), len(traffic.last.get(tpdo.cob_id, b""))
            if not count:
                section.warn(f"node {node}", f"0x{tpdo.cob_id:03X} was not heard")
            elif length < tpdo.length:
                text = f"0x{tpdo.cob_id:03X} has {length} bytes, its mapping {tpdo.length}"
                section.error(f"node {node}", text, "correct the mapping in the joint file or its EDS")
            else:
                section.ok(f"node {node}", f"0x{tpdo.cob_id:03X} heard {count} times")
    _judge_load(section, list(configurator.layouts.values()), joint.bus)
    readings = heard.readings()
    if readings:
        record = record_of(readings, len(joint.motor), joint.model().has_deflection)
        judge_record(report.section("Units and signs"), heard.joint, record)
    elif not configurator.missing:  # already reported
        text = f"units and signs cannot be checked: no sample in {seconds:g} s: {heard.missing}"
        section.info(joint.name, text)


def _judge_traffic(section: Section, traffic: Traffic, bus: BusSection, daemons: Daemons) -> None:
    frames = sum(traffic.counts.values())
    section.facts["frames_per_s"] = frames / traffic.seconds if traffic.seconds else 0.0
    section.facts["identifiers"] = {f"0x{cob:03X}": n for cob, n in sorted(traffic.counts.items())}
    if traffic.error_frames:
        fix = "check cable, termination (2 x 120 Ω) and that all nodes have the same bit rate"
        section.warn(bus.channel, f"{traffic.error_frames} error frames in {traffic.seconds:g} s", fix)
    judge_sync(section, traffic.sync_s, bus, daemons)
