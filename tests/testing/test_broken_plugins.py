"""Every promise of every suite is broken once, and the suite names it and no other."""

from __future__ import annotations

from functools import partial

import pytest

from labseq.errors import DeviceError, LimitError
from labseq.model import ToneProgram
from labseq.registry import KINDS
from labseq.roles import Context
from labseq.testing import SUITES, ContractViolation, MobileTweezersContract, PlannerContract
from labseq.testing.contracts import HardwareContract
from labseq.testing.fakes import OneByOnePlanner, RecordingCamera, RecordingMobileTweezers

from . import (
    broken_analyses,
    broken_cameras,
    broken_detectors,
    broken_hardware,
    broken_instruments,
    broken_lines,
    broken_patterns,
    broken_planners,
    broken_scanners,
    broken_simulations,
    broken_steps,
    broken_tweezers,
)
from .planted import Factory, Planted, failed_tests, name_of, promised_by

ALL: dict[str, Planted] = {
    "planner": broken_planners.PLANTED,
    "camera": broken_cameras.PLANTED,
    "static_tweezers": broken_tweezers.STATIC,
    "mobile_tweezers": broken_tweezers.MOBILE,
    "detector": broken_detectors.PLANTED,
    "device": broken_instruments.PLANTED,
    "lines": broken_lines.PLANTED,
    "step": broken_steps.PLANTED,
    "pattern": broken_patterns.PLANTED,
    "simulation": broken_simulations.PLANTED,
    "scanner": broken_scanners.PLANTED,
    "analysis": broken_analyses.PLANTED,
    "hardware": broken_hardware.PLANTED,
}
FAULTS = [
    pytest.param(planted, plugin, tests, id=f"{kind}-{name_of(plugin)}")
    for kind, planted in ALL.items()
    for plugin, tests in planted.each()
]


@pytest.mark.parametrize(("planted", "plugin", "tests"), FAULTS)
def test_the_broken_promise_is_named_and_no_other(
    planted: Planted, plugin: Factory, tests: tuple[str, ...]
) -> None:
    failed = failed_tests(planted.suite, plugin)
    assert {*failed} == {*tests}, {name: str(error) for name, error in failed.items()}
    promise = getattr(planted.suite, tests[0]).promise
    for error in failed.values():
        assert error.promise == promise
        assert str(error) == f"promise: {promise}; but {error.detail}"


@pytest.mark.parametrize("kind", ALL)
def test_a_right_plugin_keeps_all_promises(kind: str) -> None:
    assert failed_tests(ALL[kind].suite, ALL[kind].right) == {}


def test_a_right_planner_keeps_all_promises_of_the_whole_suite() -> None:
    assert failed_tests(PlannerContract(), partial(OneByOnePlanner, None)) == {}


def test_every_kind_of_plugin_has_a_suite_and_every_promise_a_fault() -> None:
    assert {*KINDS} == {*SUITES}
    broken = {(kind, tests[0]) for kind, planted in ALL.items() for _, tests in planted.each()}
    shared = {*promised_by(HardwareContract())}
    assert shared == {test for kind, test in broken if kind == "hardware"}
    for kind, suite in SUITES.items():
        assert isinstance(ALL[kind].suite, suite)
        missing = {*promised_by(suite)} - {test for of, test in broken if of == kind} - shared
        assert not missing, f"no {kind} breaks the promise of {missing}"


class CannotBeMadeSafe(RecordingCamera):
    def safe_state(self) -> None:
        raise DeviceError(self.name, "no answer")


@pytest.mark.parametrize("plugin", [RecordingCamera, CannotBeMadeSafe])
def test_all_that_a_suite_makes_is_closed(plugin: type[RecordingCamera]) -> None:
    made: list[RecordingCamera] = []

    def factory(context: Context) -> RecordingCamera:
        made.append(plugin(context))
        return made[-1]

    failed_tests(broken_hardware.Suite(), factory)
    assert len(made) > len(promised_by(broken_hardware.Suite()))
    assert all(not camera.is_open and "camera.close" in camera.calls.names() for camera in made)


def test_a_hang_is_told_with_the_patience() -> None:
    with pytest.raises(ContractViolation, match=r"read\(\) without a trigger has not returned after 0.2 s"):
        broken_hardware.Suite().test_keeps_timeouts(broken_hardware.PollsForEver)


def test_an_empty_program_may_be_refused() -> None:
    class WantsTones(RecordingMobileTweezers):
        def prepare(self, program: ToneProgram) -> float:
            if program.n_segments == 0:
                raise LimitError("the length of the program", 0, "more than 0")
            return super().prepare(program)

    assert failed_tests(MobileTweezersContract(), WantsTones) == {}


@pytest.mark.parametrize(
    ("kind", "plugin"),
    [
        ("scanner", broken_scanners.Stops),
        ("step", broken_steps.RecordedSetup),
        ("mobile_tweezers", broken_tweezers.TellsItsTimings),
    ],
)
def test_what_a_plugin_may_do_besides(kind: str, plugin: Factory) -> None:
    assert failed_tests(ALL[kind].suite, plugin) == {}
