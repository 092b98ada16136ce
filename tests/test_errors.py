import pytest

from labseq import errors
from labseq.errors import LabseqError
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
