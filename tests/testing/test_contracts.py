"""Every promise of every suite is broken once, and the suite names it and no other."""

from __future__ import annotations

import importlib
import os
import re
import sys
import threading
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from labseq.errors import DeviceError, LimitError, PlanError
from labseq.model import Occupancy, Plan, TargetPattern, ToneProgram
from labseq.roles import ROLES, Context
from labseq.testing import SUITES, CameraContract, ContractViolation, MobileTweezersContract, PlannerContract
from labseq.testing.contracts import HardwareContract
from labseq.testing.contracts.promises import failure_text
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
from .broken_planners import CreatesAnAtom, DoesNothing, Suite
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


ADVICE = {
    "ReturnsBatches": "a list\nto do: 'return Plan.from_batches(batches)'",
    "TakesTheOccupancyAlone": "'def plan(self, occupancy, target)'",
    "Prints": "it printed 'planning\\n' (use logging.getLogger(__name__))",
    "CountsFromOne": "takes an atom from (1, 1), which is empty, for the loading\n#\n",
    "ChecksNothing": "begin plan() with 'occupancy = as_occupancy(",
    "Sleeps": "called time.sleep(1e-09)\nto do: wait with context.clock",
    "WaitsInRealTime": "during work that takes 0.0099 s\nto do: wait with context.clock",
    "GivesTuples": "a tuple\nto do: return a list of Timeline",
    "RunsWithoutAShot": "'def run(self, shot)'",
}
"""What the author of some is told."""


@pytest.mark.parametrize(("planted", "plugin", "tests"), FAULTS)
def test_the_broken_promise_is_named_and_no_other(
    planted: Planted, plugin: Factory, tests: tuple[str, ...]
) -> None:
    failed = failed_tests(planted.suite, plugin)
    assert {*failed} == {*tests}, {name: str(error) for name, error in failed.items()}
    promise = getattr(planted.suite, tests[0]).promise
    for error in failed.values():
        assert error.promise == promise
        assert str(error).startswith(f"promise: {promise}; but {error.detail}")
        assert ADVICE.get(name_of(plugin), "") in str(error)


def test_what_some_are_told_belongs_to_a_fault() -> None:
    assert {*ADVICE} <= {name_of(plugin) for planted in ALL.values() for plugin, _ in planted.each()}


class NoTargets(Suite):
    fills_any_target: ClassVar[bool] = False


@pytest.mark.parametrize(
    ("suite", "plugin", "words"),
    [
        (
            Suite(),
            object,
            "its constructor raised TypeError: object() takes no arguments\nto do: the fixture",
        ),
        (Suite(), partial(broken_planners.Hangs, None), "plan() has not returned after 0.1 s for\n"),
        (NoTargets(), partial(OneByOnePlanner, None), "and no targets\nto do: .*: targets ="),
    ],
)
def test_the_author_is_told_once_what_to_do(
    monkeypatch: pytest.MonkeyPatch, suite: object, plugin: Factory, words: str
) -> None:
    monkeypatch.setattr("labseq.testing.contracts.planner.MAX_WAIT_S", 0.1 if "0.1 s" in words else 60.0)
    (error,) = failed_tests(suite, plugin).values()
    assert re.search(words.replace("()", r"\(\)"), str(error))


def test_pytest_prints_the_lines_of_the_plugin_only() -> None:
    with pytest.raises(ContractViolation) as caught:
        Suite().test_returns_a_plan(partial(broken_planners.Raises, None))
    text = failure_text(caught.value)
    line = broken_planners.Raises.plan.__code__.co_firstlineno + 1
    assert text.startswith("promise: plan() returns a Plan, ")
    assert [line for line in text.splitlines() if line.startswith("  File ")] == [
        f'  File "{broken_planners.__file__}", line {line}, in plan'
    ]


@pytest.mark.parametrize("kind", ALL)
def test_a_right_plugin_keeps_all_promises(kind: str) -> None:
    assert failed_tests(ALL[kind].suite, ALL[kind].right) == {}


