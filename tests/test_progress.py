"""Progress: nothing for quick work, a bar on a terminal, plain lines elsewhere."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from drivelink.output import progress
from drivelink.output.progress import Meter


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass when asked to."""
    made = SimpleNamespace(now_s=100.0, monotonic=lambda: made.now_s)
    monkeypatch.setattr(progress, "time", made)
    return made


def console(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=80)


def text(shown):
    return shown.file.getvalue()


def test_quick_work_shows_nothing(clock):
    for terminal in (True, False):
        shown = console(terminal)
        with Meter("count", 1000, shown) as meter:
            for k in range(1000):
                meter.update(k)
        assert text(shown) == ""


def test_long_work_without_a_terminal_is_a_line_now_and_then(clock):
    shown = console(terminal=False)
    with Meter("fit", 100, shown) as meter:
        for k in range(100):
            clock.now_s += 0.3
            meter.update(k)
    lines = text(shown).splitlines()
    assert lines[0] == "fit: 16 % after 5 s" and 5 <= len(lines) <= 6


def test_progress_says_what_is_being_done(clock):
    for terminal in (True, False):
        shown = console(terminal)
        with Meter("diagnose run.csv", None, shown) as meter:
            for stage in ("bandwidth", "search"):
                clock.now_s += 6.0
                meter.stage(stage)
        assert "diagnose run.csv (bandwidth)" in text(shown) and "(search)" in text(shown)


def test_long_work_on_a_terminal_is_a_bar_that_goes_away_also_where_it_breaks_off(clock):
    shown = console(terminal=True)
    with pytest.raises(KeyboardInterrupt), Meter("fit", 100, shown) as meter:
        clock.now_s += 3.0
        meter.advance(40)
        raise KeyboardInterrupt
    assert "fit" in text(shown) and "40/100" in text(shown)
    assert text(shown).rstrip().endswith("\x1b[2K")  # the line is erased
    assert "\x1b[?25h" in text(shown)  # the cursor is back
