"""`labseq run`, `labseq resume`, `labseq rerun`, `labseq stop` and `labseq demo`."""

from __future__ import annotations

import importlib.util
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from labseq.assembly.options import DryRun, Options
from labseq.console.events import LogLines
from labseq.console.output import as_line, say, stdout_to_stderr
from labseq.console.runs import folder_of_run
from labseq.console.text import plural, quoted
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.files import packaged_profiles_dir, packaged_sequences_dir
from labseq.messages import install_hint, visible
from labseq.queue.queue import Queue
from labseq.recording import data_root
from labseq.recording.folders import NOTIFY_FILE
from labseq.roles import RunObserver
from labseq.session.session import Session
from labseq.session.stopping import ask_to_stop, find_running, is_running, owner_text, running_here

if TYPE_CHECKING:
    from labseq.cli.live import LiveView
    from labseq.cli.summary import Summary


def run_sequence(sequence: Path, options: Options, *, as_json: bool, web: bool = False) -> None:
    """Run a sequence, and print the result even if the run was stopped or failed. ``web``: in a browser."""
    if web:
        from labseq.web.serve import start_for_run

        say(start_for_run(options.output or data_root()), stream=sys.stderr)

    def start(observer: RunObserver | None) -> Session:
        return Session.open(sequence, **asdict(options), observer=observer)

    run_session(start, as_json=as_json)


def resume_run(path: Path, options: Mapping[str, Any], *, as_json: bool) -> None:
    """Take missing or further shots of a run, and print the result. See ``Session.resume``."""

    def resume(observer: RunObserver | None) -> Session:
        return Session.resume(folder_of_run(path), **options, observer=observer)

    run_session(resume, as_json=as_json)


def rerun_run(path: Path, options: Mapping[str, Any], *, as_json: bool) -> None:
    """Take a run again, and print the result. ``options`` as in ``Session.rerun``."""

    def rerun(observer: RunObserver | None) -> Session:
        return Session.rerun(folder_of_run(path), **options, observer=observer)

    run_session(rerun, as_json=as_json)


def _observer() -> LogLines | LiveView:
    """Shows the run on a terminal, or prints lines. Only the former imports rich."""
    if not sys.stdout.isatty():
        return LogLines(sys.stdout)
    from labseq.cli.live import observer_for

    return observer_for(sys.stdout)


def run_session(opening: Callable[[RunObserver | None], Session], *, as_json: bool) -> None:
    """Run the session that ``opening`` opens with an observer. Print the result even if the run failed."""
    answer = stdout_to_stderr() if as_json else None
    observer = _observer()
    session: Session | None = None
    failure: BaseException | None = None
    try:
        session = opening(observer)
        with session:
            session.run()
    except BaseException as error:
        failure = error
        raise
    finally:
        with suppress(Exception):  # a broken terminal must not hide the result of the run
            observer.close()
        _print_result(None if session is None else session.run_dir, failure, answer)


def calibrate_for_queue(kind: str, profile: str, dry_run: DryRun) -> None:
    """Take a calibration that an entry of the queue needs, and print it."""
    from labseq.calibration.measure import CalibrationRequest  # only a queue that calibrates needs it
    from labseq.calibration.terminal import calibrate_kind

    say(f"queue: calibrating {kind}")
    calibrate_kind(kind, CalibrationRequest(profile, dry_run=dry_run), as_json=False)


def try_notice(text: str) -> None:
    """Send a notice in every way that ``notify.yaml`` names.

    Raises:
        ConfigError: There is no such file, it has an error, or a notice could not be sent.
    """
    from labseq.session.notices import Notices  # other commands do not need it
    from labseq.session.send_notice import send

    path = data_root() / NOTIFY_FILE
    settings = Notices.read().settings
    if settings is None:
        expected = "a file with 'labseq: 1' and 'command' or 'webhook'"
        raise ConfigError(Problem("there is no such file", visible(str(path)), expected=expected))
    if failures := send(settings.task("test", "", text)):
        raise ConfigError([Problem(failure, visible(str(path))) for failure in failures])
    say(f"sent to {' and '.join(filter(None, [*settings.command[:1], settings.webhook]))}")


def _print_result(
    run_dir: Path | None, failure: BaseException | None, answer: Callable[[str], None] | None
) -> None:
    """Print the summary of a run, if it was created, and its JSON by ``answer``."""
    run = _read_back(run_dir)
    if run is None and answer is None:
        return
    from labseq.cli.summary import Summary  # only now, because it takes 0.1 s to import

    summary = Summary(run_dir=run_dir) if run is None else Summary.of(run)
    if run is not None:
        _report(summary)
    if answer is not None:
        with nullcontext() if failure is None else suppress(RecordingError):  # the failure is reported
            answer(as_line(summary if failure is None else summary.ended_by(failure)))


def _report(summary: Summary) -> None:
    """Print the summary. An error of stdout, such as a full disk, does not affect the run."""
    lines = summary.as_text()
    try:
        say(*lines)
    except RecordingError as error:
        with suppress(RecordingError):
            say(f"warning: {error} (the run is not affected)", *lines, stream=sys.stderr)


