"""Asks a run in another process to end after its current shot, for `labseq stop`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from labseq.config.find import find_profile
from labseq.errors import ConfigError, Problem
from labseq.files import write_file
from labseq.plain import dumps
from labseq.processes import Process
from labseq.recording import runs_in_progress
from labseq.recording.folders import STOP_FILE, find_run
from labseq.recording.run_file import read_owner, read_state


def ask_to_stop(run_dir: Path) -> None:
    """Ask a run to end after its current shot.

    Raises:
        RecordingError: Its folder cannot be written to.
    """
    write_file(run_dir / STOP_FILE, dumps(asdict(Process.current())).encode() + b"\n")


def is_running(run_dir: Path) -> bool:
    """Whether a run is in progress. For a run on another computer, its folder says so."""
    return read_state(run_dir)[0] == "running"


def running_here(profile: str | None = None) -> list[Path]:
    """The folders of the runs in progress on this computer.

    Args:
        profile: Name or path of a profile, to return only runs on it.

    Raises:
        ConfigError: There is no such profile.
    """
    runs = runs_in_progress()
    if profile is not None:
        path = str(find_profile(profile, Path()).resolve())
        runs = {folder: key for folder, key in runs.items() if key in {path, f"{path} (dry run)"}}
    return [folder for folder in runs if is_running(folder)]


def find_running(run: Path | None = None, profile: str | None = None) -> Path:
    """Find the folder of the run in progress that a user names by its path or profile.

    Args:
        run: Its folder, or any file in it.
        profile: Name or path of its profile.

    Returns:
        Its folder.

    Raises:
        ConfigError: The run is not in progress, no run is in progress, or several are.
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
    """Process and computer of a run, as text."""
    owner = read_owner(run_dir)
    return "unknown process" if owner is None else f"process {owner.pid} on {owner.host}"
