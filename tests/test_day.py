"""The last 24 hours: rows of the black box, events with their recordings and diagnoses, in the web view."""

import http.client
import json
import shutil
import urllib.error
import urllib.request
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import chromium
import numpy as np
import pytest

from drivelink.loop import day, finding
from drivelink.loop.finding import drop_oldest, page_file, recording_name
from drivelink.monitor.web import WebView
from drivelink.monitor.webday import WebDay
from drivelink.pubsub.wire import EstimateMessage
from estimator.sample import Status

BEGIN_S = datetime(2026, 1, 5, tzinfo=UTC).timestamp()


SAID = """(() => { const said = [], canvas = CanvasRenderingContext2D.prototype, fill = canvas.fillText;
canvas.fillText = text => said.push(text); dispatchEvent(new Event('resize')); canvas.fillText = fill; return said; })()"""


class Written:
    """Rows of some seconds; every fifth of them with nothing valid."""

    def __init__(self, folder: Path) -> None:
        self.now_s = BEGIN_S
        self.day = day.Day(folder, "elbow", lambda: self.now_s)

    def run(self, seconds: int) -> None:
        for _ in range(seconds):
            self.now_s += 1.0
            valid = 0 if self.now_s % 5 == 0 else int(Status.VALID)
            self.day.estimate(EstimateMessage(1, 0, valid, 1.0, 700.0, 3.0, ()))
            self.day.status({"friction": [{"torque_nm": 0.3, "std_nm": 0.01}]})
            self.day.row()


def test_rows_of_a_clock_that_was_wrong_are_not_of_the_last_day(tmp_path):
    written = Written(tmp_path)
    for begin_s in (0.0, BEGIN_S + 3e9, BEGIN_S + 100.0, BEGIN_S):  # each time it is set: at last, right
        written.now_s = begin_s
        written.run(150)
    table = day.rows(tmp_path, "elbow")
    assert table[:, 0].tolist() == sorted(BEGIN_S + s for s in (*range(1, 151), *range(101, 151)))


def test_a_folder_that_was_removed_is_made_again(tmp_path):
    written = Written(tmp_path / "kept")
    for _ in range(2):
        written.run(3)
        assert len(day.rows(tmp_path / "kept", "elbow")) == 3
        shutil.rmtree(tmp_path / "kept")


def kept_one(folder: Path) -> Path:
    recording = folder / recording_name("elbow", "model alarm", datetime.fromtimestamp(BEGIN_S + 60, UTC))
    recording.write_bytes(b"mcap")
    finding.write(recording, finding.begun(recording, finding.NOTHING, "The model is sufficient."))
    page_file(recording).write_text("<title>diagnosis</title>")
    return recording


def test_a_row_a_second_in_two_files_of_bounded_size(tmp_path, monkeypatch):
    monkeypatch.setattr(day, "_MOST", 20_000)
    written = Written(tmp_path)
    written.day.row()  # no estimate, no row
    written.run(1000)
    table = day.rows(tmp_path, "elbow")
    assert 200 < len(table) < 600 and table[-1, 0] == written.now_s
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 22_000
    np.testing.assert_allclose(table[-1, 1:3], [700.0, 3.0])
    np.testing.assert_allclose(table[-1, 4:], [0.3, 0.01])
    file, _ = day.day_files(tmp_path, "elbow")
    file.write_text(file.read_text() + "1,2\n3,4,nonsense,1,1,1")  # a kill
    assert len(day.rows(tmp_path, "elbow")) == len(table)
    thin = day.thinned(table, table[0, 0], table[-1, 0], 20)
    assert len(thin) <= 21 and all(row[1] == 700.0 and 0.5 < (row[3] or 0.0) < 1.0 for row in thin)


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path, caplog):
    (folder := tmp_path / "kept").touch()  # in whose place a file is
    written = Written(folder)
    written.run(5)
    assert len(caplog.records) == 1
    folder.unlink()
    written.run(1)
    assert len(day.rows(folder, "elbow")) == 1


def test_the_page_links_events_to_recording_and_diagnosis(tmp_path, monkeypatch):
    Written(tmp_path).run(200)
    recording = kept_one(tmp_path)
    (tmp_path / "secret.toml").write_text("x")

    web = WebView(cast(Any, None), day=WebDay(tmp_path, "elbow"))  # no joint is watched

    def get(path: str, **headers: str) -> bytes:
        asked = urllib.request.Request(
            web.url + path, headers={k.replace("_", "-"): v for k, v in headers.items()}
        )
        with urllib.request.urlopen(asked, timeout=10) as reply:
            return bytes(reply.read())

    try:
        assert b"elbow: the last 24 hours" in get("day") and b'href="day" >' in get("")
        document = json.loads(get("day.json"))
        (event,) = document["events"]
        assert len(document["rows"]) == 200 and document["end"] == BEGIN_S + 200
        assert event["cause"] == "model alarm" and event["sentence"] == "The model is sufficient."
        assert get(f"kept/{event['recording']}") == b"mcap"
        assert b"diagnosis" in get(f"kept/{event['finding']}")
        begin = BEGIN_S + 50.5
        rows = json.loads(get(f"day.json?begin={begin}&end={begin + 10}"))["rows"]
        assert [row[0] - BEGIN_S for row in rows] == list(range(51, 61))
        (tmp_path / event["finding"]).unlink()
        (tmp_path / event["finding"]).symlink_to("secret.toml")  # somebody has put it there
        finding = f"kept/{event['finding']}"
        for path in (finding, "kept/secret.toml", "kept/..%2Fsecret.toml", "kept/", "day/x"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                get(path)
        monkeypatch.setattr(Path, "is_symlink", lambda _: False)  # it was none when it was looked at
        with pytest.raises(http.client.RemoteDisconnected):
            get(finding)
        with pytest.raises(urllib.error.HTTPError):
            get("day.json", Sec_Fetch_Site="cross-site")
    finally:
        web.close()
    newer = tmp_path / recording_name("elbow", "change", datetime.fromtimestamp(BEGIN_S + 90, UTC))
    newer.write_bytes(b"x")
    drop_oldest(tmp_path, "elbow", 1e-6)
    assert not recording.exists() and not page_file(recording).exists() and newer.exists()


@pytest.mark.slow
@pytest.mark.skipif(chromium.EXECUTABLE is None, reason="needs Chromium")
def test_the_page_of_a_short_day_can_be_read_on_a_phone(tmp_path):
    Written(tmp_path).run(200)
    kept_one(tmp_path)
    with (
        closing(WebView(cast(Any, None), day=WebDay(tmp_path, "elbow"))) as web,
        chromium.Chromium(tmp_path / "profile") as browser,
    ):
        browser.resize(375, 700)
        browser.open(web.url + "day")
        browser.wait_for("document.querySelector('#events td') !== null")
        assert browser.evaluate("Math.max(...[...$('events').rows].map(row => row.scrollWidth))") <= 375
        last = browser.evaluate("$('events').querySelector('td:last-child').getBoundingClientRect().width")
        assert last > 250  # what was found has a line of its own
        assert browser.evaluate("document.querySelector('[aria-pressed=true]').textContent") == "10 min"
        assert browser.evaluate("text(5e-7, 5e-7)") == "5e−7"
        assert "grey: not valid, red: event" in browser.evaluate(SAID)
        assert browser.evaluate("$('friction').shown.high") > 0.3 + 1.96 * 0.01  # its band is in the plot
