"""Detectors that break one promise each."""

import os
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from labseq.errors import DeviceError
from labseq.model import Frame, Occupancy
from labseq.roles import Context
from labseq.testing import DetectorContract

from .planted import Planted


class Suite(DetectorContract):
    frame_shape: ClassVar[tuple[int, int]] = (40, 60)


class BlockDetector:
    """Right: one block of 2 x 3 pixels per site of 20 x 20."""

    def __init__(self, context: Context) -> None:
        self.grid_shape = context.grid.shape

    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        if frame.image.shape != Suite.frame_shape:
            raise DeviceError("detector", f"a frame of {frame.image.shape}")
        return self.decide(frame.image.reshape(20, 2, 20, 3).mean(axis=(1, 3)))

    def decide(self, counts: NDArray[np.float64]) -> Any:
        return counts > 1000, np.tanh(np.abs(counts - 1000) / 100).astype(np.float32)


class GivesDoubles(BlockDetector):
    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, confidence = super().decide(counts)
        return occupancy, confidence.astype(np.float64)


class GivesAnotherShape(BlockDetector):
    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, confidence = super().decide(counts)
        return occupancy, confidence.ravel()


class IsTooConfident(BlockDetector):
    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, confidence = super().decide(counts)
        return occupancy, 100 * confidence


class DividesByTheMean(BlockDetector):
    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, confidence = super().decide(counts)
        with np.errstate(invalid="ignore"):
            return occupancy, (confidence * (counts / counts)).astype(np.float32)


class LearnsAsItGoes(BlockDetector):
    mean = 0.0

    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, confidence = super().decide(counts + self.mean)
        self.mean = float(counts.mean())
        return occupancy, confidence


class SharesItsArray(BlockDetector):
    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.confidence = np.zeros(self.grid_shape, np.float32)

    def decide(self, counts: NDArray[np.float64]) -> Any:
        occupancy, self.confidence[...] = super().decide(counts)
        return occupancy, self.confidence


class SubtractsInPlace(BlockDetector):
    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        answer = super().detect(frame)
        frame.image.flags.writeable = True
        frame.image[...] //= 2
        return answer


class TakesAnySize(BlockDetector):
    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        image = np.resize(frame.image, Suite.frame_shape)
        return super().detect(Frame(image, frame.exposure_s, frame.t_start_s))


class ReadsAFile(BlockDetector):
    def detect(self, frame: Frame) -> tuple[Occupancy, NDArray[np.float32]]:
        Path(os.devnull).read_bytes()
        return super().detect(frame)


PLANTED = Planted(
    Suite(),
    BlockDetector,
    (
        (GivesDoubles, "test_gives_occupancy_and_confidence"),
        (GivesAnotherShape, "test_gives_occupancy_and_confidence"),
        (IsTooConfident, "test_gives_occupancy_and_confidence"),
        (DividesByTheMean, "test_gives_occupancy_and_confidence"),
        (LearnsAsItGoes, "test_same_frame_same_answer"),
        (SharesItsArray, "test_answers_do_not_change"),
        (SubtractsInPlace, "test_leaves_the_frame_untouched"),
        (TakesAnySize, "test_refuses_other_sizes"),
        (ReadsAFile, "test_does_no_io"),
    ),
)
