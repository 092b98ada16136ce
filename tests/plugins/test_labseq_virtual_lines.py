"""The virtual timing box, and what its lines do to the simulated atoms."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labseq_virtual.devices import VirtualLines
from labseq_virtual.settings import LightSettings, LinesSettings, SimulationSettings
from labseq_virtual.simulation import Lights, VirtualSimulation

import labseq
from labseq.errors import ConfigError
from labseq.model import LineProgram, LineSpec, RandomStream, SiteGrid
from labseq.roles import Context
from labseq.sequencer.lines import line_program
from labseq.testing import LinesContract
from labseq.testing.fakes import FakeClock

ROOT = Path(__file__).parents[2]
SPECS = (
    LineSpec("cooling", 2, frozenset({"load", "rearrange", "idle"})),
    LineSpec("mot", 3, frozenset({"load"})),
    LineSpec("imaging", 4, frozenset({"image"}), lead_s=1e-3),
    LineSpec("repump", 5, frozenset({"image"})),
    LineSpec("camera_trigger", 6, frozenset({"image"}), pulse_s=1e-3, triggers="camera"),
)
NEEDS = LightSettings(loading=("mot",), cooling=("cooling",), imaging=("imaging", "repump"))


class TestVirtualLines(LinesContract):
    @pytest.fixture
    def factory(self):
        return partial(VirtualLines, LinesSettings())


def fire(lights: Lights, kind: str, duration_s: float, t_s: float) -> LineProgram:
    program = line_program(SPECS, kind, duration_s)
    lights.switch(program, t_s)
    return program


def test_without_lines_all_light_is_on() -> None:
    lights = Lights(NEEDS, ())
    assert lights.fraction_on("imaging", 0.0, 1.0) == 1.0


def test_light_that_needs_no_line_is_always_on() -> None:
    lights = Lights(LightSettings(), SPECS)
    fire(lights, "load", 0.1, 0.0)
    assert lights.fraction_on("imaging", 0.0, 0.1) == 1.0


def test_light_needs_all_of_its_lines() -> None:
    lights = Lights(NEEDS, SPECS)
    fire(lights, "image", 10e-3, 5.0)
    assert lights.fraction_on("imaging", 5.0, 5.001) == pytest.approx(0.0)  # imaging leads, repump does not
    assert lights.fraction_on("imaging", 5.001, 5.011) == pytest.approx(1.0)
    assert lights.fraction_on("imaging", 5.006, 5.016) == pytest.approx(0.5)
    assert lights.fraction_on("loading", 5.001, 5.011) == 0.0


def test_idle_lines_stay_on_between_steps() -> None:
    lights = Lights(NEEDS, SPECS)
    fire(lights, "load", 0.1, 0.0)
    fire(lights, "image", 0.1, 1.0)
    assert lights.fraction_on("cooling", 0.0, 1.0) == 1.0
    assert lights.fraction_on("cooling", 1.0, 1.101) == 0.0
    assert lights.fraction_on("cooling", 1.2, 9.0) == 1.0


def test_a_line_that_nobody_declared_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"`lights.loading` names a line 'mott'; the profile has 'cooling'"):
        Lights(LightSettings(loading=("mott",)), SPECS)


def test_an_edge_reaches_what_is_wired_to_it() -> None:
    lights, seen = Lights(NEEDS, SPECS), list[float]()
    lights.wire("camera", seen.append)
    fire(lights, "image", 10e-3, 2.0)
    fire(lights, "load", 10e-3, 3.0)
    assert seen == [pytest.approx(2.001)]


class Lit:
    """A world with lines."""

    def __init__(self, **settings: Any) -> None:
        self.clock = FakeClock()
        self.context = Context(
            "simulation", SiteGrid(), clock=self.clock, random=RandomStream(3), lines=SPECS
        )
        self.world = VirtualSimulation(SimulationSettings(lights=NEEDS, **settings), self.context)
        self.world.open()
        self.world.play("static_tweezers", labseq.DepthRamp(0.0, 1.0), 0.0)
        self.context.random.begin_shot(0, 0)
        self.world.begin_shot()
        self.t_s = 0.0

    def fire(self, kind: str, duration_s: float) -> None:
        self.t_s += 1.0
        self.world.play("lines", line_program(SPECS, kind, duration_s), self.t_s)

    def n_atoms(self) -> int:
        return int(np.count_nonzero(self.world.truth()))


def loaded(kind: str) -> int:
    lit = Lit()
    lit.fire(kind, 0.5)
    lit.world.load(lit.t_s, 0.5)
    return lit.n_atoms()


def test_without_the_mot_nothing_loads() -> None:
    assert loaded("wait") == 0
    assert 250 < loaded("load") < 350


def frame(kind: str) -> tuple[int, int]:
    """Pixels that shine brighter than noise does, and atoms lost to imaging."""
    lit = Lit()
    lit.fire("load", 0.5)
    lit.world.load(lit.t_s, 0.5)
    lit.fire(kind, 45e-3)
    image = lit.world.expose(lit.t_s + 1e-3, 45e-3).image
    return int(np.count_nonzero(image > 800)), int(lit.world.losses()["imaging"])


def test_without_imaging_light_a_frame_is_dark_and_no_atom_is_lost_to_it() -> None:
    dark, n_lost_in_the_dark = frame("wait")
    bright, _ = frame("image")
    assert dark < 30 < 10 * dark < bright
    assert n_lost_in_the_dark == 0


PROFILE = (ROOT / "hardware_profiles" / "virtual.yaml").read_text("utf-8")
LINES = """
lines:
  use: virtual
  channels:
    cooling: {channel: 2, on: [load, rearrange, idle]}
    mot: {channel: 3, on: [load], lag: 5 ms, blinding: true}
    imaging: {channel: 4, on: [image], lead: 0.2 ms}
    camera_trigger: {channel: 6, on: [image], pulse: 1 ms, triggers: camera}
