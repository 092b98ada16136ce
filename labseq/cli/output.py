"""Text on stdout and stderr: streams, columns, characters."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from typing import TextIO

from labseq.errors import RecordingError


def replace_unencodable() -> None:
    """Let stdout and stderr replace characters that they cannot encode instead of failing.

    Closed ones lead nowhere from now on, so that no file of a run takes their place.
    """
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: PTH123, SIM115 - for good
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def stdout_to_stderr() -> Callable[[str], None]:
    """Send whatever anybody prints to stderr, for the rest of the process.

    That includes C libraries and child processes, so that nothing but the answer
    reaches a program that reads stdout.

    Returns:
        Prints a line to the real stdout, and closes it; nothing happens where nobody reads
        it any more. It raises ``RecordingError`` if it cannot be written.
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


def report_compiling(module: str) -> None:
    """Say on stderr why it takes longer this time."""
    say(f"compiling {module}; later runs find it in the cache", stream=sys.stderr)


def say(*lines: str, stream: TextIO | None = None) -> None:
    """Print lines, at once.

    Where nobody reads them any more, as behind ``| head``, they go nowhere: that ends no
    command and changes no exit code.

    Args:
        *lines: Without line ends.
        stream: Where to; stdout by default.

    Raises:
        RecordingError: It cannot be written, for example to a full disk.
    """
    out = sys.stdout if stream is None else stream
    with writing_to(out):
        out.write("".join(f"{line}\n" for line in lines))
        out.flush()


@contextmanager
def writing_to(stream: TextIO) -> Generator[None]:
    """What is done here writes to a stream; it is broken off where nobody reads that any more.

    Raises:
        RecordingError: It cannot be written, for example to a full disk.
    """
    try:
        yield
    except BrokenPipeError:
        _lead_nowhere(stream)
    except OSError as error:
        raise RecordingError(stream.name, f"cannot be written: {error.strerror}") from error


def discard_unwritten() -> None:
    """Drop what stdout and stderr could not take, else Python tries again as it ends, and complains."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            _lead_nowhere(stream)


def _lead_nowhere(stream: TextIO) -> None:
    with suppress(OSError):  # a stream that is no file of the system
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def encodes(encoding: str | None, characters: str) -> bool:
    """Whether an encoding has all of these characters.

    Example:
        >>> encodes("cp1252", "●"), encodes("utf-8", "●")
        (False, True)
    """
    try:
        characters.encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def columns(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> list[str]:
    """Lay out rows in columns two spaces apart.

    Args:
        rows: The cells; all rows have the same number of them.
        right: Indices of columns that are aligned on the right.

    Example:
        >>> columns([["image", "45 ms"], ["load", "500 ms"]], right=[1])
        ['image   45 ms', 'load   500 ms']
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines: list[str] = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        padded = (c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(cells))
        lines.append("  ".join(padded).rstrip())
    return lines
