"""Which run a command is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from labseq.data import Run, open_run
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import is_there
from labseq.messages import clean, visible
from labseq.recording import data_root
from labseq.recording.folders import RUN_FILE, counter_of, find_run, runs_in


def chosen_run(path: Path | None, where: Sequence[str] | None = None) -> Run:
    """Open the run that a command is given; see :func:`folder_of_run`.

    Args:
        path: As that takes it.
        where: Conditions that its shots must meet.

    Raises:
        ConfigError: There is no such run, or no such shot.
        RecordingError: It is damaged.
    """
    return open_run(folder_of_run(path)).select(*where or ())


def folder_of_run(path: Path | None) -> Path:
    """The folder of the run that a command is given.

    Args:
        path: Its folder, any file in it, its name or its number; None for the newest run.

    Raises:
        ConfigError: There is no such run: the command line is wrong, not the data.
    """
    if path is None:
        return newest_run(data_root())
    try:
        if not is_there(path.expanduser()):
            return _named_run(path.as_posix(), data_root())
        return find_run(path)
    except RecordingError as error:
        raise ConfigError(str(error)) from error
    except OSError as error:
        reason = str(error.strerror or error).lower()
        raise ConfigError(Problem(f"the folder cannot be read: {reason}", clean(str(path)))) from error


def _named_run(name: str, root: Path) -> Path:
    """The newest run of a name or number as `labseq runs` prints it, all of it or a part.

    Args:
        name: "2026-11-20/0001_compact-225", "2026-11-20/1", "0001_compact-225", "compact-225" or "1".

    Raises:
        ConfigError: There is none.
    """
    day, _, last = name.rpartition("/")
    for folder in reversed(runs_in(root)):
        is_number = last.isdecimal() and int(last) == counter_of(folder)
        if day in ("", folder.parent.name) and (
            is_number or last in (folder.name, folder.name.partition("_")[2])
        ):
            return folder
    what = f"there is no such folder, and no run of this name or number in {visible(str(root))}"
    raise ConfigError(Problem(what, visible(name), hint="`labseq runs` lists the runs"))


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last: newest day, highest counter.

    Raises:
        ConfigError: There is none.
    """
    folders = [folder for folder in runs_in(root) if (folder / RUN_FILE).exists()]
    if not folders:
        raise ConfigError(f"{root} holds no runs; give a run's folder, or set LABSEQ_DATA")
    return folders[-1]
