"""Which run a command is given."""

from __future__ import annotations

from pathlib import Path

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean
from labseq.recording import Run, data_root, open_run
from labseq.recording.folders import find_run


def chosen_run(path: Path | None) -> Run:
    """Open the run of this folder or of any file in it; without a path the newest.

    Raises:
        ConfigError: There is no such run.
        RecordingError: It is damaged.
    """
    return open_run(newest_run(data_root()) if path is None else existing_run(path))


def existing_run(path: Path) -> Path:
    """The folder of the run that a command is given, or any file in it.

    Raises:
        ConfigError: There is no such run: the command line is wrong, not the data.
    """
    try:
        return find_run(path)
    except RecordingError as error:
        raise ConfigError(str(error)) from error
    except OSError as error:
        reason = str(error.strerror or error).lower()
        raise ConfigError(Problem(f"the folder cannot be read: {reason}", clean(str(path)))) from error


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last: newest day, highest counter.

    Raises:
        ConfigError: There is none.
    """
    folders = [file.parent for file in root.glob("*-*-*/*_*/run.json")]
    if not folders:
        raise ConfigError(f"{root} holds no runs; give a run's folder, or set LABSEQ_DATA")
    return max(folders, key=lambda folder: (folder.parent.name, _counter(folder)))


def _counter(folder: Path) -> int:
    number = folder.name.partition("_")[0]
    return int(number) if number.isdecimal() else -1
