"""What a detector promises."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.errors import LabseqError
from labseq.model import Frame, SiteGrid
from labseq.roles import Context, Detector
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import doing, no_factory, promise, refusal

DetectorFactory: TypeAlias = Callable[[Context], Detector]


class DetectorContract:
    """Promises of a detector; provide the fixture ``factory``.

    Attributes:
        frame_shape: (height, width) of the frames that it takes.
    """

    frame_shape: ClassVar[tuple[int, int]] = (512, 512)

    @pytest.fixture
    def factory(self) -> DetectorFactory:
        """Constructs the detector, given a context; provided by the plugin's test."""
        no_factory(self, "context -> detector")

    def context(self) -> Context:
        """What the detector is constructed with; override it for another grid."""
        return Context("detector", SiteGrid())

    def frames(self) -> dict[str, Frame]:
        """Frames of the right size: description -> frame."""
        noise = np.random.default_rng(7).integers(0, 2000, self.frame_shape, np.uint16)
        return {
            "a noisy frame": _frame_of(noise),
            "a black frame": _frame_of(np.zeros(self.frame_shape, np.uint16)),
            "a saturated frame": _frame_of(np.full(self.frame_shape, 65535, np.uint16)),
        }

    @promise("detect() gives bool (n_rows, n_cols) and float32 (n_rows, n_cols) between 0 and 1")
    def test_gives_occupancy_and_confidence(self, factory: DetectorFactory) -> None:
        """On frames of every kind."""
        context = self.context()
        detector = factory(context)
        for what, frame in self.frames().items():
            answer: Any = detector.detect(frame)
            assert isinstance(answer, tuple), f"detect() gave a {type(answer).__name__}"
            occupancy, confidence = answer
            _require_array(f"on {what} the occupancy", occupancy, np.bool_, context.grid.shape)
            _require_array(f"on {what} the confidence", confidence, np.float32, context.grid.shape)
            assert np.all((confidence >= 0) & (confidence <= 1)), (
                f"on {what} the confidence reaches from {confidence.min()} to {confidence.max()}"
            )

    @promise("the same frame gives the same answer")
    def test_same_frame_same_answer(self, factory: DetectorFactory) -> None:
        """Again, after other frames, and from a fresh instance."""
        detector = factory(self.context())

        def answer_of(any_detector: Detector) -> tuple[NDArray[Any], NDArray[Any]]:
            return any_detector.detect(self.frames()["a noisy frame"])

        first = answer_of(detector)
        again = {"the second time": answer_of(detector)}
        for other in self.frames().values():
            detector.detect(other)
        again["after other frames"] = answer_of(detector)
        again["from a fresh instance"] = answer_of(factory(self.context()))
        for when, answer in again.items():
            for name, was, now in zip(("occupancy", "confidence"), first, answer, strict=True):
                assert np.array_equal(was, now), f"the {name} is another {when}"

    @promise("an answer does not change after it was given")
    def test_answers_do_not_change(self, factory: DetectorFactory) -> None:
        """A detector that hands out its own arrays would overwrite the last answer with the next."""
        detector = factory(self.context())
        frames = self.frames()
        answer = detector.detect(frames["a noisy frame"])
        before = [np.array(array) for array in answer]
        for frame in frames.values():
            detector.detect(frame)
        for name, was, now in zip(("occupancy", "confidence"), before, answer, strict=True):
            assert np.array_equal(was, now), f"the next frame overwrote the {name}"

    @promise("the frame is left untouched")
    def test_leaves_the_frame_untouched(self, factory: DetectorFactory) -> None:
        """It is written to disk afterwards."""
        detector = factory(self.context())
        frame = self.frames()["a noisy frame"]
        before = np.array(frame.image)
        detector.detect(frame)
        assert np.array_equal(before, frame.image), "detect() changed the image"

    @promise("a frame of the wrong size raises LabseqError")
    def test_refuses_other_sizes(self, factory: DetectorFactory) -> None:
        """Smaller, larger, turned."""
        height, width = self.frame_shape
        detector = factory(self.context())
        for shape in {(height - 1, width), (height, width + 1), (2 * height, 2 * width), (1, 1)}:
            if shape != self.frame_shape:
                frame = _frame_of(np.zeros(shape, np.uint16))
                refusal(LabseqError, f"a frame of {shape}", detector.detect, frame)

    @promise("detect() is pure: no I/O, nothing changed that all code shares")
    def test_does_no_io(self, factory: DetectorFactory) -> None:
        """It runs between the exposure and the moves."""
        detector = factory(self.context())
        frame = self.frames()["a noisy frame"]
        with doing("the first detect()"):
            detector.detect(frame)  # may compile
        with quietly():
            detector.detect(frame)


def _require_array(what: str, array: Any, dtype: type[np.generic], shape: tuple[int, int]) -> None:
    assert isinstance(array, np.ndarray), f"{what} is a {type(array).__name__}"
    came = f"{what} is {array.dtype} {array.shape}; expected {np.dtype(dtype)} {shape}"
    assert array.dtype == dtype, came
    assert array.shape == shape, came


def _frame_of(image: NDArray[np.uint16]) -> Frame:
    return Frame(image, 0.045, 0.0)
