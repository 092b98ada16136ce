"""Writes lines and JSON to stdout, stderr and files, also if a stream is closed or cannot encode them."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, TextIO

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import visible

STDOUT: Final = "-"
"""The name that means stdout where a file is expected."""


def replace_unencodable() -> None:
    """Let stdout and stderr replace characters that they cannot encode instead of failing.

    A stream that was closed before Python started is opened on the null device. Otherwise the
    next file to be opened, such as a shot, would get its descriptor and its output.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: PTH123, SIM115 - stays open
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def say(*lines: str, stream: TextIO | None = None) -> None:
    """Print lines and flush. Default: stdout.

    If the reader has closed the pipe, as ``| head`` does, the lines are dropped. The command neither ends
    nor changes its exit code because of it.

    Raises:
        RecordingError: The lines cannot be written, for example because the disk is full.
    """
    out = sys.stdout if stream is None else stream
    with writing_to(out):
        out.write("".join(f"{line}\n" for line in lines))
        out.flush()


@contextmanager
def writing_to(stream: TextIO) -> Generator[None]:
    """Stop writing quietly if the reader has closed the pipe.

    Raises:
        RecordingError: The stream cannot be written, for example because the disk is full.
    """
    try:
        yield
    except BrokenPipeError:
        _to_null_device(stream)
    except OSError as error:
        raise RecordingError(stream.name, f"cannot be written: {error.strerror}") from error


def discard_unwritten() -> None:
    """Drop what stdout and stderr could not write, so that Python does not complain when it ends."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            _to_null_device(stream)


def _to_null_device(stream: TextIO) -> None:
    with suppress(OSError):  # a stream without a file descriptor
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def report_compiling(about_s: float) -> None:
    """Print on stderr why the command takes longer this time."""
    say(compiling_text(about_s), stream=sys.stderr)


def compiling_text(about_s: float) -> str:
    """The line to print before this process compiles kernels."""
    from labseq.kernels.kernel import cache_problem  # few commands compile

    text = f"compiling kernels, about {max(1.0, about_s):.0f} s"
    if problem := cache_problem():
        return f"{text}, at every start: {problem}"
    return f"{text}; later runs find them in the cache"


def as_line(values: Any) -> str:
    """Any values as JSON on one line, in ASCII, so that every terminal can show it.

    Dataclasses become objects of their fields, nan becomes null.
    """
    from labseq.plain import to_plain

    return json.dumps(to_plain(values))


def stdout_to_stderr() -> Callable[[str], None]:
    """Redirect stdout to stderr for the rest of the process, including C libraries and child processes.

    A program that reads stdout then gets the answer and nothing else.

    Returns:
        A function that prints a line to the original stdout and closes it. It ignores a closed pipe, and
        raises ``RecordingError`` if anything else prevents this.
    """
    sys.stdout.flush()
    real, sys.stdout = os.dup(1), sys.stderr
    os.dup2(2, 1)

    def answer(line: str) -> None:
        try:
            with os.fdopen(real, "wb", buffering=0) as stream:
                stream.write(f"{line}\n".encode())
        except BrokenPipeError:
            pass
        except OSError as error:
            raise RecordingError("<stdout>", f"cannot be written: {error.strerror}") from error

    return answer


def json_writer(name: str | None) -> Callable[[Any], None]:
    """Prepare the output of a command's JSON before the command does any work.

    Args:
        name: Name of the file. "-" for stdout, to which nothing else is printed from now on. None
            for no JSON.

    Returns:
        A function that writes a value on one line.

    Raises:
        ConfigError: The file cannot be written. The returned function raises it, too.
    """
    if name is None:
        return lambda _: None
    if name == STDOUT:
        answer = stdout_to_stderr()
        return lambda value: answer(as_line(value))
    path = Path(name)
    check_writable(path)
    return lambda value: write_text(path, f"{as_line(value)}\n")


def check_different(*names: str | Path | None) -> None:
    """Check that no file is named twice, as the last output would replace the others. Ignores None and "-".

    Raises:
        ConfigError: Two names are the same file.
    """
    seen: set[Path] = set()
    for name in names:
        if name is None or str(name) == STDOUT:
            continue
        try:
            real = Path(name).resolve()
        except (OSError, RuntimeError):  # a circle of links is reported when the file is opened
            continue
        if real in seen:
            what = "this file is given for two outputs, and one would replace the other"
            raise _problem(name, what, hint="choose another name")
        seen.add(real)


def check_writable(path: Path) -> None:
    """Check that a file can be written before hours of work.

    Raises:
        ConfigError: The file cannot be written.
    """
    try:
        is_new = not path.exists()
        if not is_new and not path.is_file() and not path.is_dir():
            return  # opening a pipe twice would lose its reader
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except (OSError, ValueError) as error:
        raise _unwritten(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Write a file completely or not at all.

    Raises:
        ConfigError: The file cannot be written.
    """
    from labseq.files import whole_file

    try:
        with whole_file(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: Exception) -> ConfigError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return _problem(path, f"it cannot be written: {reason}")


def _problem(name: str | Path, what: str, hint: str = "") -> ConfigError:
    return ConfigError(Problem(what, visible(str(name)), hint=hint))
