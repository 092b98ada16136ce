"""What an analysis of shots promises."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, TypeAlias, cast

import numpy as np
import pytest

from labseq.errors import LabseqError
from labseq.model import SiteGrid
from labseq.plain import dumps
from labseq.recording.results import ResultsLog
from labseq.roles import Analysis, Context, RecordedShot
from labseq.testing.contracts.process import quietly
from labseq.testing.contracts.promises import (
    ContractViolation,
    doing,
    format_error,
    no_factory,
    promise,
    promised,
)
from labseq.testing.fakes import FakeShot, fake_shot

AnalysisFactory: TypeAlias = Callable[[Context], Analysis]

GIVES_RESULTS: Final = "shot() gives names and numbers, texts, arrays, or lists and mappings of them"


class AnalysisContract:
    """Promises of an analysis; provide the fixture ``factory``."""

    @pytest.fixture
    def factory(self) -> AnalysisFactory:
        """Constructs the analysis, given a context; provided by the plugin's test."""
        no_factory(self, "context -> analysis")

    def context(self) -> Context:
        """What the analysis is constructed with; override it for another grid or calibrations."""
        return Context("analysis", SiteGrid(6, 7))

    def shots(self) -> Mapping[str, FakeShot]:
        """Shots that it can analyse: description -> shot; override it for what it needs of them."""
        shape = self.context().grid.shape
        return {
            "a shot of two images": fake_shot(shape, n_images=2),
            "a shot of three images and two cycles": fake_shot(shape, index=1, n_images=3, n_cycles=2),
        }

    def odd_shots(self) -> Mapping[str, FakeShot]:
        """Shots that come now and then: description -> shot."""
        shape = self.context().grid.shape
        return {
            "a shot without images": fake_shot(shape, n_images=0),
            "a shot of one image": fake_shot(shape, n_images=1),
            "a shot whose frames were not kept": fake_shot(shape, n_images=2, frame_shape=None),
            "a shot without atoms": fake_shot(shape, n_images=2, filling=0.0),
        }

    @promise(GIVES_RESULTS)
    def test_gives_results(self, factory: AnalysisFactory) -> None:
        """They are written as a line of JSON; "shot" and "error" are no names of results."""
        analysis = factory(self.context())
        for what, shot in self.shots().items():
            with doing(what):
                _check_value(ResultsLog.checked(_result_of(analysis, shot)), "the result")

    @promise("the same shot gives the same result, whatever came before it")
    def test_same_shot_same_result(self, factory: AnalysisFactory) -> None:
        """Shots are analysed in another order when a run is resumed or analysed again."""
        analysis, shots = factory(self.context()), self.shots()
        first = {what: dumps(_result_of(analysis, shot)) for what, shot in shots.items()}
        for what, shot in reversed([*shots.items()]):
            assert dumps(_result_of(analysis, shot)) == first[what], f"{what} gives another one the second time"
            fresh = _result_of(factory(self.context()), shot)
            assert dumps(fresh) == first[what], f"{what} gives another one from a fresh instance"

    @promise("the shot is left untouched")
    def test_leaves_the_shot_untouched(self, factory: AnalysisFactory) -> None:
        """Other analyses, and the shot's file, have the same arrays."""
        analysis = factory(self.context())
        for what, shot in self.shots().items():
            before = copy.deepcopy(_arrays(shot))
            _result_of(analysis, shot)
            for name, array in _arrays(shot).items():
                assert np.array_equal(before[name], array), f"of {what} it changed {name}"

    @promise("a shot that lacks something gives a result, or raises LabseqError")
    def test_takes_odd_shots(self, factory: AnalysisFactory) -> None:
        """Without images, without frames, without atoms."""
        analysis = factory(self.context())
        for what, shot in self.odd_shots().items():
            with doing(what):
                try:
                    result = analysis.shot(shot)
                except LabseqError:
                    continue
                with promised(GIVES_RESULTS):
                    _check_value(ResultsLog.checked(result), "the result")

    @promise("shot() is pure: no I/O, nothing changed that all code shares")
    def test_is_pure(self, factory: AnalysisFactory) -> None:
        """What it works out is kept by labseq."""
        analysis = factory(self.context())
        for shot in self.shots().values():
            _result_of(analysis, shot)  # may compile
            with quietly():
                _result_of(analysis, shot)


def _result_of(analysis: Analysis, shot: RecordedShot) -> Any:
    try:
        return analysis.shot(shot)
    except Exception as error:
        raise ContractViolation(GIVES_RESULTS, f"it {format_error(error)}") from error


def _check_value(value: Any, what: str) -> None:
    """Refuse what a line of results could not hold but as its ``repr``."""
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
