"""The page of the live view: served to this machine only, and drawn in a real browser."""

import json
import socket
import urllib.error
import urllib.request
from contextlib import suppress

import chromium
import pytest
import zenohkit

from drivelink import cli
from drivelink.monitor.watcher import Watcher
from drivelink.monitor.web import MAX_CONNECTIONS, MAX_STREAMS, WebView
from drivelink.pubsub.session import close_session, open_client

BLUE = """(() => { const c = document.getElementById('torqueplot');
const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
let n = 0; for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 200 && d[i + 2] - d[i] > 80) n++;
return n > 100 ? n : 0; })()"""
WIDE = "[...document.querySelectorAll('.numbers dl')].filter(d => d.scrollWidth > d.clientWidth).length"
LONG = """(() => { $('externalbox').hidden = false; $('external').textContent = 'not valid';
$('externalband').textContent = 'the residual is above its own baseline: the model is not sufficient';
return document.documentElement.scrollWidth; })()"""
SAVE = "HTMLAnchorElement.prototype.click = function() { saved = this.href; }; $('save').click()"


def get(url, host=None):
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request, timeout=60) as response:
            return response.status, response.read(20_000)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, b""


@pytest.fixture(scope="module")
def web(daemon):
    session = open_client(daemon)
    watcher = Watcher(session)
    view = WebView(watcher)
    yield view
    view.close()
    watcher.close()
    close_session(session)


def test_the_page_loads_nothing_from_elsewhere_and_answers_this_machine_only(web):
    status, page = get(web.url)
    text = page.decode()
    assert status == 200 and "http://" not in text and "https://" not in text and "src=" not in text
    assert get(web.url + "etc/passwd")[0] == 404
    assert get(web.url, host="evil.example")[0] == 403
    assert get(web.url + "events", host="evil.example:80")[0] == 403


def test_events_bring_new_moments_once(web):
    since: dict[str, float] = {}

    def event():
        web.poll()
        return json.loads(web.event(since))["joints"].get("elbow", {})

    zenohkit.until(lambda: event().get("moments"))
    times: list[float] = []
    while len(times) < 30:
        times += [moment[0] for moment in event()["moments"]]
    assert times == sorted(set(times))


def test_a_port_that_is_taken_is_one_line(web, capsys):
    port = web.url.rsplit(":", 1)[1].strip("/")
    assert cli.main(["monitor", "--web", "--port", port, "--endpoint", zenohkit.free_endpoint()]) == 2
    err = capsys.readouterr().err
    assert "cannot be served" in err and err.count("\n") == 1


def connect(web):
    return socket.create_connection(("127.0.0.1", int(web.url.rsplit(":", 1)[1].strip("/"))), timeout=60)


def test_the_page_serves_so_many_connections_at_a_time_and_leaves_those_that_say_nothing(web, monkeypatch):
    monkeypatch.setattr("drivelink.monitor.web._Handler.timeout", 60.0)
    idle = [connect(web) for _ in range(MAX_CONNECTIONS)]
    with connect(web) as refused:
        assert refused.recv(100).startswith(b"HTTP/1.1 503")
    for connection in idle:
        connection.close()
    zenohkit.until(lambda: get(web.url)[0] == 200)
    monkeypatch.setattr("drivelink.monitor.web._Handler.timeout", 0.1)
    with connect(web) as silent:
        assert silent.recv(100) == b""


def test_who_says_a_byte_now_and_then_gives_way_too(web, monkeypatch):
    monkeypatch.setattr("drivelink.monitor.web.PATIENCE_S", 0.3)
    slow = [connect(web) for _ in range(MAX_CONNECTIONS)]

    def drip():
        for connection in slow:
            with suppress(OSError):
                connection.sendall(b"x")

    with zenohkit.repeated(drip, 0.05):
        zenohkit.until(lambda: get(web.url)[0] == 200, 20.0)
    for connection in slow:
        connection.close()


def stream(web, **headers):
    connection = connect(web)
    host = web.url.split("/")[2]
    lines = [f"Host: {host}", *(f"{name.replace('_', '-')}: {text}" for name, text in headers.items())]
    connection.sendall(("GET /events HTTP/1.1\r\n" + "\r\n".join(lines) + "\r\n\r\n").encode())
    return connection


def test_a_page_of_another_site_gets_no_events(web):
    origins = ({"Origin": origin} for origin in ("http://evil.example", "null", "http://127.0.0.1:1"))
    for headers in (*origins, {"Sec_Fetch_Site": "cross-site"}, {"Sec_Fetch_Site": "same-site"}):
        with stream(web, **headers) as connection:
            assert connection.recv(100).startswith((b"HTTP/1.1 403", b"HTTP/1.1 404"))
    with stream(web, Origin=web.url.rstrip("/"), Sec_Fetch_Site="same-origin") as connection:
        assert connection.recv(100).startswith(b"HTTP/1.1 200")


def test_streams_that_stay_open_do_not_fill_the_page(web):
    held = []

    def opened():
        """Open one more stream; no where one that gives way has not ended yet."""
        held.append(stream(web))
        return held[-1].recv(12) == b"HTTP/1.1 200"

    for _ in range(3 * MAX_CONNECTIONS):
        zenohkit.until(opened)
        assert len(web._streams) <= MAX_STREAMS
    assert get(web.url)[0] == 200
    for connection in held:
        connection.close()


@pytest.mark.slow  # what the page does with what it gets: test_web_page.py
@pytest.mark.skipif(chromium.EXECUTABLE is None, reason="needs Chromium")
def test_the_page_draws_live_plots_in_a_browser(web, tmp_path):
    with zenohkit.repeated(web.poll, 0.02), chromium.Chromium(tmp_path / "profile") as browser:
        browser.open(web.url)
        browser.wait_for("document.getElementById('stiffness').textContent === '700.0'")
        assert browser.wait_for("document.getElementById('state').textContent") == "running"
        before = "$('state').className = '{}', getComputedStyle($('state'), '::before').content"
        assert browser.evaluate(before.format("")) == '"daemon: "'
        assert browser.evaluate(before.format("red")) == "none"  # "daemon gone" says it
        for width in (390, 800, 1200):  # no number reaches into the next one
            browser.resize(width, 900)
            assert browser.evaluate(WIDE) == 0
            assert browser.evaluate(LONG) <= width  # nor does a reason widen the page
            assert (
                browser.evaluate("new Set(['measured', 'save', 'pause'].map(id => $(id).offsetTop)).size")
                == 1
            )
        browser.wait_for(BLUE)  # the curve
        browser.screenshot(tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 20_000
        # the motor signals: subscribed to while they are shown, and saved with the rest
        subscribed = lambda: [n for n, _ in web._watcher._streams if n in ("estimate", "sample")]  # noqa: E731
        assert subscribed() == ["estimate"]
        browser.evaluate("$('measured').click()")
        browser.wait_for("joints.elbow.signals.length > 9 && $('motortorque').shown.series[0].length > 9")
        assert subscribed() == ["estimate", "sample"]
        browser.evaluate(SAVE)
        head, *rows = browser.evaluate("decodeURIComponent(saved)").removeprefix("data:text/csv,").split()
        columns = "time_s,flexibility_torque_nm,stiffness_nm_rad,stiffness_std_nm_rad,valid,motor1_t"
        assert head.startswith(columns) and any(row.endswith("1.5,0.5,0,0.25") for row in rows)
        browser.evaluate("$('measured').click()")
        zenohkit.until(lambda: subscribed() == ["estimate"])
