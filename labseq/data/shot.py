"""Reads a recorded shot from the index and its file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from labseq.errors import RecordingError
from labseq.model import CycleRecord, ImageRecord, Plan, ShotRecord, StageTiming, StepTiming, TargetPattern
from labseq.model.records import LineEdge, ShotStatus
from labseq.recording.index import IndexRow, digest_of

if TYPE_CHECKING:
    from labseq.recording.shot_file import ShotContent


def load_content(path: Path) -> ShotContent:
    """Read a shot's file without its frames, see :func:`labseq.recording.shot_file.read_content`."""
    from labseq.recording.shot_file import read_content  # h5py takes 0.1 s to import

    return read_content(path)


class CachingLoader:
    """Reads shots' files and keeps the last eight, so that several values of a shot read its file once."""

    def __init__(self) -> None:
        self._read = lru_cache(maxsize=8)(load_content)

    def __call__(self, path: Path) -> ShotContent:
        """The content of a shot's file."""
        return self._read(path)

    def __reduce__(self) -> tuple[type[CachingLoader], tuple[()]]:
        return CachingLoader, ()  # another process reads the files itself


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Shot:
    """A recorded shot. Values in the index are known at once, all others are read from its file when needed.

    Every property from ``occupancies`` onwards raises ``RecordingError`` if the file is missing or damaged.

    Attributes:
        run_dir: The run's folder.
        row: The shot as the index lists it.
    """

    run_dir: Path
    row: IndexRow
    _load: Callable[[Path], ShotContent] = load_content

    def __repr__(self) -> str:
        return f"<Shot {self.index}: {self.status}, {self.file}>"

    @property
    def file(self) -> Path:
        """The shot's HDF5 file."""
        return self.run_dir / self.row.file

    @property
    def index(self) -> int:
        """Index in the run, from 0."""
        return self.row.shot

    @property
    def attempt(self) -> int:
        """Number of the attempt, from 0."""
        return self.row.attempt

    @property
    def status(self) -> ShotStatus:
        """The status: "complete", "interrupted" or "failed"."""
        return self.row.status

    @property
    def success(self) -> bool:
        """Whether the last ``image`` step met the target."""
        return bool(self.row.success)

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on the last ``image`` step. nan without such a step."""
        return self.row.filling_fraction

    @property
    def seen_defect_free_cycle(self) -> int:
        """Index of the first cycle whose image met the target. -1 if none did."""
        return self.row.seen_defect_free_cycle

    @property
    def occupancies(self) -> NDArray[np.bool_]:
        """The detected occupancies, bool (n_images, n_rows, n_cols)."""
        from labseq.recording.shot_file import read_occupancies

        # takes a seventh of the time to read the whole file
        return read_occupancies(self.file)[1].astype(np.bool_)

    @property
    def signals(self) -> NDArray[np.float64]:
        """The detector's signals, float64 (n_images, n_rows, n_cols). nan where it reported none."""
        none = np.full(self._content.target.shape, np.nan)
        signals = [none if image.signal is None else image.signal for image in self.images]
        return np.array(signals, np.float64).reshape(len(signals), *none.shape)

    @property
    def thresholds(self) -> NDArray[np.float64] | None:
        """The thresholds of the signals, float64 (n_rows, n_cols). None if the detector reported none."""
        return self._content.record.thresholds

    @property
    def sites_px(self) -> NDArray[np.float64] | None:
        """(y, x) of each site on the frames, float64 (n_rows, n_cols, 2). None if it was not reported."""
        return self._content.record.sites_px

    @property
    def confidences(self) -> NDArray[np.float32]:
        """The detector's confidence, float32 (n_images, n_rows, n_cols)."""
        shape = (len(self.images), *self._content.target.shape)
        return np.array([image.confidence for image in self.images], np.float32).reshape(shape)

    @property
    def target(self) -> TargetPattern:
        """The target of the run."""
        return self._content.target

    @property
    def images(self) -> tuple[ImageRecord, ...]:
        """The images without their frames, in the order they were taken."""
        return tuple(self._content.record.images)

    @property
    def plans(self) -> tuple[Plan, ...]:
        """The plan of each cycle."""
        return tuple(cycle.plan for cycle in self.cycles)

    @property
    def cycles(self) -> tuple[CycleRecord, ...]:
        """The rearrangement cycles."""
        return tuple(self._content.record.cycles)

    @property
    def steps(self) -> tuple[StepTiming, ...]:
        """Planned and achieved durations of the steps."""
        return tuple(self._content.record.steps)

    @property
    def edges(self) -> tuple[LineEdge, ...]:
        """The changes of the digital lines as the timing box played them. Empty without a timing box."""
        return tuple(self._content.record.edges)

    @property
    def timing(self) -> tuple[StageTiming, ...]:
        """The stages, in the order they ended."""
        return tuple(self._content.record.timing)

    @property
    def parameters(self) -> dict[str, Any]:
        """Settings of this shot that differ from the files: address -> value, scanned values in SI."""
        return dict(self.row.parameters)

    @property
    def calibrations(self) -> dict[str, str]:
        """The calibrations in use: kind -> id."""
        return dict(self.row.calibrations)

    @property
    def readings(self) -> dict[str, Any]:
        """Values read from devices during the shot."""
        return dict(self._content.record.readings)

    @property
    def atom_events(self) -> dict[str, NDArray[Any]]:
        """Events of the atoms in the simulation: name -> structured array. Empty on real hardware."""
        return dict(self._content.record.atom_events)

    @property
    def provenance(self) -> dict[str, Any]:
        """Seed, versions, texts and settings from the shot's file."""
        run = self._content.run
        texts = {name: run[f"{name}_text"] for name in ("sequence", "profile")}
        settings = {name: run[name] for name in ("resolved", "overrides", "plugins")}
        return {**run["provenance"], "seed": self._content.record.seed, **texts, **settings}

    @property
    def devices(self) -> dict[str, Any]:
        """The description of each device."""
        return dict(self._content.run["devices"])

    @property
    def frames(self) -> NDArray[np.uint16]:
        """The recorded frames, uint16 (n_frames, height, width). Read from the file each time.

        Raises:
            RecordingError: The frames differ in size. :meth:`record` gives them one by one.
        """
        from labseq.recording.shot_file import read_frames

        images = [frame.image for frame in read_frames(self.file).values()]
        if len({image.shape for image in images}) > 1:
            raise RecordingError(self.file, "holds frames of several sizes", "use shot.record().images")
        return np.stack(images) if images else np.empty((0, 0, 0), np.uint16)

    def record(self) -> ShotRecord:
        """The whole record as it was written, including frames."""
        from labseq.recording.shot_file import read_frames, with_frames

        return with_frames(self._content.record, read_frames(self.file))

    def verify(self) -> None:
        """Compare the file with the checksum in the index.

        Raises:
            RecordingError: The file cannot be read, or has changed since it was written.
        """
        try:
            sha256 = digest_of(self.file, self.row.bytes).sha256
        except OSError as error:
            raise RecordingError(self.file, f"cannot be read: {error.strerror}", "check the disk") from error
        if sha256 != self.row.sha256:
            raise RecordingError(self.file, "has changed since it was written", "restore it from a backup")

    @property
    def _content(self) -> ShotContent:
        return self._load(self.file)
