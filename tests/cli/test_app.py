from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.cli import main
from labseq.errors import ConfigError, DeviceError, PlanError, Problem, StopRequested

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"
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
        (["run", "a.yaml", "--shots", "x"], "--shots"),
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


def test_wrong_numbers_of_shots_and_seeds_are_reported_as_all_other_settings(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert code_of("run", str(SEQUENCE), "--shots", "0", "--seed", "-1") == 2
    assert capsys.readouterr().err == (
        "--shots 0: shots is 0; expected at least 1\n--seed -1: seed is -1; expected at least 0\n"
    )


def test_safe_changes_no_sequence(capsys: pytest.CaptureFixture[str]) -> None:
    assert code_of("safe", "virtual", "--set", "camera.gain=1") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("--set camera.gain=1: there is no sequence here")


@pytest.mark.parametrize(
    ("path", "said"), [("nope", "nope: no such file or folder"), ("x" * 5000, "xxx...: the folder cannot be")]
)
def test_a_run_that_is_not_there_is_a_mistake_of_the_user(
    path: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("show", path) == 2
    assert said in capsys.readouterr().err