def test_every_kind_of_plugin_has_a_suite_and_every_promise_a_fault() -> None:
    assert {*ROLES} == {*SUITES}
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


def test_a_hang_is_reported_with_its_time_limit() -> None:
    polls: Any = broken_hardware.PollsForEver
    with pytest.raises(ContractViolation, match=r"read\(\) without a trigger has not returned after 0.15 s"):
        broken_hardware.Suite().test_keeps_timeouts(polls)


def test_a_driver_that_hangs_is_waited_for_once() -> None:
    class Impatient(CameraContract):
        max_wait_s: ClassVar[float] = 0.15

    hangs: Any = broken_cameras.WaitsForAClockThatItDoesNotMove
    text = r"its work has not returned after 0.15 s, and 0 s passed on context.clock during work that takes"
    with pytest.raises(ContractViolation, match=text):
        Impatient().test_works(hangs)
    with pytest.raises(pytest.skip.Exception, match=r"cannot continue: promise: .* used as in a shot"):
        Impatient().test_gives_a_frame(hangs)


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
def test_optional_behaviour_breaks_no_promise(kind: str, plugin: Factory) -> None:
    assert failed_tests(ALL[kind].suite, plugin) == {}


class ServesOnly(PlannerContract):
    """A planner for one target, 2 x 2 in the corner of 3 x 3."""

    fills_any_target: ClassVar[bool] = False
    targets = (TargetPattern(np.pad(np.ones((2, 2), np.bool_), (0, 1)), np.zeros((3, 3), np.bool_)),)
    n_examples: ClassVar[int] = 15


class KnowsOneTarget(OneByOnePlanner):
    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        if not any(np.array_equal(target.fill, known.fill) for known in ServesOnly.targets):
            raise PlanError("this target is not served")
        return super().plan(occupancy, target)


def test_a_planner_may_serve_certain_targets_only() -> None:
    assert failed_tests(ServesOnly(), partial(KnowsOneTarget, None)) == {}


def test_a_test_that_cannot_continue_is_skipped_if_another_one_fails() -> None:
    with pytest.raises(pytest.skip.Exception, match="cannot continue: promise: no atom is created"):
        Suite().test_fills_the_target(partial(CreatesAnAtom, None))


def test_a_test_that_cannot_continue_fails_if_no_other_does() -> None:
    class Blind(Suite):
        test_creates_no_atom = Suite.test_is_pure

    with pytest.raises(ContractViolation, match="no atom is created"):
        Blind().test_fills_the_target(partial(CreatesAnAtom, None))


def test_a_planner_that_hangs_is_abandoned() -> None:
    released = threading.Event()

    class Hangs(OneByOnePlanner):
        def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
            released.wait(30)
            return super().plan(occupancy, target)

    class Impatient(Suite):
        time_limit_s: ClassVar[float] = 0.01

    with pytest.raises(ContractViolation, match=r"plan\(\) has not returned after 0.02 s"):
        Impatient().test_plans_in_time(partial(Hangs, None))
    released.set()


def test_a_message_draws_the_case_that_failed() -> None:
    with pytest.raises(ContractViolation, match=r"leaves \d defects and \d surplus atoms of\n[^(]*\(# "):
        Suite().test_fills_the_target(partial(DoesNothing, None))


def test_the_file_that_a_constructor_reads_is_named() -> None:
    def camera(context: Context) -> Any:
        Path(os.devnull).read_bytes()
        return RecordingCamera(context)

    with pytest.raises(ContractViolation, match=r"but it did open\(.*\); open\(\) is the place"):
        CameraContract().test_constructor_does_no_io(camera)


def test_an_import_in_a_constructor_is_no_io(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "wave", raising=False)

    def camera(context: Context) -> Any:
        importlib.import_module("wave")
        return RecordingCamera(context)

    CameraContract().test_constructor_does_no_io(camera)
