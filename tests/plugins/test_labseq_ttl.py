"""The timing box: the driver and whole runs, with a model of the box and with its firmware."""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, strategies as st
from labseq_ttl.lines import TtlLines
from labseq_ttl.programs import MAX_EDGES, edges_of
from labseq_ttl.protocol import CHANNELS, SHORTEST, SLOTS, TICK_S, unframed
from labseq_ttl.settings import TtlSettings
from labseq_ttl_sim.access import as_played
from pydantic import ValidationError

from labseq import ConfigError, LineProgram, LineSpec, Run, Session
from labseq.errors import DeviceError, LimitError, StopRequested
from labseq.plugin import Context
from labseq.sequencer.lines import line_program
from labseq.testing import LinesContract
from tests.profiles import virtual_without_lines

from .labseq_ttl_rig import FIRMWARE, make_rig, rig, simulated_by


class TestModel(LinesContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], TtlLines]:
        return partial(TtlLines, TtlSettings())


@pytest.mark.needs("firmware")
class TestFirmware(LinesContract):
    @pytest.fixture
    def factory(self) -> Generator[Callable[[Context], TtlLines]]:
        with simulated_by("firmware"):
            yield partial(TtlLines, TtlSettings())


@pytest.mark.parametrize("box", ["model", FIRMWARE])
def test_the_self_test_changes_no_line(box: str) -> None:
    with rig(box=box) as lab:
        lab.lines.idle()
        n_played = len(lab.played)
        lab.lines.self_test()
        assert len(lab.played) == n_played
        assert lab.driver_box.state().on == 1 << 2  # cooling
        lab.fire()
        lab.lines.wait(1.0)


def test_a_known_program_is_sent_again_only_after_one_not_used_for_longest_gave_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with rig() as lab:
        sent: list[int] = []
        put = lab.driver_box.put
        monkeypatch.setattr(lab.driver_box, "put", lambda slot, edges: (sent.append(slot), put(slot, edges)))
        for n in (*range(SLOTS), 0, SLOTS, 0, 1, 2):
            lab.fire("image", 1e-3 * (n + 1))
            lab.lines.wait(1.0)
    assert sent == [*range(SLOTS), 1, 2, 3]


def two_edges_apart(apart_s: float) -> LineProgram:
    on = np.array([[False, True], [True, True], [True, False]])
    return LineProgram("image", ("a", "b"), np.array([0.0, 1e-3, 1e-3 + apart_s]), on, 0.0, 1.0)


TWO = (LineSpec("a", 2), LineSpec("b", 9))


def test_edges_too_near_and_pauses_too_long_are_refused() -> None:
    too_near = "lines: `image`: .*'a' at 1 ms and of 'b' at 1.003 ms is 3 us; .* at least 5 us"
    with pytest.raises(LimitError, match=too_near):
        edges_of(two_edges_apart(3e-6), TWO, "lines")
    edges_of(two_edges_apart(SHORTEST * TICK_S), TWO, "lines")
    with pytest.raises(LimitError, match="at most"):
        edges_of(two_edges_apart(3000.0), TWO, "lines")


@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(SHORTEST, 10**7), st.integers(1, 2**10 - 1))))
def test_programs_come_back_from_their_edges(seed: int, steps: list[tuple[int, int]]) -> None:
    specs = tuple(LineSpec(f"line {c}", c, active_low=c % 2 == 0) for c in CHANNELS)
    rng, state = np.random.default_rng(seed), np.zeros(10, np.bool_)
    t_s, on = [0.0], [state]
    for ticks, change in steps[: MAX_EDGES - 1]:
        t_s.append(t_s[-1] + ticks * TICK_S)
        on.append(on[-1] ^ np.array([bool(change >> i & 1) for i in range(10)]))
    names = tuple(spec.name for spec in specs)
    program = LineProgram("image", names, np.array(t_s), np.array(on), 0.0, t_s[-1] + rng.uniform(0, 1))
    edges = edges_of(program, specs, "lines")
    ticks = np.cumsum([ticks for ticks, _ in edges])
    back = as_played([(int(t), mask) for t, (_, mask) in zip(ticks, edges, strict=True)], program, specs)
    np.testing.assert_allclose(back.t_s, program.t_s, atol=1e-9)
    np.testing.assert_array_equal(back.on, program.on)


