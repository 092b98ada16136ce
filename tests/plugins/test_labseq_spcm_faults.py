"""The Spectrum driver: wrong cards, settings and programs, safe state, and faults that it works around."""

from __future__ import annotations

import gc
import subprocess
import sys
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
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
from labseq_spcm.library import VendorLibrary, load_spcm
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.play_sequence import SequenceReplay
from labseq_spcm.replay_fifo import Fifo, Replay
from labseq_spcm.settings import SpcmSettings
from labseq_spcm.stream import Stream
from labseq_spcm_sim import M4I6631, SimulatedCard, SimulatedLibrary, vendor_library_found

from labseq.plugin import Context, DeviceError, DeviceTimeoutError, LabseqError, LimitError, MotionSpec
from labseq.plugin.messages import install_hint
from labseq.plugin.motion import RfSpec
from labseq.testing.fakes import FakeClock

from .small_run import run

MODES = ["replay", "sequence", "fifo", "stream"]
TRIGGERED = ["replay", "sequence", "fifo"]


def context(motion: MotionSpec | None = None) -> Context:
    return Context("mobile_tweezers", clock=FakeClock(), motion=motion or MotionSpec())


class TestCards:
    def test_that_are_unknown_are_named_with_the_drivers_reason(self, driver: Any) -> None:
        with driver():  # so that there is a driver library
            tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated-none"), context())
            with pytest.raises(DeviceError, match=r"'simulated-none': .*no such card; look up its name"):
                tweezers.open()

    def test_in_use_are_named_and_not_disturbed(self, driver: Any) -> None:
        with driver() as lab:
            other = SpcmMobileTweezers(lab.settings, context())
            with pytest.raises(DeviceError, match=r"in use; .*close other programs"):
                other.open()
            other.close()
            lab.play(lab.program())

    def test_of_another_family_are_refused(self, driver: Any) -> None:
        digitizer = replace(M4I6631, name="M4i.4420-x8", card_type=0x74420)
        text = r"a M4i\.4420-x8 .* name a Spectrum M4i\.66xx, .*`card`"
        with pytest.raises(DeviceError, match=text), driver(model=digitizer):
            pass

    def test_that_are_too_slow_are_refused(self, driver: Any) -> None:
        slow = replace(M4I6631, name="M4i.6622-x8", sample_rate_hz=(50e6, 625e6))
        text = r"M4i\.6622-x8 makes 50 to 625 MS/s, but sample_rate is 1000 MHz"
        with pytest.raises(DeviceError, match=text), driver(model=slow, sample_rate=1e9):
            pass

    def test_that_were_refused_are_left_closed_with_their_outputs_off(self, driver: Any) -> None:
        with driver() as lab:
            lab.tweezers.close()
            wrong = SpcmMobileTweezers(SpcmSettings(card=lab.settings.card, serial=99), context())
            with pytest.raises(DeviceError):
                wrong.open()
            assert lab.card.outputs_on == (False, False)
            lab.tweezers.open()
            lab.play(lab.program())


@pytest.mark.parametrize(("mode", "timeout_s"), [("replay", 0.0), ("sequence", 0.0), ("fifo", 50e-3)])
def test_a_trigger_that_never_comes_times_out_into_the_safe_state(
    driver: Any, mode: str, timeout_s: float
) -> None:
    with driver(mode, trigger="external") as lab:
        lab.tweezers.prepare(lab.program())
        lab.tweezers.play()
        with pytest.raises(DeviceTimeoutError, match=r"no trigger came .* the cable at Ext0"):
            lab.tweezers.wait(timeout_s)
        assert not lab.card.running
        assert lab.card.outputs_on == (False, False)
        lab.tweezers.prepare(lab.program())


