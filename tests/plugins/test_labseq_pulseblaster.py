"""Lines on a PulseBlaster: the driver, and SpinCore's functions on a simulated board below it."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_pulseblaster import emergency
from labseq_pulseblaster.library import InstalledLibrary
from labseq_pulseblaster.lines import PulseBlasterLines
from labseq_pulseblaster.models import SHORT_PULSE_BITS, Code
from labseq_pulseblaster.settings import PulseBlasterSettings
from labseq_pulseblaster_sim import SimulatedLibrary
from labseq_pulseblaster_sim.access import Spinapi
from labseq_pulseblaster_sim.board import Board

from labseq import LineProgram, LineSpec, Run, Session
from labseq.cli import main
from labseq.errors import ConfigError, DeviceError, DeviceTimeoutError, LimitError
from labseq.plugin import Context
from labseq.sequencer.lines import line_program
from labseq.testing import LinesContract
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation
from tests.profiles import virtual_without_lines

SPECS = LinesContract.specs
NAMES = tuple(spec.name for spec in SPECS)
ACTIVE_LOW = 1 << 6


def settings(model: str = "PB24-100-4k", **given: Any) -> PulseBlasterSettings:
    return PulseBlasterSettings.model_validate({"driver": "simulated", "model": model, **given})


class TestLines(LinesContract):
    @pytest.fixture(params=["PB24-100-4k", "PBESR-PRO-500"])
    def factory(self, request: pytest.FixtureRequest) -> Callable[[Context], PulseBlasterLines]:
        return partial(PulseBlasterLines, settings(request.param))


class Lab:
    """A driver on a simulated board, what the simulation received, and the board."""

    def __init__(self, specs: tuple[LineSpec, ...] = SPECS, model: str = "PB24-100-4k", **given: Any) -> None:
        self.clock = FakeClock()
        self.world = RecordingSimulation(Calls(self.clock))
        self.lines = PulseBlasterLines(
            settings(model, **given),
            Context("lines", clock=self.clock, simulation=self.world, lines=specs),
        )

    @property
    def board(self) -> Board:
        library = self.lines._library
        assert isinstance(library, SimulatedLibrary)
        return library.board

    @property
    def played(self) -> list[LineProgram]:
        return [call.args[1] for call in self.world.calls if call.method == "play"]

    def play(self, program: LineProgram) -> None:
        self.lines.compile(program)
        self.lines.arm()
        self.lines.fire()


@contextmanager
def lab(**given: Any) -> Generator[Lab]:
    made = Lab(**given)
    made.lines.open()
    try:
        yield made
    finally:
        with suppress(DeviceError):
            made.lines.close()


@given(
    st.lists(st.tuples(st.integers(5, 10**10), st.integers(1, 2**5 - 1)), max_size=30),
    st.sampled_from(["PB24-100-4k", "PBESR-PRO-500"]),
    st.booleans(),
)
def test_the_outputs_play_any_program(
    steps: list[tuple[int, int]], model: str, external_trigger: bool
) -> None:
    ticks, states = [0], [np.zeros(5, np.bool_)]
    for n_ticks, change in steps:
        ticks.append(ticks[-1] + n_ticks)
        states.append(states[-1] ^ np.array([bool(change >> i & 1) for i in range(5)]))
    with lab(model=model, external_trigger=external_trigger) as here:
        t_s = np.array(ticks) * here.lines.lines_facts.resolution_s
        program = LineProgram("image", NAMES, t_s, np.array(states), 0.0, float(t_s[-1]))
        here.play(program)
        np.testing.assert_allclose(here.played[-1].t_s, program.t_s, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(here.played[-1].on, program.on)
        here.lines.wait(float(t_s[-1]) + 1.0)
        with pytest.raises(DeviceError, match="call arm"):
            here.lines.fire()


def test_a_program_that_the_board_holds_is_not_written_again() -> None:
    with lab() as here:
        for duration_s, is_same in ((10e-3, False), (10e-3, True), (11e-3, False)):
            before = here.board.program
            here.play(line_program(SPECS, "image", duration_s))
            here.lines.wait(1.0)
            assert (here.board.program is before) == is_same


def test_a_program_with_a_trigger_holds_the_levels_before_it_while_it_waits() -> None:
    with lab(external_trigger=True) as here:
        here.lines.idle()
        idle = here.board.flags
        here.play(line_program(SPECS, "image", 10e-3))
        before, wait, *_ = here.board.program
        assert (before.flags, wait.flags, wait.code) == (idle, idle, Code.WAIT)
    with lab(external_trigger=True, faults={"no_edge": True}) as here:
        here.play(line_program(SPECS, "load", 10e-3))
        assert here.board.flags == ACTIVE_LOW
        with pytest.raises(DeviceTimeoutError, match="not ended after 30 ms; is there an edge at the"):
            here.lines.wait(30e-3)
        here.lines.safe_state()


def test_programs_that_the_board_cannot_play_are_refused() -> None:
    close = LineProgram(
        "image",
        ("light",),
        np.array([0.0, 1e-3, 1.00004e-3]),
        np.array([[False], [True], [False]]),
        0.0,
        2e-3,
    )
    with lab(specs=(LineSpec("light", 0, ("image",)),)) as here:
        text = r"edge of 'light' at 1\.00004 ms is 40 ns; the limit is at least 50 ns; change a lead"
        with pytest.raises(LimitError, match=text):
            here.lines.check_program(close)
        n_edges = 4094
        many = LineProgram(
            "load",
            ("light",),
            np.arange(n_edges, dtype=np.float64) * 1e-6,
            np.arange(n_edges)[:, None] % 2 == 1,
            0.0,
            1.0,
        )
        with pytest.raises(LimitError, match="number of instructions is 4094; the limit is at most 4093"):
            here.lines.compile(many)
        fitting = LineProgram("load", ("light",), many.t_s[:-1], many.on[1:], 0.0, 1.0)
        here.lines.compile(fitting)


@pytest.mark.parametrize(
    ("channel", "model"), [(24, "PB24-100-4k"), (21, "PBESR-PRO-500"), ("D/a", "PB24-100-32k")]
)
def test_outputs_that_the_board_does_not_have_are_refused(channel: int | str, model: str) -> None:
    with pytest.raises(ConfigError, match=f"'a' is on channel {channel}; expected the number of an output"):
        Lab((LineSpec("a", channel),), model)


@pytest.mark.parametrize(
    ("faults", "text"),
    [
        ({"missing": True}, "there is no board 1, since SpinAPI finds no board; check the cable"),
        ({"in_use": True}, "SpinAPI: pb_init: the board cannot be opened; another program may use it"),
    ],
)
def test_a_board_that_cannot_be_opened_is_named_every_time(faults: dict[str, Any], text: str) -> None:
    here = Lab(board_number=1, faults=faults)
    for _ in range(2):
        with pytest.raises(DeviceError, match=text):
            here.lines.open()
    here.lines.safe_state()
    here.lines.close()


def test_a_board_that_is_unplugged_is_an_error_of_every_call() -> None:
    with lab() as here:
        here.board._faults = settings(faults={"unplugged": True}).faults
        here.play(line_program(SPECS, "image", 10e-3))
        for call in (partial(here.lines.wait, 1.0), here.lines.safe_state, here.lines.close):
            with pytest.raises(DeviceError, match="the board does not answer"):
                call()
        here.lines.close()


@pytest.mark.parametrize(
    ("clock", "text"),
    [
        ("500 MHz", "faster than the clock of 'model', PB24-100-4k"),
        ("20 MHz", "is the board a PB24-"),
    ],
)
def test_the_self_test_finds_a_board_with_another_clock(clock: str, text: str) -> None:
    with lab() as here:
        here.lines.self_test()
    with lab(faults={"clock": clock}) as here, pytest.raises(DeviceError, match=text):
        here.lines.self_test()


def test_a_program_that_is_cut_ends_with_all_lines_off() -> None:
    with lab() as here:
        here.play(line_program(SPECS, "load", 20e-3))
        here.clock.sleep(5e-3)
        assert here.played[-1].on.any()
        here.lines.safe_state()
        assert not here.played[-1].on[-1].any()
        assert here.board.flags == ACTIVE_LOW
        assert here.board.program[-1].code == Code.BRANCH  # which never ends


def writing(spinapi: Spinapi) -> None:
    spinapi.pb_core_clock(100.0)
    assert spinapi.pb_start_programming(0) == 0


def written(spinapi: Spinapi) -> None:
    writing(spinapi)
    assert spinapi.pb_inst_pbonly(1, Code.CONTINUE, 0, 1000.0) == 0
    assert spinapi.pb_inst_pbonly(1, Code.STOP, 0, 1000.0) == 1
    assert spinapi.pb_stop_programming() == 0


def after(*steps: Callable[[Spinapi], object]) -> Callable[[Spinapi], object]:
    return lambda spinapi: [step(spinapi) for step in steps][-1]


def instruction(*arguments: float) -> Callable[[Spinapi], object]:
    return lambda spinapi: spinapi.pb_inst_pbonly(*arguments)  # pyright: ignore[reportArgumentType]


SPINAPI_REFUSES: dict[str, tuple[str, Callable[[Spinapi], object]]] = {
    "an instruction outside of a program": ("call pb_start_programming", instruction(1, 0, 0, 1000.0)),
    "the end of no program": ("call pb_start_programming", Spinapi.pb_stop_programming),
    "a program before the clock": ("call pb_core_clock", lambda spinapi: spinapi.pb_start_programming(0)),
    "too short an instruction": ("at least 5", after(writing, instruction(1, Code.CONTINUE, 0, 40.0))),
    "too long an instruction": ("at most 4294967295", after(writing, instruction(1, 0, 0, 43e9))),
    "one repetition": ("long delay of 1", after(writing, instruction(1, Code.LONG_DELAY, 1, 100.0))),
    "an unknown instruction": ("no instruction 12", after(writing, instruction(1, 12, 0, 100.0))),
    "too many flags": ("more than 24 bits", after(writing, instruction(1 << 24, 0, 0, 100.0))),
    "a branch to nowhere": ("branch to instruction 7", after(writing, instruction(1, Code.BRANCH, 7, 100.0))),
    "WAIT at once": ("a longer instruction before", after(writing, instruction(1, Code.WAIT, 0, 100.0))),
    "a full memory": ("room for 4096", after(writing, *[instruction(1, 0, 0, 100.0)] * 4097)),
    "a program without an end": (
        "does not end with STOP",
        after(writing, instruction(1, 0, 0, 100.0), Spinapi.pb_stop_programming),
    ),
    "a start without a program": ("no program", Spinapi.pb_start),
    "a start of half a program": ("no program", after(writing, Spinapi.pb_start)),
    "a start without a reset": ("call pb_reset", after(written, Spinapi.pb_start, Spinapi.pb_start)),
    "a new program while one plays": ("call pb_stop", after(written, Spinapi.pb_start, writing)),
    "another board": ("no board 1", lambda spinapi: spinapi.pb_select_board(1)),
    "a closed board": ("call pb_init", after(Spinapi.pb_close, Spinapi.pb_read_status)),
}


@pytest.mark.parametrize("what", SPINAPI_REFUSES)
def test_the_simulator_refuses_what_the_manual_forbids(what: str) -> None:
    text, call = SPINAPI_REFUSES[what]
    spinapi = Spinapi(Lab().board)
    assert spinapi.pb_init() == 0
    with suppress(AssertionError):  # of a step on the way, which is refused itself
        assert call(spinapi) == -1
    assert text in spinapi.pb_get_error().decode()


def test_outputs_of_an_esr_pro_are_low_without_the_bits_of_the_short_pulses() -> None:
    with lab(model="PBESR-PRO-500") as here:
        here.lines.idle()
        assert here.board.flags & SHORT_PULSE_BITS == SHORT_PULSE_BITS
        emergency.hold(Spinapi(here.board), here.board.flags & ~SHORT_PULSE_BITS)
        assert here.played[-1].on[-1].tolist() == [spec.active_low for spec in SPECS]


def test_the_watchdog_stops_a_program_and_holds_the_levels_for_off(monkeypatch: pytest.MonkeyPatch) -> None:
    with lab(model="PBESR-PRO-300") as here:
        here.lines._library = InstalledLibrary()
        script = here.lines.emergency()
        assert script is not None
        arguments = json.loads(json.dumps(dict(script.arguments)))
    with lab(model="PBESR-PRO-300") as here:
        monkeypatch.setattr(emergency, "load", lambda: Spinapi(here.board))
        emergency.prepare(**arguments)
        here.play(line_program(SPECS, "load", 20e-3))
        here.clock.sleep(1e-3)
        assert emergency.off(**arguments) == "PulseBlaster 0 holds the flags 0xe00040"
        assert not here.played[-1].on.any()
        here.board.n_boards = 0
        with pytest.raises(emergency.SpinapiError, match="pb_select_board: there is no board 0"):
            emergency.off(**arguments)


ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
LINES = """
lines:
  USE
  channels:
    cooling: {channel: 2, on: [load, rearrange, wait, image, idle]}
    mot: {channel: 3, on: [load], lag: 2 ms}
    imaging: {channel: 4, on: [image], lead: 1 ms, lag: 1 ms}
    shutter: {channel: 6, on: [image], lead: 3 ms, lag: 2 ms, active_low: true}
  mutually_exclusive: [[mot, imaging]]
