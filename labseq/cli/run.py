"""``labseq run`` and ``labseq resume``: a session with a view, and what came of it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from labseq.cli.failures import lines_of
from labseq.cli.live import observer_for
from labseq.cli.output import stdout_to_stderr, say
from labseq.cli.show import as_line, existing, json_summary, summary_lines
from labseq.errors import LabseqError, RecordingError, StopRequested
from labseq.recording import Run, open_run
from labseq.roles import RunObserver
from labseq.session import Options, Session


def run_sequence(sequence: Path, options: Options, *, as_json: bool) -> None:
    """Run a sequence and say what came of it, also when it was stopped or failed.

    Args:
        sequence: The sequence file.
        options: What the user changed.
        as_json: Whether to print the outcome as JSON, last and alone on stdout.

    Raises:
        LabseqError: Whatever ended the run.
    """

    def start(observer: RunObserver | None) -> Session:
        return Session.open(sequence, **asdict(options), observer=observer)

    run_session(start, as_json=as_json)


def resume_run(path: Path, *, accept_changes: bool, realtime: bool, as_json: bool) -> None:
    """Go on with a run that ended early, and say what came of it.

    Args:
        path: The run's folder or any file in it.
        accept_changes: Whether to go on although something differs from then.
        realtime: Let virtual time take as long as it says.
        as_json: Whether to print the outcome as JSON, last and alone on stdout.

    Raises:
        LabseqError: Whatever ended the run.
    """

    def resume(observer: RunObserver | None) -> Session:
        options = {"accept_changes": accept_changes, "realtime": realtime}
        return Session.resume(existing(path), **options, observer=observer)

    run_session(resume, as_json=as_json)


def run_session(opening: Callable[[RunObserver | None], Session], *, as_json: bool) -> None:
    """Run a session and say what came of it, also when it was stopped or failed.

    Args:
        opening: Opens the session; is given the observer that shows it.
        as_json: Whether to print the outcome as JSON, last and alone on stdout.

    Raises:
        LabseqError: Whatever ended the run.
    """
    answer = stdout_to_stderr() if as_json else None
    observer = observer_for(sys.stdout)
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
        with suppress(Exception):  # a broken screen must not hide what came of the run
            observer.close()
        run = _read_back(session)
        if run is not None:
            _report(run)
        if answer is not None:
            _answer(answer, outcome(session, run, failure), failure)


def outcome(session: Session | None, run: Run | None, failure: BaseException | None) -> str:
    """What came of a run, as one line of JSON.

    Args:
        session: The session, if it came to one.
        run: The run as it is on disk, if it can be read.
        failure: What ended the run, or None.
    """
    values = json_summary(run)
    if run is None and session is not None and session.run_dir is not None:
        values["run_dir"] = str(session.run_dir)
    if failure is not None:  # the disk may be too full to have taken the status
        values["status"] = "stopped" if isinstance(failure, StopRequested | KeyboardInterrupt) else "failed"
        values["error"] = "\n".join(lines_of(failure))
    return as_line(values)


def _report(run: Run) -> None:
    """Print the summary; a full disk behind stdout takes nothing from the run."""
    lines = summary_lines(run)
    try:
        say(*lines)
    except RecordingError as error:
        with suppress(RecordingError):
            say(f"warning: {error}; the run is not touched by that", *lines, stream=sys.stderr)


def _answer(answer: Callable[[str], None], line: str, failure: BaseException | None) -> None:
    """Print the outcome; where that fails, what ended the run is still the first to be told."""
    try:
        answer(line)
    except RecordingError:
        if failure is None:
            raise


def _read_back(session: Session | None) -> Run | None:
    if session is None or session.run_dir is None:
        return None
    try:
        return open_run(session.run_dir)
    except LabseqError:
        return None
