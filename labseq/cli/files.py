"""The files that commands write besides what they print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from labseq.cli.output import stdout_to_stderr
from labseq.cli.show import as_line
from labseq.config.reading import is_file
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem
from labseq.files import whole_file

STDOUT: Final = "-"


def json_writer(name: str | None) -> Callable[[Any], None]:
    """Prepare for a command's JSON, before anything is worked out.

    Args:
        name: Name of the file; "-" for stdout, to which nothing else goes from now on; None
            for no JSON.

    Returns:
        Writes a value, in one line.

    Raises:
        ConfigError: The file cannot be written; so does what is returned.
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
    """Refuse a file that is named twice: what is written there last would replace the rest.

    Args:
        *names: What a command reads and writes; None and "-" are no files.

    Raises:
        ConfigError: Two of them are the same file.
    """
    seen: set[Path] = set()
    for name in names:
        if name is None or str(name) == STDOUT:
            continue
        try:
            real = Path(name).resolve()
        except (OSError, RuntimeError):  # links in a circle: told where it is opened
            continue
        if real in seen:
            what = "this file is named twice, and one would replace the other"
            raise ConfigError(Problem(what, visible(str(name)), hint="choose another name"))
        seen.add(real)


def check_writable(path: Path) -> None:
    """Find out that a file cannot be written before hours are spent.

    Raises:
        ConfigError: It cannot be written.
    """
    try:
        is_new = not path.exists()
        if not is_new and not is_file(path) and not path.is_dir():
            return  # to open a pipe twice is to lose its reader
        with path.open("ab"):
            pass
        if is_new:
            path.unlink()
    except (OSError, ValueError) as error:
        raise _unwritten(path, error) from error


def write_text(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all.

    Raises:
        ConfigError: It cannot be written.
    """
    try:
        with whole_file(path) as file:
            file.write(text.encode())
    except OSError as error:
        raise _unwritten(path, error) from error


def _unwritten(path: Path, error: Exception) -> ConfigError:
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return ConfigError(Problem(f"it cannot be written: {reason}", visible(str(path))))
