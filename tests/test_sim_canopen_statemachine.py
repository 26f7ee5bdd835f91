"""The CiA 402 state machine against the standard's table of transitions."""

import pytest

from sim.canopen.drive import PowerState as P
from sim.canopen.drive import StateMachine

WORDS = (0x06, 0x07, 0x0F, 0x00, 0x02)  # shutdown, switch on, enable operation, disable voltage, quick stop
STATES = {
    "D": P.SWITCH_ON_DISABLED, "R": P.READY_TO_SWITCH_ON, "S": P.SWITCHED_ON, "O": P.OPERATION_ENABLED,
    "Q": P.QUICK_STOP_ACTIVE,
}  # fmt: skip

TABLE = {  # where each of WORDS leads from a state
    (STATES[state], word): STATES[following]
    for state, row in {"D": "RDDDD", "R": "RSODD", "S": "RSODD", "O": "RSODQ", "Q": "QQODQ"}.items()
    for word, following in zip(WORDS, row, strict=True)
}


def machine(state):
    made = StateMachine()
    made.state = state
    return made


@pytest.mark.parametrize(("state", "word"), TABLE)
def test_a_controlword_leads_where_the_standard_says(state, word):
    made = machine(state)
    made.control(word)
    assert made.state is TABLE[state, word]


def test_quick_stop_ends_disabled_or_stays_as_its_option_says():
    for option in range(9):
        made = machine(P.QUICK_STOP_ACTIVE)
        made.quick_stop_option = option
        made.step()
        assert made.state is (P.QUICK_STOP_ACTIVE if option >= 5 else P.SWITCH_ON_DISABLED), option
