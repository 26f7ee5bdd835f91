"""The examples run against a daemon in another process, in every language whose tools are here."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from zenohkit import free_endpoint, ready, script

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"


@pytest.fixture
def endpoint():
    endpoint = free_endpoint()
    with script("elbow", endpoint) as daemon:
        ready(daemon)
        yield endpoint


def run(*command, **options):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("name", "seconds", "expected"),
    [
        ("subscribe_latest.py", "1.2", r"live     gain    70\.0 N·m/rad"),
        ("subscribe_wait.py", "1.5", "in control from cycle"),
        ("subscribe_async.py", "3.2", r"elbow: cycle \d*[05]00, 700\.0 N·m/rad, running"),
        ("subscribe_numpy.py", "0.5", r"stiffness 700\.0 N·m/rad"),
    ],
)
def test_the_python_examples_run(endpoint, name, seconds, expected):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for longer in (1, 3, 10, 30):  # on a loaded machine the first seconds may pass before anything has come
        out = run(
            sys.executable, EXAMPLES / name, "elbow", endpoint, float(seconds) * longer, env=environment
        )
        if re.search(expected, out):
            return
    pytest.fail(out)


@pytest.mark.rust
@pytest.mark.timeout(1200)
def test_the_rust_example_reads_the_golden_vectors_and_the_daemon(endpoint):
    if shutil.which("cargo") is None:
        pytest.skip("no cargo on this machine")
    target = Path(os.environ.get("CARGO_TARGET_DIR", EXAMPLES / "rust" / "target"))
    if not target.exists() and "CARGO_TARGET_DIR" not in os.environ:
        pytest.skip("builds for minutes: set CARGO_TARGET_DIR, or run cargo build in examples/rust once")
    run("cargo", "test", "--locked", "--quiet", cwd=EXAMPLES / "rust")
    run("cargo", "build", "--locked", "--quiet", cwd=EXAMPLES / "rust")
    out = run(target / "debug" / "drivelink-subscribe", "elbow", endpoint, "20", timeout=60)
    assert out.count("700.0 ± 3.0 N·m/rad, valid true, observable true") == 20


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


def test_the_cpp_example_reads_the_daemon(cpp, endpoint):
    if not (cpp / "subscribe").exists():
        pytest.skip("zenoh-pico is not installed (CMAKE_PREFIX_PATH)")
    out = run(cpp / "subscribe", "elbow", endpoint, "20", timeout=60)
    assert out.count("700.0 ± 3.0 N·m/rad, valid 1, observable 1") == 20
