import errno

import pytest

from labseq.console.errors import MAX_REPORTED, exit_code_of, lines_of, report
from labseq.errors import (
    ConfigError,
    DeviceError,
    DeviceTimeoutError,
    LabseqError,
    PlanError,
    Problem,
    RecordingError,
    StopRequested,
    UnknownPluginError,
)
from labseq.messages import MAX_ERROR


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (ConfigError("wrong"), 2),
        (UnknownPluginError("planner", "x"), 2),
        (DeviceTimeoutError("camera", "silent", 1.0), 3),
        (PlanError("no plan"), 1),
        (RecordingError("x", "full"), 1),
        (LabseqError("other"), 1),
        (StopRequested(2), 130),
        (StopRequested(15), 143),
        (KeyboardInterrupt(), 130),
        (ZeroDivisionError("by zero"), 1),
    ],
)
def test_exit_codes(error: BaseException, code: int) -> None:
    assert exit_code_of(error) == code


def test_problems_start_with_their_place() -> None:
    error = ConfigError(
        [
            Problem("unknown key 'shot'", "a.yaml", 3, 5, "one of 'shots'", "did you mean 'shots'?"),
            Problem("no such address", "--set a.b=1"),
            Problem("no place at all"),
        ]
    )
    assert lines_of(error) == [
        "a.yaml:3:5: unknown key 'shot'; expected one of 'shots'; did you mean 'shots'?",
        "--set a.b=1: no such address",
        "error: no place at all",
    ]


def test_a_text_from_a_device_cannot_disturb_the_terminal() -> None:
    (line,) = lines_of(DeviceError("camera", "stuck\x1b[2J" + "x" * 5_000_000))
    assert line.startswith(r"error: camera: stuck\x1b[2Jxxx")
    assert line.isprintable()
    assert len(line) < 2 * MAX_ERROR


def test_a_full_disk_is_no_internal_error() -> None:
    text = "cannot be written: No space left on device"
    full = OSError(errno.ENOSPC, "No space left on device")
    assert lines_of(full) == [f"error: output {text}"]
    full.filename = "a.npy"
    assert lines_of(full) == [f"error: a.npy {text}"]


def test_of_very_many_problems_the_first_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert report(ConfigError([Problem(f"wrong {i}") for i in range(MAX_REPORTED + 3)])) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2:] == [f"error: wrong {MAX_REPORTED - 1}", "and 3 more problems"]
