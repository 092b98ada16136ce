"""Lines on NI-DAQmx: the driver, and NI's own Python package, on simulated cards below it."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_nidaqmx import emergency
from labseq_nidaqmx.library import InstalledLibrary
from labseq_nidaqmx.lines import NidaqmxLines
from labseq_nidaqmx.outputs import output_groups, sample_counts
from labseq_nidaqmx.settings import LevelSettings, NidaqmxSettings
from labseq_nidaqmx_sim import SimulatedLibrary
from labseq_nidaqmx_sim.access import Functions
from labseq_nidaqmx_sim.tasks import Computer

from labseq import LineProgram, LineSpec, Run, Session
from labseq.cli import main
from labseq.errors import ConfigError, DeviceError, DeviceTimeoutError, LimitError
from labseq.plugin import Context
from labseq.sequencer.lines import line_program
from labseq.testing import LinesContract
from labseq.testing.fakes import Calls, FakeClock, RecordingSimulation
from tests.profiles import virtual_without_lines

pytestmark = pytest.mark.needs("nidaqmx")

SPECS = (
    LineSpec("cooling", "Dev1/port0/line2", ("load", "rearrange", "idle")),
    LineSpec("mot", "Dev1/port0/line10", ("load",), lag_s=2e-3, blinding=True),
    LineSpec("imaging", "Dev1/ao0", ("image",), lead_s=1e-3, lag_s=0.5e-3),
    LineSpec("camera", "Dev1/port0/line5", ("image",), pulse_s=0.2e-3, triggers="camera"),
    LineSpec("shutter", "Dev2/port0/line31", ("image",), lead_s=2e-3, active_low=True),
)
LEVELS = {"imaging": {"on": "3.2 V", "off": "0.1 V"}}


def settings(**given: Any) -> NidaqmxSettings:
    return NidaqmxSettings.model_validate({"driver": "simulated", "levels": LEVELS, **given})


class TestLines(LinesContract):
    specs = SPECS

    @pytest.fixture
    def factory(self) -> Callable[[Context], NidaqmxLines]:
        return partial(NidaqmxLines, settings(rate="100 kHz"))


class Lab:
    """A driver on simulated cards, what the simulation received, and the computer with the cards."""

    def __init__(self, specs: tuple[LineSpec, ...] = SPECS, **given: Any) -> None:
        self.clock = FakeClock()
        self.world = RecordingSimulation(Calls(self.clock))
        context = Context("lines", clock=self.clock, simulation=self.world, lines=specs)
        self.specs = specs
        self.lines = NidaqmxLines(settings(**given), context)

    @property
    def computer(self) -> Computer:
        library = self.lines._library
        assert isinstance(library, SimulatedLibrary)
        return library.computer

    @property
    def played(self) -> list[LineProgram]:
        return [call.args[1] for call in self.world.calls if call.method == "play"]

    def fire(self, kind: str = "image", duration_s: float = 10e-3) -> LineProgram:
        program = line_program(self.specs, kind, duration_s)
        self.lines.compile(program)
        self.lines.arm()
        self.lines.fire()
        return program


@contextmanager
def lab(*specs: LineSpec, **given: Any) -> Generator[Lab]:
    made = Lab(specs or SPECS, **given)
    made.lines.open()
    try:
        yield made
    finally:
        with suppress(DeviceError):
            made.lines.close()


ONE = LineSpec("light", "Dev1/port0/line0", ("image",))


@given(
    st.lists(st.tuples(st.integers(1, 1000), st.integers(1, 2**5 - 1)), max_size=30),
    st.sampled_from([1e5, 1e6]),
)
def test_the_outputs_play_any_program(steps: list[tuple[int, int]], rate_hz: float) -> None:
    ticks, states = [0], [np.zeros(5, np.bool_)]
    for n_samples, change in steps:
        ticks.append(ticks[-1] + n_samples)
        states.append(states[-1] ^ np.array([bool(change >> i & 1) for i in range(5)]))
    names = tuple(spec.name for spec in SPECS)
    t_s = np.array(ticks) / rate_hz
    program = LineProgram("image", names, t_s, np.array(states), 0.0, float(t_s[-1]))
    with lab(rate=rate_hz) as here:
        here.lines.compile(program)
        here.lines.arm()
        here.lines.fire()
        played = here.played[-1]
        np.testing.assert_allclose(played.t_s, program.t_s, atol=1e-12)
        np.testing.assert_array_equal(played.on, program.on)
        here.lines.wait(1.0)
        levels = here.computer.outputs.levels
        on = dict(zip(names, program.on[-1].tolist(), strict=True))
        assert levels["dev1/ao0"] == (3.2 if on["imaging"] else 0.1)
        assert levels["dev2/port0/line31"] == (not on["shutter"])


def test_a_program_that_the_cards_hold_is_not_written_again() -> None:
    with lab() as here:
        here.fire()
        here.lines.wait(1.0)
        tasks = list(here.computer.tasks)
        here.fire()
        here.lines.wait(1.0)
        assert list(here.computer.tasks) == tasks
        assert len(tasks) == 3  # analogue and digital outputs of Dev1, digital ones of Dev2
        here.fire(duration_s=11e-3)
        assert not set(tasks) & set(here.computer.tasks)


def test_edges_in_one_sample_and_programs_that_fill_the_memory_are_refused() -> None:
    on = np.array([[False], [True], [False]])
    close = LineProgram("image", ("light",), np.array([0.0, 1e-3, 1.0003e-3]), on, 0.0, 2e-3)
    with pytest.raises(
        LimitError, match=r"edge of 'light' at 1\.0003 ms is 300 ns; .* a sample, 1 us; .*'rate'"
    ):
        sample_counts(close, 1e6, "lines")
    long = LineProgram("load", ("light",), np.zeros(1), on[:1], 0.0, 100.0)
    with pytest.raises(
        LimitError, match="duration is 100 s; the limit is at most 30 s at this 'rate'; a lower rate"
    ):
        sample_counts(long, 1e6, "lines")


@pytest.mark.parametrize(
    ("spec", "levels", "text"),
    [
        (LineSpec("a", 4), {}, "'a' is on channel 4; expected a name of NI's such as Dev1/port0/line3"),
        (LineSpec("a", "Dev1/port0/line32"), {}, "expected a name of NI's"),
        (LineSpec("a", "Dev1/ao1"), {}, r"has no 'levels'; expected `levels: \{a: \{on: 3.3 V"),
        (LineSpec("a", "Dev1/ao1", active_low=True), {"a": 1.0}, "'active_low', which is for digital lines"),
        (LineSpec("a", "Dev1/port0/line0"), {"a": 1.0}, "is digital, but has 'levels'"),
        (LineSpec("a", "Dev1/port0/line0"), {"b": 1.0}, "'levels' has 'b', which is not a line"),
    ],
)
def test_wrong_outputs_are_refused(spec: LineSpec, levels: dict[str, float], text: str) -> None:
    given_levels = {name: LevelSettings(on=on) for name, on in levels.items()}
    with pytest.raises(ConfigError, match=text):
        output_groups((spec,), given_levels, "lines")


@pytest.mark.parametrize(
    ("channel", "given", "error", "text"),
    [
        ("Dev1/port1/line0", {}, DeviceError, "Dev1/port1/line0 of this PCIe-6363 has no hardware timing"),
        (
            "Dev1/port0/line0",
            {"faults": {"card": "USB-6008"}},
            DeviceError,
            "USB-6008 has no hardware timing",
        ),
        ("Dev1/ao0", {"faults": {"card": "USB-6008"}}, DeviceError, "Dev1/ao0 of this USB-6008 has no hard"),
        (
            "Dev1/port0/line0",
            {"rate": "20 MHz"},
            LimitError,
            "Dev1/do of this PCIe-6363, is 20 MHz; .* 10 MHz",
        ),
        (
            "Dev1/port0/line0",
            {"faults": {"missing": True}},
            DeviceError,
            "no card 'Dev1'; expected a card, but none",
        ),
        (
            "Dev1/port0/line0",
            {"faults": {"in_use": True}},
            DeviceError,
            r"\(-50103\); close the other program",
        ),
        ("Dev1/port7/line0", {}, DeviceError, r"no such physical channel.*\(-200170\)"),
        ("Dev1/ao7", {}, DeviceError, r"no such physical channel.*\(-200170\)"),
    ],
)
def test_cards_that_cannot_play_the_lines_are_refused_and_can_be_opened_again(
    channel: str, given: dict[str, Any], error: type[Exception], text: str
) -> None:
    levels = {"light": {"on": 5.0}} if "ao" in channel else {}
    here = Lab((LineSpec("light", channel, ("image",)),), **{"levels": levels, **given})
    for _ in range(2):
        with pytest.raises(error, match=text):
            here.lines.open()
    here.lines.safe_state()
    here.lines.close()


def test_levels_beyond_the_range_of_the_card_are_refused() -> None:
    here = Lab((LineSpec("light", "Dev1/ao0"),), levels={"light": {"on": "11 V"}})
    with pytest.raises(DeviceError, match=r"range 0 V to 11 V of Dev1/ao0 \(-200077\)"):
        here.lines.open()


def test_a_card_without_a_clock_for_its_lines_takes_that_of_an_analogue_output() -> None:
    text = r"\(-200303\); put a line on an analogue output, whose clock the digital lines"
    with lab(ONE, levels={}, faults={"card": "PCI-6259"}) as here, pytest.raises(DeviceError, match=text):
        here.fire()
    power = LineSpec("power", "Dev1/ao1", ("image",))
    with lab(ONE, power, levels={"power": {"on": 1.0}}, faults={"card": "PCI-6259"}) as here:
        program = here.fire()
        here.lines.wait(1.0)
        np.testing.assert_allclose(here.played[-1].t_s, program.t_s)


def test_a_card_that_runs_out_of_samples_ends_the_program_with_all_lines_safe() -> None:
    with lab(faults={"underflow": "5 ms"}) as here:
        here.fire("load", 20e-3)
        assert here.played[-1].duration_s == pytest.approx(5e-3)
        with pytest.raises(DeviceError, match=r"NI-DAQmx: .*\(-200621\); lower `rate`"):
            here.lines.wait(1.0)
        here.lines.safe_state()
        assert not here.played[-1].on.any()
        with pytest.raises(DeviceError, match="call compile"):
            here.lines.arm()


def test_an_edge_that_never_comes_ends_in_a_timeout_that_names_its_terminal() -> None:
    with lab(trigger="/Dev1/PFI0", faults={"no_edge": True}) as here:
        here.fire()
        with pytest.raises(DeviceTimeoutError, match="not ended after 30 ms; is there an edge at /Dev1/PFI0"):
            here.lines.wait(30e-3)
        here.lines.safe_state()
    with lab(trigger="/Dev1/PFI0") as here:
        here.fire()
        here.lines.wait(30e-3)
    with (
        lab(trigger="/Dev1/PFI99") as here,
        pytest.raises(DeviceError, match=r"no such terminal.*\(-89120\)"),
    ):
        here.fire()


def test_a_card_that_is_unplugged_is_an_error_of_every_call() -> None:
    with lab(faults={"unplugged": True}) as here:
        here.fire()
        for call in (partial(here.lines.wait, 1.0), here.lines.safe_state, here.lines.close):
            with pytest.raises(DeviceError, match=r"\(-201003\); check the cable"):
                call()
        here.lines.close()


def test_a_program_that_is_cut_leaves_the_outputs_as_they_are_until_they_are_written() -> None:
    with lab() as here:
        here.fire("load", 20e-3)
        here.clock.sleep(5e-3)
        here.lines.safe_state()
        held, *_, off = here.played[-5:]
        assert held.on[-1].any()
        assert not off.on.any()


def timed(task: Any, n_samples: int, rate_hz: float = 1e3) -> None:
    task.timing.cfg_samp_clk_timing(rate_hz, samps_per_chan=n_samples)


def write(task: Any, n_samples: int, *, auto_start: bool = False) -> None:
    writers: Any = importlib.import_module("nidaqmx.stream_writers")
    writer = writers.DigitalMultiChannelWriter(task.out_stream, auto_start)
    writer.write_many_sample_port_uint32(np.zeros((1, n_samples), np.uint32))


def started(task: Any) -> None:
    timed(task, 5)
    write(task, 5)
    task.start()


def second(ni: Any, task: Any, lines: str) -> None:
    started(task)
    with ni.Task() as other:
        other.do_channels.add_do_chan(lines)
        started(other)


def cleared(ni: Any, task: Any) -> None:
    handle, interpreter = task._handle, task._interpreter
    with ni.Task():
        interpreter.clear_task(handle)
        try:
            interpreter.start_task(handle)
        finally:
            task._handle = None


NI_REFUSES: dict[str, tuple[int, Callable[[Any, Any], object]]] = {
    "a write of several samples without a clock": (-200217, lambda _, task: write(task, 5, auto_start=True)),
    "a write on demand to a task that does not run": (-200846, lambda _, task: write(task, 1)),
    "a start without samples": (-200462, lambda _, task: (timed(task, 5), task.start())),
    "a start of a running task": (-200479, lambda _, task: (started(task), task.start())),
    "a write to a running task": (-200288, lambda _, task: (started(task), write(task, 5))),
    "more samples than it generates": (-200288, lambda _, task: (timed(task, 5), write(task, 6))),
    "a buffer of one sample": (-200609, lambda _, task: (timed(task, 2), write(task, 1), task.start())),
    "timing of a running task": (-200479, lambda _, task: (started(task), timed(task, 5))),
    "a rate above the highest": (-200077, lambda _, task: (timed(task, 5, 20e6), write(task, 5))),
    "no such device": (-200220, lambda _, task: task.do_channels.add_do_chan("Dev9/port0/line0")),
    "no such line": (-200170, lambda _, task: task.do_channels.add_do_chan("Dev1/port0/line32")),
    "a line twice": (-200489, lambda _, task: task.do_channels.add_do_chan("Dev1/port0/line0")),
    "lines of another task": (-50103, lambda ni, task: second(ni, task, "Dev1/port0/line0:3")),
    "a second clock of the lines of a card": (-50103, lambda ni, task: second(ni, task, "Dev1/port0/line9")),
    "a wait that is too short": (-200560, lambda _, task: (started(task), task.wait_until_done(1e-6))),
    "a task that was cleared": (-200088, cleared),
}


@pytest.mark.parametrize("what", NI_REFUSES)
def test_the_simulator_refuses_what_ni_refuses(what: str) -> None:
    code, call = NI_REFUSES[what]
    here = Lab((ONE,), levels={})
    library = here.lines._library
    ni = library.load("lines")
    try:
        task = ni.Task()
        task.do_channels.add_do_chan("Dev1/port0/line0")
        with pytest.raises(ni.DaqError) as raised:
            call(ni, task)
        assert raised.value.error_code == code
        assert f"{code}" in str(raised.value)
        if task._handle is not None:
            task.close()
    finally:
        library.unload()


def test_a_task_that_is_stopped_early_is_started_again_from_its_first_sample() -> None:
    here = Lab((ONE,), levels={})
    library = here.lines._library
    ni = library.load("lines")
    try:
        with ni.Task() as task:
            task.do_channels.add_do_chan("Dev1/port0/line0")
            started(task)
            with pytest.warns(ni.DaqWarning, match="200010"):
                task.stop()
            task.start()
            task.wait_until_done(1.0)
            assert here.clock.now() == pytest.approx(5e-3)
    finally:
        library.unload()


def test_the_watchdog_writes_the_levels_for_off_and_resets_a_card_that_is_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with lab(faults={}) as here:
        found = InstalledLibrary().emergency(here.lines._groups)
        assert found is not None
        arguments = json.loads(json.dumps(dict(found.arguments)))
        library = Functions(here.computer)
        monkeypatch.setattr(emergency, "load", lambda: library)
        emergency.prepare(**arguments)
        here.fire("load", 20e-3)  # its tasks hold all outputs
        here.clock.sleep(1e-3)
        assert "3 outputs of NI-DAQmx written" in emergency.off(**arguments)
        assert not here.played[-1].on.any()
        here.computer.cards = ()
        with pytest.raises(emergency.EmergencyError, match=r"Dev1/ao0: .*\(-200220\); Dev1/port0/line2"):
            emergency.off(**arguments)


ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
LINES = """
lines:
  use: nidaqmx
  driver: DRIVER
  levels:
    imaging: {on: 3.2 V}
  channels:
    cooling: {channel: Dev1/port0/line2, on: [load, rearrange, wait, image, idle]}
    mot: {channel: Dev1/port0/line10, on: [load], lag: 2 ms}
    imaging: {channel: Dev1/ao0, on: [image], lead: 1 ms, lag: 1 ms}
    shutter: {channel: Dev1/port0/line4, on: [image], lead: 3 ms, lag: 2 ms, active_low: true}
  mutually_exclusive: [[mot, imaging]]
