"""Drives, daemon and controller in three processes: CAN over TCP between them, zenoh through a relay.

What is asserted is that each fault ends in safe torque and that the controller comes back. How fast is asserted
in bus time by the tests in lockstep and of the process's own clock by `test_controller_deadman.py`, and here only
told: the machine may be doing something else.
"""

import socket

import pytest
from controllerprocesses import Plant, go_through_faults
from zenohkit import until


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_each_fault_and_the_way_back_in_three_processes(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    options = f'{{ host = "127.0.0.1", port = {port}, tcp_tune = true }}'
    bus = f'interface = "socketcand"\nchannel = "vsa"\noptions = {options}\nperiod_s = 0.002'
    # The example's own 10 ms belong to a machine of its own: here others may hold a core for longer.
    plant = Plant(tmp_path, bus, "--deadline", "0.08")
    try:
        told = go_through_faults(plant)
        assert plant.end_controller() == 0
        until(lambda: not plant.enabled())
    finally:
        plant.close()
    with capsys.disabled():
        for event in told:
            print(
                f"\n{event['fault']}: {event['reason']}; told {1e3 * event['age_s']:.1f} ms after the last "
                f"estimate, no torque at the drives after {1e3 * event['torque_ended_s']:.1f} ms",
                end="",
            )