"""
MOVED = ("simulation.lost.transport", "simulation.lost.hand_over")
LIT = "simulation:\n  lights: {loading: [mot], cooling: [cooling], imaging: [imaging]}\n"


def run(tmp_path: Path, lines: str, *overrides: str, shots: int = 4) -> labseq.Run:
    tmp_path.mkdir(exist_ok=True)
    profile = tmp_path / "lined.yaml"
    profile.write_text(PROFILE.replace("simulation:\n", LIT) + lines, "utf-8")
    with labseq.Session.open(
        ROOT / "sequences" / "compact_225.yaml",
        profile=str(profile),
        shots=shots,
        seed=5,
        overrides=["record_frames=none", *overrides],
        output=tmp_path / "data",
    ) as session:
        return session.run()


def test_a_run_without_molasses_in_the_moves_loses_more_atoms(tmp_path: Path) -> None:
    lit = run(tmp_path / "a", LINES)
    dark = run(tmp_path / "b", LINES.replace("[load, rearrange, idle]", "[load, idle]"))
    n_cool, n_hot = (
        sum(n for shot in one.shots for cause, n in shot.readings.items() if cause in MOVED)
        for one in (lit, dark)
    )
    assert n_hot > 1.8 * n_cool > 0


def test_the_trigger_line_starts_the_exposures(tmp_path: Path) -> None:
    made = run(tmp_path / "a", LINES, shots=1).shots[0]
    by_software = run(tmp_path / "b", LINES.replace(", triggers: camera", ""), shots=1).shots[0]
    assert made.filling_fraction > 0.9
    assert np.array_equal(made.occupancies, by_software.occupancies)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "on: [load], lag",
            "on: [laod], lag",
            r"lined.yaml:\d+:\d+: there is no kind of step 'laod'.*'load'",
        ),
        ("channel: 3", "channel: 2", "'cooling' and 'mot' are both on channel 2"),
        ("channel: 3", "channel: 77", "the box has no channel 77"),
        ("lag: 5 ms", "pulse: 1 ms, lag: 5 ms", "lag is set beside pulse"),
        ("on: [image], pulse", "on: [load], pulse", "a line that triggers the camera is on at other times"),
        (
            "  channels:",
            "  mutually_exclusive: [[mot, cooling]]\n  channels:",
            "'mot' and 'cooling' must never be on together, but both are during 'load'",
        ),
        ("  channels:", "  mutually_exclusive: [[mot, x]]\n  channels:", "there is no line 'x'"),
        ("  use: virtual", "  use: virtuel", "unknown lines 'virtuel'"),
    ],
)
def test_wrong_lines_are_told_with_their_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        run(tmp_path / "x", LINES.replace(old, new))
    assert all(problem.line > 0 for problem in caught.value.problems)


def test_a_blinding_line_in_an_exposure_with_em_gain_is_refused_before_the_run(tmp_path: Path) -> None:
    lines = LINES.replace("on: [load], lag", "on: [load, image], lag")
    with pytest.raises(ConfigError, match="'mot' is blinding and on during `image`, with an EM gain of 300"):
        run(tmp_path, lines, "profile.camera.em_gain=300")
