"""The table of a fleet: rows of runs at once and after each other, and what the page makes of them."""

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import fleetkit
import numpy as np
import pytest
from fleetkit import row

pytest.importorskip("distributed", reason="the extra [fleet] is not installed")

import chromium
import pyarrow as pa
import pyarrow.parquet as pq

from drivelink.cli import main
from drivelink.fleet import table
from drivelink.fleet.page import page
from drivelink.fleet.storage import FleetError, Source, Store
from drivelink.fleet.summary import COLUMNS, summarise
from drivelink.fleet.table import FleetTable, read_rows

CUT = "[...document.querySelectorAll('figure, .table')].filter(e => e.scrollWidth > e.clientWidth).length"


SMALLEST = """Math.min(...[...document.querySelectorAll('.large text')].filter(e => e.getClientRects().length)
.map(e => parseFloat(getComputedStyle(e).fontSize) * e.getScreenCTM().a))"""


SHOWN = """[...document.querySelectorAll('.joints tr')].filter(row => row.offsetHeight)
.sort((a, b) => a.offsetTop - b.offsetTop).map(row => row.querySelector('th').textContent)"""


# The table


def append(folder: Path, *rows: dict[str, Any]) -> None:
    with FleetTable(Store(str(folder))) as one:
        one.append([*rows])


def test_rows_of_runs_one_after_the_other_and_at_once_stand_in_one_part(tmp_path):
    append(tmp_path, row("a"))
    append(tmp_path, row("b"))
    assert len(list(tmp_path.glob("table/*.parquet"))) == 1
    assert not list(tmp_path.glob("table/*.tmp"))
    store = Store(str(tmp_path))
    with FleetTable(store) as first, FleetTable(store) as second:
        first.append([row("c")])
        second.append([row("d")])
    assert fleetkit.ids(tmp_path) == [f"{digest}-elbow" for digest in "abcd"]


def test_full_parts_follow_each_other_and_a_newer_row_takes_the_place_of_an_old_one(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "_PART_ROWS", 2)
    for digest in "abcde":
        append(tmp_path, row(digest))
    assert len(list(tmp_path.glob("table/*.parquet"))) == 3
    append(tmp_path, row("a", version="2"))
    assert fleetkit.ids(tmp_path) == [f"{digest}-elbow" for digest in "abcde"]
    assert {r["id"]: r["version"] for r in read_rows(Store(str(tmp_path)))}["a-elbow"] == "2"


def test_what_a_kill_between_two_writes_leaves_double_is_read_once_and_mended(tmp_path):
    append(tmp_path, row("a"))
    (part,) = tmp_path.glob("table/*.parquet")
    shutil.copy(part, part.with_name("part-0.parquet"))
    assert len(read_rows(Store(str(tmp_path)))) == 1
    append(tmp_path, row("b"))
    assert fleetkit.ids(tmp_path) == ["a-elbow", "b-elbow"]


def test_an_error_gives_way_to_the_result_of_the_same_recording(tmp_path):
    append(tmp_path, row("unread-1", None, recording="a.csv", status="error", error="no such host"))
    with FleetTable(Store(str(tmp_path))) as one:
        assert one.at(Source("a.csv", 1, "s", None)).failed  # type: ignore[union-attr]
        one.append([row("a")])
    assert fleetkit.ids(tmp_path) == ["a-elbow"]


def test_a_part_that_is_no_parquet_file_is_one_line(tmp_path):
    (tmp_path / "table").mkdir()
    (tmp_path / "table" / "part-1.parquet").write_text("garbage")
    with pytest.raises(FleetError, match=r"part-1.parquet: expected a Parquet file"):
        read_rows(Store(str(tmp_path)))


@pytest.mark.parametrize(
    ("rows", "said"),
    [(300_000, "at most 10000 rows, got 300000"), (3, "a value in each row of id, got 3 without")],
)
def test_a_part_that_no_run_wrote_is_one_line(rows, said, tmp_path):
    (tmp_path / "table").mkdir()
    empty = pa.table([pa.nulls(rows, field.type) for field in table.SCHEMA], schema=table.SCHEMA)
    pq.write_table(empty, tmp_path / "table" / "part-1.parquet")
    with pytest.raises(FleetError, match=f"part-1.parquet: expected {said}"):
        read_rows(Store(str(tmp_path)))


