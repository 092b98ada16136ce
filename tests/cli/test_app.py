from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import ConfigError, Problem, StopRequested

SEQUENCE = Path(__file__).parents[2] / "sequences" / "compact_225.yaml"


def test_version(call: Any) -> None:
    assert call("--version") == (0, f"labseq {labseq.__version__}\n", "")


def test_help_names_commands_options_and_an_example(call: Any) -> None:
    code, out, _ = call("--help")
    assert code == 0
    assert all(f"\n  {command} " in out for command in ("run", "check", "show", "plugins", "safe"))
    code, out, _ = call("run", "--help")
    assert code == 0
    assert "--dry-run" in out
    assert "labseq run sequences/compact_225.yaml --shots 5 --seed 1 --json\n" in out


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["run", "a.yaml", "--shots", "2.5"], "Error: --shots is '2.5'; expected a whole number\n"),
        (["bench", "planners", "--loadings", "0"], "Error: --loadings is 0; expected at least 1\n"),
        (["queue", "remove", "x"], "ID... is 'x'"),
        (["run", "a.yaml", "--dry-run=quick"], "--dry-run: 'quick' is not one of 'full', 'fast'"),
        (["run"], "SEQUENCE"),
        (["fly"], "fly"),
    ],
)
def test_wrong_usage(arguments: list[str], named: str, call: Any) -> None:
    code, out, err = call(*arguments)
    assert (code, out) == (2, "")
    assert named in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (ConfigError(Problem("wrong", "a.yaml", 1, 2)), 2, "a.yaml:1:2: wrong\n"),
        (StopRequested(15), 143, "stopped by SIGTERM\n"),
        (StopRequested(1), 129, "stopped because the terminal was closed (SIGHUP)\n"),
        (ValueError("odd"), 1, "internal error: ValueError: odd; please report it with "),
    ],
)
@pytest.mark.parametrize("debug", [False, True])
def test_a_failing_command(
    error: BaseException,
    code: int,
    message: str,
    debug: bool,
    monkeypatch: pytest.MonkeyPatch,
    call: Any,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr("labseq.cli.show.show_run", fail)
    got, out, err = call("show", "x", *(["--debug"] if debug else []))
    assert (got, out) == (code, "")
    assert message in err
    assert err.startswith(message) or debug
    assert ("Traceback" in err) is debug


def test_ctrl_c_outside_of_a_run(monkeypatch: pytest.MonkeyPatch, call: Any) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("labseq.cli.show.show_run", interrupt)
    assert call("show", "x") == (130, "", "stopped by Ctrl-C\n")


def test_wrong_numbers_of_shots_and_seeds_are_reported_as_all_other_settings(call: Any) -> None:
    code, _, err = call("run", str(SEQUENCE), "--shots", "0", "--seed", "-1")
    assert code == 2
    assert [line.split(": ")[0] for line in err.splitlines()] == ["--shots 0", "--seed -1"]


def test_safe_changes_no_sequence(call: Any) -> None:
    code, out, err = call("safe", "virtual", "--set", "camera.gain=1")
    assert (code, out) == (2, "")
    assert err.startswith("--set camera.gain=1: this command uses no sequence")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("nope", "nope: no such file or folder, and no run of this name"),
        ("x" * 5000, "xxx: cannot be read: file name too long"),
    ],
)
def test_a_run_that_does_not_exist_is_a_mistake_of_the_user(path: str, said: str, call: Any) -> None:
    code, _, err = call("show", path)
    assert code == 2
    assert said in err