@pytest.mark.parametrize(
    ("mode", "player"),
    [("replay", Replay), ("sequence", SequenceReplay), ("fifo", Fifo), ("stream", Stream)],
)
def test_a_wait_during_which_another_thread_makes_the_card_safe_is_no_end_of_the_program(
    driver: Any, mode: str, player: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    finished = player.finished
    with driver(mode) as lab:
        lab.tweezers.prepare(lab.program())
        lab.tweezers.play()

        def after_safe_state(self: Any) -> bool:
            lab.tweezers.safe_state()
            return finished(self)

        monkeypatch.setattr(player, "finished", after_safe_state)
        with pytest.raises(DeviceError, match=r"stopped by safe_state\(\) while it played"):
            lab.tweezers.wait(1.0)
        assert lab.card.outputs_on == (False, False)


class TestSettings:
    @pytest.mark.parametrize(
        ("full_scale_v", "max_peak_v", "text"),
        [
            (2.6, 3.0, "2500 mV"),
            (0.05, 2.0, "80 mV"),
            (0.42, 2.0, "relay"),
            (0.48, 2.0, "relay"),
            (1.0, 0.5, "max_peak"),
        ],
    )
    def test_amplitudes_that_card_or_amplifiers_cannot_do_are_refused(
        self, full_scale_v: float, max_peak_v: float, text: str
    ) -> None:
        motion = MotionSpec(rf=RfSpec(full_scale_v=full_scale_v, max_peak_v=max_peak_v))
        with pytest.raises(LimitError, match=text):
            SpcmMobileTweezers(SpcmSettings(card="simulated"), context(motion))


def test_a_program_beyond_the_limits_is_refused_before_anything_is_uploaded(driver: Any) -> None:
    with driver() as lab:
        program = lab.program()
        low = replace(program, row=replace(program.row, start_hz=program.row.start_hz - 20e6))
        lab.card.log.clear()
        for wrong, text in ((low, "the AOD's band, 82 to 118 MHz"), (lab.program(0), "length")):
            with pytest.raises(LimitError, match=text):
                lab.tweezers.prepare(wrong)
        assert not list(lab.card.log)
        with pytest.raises(DeviceError, match="without a prepared program"):
            lab.tweezers.play()


def test_a_program_longer_than_the_memory_is_refused(driver: Any) -> None:
    small = replace(M4I6631, memory_samples=2 * 2**16)
    with (
        driver(model=small) as lab,
        pytest.raises(LimitError, match=r"\(the card's memory\); use `mode: fifo`"),
    ):
        lab.tweezers.prepare(lab.program())


AMP0, TIMEOUT = 30010, 295130


@pytest.fixture
def unraisable(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What finalizers raise."""
    seen: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda raised: seen.append(raised.exc_value))
    return seen


ANOTHER_PROCESS = """
import sys
import labseq_spcm
from labseq.registry import Registry
labseq_spcm.labseq_register(Registry())
assert not {"labseq_spcm_sim", "numba", "matplotlib"} & sys.modules.keys()
from labseq.plugin import Context, LabseqError
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings
tweezers = SpcmMobileTweezers(SpcmSettings(card="simulated"), Context("mobile_tweezers"))
assert "spcm_core" not in sys.modules
tweezers.warm()
assert "spcm_core" in sys.modules
assert not {"spcm", "matplotlib"} & sys.modules.keys()
tweezers.open()
tweezers.close()
print("warm")
for card in sys.argv[1:]:
    tweezers = SpcmMobileTweezers(SpcmSettings(card=card), Context("mobile_tweezers"))
    try:
        tweezers.open()
    except LabseqError as error:
        print(error.exit_code, error)
    tweezers.close()
"""


@pytest.fixture(scope="module")
def another_process() -> subprocess.CompletedProcess[str]:
    """A process that warms the driver, then opens cards; the real one only where it cannot be there."""
    real = [] if vendor_library_found() else ["/dev/spcm0"]
    command = [sys.executable, "-c", ANOTHER_PROCESS, *real, "simulated", *real]
    return subprocess.run(command, capture_output=True, text=True, check=False)


class TestFaultsOfThePackage:
    def test_a_closed_card_is_not_closed_again_by_the_garbage_collector(
        self, driver: Any, unraisable: list[object]
    ) -> None:
        gc.collect()
        unraisable.clear()  # what other tests left behind
        with driver() as lab:
            lab.card.write(AMP0, 9000)  # also with an error pending
        gc.collect()
        assert not unraisable

    def test_it_is_imported_when_warming_and_prints_nothing(
        self, another_process: subprocess.CompletedProcess[str]
    ) -> None:
        assert (another_process.returncode, another_process.stderr) == (0, "")
        n_refusals = 0 if vendor_library_found() else 2
        assert another_process.stdout.count("\n") == 1 + n_refusals


@pytest.mark.skipif(vendor_library_found(), reason="the vendor's library is installed here")
def test_opening_without_the_library_names_the_package_and_the_simulated_card(
    another_process: subprocess.CompletedProcess[str],
) -> None:
    """Before a simulated card was opened in the same process, and after."""
    before, after = another_process.stdout.splitlines()[1:]
    for line in (before, after):
        assert line.startswith("3 mobile_tweezers: ")
        assert "`card: simulated`" in line


def test_a_package_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "spcm_core", None)
    hint = install_hint("", "spcm_core")
    with pytest.raises(DeviceError, match=rf"'spcm_core' cannot be imported .*; install it with {hint}$"):
        load_spcm("mobile_tweezers", VendorLibrary("/dev/spcm0"))


def test_closing_goes_through_even_if_the_card_is_broken(driver: Any) -> None:
    with driver() as lab:
        lab.card.break_down("for this test")
        lab.tweezers.close()
        with pytest.raises(LabseqError, match="not open"):
            lab.tweezers.play()


@pytest.mark.parametrize(
    "mobile",
    [
        "{use: spcm, card: simulated, mode: replay, sample_rate: 250 MHz}",
        "{use: spcm, card: simulated, mode: sequence, sample_rate: 250 MHz}",
        "{use: spcm, card: simulated, mode: fifo, sample_rate: 250 MHz}",
    ],
)
def test_a_simulated_card_plays_in_virtual_time_from_the_edge_of_a_line_on(
    tmp_path: Path, mobile: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    edges: list[tuple[bool, float]] = []
    trigger_at = SimulatedCard.trigger_at

    def watched(card: SimulatedCard, time_s: float) -> None:
        edges.append((card._machine.trigger_enabled, time_s))
        trigger_at(card, time_s)

    monkeypatch.setattr(SimulatedCard, "trigger_at", watched)
    done = run(tmp_path, mobile=mobile + LINE)
    assert (done.status, done.simulated, len(done.shots)) == ("complete", True, 1)
    assert [is_armed for is_armed, _ in edges] == [True]


LINE = (
    "\nlines: {use: virtual, channels: {awg: {channel: 7, on: [rearrange], pulse: 0.1 ms, "
    "triggers: mobile_tweezers}}}"
)


@pytest.mark.parametrize("mode", ["replay", "sequence"])
@pytest.mark.parametrize(
    ("n_edges", "text"),
    [
        (0, "no trigger came .* cable at Ext0 and trigger_level"),
        (2, r"ended \d+ us too early, .* second edge"),
    ],
)
def test_a_cable_with_no_edge_or_two_ends_the_run_with_the_outputs_off(
    tmp_path: Path, n_edges: int, text: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    cards: list[Any] = []
    play = SpcmMobileTweezers.play

    def disturbed(tweezers: SpcmMobileTweezers) -> None:
        play(tweezers)
        assert isinstance(tweezers.library, SimulatedLibrary)
        cards.append(tweezers.library.card)
        if n_edges == 2:
            cards[0].trigger()
            tweezers._clock.sleep(1e-3)

    monkeypatch.setattr(SpcmMobileTweezers, "play", disturbed)
    if n_edges == 0:
        monkeypatch.setattr(SimulatedCard, "trigger_at", lambda *_: None)
    with pytest.raises(DeviceError, match=text) as raised:
        run(tmp_path, mobile=f"{{use: spcm, card: simulated, mode: {mode}, sample_rate: 250 MHz}}{LINE}")
    assert (raised.value.device, raised.value.exit_code) == ("mobile_tweezers", 3)
    assert (cards[0].running, cards[0].outputs_on) == (False, (False, False))


@pytest.mark.parametrize(
    ("mobile", "exit_code", "text"),
    [
        ("serial: 99", 3, "12345, not 99"),
        ("sample_rate: 755 MHz", 2, "p.yaml:6:60: sample_rate: .* gap"),
        ("sample_rate: 150 MHz", 2, "sample_rate is 150 MHz; .* 236 MHz"),
        ("sample_rate: .nan", 2, "p.yaml:6:60: sample_rate is .nan; expected a finite"),
        ("mode: fifo, sample_rate: 1 GHz", 2, "the bus carries at most 700 MHz"),
        ("mode: stream, sample_rate: 1 GHz", 2, "the bus carries at most 700 MHz"),
        ("mode: stream, trigger: external", 2, "no external trigger"),
        ("mode: stream, look_ahead: 0.1 ms", 2, "look_ahead is 100 us; expected at least 184"),
        ("mode: stream, notify_size: 5000", 2, "notify_size is 5000; expected a power of two"),
        ("mode: stream, card_buffer: 65536", 2, "at least twice notify_size, 131072"),
        (f"mode: stream}}{LINE[:-1]}", 2, "a line triggers it, but `mode: stream`"),
        (
            "mode: replay, keep_warm: {row_frequency: 82 MHz, column_frequency: 118 MHz}",
            2,
            "keep_warm is set, but `mode: replay` leaves the AODs dark",
        ),
        ("rf: {full_scale: 3 V}", 2, "rf.full_scale is 3 V; .* 80 mV"),
    ],
)
def test_mistakes_are_reported_with_what_is_expected(
    tmp_path: Path, mobile: str, exit_code: int, text: str
) -> None:
    with pytest.raises(LabseqError, match=text) as raised:
        run(tmp_path, mobile=f"{{use: spcm, card: simulated, {mobile}}}")
    assert raised.value.exit_code == exit_code


class TestSafeState:
    @pytest.mark.parametrize("mode", MODES)
    def test_ramps_down_stops_and_opens_the_output_relays(self, driver: Any, mode: str) -> None:
        with driver(mode) as lab:
            lab.tweezers.prepare(lab.program(20))
            lab.tweezers.play()
            lab.clock.sleep(0.6e-3)
            lab.card.log.clear()
            lab.tweezers.safe_state()
            levels = lab.written(AMP0)
            ramp = levels[:-1]  # then the amplitude is set again, with the output off
            assert ramp == sorted(ramp, reverse=True)
            assert len(ramp) > 10
            at_s = [entry.time_s for entry in lab.card.log if entry.register == AMP0][: len(ramp)]
            assert 0.2e-3 < at_s[-1] - at_s[0] < 0.4e-3, "slow against the swing of the atoms, and soon over"
            assert min(ramp) == 481
            assert levels[-1] == 1600
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)
            lab.card.log.clear()
            lab.tweezers.safe_state()
            assert set(lab.written(AMP0)) == {1600}, "there is nothing to ramp down"

    def test_ramps_to_the_least_amplitude_where_no_relay_is_in_the_way(self, driver: Any) -> None:
        with driver(motion=MotionSpec(rf=RfSpec(full_scale_v=0.3))) as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            lab.tweezers.safe_state()
            assert min(lab.written(AMP0)) == 80

    def test_works_when_an_error_locks_the_driver(self, driver: Any) -> None:
        with driver() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            assert lab.card.write(AMP0, 9000) == 0x101  # somebody else's mistake
            lab.tweezers.safe_state()
            assert not lab.card.running
            assert lab.card.outputs_on == (False, False)

    def test_an_output_that_cannot_be_switched_off_is_reported_and_the_other_one_is_off(
        self, driver: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with driver() as lab:
            lab.tweezers.prepare(lab.program())
            lab.tweezers.play()
            card = lab.tweezers._card
            set_register = card.set

            def broken(register: int, *arguments: Any) -> int:
                if register == card.spcm.SPC_ENABLEOUT0:
                    raise DeviceError("mobile_tweezers", "output 0 is broken")
                return set_register(register, *arguments)

            with monkeypatch.context() as patch:
                patch.setattr(card, "set", broken)
                with pytest.raises(DeviceError, match="output 0 is broken"):
                    lab.tweezers.safe_state()
            assert lab.card.outputs_on == (True, False)
            assert not lab.card.running

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
            silent_s = 70e-6 if mode == "stream" else 1e-6  # to the end of a block
            assert spans[-1].end_s - spans[0].start_s <= program.total_duration_s + silent_s


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
        self.is_open = self.safe = self.idle = True
        self.streams = mode in ("sequence", "stream")  # it plays silence between programs

    @rule(n_batches=st.sampled_from([1, 2, 24]))
    def prepare(self, n_batches: int) -> None:
        with suppress(LabseqError):
            self.safe = False
            self.idle = self.idle and not self.streams
            self.lab.tweezers.prepare(self.lab.program(n_batches))

    @rule()
    def play(self) -> None:
        with suppress(LabseqError):
            self.safe = self.idle = False
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
        self.safe = self.idle = True

    @rule()
    def close(self) -> None:
        self.lab.tweezers.close()
        self.safe, self.idle, self.is_open = True, True, False

    @precondition(lambda self: self.safe)
    @rule()
    def open(self) -> None:
        self.lab.tweezers.open()
        self.is_open = True

    @invariant()
    def nothing_plays_in_the_safe_state(self) -> None:
        if self.safe:
            assert self.lab.card.outputs_on == (False, False)
        if self.idle:
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
            self.safe = self.idle = True
            self.nothing_plays_in_the_safe_state()
            self.lab.clock.sleep(1.0)
            late = [
                span for channel in (0, 1) for span in self.lab.card.played(channel) if span.end_s > now_s
            ]
            assert not late
        finally:
            self.stack.close()


@pytest.mark.parametrize(
    ("mode", "trigger"),
    [*((mode, "software") for mode in MODES), *((mode, "external") for mode in TRIGGERED)],
)
def test_any_calls_end_in_silence(driver: Any, mode: str, trigger: str) -> None:
    few = settings(max_examples=8, stateful_step_count=20)
    run_state_machine_as_test(lambda: Calls(driver, mode, trigger), settings=few)  # type: ignore[no-untyped-call]
