"""How commands print: tables, JSON, files, numbers with units."""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TextIO, cast

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import whole_file
from labseq.messages import visible
from labseq.model import RunRecord, ShotRecord
from labseq.text_files import is_file
from labseq.units import format_quantity


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


def percent(fraction: float | None, digits: int = 1) -> str:
    """Write a fraction in per cent; "-" for none.

    Example:
        >>> percent(0.9955, 2), percent(None)
        ('99.55 %', '-')
    """
    if fraction is None or math.isnan(fraction):
        return "-"
    return f"{100 * fraction:.{digits}f} %"


def count_of(n: int, total: int) -> str:
    """Write a count, what it is of, and its fraction.

    Example:
        >>> count_of(7, 20), count_of(0, 0)
        ('7 of 20 (35.0 %)', '0 of 0')
    """
    return f"{n} of {total} ({percent(n / total)})" if total else "0 of 0"


def clock_time(duration_s: float) -> str:
    """Write a time as clocks do.

    Example:
        >>> clock_time(83.4), clock_time(3723)
        ('1:23', '1:02:03')
    """
    minutes, seconds = divmod(round(duration_s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def age_text(duration_s: float) -> str:
    """Write an age by its largest unit.

    Example:
        >>> age_text(90), age_text(3 * 3600), age_text(40 * 86_400)
        ('1 minute', '3 hours', '40 days')
    """
    for unit, unit_s in (("day", 86_400), ("hour", 3600), ("minute", 60)):
        if duration_s >= unit_s:
            return plural(int(duration_s // unit_s), unit)
    return plural(max(0, int(duration_s)), "second")


def plural(n: int, noun: str) -> str:
    """Write a count with its noun.

    Example:
        >>> plural(1, "defect"), plural(2, "defect")
        ('1 defect', '2 defects')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def settings_text(settings: Mapping[str, Any]) -> str:
    """Settings that are given, in one line.

    Example:
        >>> settings_text({"degree_of_parallelism": 7, "max_tones": {"row": 16, "col": None}, "file": None})
        'degree_of_parallelism 7, max_tones (row 16)'
    """
    words: list[str] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            within = settings_text(cast("Mapping[str, Any]", value))
            words += [f"{key} ({within})"] if within else []
        elif value is not None:
            words.append(f"{key} {value}")
    return ", ".join(words)


@dataclass(frozen=True, slots=True)
class Glyphs:
    """One character for each thing that is drawn.

    Attributes:
        atom: An atom on a target site.
        defect: An empty target site.
        surplus: An atom on a site that must be empty.
        reservoir: Any other atom.
        done: Part of a bar that is done.
        left: Part of a bar that is left.
        plus_minus: Before an uncertainty.
        to: Between the ends of an interval.
        levels: Parts of a cell that are filled from below, from the least to the whole.
        upper: Upper half of a cell; "" where there are no half blocks.
        lower: Lower half of a cell.
        both: A whole cell.
    """

    atom: str
    defect: str
    surplus: str
    reservoir: str
    done: str
    left: str
    plus_minus: str
    to: str
    levels: str
    upper: str = ""
    lower: str = ""
    both: str = ""

    @property
    def all(self) -> str:
        """All characters, to find out whether they can be encoded."""
        return "".join(getattr(self, name) for name in self.__slots__)


UNICODE: Final = Glyphs("●", "○", "×", "·", "━", "╌", "±", "–", "▁▂▃▄▅▆▇█", "▀", "▄", "█")  # noqa: RUF001 - meant
ASCII: Final = Glyphs("@", "o", "x", ".", "#", "-", "+-", "-", ".:#")


def glyphs_for(encoding: str | None) -> Glyphs:
    """The characters for a screen with this encoding.

    Example:
        >>> glyphs_for("cp1252").atom
        '@'
    """
    return UNICODE if encodes(encoding, UNICODE.all) else ASCII


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


LASTING: Final = frozenset(
    {"settling", "compiling", "compiled", "warning", "run_starting", "shot_repeated", "safe_state", "closed"}
)
"""Events that must not scroll out of the live view unseen."""


def event_text(name: str, values: Mapping[str, Any], run: RunRecord | None) -> str:
    """Put an event into words.

    Args:
        name: Name of the event.
        values: Its values.
        run: The run, once it is known.

    Returns:
        One line, or "" for an event that is not worth one.
    """
    match name:
        case "run_starting":
            return run_text(values["record"], values["run_dir"], values.get("n_before", 0))
        case "shot_finished":
            return shot_text(values["shot"], run)
        case "shot_repeated":
            shot: ShotRecord = values["shot"]
            return f"shot {shot.shot_index + 1}: attempt {shot.attempt + 1} failed, once more: {shot.error}"
        case "safe_state" | "closed" if not values["ok"]:
            task = "brought to its safe state" if name == "safe_state" else "closed"
            return f"warning: {values['device']} could not be {task}: {values['error']}"
        case "settling":
            longest = format_quantity(values["timeout_s"], "time")
            return f"waiting for {values['device']} to settle, at most {longest}"
        case "compiling":
            return f"compiling {values['module']}; later runs find it in the cache"
        case "compiled":
            return f"compiled in {format_quantity(values['duration_s'], 'time')}"
        case "warning":
            return f"warning: {values['text']}"
        case "window_too_short":
            where = f"shot {values['shot'] + 1}, cycle {values['cycle']}"
            return f"{where}: {values['n_batches_played']} of {values['n_batches']} batches fit the window"
        case "leader_awaited":
            longest = format_quantity(values["timeout_s"], "time")
            who, signal = values["device"], values["signal"]
            return f"shot {values['shot'] + 1}: waiting for '{signal}' from {who}, at most {longest}"
        case "scan_point":
            return point_text(values)
        case "scan_ended":
            return f"{values['scanner']} wants no more points"
        case "device_command":
            return f"shot {values['shot'] + 1}: {values['device']}: {values['command']}"
        case _:
            return ""


def point_text(values: Mapping[str, Any]) -> str:
    """A line about a point of an adaptive scan, and the best one so far."""
    best = values["best"]
    at = ", ".join(f"{address} {text}" for address, text in values["written"].items())
    own = f"point {values['point'] + 1} ({at}): {values['figure']} {_figure(values['value'])}"
    if best is None:
        return own
    return f"{own}; best so far " + ("this" if best["point"] == values["point"] else best_text(values))


def best_text(values: Mapping[str, Any]) -> str:
    """The best point of an adaptive scan so far, without its addresses; "" if there is none."""
    best = values["best"]
    if best is None:
        return ""
    return f"{_figure(best['value'])}, point {best['point'] + 1} ({', '.join(best['written'].values())})"


def _figure(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.5g}"


def run_text(run: RunRecord, run_dir: str, n_before: int = 0) -> str:
    """A line about a run that starts, or goes on with so many shots taken before."""
    simulated = ", simulated" if run.simulated else ""
    profile = Path(run.profile_path).stem
    before = f", {n_before} of them taken before" if n_before else ""
    return f"{run_dir}: {plural(run.n_shots, 'shot')}{before}, seed {run.seed}, profile {profile}{simulated}"


def shot_text(shot: ShotRecord, run: RunRecord | None) -> str:
    """A line about a shot that is over."""
    of = f"{shot.shot_index + 1}/{run.n_shots}" if run is not None else f"{shot.shot_index + 1}"
    if shot.status != "complete":
        return f"shot {of}  {shot.status}" + (f": {shot.error}" if shot.status == "failed" else "")
    n_atoms = run.target.n_atoms if run is not None else 0
    parts = [f"shot {of}", outcome(shot.success, shot.seen_defect_free_cycle, shot.filling_fraction, n_atoms)]
    if not math.isnan(shot.filling_fraction):
        parts.append(f"filling {percent(shot.filling_fraction)}")
    if shot.n_missing_atoms:
        parts.append(f"{plural(shot.n_missing_atoms, 'atom')} too few loaded")
    duration_s = max((timing.t_start_s + timing.duration_s for timing in shot.timing), default=0.0)
    return "  ".join([*parts, format_quantity(duration_s, "time")])


def outcome(success: bool, seen_cycle: int, filling_fraction: float, n_atoms: int) -> str:
    """How a shot ended, in words.

    Example:
        >>> outcome(True, 2, 1.0, 225)
        'defect-free in cycle 2'
        >>> outcome(False, 3, 0.9955555, 225)
        '1 defect (defect-free in cycle 3)'
    """
    seen = f"defect-free in cycle {seen_cycle}" if seen_cycle else ""
    if success:
        return seen or "defect-free"
    if math.isnan(filling_fraction):
        return "not judged: no image"
    n_defects = round((1.0 - filling_fraction) * n_atoms)
    found = plural(n_defects, "defect") if n_defects else "surplus atoms"
    return f"{found} ({seen})" if seen else found


_TOLD: Final = LASTING | {"shot_finished", "scan_point", "scan_ended"}


class LogLines:
    """Implements ``RunObserver`` with plain lines of text.

    Args:
        stream: Where they go.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._run: RunRecord | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print a line if the event is worth one."""
        if name == "run_starting":
            self._run = values["record"]
        text = event_text(name, values, self._run) if name in _TOLD else ""
        if text:
            say(text, stream=self._stream)

    def refresh(self) -> None:
        """Every line was printed at once."""

    def close(self) -> None:
        """Nothing to leave in order."""


def as_line(values: Mapping[str, Any]) -> str:
    """JSON on one line, in ASCII, whatever the terminal can show."""
    return json.dumps(values)
