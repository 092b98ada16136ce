"""``labseq stop``: a run in progress is asked to end after the shot at hand, by a file in its folder."""

from __future__ import annotations

import signal
from dataclasses import asdict
from pathlib import Path

from labseq.config import find_profile
from labseq.errors import ConfigError, Problem, StopRequested
from labseq.recording import data_root, marker_roots, runs_in_progress
from labseq.recording.durable import write_file
from labseq.recording.folders import STOP_FILE, find_run
from labseq.recording.plain import dumps
from labseq.recording.process import Owner
from labseq.recording.run_file import read_owner, read_state


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
    write_file(run_dir / STOP_FILE, dumps(asdict(Owner.current())).encode() + b"\n")


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
