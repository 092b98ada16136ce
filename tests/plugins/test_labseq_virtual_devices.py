"""The virtual tweezers, lines, instruments and spot meter; the contracts of all virtual drivers."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.devices import VirtualDevice, VirtualLines
from labseq_virtual.lights import Lights
from labseq_virtual.settings import (
    CameraSettings,
    DeviceSettings,
    LightSettings,
    LinesSettings,
    MobileTweezersSettings,
    SimulationSettings,
    SpotMeterSettings,
    StaticTweezersSettings,
)
from labseq_virtual.simulation import VirtualSimulation
from labseq_virtual.spot_meter import VirtualSpotMeter
from labseq_virtual.tweezers import VirtualMobileTweezers, VirtualStaticTweezers

import labseq
from labseq.model import AxisTones, LineProgram, LineSpec
from labseq.plugin import (
    ConfigError,
    Context,
    DepthRamp,
    DeviceError,
    LimitError,
    NeedsWarmUp,
    RandomStream,
    SiteGrid,
    ToneProgram,
    TweezerAmplitudes,
)
from labseq.sequencer.lines import line_program
from labseq.session.check import check
from labseq.testing import (
    CameraContract,
    DeviceContract,
    LinesContract,
    MobileTweezersContract,
    SimulationContract,
    StaticTweezersContract,
)
from labseq.testing.fakes import FakeClock, RecordingSimulation
from tests.profiles import virtual_without_lines


class TestVirtualCamera(CameraContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualCamera]:
        return partial(VirtualCamera, CameraSettings())


class TestVirtualCameraWithEverything(CameraContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualCamera]:
        settings = {
            "region": {"y": 10, "x": 20, "height": 100, "width": 60},
            "binning": 2,
            "em_gain": 300,
            "cooling": {"temperature": "-70 degC"},
        }
        return partial(VirtualCamera, CameraSettings.model_validate(settings))


class TestVirtualStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualStaticTweezers]:
        return partial(VirtualStaticTweezers, StaticTweezersSettings())


class TestVirtualMobileTweezers(MobileTweezersContract):
    def context(self) -> Context:
        return with_simulation(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualMobileTweezers]:
        return partial(VirtualMobileTweezers, MobileTweezersSettings())


class TestVirtualDevice(DeviceContract):
    commands: ClassVar = {"open": {}, "set": {"power": 0.5}}
    values: ClassVar = ("state", "power")

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualDevice]:
        return partial(VirtualDevice, DeviceSettings(commands=("open", "set"), values={"power": 1.0}))


class TestVirtualSimulation(SimulationContract):
    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualSimulation]:
        settings = {"image": {"frame": [80, 96], "centre_px": [39.5, 47.5]}}
        return partial(VirtualSimulation, SimulationSettings.model_validate(settings))


def with_simulation(context: Context) -> Context:
    return replace(context, simulation=VirtualSimulation(SimulationSettings(), context))


GRID = SiteGrid(2, 3)


class Lab:
    """A small virtual lab with all atoms loaded and nothing that loses them."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.random = RandomStream(0)
        physics = {"loading": 1.0, "lifetime": 2e6, "imaging_loss": 0.0, "transport_loss": 0.0}
        settings = SimulationSettings.model_validate(
            {**physics, "image": {"frame": (64, 64), "centre_px": (31.5, 31.5)}}
        )
        self.simulation = VirtualSimulation(
            settings, Context("simulation", GRID, clock=self.clock, random=self.random)
        )
        self.static = VirtualStaticTweezers(StaticTweezersSettings(), self.context("static_tweezers"))
        self.camera = VirtualCamera(CameraSettings(), self.context("camera"))
        self.mobile = VirtualMobileTweezers(MobileTweezersSettings(), self.context("mobile_tweezers"))
        self.simulation.open()
        self.simulation.begin_shot()
        for device in (self.static, self.camera, self.mobile):
            device.open()
        self.static.start()
        self.simulation.load(self.clock.now(), 0.5)
        self.clock.sleep(0.5)

    def context(self, name: str) -> Context:
        return Context(name, GRID, clock=self.clock, random=RandomStream(0, name), simulation=self.simulation)

    @property
    def n_atoms(self) -> int:
        return int(self.simulation.truth().sum())


@pytest.fixture
def lab() -> Lab:
    return Lab()


