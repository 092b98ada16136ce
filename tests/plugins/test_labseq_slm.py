"""The static tweezers by an SLM: contract, phases, grey levels, and the light of the simulated SLM."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from labseq_slm import retrieval
from labseq_slm.levels import levels_of, nearest_levels, read_correction, read_look_up_table
from labseq_slm.optics import optics_of
from labseq_slm.settings import SlmSettings
from labseq_slm.static_tweezers import SlmStaticTweezers
from labseq_slm_sim.panel import SimulatedSlm
from PIL import Image

from labseq.plugin import Context, DeviceError, LimitError, SiteGrid
from labseq.testing import StaticTweezersContract
from labseq.testing.fakes import FakeClock

SMALL: dict[str, Any] = {
    "output": "simulated",
    "pixels": [256, 256],
    "pixel_pitch": 50e-6,
    "offset": [60e-6, 0.0],
    "settle": 60e-3,
}
GRID = SiteGrid(5, 6)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(retrieval, "cache_root", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "slm"


def settings(**changes: Any) -> SlmSettings:
    return SlmSettings.model_validate(SMALL | changes)


def made(grid: SiteGrid = GRID, **changes: Any) -> SlmStaticTweezers:
    return SlmStaticTweezers(settings(**changes), Context("static_tweezers", grid, clock=FakeClock()))


def powers(tweezers: SlmStaticTweezers) -> np.ndarray:
    """What the sites receive when the liquid crystal has followed."""
    panel = tweezers._output
    assert isinstance(panel, SimulatedSlm)
    return panel.powers(1e9)


class TestSlmStaticTweezers(StaticTweezersContract):
    def context(self) -> Context:
        return replace(super().context(), grid=GRID)

    @pytest.fixture
    def factory(self) -> Callable[[Context], SlmStaticTweezers]:
        return partial(SlmStaticTweezers, settings())


@pytest.mark.parametrize("changes", [{}, {"rotation": 0.1, "mirrored": True, "offset": [55e-6, -20e-6]}])
def test_the_phases_send_light_to_each_site_in_proportion_to_its_weight(changes: dict[str, Any]) -> None:
    chosen = settings(**changes)
    optics = optics_of("slm", chosen, GRID)
    weights = np.random.default_rng(2).uniform(0.5, 1.5, 30)
    field = retrieval.FarField(optics, np.ones((256, 256), np.float32))
    phase = np.angle(field.light(retrieval.retrieve(optics, weights)))
    # the far field of the beam summed over all pixels, from the positions in metres
    x, y = ((np.arange(256) - 127.5) * chosen.pixel_pitch for _ in range(2))
    beam = np.exp(-(x**2 + y[:, None] ** 2) / chosen.beam_waist**2)
    cos, sin = np.cos(chosen.rotation), np.sin(chosen.rotation)
    reached = np.empty(30)
    for site, (x_m, y_m) in enumerate(GRID.positions_m.reshape(-1, 2)):
        x_m = -x_m if chosen.mirrored else x_m
        place = np.array([cos * x_m + sin * y_m, cos * y_m - sin * x_m]) + chosen.offset
        k = 2 * np.pi / (chosen.wavelength * chosen.focal_length) * place
        reached[site] = (
            abs((beam * np.exp(1j * (phase - k[0] * x - k[1] * y[:, None]))).sum() / beam.sum()) ** 2
        )
    share = reached / weights
    assert share.std() < 0.01 * share.mean()
    assert reached.sum() > 0.85


def test_phases_are_kept_until_something_changes_that_they_depend_on(
    monkeypatch: pytest.MonkeyPatch, cache: Path
) -> None:
    optics, weights = optics_of("slm", settings(), GRID), np.linspace(1, 2, 30)
    first = retrieval.retrieve(optics, weights)
    n_iterations = list[int]()
    reached = retrieval.FarField.reached
    monkeypatch.setattr(
        retrieval.FarField, "reached", lambda self, each: (n_iterations.append(1), reached(self, each))[1]
    )
    assert np.array_equal(retrieval.retrieve(optics, 3 * weights), first), "only ratios count"
    assert not n_iterations
    for change in ({"beam_waist": 4e-3}, {"offset": [61e-6, 0.0]}, {"pixels": [256, 300]}):
        retrieval.retrieve(optics_of("slm", settings(**change), GRID), weights)
        assert n_iterations
        n_iterations.clear()
    for path in cache.iterdir():
        path.write_bytes(b"damaged")
    assert retrieval.retrieve(optics, weights) == pytest.approx(first)


def test_a_pattern_changes_little_where_weights_change_little() -> None:
    """Else a calibration would not hold for the pattern that it leads to."""
    optics, weights = optics_of("slm", settings(), GRID), np.ones(30)
    before = retrieval.retrieve(optics, weights)
    after = retrieval.retrieve(optics, weights * np.exp(0.05 * np.random.default_rng(3).normal(size=30)))
    assert np.abs(after / np.abs(after).mean() - before / np.abs(before).mean()).max() < 0.2


def test_the_look_up_table_and_corrections_of_the_device_bring_the_light_back(tmp_path: Path) -> None:
    """A table and aberrations are known here: they are those of the simulated SLM."""
    errors = {"phase_range": 0.2, "phase_curve": 0.4, "aberration": {"horizontal_coma": 0.5}}
    x = np.arange(256) / 256
    np.save(tmp_path / "table.npy", 2 * np.pi * x * 1.2 + 0.4 * np.sin(2 * np.pi * x))
    surface = np.rint(256 / (2 * np.pi) * np.linspace(0, 3, 256) ** 2) % 256
    Image.fromarray(np.tile(surface.astype(np.uint8), (256, 1))).save(tmp_path / "surface.bmp")
    known = {"look_up_table": tmp_path / "table.npy", "zernike": {"horizontal_coma": -0.5}}
    light = list[float]()
    trials: list[dict[str, Any]] = [{}, known, {**known, "correction": tmp_path / "surface.bmp"}]
    for changes in trials:
        tweezers = made(errors=errors, **changes)
        assert not tweezers.check_settings()
        tweezers.open()
        tweezers.start()
        light.append(float(powers(tweezers).mean()))
    assert light[1] > 1.3 * light[0]
    assert light[2] < 0.5 * light[1], "of a surface that is flat in the simulation"


def test_grey_levels_are_the_nearest_that_a_look_up_table_has() -> None:
    table = np.sort(np.random.default_rng(5).uniform(0, 2 * np.pi, 256))
    phase = np.random.default_rng(6).uniform(-20, 20, (40, 50)).astype(np.float32)
    levels = levels_of(phase, nearest_levels(table))
    reached = np.abs(np.exp(1j * table[levels]) - np.exp(1j * phase))
    least = np.abs(np.exp(1j * table) - np.exp(1j * phase[..., None])).min(axis=-1)
    assert levels.dtype == np.uint8
    assert (reached - least).max() < 2 * np.pi / 4096


def test_the_liquid_crystal_follows_slowly_and_off_leaves_no_tweezer() -> None:
    tweezers = made(settle=0.0)
    tweezers.open()
    assert powers(tweezers).max() < 0.1
    tweezers.start()
    panel: Any = tweezers._output
    at_once, soon = (panel.powers(after_s).mean() for after_s in (0.0, 8e-3))
    assert at_once < 0.1
    assert at_once < soon < 0.9 * powers(tweezers).mean()
    with pytest.raises(DeviceError, match=r"got uint8 of shape \(256, 255\), not uint8 of \(256, 256\)"):
        panel.show(np.zeros((256, 255), np.uint8))
    tweezers.safe_state()
    assert powers(tweezers).max() < 0.1
    assert tweezers.describe()["depth"] == 0.0


@pytest.mark.parametrize(
    ("grid", "changes", "message"),
    [
        (SiteGrid(50, 60), {}, r"width of 50 x 60 sites 4\.49 um apart is 374\.9 um; the limit is 242\.4"),
        (GRID, {"offset": [110e-6, 0.0]}, r"site \(4, 5\) from the zeroth order is 1\d\d\.?\d* um; .* 121"),
        (GRID, {"offset": [2e-6, 0.0]}, r"\(2, 2\) from the zeroth order is 0\.245 um; .* 2\.14 um or more"),
        (GRID, {"beam_waist": 1e-3}, r"distance between sites is 4\.49 um; the limit is 9\.6\d um or more"),
    ],
)
def test_sites_that_the_slm_cannot_make_are_refused(
    grid: SiteGrid, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(LimitError, match=message):
        made(grid, **changes)


PROFILE = """labseq: 1
name: slm
grid: {rows: 5, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: slm, pixels: [256, 256], pixel_pitch: 50 um, offset: [60 um, 0 um], SETTINGS}
mobile_tweezers: {use: virtual}
detector: {use: threshold}
simulation: {use: virtual}
"""


@pytest.mark.parametrize(
    ("fault", "code", "message"),
    [
        ("output: simulated, offset: [2 um, 0 um]", 2, "move the array with `offset`"),
        ("output: file, image: none/phase.png", 3, "there is no folder"),
        ("output: display, display: 1", 3, "a display needs the packages slmsuite and pyglet"),
        (
            "output: simulated, correction: surface.bmp",
            3,
            "surface.bmp: there is no such file; expected grey",
        ),
    ],
)
def test_faults_are_reported_by_devices(
    fault: str, code: int, message: str, call: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "slmsuite", None)
    path = tmp_path / "p.yaml"
    text = PROFILE.replace("offset: [60 um, 0 um], ", "") if "offset" in fault else PROFILE
    path.write_text(text.replace("SETTINGS", fault), "utf-8")
    exit_code, out, err = call("devices", str(path))
    assert (exit_code, message in " ".join((out + err).split())) == (code, True), out + err


def test_a_missing_correction_file_is_found_by_check(call: Any, tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        PROFILE.replace("SETTINGS", "output: simulated, correction: no.bmp"), "utf-8"
    )
    (tmp_path / "s.yaml").write_text(
        "labseq: 1\nname: s\nprofile: ./p.yaml\nshots: 1\nshot: [image: {}]\n", "utf-8"
    )
    code, out, err = call("check", str(tmp_path / "s.yaml"))
    assert code == 2
    assert "no.bmp: there is no such file; expected grey levels of 256 x 256 pixels" in " ".join(
        (out + err).split()
    )


def test_files_that_are_not_what_they_should_be_are_named(tmp_path: Path) -> None:
    np.save(tmp_path / "short.npy", np.zeros(17))
    Image.fromarray(np.zeros((10, 20), np.uint8)).save(tmp_path / "small.png")
    (tmp_path / "text.png").write_text("not a picture", "utf-8")
    for setting, name, message in (
        ("look_up_table", "short.npy", "(17,)"),
        ("correction", "small.png", "(10, 20)"),
        ("correction", "text.png", "not a picture"),
    ):
        changes: dict[str, Any] = {setting: tmp_path / name}
        ((_, problem),) = made(**changes).check_settings().items()
        assert message in str(problem)


def test_a_file_receives_the_grey_levels(tmp_path: Path) -> None:
    image = tmp_path / "phase.png"
    tweezers, simulated = made(output="file", image=image), made()
    for each in (tweezers, simulated):
        each.open()
        each.start()
    levels = np.asarray(Image.open(image))
    panel: Any = simulated._output
    panel.show(levels)
    assert powers(simulated).mean() > 0.9
    tweezers.close()
    assert not np.array_equal(np.asarray(Image.open(image)), levels)
    assert [path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".part")] == ["phase.png"]


class Screen:
    """As slmsuite's class, whose window is not needed here."""

    def __init__(self, number: int, **_: Any) -> None:
        if number > 1:
            raise ValueError(f"Could not find display_number={number}; only 2 displays")
        self.shape, self.shown, self.is_open = (256, 256), list[np.ndarray](), True

    def set_phase(self, levels: np.ndarray, **options: Any) -> None:
        assert levels.dtype == np.uint8
        assert options == {"phase_correct": False, "settle": False, "block": True}
        self.shown.append(levels)

    def close(self) -> None:
        self.is_open = False


def test_a_display_receives_the_grey_levels_and_its_faults_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = ModuleType("slmsuite.hardware.slms.screenmirrored")
    module.ScreenMirrored = Screen
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(sys.modules, "slmsuite", SimpleNamespace(__version__="0.5.0"))
    tweezers = made(output="display")
    tweezers.open()
    tweezers.start()
    screen: Any = vars(tweezers._output)["_screen"]
    assert len(screen.shown) == 2
    assert tweezers.versions() == {"slmsuite": ("0.5.0", "0.5.0")}
    tweezers.close()
    assert not screen.is_open
    with pytest.raises(DeviceError, match=r"cannot open display 2: .* only 2 displays"):
        made(output="display", display=2).open()
    with pytest.raises(DeviceError, match=r"display 1 has 256 x 256 pixels, but `pixels` says 256 x 300"):
        made(output="display", pixels=[256, 300]).open()


def test_without_files_levels_rise_linearly_and_the_surface_is_flat() -> None:
    assert np.diff(read_look_up_table(None)) == pytest.approx(np.full(255, 2 * np.pi / 256))
    assert not read_correction(None, (10, 20)).any()
