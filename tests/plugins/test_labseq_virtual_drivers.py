"""The virtual drivers: the manners of real hardware."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from labseq_virtual.camera import VirtualCamera
from labseq_virtual.settings import (
    CameraSettings,
    MobileTweezersSettings,
    SimulationSettings,
    StaticTweezersSettings,
)
from labseq_virtual.simulation import VirtualSimulation
from labseq_virtual.tweezers import VirtualMobileTweezers, VirtualStaticTweezers

from labseq import (
    ConfigError,
    Context,
    DeviceError,
    DeviceTimeoutError,
    LimitError,
    NeedsWarmUp,
    RandomStream,
    SiteGrid,
    ToneProgram,
)
from labseq.model import AxisTones
from labseq.testing.fakes import FakeClock

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
        self.world = VirtualSimulation(
            settings, Context("simulation", GRID, clock=self.clock, random=self.random)
        )
        self.static = VirtualStaticTweezers(StaticTweezersSettings(), self.context("static_tweezers"))
        self.camera = VirtualCamera(CameraSettings(), self.context("camera"))
        self.mobile = VirtualMobileTweezers(MobileTweezersSettings(), self.context("mobile_tweezers"))
        self.world.open()
        self.world.begin_shot()
        for device in (self.static, self.camera, self.mobile):
            device.open()
        self.static.start()
        self.world.load(self.clock.now(), 0.5)
        self.clock.sleep(0.5)

    def context(self, name: str) -> Context:
        return Context(name, GRID, clock=self.clock, random=RandomStream(0, name), simulation=self.world)

    @property
    def n_atoms(self) -> int:
        return int(self.world.truth().sum())


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
    amplitude: float = 0.5,
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


@pytest.mark.parametrize(("depth", "duration_s"), [(-0.1, 0.0), (2.0, 0.0), (1.0, -1.0), (float("nan"), 0.0)])
def test_an_impossible_ramp_is_refused(lab: Lab, depth: float, duration_s: float) -> None:
    with pytest.raises(LimitError, match="static_tweezers"):
        lab.static.ramp(depth, duration_s)
    assert lab.n_atoms == 6


@pytest.mark.parametrize(
    ("rows", "cols", "what"),
    [
        ([0.1, 0.1], [0.1, 0.1], "shape of the column amplitudes"),
        ([0.1, -0.1], [0.1] * 3, "a row amplitude"),
        ([0.1, float("nan")], [0.1] * 3, "a row amplitude"),
        ([0.1, 0.1], [0.4] * 3, "sum of the column amplitudes"),
    ],
)
def test_impossible_amplitudes_are_refused(lab: Lab, rows: list[float], cols: list[float], what: str) -> None:
    with pytest.raises(LimitError, match=what):
        lab.static.load((np.array(rows), np.array(cols)))


def test_amplitudes_are_kept_for_the_record(lab: Lab) -> None:
    assert lab.static.describe()["amplitudes"] == "calibrated"
    lab.static.load((np.array([0.5, 0.5]), np.array([0.25, 0.25, 0.5])))
    assert lab.static.describe()["amplitudes"] == {"row": [0.5, 0.5], "column": [0.25, 0.25, 0.5]}


def test_mobile_tweezers_carry_an_atom(lab: Lab) -> None:
    lab.world.truth()
    lab.world._occupied[0, 1:] = False
    assert lab.mobile.prepare(program()) == pytest.approx(3e-3)
    start_s = lab.clock.now()
    lab.mobile.play()
    assert lab.clock.now() == start_s
    lab.mobile.wait(1.0)
    assert lab.clock.now() - start_s == pytest.approx(3e-3)
    assert lab.world.truth().tolist() == [[False, False, True], [True, True, True]]
    lab.mobile.wait(1.0)
    assert lab.clock.now() - start_s == pytest.approx(3e-3)


def test_each_play_needs_its_own_prepare(lab: Lab) -> None:
    with pytest.raises(DeviceError, match=r"without a prepared program; call prepare\(\)"):
        lab.mobile.play()
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.mobile.wait(1.0)
    with pytest.raises(DeviceError, match="without a prepared program"):
        lab.mobile.play()


def test_nothing_is_started_while_a_program_plays(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    with pytest.raises(DeviceError, match=r"play\(\) while a program plays"):
        lab.mobile.play()
    with pytest.raises(DeviceError, match=r"prepare\(\) while a program plays"):
        lab.mobile.prepare(program())


def test_waiting_too_short_is_a_timeout(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    with pytest.raises(DeviceTimeoutError, match="still playing after 1 ms") as caught:
        lab.mobile.wait(1e-3)
    assert caught.value.timeout_s == 1e-3
    lab.mobile.wait(1.0)


def test_a_camera_cannot_look_while_atoms_move(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.camera.arm(1, 10e-3, "software")
    with pytest.raises(DeviceError, match=r"mobile_tweezers\.wait"):
        lab.camera.trigger()


def test_the_safe_state_lets_go_of_atoms_in_flight(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.clock.sleep(1.5e-3)
    lab.mobile.safe_state()
    lab.mobile.safe_state()
    assert not lab.world.truth()[0, 0]
    assert lab.n_atoms == 5
    lab.mobile.prepare(program())


def test_the_safe_state_of_all_in_any_order_ends_dark(lab: Lab) -> None:
    lab.mobile.prepare(program())
    lab.mobile.play()
    lab.static.safe_state()
    lab.camera.safe_state()
    lab.mobile.safe_state()
    assert lab.n_atoms == 0


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        (
            {"col_hz": 80e6},
            r"column tone 0 in segment 0 \(batch 0\) is 80 MHz; the limit is the band of 82 to 118 MHz",
        ),
        ({"end_hz": 118.1e6}, r"column tone 0 in segment 1 \(batch 0\) is 118\.1 MHz"),
        ({"row_hz": float("nan")}, "row tone 0 in segment 0"),
        ({"amplitude": 1.1}, r"amplitude of row tone 0 .* is 1\.1 of full scale"),
        ({"amplitude": -0.1}, "amplitude of row tone 0"),
        ({"duration_s": 0.0}, "length of the program is 0 s"),
        ({"duration_s": -1.0}, "a segment's duration"),
        ({"duration_s": float("nan")}, "a segment's duration"),
    ],
)
def test_an_impossible_program_is_refused_before_it_plays(
    lab: Lab, wrong: dict[str, float], what: str
) -> None:
    with pytest.raises(LimitError, match=what):
        lab.mobile.prepare(program(**wrong))
    with pytest.raises(DeviceError, match="without a prepared program"):
        lab.mobile.play()


def test_tones_that_would_clip_together_are_refused(lab: Lab) -> None:
    hz, on = np.array([99e6, 101e6]), np.array([0.6, 0.6])
    two = AxisTones(np.array([0, 2], np.int32), hz, hz, on, on, np.zeros(2))
    one = axis([100e6, 100e6], [1.0, 1.0])
    clipping = ToneProgram(two, one, np.array([1e-3]), np.zeros(1, np.int8), np.array([7], np.int32))
    with pytest.raises(LimitError, match=r"sum of the row amplitudes in segment 0 \(batch 7\) is 1\.2"):
        lab.mobile.prepare(clipping)


def test_closing_makes_safe(lab: Lab) -> None:
    lab.static.close()
    assert lab.n_atoms == 0


@pytest.mark.parametrize("driver", [VirtualCamera, VirtualStaticTweezers, VirtualMobileTweezers])
def test_virtual_hardware_needs_a_world(driver: Any) -> None:
    with pytest.raises(ConfigError, match=r"simulation: \{use: virtual\}"):
        driver(object(), Context("camera"))


def test_the_self_tests_of_the_tweezers_pass_and_change_nothing(lab: Lab) -> None:
    for device in (lab.static, lab.mobile):
        before = device.describe()
        device.self_test()
        assert device.describe() == before
    assert lab.n_atoms == 6


def test_self_tests_need_an_open_device(lab: Lab) -> None:
    for device in (lab.static, lab.mobile, lab.camera):
        device.close()
        with pytest.raises(DeviceError, match="not open"):
            device.self_test()


def test_the_static_tweezers_tell_amplitudes_that_they_cannot_have(lab: Lab) -> None:
    settings = StaticTweezersSettings(max_amplitude_sum=0.5)
    static = VirtualStaticTweezers(settings, lab.context("static_tweezers"))
    static.open()
    with pytest.raises(
        DeviceError, match=r"the calibrated amplitudes exceed a limit: .*.* is 1; the limit is 0\.5"
    ):
        static.self_test()


def test_the_mobile_tweezers_tell_a_site_that_is_out_of_reach(lab: Lab) -> None:
    settings = MobileTweezersSettings(band_half_width=1e6)
    mobile = VirtualMobileTweezers(settings, lab.context("mobile_tweezers"))
    mobile.open()
    with pytest.raises(
        DeviceError, match=r"column 0 is out of reach: its tone of .* is not in the band of 99 to"
    ):
        mobile.self_test()


def test_no_kernel_is_left_to_be_compiled_by_the_first_image(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels = "labseq_virtual.transport_kernels"  # which takes longer than a camera may
    monkeypatch.delitem(sys.modules, kernels, raising=False)
    assert isinstance(lab.mobile, NeedsWarmUp)
    lab.mobile.warm()
    assert kernels in sys.modules
