"""`drivelink diagnose`: report.json, its page, the joint file that knows the effect; plots; progress on a terminal."""

import io
import json
import re
from functools import cache
from types import SimpleNamespace

import diagnosiskit as kit
import fleetkit
import joints
import numpy as np
import pytest
from rich.console import Console

from drivelink import jointfile
from drivelink.cli import main
from drivelink.jointfile.apply_diagnosis import floor_entry, make_model_monitor
from drivelink.output import document, plots, progress, report
from drivelink.output.document import Document, Grid, Section, drawn, page, show
from drivelink.output.numbers import Units
from drivelink.output.plots import COLORS, PlotCurve, medians, new_figure, over_time, plot_over_time, save, xy
from drivelink.output.progress import Meter
from drivelink.plaintext import for_page
from estimator.diagnosis import Errors
from estimator.reasons import percent

JOINT = fleetkit.JOINT.format(name="elbow")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diagnose")
    effects = [{}, {"coulomb_nm": 0.4}, {"late_s": 0.004}]
    for name, record in zip(("clean", "coulomb", "late"), kit.World(effects, seconds=8.0).run(), strict=True):
        joints.write_csv(record, folder / f"{name}.csv", 9)
    (folder / "joint.toml").write_text(JOINT, encoding="utf-8")
    return folder