def _read_back(run_dir: Path | None) -> Run | None:
    if run_dir is None:
        return None
    try:
        return open_run(run_dir)
    except LabseqError:
        return None


POLL_S: Final = 0.1
"""Interval at which ``--wait`` checks whether the run has ended, in seconds."""


def stop_run(run: Path | None, profile: str | None, *, queue: bool, wait: bool) -> None:
    """Ask a run in progress to end after its current shot, and print a confirmation."""
    if queue:
        if not Queue(data_root()).ask_to_stop():
            raise ConfigError("no process runs the queue; to end a run use 'labseq stop' without --queue")
        say("the queue starts no further runs")
        if run is None and not running_here(profile):
            return
    folder = find_running(None if run is None else folder_of_run(run), profile)
    ask_to_stop(folder)
    say(f"{folder} ({owner_text(folder)}) ends after its current shot")
    say(f"resume it later with: labseq resume {quoted(folder)}")
    while wait and is_running(folder):
        time.sleep(POLL_S)
    if wait:
        say("the run has ended")


SEQUENCE: Final = "compact_225"
PROFILE: Final = "virtual"
SHOTS: Final = 10


def run_demo(shots: int | None, output: Path | None) -> None:
    """Run a packaged sequence on the packaged virtual profile, and explain it before and after."""
    opened: list[Session] = []
    profile = str(packaged_profiles_dir() / f"{PROFILE}.yaml")  # not from the current folder
    options = Options(profile, SHOTS if shots is None else shots, output=output)

    def start(observer: RunObserver | None) -> Session:
        sequence = packaged_sequences_dir() / f"{SEQUENCE}.yaml"
        opened.append(Session.open(sequence, **asdict(options), observer=observer))
        say(*beginning(opened[0]))
        return opened[0]

    run_session(start, as_json=False)
    if opened[0].run_dir is not None:
        say("", *ending(opened[0].run_dir))


def beginning(session: Session) -> list[str]:
    """The explanation printed before the run."""
    assembly = session.assembly
    target, grid = assembly.target.fill, assembly.hardware.grid
    steps: list[Any] = [step for _, step in assembly.steps]
    cycles = max(getattr(getattr(step, "settings", None), "cycles", 0) for step in steps)
    rows, cols = (int(target.any(axis=axis).sum()) for axis in (1, 0))
    grid_is, shots = f"{grid.n_rows} x {grid.n_cols}", plural(assembly.sequence.shots, "shot")
    return [
        f"This is {SEQUENCE}, a sequence that comes with labseq, on simulated hardware. No device is used.",
        f"Each of {shots} loads atoms at random into {grid_is} tweezers, takes an image, rearranges",
        f"the atoms into an array of {rows} x {cols} in up to {cycles} cycles of plan, check, move, image,",
        "and takes the image that decides its success. The first time, labseq compiles its kernels.",
        "",
    ]


def ending(run_dir: Path) -> list[str]:
    """The commands suggested after the run."""
    run = quoted(run_dir)
    has_matplotlib = importlib.util.find_spec("matplotlib") is not None
    needs = "" if has_matplotlib else f"; first: {install_hint('plot')}"
    rows = [
        (f"  labseq show {run}", "these numbers again (more with --shots and --timing)"),
        (f"  labseq plot {run}", f"the run as a picture{needs}"),
        (f"  labseq check {SEQUENCE}", "what a shot does, step by step"),
        (f"  labseq run {SEQUENCE} --set planner.degree_of_parallelism=15", "with one value changed"),
        ("  labseq demo --copy .", "copy the sequences and profiles, for you to change"),
    ]
    width = max(len(command) for command, _ in rows)  # unlike a table, never wrapped: commands are copied
    return [
        f"The data are in {run_dir}, one file per shot. What next:",
        *(f"{c.ljust(width)}  {text}" for c, text in rows),
    ]


def copy_files(folder: Path) -> None:
    """Copy the packaged sequences and profiles to a folder, for the user to change. No file is replaced.

    Raises:
        ConfigError: One of the files exists already, and none was copied. Or one cannot be written.
    """
    copies = list(_copies(folder))
    if taken := [new for _, new in copies if new.exists()]:
        more = f" (and {plural(len(taken) - 1, 'more file')})" if len(taken) > 1 else ""
        what = f"this file already exists{more}, so nothing was copied"
        raise ConfigError(Problem(what, visible(str(taken[0])), expected="a folder without them"))
    for old, new in copies:
        try:
            new.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(old, new)
        except OSError as error:
            raise ConfigError(
                Problem(f"it cannot be written: {error.strerror}", visible(str(new)))
            ) from error
    say(
        f"{plural(len(copies), 'file')} copied to sequences and hardware_profiles in {visible(str(folder))}.",
        "To run the copies, change to that folder:",
        f"  labseq run sequences/{SEQUENCE}.yaml",
        "There, the profile 'virtual' is the copy in ./hardware_profiles.",
    )


def _copies(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Each packaged file and the path of its copy."""
    for source in (packaged_sequences_dir(), packaged_profiles_dir()):
        for path in sorted(path for path in source.iterdir() if path.is_file()):
            yield path, folder / source.name / path.name
