"""The steps that watch for drifts, on fakes that drift."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.builtin.overlay import SurvivalShape
from labseq.builtin.probes import CheckOverlaySettings, CheckOverlayStep, CheckSitesSettings, CheckSitesStep
from labseq.builtin.steps import ImageSettings, ImageStep
from labseq.detection.threshold import ThresholdDetector, ThresholdSettings
from labseq.errors import ConfigError, DeviceError
from labseq.model import CalibrationEntry, Frame, SegmentKind, ShotRecord, SiteGrid
from labseq.model.calibration import grid_facts
from labseq.roles import Context, Step
from labseq.sequencer.run import Sequencer
from labseq.testing.fakes import FakeLab, ListSink, RecordingObserver, fake_lab

GRID = SiteGrid(20, 20)
FULL = np.ones(GRID.shape, np.bool_)
SHAPE = SurvivalShape(0.93e-6, 0.23e-6, 0.01, 0.98)
SEQUENCE = list[tuple[str, Step]]


class Drifting:
    """A detector that knows what the mobile tweezers did to the atoms: they stand beside the sites.

    Before each shot all sites are full.
    """

    def __init__(self, offset_m: tuple[float, float], shape: SurvivalShape = SHAPE) -> None:
        self.offset_m = offset_m
        self.shape = shape
        self.lab: FakeLab | None = None
        self.n_programs = 0
        self.rng = np.random.default_rng(1)

    def detect(self, frame: Frame) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        assert self.lab is not None
        programs = [call.args[0] for call in self.lab.calls.of("mobile_tweezers.prepare")]
        seen = FULL.copy()
        for program in programs[self.n_programs :]:
            self._probe(seen, program)
        self.n_programs = len(programs)
        return seen, np.ones(seen.shape, np.float32)

    def _probe(self, seen: NDArray[np.bool_], program: Any) -> None:
        for segment in np.flatnonzero(program.kind == SegmentKind.TRANSPORT):
            rows, cols = (
                (axis.start_hz[slice(*axis.offsets[segment : segment + 2])] - 84.8e6) / 1.6e6
                for axis in (program.row, program.column)
            )
            row, site = round(float(rows[0])), np.rint(cols).astype(int)
            beside = np.stack([cols - site, np.full(len(cols), rows[0] - row)], axis=1) * GRID.spacing_m
            place = (beside + self.offset_m) @ (GRID.axes / GRID.spacing_m)
            survival = self.shape.survival(np.hypot(*place.T))
            seen[row, site] = self.rng.random(len(cols)) < survival


def overlay_lab(detector: Any, **parts: Any) -> FakeLab:
    lab = fake_lab(grid=GRID, detector=detector, **parts)
    detector.lab = lab
    return lab


def run(lab: FakeLab, steps: SEQUENCE, n_shots: int = 1) -> tuple[list[ShotRecord], RecordingObserver]:
    sink, observer = ListSink(), RecordingObserver()
    image = ("image", ImageStep(ImageSettings(exposure=0.045)))
    sequencer = Sequencer(lab, [image, *steps], lab.stop, sink, observer, seed=1)
    try:
        sequencer.open()
        for shot in range(n_shots):
            sequencer.take(shot)
    finally:
        sequencer.shut_down()
    return sink.shots, observer


def check_overlay(every: int = 1, **settings: Any) -> SEQUENCE:
    return [("check", CheckOverlayStep(CheckOverlaySettings(every=every, **settings)))]


def test_a_right_overlay_is_recorded_without_a_warning() -> None:
    shots, observer = run(overlay_lab(Drifting((20e-9, -10e-9))), check_overlay())
    readings = shots[0].readings
    assert readings["overlay.along_row_m"] == pytest.approx(20e-9, abs=80e-9)
    assert readings["overlay.row_to_row_m"] == pytest.approx(-10e-9, abs=80e-9)
    assert 10e-9 < readings["overlay.error_m"] < 40e-9
    assert not observer.of("warning")
    assert not shots[0].images[-1].occupancy.all()  # the image of the check judges nothing
    assert (shots[0].success, shots[0].filling_fraction) == (True, 1.0)


def test_an_overlay_that_has_drifted_is_a_warning_with_the_shift() -> None:
    shots, observer = run(overlay_lab(Drifting((0.25e-6, 0.0))), check_overlay())
    assert shots[0].status == "complete"
    (warning,) = observer.of("warning")
    facts = ("shot 0", "mobile tweezers are 2", "from row to row", "100 nm", "`labseq calibrate overlay`")
    assert all(fact in warning["text"] for fact in facts)
    with pytest.raises(DeviceError, match=r"mobile_tweezers: .* run `labseq calibrate overlay`") as caught:
        run(overlay_lab(Drifting((0.25e-6, 0.0))), check_overlay(exceeded="stop"))
    assert caught.value.exit_code == 3


@pytest.mark.parametrize("n_atoms", [0, 3])
def test_too_few_atoms_are_a_warning(n_atoms: int) -> None:
    few = np.zeros(GRID.shape, np.bool_)
    few[3, 4 : 4 + n_atoms] = True
    shots, observer = run(fake_lab([few], grid=GRID), check_overlay(exceeded="stop"))
    (warning,) = observer.of("warning")
    what = f"check_overlay cannot measure the overlay to 100 nm with {n_atoms} atoms in this shot"
    assert warning["text"] == f"shot 0: {what}"
    assert ("overlay.along_row_m" in shots[0].readings) == bool(n_atoms)


def test_losses_that_no_offset_explains_are_reported_too() -> None:
    class Uneven(Drifting):
        def _probe(self, seen: NDArray[np.bool_], program: Any) -> None:
            seen[1::2] = False  # both groups that went along one axis, and none of those along the other

    with pytest.raises(DeviceError, match="fits no small offset of the mobile tweezers; run `labseq"):
        run(overlay_lab(Uneven((0.0, 0.0))), check_overlay(exceeded="stop"))


def test_it_is_made_in_every_so_many_shots() -> None:
    lab = overlay_lab(Drifting((0.0, 0.0)))
    shots, _ = run(lab, check_overlay(every=3), n_shots=7)
    assert [len(shot.images) for shot in shots] == [2, 1, 1, 2, 1, 1, 2]
    assert ["overlay.error_m" in shot.readings for shot in shots] == [True, False, False] * 2 + [True]


def test_the_survival_shape_of_the_calibration_in_use_is_taken() -> None:
    wide = SurvivalShape(1.2e-6, 0.2e-6, 0.01, 0.98)
    values = {"offset_m": np.zeros(2), **{key: np.array(value) for key, value in wide.values().items()}}
    entry = CalibrationEntry(
        "overlay", values, {"error_m": 1e-8}, grid_facts(GRID), {}, "2026-01-01T00:00:00+00:00"
    )
    lab = overlay_lab(Drifting((0.15e-6, 0.0), wide), calibrations={"overlay": entry})
    shots, _ = run(lab, check_overlay(offset=1.2e-6))
    readings = shots[0].readings
    assert readings["overlay.along_row_m"] == pytest.approx(0.15e-6, abs=4 * readings["overlay.error_m"])


def test_its_timeline_may_be_left_out() -> None:
    step = CheckOverlayStep(CheckOverlaySettings())
    lab = overlay_lab(Drifting((0.0, 0.0)))
    probe, image = step.plan_timeline(lab.step_context)
    assert (probe.min_duration_s, image.min_duration_s, image.n_images) == (0.0, 0.0, 1)
    shots, _ = run(lab, [("check", step)])
    (took,) = [t for t in shots[0].timing if t.stage == "step_1_check"]
    assert took.duration_s == pytest.approx(probe.duration_s + image.duration_s)


SETTINGS = ThresholdSettings(frame=(340, 480), centre_px=(170.0, 240.0), threshold=2000.0)


class MovedCamera:
    """Draws atoms, all of them beside where the detector looks for them."""

    def __init__(self, shift_px: tuple[float, float], occupied: NDArray[np.bool_]) -> None:
        detector = ThresholdDetector(SETTINGS, Context("detector", GRID))
        sites = detector.sites_px[occupied] + shift_px
        y, x = np.indices(SETTINGS.frame, np.float64)
        light = np.zeros(SETTINGS.frame)
        for at_y, at_x in sites:
            part = (slice(int(at_y) - 8, int(at_y) + 9), slice(int(at_x) - 8, int(at_x) + 9))
            light[part] += 400 * np.exp(-((y[part] - at_y) ** 2 + (x[part] - at_x) ** 2) / (2 * 1.2**2))
        image = np.random.default_rng(1).poisson(light + 20) + 500
        self.image = image.astype(np.uint16)


def sites_run(
    shift_px: tuple[float, float], occupied: NDArray[np.bool_] = FULL, **settings: Any
) -> tuple[list[ShotRecord], RecordingObserver]:
    detector = ThresholdDetector(SETTINGS, Context("detector", GRID))
    lab = fake_lab(grid=GRID, detector=detector)
    image = MovedCamera(shift_px, occupied).image
    vars(lab.camera)["read"] = lambda timeout_s: Frame(image, 0.045, 0.0)
    return run(lab, [("check", CheckSitesStep(CheckSitesSettings(**settings)))])


def loaded(share: float) -> NDArray[np.bool_]:
    return np.random.default_rng(2).random(GRID.shape) < share


def test_the_shift_of_the_sites_is_recorded() -> None:
    shots, observer = sites_run((0.3, -0.2), loaded(0.75))
    readings = shots[0].readings
    assert readings["sites.shift_y_px"] == pytest.approx(0.3, abs=0.05)
    assert readings["sites.shift_x_px"] == pytest.approx(-0.2, abs=0.05)
    assert 0 < readings["sites.shift_error_px"] < 0.05
    assert not observer.of("warning")


def test_sites_that_have_moved_are_a_warning_with_the_shift() -> None:
    _, observer = sites_run((-0.6, 0.4), loaded(0.75))
    (warning,) = observer.of("warning")
    assert warning["text"].startswith("shot 0: the sites have moved by -0.6")
    assert warning["text"].endswith(", limit 0.5 px); run `labseq calibrate sites`")
    with pytest.raises(DeviceError, match=r"camera: the sites have moved by \+1\.\d+ px down and"):
        sites_run((1.2, 0.0), loaded(0.6), exceeded="stop")


@pytest.mark.parametrize("n_atoms", [0, 9])
def test_too_few_atoms_are_no_drift(n_atoms: int) -> None:
    occupied = np.zeros(GRID.shape, np.bool_)
    occupied.flat[: 7 * n_atoms : 7] = True
    shots, observer = sites_run((0.9, 0.0), occupied, exceeded="stop")
    (warning,) = observer.of("warning")
    assert warning["text"] == (
        f"shot 0: check_sites cannot locate the sites from {n_atoms} atoms, because "
        "few were loaded or the sites are far from where the detector looks"
    )
    assert "sites.shift_y_px" not in shots[0].readings


def test_a_detector_that_reports_no_sites_is_refused() -> None:
    with pytest.raises(ConfigError, match="needs a detector that reports where it looks"):
        run(fake_lab(grid=GRID), [("check", CheckSitesStep(CheckSitesSettings()))])
