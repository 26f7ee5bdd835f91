"""Drives, daemon and controller in three processes: safe torque when the daemon is killed, and moving again with it.

How fast is asserted in bus time by the tests in lockstep and of the process's own clock by `test_controller_faults.py`,
and so is what it does once the springs are identified: a machine that others use may lose so many cycles that they
never are.
"""

import json
import signal
import subprocess
import sys
import threading

import controllerkit as kit
import pytest
from zenohkit import free_endpoint, free_port, process, python, until


def reaches(events: list[dict], phase: str, after: int = 0) -> dict:
    """Wait for the first event of that phase after so many events."""
    until(lambda: any(event["phase"] == phase for event in events[after:]), 120.0)
    return next(event for event in events[after:] if event["phase"] == phase)


def test_without_a_bus_the_controller_is_one_line(tmp_path):
    path, port = tmp_path / "vsa.toml", free_port()
    path.write_text((kit.EXAMPLE / "joint.toml").read_text(encoding="utf-8").replace("29536", str(port)))
    done = subprocess.run([sys.executable, kit.EXAMPLE / "run.py", path], capture_output=True, text=True)
    said = f"socketcand 127.0.0.1:{port} cannot be opened: nobody listens there"
    assert done.returncode == 1 and done.stderr.splitlines()[-1].startswith(f"run.py: {said}")
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_killed_daemon_and_the_way_back_in_three_processes(tmp_path):
    head, _, rest = kit.declared_text().partition("[bus]")
    options = f'options = {{ host = "127.0.0.1", port = {free_port()}, tcp_tune = true }}\nperiod_s = 0.002'
    bus = f'[bus]\ninterface = "socketcand"\nchannel = "vsa"\n{options}\n[zenoh]\nendpoint = "{free_endpoint()}"\n'
    path = tmp_path / "vsa.toml"
    path.write_text(f"{head}{bus}[estimator]{rest.partition('[estimator]')[2]}", encoding="utf-8")
    # The example's own 10 ms belong to a machine of its own: here others may hold a core for longer.
    options = ("--identify", "1", "--deadline", "0.08", "--json")
    with process("sim", path) as drives:
        assert "ready" in drives.stdout.readline()
        with process("run", path) as daemon, python(kit.EXAMPLE / "run.py", path, *options) as controller:
            events: list[dict] = []
            reader = threading.Thread(target=lambda: events.extend(map(json.loads, controller.stdout)))
            reader.start()
            try:
                reaches(events, "identify")
                before = len(events)
                daemon.kill()
                assert reaches(events, "safe", before)["reason"] == "estimates are stale"
                with process("run", path):
                    reaches(events, "identify", before)
                    controller.send_signal(signal.SIGTERM)
                    assert controller.wait(60.0) == 0
                    with python(kit.EXAMPLE / "run.py", path, *options) as piped:  # `| head`
                        assert piped.stdout.readline()
                        piped.stdout.close()
                        piped.stdout = None
                        assert "Traceback" not in piped.communicate(timeout=60)[1] and piped.returncode == 0
            finally:
                controller.kill()
                reader.join()