@cache  # what was diagnosed once is looked at by several tests
def _diagnose(folder, name, joint="joint.toml", *more):  # type: ignore[type-arg]
    out = folder / f"{name}-{joint}"
    arguments = ["diagnose", str(folder / f"{name}.csv"), "--joint", str(folder / joint), "--out", str(out)]
    assert main([*arguments, *more]) == 0
    return json.loads((out / "report.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def test_report_json_is_as_promised(folder):
    report = _diagnose(folder, "coulomb")
    assert (report["schema"], report["verdict"]) == ("drivelink.diagnosis/1", "effect")
    assert report["bandwidth_hz"] > 0
    effect, error = report["effects"][0], report["error"]
    assert {"name", "location", "parameters", "std", "alternatives"} <= set(effect)
    assert (effect["name"], effect["location"]) == ("coulomb_friction", "motor")
    names = {f"{when}_{what}" for when in ("before", "after") for what in ("rms_nm", "relative")}
    assert {name: set(error[name]) for name in error} == {"train": names, "validation": names}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effect"), [("coulomb", "coulomb_friction"), ("late", "encoder_delay")])
def test_the_written_joint_file_knows_the_effect_and_its_floor(folder, name, effect):
    better = f"{name}-better.toml"
    _diagnose(folder, name, "joint.toml", "--write", str(folder / better))
    joint = jointfile.load(folder / better)
    effects = joint.motor[0].effect if name == "coulomb" else joint.link.effect
    assert [e.name for e in effects] == [effect]
    assert make_model_monitor(joint) is not None
    assert _diagnose(folder, name, better)["verdict"] == "sufficient"


def test_json_is_pure_and_a_page_without_a_curve_has_no_empty_section(folder, capsys):
    report = _diagnose(folder, "clean", "joint.toml", "--json")
    assert json.loads(capsys.readouterr().out) == report
    page = (folder / "clean-joint.toml" / "report.html").read_text(encoding="utf-8")
    assert "What reveals it" not in page and "What could not be separated" not in page
    assert "<th>probability" not in page and not re.search(
        r"e-\d", page[page.index("Error of") : page.index("<svg")]
    )


def test_a_full_disk_loses_no_finding(folder, monkeypatch, capsys):
    def full(path, *_, **__):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(document, "write_whole", full)
    arguments = ["diagnose", str(folder / "clean.csv"), "--joint", str(folder / "joint.toml")]
    assert main([*arguments, "--out", str(folder / "full")]) == 1
    said = capsys.readouterr()
    assert "The model is sufficient" in said.out
    assert (
        said.err.splitlines()[-1] == f"drivelink diagnose: {folder}/full/report.json: No space left on device"
    )


def test_the_report_is_self_contained_and_has_the_verdict_units_bands_the_winner_and_what_is_left(folder):
    _diagnose(folder, "coulomb")
    page = (folder / "coulomb-joint.toml" / "report.html").read_text(encoding="utf-8")
    for part in (
        "The model lacks Coulomb friction (motor)", "of the torque (", "rms) stays unexplained", "What reveals it",
        ">refitted</text>", "Stiffness of motor 1's transmission, with 95 % bands", "prefers-color-scheme: dark", "currentColor",
    ):  # fmt: skip
        assert part in page, part
    assert page.index("<h2>Notes") < page.index("of the error ")
    for foreign in ("#ffffff", 'src="http', 'href="http', "@import", "<script"):
        assert foreign not in page
    # The one that was chosen, and what the mark means.
    assert page.count("<svg") >= 3 and page.count("▶ ") == 2
    assert re.search(r'<tr class="chosen"><th>▶ Coulomb friction</th><td>(0\.9\d|1\.00)</td>', page)
    assert re.search(r"<th>torque_<wbr>nm</th><td>0\.\d+</td><td>\S+</td><td>N·m</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N·m/rad</td>", page)


def test_what_cannot_be_diagnosed_is_one_line(folder, capsys):
    text = (folder / "clean.csv").read_text(encoding="utf-8").splitlines()
    (folder / "short.csv").write_text("\n".join(text[:900]) + "\n", encoding="utf-8")
    arguments = ["diagnose", str(folder / "short.csv"), "--joint", str(folder / "joint.toml")]
    assert main([*arguments, "--out", str(folder / "no")]) == 3
    error = capsys.readouterr().err
    assert "too short" in error
    assert error.count("\n") == 1


def test_a_baseline_that_cannot_be_measured_is_a_warning(caplog):
    record = joints.recorded(np.zeros(50), np.zeros(50), 1e-3 * np.arange(50))
    model = joints.joint_model(0.1, 0.0, model="linear", order=None, parameters={"k_nm_rad": 100.0})
    assert floor_entry(record, model, 1.0) == {}
    assert "the daemon cannot raise the model alarm: " in caplog.text


def wave(n=20_000):
    t = np.arange(n) * 1e-3
    phi = 0.1 * np.sin(t)
    return t, phi, 100.0 + 3000.0 * phi**2


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
    columns = {"time_s": t, **dict.fromkeys(("torque_valid", "stiffness_valid"), valid.astype(float))}
    columns["flexibility_torque_std_nm"] = np.ones_like(t)
    for name in ("flexibility_torque_nm", "stiffness_nm_rad", "stiffness_std_nm_rad"):
        columns[name] = np.where(valid, 1.0 + t, 1e6)
    columns["stiffness_nm_rad"][50:] = np.nan
    plot_over_time(columns, tmp_path / "time.png", "elbow")
    for axes in figures[0].axes:
        assert np.nanmax(axes.lines[0].get_ydata()) < 2.0
        assert np.nanmin(axes.lines[1].get_ydata()) == 1e6 and axes.get_ylim()[1] < 2.0  # grey, and no scale
    torque, stiffness = figures[0].axes
    assert torque.get_xlim() == stiffness.get_xlim() == (t[0], t[-1])
    for axes in figures[0].axes:  # which part of the recording that is, is said
        assert "not valid" in axes.get_legend_handles_labels()[1]
    columns |= {"observable": 0.0 * t} | {
        f"motor1_{name}": t for name in ("deflection_rad", "stiffness_nm_rad", "stiffness_std_nm_rad")
    }
    plots.plot_curves(columns, 1, tmp_path / "stiffness.png", "elbow")  # an empty plot says why
    assert "never observable" in figures[1].axes[0].get_title(loc="left")


@pytest.mark.parametrize("n", [3000, 300_000])
def test_no_curve_over_time_goes_on_where_samples_are_missing(n):
    t = np.arange(n) * 1e-3
    t[n // 3 :] += 2.0
    _, (axes,) = new_figure()
    over_time(axes, {"a": PlotCurve(t, np.sin(t), np.ones(n))}, "y")
    x, y = axes.lines[0].get_data()
    across = np.flatnonzero(np.isnan(x))
    assert len(across) == 1 and np.isnan(y[across[0]]) and x[across[0] + 1] - x[across[0] - 1] > 2.0


def test_a_name_with_a_control_character_is_drawn_without_it(tmp_path):
    figure, (axes,) = new_figure("\x1b[2Ja name\nof two lines")  # matplotlib warns of what no letter is
    xy(axes, {"\x1bcurve": PlotCurve(np.arange(3.0), np.arange(3.0))}, "x", "y", "\x9bt")
    assert b"\x1b" not in save(figure, tmp_path / "x.svg").read_bytes()
    assert figure.get_suptitle().endswith("a name\nof two lines")


def test_words_in_a_page_are_text_without_what_turns_or_hides_them():
    """Names of files and joints are anybody's."""
    name = "<img src=x>\x1b]0;own\x07\x9b31m\u202egpj.exe"
    made = page(Document(title=name, about=name, sections=[]))
    assert made.count("&lt;img src=x&gt;]0;own31mgpj.exe") >= 2 and "<img" not in made
    assert for_page(name + '"') == "&lt;img src=x&gt;]0;own31mgpj.exe&quot;"


def test_on_a_phone_no_line_ends_within_a_share_and_a_path_has_places_to_break():
    html = drawn([Grid(("recording", "fit"), [("/plant/night/elbow.csv", "100.0 %"), ("b", "132.5 σ")])])
    assert (
        "100.0\u00a0%" in html and "132.5\u00a0σ" in html and "/<wbr>plant/<wbr>night/<wbr>elbow.csv" in html
    )


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


@pytest.fixture
def clock(monkeypatch):
    made = SimpleNamespace(now_s=100.0, monotonic=lambda: made.now_s)
    monkeypatch.setattr(progress, "time", made)
    return made


def console(terminal):
    return Console(file=io.StringIO(), force_terminal=terminal, width=80)


def text(shown):
    return shown.file.getvalue()


def test_long_work_on_a_terminal_is_a_bar_that_goes_away_also_where_it_breaks_off(clock):
    shown = console(terminal=True)
    with pytest.raises(KeyboardInterrupt), Meter("fit", 100, shown) as meter:
        clock.now_s += 3.0
        meter.update(40)
        raise KeyboardInterrupt
    assert "fit" in text(shown) and "40/100" in text(shown)
    assert text(shown).rstrip().endswith("\x1b[2K")  # the line is erased
    assert "\x1b[?25h" in text(shown)  # the cursor is back


@pytest.mark.parametrize(("chosen", "said"), [(0.02, True), (0.005, False)])
def test_the_report_says_why_another_effect_was_not_chosen(chosen, said):
    rival = SimpleNamespace(name="asymmetric_friction", error_relative=0.01)
    outcome = SimpleNamespace(train=SimpleNamespace(after_relative=chosen), rivals=[rival])
    why = "asymmetric friction alone leaves less: an effect with more freedom"
    assert (why in report._choice_of(outcome, [chosen])) == said


def test_a_fall_by_many_orders_keeps_its_digits_and_what_has_no_parameters_no_table():
    units, error = Units(linear=False), Errors(16991.2, 0.0098, 828658.0, 0.4787)
    outcome = SimpleNamespace(
        train=error, validation=error, effects=(), curves=(), transmissions=(), alignment={}
    )
    assert report._errors(outcome, units).rows[0][1:3] == ("16991 N·m, 82865800 %", "0.0098 N·m, 47.87 %")
    assert report._parameters(outcome, units) == []


def test_a_share_below_zero_has_the_minus_sign_of_other_numbers():
    assert (percent(-0.3371, 1), percent(0.998, 1)) == ("−33.7 %", "99.8 %")


@pytest.mark.slow
def test_of_a_linear_axis_the_report_speaks_of_newtons_and_metres(folder):
    (folder / "slide.toml").write_text(JOINT.replace("[[motor]]", 'axis = "linear"\n[[motor]]', 1))
    _diagnose(folder, "coulomb", "slide.toml")
    page = (folder / "coulomb-slide.toml" / "report.html").read_text(encoding="utf-8")
    assert re.search(r"<th>torque_<wbr>nm</th><td>\S+</td><td>\S+</td><td>N</td>", page)
    assert re.search(r"<th>k_<wbr>nm_<wbr>rad</th><td>\S+</td><td>\S+</td><td>N/m</td>", page)
    assert "N·m" not in page and "/ rad" not in page and "m/s" in page


def test_every_coefficient_of_a_polynomial_has_its_unit():
    text = Units(linear=False).value("coefficients_nm_rad", tuple(float(k) for k in range(1, 9)), None)
    units = ["rad", "rad³", "rad⁵", "rad⁷", "rad⁹", "rad¹¹", "rad¹³", "rad¹⁵"]
    assert text == ", ".join(f"{k} N·m/{unit}" for k, unit in enumerate(units, start=1))


@pytest.mark.parametrize("columns", [60, 80])  # in 40 it is a list
def test_a_printed_table_keeps_every_letter_in_a_narrow_terminal(columns):
    names = ("viscous_damping_nm_s_rad", "coefficients_nm_rad[2]")
    grid = Grid(
        ("where they differ most", "at", "of A", "of B"),
        [(name, "−0.0147 rad/s", "140.00 N·m/rad", "–") for name in names],
    )
    console = Console(width=columns, file=io.StringIO(), record=True)
    show([Section("", [grid])], console)
    lines = console.export_text().splitlines()
    first = "".join(line[1:].split("│")[0].strip() for line in lines if line.startswith("│"))
    assert first == "".join(names) and max(map(len, lines)) <= columns


def test_curves_differ_in_line_style_marker_and_lightness_not_only_in_colour():
    _, (axes,) = new_figure()
    t, phi, _ = wave(100)
    over_time(axes, {name: PlotCurve(t, k + phi) for k, name in enumerate("abcdef")}, "y")
    looks = [(line.get_linestyle(), line.get_marker()) for line in axes.lines]
    assert len(set(looks)) == len(looks) == 6
    rgb = [[int(color[i : i + 2], 16) for i in (1, 3, 5)] for color in COLORS[:3]]
    lightness = sorted(np.array(rgb) @ (0.2126, 0.7152, 0.0722))
    assert np.diff(lightness).min() > 20


def test_thinning_loses_no_peak():
    t = np.arange(300_000) * 1e-3
    y = np.zeros_like(t)
    y[123_456] = 7.0
    _, (axes,) = new_figure()
    over_time(axes, {"a": PlotCurve(t, y)}, "y")
    assert len(axes.lines[0].get_xdata()) < 5000 and max(axes.lines[0].get_ydata()) == 7.0


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_same_data_are_the_same_file(suffix, tmp_path):
    contents = []
    for name in ("a", "b"):
        figure, (axes,) = new_figure("t")
        t, phi, _ = wave(200)
        over_time(axes, {"φ": PlotCurve(t, phi)}, "φ / rad")
        contents.append(save(figure, tmp_path / f"{name}{suffix}").read_bytes())
    assert contents[0] == contents[1]


def test_a_power_of_ten_stands_beside_the_legend_not_in_it():
    figure, (axes,) = plots.new_figure()
    one = plots.PlotCurve(np.arange(3.0), 4.6e6 + np.arange(3.0), np.ones(3))
    plots.xy(axes, {"a": one, "b": one}, "x", "y")
    figure.draw_without_rendering()
    power, legend = axes.yaxis.get_offset_text().get_window_extent(), axes.get_legend().get_window_extent()
    assert power.width > 0 and not power.overlaps(legend)
