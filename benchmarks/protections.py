# ruff: noqa: E501 - one protection a line
"""Take away one protection after the other: for each, a test has to fail.

    python benchmarks/protections.py [--only WORD]

Each change is made in a copy of the checkout, where the tests named beside it run. A protection whose tests pass
without it is reported, and the exit status is 1.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("drivelink", "estimator", "sim", "tests", "benchmarks", "examples", "pyproject.toml")


class Protection(NamedTuple):
    """What is replaced where, and the tests that have to notice."""

    name: str
    file: str
    before: str
    after: str
    tests: str


LIMITS, FOLLOWING = "tests/test_recording_limits.py", "tests/test_cycle_following.py"
PROTECTIONS = [
    Protection(*row)
    for row in (
        ("size of a joint file", "jointfile/document.py", "if len(text) > MAX_BYTES or len(text.encode()) > MAX_BYTES:", "if False:", "tests/test_jointfile.py -k without_end"),
        ("lines of a joint file", "jointfile/document.py", "> MAX_LINE_BYTES:", "> 1 << 40:", "tests/test_jointfile.py -k without_end"),
        ("depth of a joint file", "jointfile/document.py", "if _DEEP.search(text):", "if False:", "tests/test_jointfile.py -k without_end"),
        ("regular files only", "files.py", "if not stat.S_ISREG(os.fstat(fd).st_mode):", "if False:", f"{LIMITS} -k regular --timeout 20"),
        ("size of an MCAP chunk", "recording/mcapfile.py", "    if size > MAX_BLOCK_BYTES:", "    if False:", f"{LIMITS} -k unpacks_to_much"),
        ("size of a carried joint file", "recording/mapping.py", "if len(carried) > MAX_BYTES:", "if False:", f"{LIMITS} -k huge_message"),
        ("size of a carried mapping", "recording/mapping.py", "    if len(data) > MAX_BYTES:", "    if False:", f"{LIMITS} -k huge_message"),
        ("number of records", "recording/mcapfile.py", "if messages.count > most:", "if False:", f"{LIMITS} -k unpacks_to_much"),
        ("changes of mappings", "recording/canframes.py", "if self._judged > self._most_judged:", "if False:", f"{LIMITS} -k unpacks_to_much"),
        ("a state of another model", "recording/playback.py", "if own is None or (own.model(), own.estimator) != (joint.model(), joint.estimator):", "if False:", "tests/test_blackbox.py -k another_model"),
        ("size of a reload", "jointfile/apart.py", "if len(done.stdout) > _MAX_BYTES:", "if False:", "tests/test_jointfile.py -k another_process"),
        ("links in a black box's folder", "loop/finding.py", " | os.O_NOFOLLOW", "", "tests/test_blackbox.py -k others_put"),
        ("links in a page's folder", "monitor/webday.py", " and not one.is_symlink()", "", "tests/test_day.py -k links_events"),
        ("nodes that are asked for ever", "canopen/bus.py", "if now_s > end_s:", "if False:", "tests/test_doctor.py -k limited_time --timeout 20"),
        ("events of other joints", "daemon/status.py", 'return not self._joint or joint in ("", self._joint)', "return True", "tests/test_daemon.py -k exception"),
        ("number of frames", "recording/canlog.py", "raise too_many_records(path)", "pass", f"{LIMITS} -k 'blf or unpacks_to_much'"),
        ("objects of an EDS file", "canopen/eds.py", "if len(found) > _MOST_OBJECTS:", "if False:", "tests/test_canopen_eds.py -k bounded"),
        ("digits of an EDS file", "canopen/eds.py", "or len(text) > _MOST_DIGITS:", "or False:", "tests/test_canopen_eds.py -k bounded"),
        ("stamps", "recording/limits.py", "if stamp_ns > LAST_STAMP_NS:", "if False:", f"{LIMITS} tests/test_fuzz_bus.py -k 'stamps or .log'"),
        ("stamps of an interface", "canopen/bus.py", " if 0.0 < seconds < _LAST_S else time.time_ns()", "", "tests/test_interfaces.py -k no_interface"),
        ("units that a node reports", "canopen/units.py", "not allowed.least <= reported <= allowed.most:", "False:", "tests/test_canopen_units.py -k float"),
        ("a bus that never rests", "canopen/bus.py", "        if message is not None and is_canopen(message):\n            session.feed", "        while message is not None and is_canopen(message):\n            message = receive(bus, 0.0)\n            session.feed", "tests/test_canopen_sdo.py -k never_rests --timeout 20"),
        ("connections that say nothing", "daemon/service.py", "callback(_close_in_time, session)", "callback(close_session, session)", "tests/test_daemon.py -k never_say"),
        ("what others put beside recordings", "loop/finding.py", "if path.is_file())", ")", "tests/test_blackbox.py -k others_put"),
        ("open files", "pubsub/session.py", "    _require_files()\n    if section", "    if section", "tests/test_session.py -k too_few"),
        ("number of samples", "recording/limits.py", "if count > MAX_SAMPLES:", "if False:", f"{LIMITS} -k 'gap_of_a_million'"),
        ("size of a BLF container", "recording/blf.py", "_require(left >= 0, path)", "pass", f"{LIMITS} -k 'blf or unpacks_to_much'"),
        ("answers of one object", "cycle/objectcheck.py", " and not node.waits(read[0])", "", "tests/test_read_back.py -k all_the_time"),
        ("foreign lines of a log", "recording/canlog.py", "if not understood or strange > understood + _HOPELESS:", "if not understood:", "tests/test_recording_canlog.py -k foreign"),
        ("carried joint files open nothing", "recording/mapping.py", "joint=contained(jointfile.parse(text, name))", "joint=jointfile.parse(text, name)", f"{LIMITS} -k opens_nothing"),
        ("words as plain text", "plaintext.py", '    return "" if unicodedata.category(character) in _UNSHOWABLE else character', "    return character", "tests/test_status.py -k plain_text"),
        ("rate of a source", "daemon/status.py", "len(kinds) >= self._KINDS", "False", "tests/test_status.py -k rate"),
        ("rate of all lines", "daemon/status.py", "if window.lines <= self._LINES:", "if True:", "tests/test_status.py -k rate"),
        ("frames that may be sent", "canopen/guard.py", "    raise ForbiddenFrameError(", "    return\n    raise ForbiddenFrameError(", "tests/test_never_moves.py tests/test_canopen_sdo.py"),
        ("a passive daemon sends nothing", "canopen/guard.py", "        raise BusError(", "        return self.inner.send(message)\n        raise BusError(", "tests/test_canopen_sdo.py"),
        ("stored parameters", "canopen/passivenode.py", "address[0] in _STORE_OR_RESTORE", "False", f"{FOLLOWING} tests/test_canopen_passive.py"),
        ("block downloads", "canopen/sdo.py", "class SdoSniffer(SdoTransfers):\n", "class SdoSniffer(SdoTransfers):\n    def request(self, data, now_s):\n        return None if data and data[0] >> 5 == 6 else super().request(data, now_s)\n\n", f"{FOLLOWING} -k block"),
        ("refused block downloads", "canopen/sdo.py", "class SdoSniffer(SdoTransfers):\n", "class SdoSniffer(SdoTransfers):\n    def response(self, data, now_s):\n        return None if data and data[0] >> 5 == 4 else super().response(data, now_s)\n\n", "tests/test_canopen_passive.py -k refused"),
        ("identity of a node", "canopen/passivenode.py", "            self._check_identity()\n", "            pass\n", f"{FOLLOWING} tests/test_canopen_passive.py"),
        ("silence of a node", "cycle/following.py", "        if silent:\n", "        if False:\n", f"{FOLLOWING} -k not_heard"),
        ("silence of the bus", "cycle/following.py", "if gap := number - before >= self._silent:", "if gap := False:", f"{FOLLOWING} -k nobody_is_heard"),
        ("what nobody heard of a default", "canopen/passivenode.py", "(self.stored or self.lost or not", "(self.stored or not", "tests/test_canopen_passive.py -k nobody_heard"),
        ("receive overflow", "daemon/supervision.py", "if unread > before and", "if False and", f"{FOLLOWING} -k overflow"),
        ("foreign pages", "monitor/web.py", 'origin not in (None, f"http://{host}")', "False", "tests/test_web.py"),
        ("open streams", "monitor/web.py", "in _OWN_PAGES\n        ):\n            self._events()", "in _OWN_PAGES or True\n        ):\n            self._events()", "tests/test_web.py"),
        ("claims of a joint", "pubsub/feed.py", "if len(self._claims) < MAX_CLAIMS:", "if True:", "tests/test_network_attacks.py -k tokens"),
        ("messages of others", "pubsub/feed.py", "if not (free and vouched):", "if False:", "tests/test_network_attacks.py -k 'stays or who_speaks'"),
        ("valid and impossible", "pubsub/wire.py", "if message.status & _VALID and not _usable(message):", "if False:", "tests/test_wire.py"),
        ("floods of queries", "pubsub/publisher.py", "zenoh.handlers.RingChannel(_QUERIES)", "zenoh.handlers.FifoChannel(10_000)", "tests/test_publisher.py -k flood"),
        ("rows of a part", "fleet/table.py", "    if left < 0:", "    if False:", "tests/test_fleet_table.py -k stands_in_a_part"),
        ("units that another master writes", "cycle/following.py", ' else "units" if address in dict(layout.reported) else ""', ' else ""', "tests/test_read_back.py -k writes_a_unit"),
        ("findings that are told", "canopen/passive.py", "node.untold(layout.notices)", "layout.notices", "tests/test_canopen_passive.py -k fills_no_log"),
        ("frames at once", "cycle/sources.py", "while len(messages) < MOST_FRAMES and", "while len(messages) < 5000 and", "tests/test_interfaces.py -k 11_bits"),
        ("a server that has gone", "canopen/bus.py", "        except OSError as error:  # of an interface over TCP", "        except ValueError as error:", "tests/test_canopen_mapping.py -k full_transmit"),
        ("levels of a document", "pubsub/feed.py", "if depth == MAX_DEPTH:", "if False:", "tests/test_network_attacks.py -k each_limit"),
        ("size of a snapshot", "recording/recorder.py", "if not 8 < len(payload) <= MAX_BLOCK_BYTES:", "if False:", "tests/test_network_attacks.py -k snapshot"),
        ("a stamp that jumps", "pubsub/feed.py", "min(elapsed_ns // step, _LONGEST_PERIOD_NS)", "elapsed_ns // step", "tests/test_client.py -k jumps"),
        ("daemons that begin at once", "pubsub/publisher.py", "if any(other < own for", "if False and any(other < own for", "tests/test_session.py -k smaller"),
        ("frames that wait", "recording/canframes.py", "if len(head) > _MOST_HELD:", "if False:", f"{LIMITS} -k wait_for"),
        ("a scheduler with certificates", "fleet/runner.py", 'if not address.startswith("tls://") and not insecure:', "if False:", "tests/test_fleet_run.py -k certificates"),
    )
]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", metavar="WORD", help="protections with this word in their name")
    wanted = [one for one in PROTECTIONS if parser.parse_args().only in one.name]
    missed = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in COPIED:
            source, target = ROOT / name, copy / name
            copier = shutil.copytree if source.is_dir() else shutil.copy
            copier(source, target)
        for one in wanted:
            path = copy / "drivelink" / one.file
            whole = path.read_text(encoding="utf-8")
            assert whole.count(one.before) == 1, f"{one.name}: its place in {one.file} has changed"
            path.write_text(whole.replace(one.before, one.after), encoding="utf-8")
            command = f"{sys.executable} -m pytest -x -p no:cacheprovider {one.tests}"
            environment = os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
            ran = subprocess.run(
                command, shell=True, cwd=copy, env=environment, capture_output=True, text=True, check=False
            )
            path.write_text(whole, encoding="utf-8")
            noticed = ran.returncode == 1  # 0: all passed; others: no test ran
            print(f"{'noticed' if noticed else 'MISSED'}: {one.name}", flush=True)
            if not noticed:
                missed.append(one.name)
                print("\n".join(ran.stdout.splitlines()[-3:] + ran.stderr.splitlines()[-3:]))
    print(f"{len(wanted) - len(missed)} of {len(wanted)} protections: a test fails without them")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
