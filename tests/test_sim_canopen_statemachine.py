"""The CiA 402 state machine against the standard's table of transitions."""

from __future__ import annotations

import pytest

from sim.canopen.drive import PowerState as P
from sim.canopen.drive import StateMachine

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP = 0x06, 0x07, 0x0F, 0x00, 0x02

# CiA 402-2, figure 3 and table 4. Enable operation from ready to switch on does transitions 3 and 4.
TABLE = {
    (P.SWITCH_ON_DISABLED, SHUTDOWN): P.READY_TO_SWITCH_ON,  # 2
    (P.SWITCH_ON_DISABLED, SWITCH_ON): P.SWITCH_ON_DISABLED,
    (P.SWITCH_ON_DISABLED, ENABLE): P.SWITCH_ON_DISABLED,
    (P.SWITCH_ON_DISABLED, DISABLE_VOLTAGE): P.SWITCH_ON_DISABLED,
    (P.SWITCH_ON_DISABLED, QUICK_STOP): P.SWITCH_ON_DISABLED,
    (P.READY_TO_SWITCH_ON, SHUTDOWN): P.READY_TO_SWITCH_ON,
    (P.READY_TO_SWITCH_ON, SWITCH_ON): P.SWITCHED_ON,  # 3
    (P.READY_TO_SWITCH_ON, ENABLE): P.OPERATION_ENABLED,  # 3 + 4
    (P.READY_TO_SWITCH_ON, DISABLE_VOLTAGE): P.SWITCH_ON_DISABLED,  # 7
    (P.READY_TO_SWITCH_ON, QUICK_STOP): P.SWITCH_ON_DISABLED,  # 7
    (P.SWITCHED_ON, SHUTDOWN): P.READY_TO_SWITCH_ON,  # 6
    (P.SWITCHED_ON, SWITCH_ON): P.SWITCHED_ON,
    (P.SWITCHED_ON, ENABLE): P.OPERATION_ENABLED,  # 4
    (P.SWITCHED_ON, DISABLE_VOLTAGE): P.SWITCH_ON_DISABLED,  # 10
    (P.SWITCHED_ON, QUICK_STOP): P.SWITCH_ON_DISABLED,  # 10
    (P.OPERATION_ENABLED, SHUTDOWN): P.READY_TO_SWITCH_ON,  # 8
    (P.OPERATION_ENABLED, SWITCH_ON): P.SWITCHED_ON,  # 5
    (P.OPERATION_ENABLED, ENABLE): P.OPERATION_ENABLED,
    (P.OPERATION_ENABLED, DISABLE_VOLTAGE): P.SWITCH_ON_DISABLED,  # 9
    (P.OPERATION_ENABLED, QUICK_STOP): P.QUICK_STOP_ACTIVE,  # 11
    (P.QUICK_STOP_ACTIVE, SHUTDOWN): P.QUICK_STOP_ACTIVE,
    (P.QUICK_STOP_ACTIVE, SWITCH_ON): P.QUICK_STOP_ACTIVE,
    (P.QUICK_STOP_ACTIVE, ENABLE): P.OPERATION_ENABLED,  # 16
    (P.QUICK_STOP_ACTIVE, DISABLE_VOLTAGE): P.SWITCH_ON_DISABLED,  # 12
    (P.QUICK_STOP_ACTIVE, QUICK_STOP): P.QUICK_STOP_ACTIVE,
}


@pytest.mark.parametrize(("state", "word"), TABLE)
def test_a_controlword_leads_where_the_standard_says(state: P, word: int) -> None:
    machine = StateMachine()
    machine.state = state
    machine.control(word)
    assert machine.state is TABLE[state, word]


@pytest.mark.parametrize("state", [P.FAULT, P.FAULT_REACTION])
def test_no_controlword_without_bit_7_leads_out_of_a_fault(state: P) -> None:
    machine = StateMachine()
    machine.state = state
    for word in range(0x80):
        machine.control(word)
        assert machine.state is state, word


@pytest.mark.parametrize("state", [s for s in P if s not in (P.FAULT, P.FAULT_REACTION, P.NOT_READY)])
def test_a_fault_runs_through_its_reaction_and_is_reset_by_an_edge(state: P) -> None:
    machine = StateMachine()
    machine.state = state
    machine.fault()
    assert machine.state is P.FAULT_REACTION
    machine.control(0x80)
    assert machine.state is P.FAULT_REACTION
    machine.step()
    assert machine.state is P.FAULT
    assert not machine.control(0x80)  # bit 7 was set already
    assert not machine.control(0x00)
    assert machine.control(0x80)
    assert machine.state is P.SWITCH_ON_DISABLED


def test_quick_stop_ends_disabled_or_stays_as_its_option_says() -> None:
    for option in range(9):
        machine = StateMachine()
        machine.quick_stop_option = option
        machine.state = P.QUICK_STOP_ACTIVE
        machine.step()
        assert machine.state is (P.QUICK_STOP_ACTIVE if option >= 5 else P.SWITCH_ON_DISABLED), option
