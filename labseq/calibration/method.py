"""What a way to calibrate must offer and what it is given; runs that probe the overlay."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.calibration.store import read_entry
from labseq.errors import ConfigError, DeviceError, Problem
from labseq.guard import StopFlag
from labseq.model import CalibrationKind, Frame, MotionSpec, SiteGrid
from labseq.recording import Run
from labseq.roles import Detector
from labseq.sequencer import VirtualClock
from labseq.session.construct import construct
from labseq.session.planning import recorded_machine
from labseq.session.profile import ResolvedProfile

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_FULL: Final = 20
"""Saturated pixels that a frame may have whatever its size: hot ones, cosmic rays."""


@dataclass(frozen=True, slots=True)
class AnalysisResult:
    """What came of an analysis.

    Attributes:
        values: What the machine will use; see :class:`labseq.CalibrationEntry`.
        quality: Figures of merit.
        told: Lines for people.
        origin: What else must be known of where it comes from, JSON-ready.
        draw: Draws the picture to look at; None for none.
    """

    values: Mapping[str, ArrayLike]
    quality: Mapping[str, float]
    summary_lines: tuple[str, ...]
    origin: Mapping[str, Any] = field(default_factory=dict[str, Any])
    draw: Callable[[], Figure] | None = None


@dataclass(frozen=True, slots=True)
class CalibrationData:
    """A run, and the profile that it is analysed for.

    Attributes:
        run: The run.
        bench: The profile, with the calibrations that count in the analysis.
    """

    run: Run
    bench: ResolvedProfile

    def frames(self) -> Iterator[Frame]:
        """The frame of the first image of each shot: of randomly loaded atoms, before any move.

        Raises:
            ConfigError: The run has no shots, or kept no frames of them.
            DeviceError: The frames differ in size, or one is saturated.
            RecordingError: A shot's file is damaged.
        """
        if not self.run.shots:
            raise ConfigError(
                Problem("the run has no shots", str(self.run.path), expected="a run with frames")
            )
        from labseq.recording.shot import read_frames

        first: Frame | None = None
        for shot in self.run.shots:
            frame = read_frames(shot.file).get(0)
            if frame is None:
                what = f"the first image of shot {shot.index + 1} was not kept"
                hint = "take a run with 'record_frames: all'"
                raise ConfigError(
                    Problem(what, str(self.run.path), expected="a frame of each shot", hint=hint)
                )
            first = first or frame
            if frame.image.shape != first.image.shape:
                sizes = f"{first.image.shape} and {frame.image.shape}"
                raise DeviceError(frame.camera, f"frames of the run differ in size: {sizes}")
            self._refuse_saturated(frame, shot.index)
            yield frame

    def _refuse_saturated(self, frame: Frame, shot: int) -> None:
        n_full = int(np.count_nonzero(frame.image == np.iinfo(frame.image.dtype).max))
        if n_full > max(MIN_FULL, self.bench.grid.n_rows * self.bench.grid.n_cols // 20):
            text = f"{n_full} pixels of the first frame of shot {shot + 1} are saturated"
            raise DeviceError(frame.camera, f"{text}; use less light, gain or exposure")

    def detector(self) -> Detector:
        """The profile's detector, with the calibrations that count in the analysis."""
        bench = self.bench
        chosen, clock = {"detector": bench.chosen["detector"]}, VirtualClock(StopFlag())
        made, _ = construct(
            chosen, bench.grid, bench.profile.motion, clock, 0, calibrations=bench.calibrations
        )
        return made["detector"]


