"""The runs in a data folder, and the names by which users refer to them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from labseq.errors import RecordingError
from labseq.messages import visible
from labseq.recording.folders import RUN_FILE, SHOTS_FOLDER, STATE_FILE


def runs_in(root: Path) -> list[Path]:
    """The folders of runs in a data folder, including damaged ones, the newest last."""
    return [root / day / name for day, name in newest_first(root)][::-1]


def newest_first(root: Path) -> Iterator[tuple[str, str]]:
    """Day and name of the runs in a data folder, the newest first. An older day is read only when needed.

    They are text because making ten thousand paths takes longer than all the rest.
    """
    for day in sorted(_folders(root), reverse=True):
        if day.count("-") >= 2:
            names = [name for name in _folders(root / day) if "_" in name and counter_of(name) >= 0]
            # by number, not by name: 10000 follows 9999
            for name in sorted(names, key=lambda name: (counter_of(name), name), reverse=True):
                yield day, name


def _folders(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as found:
            return [entry.name for entry in found if entry.is_dir()]
    except OSError:  # it is gone, is a file, or may not be read
        return []


def counter_of(name: str) -> int:
    """The number of a run, from the name of its folder. -1 if it has none."""
    number = name.partition("_")[0]
    return int(number) if number.isdecimal() else -1


def named_run(name: str, root: Path) -> Path:
    """The newest run with a name or number, which may be given in part.

    Args:
        name: "2026-11-20/0001_compact-225", "2026-11-20/1", "0001_compact-225", "compact-225" or "1".
        root: The data folder.

    Raises:
        RecordingError: There is no such run.
    """
    day, _, last = name.rpartition("/")
    for its_day, its_name in newest_first(root):
        is_number = last.isdecimal() and int(last) == counter_of(its_name)
        if day in ("", its_day) and (is_number or last in (its_name, its_name.partition("_")[2])):
            return root / its_day / its_name
    what = f"no such file or folder, and no run of this name or number in {visible(str(root))}"
    raise RecordingError(name, what, "`labseq runs` lists the runs")


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last, with the newest day and the highest counter.

    Raises:
        RecordingError: There are no runs.
    """
    for day, name in newest_first(root):
        if (root / day / name / RUN_FILE).exists():
            return root / day / name
    raise RecordingError(root, "holds no runs", "give a run's folder, or set LABSEQ_DATA")


def not_a_run(path: Path) -> RecordingError:
    """The error for a path that exists but is not part of a run. It says what to give instead."""
    for folder in (path, path.parent, path.parent.parent):
        if (folder / STATE_FILE).is_file():
            return RecordingError(folder, _without_run_file(folder))
    runs = sorted(file.parent for depth in ("*", "*/*") for file in path.glob(f"{depth}/{RUN_FILE}"))
    if runs:
        content = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
        return RecordingError(
            path, f"contains {content} but is not a run itself", f"give one of them, for example {runs[-1]}"
        )
    return RecordingError(path, f"is not a run: it has no {RUN_FILE}", "give a run's folder")


def _without_run_file(folder: Path) -> str:
    if any((folder / SHOTS_FOLDER).glob("*.h5")):
        return f"holds shots, but its {RUN_FILE} is gone; restore it from a backup"
    return f"has no {RUN_FILE}: the run died while its folder was created; delete it, as it holds no shots"
