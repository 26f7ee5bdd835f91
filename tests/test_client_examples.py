"""The examples run against a daemon in another process, in every language whose tools are here."""

import itertools
import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
from zenohkit import make_estimate, make_external, python

from drivelink._core import encode_estimate, encode_external

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"


def run(*command, **options):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("name", "expected", "more"),
    [
        ("subscribe_latest.py", r"live     gain      70 N·m/rad", "1000"),
        ("subscribe_wait.py", "in control from cycle", "1000"),
        pytest.param(
            "subscribe_async.py",
            r"elbow: cycle \d*[05]00, 700 N·m/rad, running",
            "1000",
            marks=pytest.mark.slow,
        ),
        ("subscribe_numpy.py", "stiffness 700 N·m/rad", "0.5"),
    ],
)
def test_the_python_examples_run(daemon, name, expected, more):
    with python(EXAMPLES / name, "elbow", daemon, more) as process:
        assert any(re.search(expected, line) for line in process.stdout)


@pytest.mark.slow
def test_python_examples_end_without_a_traceback_by_ctrl_c_and_where_nobody_reads_on(daemon):
    # As a user's shell: what is printed comes through a pipe all the same.
    buffered = {"PYTHONUNBUFFERED": ""}
    with ExitStack() as stack:  # at once: each prints a line now and then
        running = [
            (
                stack.enter_context(
                    python(EXAMPLES / f"subscribe_{name}.py", "elbow", daemon, "1000", **buffered)
                ),
                pipe,
            )
            for name in ("latest", "wait", "async")
            for pipe in (False, True)
        ]
        for process, pipe in running:
            assert process.stdout.readline()
            if pipe:
                process.stdout.close()
                process.stdout = None
            else:
                process.send_signal(signal.SIGINT)
        alone = stack.enter_context(python(EXAMPLES / "subscribe_numpy.py", "nosuch", daemon, **buffered))
        assert alone.stderr.readline()  # which joints there are: it still waits
        alone.send_signal(signal.SIGINT)
        for process, _ in (*running, (alone, False)):
            assert "Traceback" not in process.communicate(timeout=20)[1]


@pytest.mark.parametrize("name", ["latest", "wait", "numpy", "async"])
def test_the_examples_explain_themselves_and_a_wrong_argument(name):
    path = EXAMPLES / f"subscribe_{name}.py"
    assert f"{path.name} [JOINT" in run(sys.executable, path, "--help")
    for wrong, said in ((("el bow",), "joint: expected a name"), (("elbow", "7447"), "endpoint: expected")):
        done = subprocess.run([sys.executable, path, *wrong], capture_output=True, text=True, timeout=60)
        assert done.returncode == 1 and done.stderr.startswith(said) and f"{path.name} [" in done.stderr


def test_without_ros_its_example_says_what_it_needs():
    done = subprocess.run([sys.executable, EXAMPLES / "ros2_stiffness.py"], capture_output=True, text=True)
    assert done.returncode == 1 and "expected ROS 2" in done.stderr and "Traceback" not in done.stderr


def test_a_controller_in_its_safe_state_says_why(monkeypatch, capsys):
    usable = SimpleNamespace(
        usable=True, sequence=1, flexibility_torque_nm=0.0, stiffness_nm_rad=1.0, stiffness_std_nm_rad=0.1
    )
    for worse, why in ((None, "no estimate in time"), (SimpleNamespace(usable=False), "it is not usable")):
        coming = itertools.chain([usable, worse], itertools.repeat(None))
        elbow = SimpleNamespace(
            wait=lambda _, c=coming: next(c), state="live", stale=False, gaps=0, foreign=0
        )
        monkeypatch.setattr("drivelink.subscribe", lambda *_, e=elbow, **__: nullcontext(e))
        runpy.run_path(str(EXAMPLES / "subscribe_wait.py"))["main"](seconds="0.05")
        said = capsys.readouterr().out
        assert why in said and said.startswith("in control from cycle 1 on\n")  # also if it never was safe