"""
LIGHTS = """\
simulation:
  use: virtual
  lights: {loading: [mot], cooling: [cooling], imaging: [imaging, shutter]}
"""


def profile(folder: Path, driver: str = "simulated", use: str = "nidaqmx") -> Path:
    path = folder / f"{use}.yaml"
    text = virtual_without_lines().replace("simulation:\n  use: virtual\n", LIGHTS)
    assert LIGHTS in text
    lines = LINES.replace("DRIVER", driver)
    if use == "virtual":
        lines = LINES.replace(
            "use: nidaqmx\n  driver: DRIVER\n  levels:\n    imaging: {on: 3.2 V}\n", "use: virtual\n"
        )
    path.write_text(text + lines)
    return path


def run(path: Path, dry_run: Literal["off", "fast", "full"] = "off") -> Run:
    output = path.parent / path.stem
    with Session.open(SEQUENCE, profile=path, shots=1, seed=1, output=output, dry_run=dry_run) as session:
        return session.run()


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(profile(tmp_path_factory.mktemp("virtual"), use="virtual"))


@pytest.mark.parametrize("dry_run", ["off", "full", "fast"])
def test_a_run_with_simulated_cards_fills_as_one_with_virtual_lines(
    dry_run: Literal["off", "fast", "full"], virtual: Run, tmp_path: Path
) -> None:
    result = run(profile(tmp_path, "simulated" if dry_run == "off" else "installed"), dry_run)
    for shot, expected in zip(result.shots, virtual.shots, strict=True):
        np.testing.assert_array_equal(shot.occupancies, expected.occupancies)
        assert shot.occupancies[0].sum() > 200, "no light where light is needed"


@pytest.mark.parametrize(
    ("set_to", "text"),
    [
        ("faults.card=USB-6008", "Dev1/ao0 of this USB-6008 has no hardware timing"),
        ("faults.in_use=true", "close the other program or task that uses these outputs"),
        ("faults.underflow=1ms", "ran out of samples, because the bus was too slow (-200621); lower `rate`"),
    ],
)
def test_labseq_devices_finds_what_is_wrong(
    set_to: str, text: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = profile(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(["devices", str(path)])
    assert left.value.code == 0
    assert "PCIe-6363" in capfd.readouterr().out
    path.write_text(path.read_text() + f"  faults: {{{set_to.removeprefix('faults.').replace('=', ': ')}}}\n")
    with pytest.raises(SystemExit) as left:
        main(["devices", str(path)])
    assert left.value.code == 3
    printed = capfd.readouterr()
    assert text in " ".join((printed.out + printed.err).split())


def test_without_ni_daqmx_the_message_says_where_to_get_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        main(["devices", str(profile(tmp_path, "installed"))])
    assert left.value.code == 3
    printed = capfd.readouterr()
    wanted = "NI-DAQmx is not installed, or not for this system; install it from ni.com/downloads"
    assert wanted in " ".join((printed.out + printed.err).split())
