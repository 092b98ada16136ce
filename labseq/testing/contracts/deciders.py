"""Promises of detectors, scanners and analyses, which are pure functions of frames, results and shots."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, TypeAlias, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from labseq.errors import LabseqError
from labseq.model import Frame, ScanRange, ScanSpace, SiteGrid, VisitedPoint
from labseq.plain import dumps
from labseq.recording.results import ResultsLog
from labseq.roles import Analysis, Context, Detection, Detector, RecordedShot, ReportsSignals, Scanner
from labseq.testing.contracts.promises import (
    ContractViolation,
    doing,
    format_error,
    in_time,
    no_factory,
    promise,
    promised,
    quietly,
    refusal,
)
from labseq.testing.fakes import FakeShot, fake_shot

DetectorFactory: TypeAlias = Callable[[Context], Detector]


class DetectorContract:
    """Promises of a detector. Provide the fixture ``factory``.

    Attributes:
        frame_shape: (height, width) of the frames that the detector takes.
    """

    frame_shape: ClassVar[tuple[int, int]] = (512, 512)

    @pytest.fixture
    def factory(self) -> DetectorFactory:
        """Constructs the detector from a context. Provided by the plugin's test."""
        no_factory(self, "context -> detector")

    def context(self) -> Context:
        """Context of the detector. Override it for another grid."""
        return Context("detector", SiteGrid())

    def frames(self) -> dict[str, Frame]:
        """Frames of the right size, as description -> frame."""
        noise = np.random.default_rng(7).integers(0, 2000, self.frame_shape, np.uint16)
        return {
            "a noisy frame": _frame_of(noise),
            "a black frame": _frame_of(np.zeros(self.frame_shape, np.uint16)),
            "a saturated frame": _frame_of(np.full(self.frame_shape, 65535, np.uint16)),
        }

    @promise(
        "detect() gives bool (n_rows, n_cols), float32 (n_rows, n_cols) from 0 to 1, and perhaps signals"
    )
    def test_gives_occupancy_and_confidence(self, factory: DetectorFactory) -> None:
        """Detect atoms on frames of every kind."""
        context = self.context()
        detector = factory(context)
        for what, frame in self.frames().items():
            answer: Any = detector.detect(frame)
            assert isinstance(answer, tuple), f"detect() gave a {type(answer).__name__}"
            occupancy, confidence, *signals = answer
            _require_array(f"on {what} the occupancy", occupancy, np.bool_, context.grid.shape)
            _require_array(f"on {what} the confidence", confidence, np.float32, context.grid.shape)
            assert np.all((confidence >= 0) & (confidence <= 1)), (
                f"on {what} the confidence ranges from {confidence.min()} to {confidence.max()}"
            )
            if signals:
                _require_array(f"on {what} the signals", signals[0], np.float64, context.grid.shape)
            if signals and isinstance(detector, ReportsSignals):
                decided = signals[0] > detector.thresholds
                assert np.array_equal(occupancy, decided), f"on {what} the signals contradict the occupancy"

    @promise("the same frame gives the same answer")
    def test_same_frame_same_answer(self, factory: DetectorFactory) -> None:
        """Repeat a frame, also after other frames and with a new instance."""
        detector = factory(self.context())

        def answer_of(any_detector: Detector) -> Detection:
            return any_detector.detect(self.frames()["a noisy frame"])

        first = answer_of(detector)
        again = {"the second time": answer_of(detector)}
        for other in self.frames().values():
            detector.detect(other)
        again["after other frames"] = answer_of(detector)
        again["from a new instance"] = answer_of(factory(self.context()))
        for when, answer in again.items():
            for name, was, now in zip(("occupancy", "confidence", "signals"), first, answer, strict=False):
                assert np.array_equal(was, now), f"the {name} differs {when}"

    @promise("an answer does not change after it was given")
    def test_answers_do_not_change(self, factory: DetectorFactory) -> None:
        """Otherwise the next answer overwrites the last one in the detector's buffers."""
        detector = factory(self.context())
        frames = self.frames()
        answer = detector.detect(frames["a noisy frame"])
        before = [np.array(array) for array in answer]
        for frame in frames.values():
            detector.detect(frame)
        for name, was, now in zip(("occupancy", "confidence", "signals"), before, answer, strict=False):
            assert np.array_equal(was, now), f"the next frame overwrote the {name}"

    @promise("the frame is left untouched")
    def test_leaves_the_frame_untouched(self, factory: DetectorFactory) -> None:
        """The frame is written to disk afterwards."""
        detector = factory(self.context())
        frame = self.frames()["a noisy frame"]
        before = np.array(frame.image)
        detector.detect(frame)
        assert np.array_equal(before, frame.image), "detect() changed the image"

    @promise("a frame of the wrong size raises LabseqError")
    def test_refuses_other_sizes(self, factory: DetectorFactory) -> None:
        """Pass frames that are smaller, larger or turned."""
        height, width = self.frame_shape
        detector = factory(self.context())
        for shape in {(height - 1, width), (height, width + 1), (2 * height, 2 * width), (1, 1)}:
            if shape != self.frame_shape:
                frame = _frame_of(np.zeros(shape, np.uint16))
                refusal(LabseqError, f"a frame of {shape}", detector.detect, frame)

    @promise("detect() is pure: no I/O, no change of shared state")
    def test_does_no_io(self, factory: DetectorFactory) -> None:
        """The detector runs between the exposure and the moves."""
        detector = factory(self.context())
        frame = self.frames()["a noisy frame"]
        with doing("the first detect()"):
            detector.detect(frame)  # the first call may compile
        with quietly():
            detector.detect(frame)


