"""Plots: one style, legible without colour, the same file for the same data; and progress on a terminal."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from drivelink.output import plots, progress
from drivelink.output.plots import COLORS, PlotCurve, medians, new_figure, over_time, plot_over_time, save, xy
from drivelink.output.progress import Meter


def wave(n=20_000):
    t = np.arange(n) * 1e-3
    phi = 0.1 * np.sin(t)
    return t, phi, 100.0 + 3000.0 * phi**2


def test_curves_differ_in_line_style_marker_and_lightness_not_only_in_colour():
    _, (axes,) = new_figure()
    t, phi, _ = wave(100)
    over_time(axes, {name: PlotCurve(t, k + phi) for k, name in enumerate("abcdef")}, "y")
    looks = [(line.get_linestyle(), line.get_marker()) for line in axes.lines]
    assert len(set(looks)) == len(looks) == 6
    rgb = [[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in COLORS[:3]]
    lightness = sorted(np.array(rgb) @ (0.2126, 0.7152, 0.0722))
    assert np.diff(lightness).min() > 20


def test_scattered_samples_become_one_curve():
    t, phi, sigma = wave()
    noisy = sigma + np.random.default_rng(1).normal(0, 5, len(t))
    x, y, std = medians(phi, noisy, std=np.full(len(t), 5.0))
    assert len(x) < 500 and np.all(np.diff(x) > 0) and np.all(std == 5.0)
    inside = np.abs(x) < 0.095  # the outermost bins average over the steepest part
    # The median of some 80 samples a bin: 5 N·m/rad * 1.25 / sqrt(80) = 0.7, four of them are a wide bound.
    assert np.nanmax(np.abs(y - 100.0 - 3000.0 * x**2)[inside]) < 2.8


def test_what_is_not_valid_is_a_gap_and_both_plots_share_their_time_axis(tmp_path, monkeypatch):
    figures = []
    monkeypatch.setattr(plots, "save", lambda figure, path: figures.append(figure) or path)
    t = np.arange(100) * 1e-3
    valid = (t > 0.02) & (t < 0.06)
    columns = {"time_s": t, "valid": valid.astype(float), "torque_valid": valid.astype(float)}
    columns["flexibility_torque_std_nm"] = np.ones_like(t)
    for name in ("flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad"):
        columns[name] = np.where(valid, 1.0 + t, 1e6)
    columns["stiffness_nm_rad"][50:] = np.nan
    plot_over_time(columns, tmp_path / "time.png", "elbow")
    for axes in figures[0].axes:
        assert np.nanmax(axes.lines[0].get_ydata()) < 2.0
    torque, stiffness = figures[0].axes
    assert torque.get_xlim() == stiffness.get_xlim()


def test_thinning_loses_no_peak():
    t = np.arange(300_000) * 1e-3
    y = np.zeros_like(t)
    y[123_456] = 7.0
    _, (axes,) = new_figure()
    over_time(axes, {"a": PlotCurve(t, y)}, "y")
    assert len(axes.lines[0].get_xdata()) < 5000 and max(axes.lines[0].get_ydata()) == 7.0


def test_what_is_not_finite_or_constant_or_empty_can_be_drawn(tmp_path):
    figure, axes = new_figure("title", rows=3)
    nan = np.full(5000, np.nan)
    over_time(axes[0], {"a": PlotCurve(nan, nan, nan)}, "y")
    xy(axes[1], {"a": medians(np.zeros(5000), np.ones(5000), std=nan)}, "x", "y")
    xy(axes[2], {"a": medians(np.zeros(0), np.zeros(0)), "b": medians(nan, nan)}, "x", "y")
    for count in (1, 2, 5, 100, 1000):
        x = np.linspace(0.0, 1.0, count)
        curve = medians(x, 2.0 * x)
        assert len(curve.x) > 0 and np.all(np.isfinite(curve.y))
    assert save(figure, tmp_path / "x.png").stat().st_size > 1000


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_same_data_are_the_same_file(suffix, tmp_path):
    contents = []
    for name in ("a", "b"):
        figure, (axes,) = new_figure("t")
        t, phi, _ = wave(200)
        over_time(axes, {"φ": PlotCurve(t, phi)}, "φ / rad")
        contents.append(save(figure, tmp_path / f"{name}{suffix}").read_bytes())
    assert contents[0] == contents[1]


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
