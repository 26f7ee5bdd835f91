"""What holds for every test, and how they are shared out where several processes run them (`-n 2`)."""

import gc
import os
import signal
from pathlib import Path
from types import SimpleNamespace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported
os.environ["TERM"] = "xterm-256color"  # what is drawn is the same wherever tests run
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # many processes would each compile every library

import can.interfaces.virtual
import hypothesis
import pytest
import zenohkit

from drivelink.cycle import realtime
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_session

# A shell starts what runs in the background with SIGINT ignored, and processes hand that on to the ones they
# start; the tests press Ctrl-C on theirs.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The receivers of a virtual bus share a message, into which nobody writes: half the cost of a frame.
can.interfaces.virtual.deepcopy = lambda message: message

# A daemon or a simulation in a process of all tests looks through all they keep for garbage, twice, and reads in
# what is mapped and never used: seconds.
realtime.gc = SimpleNamespace(collect=int, freeze=int, unfreeze=int, disable=gc.disable, enable=gc.enable)
realtime._MCL_FUTURE = 4  # MCL_ONFAULT

# How long an example takes says something of the machine only.
hypothesis.settings.register_profile(
    "drivelink", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("drivelink")

# Real processes, sockets and clocks. One worker runs them all, one after the other: they load a second core
# by themselves, and what they wait for comes late enough beside one worker that only calculates.
REAL_TIME = {
    "test_cli_run", "test_cli_sim", "test_client", "test_client_examples", "test_controller_processes",
    "test_daemon", "test_demo", "test_interfaces", "test_monitor",
    "test_network_attacks", "test_never_moves", "test_publisher", "test_realtime", "test_recording_recorder",
    "test_ros2", "test_session", "test_session_security", "test_sim_canopen_network", "test_socketcan",
}  # fmt: skip


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings and joint files of two joints (fleetkit.py), only read."""
    import fleetkit

    return fleetkit.make_fleet(tmp_path_factory.mktemp("fleet"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # A tenth of the time would go into looking through hundreds of modules for garbage, again and again: `swept`.
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)
    for item in items:
        if item.path.stem in REAL_TIME:
            item.add_marker(pytest.mark.real_time)


@pytest.fixture(scope="module", autouse=True)
def swept():
    """What a file leaves is collected before the next one; what it keeps for others is not looked through again."""
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture
def endpoint():
    return zenohkit.free_endpoint()


@pytest.fixture
def publisher(endpoint):
    """The keys of the joint elbow."""
    joint = zenohkit.make_joint("elbow", endpoint)
    session = open_session(joint.zenoh, Path())
    yield JointPublisher(session, joint)
    close_session(session)


@pytest.fixture(scope="module")
def daemon():
    """The endpoint of a daemon of the joint elbow, in a process of its own."""
    endpoint = zenohkit.free_endpoint()
    with zenohkit.script("elbow", endpoint) as process:
        zenohkit.ready(process)
        yield endpoint


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """By file, so that what a module prepares is prepared once; all in real time as if they were one file."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "real time" if Path(file).stem in REAL_TIME else file

    return ByFile(config, log)