def _require_array(what: str, array: Any, dtype: type[np.generic], shape: tuple[int, int]) -> None:
    assert isinstance(array, np.ndarray), f"{what} is a {type(array).__name__}"
    came = f"{what} is {array.dtype} {array.shape}; expected {np.dtype(dtype)} {shape}"
    assert array.dtype == dtype, came
    assert array.shape == shape, came


def _frame_of(image: NDArray[np.uint16]) -> Frame:
    return Frame(image, 0.045, 0.0)


ScannerFactory: TypeAlias = Callable[[ScanSpace], Scanner]
Scores: TypeAlias = Callable[[ScanSpace, Mapping[str, float]], float]

GIVES_POINTS: Final = "next_point() soon gives an allowed value for each address, or later None"


class ScannerContract:
    """Promises of a scanner. Provide the fixture ``factory``.

    Attributes:
        n_points: Number of points in each test.
        time_limit_s: Longest time for one point, in seconds.
    """

    n_points: ClassVar[int] = 25
    time_limit_s: ClassVar[float] = 5.0

    @pytest.fixture
    def factory(self) -> ScannerFactory:
        """Constructs the scanner from a space. Provided by the plugin's test."""
        no_factory(self, "space -> scanner")

    def spaces(self) -> dict[str, ScanSpace]:
        """The spaces to choose from, as description -> space."""
        dop = ScanRange("planner.degree_of_parallelism", 2, 15, is_whole=True, start=7)
        ramp = ScanRange("profile.mobile_tweezers.pick_up", 20e-6, 400e-6)
        speed = ScanRange("profile.mobile_tweezers.speed", 0.05, 0.2, n_steps=10, start=0.13)
        two = ScanRange("shot.2.rearrange.cycles", 1, 2, is_whole=True)
        ranges = {"all kinds of range": (dop, ramp, speed), "one quantity": (ramp,), "two values": (two,)}
        return {kind: ScanSpace(axes, self.n_points, 2, seed=5) for kind, axes in ranges.items()}

    @promise(GIVES_POINTS)
    def test_points_are_in_their_ranges(self, factory: ScannerFactory) -> None:
        """Choose points with scores that rise, stay the same or are missing."""
        for what, space in self.spaces().items():
            for kind, scores in _SCORES.items():
                with doing(f"on {what}, {kind}"):
                    self.visited(factory(space), space, scores)

    @promise("the same space and the same results give the same point")
    def test_same_results_same_point(self, factory: ScannerFactory) -> None:
        """Repeat, also with a new instance that receives all results at once, as in a resumed run."""
        for what, space in self.spaces().items():
            scanner = factory(space)
            visited = self.visited(scanner, space, _hill)
            for n in {0, 1, len(visited) // 2, len(visited)}:
                results = _copies(visited[:n])
                answers = [_plain(each.next_point(_copies(results))) for each in (scanner, factory(space))]
                earlier = _plain(visited[n].values) if n < len(visited) else answers[0]
                assert answers == [earlier] * 2, f"on {what}, point {n} was {earlier}, and now is {answers}"

    @promise("the input is left untouched")
    def test_leaves_its_input_untouched(self, factory: ScannerFactory) -> None:
        """Other code uses the same points."""
        space = self.spaces()["all kinds of range"]
        scanner = factory(space)
        visited = self.visited(scanner, space, _hill)
        given = _copies(visited)
        scanner.next_point(given)
        assert given == visited, "it changed the points"

    @promise("it is pure: no I/O, no change of shared state")
    def test_is_pure(self, factory: ScannerFactory) -> None:
        """Watch for I/O and shared state, which a resumed run does not have."""
        space = self.spaces()["all kinds of range"]
        visited = self.visited(factory(space), space, _hill)  # the first call may compile
        with quietly():
            factory(space).next_point(visited)

    def visited(self, scanner: Scanner, space: ScanSpace, scores: Scores) -> list[VisitedPoint]:
        """The points that the scanner chooses in turn, ``n_points`` at most, each checked."""
        visited: list[VisitedPoint] = []
        with promised(GIVES_POINTS):
            while len(visited) < self.n_points:
                so_far = tuple(_copies(visited))
                point: Any = in_time(self.time_limit_s, "next_point()", scanner.next_point, so_far)
                if point is None:
                    assert visited, "next_point() gave no point at all"
                    break
                _check_point(point, space)
                visited.append(VisitedPoint(dict(point), scores(space, point)))
        return visited


def _check_point(point: Any, space: ScanSpace) -> None:
    """Fail unless the point is in the space."""
    assert isinstance(point, Mapping), f"next_point() gave a {type(point).__name__}"
    values = cast("Mapping[str, Any]", point)
    expected = {axis.address for axis in space.ranges}
    assert {*values} == expected, (
        f"next_point() gave values for {sorted(values)}; expected {sorted(expected)}"
    )
    for axis in space.ranges:
        value = values[axis.address]
        assert axis.allowed(value) is not None, f"{value!r} for '{axis.address}' is not in its range"


def _copies(visited: Sequence[VisitedPoint]) -> list[VisitedPoint]:
    """Copies of the points, which a scanner may change without an effect on other tests."""
    return [VisitedPoint(dict(point.values), point.score) for point in visited]


def _hill(space: ScanSpace, point: Mapping[str, float]) -> float:
    return -sum((axis.fraction(point[axis.address]) - 0.3) ** 2 for axis in space.ranges)


def _constant_score(score: float) -> Scores:
    def scores(space: ScanSpace, point: Mapping[str, float]) -> float:
        del space, point
        return score

    return scores


_SCORES: dict[str, Scores] = {
    "on a hill": _hill,
    "on a plain": _constant_score(0.0),
    "without a single score": _constant_score(math.nan),
}


def _plain(point: Mapping[str, float] | None) -> dict[str, float] | None:
    return None if point is None else dict(point)


AnalysisFactory: TypeAlias = Callable[[Context], Analysis]

GIVES_RESULTS: Final = "shot() gives names and numbers, texts, arrays, or lists and mappings of them"


class AnalysisContract:
    """Promises of an analysis. Provide the fixture ``factory``."""

    @pytest.fixture
    def factory(self) -> AnalysisFactory:
        """Constructs the analysis from a context. Provided by the plugin's test."""
        no_factory(self, "context -> analysis")

    def context(self) -> Context:
        """Context of the analysis. Override it for another grid or calibrations."""
        return Context("analysis", SiteGrid(6, 7))

    def shots(self) -> Mapping[str, FakeShot]:
        """Valid shots, as description -> shot. Override it if the analysis needs other shots."""
        shape = self.context().grid.shape
        return {
            "a shot of two images": fake_shot(shape, n_images=2),
            "a shot of three images and two cycles": fake_shot(shape, index=1, n_images=3, n_cycles=2),
        }

    def odd_shots(self) -> Mapping[str, FakeShot]:
        """Incomplete shots, as description -> shot."""
        shape = self.context().grid.shape
        return {
            "a shot without images": fake_shot(shape, n_images=0),
            "a shot of one image": fake_shot(shape, n_images=1),
            "a shot whose frames were not kept": fake_shot(shape, n_images=2, frame_shape=None),
            "a shot without atoms": fake_shot(shape, n_images=2, filling=0.0),
        }

    @promise(GIVES_RESULTS)
    def test_gives_results(self, factory: AnalysisFactory) -> None:
        """Check names and values. Results become a line of JSON, which already has "shot" and "error"."""
        analysis = factory(self.context())
        for what, shot in self.shots().items():
            with doing(what):
                _check_value(ResultsLog.checked(_result_of(analysis, shot)), "the result")

    @promise("the same shot gives the same result, whatever shots came before it")
    def test_same_shot_same_result(self, factory: AnalysisFactory) -> None:
        """Shots are analysed in another order when a run is resumed or analysed again."""
        analysis, shots = factory(self.context()), self.shots()
        first = {what: dumps(_result_of(analysis, shot)) for what, shot in shots.items()}
        for what, shot in reversed([*shots.items()]):
            assert dumps(_result_of(analysis, shot)) == first[what], (
                f"{what} gives a different result the second time"
            )
            fresh = _result_of(factory(self.context()), shot)
            assert dumps(fresh) == first[what], f"{what} gives a different result from a new instance"

    @promise("the shot is left untouched")
    def test_leaves_the_shot_untouched(self, factory: AnalysisFactory) -> None:
        """Other analyses and the shot's file use the same arrays."""
        analysis = factory(self.context())
        for what, shot in self.shots().items():
            before = copy.deepcopy(_arrays(shot))
            _result_of(analysis, shot)
            for name, array in _arrays(shot).items():
                assert np.array_equal(before[name], array), f"of {what} it changed {name}"

    @promise("an incomplete shot gives a result, or raises LabseqError")
    def test_takes_odd_shots(self, factory: AnalysisFactory) -> None:
        """Analyse shots without images, without frames and without atoms."""
        analysis = factory(self.context())
        for what, shot in self.odd_shots().items():
            with doing(what):
                try:
                    result = analysis.shot(shot)
                except LabseqError:
                    continue
                with promised(GIVES_RESULTS):
                    _check_value(ResultsLog.checked(result), "the result")

    @promise("shot() is pure: no I/O, no change of shared state")
    def test_is_pure(self, factory: AnalysisFactory) -> None:
        """The results are stored by labseq."""
        analysis = factory(self.context())
        for shot in self.shots().values():
            _result_of(analysis, shot)  # the first call may compile
            with quietly():
                _result_of(analysis, shot)


def _result_of(analysis: Analysis, shot: RecordedShot) -> Any:
    try:
        return analysis.shot(shot)
    except Exception as error:
        raise ContractViolation(GIVES_RESULTS, f"it {format_error(error)}") from error


def _check_value(value: Any, what: str) -> None:
    """Fail for values that a line of results could only contain as their ``repr``."""
    if isinstance(value, Mapping):
        for name, one in cast("Mapping[Any, Any]", value).items():
            assert isinstance(name, str), f"{what} has the name {name!r}; expected text"
            _check_value(one, f"'{name}'")
    elif isinstance(value, list | tuple):
        for one in cast("Sequence[Any]", value):
            _check_value(one, f"an element of {what}")
    else:
        is_plain = value is None or isinstance(value, bool | int | float | str | np.generic)
        is_array = isinstance(value, np.ndarray) and value.dtype.kind in "biufSU"
        assert is_plain or is_array, f"{what} is a {type(value).__name__}"


def _arrays(shot: RecordedShot) -> dict[str, Any]:
    images = {
        f"the {name} of image {i}": getattr(image, name)
        for i, image in enumerate(shot.images)
        for name in ("occupancy", "confidence")
    }
    stacks = {name: getattr(shot, name) for name in ("occupancies", "confidences", "frames")}
    return {**images, **stacks, "the target": shot.target.fill}