def axis(hz: list[float], amplitude: list[float]) -> AxisTones:
    """One tone in each of ``len(hz) - 1`` segments, through given frequencies and amplitudes."""
    n = len(hz) - 1
    offsets = np.arange(n + 1, dtype=np.int32)
    f, a = np.array(hz), np.array(amplitude)
    return AxisTones(offsets, f[:-1], f[1:], a[:-1], a[1:], np.zeros(n))


def program(
    row_hz: float = GRID.row_frequency_hz[0],
    col_hz: float = GRID.column_frequency_hz[0],
    end_hz: float = GRID.column_frequency_hz[2],
    amplitude: float = 0.05,
    duration_s: float = 1e-3,
) -> ToneProgram:
    """Take the atom at (0, 0) to (0, 2)."""
    return ToneProgram(
        axis([row_hz] * 4, [amplitude] * 4),
        axis([col_hz, col_hz, end_hz, end_hz], [0.0, amplitude, amplitude, 0.0]),
        np.full(3, duration_s),
        np.zeros(3, np.int8),
        np.array([0, 0, 1], np.int32),
    )


def test_static_tweezers_hold_atoms_until_they_are_made_safe(lab: Lab) -> None:
    assert lab.n_atoms == 6
    start_s = lab.clock.now()
    lab.static.ramp(0.5, 10e-3)
    assert lab.clock.now() - start_s == pytest.approx(10e-3)
    assert lab.static.describe()["depth"] == 0.5
    lab.static.start()
    assert lab.static.describe()["depth"] == 1.0
    assert lab.n_atoms == 6
    lab.static.safe_state()
    assert lab.n_atoms == 0
    assert lab.static.describe()["depth"] == 0.0


def test_what_exceeds_a_limit_is_refused_and_moves_nothing(lab: Lab) -> None:
    with pytest.raises(LimitError, match="static_tweezers: depth"):
        lab.static.ramp(2.0, 0.0)
    with pytest.raises(LimitError, match="sum of the column amplitudes"):
        lab.static.load((np.array([0.1, 0.1]), np.array([0.4] * 3)))
    with pytest.raises(LimitError, match=r"column tone 0 in segment 1 \(batch 0\) is 118\.1 MHz"):
        lab.mobile.prepare(program(end_hz=118.1e6))
    with pytest.raises(DeviceError, match="without a prepared program"):
        lab.mobile.play()
    assert lab.n_atoms == 6


def test_mobile_tweezers_carry_an_atom(lab: Lab) -> None:
    lab.simulation.truth()
    lab.simulation._atoms.occupied[0, 1:] = False
    assert lab.mobile.prepare(program()) == pytest.approx(3e-3)
    start_s = lab.clock.now()
    lab.mobile.play()
    assert lab.clock.now() == start_s
    lab.mobile.wait(1.0)
    assert lab.clock.now() - start_s == pytest.approx(3e-3)
    assert lab.simulation.truth().tolist() == [[False, False, True], [True, True, True]]
    lab.mobile.wait(1.0)
    assert lab.clock.now() - start_s == pytest.approx(3e-3)


