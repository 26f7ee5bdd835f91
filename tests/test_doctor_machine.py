"""What the doctor says of the machine, the CAN interface and SYNC."""

import json

import pytest

from drivelink.cli import main
from drivelink.doctor import Section
from drivelink.doctor.interface import examine_interface, judge_link
from drivelink.doctor.machine import Daemons, examine_machine, judge_sync
from drivelink.jointfile import BusSection
from drivelink.notice import Severity


@pytest.mark.parametrize(("limit", "severity"), [(1024, Severity.WARNING), (8192, Severity.OK)])
def test_the_machine_is_examined_and_every_warning_has_a_fix(monkeypatch, capsys, limit, severity):
    monkeypatch.setattr("drivelink.doctor.machine.resource.getrlimit", lambda _: (limit, limit))
    section = Section("Machine")
    examine_machine(section, 0.001, 0.05)
    by_subject = {finding.subject: finding for finding in section.notices}
    assert {"kernel", "real time", "memory", "files", "timer"} <= set(by_subject)
    assert all(finding.fix for finding in section.notices if finding.severity is Severity.WARNING)
    assert by_subject["files"].severity is severity and str(limit) in by_subject["files"].text
    assert main(["doctor", "--seconds", "0.05"]) in (0, 1)  # without a joint it is the machine
    shown = capsys.readouterr().out
    assert "kernel" in shown and "timer" in shown


LINK = {
    "ifname": "can0", "link_type": "can", "flags": ["NOARP", "UP", "LOWER_UP"], "txqlen": 10, "mtu": 16,
    "linkinfo": {
        "info_kind": "can", "info_xstats": {"bus_off": 2},
        "info_data": {"state": "ERROR-PASSIVE", "berr_counter": {"tx": 128, "rx": 3}, "restart_ms": 0,
                      "bittiming": {"bitrate": 500000}},
    },
    "stats64": {"rx": {"dropped": 7}},
}  # fmt: skip


def test_a_sick_interface_is_seen_in_every_way_and_a_healthy_one_has_no_warning():
    section = Section("CAN")
    judge_link(section, LINK, BusSection(interface="socketcan", channel="can0"))
    said = "\n".join(str(finding) for finding in section.notices)
    for expected in (
        "runs at 500 kbit/s, the joint file says 1000", "error-passive, error counters: tx 128, rx 3",
        "transmit queue of 10", "txqueuelen 1000", "does not recover from bus-off", "restart-ms 100",
        "bus-off 2 times", "7 received frames were dropped",
    ):  # fmt: skip
        assert expected in said
    link = json.loads(json.dumps(LINK))
    link["txqlen"], link["stats64"]["rx"]["dropped"] = 1000, 0
    data = link["linkinfo"]["info_data"]
    data.update(state="ERROR-ACTIVE", restart_ms=100, bittiming={"bitrate": 1_000_000})
    del link["linkinfo"]["info_xstats"]
    section = Section("CAN")
    judge_link(section, link, BusSection(interface="socketcan", channel="can0"))
    assert {finding.severity for finding in section.notices} == {Severity.OK}


@pytest.mark.parametrize(
    ("change", "expected"),
    [({"flags": ["NOARP"]}, "is down"), ({"link_type": "ether"}, "is not a CAN interface")],
)
def test_an_interface_that_cannot_work_is_an_error_with_a_fix_and_a_virtual_bus_is_explained(
    change, expected
):
    section = Section("CAN")
    judge_link(section, {**LINK, **change}, BusSection(interface="socketcan", channel="can0"))
    (finding,) = [f for f in section.notices if f.severity is Severity.ERROR]
    assert expected in finding.text and finding.fix
    examine_interface(section, BusSection())
    assert "one process" in section.notices[-1].text


def sync(period_s, jitter_s=0.0, count=500):
    return [k * period_s + (jitter_s if k % 2 else 0.0) for k in range(count)]


OURS_RUNS, WRIST_RUNS = Daemons(ours=True, others=()), Daemons(ours=False, others=("wrist",))


@pytest.mark.parametrize(
    ("stamps", "bus", "daemons", "severity", "words"),
    [
        (sync(0.001), {"sync": "follow"}, None, Severity.OK, "every 1.000 ms"),
        (sync(0.002), {"sync": "follow", "period_s": 0.001}, None, Severity.ERROR, "the joint file says 1 ms"),
        (sync(0.002), {"sync": "follow"}, None, Severity.OK, "every 2.000 ms"),
        ([], {"sync": "follow"}, None, Severity.ERROR, "nobody makes SYNC"),
        ([], {}, None, Severity.OK, "drivelink run will"),
        (sync(0.001), {}, None, Severity.WARNING, "another master produces it"),
        (sync(0.001), {}, OURS_RUNS, Severity.OK, "produced by the drivelink daemon"),
        (sync(0.001), {}, WRIST_RUNS, Severity.WARNING, "wrist"),
    ],
)  # fmt: skip
def test_sync_is_judged_by_rate_and_role(stamps, bus, daemons, severity, words):
    section = Section("Bus")
    judge_sync(section, stamps, BusSection(**bus), *([daemons] if daemons else []))
    (finding,) = section.notices
    assert finding.severity is severity and words in finding.text
    if daemons is not None:  # our own daemon is no reason to follow; two joints belong into one command
        assert "one command" in finding.fix if daemons.others else not finding.fix


def test_jitter_is_the_deviation_from_the_period():
    section = Section("Bus")
    judge_sync(section, sync(0.001, 50e-6), BusSection(sync="follow"))
    # gaps alternate between 1.05 and 0.95 ms; their median is one of the two, the largest deviation 0.1 ms
    assert section.facts["sync"]["jitter_us"]["max"] == pytest.approx(100.0, rel=1e-6)