"""
LIGHTS = """\
simulation:
  use: virtual
  lights: {loading: [mot], cooling: [cooling], imaging: [imaging, shutter]}
"""
PULSEBLASTER = "use: pulseblaster\n  model: PB24-100-4k\n  driver: "


def profile(folder: Path, use: str) -> Path:
    path = folder / "profile.yaml"
    text = virtual_without_lines().replace("simulation:\n  use: virtual\n", LIGHTS)
    assert LIGHTS in text
    path.write_text(text + LINES.replace("USE", use))
    return path


def run(path: Path, dry_run: Literal["off", "fast"] = "off") -> Run:
    output = path.parent / "run"
    with Session.open(SEQUENCE, profile=path, shots=1, seed=1, output=output, dry_run=dry_run) as session:
        return session.run()


def test_a_run_with_a_simulated_board_fills_as_one_with_virtual_lines(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    expected = run(profile(tmp_path_factory.mktemp("virtual"), "use: virtual"))
    modes: dict[str, Literal["off", "fast"]] = {"simulated": "off", "installed": "fast"}
    for driver, dry_run in modes.items():
        result = run(profile(tmp_path_factory.mktemp(driver), PULSEBLASTER + driver), dry_run)
        for shot, wanted in zip(result.shots, expected.shots, strict=True):
            np.testing.assert_array_equal(shot.occupancies, wanted.occupancies)
            assert shot.occupancies[0].sum() > 200, "no light where light is needed"


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("missing: true", "there is no board 0, since SpinAPI finds no board; check the cable"),
        ("in_use: true", "the board cannot be opened; another program may use it"),
        ("clock: 500 MHz", "the board's clock is faster than the clock of 'model', PB24-100-4k"),
    ],
)
def test_labseq_devices_finds_what_is_wrong(
    fault: str, text: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = profile(tmp_path, PULSEBLASTER + "simulated")
    for exit_code, wanted in ((0, "PB24-100-4k"), (3, text)):
        with pytest.raises(SystemExit) as left:
            main(["devices", str(path)])
        printed = capfd.readouterr()
        assert left.value.code == exit_code
        assert wanted in " ".join((printed.out + printed.err).split())
        path.write_text(path.read_text() + f"  faults: {{{fault}}}\n")


def test_without_spinapi_the_message_says_where_to_get_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        main(["devices", str(profile(tmp_path, PULSEBLASTER + "installed"))])
    assert left.value.code == 3
    printed = capfd.readouterr()
    assert "install SpinAPI from spincore.com" in " ".join((printed.out + printed.err).split())