@given(st.binary(max_size=40))
def test_no_bytes_make_the_reader_of_lines_fail(line: bytes) -> None:
    said = unframed(line)
    assert said is None or isinstance(said, str)


def test_a_step_with_every_line_of_the_box_fits_its_edges() -> None:
    specs = [
        LineSpec(f"line_{i}", channel, ("image",), lead_s=1e-3 * (i + 1), lag_s=2e-3 * (i + 1))
        for i, channel in enumerate(CHANNELS)
    ]
    program = line_program(specs, "image", 45e-3)
    assert len(specs) == 10
    assert 2 * len(specs) <= len(edges_of(program, specs, "lines")) <= MAX_EDGES


def test_a_line_on_a_channel_that_the_box_does_not_have_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no channel 13 for 'mot'; .*'2', .*'12'"):
        make_rig((LineSpec("mot", 13),)).lines.open()


def test_a_simulated_box_has_no_external_start() -> None:
    with pytest.raises(ValidationError, match="no external start"):
        TtlSettings(start="external")
    assert TtlSettings(port="/dev/ttyACM0", start="external").start == "external"


def test_a_program_that_runs_is_waited_for_first() -> None:
    with rig() as lab:
        lab.fire("load", 0.1)
        for use in (lambda: lab.lines.compile(lab.program()), lab.lines.arm, lab.lines.self_test):
            with pytest.raises(DeviceError, match="while a program runs"):
                use()
        lab.lines.wait(1.0)
        lab.fire()


def test_a_wait_looks_for_a_request_to_stop() -> None:
    with rig() as lab:
        lab.fire("load", 0.1)
        lab.clock.stop.request()
        with pytest.raises(StopRequested):
            lab.lines.wait(1.0)
        with lab.clock.stop.held():
            lab.lines.safe_state()
            lab.lines.close()


ROOT = Path(__file__).parents[2]
SEQUENCE = ROOT / "sequences" / "compact_225.yaml"
LINES = """
lines:
  use: USE
  channels:
    cooling: {channel: 2, on: [load, rearrange, wait, image, idle]}
    mot: {channel: 3, on: [load], lag: 2 ms}
    imaging: {channel: 4, on: [image], lead: 1 ms, lag: 1 ms}
    shutter: {channel: 9, on: [image], lead: 3 ms, lag: 2 ms, active_low: true}
  mutually_exclusive: [[mot, imaging]]
"""
LIGHTS = "  lights: {loading: [mot], cooling: [cooling], imaging: [imaging, shutter]}\n"


def profile(folder: Path, use: str) -> str:
    """``virtual`` with lines."""
    path = folder / "with_lines.yaml"
    text = virtual_without_lines().replace(
        "simulation:\n  use: virtual\n", f"simulation:\n  use: virtual\n{LIGHTS}"
    )
    assert LIGHTS in text
    path.write_text(text + LINES.replace("USE", use))
    return str(path)


def run(folder: Path, use: str, dry_run: Literal["off", "full"] = "off") -> Run:
    folder.mkdir()
    with Session.open(
        SEQUENCE, profile=profile(folder, use), shots=1, seed=1, output=folder, dry_run=dry_run
    ) as session:
        return session.run()


WAYS: dict[str, tuple[str, Literal["off", "full"]]] = {
    "model": ("ttl\n  port: simulated", "off"),
    "dry run": ("ttl\n  port: /dev/ttyACM0\n  start: external", "full"),
    "firmware": ("ttl\n  port: simulated", "off"),
}


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run with virtual lines."""
    return run(tmp_path_factory.mktemp("virtual") / "run", "virtual")


@pytest.mark.parametrize("way", ["model", "dry run", FIRMWARE])
def test_a_simulated_box_switches_the_lines_as_the_virtual_one_does(
    way: str, virtual: Run, tmp_path: Path
) -> None:
    use, dry_run = WAYS[way]
    with simulated_by(way):
        simulated = run(tmp_path / "run", use, dry_run)
    assert simulated.simulated
    for one, expected in zip(simulated.shots, virtual.shots, strict=True):
        np.testing.assert_array_equal(one.occupancies, expected.occupancies)
        assert one.occupancies[0].sum() > 200, "no light where light is needed"
