"""Finds the run that a command is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import visible
from labseq.recording import data_root
from labseq.recording.folders import find_run
from labseq.recording.listing import newest_run

if TYPE_CHECKING:
    from labseq.data.reader import Run


def chosen_run(path: Path | None, where: Sequence[str] | None = None) -> Run:
    """Open the run that a command is given, see :func:`folder_of_run`.

    Args:
        path: As in that function.
        where: Conditions that its shots must meet.

    Raises:
        ConfigError: There is no such run, or no such shot.
        RecordingError: The run is damaged.
    """
    from labseq.data.reader import open_run  # with numpy, which commands that only name a run do not need

    return open_run(folder_of_run(path)).select(*where or ())


def folder_of_run(path: Path | None) -> Path:
    """The folder of the run that a command is given.

    Args:
        path: Its folder, any file in it, its name or its number. None for the newest run.

    Raises:
        ConfigError: There is no such run, which is an error in the command line, not in the data.
    """
    try:
        return newest_run(data_root()) if path is None else find_run(path)
    except RecordingError as error:
        raise ConfigError(Problem(error.what, visible(error.path), hint=error.advice)) from error
