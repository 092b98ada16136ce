from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

import labseq
from labseq.cli import main
from labseq.errors import ConfigError, DeviceError, PlanError, Problem, StopRequested

HEAVY = ("numpy", "pydantic", "yaml", "rich", "h5py", "numba", "scipy", "pluggy")


def code_of(*arguments: str) -> Any:
    with pytest.raises(SystemExit) as leaving:
        main(arguments)
    return leaving.value.code


def test_help_imports_nothing_heavy() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "labseq", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "typer" in imported
    assert imported.isdisjoint(HEAVY)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("--version") == 0
    assert capsys.readouterr().out == f"labseq {labseq.__version__}\n"


def test_help_names_every_command_and_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("--help") == 0
    out = capsys.readouterr().out
    assert all(f"\n  {command} " in out for command in ("run", "check", "show", "plugins", "safe"))
    assert code_of("run", "--help") == 0
    out = capsys.readouterr().out
    options = ("--profile", "--dry-run", "--shots", "--seed", "--set", "--output", "--json", "--realtime")
    assert all(option in out for option in options)
    assert "labseq run sequences/compact_225.yaml --shots 5 --seed 1 --json\n" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["run", "a.yaml", "--shots", "0"], "--shots"),
        (["run", "a.yaml", "--shots", "x"], "--shots"),
        (["run", "a.yaml", "--seed", "-1"], "--seed"),
        (["run", "a.yaml", "--dry-run=quick"], "--dry-run"),
        (["run", "a.yaml", "--shot", "3"], "--shot"),
        (["run"], "SEQUENCE"),
        (["safe"], "PROFILE"),
        (["fly"], "fly"),
    ],
)
def test_wrong_usage(arguments: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of(*arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert named in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ConfigError(Problem("wrong", "a.yaml", 1, 2)), 2, "a.yaml:1:2: wrong\n"),
        (DeviceError("camera", "mute"), 3, "error: camera: mute\n"),
        (PlanError("no plan"), 1, "error: no plan\n"),
        (StopRequested(2), 130, "stopped by Ctrl-C\n"),
        (StopRequested(15), 143, "stopped by SIGTERM\n"),
        (ValueError("odd"), 1, "internal error: ValueError: odd; please report it; "),
    ],
)
@pytest.mark.parametrize("debug", [False, True])
def test_a_failing_command(
    error: BaseException,
    code: int,
    message: str,
    debug: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("labseq.cli.show.show_run", fail)
    assert code_of("show", "x", *(["--debug"] if debug else [])) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.startswith(message) or debug
    assert ("Traceback" in err) is debug


def test_ctrl_c_outside_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("labseq.cli.show.show_run", interrupt)
    assert code_of("show", "x") == 130


def test_a_reader_that_went_away_is_no_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def break_pipe(*_: Any, **__: Any) -> None:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr("labseq.cli.show.show_run", break_pipe)
    assert code_of("show", "x") == 1
    assert capsys.readouterr().err == ""
