import pytest

from labseq import errors
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.workers import portable


def tree():
    return [e for e in vars(errors).values() if isinstance(e, type) and issubclass(e, LabseqError)]


def test_exit_codes():
    codes = {e.__name__: e.exit_code for e in tree()}
    assert {codes[n] for n in ("ConfigError", "UnknownPluginError", "PluginLoadError", "LimitError")} == {2}
    assert {codes[n] for n in ("DeviceError", "DeviceTimeoutError", "TransientError")} == {3}
    assert {codes[n] for n in ("PlanError", "InvalidPlanError", "RecordingError")} == {1}


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (errors.ConfigError, ValueError),
        (errors.LimitError, ValueError),
        (errors.UnknownPluginError, LookupError),
        (errors.DeviceTimeoutError, TimeoutError),
    ],
)
def test_errors_are_the_builtin_that_a_reader_expects(kind, builtin):
    assert issubclass(kind, builtin)


def test_a_problem_has_a_place_and_a_remedy():
    problem = Problem("'rwos' is unknown", "a.yaml", 3, 7, "one of rows, cols", "did you mean 'rows'?")
    assert str(problem) == "a.yaml:3:7: 'rwos' is unknown; expected one of rows, cols; did you mean 'rows'?"


def test_all_problems_are_reported():
    error = ConfigError([Problem("one", "a", 1, 1), Problem("two", "a", 2, 1)])
    assert str(error) == "a:1:1: one\na:2:1: two"
    assert len(error.problems) == 2


def test_errors_carry_their_values():
    error = errors.InvalidPlanError("path", "(1, 2) is occupied", batch=3, move=1, planner="mine")
    assert (error.rule, error.batch, error.move, error.planner) == ("path", 3, 1, "mine")
    assert str(error) == "planner 'mine': batch 3, atom move 1 breaks the rule 'path': (1, 2) is occupied"
    limit = errors.LimitError("row tones in batch 3", 21, 20, "use fewer")
    assert str(limit) == "row tones in batch 3 is 21; the limit is 20; use fewer"
    assert str(errors.UnknownPluginError("planner", "x", ["a", "b"])) == (
        "unknown planner 'x'; expected one of 'a', 'b'"
    )


@pytest.mark.parametrize(
    "error",
    [
        errors.ConfigError(errors.Problem("wrong", "file", 1, 2)),
        errors.DeviceTimeoutError("camera", "no frame", 1.5),
        errors.UnknownPluginError("planner", "x", ("psca",)),
        errors.InvalidPlanError("order", "sites", batch=2, planner="p"),
        errors.StopRequested(15, after_shot=True),
    ],
)
def test_errors_of_workers_arrive_as_they_were(error):
    arrived = portable(error)
    assert type(arrived) is type(error)
    assert (str(arrived), vars(arrived)) == (str(error), vars(error))