@pytest.mark.rust
@pytest.mark.timeout(1200)
def test_the_rust_example_reads_the_golden_vectors_and_the_daemon(daemon):
    if shutil.which("cargo") is None:
        pytest.skip("no cargo on this machine")
    target = Path(os.environ.get("CARGO_TARGET_DIR", EXAMPLES / "rust" / "target"))
    if not target.exists() and "CARGO_TARGET_DIR" not in os.environ:
        pytest.skip("builds for minutes: set CARGO_TARGET_DIR, or run cargo build in examples/rust once")
    run("cargo", "test", "--locked", "--quiet", cwd=EXAMPLES / "rust")
    run("cargo", "build", "--locked", "--quiet", cwd=EXAMPLES / "rust")
    out = run(target / "debug" / "drivelink-subscribe", "elbow", daemon, "20", timeout=60)
    assert out.count("700.0 ± 3.0 N·m/rad, valid true, observable true") == 20
    waiting = subprocess.Popen(
        [target / "debug" / "drivelink-subscribe", "nosuch", daemon], stderr=subprocess.PIPE, text=True
    )
    with waiting:
        assert "no estimate of nosuch" in waiting.stderr.readline()  # not silence
        waiting.kill()
    for wrong, said in (
        (["elbow", "tcp/127.0.0.1:1"], "tcp/127.0.0.1:1: nobody answers there: expected a daemon"),
        (["elbow", "7447"], "ENDPOINT: expected one like tcp/127.0.0.1:7447, got 7447"),
        (["el bow#", daemon], 'JOINT: expected the name of a joint, got "el bow#"'),
        (["elbow", daemon, "all"], "COUNT: expected a whole number, got all"),
    ):
        done = subprocess.run(
            [target / "debug" / "drivelink-subscribe", *wrong], capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 1 and done.stderr.startswith(said) and done.stderr.count("\n") == 1


@pytest.fixture(scope="module")
def cpp(tmp_path_factory):
    if shutil.which("cmake") is None or shutil.which("c++") is None:
        pytest.skip("no cmake or no C++ compiler on this machine")
    build = tmp_path_factory.mktemp("cpp")
    run("cmake", "-S", EXAMPLES / "cpp", "-B", build)
    run("cmake", "--build", build)
    return build


def test_the_cpp_decoder_reads_the_golden_vectors(cpp):
    printed = run(cpp / "golden", ROOT / "tests" / "golden")
    assert "12 vectors, 39 to be refused, 0 wrong" in printed


def test_the_cpp_example_reads_the_daemon(cpp, daemon):
    if not (cpp / "subscribe").exists():
        pytest.skip("zenoh-pico is not installed (CMAKE_PREFIX_PATH)")
    out = run(cpp / "subscribe", "elbow", daemon, "20", timeout=60)
    assert out.count("700 ± 3 N·m/rad, valid 1, observable 1") == 20


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """The plugin for ros2_control, compiled against stand-ins for ROS (tests/ros2); its messages are handed in."""
    if shutil.which("c++") is None:
        pytest.skip("no C++ compiler on this machine")
    built = tmp_path_factory.mktemp("ros2") / "plugin"
    folder, stubs = EXAMPLES / "cpp" / "ros2_control", ROOT / "tests" / "ros2"
    strict = ("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pthread", "-I", stubs, "-I", folder)
    run("c++", *strict, folder / "sensor.cpp", stubs / "main.cpp", "-o", built)
    return built


def test_the_ros2_control_plugin_has_numbers_only_while_they_may_be_used(plugin):
    valid, invalid = (encode_estimate(make_estimate(5, status), 0).hex() for status in (1, 2))
    external, nothing = (encode_external(make_external(5, status), 0).hex() for status in (3, 0))
    of, touch = "drivelink/elbow/estimate", "drivelink/elbow/external"
    names = "stiffness,usable,external_torque,contact"
    messages = [
        f"{of}={valid}",
        f"{touch}={external}",
        f"{of}={invalid}",
        f"{touch}={nothing}",
        f"{of}={valid}",
    ]
    lines = run(plugin, "elbow", names, "stale_after_s=0.25", "--", *messages).splitlines()
    said = [dict(each.removeprefix("elbow/").split() for each in line.split("  ") if each) for line in lines]
    rows = [" ".join(row[name] for name in names.split(",")) for row in said]
    no_number = "nan 0 nan nan"  # before the first one, with nothing valid, and when the last is old
    usable = ["700 1 nan nan", "700 1 0.05 1", "nan 0 0.05 1"]
    assert rows == [no_number, *usable, no_number, usable[0], no_number]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("stifness", "elbow/stifness: no such state interface"),
        ("stiffness endpoint=tcp/10.0.0.9:1", "tcp/10.0.0.9:1: nobody answers there"),
        ("stiffness stale_after_s=soon", "stale_after_s: expected a number of seconds"),
    ],
)
def test_the_ros2_control_plugin_says_what_it_cannot_use(plugin, arguments, said):
    command = [plugin, "elbow", *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout.strip() == f"drivelink: {said}"
