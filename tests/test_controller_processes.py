"""Drives, daemon and controller in three processes: CAN over TCP between them, zenoh through a relay.

What is asserted is that each fault ends in safe torque and that the controller moves the joint again. How fast is
asserted in bus time by the tests in lockstep and of the process's own clock by `test_controller_deadman.py`, and
here only reported. What the controller does once the springs are identified is asserted in lockstep too: a machine
that others use may lose so many cycles that they never are.
"""

import socket

import pytest
from controllerprocesses import Plant, go_through_faults
from zenohkit import until


def start(folder):
    """The three processes, the drives being in this one."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    where = f'{{ host = "127.0.0.1", port = {port}, tcp_tune = true }}'
    bus = f'interface = "socketcand"\nchannel = "vsa"\noptions = {where}\nperiod_s = 0.002'
    # The example's own 10 ms belong to a machine of its own: here others may hold a core for longer.
    return Plant(folder, bus, "--deadline", "0.08")


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_fault_and_the_way_back_in_three_processes(tmp_path, capsys):
    plant = start(tmp_path)
    try:
        outcomes = go_through_faults(plant)
        assert plant.end_controller() == 0
        until(lambda: not plant.enabled())
    finally:
        plant.close()
    with capsys.disabled():
        for event in outcomes:
            print(
                f"\n{event['fault']}: {event['reason']}, {1e3 * event['age_s']:.1f} ms after the last estimate",
                end="",
            )