def test_nothing_is_started_while_a_program_plays(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    with pytest.raises(DeviceError, match=r"play\(\) while a program plays"):
        lab.mobile.play()
    with pytest.raises(DeviceError, match=r"prepare\(\) while a program plays"):
        lab.mobile.prepare(program())


def test_a_camera_cannot_look_while_atoms_move(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.camera.arm(1, 10e-3, "software")
    with pytest.raises(DeviceError, match=r"mobile_tweezers\.wait"):
        lab.camera.trigger()


def test_the_safe_state_drops_atoms_in_flight(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.clock.sleep(1.2e-3)  # between two sites
    lab.mobile.safe_state()
    lab.mobile.safe_state()
    assert not lab.simulation.truth()[0, 0]
    assert lab.n_atoms == 5
    lab.mobile.prepare(program())


def test_virtual_hardware_needs_a_simulation() -> None:
    with pytest.raises(ConfigError, match=r"simulation: \{use: virtual\}"):
        VirtualCamera(CameraSettings(), Context("camera"))


def test_the_static_tweezers_refuse_calibrated_amplitudes_beyond_a_limit(lab: Lab) -> None:
    values = {
        f"{axis}_amplitudes": np.full(n, 0.6) for axis, n in zip(("row", "column"), GRID.shape, strict=True)
    }
    calibrations: Any = {"tweezers": SimpleNamespace(values=values)}
    context = replace(lab.context("static_tweezers"), calibrations=calibrations)
    static = VirtualStaticTweezers(StaticTweezersSettings(), context)
    static.open()
    with pytest.raises(DeviceError, match=r"calibrated amplitudes .* is 1\.2; .* 1"):
        static.self_test()


def test_the_self_test_names_a_site_out_of_reach(lab: Lab) -> None:
    settings = MobileTweezersSettings(band_half_width=1e6)
    mobile = VirtualMobileTweezers(settings, lab.context("mobile_tweezers"))
    mobile.open()
    with pytest.raises(DeviceError, match=r"column 0 is out of reach: .* 99 to"):
        mobile.self_test()


def test_no_kernel_is_left_to_be_compiled_by_the_first_image(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels = "labseq_virtual.flight_kernels"  # which takes longer than a camera may
    monkeypatch.delitem(sys.modules, kernels, raising=False)
    assert isinstance(lab.mobile, NeedsWarmUp)
    lab.mobile.warm()
    assert kernels in sys.modules


ROOT = Path(__file__).parents[2]
SPECS = (
    LineSpec("cooling", 2, ("load", "rearrange", "idle")),
    LineSpec("mot", 3, ("load",)),
    LineSpec("imaging", 4, ("image",), lead_s=1e-3),
    LineSpec("repump", 5, ("image",)),
    LineSpec("camera_trigger", 6, ("image",), pulse_s=1e-3, triggers="camera"),
)

NEEDS = LightSettings(loading=("mot",), cooling=("cooling",), imaging=("imaging", "repump"))


class TestVirtualLines(LinesContract):
    @pytest.fixture
    def factory(self):
        return partial(VirtualLines, LinesSettings())


def test_lines_are_not_fired_during_a_program() -> None:
    context = Context("lines", clock=FakeClock(), simulation=RecordingSimulation(), lines=SPECS)
    lines = VirtualLines(LinesSettings(), context)
    lines.open()
    lines.compile(line_program(SPECS, "load", 0.1))
    lines.arm()
    lines.fire()
    lines.arm()
    with pytest.raises(DeviceError, match="fired during a program that ends at"):
        lines.fire()
    lines.wait(1.0)
    lines.fire()


def fire(lights: Lights, kind: str, duration_s: float, t_s: float) -> LineProgram:
    program = line_program(SPECS, kind, duration_s)
    lights.switch(program, t_s)
    return program


def test_light_that_needs_no_line_is_always_on() -> None:
    assert Lights(NEEDS, ()).fraction_on("imaging", 0.0, 1.0) == 1.0
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


def test_an_undeclared_line_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"`lights.loading` .*'mott', but .*'cooling'"):
        Lights(LightSettings(loading=("mott",)), SPECS)


def test_an_edge_reaches_the_device_wired_to_it() -> None:
    lights, seen = Lights(NEEDS, SPECS), list[tuple[float, float]]()
    lights.wire("camera", lambda t_s, width_s: seen.append((t_s, width_s)))
    fire(lights, "image", 10e-3, 2.0)
    fire(lights, "load", 10e-3, 3.0)
    assert seen == [pytest.approx((2.001, 1e-3))]


def lit_simulation(load: str) -> VirtualSimulation:
    """A simulation with lines, after 0.5 s of loading while the lines are as in a kind of step."""
    context = Context("simulation", SiteGrid(), clock=FakeClock(), random=RandomStream(3), lines=SPECS)
    simulation = VirtualSimulation(SimulationSettings(lights=NEEDS), context)
    simulation.open()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    context.random.begin_shot(0, 0)
    simulation.begin_shot()
    simulation.play("lines", line_program(SPECS, load, 0.5), 1.0)
    simulation.load(1.0, 0.5)
    return simulation


def test_without_the_mot_nothing_loads() -> None:
    assert lit_simulation("wait").truth().sum() == 0
    assert 250 < lit_simulation("load").truth().sum() < 350


def test_without_imaging_light_a_frame_is_dark_and_no_atom_is_lost_to_it() -> None:
    n_bright: dict[str, int] = {}
    for kind in ("wait", "image"):
        simulation = lit_simulation("load")
        simulation.play("lines", line_program(SPECS, kind, 45e-3), 2.0)
        n_bright[kind] = int((simulation.expose(2.0 + 1e-3, 45e-3).image > 800).sum())
        if kind == "wait":
            assert simulation.losses()["imaging"] == 0
    assert n_bright["wait"] < 30 < 10 * n_bright["wait"] < n_bright["image"]


PROFILE = virtual_without_lines()
LINES = """
lines:
  use: virtual
  channels:
    cooling: {channel: 2, on: [load, rearrange, idle]}
    mot: {channel: 3, on: [load], lag: 5 ms, blinding: true}
    imaging: {channel: 4, on: [image], lead: 0.2 ms}
    camera_trigger: {channel: 6, on: [image], pulse: 1 ms, triggers: camera}
    awg_trigger: {channel: 7, on: [rearrange], pulse: 1 ms, triggers: mobile_tweezers}
"""

MOVED = ("simulation.lost.transport", "simulation.lost.hand_over")
LIT = "simulation:\n  lights: {loading: [mot], cooling: [cooling], imaging: [imaging]}\n"


def run(tmp_path: Path, lines: str, *overrides: str, shots: int = 3) -> labseq.Run:
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


def test_the_trigger_lines_start_the_exposures_and_the_moves(tmp_path: Path) -> None:
    triggered, by_software = (
        run(tmp_path / name, lines, shots=1).shots[0]
        for name, lines in (("a", LINES), ("b", re.sub(", triggers: [a-z_]+", "", LINES)))
    )
    assert triggered.filling_fraction > 0.9
    assert np.array_equal(triggered.occupancies, by_software.occupancies)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("on: [load], lag", "on: [laod], lag", r"lined.yaml:\d+:\d+: .*'laod'.*'load'"),
        ("channel: 3", "channel: 77", "the box has no channel 77"),
        ("on: [image], pulse", "on: [load], pulse", "a line that triggers the camera is on at other times"),
        ("on: [rearrange], pulse", "on: [image], pulse", "mobile tweezers .* `on: \\[rearrange\\]`"),
        (
            "  channels:",
            "  mutually_exclusive: [[mot, cooling]]\n  channels:",
            "'mot' and 'cooling' must never be on together, .*'load'",
        ),
    ],
)
def test_mistakes_in_lines_are_reported_with_line_and_column(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        run(tmp_path / "x", LINES.replace(old, new))
    assert all(problem.line > 0 for problem in caught.value.problems)


def test_a_trigger_line_for_a_driver_that_cannot_wait_for_it_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(VirtualMobileTweezers, "waits_for_trigger", False)
    with pytest.raises(
        ConfigError, match=r"lined.yaml:\d+:\d+: the mobile tweezers take no external trigger"
    ):
        run(tmp_path, LINES)


WIDE = LINES.replace("on: [image], pulse: 1 ms, triggers", "on: [image], triggers")
UNWIRED = WIDE.replace(", triggers: camera", "")
BULB = "profile.camera.line_trigger=bulb"
START = "profile.camera.line_trigger=external_start"
TWO_IMAGES = "shot=[{load: {}}, {image: {}}, {wait: {duration: 20 ms}}, {image: {}}]"


@pytest.mark.parametrize("box", ["virtual", "ttl\n  port: simulated"])
def test_a_bulb_camera_sees_what_one_that_is_triggered_sees(tmp_path: Path, box: str) -> None:
    bulb = run(tmp_path / "a", WIDE.replace("virtual", box, 1), BULB, shots=1).shots[0]
    by_software = run(tmp_path / "b", UNWIRED, shots=1).shots[0]
    assert bulb.filling_fraction > 0.9
    assert np.array_equal(bulb.occupancies, by_software.occupancies)


def test_with_an_external_start_the_images_wait_for_the_camera(tmp_path: Path) -> None:
    (shot,) = run(tmp_path, LINES, START, "profile.camera.cycle_time=90 ms", TWO_IMAGES, shots=1).shots
    first, second = shot.images
    step = shot.steps[3]
    assert (step.planned_s, step.achieved_s) == pytest.approx((70e-3, 70e-3))  # it waits for 19.8 ms
    assert second.t_start_s - first.t_start_s == pytest.approx(90e-3)
    assert (first.occupancy & second.occupancy).sum() > 250  # both were lit


@pytest.mark.parametrize(
    ("lines", "overrides", "message"),
    [
        (LINES, [BULB], r"lined.yaml:\d+:\d+: .*'camera_tr.*no `pulse`"),
        (UNWIRED, [BULB], "no line triggers the camera; .*`triggers: camera`"),
        (
            WIDE.replace("  use: virtual", "  use: virtual\n  resolution: 1 ms"),
            [BULB, "shot.1.image.exposure=45.3 ms"],
            "45.3 ms, .* a multiple of 1 ms",
        ),
        (
            LINES,
            [START, "profile.camera.cycle_time=90 ms"],
            "'cycle 0: move' takes 0 s to 60 ms, .*line_trigger: external",
        ),
        (
            LINES,
            [START, "profile.camera.cycle_time=50 ms", TWO_IMAGES],
            "cycle_time=50 ms: .* 70.2 ms, .* every 50 ms",
        ),
        (LINES, [START], "`external_start` needs a `cycle_time`"),
        (LINES, ["profile.camera.cycle_time=50 ms"], "`cycle_time` needs `line_trigger: external_start`"),
    ],
)
def test_a_trigger_that_cannot_work_is_refused_by_the_check(
    tmp_path: Path, lines: str, overrides: list[str], message: str
) -> None:
    profile = tmp_path / "lined.yaml"
    profile.write_text(PROFILE.replace("simulation:\n", LIT) + lines, "utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        check(
            labseq.Session.open(
                ROOT / "sequences" / "compact_225.yaml", profile=str(profile), overrides=overrides
            )
        )
    assert len(caught.value.problems) == 1


def test_a_blinding_line_in_an_exposure_with_em_gain_is_refused_before_the_run(tmp_path: Path) -> None:
    lines = LINES.replace("on: [load], lag", "on: [load, image], lag")
    with pytest.raises(ConfigError, match=r"'mot' is blinding .*EM gain of 300"):
        run(tmp_path, lines, "profile.camera.em_gain=300")


SPOTS = SiteGrid(12, 15)


def with_disorder(context: Context) -> Context:
    physics = SimulationSettings.model_validate({"depth_disorder": 0.04, "tone_response": 0.06})
    return replace(context, simulation=VirtualSimulation(physics, context))


class TestVirtualSpotMeter(DeviceContract):
    values: ClassVar = ("spot_powers",)

    def context(self) -> Context:
        return with_disorder(super().context())

    @pytest.fixture
    def factory(self) -> Callable[[Context], VirtualSpotMeter]:
        return lambda context: VirtualSpotMeter(SpotMeterSettings(), context)


@pytest.fixture
def context() -> Context:
    return with_disorder(Context("trap_camera", SPOTS, clock=FakeClock(), random=RandomStream(4)))


def meter(context: Context, noise: float = 0.0) -> tuple[VirtualSpotMeter, VirtualSimulation]:
    """One that is open, on a simulation with the light on."""
    simulation = context.simulation
    assert isinstance(simulation, VirtualSimulation)
    simulation.open()
    context.random.begin_shot(0, 0)
    simulation.begin_shot()
    simulation.play("static_tweezers", DepthRamp(0.0, 1.0), 0.0)
    made = VirtualSpotMeter(SpotMeterSettings(noise=noise), context)
    made.open()
    return made, simulation


def test_it_measures_the_depth_of_each_tweezer_and_takes_its_time(context: Context) -> None:
    spots, simulation = meter(context)
    start_s = context.clock.now()
    before = spots.read("spot_powers")
    assert context.clock.now() - start_s == pytest.approx(20e-3)
    np.testing.assert_array_equal(before, simulation.spot_powers())
    simulation.play("static_tweezers", TweezerAmplitudes(np.full(12, 0.5 / 12), np.full(15, 1 / 15)), 0.0)
    np.testing.assert_allclose(spots.read("spot_powers"), 0.25 * before)


def test_its_noise_is_relative_and_new_each_time(context: Context) -> None:
    spots, simulation = meter(context, noise=0.05)
    off = np.stack([spots.read("spot_powers") for _ in range(20)]) / simulation.spot_powers() - 1
    assert off.std() == pytest.approx(0.05, rel=0.05)
    assert abs(off.mean()) < 4 * 0.05 / off.size**0.5
    assert abs(np.corrcoef(off[0].ravel(), off[1].ravel())[0, 1]) < 0.3
