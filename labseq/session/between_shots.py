"""Between two shots: what users asked for, checks on values, and requests to stop."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from labseq.config import find_profile
from labseq.errors import ConfigError, Problem, StopRequested
from labseq.files import Process, write_file
from labseq.plain import dumps
from labseq.recording import RunWriter, data_root, marker_roots, runs_in_progress
from labseq.recording.folders import STOP_FILE, find_run
from labseq.recording.run_file import read_owner, read_state
from labseq.session.policies import Checks


def look_for_stop(run_dir: Path) -> None:
    """See whether a run is asked to end.

    Raises:
        StopRequested: It is.
    """
    if (run_dir / STOP_FILE).exists():
        raise StopRequested(signal.SIGTERM, after_shot=True)


def ask_to_stop(run_dir: Path) -> None:
    """Ask a run to end after the shot at hand.

    Raises:
        RecordingError: Its folder cannot be written to.
    """
    write_file(run_dir / STOP_FILE, dumps(asdict(Process.current())).encode() + b"\n")


def is_running(run_dir: Path) -> bool:
    """Whether a run is in progress, as far as that can be known here."""
    return read_state(run_dir)[0] == "running"


def running_here(profile: str | None = None) -> list[Path]:
    """The folders of the runs that processes of this computer have in progress.

    Args:
        profile: Name or path of a profile: only those on it.

    Raises:
        ConfigError: There is no such profile.
    """
    found = runs_in_progress(marker_roots(data_root()))
    if profile is not None:
        path = str(find_profile(profile, Path()).resolve())
        found = {folder: key for folder, key in found.items() if key in {path, f"{path} (dry run)"}}
    return [folder for folder in found if is_running(folder)]


def find_running(run: Path | None = None, profile: str | None = None) -> Path:
    """The run in progress that is meant.

    Args:
        run: Its folder, or any file in it.
        profile: Name or path of its profile.

    Returns:
        Its folder.

    Raises:
        ConfigError: It is not in progress; or there is none, or several.
        RecordingError: There is no such run.
    """
    if run is not None:
        folder = find_run(run)
        if not is_running(folder):
            raise ConfigError(Problem("the run is not in progress", str(folder)))
        return folder
    running = running_here(profile)
    on = "" if profile is None else f" on the profile {profile}"
    if not running:
        raise ConfigError(Problem(f"no run is in progress{on}"))
    if len(running) > 1:
        folders = ", ".join(map(str, running))
        raise ConfigError(Problem(f"{len(running)} runs are in progress{on}", expected=f"one of {folders}"))
    return running[0]


def owner_text(run_dir: Path) -> str:
    """The process that a run belongs to, in words."""
    owner = read_owner(run_dir)
    return "nobody knows whose" if owner is None else f"process {owner.pid} on {owner.host}"


class ShotHooks:
    """Looks for a request to stop, and at what the last shots came to; puts down what is skipped.

    Args:
        writer: The run's folder.
        checks: The checks of the sequence.
        emit: Told every event: name and values.
    """

    def __init__(
        self, writer: RunWriter, checks: Checks, emit: Callable[[str, Mapping[str, Any]], None]
    ) -> None:
        self._writer = writer
        self._checks = checks
        self._emit = emit

    @property
    def left_open(self) -> tuple[int, str]:
        """The last shot of the run as it was before, and why the others of its point are to be skipped.

        That is "" if they are not. It may have been put down then, or not.
        """
        return self._checks.left_open

    def before(self) -> None:
        """Before a shot.

        Raises:
            StopRequested: The run is asked to end.
        """
        look_for_stop(self._writer.run_dir)

    def after(self, given_up: Sequence[str]) -> str:
        """After a shot.

        Args:
            given_up: Why the shot was given up, if it was.

        Returns:
            Why the other shots of its point shall be skipped, or "".

        Raises:
            CheckFailedError: A value is beyond the limits of a check that stops the run.
        """
        return given_up[0] if given_up else self._checks.after(self._writer.last_row)

    def skip(self, shots: Sequence[int], why: str) -> None:
        """Put down that shots will not be taken.

        Raises:
            RecordingError: The disk is full.
        """
        if shots:
            self._writer.skip(shots, why)
            told = f"shot {shots[0] + 1} is" if len(shots) == 1 else f"{len(shots)} shots are"
            self._emit("warning", {"text": f"{told} skipped: {why}"})
            self._emit("shots_skipped", {"shots": list(shots), "why": why})
