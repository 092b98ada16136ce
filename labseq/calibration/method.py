"""The definition of a kind of calibration, and the input and result of its analysis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.assembly.lab import construct
from labseq.assembly.profile import ResolvedProfile
from labseq.assembly.recorded import recorded_machine
from labseq.calibration_store import read_entry
from labseq.data.reader import Run
from labseq.errors import ConfigError, DeviceError, Problem
from labseq.guard import StopFlag
from labseq.model import CalibrationKind, Frame, MotionSpec, SiteGrid
from labseq.recording.shot_file import read_frames
from labseq.roles import Detector
from labseq.sequencer.clock import VirtualClock

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROBE_ADDRESS: Final = ".probe.offset"
"""Ending of the address of a probe's offset among the parameters of a shot."""


@dataclass(frozen=True, slots=True)
class AnalysisResult:
    """The result of analysing a run or a file.

    Attributes:
        values: The calibrated values (see :class:`labseq.CalibrationEntry`).
        quality: Figures of merit.
        summary_lines: Lines that summarise the result for the user.
        origin: Additions to the entry's ``origin``, JSON-ready.
        draw: Draws a picture of the result. None if there is none.
    """

    values: Mapping[str, ArrayLike]
    quality: Mapping[str, float]
    summary_lines: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict[str, Any])
    draw: Callable[[], Figure] | None = None


@dataclass(frozen=True, slots=True)
class CalibrationData:
    """A run and the profile for its analysis.

    Attributes:
        run: The run.
        hardware: The profile, with the calibrations that the analysis uses.
        centre_px: (y, x) of the middle of the sites' grid on the frames, if the user gave it.
    """

    run: Run
    hardware: ResolvedProfile
    centre_px: tuple[float, float] | None = None

    def frames(self) -> Iterator[Frame]:
        """The first frame of each shot, with randomly loaded atoms before any move.

        Raises:
            ConfigError: The run has no shots, or kept no frames.
            DeviceError: The frames differ in size, or a frame is saturated.
            RecordingError: A shot's file is damaged.
        """
        path = str(self.run.path)
        if not self.run.shots:
            raise ConfigError(Problem("the run has no shots", path, expected="a run with frames"))
        shape: tuple[int, ...] | None = None
        for shot in self.run.shots:
            frame = read_frames(shot.file).get(0)
            if frame is None:
                problem = f"the first image of shot {shot.index} was not kept"
                hint = "take a run with 'record_frames: all'"
                raise ConfigError(Problem(problem, path, expected="a frame of each shot", hint=hint))
            shape = shape or frame.image.shape
            if frame.image.shape != shape:
                sizes = f"{shape} and {frame.image.shape}"
                raise DeviceError(frame.camera, f"frames of the run have different sizes, {sizes}")
            n_saturated = int(np.count_nonzero(frame.image == np.iinfo(frame.image.dtype).max))
            # any frame may have 20 hot pixels and cosmic rays
            if n_saturated > max(20, self.hardware.grid.n_rows * self.hardware.grid.n_cols // 20):
                problem = f"{n_saturated} pixels of the first frame of shot {shot.index} are saturated"
                raise DeviceError(frame.camera, f"{problem}; use less light, gain or exposure")
            yield frame

    def detector(self) -> Detector:
        """The profile's detector, with the calibrations that the analysis uses."""
        hardware = self.hardware
        clock = VirtualClock(StopFlag())
        plugins, _ = construct({"detector": hardware.chosen["detector"]}, hardware.context(clock), 0)
        return plugins["detector"]


@dataclass(frozen=True, slots=True)
class Method:
    """The sequence and analysis of one kind of calibration.

    Attributes:
        kind: The kind.
        analyse: Makes a calibration from a run, or raises a ``LabseqError`` that says why it cannot.
        read: Makes a calibration from a file of values. None if this kind needs a run.
        ignored: Kinds of calibration that neither the run nor the analysis uses.
        uses_detector: Whether the run detects atoms. The others run before the detector is calibrated.
    """

    kind: CalibrationKind
    analyse: Callable[[CalibrationData], AnalysisResult]
    read: Callable[[Path, ResolvedProfile], AnalysisResult] | None = None
    ignored: tuple[CalibrationKind, ...] = ()
    uses_detector: bool = True

    @property
    def sequence(self) -> Path:
        """Name of the packaged sequence to run."""
        return Path(__file__).with_name(f"{self.kind}.yaml")


@dataclass(frozen=True, slots=True, eq=False)
class ProbeCounts:
    """Atoms counted before and after a probe, at each of its offsets.

    Attributes:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int64 (n_points, n_rows, n_cols), number of probed atoms on each site.
        n_survived: int64, of the same shape, number of these atoms seen afterwards.
        grid: The grid, with the tones that were played.
        motion: How the tweezers moved.
        in_use_m: float64 (2,), the offset that the overlay calibration of the run corrected.
        calibrations: Kind -> id of the calibration in use in the run.
    """

    offset_m: NDArray[np.float64]
    n_before: NDArray[np.int64]
    n_survived: NDArray[np.int64]
    grid: SiteGrid
    motion: MotionSpec
    in_use_m: NDArray[np.float64]
    calibrations: dict[str, str]


def count_probed(run: Run) -> ProbeCounts:
    """Count the atoms before and after the probe, at each offset and on each site.

    Raises:
        ConfigError: The run does not scan the offset of a probe between two images.
        RecordingError: A shot's file is damaged.
    """
    counts: dict[tuple[float, float], NDArray[np.int64]] = {}
    for shot in run.shots:
        values = (value for name, value in shot.parameters.items() if name.endswith(PROBE_ADDRESS))
        offset, occupancies = next(values, None), shot.occupancies
        if offset is None or len(occupancies) < 2:
            problem = "the run does not scan the offset of a probe between two images"
            expected = "a run as from 'labseq calibrate overlay'"
            raise ConfigError(Problem(problem, str(run.path), expected=expected))
        point = float(offset[0]), float(offset[1])
        before, after = occupancies[0], occupancies[-1]
        # an atom that comes to an empty site in between is not a survivor
        counts[point] = counts.get(point, 0) + np.stack([before, before & after]).astype(np.int64)
    if not counts:
        expected = "a scan of a probe's offset"
        raise ConfigError(Problem("the run has no shots", str(run.path), expected=expected))
    machine = recorded_machine(run.record["resolved"]["profile"], "the profile of the run")
    calibrations: dict[str, str] = dict(run.record.get("calibrations") or {})
    in_use_m = np.zeros(2)
    if "overlay" in calibrations:
        in_use_m = read_entry(run.path / "calibration_overlay.json").values["offset_m"]
    n_before, n_survived = np.stack([*counts.values()], axis=1)
    return ProbeCounts(
        np.array([*counts]), n_before, n_survived, machine.grid, machine.motion, in_use_m, calibrations
    )