class Method(Protocol):
    """How calibrations of a kind are made."""

    @property
    def kind(self) -> CalibrationKind:
        """The kind."""
        ...

    @property
    def sequence(self) -> Path:
        """The sequence that is run."""
        ...

    @property
    def aside(self) -> Collection[CalibrationKind]:
        """Kinds that do not count, neither while it is measured nor in the analysis."""
        ...

    @property
    def is_blind(self) -> bool:
        """Whether the run needs no detector, which may not know yet where to look."""
        ...

    def analyse(self, evidence: CalibrationData) -> AnalysisResult:
        """Make a calibration of a run.

        Raises:
            LabseqError: Nothing can be made of it; says why.
        """
        ...

    def read(self, path: Path, bench: ResolvedProfile) -> AnalysisResult:
        """Make a calibration of a file with its values.

        Raises:
            ConfigError: The file is wrong, or calibrations of this kind come from runs only.
        """
        ...


def from_runs_only(kind: CalibrationKind, path: Path) -> ConfigError:
    """The error of a kind that comes from no file."""
    what = f"a calibration of {kind} cannot be made of a file"
    return ConfigError(Problem(what, str(path), expected="a run's folder"))


def packaged(kind: CalibrationKind) -> Path:
    """The sequence of a kind, as it comes with labseq."""
    return Path(__file__).with_name(f"{kind}.yaml")


def mean_of(frames: Iterator[Frame]) -> tuple[np.ndarray[tuple[int, int], np.dtype[np.float64]], int]:
    """Mean of frames, float64 (height, width), and how many they are; one at a time is in memory."""
    first = next(frames)
    total, n = first.image.astype(np.float64), 1
    for frame in frames:
        total += frame.image
        n += 1
    return total / n, n


_ADDRESS = ".probe.offset"


@dataclass(frozen=True, slots=True, eq=False)
class ProbeCounts:
    """What a scan of the probe's offset saw.

    Attributes:
        offset_m: float64 (n_points, 2), commanded offsets along a1 and a2.
        n_before: int64 (n_points, n_rows, n_cols), atoms that were probed on each site.
        n_survived: int64, likewise: how many of them were seen afterwards.
        grid: The grid, with the tones that were played.
        motion: How the tweezers moved.
        in_use_m: float64 (2,), the offset that an overlay calibration made up for in the run.
        calibrations: Those in use in the run: kind -> id.
    """

    offset_m: NDArray[np.float64]
    n_before: NDArray[np.int64]
    n_survived: NDArray[np.int64]
    grid: SiteGrid
    motion: MotionSpec
    in_use_m: NDArray[np.float64]
    calibrations: dict[str, str]


def read_probed(run: Run) -> ProbeCounts:
    """Count, at each offset and on each site, the atoms before and after the probe.

    Raises:
        ConfigError: The run does not scan the offset of a probe between two images.
        RecordingError: A shot's file is damaged.
    """
    before: dict[tuple[float, float], NDArray[np.int64]] = {}
    after: dict[tuple[float, float], NDArray[np.int64]] = {}
    for shot in run.shots:
        offset = next((v for k, v in shot.parameters.items() if k.endswith(_ADDRESS)), None)
        seen = shot.occupancies
        if offset is None or len(seen) < 2:
            what = "the run does not scan the offset of a probe between two images"
            expected = "one such as 'labseq calibrate overlay' takes"
            raise ConfigError(Problem(what, str(run.path), expected=expected))
        point = float(offset[0]), float(offset[1])
        before[point] = before.get(point, 0) + seen[0].astype(np.int64)
        after[point] = after.get(point, 0) + (seen[0] & seen[-1]).astype(np.int64)
    if not before:
        raise ConfigError(
            Problem("the run has no shots", str(run.path), expected="a scan of a probe's offset")
        )
    machine = recorded_machine(run.record["resolved"]["profile"], "the profile of the run")
    calibrations: dict[str, str] = dict(run.record.get("calibrations") or {})
    in_use_m = np.zeros(2)
    if "overlay" in calibrations:
        in_use_m = read_entry(run.path / "calibration_overlay.json").values["offset_m"]
    return ProbeCounts(
        np.array([*before]),
        np.stack([*before.values()]),
        np.stack([*after.values()]),
        machine.grid,
        machine.motion,
        in_use_m,
        calibrations,
    )
