"""Frames once more: what a detector makes of the frames that a run has kept."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from labseq.model import ImageRecord
from labseq.recording import Shot
from labseq.roles import Detector

N_ATOMS_TRUE = "simulation.n_atoms_true"
"""Reading of a simulated shot: how many atoms there really are at its end."""


@dataclass(frozen=True, slots=True)
class ReplayedImage:
    """An image whose frame was kept, and what a detector makes of it.

    Attributes:
        shot: Index of the shot, from 0.
        image: Index of the image in the shot, from 0.
        n_atoms: Atoms that were seen in the run.
        n_atoms_replayed: Atoms that the detector sees.
        n_appeared: Sites where the detector alone sees an atom.
        n_vanished: Sites where the run alone saw one.
        confidence: Mean confidence in the run.
        confidence_replayed: That of the detector.
        n_atoms_true: How many there really are after the shot's last image; None if nobody knows.
    """

    shot: int
    image: int
    n_atoms: int
    n_atoms_replayed: int
    n_appeared: int
    n_vanished: int
    confidence: float
    confidence_replayed: float
    n_atoms_true: int | None


@dataclass(slots=True, eq=False)
class ReplayedImages:
    """What a detector sees on the frames of a run.

    Attributes:
        images: Each image whose frame was kept.
        appeared: On how many of them the detector alone sees an atom, int64 (n_rows, n_cols).
        vanished: On how many of them the run alone saw one, int64 (n_rows, n_cols).
        n_without_frame: Images whose frame was not kept.
        failures: Index of a shot, of an image -> what the detector raised.
    """

    images: list[ReplayedImage]
    appeared: NDArray[np.int64]
    vanished: NDArray[np.int64]
    n_without_frame: int = 0
    failures: dict[tuple[int, int], str] = field(default_factory=dict[tuple[int, int], str])

    @classmethod
    def none(cls, shape: tuple[int, int]) -> ReplayedImages:
        """To begin with.

        Args:
            shape: n_rows and n_cols of the grid.
        """
        return cls([], np.zeros(shape, np.int64), np.zeros(shape, np.int64))

    @property
    def n_differing(self) -> int:
        """Sites that differ, over all images."""
        return int(self.appeared.sum() + self.vanished.sum())

    def add(self, shot: Shot, detector: Detector) -> None:
        """Let the frames of a shot go through a detector.

        Raises:
            RecordingError: The shot cannot be read.
        """
        images, truth = shot.record().images, shot.readings.get(N_ATOMS_TRUE)
        for i, image in enumerate(images):
            if image.frame is None:
                self.n_without_frame += 1
                continue
            try:
                occupancy, confidence = detector.detect(image.frame)
                seen = np.asarray(occupancy, np.bool_).reshape(image.occupancy.shape)
                told = float(np.mean(confidence))
            except (Exception, SystemExit) as error:  # noqa: BLE001 - a plugin may raise anything
                self.failures[shot.index, i] = f"{type(error).__name__}: {error}"
                continue
            is_last = i == len(images) - 1
            self._note(
                shot.index, i, image, seen, told, int(truth) if is_last and truth is not None else None
            )

    def _note(
        self,
        shot: int,
        number: int,
        image: ImageRecord,
        seen: NDArray[np.bool_],
        confidence: float,
        n_atoms_true: int | None,
    ) -> None:
        appeared, vanished = seen & ~image.occupancy, image.occupancy & ~seen
        self.appeared += appeared
        self.vanished += vanished
        self.images.append(
            ReplayedImage(
                shot=shot,
                image=number,
                n_atoms=int(np.count_nonzero(image.occupancy)),
                n_atoms_replayed=int(np.count_nonzero(seen)),
                n_appeared=int(np.count_nonzero(appeared)),
                n_vanished=int(np.count_nonzero(vanished)),
                confidence=float(np.mean(image.confidence)),
                confidence_replayed=confidence,
                n_atoms_true=n_atoms_true,
            )
        )
