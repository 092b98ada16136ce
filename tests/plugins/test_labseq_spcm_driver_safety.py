"""The Spectrum driver's safe state: from any state of the card, and after any calls."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Any

import pytest
from hypothesis import settings, strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from labseq import DeviceError, LabseqError, MotionSpec, RfSpec

AMP0 = 30010
MODES = ["replay", "fifo", "dds"]


class TestSafeState:
    @pytest.mark.parametrize("mode", MODES)
    def test_ramps_down_stops_and_opens_the_output_relays(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.clock.sleep(0.6e-3)
            lab.card.log.clear()
            lab.tweezers.safe_state()
            levels = lab.written(AMP0)
            ramp = levels[:-1]  # then the amplitude is set again, with the output off
            assert ramp == sorted(ramp, reverse=True)
            assert len(ramp) > 10
            assert min(ramp) == 481
            assert levels[-1] == 1600
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)

    def test_ramps_to_the_least_amplitude_where_no_relay_is_in_the_way(self, driver: Any) -> None:
        with driver(motion=MotionSpec(rf=RfSpec(full_scale_v=0.3))) as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            assert min(lab.written(AMP0)) == 80

    def test_twice_ramps_only_once(self, driver: Any) -> None:
        with driver() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            lab.card.log.clear()
            lab.tweezers.safe_state()
            assert set(lab.written(AMP0)) == {1600}
            assert lab.card.outputs_on == (False, False)

    def test_works_when_an_error_locks_the_driver(self, driver: Any) -> None:
        with driver() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            assert lab.card.write(AMP0, 9000) == 0x101  # somebody else's mistake
            lab.tweezers.safe_state()
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)

    def test_the_output_path_is_never_switched_while_the_outputs_are_on(self, driver: Any) -> None:
        with driver() as lab:
            lab.play(lab.program())
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            assert not [value for value in lab.written(AMP0) if value <= 480]

    def test_drops_what_was_prepared(self, driver: Any) -> None:
        with driver() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.safe_state()
            with pytest.raises(DeviceError, match="without a prepared program"):
                lab.tweezers.play()

    @pytest.mark.parametrize("mode", MODES)
    def test_nothing_of_the_old_program_is_played_after_it(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            lab.tweezers.prepare(lab.program(6))
            lab.tweezers.play()
            lab.clock.sleep(1e-3)
            lab.tweezers.safe_state()
            lab.card.forget(lab.clock.now() + 1.0)
            lab.clock.sleep(0.1)
            program = lab.program(1)
            lab.play(program)
            spans = lab.card.played(0)
            assert spans[-1].end_s - spans[0].start_s <= program.total_duration_s + 1e-6


class Calls(RuleBasedStateMachine):
    """Calls of the driver in any order; what it refuses it refuses with an error of its own.

    Args:
        driver: Opens it on a simulated card.
        mode: Its mode.
        trigger: What starts a program.
    """

    def __init__(self, driver: Any, mode: str, trigger: str) -> None:
        super().__init__()
        self.stack = ExitStack()
        self.lab = self.stack.enter_context(driver(mode, trigger=trigger, fill=1e-3))
        self.is_open = self.safe = True

    @rule(n_batches=st.sampled_from([1, 2, 24]))
    def prepare(self, n_batches: int) -> None:
        with suppress(LabseqError):
            self.lab.tweezers.prepare(self.lab.program(n_batches))

    @rule()
    def play(self) -> None:
        with suppress(LabseqError):
            self.safe = False
            self.lab.tweezers.play()

    @rule(timeout_s=st.sampled_from([0.0, 0.3e-3, 5e-3, 1.0]))
    def wait(self, timeout_s: float) -> None:
        with suppress(LabseqError):
            self.lab.tweezers.wait(timeout_s)

    @rule(duration_s=st.sampled_from([1e-6, 0.3e-3, 3e-3, 0.1]))
    def let_time_pass(self, duration_s: float) -> None:
        self.lab.clock.sleep(duration_s)

    @rule()
    def trigger(self) -> None:
        self.lab.card.trigger()

    @precondition(lambda self: self.is_open)
    @rule(write=st.sampled_from([(AMP0, 9000), (12345, 1), (100, 1 << 16)]))
    def lock_the_driver(self, write: tuple[int, int]) -> None:
        """By a value, a register, and a transfer that it refuses."""
        self.lab.card.write(*write)

    @rule(n_times=st.sampled_from([1, 2]))
    def make_safe(self, n_times: int) -> None:
        for _ in range(n_times):
            self.lab.tweezers.safe_state()
        self.safe = True

    @rule()
    def close(self) -> None:
        self.lab.tweezers.close()
        self.safe, self.is_open = True, False

    @precondition(lambda self: self.safe)
    @rule()
    def open(self) -> None:
        self.lab.tweezers.open()
        self.is_open = True

    @invariant()
    def nothing_plays_in_the_safe_state(self) -> None:
        if self.safe:
            assert self.lab.card.outputs_on == (False, False)
            assert not self.lab.card.running

    @invariant()
    def the_output_path_is_never_switched_while_an_output_is_on(self) -> None:
        changes = self.lab.card._machine.amplifiers[0].changes
        assert not [1 for _, volts in changes if volts and not 0.48 < volts <= 1.6]

    def teardown(self) -> None:
        try:
            self.lab.tweezers.safe_state()
            self.lab.tweezers.safe_state()
            now_s = self.lab.clock.now()
            self.safe = True
            self.nothing_plays_in_the_safe_state()
            self.lab.clock.sleep(1.0)
            late = [
                span for channel in (0, 1) for span in self.lab.card.played(channel) if span.end_s > now_s
            ]
            assert not late
        finally:
            self.stack.close()


@pytest.mark.parametrize("trigger", ["software", "external"])
@pytest.mark.parametrize("mode", MODES)
def test_any_calls_end_in_silence(driver: Any, mode: str, trigger: str) -> None:
    few = settings(max_examples=15, stateful_step_count=20)
    run_state_machine_as_test(lambda: Calls(driver, mode, trigger), settings=few)  # type: ignore[no-untyped-call]