def test_a_text_that_stands_in_a_part_once_for_all_rows_is_not_unpacked_for_all_of_them(
    tmp_path, monkeypatch
):
    """14 kB took 600 MB."""
    monkeypatch.setattr(table, "_MOST_BYTES", 1 << 20)
    (tmp_path / "table").mkdir()
    rows = pa.Table.from_pylist(
        [row("a") | {"details": "x" * 20_000, "error": "x" * 20_000}] * 100, table.SCHEMA
    )
    pq.write_table(rows, part := tmp_path / "table" / "part-1.parquet", compression="zstd")
    assert part.stat().st_size < 20_000
    with pytest.raises(FleetError, match=r"part-1.parquet: expected rows of at most 1 MiB"):
        read_rows(Store(str(tmp_path)))


def test_what_cannot_be_written_is_named_once(tmp_path):
    (tmp_path / "folder").touch()
    with pytest.raises(FleetError, match=r"folder/a/b: cannot be written: [^/]+$"):
        Store(str(tmp_path)).write("folder/a/b", b"")


def test_a_part_that_says_itself_that_it_is_too_large_is_not_unpacked(tmp_path, monkeypatch):
    """One text of 600 MB has 11 kB, and was one batch."""
    append(tmp_path, row("a") | {"details": "x" * (2 << 20)})
    monkeypatch.setattr(table, "_MOST_BYTES", 1 << 20)
    monkeypatch.setattr(table, "_batches", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(FleetError, match=r"expected rows of at most 1 MiB"):
        read_rows(Store(str(tmp_path)))


def test_a_part_whose_texts_are_no_texts_is_one_line(tmp_path):
    append(tmp_path, row("a"))
    (part,) = tmp_path.glob("table/*.parquet")
    good = pq.read_table(part)
    names = part.read_bytes().replace(b"worker", b"w\xe4rker")
    pq.write_table(good.set_column(0, "id", pa.array([b"\xe4"]).view(pa.string())), part)
    for content in (part.read_bytes(), names):
        part.write_bytes(content)
        with pytest.raises(FleetError, match=r"expected a Parquet file of drivelink: .*(UTF|utf)"):
            read_rows(Store(str(tmp_path)))


# The summary


def night(joint: str, k: int, stiffness: float, effects: list[str]) -> dict[str, Any]:
    values = dict.fromkeys([*COLUMNS, "recording", "time"])
    return values | {
        "joint": joint, "transmission": 1, "status": "done", "effects": effects, "model": "linear",
        "verdict": "effect" if effects else "sufficient", "sentence": "said", "excited": True,
        "parameters": json.dumps({"k_nm_rad": stiffness}), "covariance": [0.01], "deflection_middle_rad": 0.02,
        "stiffness_middle_nm_rad": stiffness, "stiffness_std_middle_nm_rad": 0.1, "report": f"{joint}{k}.html",
        "error_before_relative": 0.1, "error_after_relative": 0.02, "recording": f"{joint}-{k}.csv",
        "time": datetime(2026, 1, 5, tzinfo=UTC) + timedelta(days=k),
        "inertia_kg_m2": 0.2, "inertia_std_kg_m2": 0.001, "viscous_damping_nm_s_rad": 0.8, "viscous_damping_std_nm_s_rad": 0.01,
        "deflection_offset_rad": 0.001, "deflection_offset_std_rad": 1e-5,
    }  # fmt: skip


def nights(count: int, changes: dict[int, dict[str, Any]] | None = None, **each: Any) -> list[dict[str, Any]]:
    """Recordings of one joint that is steady, but for some nights."""
    rows = (night("elbow", k, 150.0 + 0.1 * (k % 3), []) for k in range(count))
    return [row | each | (changes or {}).get(k, {}) for k, row in enumerate(rows)]


LOST = {"status": "error", "error": "no frames"}


def sentence(*rows: dict[str, Any]) -> str:
    (joint,) = summarise([*rows], 0.05)["joints"]
    return str(joint["sentence"])


def test_joints_come_by_urgency_with_what_changed_since_when():
    rng = np.random.default_rng(8)
    rows = []
    for k in range(20):
        noise = 0.3 * rng.standard_normal(4)
        rows.append(night("steady", k, 150.0 + noise[0], []))
        rows.append(night("drifts", k, 150.0 - 0.5 * k + noise[1], []))
        rows.append(night("steps", k, 150.0 + 4.0 * (k >= 12) + noise[2], []))
        rows.append(night("rubs", k, 150.0 + noise[3], ["coulomb_friction@motor"] if k >= 9 else []))
    document = summarise(rows, 0.05)
    assert json.loads(json.dumps(document)) == document
    joints = {one["joint"]: one for one in document["joints"]}
    assert [one["state"] for one in document["joints"]] == ["changing"] * 3 + ["steady"]
    gone = night("steps", 20, 150.0, []) | LOST
    # What shows nothing any more comes before what changes.
    first = summarise([*rows, gone], 0.05)["joints"][0]
    assert (first["joint"], first["state"]) == ("steps", "lost") and "stepped by +" in first["sentence"]
    (drift,) = joints["drifts"]["transmissions"][0]["changes"]
    assert drift["kind"] == "drift"
    assert drift["amount_relative"] == pytest.approx(-9.5 / 150.0, abs=4 * drift["amount_std_relative"])
    (step,) = joints["steps"]["transmissions"][0]["changes"]
    assert (step["kind"], step["since"][:10]) == ("step", "2026-01-17")
    (effect,) = joints["rubs"]["effects"]
    assert (effect["significant"], effect["since"][:10]) == (True, "2026-01-14")
    assert joints["rubs"]["sentence"] == "New at the motor since 2026-01-14: Coulomb friction."


@pytest.mark.parametrize(
    ("inertia", "std", "effects", "said"),
    [
        (0.2, 0.001, [], "Stiffness stepped by +5."),
        (0.21, 0.001, [], "The torque's scale stepped by +5."),
        (0.2, 0.01, [], "Stiffness or the torque's scale stepped by +5."),
        (0.2, 0.001, ["backlash@transmission"], "Stiffness or backlash stepped by +5."),
    ],
)
def test_a_stiffness_that_changes_with_the_inertia_is_the_torque_and_beside_backlash_perhaps_no_spring(
    inertia, std, effects, said
):
    rng, rows = np.random.default_rng(3), []
    for k in range(10):
        rows.append(night("elbow", k, (158.0 if k >= 4 else 150.0) + 0.1 * rng.standard_normal(), effects))
        rows[-1] |= {"inertia_kg_m2": (inertia if k >= 4 else 0.2) + 1e-4 * rng.standard_normal()}
        rows[-1] |= {"inertia_std_kg_m2": std}
    assert said in sentence(*rows)


@pytest.mark.parametrize("probability", [0.5, 1.0])
def test_damping_zero_and_parameters_of_sure_effects_are_tested_for_changes_and_drawn(probability):
    rng, rows = np.random.default_rng(4), []
    for k in range(10):
        effect = {
            "name": "backlash",
            "parameters": {"half_gap_rad": 0.001 * (1 + k) + 1e-5 * rng.standard_normal()},
        }
        effect |= {"std": {"half_gap_rad": 1e-5}, "probability": probability if k else 0.5}
        rows.append(night("elbow", k, 150.0 + 0.1 * rng.standard_normal(), ["backlash@transmission"]))
        rows[-1] |= {
            "viscous_damping_nm_s_rad": 0.8 + 0.08 * k + 0.001 * rng.standard_normal(),
            "deflection_offset_rad": (0.013 if k >= 6 else 0.001) + 1e-5 * rng.standard_normal(),
            "details": json.dumps({"effects": [effect]}),
        }
    rows.append(night("elbow", 10, 150.0, []) | {"excited": False, "deflection_offset_rad": 1.0})
    said = sentence(*rows)
    assert "Deflection offset stepped by +0.01199" in said and "rad on 2026-01-11." in said
    assert "Viscous damping has drifted by +0.7" in said and "N·m·s/rad since 2026-01-0" in said
    assert ("Backlash: half gap has drifted by +0.00" in said) == (probability == 1.0)
    drawn = page(summarise(rows, 0.05))
    assert drawn.count('class="when"') == (3 if probability == 1.0 else 2)


@pytest.mark.parametrize("rigid", [{}, {"model": "none", "excited": False, "deflection_offset_rad": None}])
@pytest.mark.parametrize(
    ("nights", "state", "said"),
    [
        (1, "undecided", "Too few recordings"),
        (5, "undecided", "Too few recordings"),
        (6, "steady", "Steady."),
    ],
)
def test_no_joint_is_called_steady_by_fewer_recordings_than_show_a_change(nights, state, said, rigid):
    rows = [night("elbow", k, 150.0 + 0.1 * (k % 2), []) | rigid for k in range(nights)]
    (joint,) = (document := summarise(rows, 0.05))["joints"]
    assert joint["state"] == state and joint["sentence"].startswith(said) and page(document)


def test_a_joint_that_lacked_an_effect_in_some_nights_is_not_merely_steady():
    lacking = ["coulomb_friction@motor1"]
    rows = [night("elbow", k, 150.0 + 0.1 * (k % 2), lacking if 3 <= k < 7 else []) for k in range(8)]
    said = "Steady in the last recording; before it Coulomb friction (motor 1) was missing in 4 of 8."
    assert sentence(*rows) == said and said in page(summarise(rows, 0.05))


def test_a_power_of_ten_on_an_axis_is_written_as_elsewhere():
    drawn = page(summarise([night("elbow", k, 4e6, []) for k in range(8)], 0.05))
    assert ">4.00e6<" in drawn and ">3.98e6<" in drawn and "e+0" not in drawn


def test_on_a_terminal_the_sentence_of_a_joint_breaks_between_words(tmp_path, monkeypatch, capsys):
    nights = [night("elbow", k, 150.0, ["coulomb_friction@motor"]) for k in range(2)]
    append(tmp_path, *({**row(str(k)), **one, "id": str(k)} for k, one in enumerate(nights)))
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    assert main(["fleet", "report", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    assert max(map(len, printed.split("wrote")[0].splitlines())) <= 40 and "elbow: The last 2 of 2" in words


def test_an_unusable_stiffness_is_no_point_of_the_trend_but_a_cross_on_the_chart():
    negative = {"stiffness_middle_nm_rad": -20.0, "parameters": '{"k_nm_rad": -20.0}'}
    document = summarise(nights(10, {4: negative, 5: {"excited": False}}), 0.05)
    (joint,) = document["joints"]
    assert len(joint["transmissions"][0]["series"]) == 8 and joint["state"] == "steady"
    assert [one["reason"] for one in joint["unusable"]] == [
        "the fitted stiffness is not above zero", "its motion does not reveal the stiffness",
    ]  # fmt: skip
    assert page(document).count('class="cross"') == 6  # on the chart, also a phone's, and in the list


def test_a_joint_that_breaks_is_said_to_be_lost_and_its_findings_stay_on_the_chart():
    broken = {"excited": False, "effects": ["torque_offset@motor"], "error_before_relative": 1.34}
    document = summarise(nights(11, {8: broken, 9: broken, 10: LOST}), 0.05)
    (joint,) = document["joints"]
    assert joint["state"] == "lost"
    assert joint["sentence"] == "The last 3 recordings show no stiffness, from 2026-01-13 on: no frames."
    text = page(document)
    assert "<h1>1 of 1 joint needs a look: 1 lost</h1>" in text and "<th>why it could not be used" in text
    assert "% of the torque (median)" in text  # also on a phone, which has no head of the table
    assert "a hollow dot a model that was not sufficient" in text
    assert text.count('class="found"') == 4 and "134.0\u00a0% → 2.00\u00a0% of the torque" in text


def test_a_joint_that_breaks_is_still_said_to_lack_what_it_lacked():
    rows = [night("elbow", k, 150.0 + 0.1 * (k % 3), ["coulomb_friction@motor"]) for k in range(8)]
    found = rows[-1]["sentence"]
    rows.append(night("elbow", 8, 150.0, []) | LOST)
    assert sentence(*rows).endswith(f"no frames. The last one that could be used says: {found}")


def test_the_examples_of_the_documentation_read_the_table(tmp_path, monkeypatch, capsys):
    pytest.importorskip("duckdb")
    text = (Path(__file__).parent.parent / "docs" / "how-to" / "fleet.md").read_text(encoding="utf-8")
    examples = [block.split("```")[0] for block in text.split("```python\n")[1:]]
    assert len(examples) == 1
    with FleetTable(Store(str(tmp_path / "fleet"))) as one:
        for k in range(3):
            one.append([row(str(k), excited=True, stiffness_middle_nm_rad=100.0 + k)])
    monkeypatch.chdir(tmp_path)
    for example in examples:
        exec(compile(example, "docs/how-to/fleet.md", "exec"), {})
    assert "elbow" in capsys.readouterr().out


@pytest.mark.parametrize(
    "report",
    ["javascript:alert(1)", "https://evil.example/report.html", "diagnoses/../../x/report.html", "//x"],
)
def test_the_table_is_data_on_the_page(report):
    mark = "<script>alert(1)</script>"
    rows = [night(mark, k, 150.0, [f"{mark}@{mark}"]) for k in range(9)]
    good = "diagnoses/elbow/0123456789abcdef01234567-2/report.html"
    for one in rows:
        one |= {"report": report, "sentence": mark, "verdict": mark, "recording": mark, "model": mark}
    rows[0] |= {"status": "error", "error": mark}
    rows[-1]["report"] = good
    text = page(summarise(rows, 0.05))
    assert report not in text and "<script" not in text
    assert f'href="{good}"' in text
    assert "Content-Security-Policy" in text and "default-src 'none'" in text


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("transmission", None),
        ("effects", None),
        ("parameters", "{"),
        ("covariance", [1.0, 2.0]),
        ("details", '{"effects": [1]}'),
    ],
)
def test_what_no_run_writes_into_the_table_is_one_line(column, value, tmp_path, capsys):
    rows = [row(str(k)) | night("elbow", k, 150.0, []) | {column: value} for k in range(8)]
    append(tmp_path, *rows)
    assert main(["fleet", "report", str(tmp_path)]) == 3
    error = capsys.readouterr().err
    assert "its table has what no run of drivelink writes: " in error and error.count("\n") == 1


def test_a_linear_axis_has_metres_and_newtons():
    text = page(summarise(nights(10, axis="linear"), 0.05))
    assert "at a deflection of 0.02 m, N/m; scatter" in text and "viscous damping, N·s/m<" in text
    assert "N·m" not in text and " rad" not in text and "false discovery rate of" not in text
    changed = page(summarise([night("elbow", k, 150.0 - 20.0 * (k > 9), []) for k in range(20)], 0.05))
    assert " %, a change from a false discovery rate of " in changed and "q = " not in changed


def test_a_stiffness_that_says_nothing_at_the_common_deflection_is_no_point():
    (joint,) = summarise(nights(10, {4: {"covariance": [80.0**2]}}), 0.05)["joints"]
    assert len(joint["transmissions"][0]["series"]) == 9
    assert [one["reason"] for one in joint["unusable"]] == ["its motion does not reveal the stiffness"]


def test_what_the_last_recordings_agree_on_is_said_with_the_day_since_which_they_do():
    found = {
        "verdict": "effect",
        "effects": ["coulomb_friction@motor1"],
        "sentence": "The model lacks Coulomb friction.",
    }
    rows = nights(12, dict.fromkeys((9, 10, 11), found))
    last = "The last 3 of 12 recordings, since 2026-01-14, agree: The model lacks Coulomb friction."
    assert sentence(*rows) == last
    assert sentence(*rows[:10]).startswith("No significant change, but the last recording says: ")


@pytest.mark.skipif(chromium.EXECUTABLE is None, reason="needs Chromium")
def test_a_phone_shows_charts_and_tables_whole_and_joints_are_sorted_and_hidden(tmp_path):
    friction = ["coulomb_friction@motor"]
    rows = [night("wrist", k, 150.0 + 4.0 * (k >= 12), friction if k >= 9 else []) for k in range(20)]
    rows += nights(20)
    (tmp_path / "fleet.html").write_text(page(summarise(rows, 0.05)), encoding="utf-8")
    with chromium.Chromium(tmp_path / "profile") as browser:
        browser.resize(390, 800)
        browser.open((tmp_path / "fleet.html").as_uri())
        assert browser.evaluate(CUT) == 0
        assert browser.evaluate(SMALLEST) > 8.0  # letters that can be read
        assert browser.evaluate(SHOWN) == ["wrist", "elbow"]  # by urgency
        browser.evaluate("document.getElementById('by1').click()")
        assert browser.evaluate(SHOWN) == ["elbow", "wrist"]  # by name
        browser.evaluate("document.getElementById('show-steady').click()")
        assert browser.evaluate(SHOWN) == ["wrist"]
