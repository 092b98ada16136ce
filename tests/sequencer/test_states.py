import pytest

from labseq.sequencer.run import TRANSITIONS, State, StateTable


def test_every_state_is_declared():
    assert set(TRANSITIONS) == set(State)


def test_every_open_state_leads_to_safety():
    after_safety = {State.CLOSED, State.MAKING_SAFE, State.SAFE, State.CLOSING}
    for state in set(State) - after_safety:
        assert State.MAKING_SAFE in TRANSITIONS[state], state


def test_devices_are_never_closed_before_they_are_safe():
    before_closing = {state for state, then in TRANSITIONS.items() if State.CLOSING in then}
    assert before_closing == {State.SAFE}


def test_an_undeclared_change_is_refused():
    seen: list[State] = []
    table = StateTable(seen.append)
    with pytest.raises(AssertionError, match="cannot go from closed to shot"):
        table.to(State.SHOT)
    table.to(State.OPENING)
    assert seen == [State.OPENING]
