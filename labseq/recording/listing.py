"""The runs in a data folder, and the names by which users call them."""

from __future__ import annotations

from pathlib import Path

from labseq.errors import RecordingError
from labseq.messages import visible
from labseq.recording.folders import RUN_FILE


def runs_in(root: Path) -> list[Path]:
    """The folders of runs in a data folder, damaged ones included, the newest last."""
    run_dirs = [folder for folder in root.glob("*-*-*/*_*") if counter_of(folder) >= 0 and folder.is_dir()]
    # by number, not by name: 10000 follows 9999
    return sorted(run_dirs, key=lambda folder: (folder.parent.name, counter_of(folder)))


def counter_of(folder: Path) -> int:
    """The number of a run, from the name of its folder; -1 if it has none."""
    number = folder.name.partition("_")[0]
    return int(number) if number.isdecimal() else -1


def named_run(name: str, root: Path) -> Path:
    """The newest run of a name or number, of which a part will do.

    Args:
        name: "2026-11-20/0001_compact-225", "2026-11-20/1", "0001_compact-225", "compact-225" or "1".
        root: The data folder.

    Raises:
        RecordingError: There is none.
    """
    day, _, last = name.rpartition("/")
    for folder in reversed(runs_in(root)):
        is_number = last.isdecimal() and int(last) == counter_of(folder)
        if day in ("", folder.parent.name) and (
            is_number or last in (folder.name, folder.name.partition("_")[2])
        ):
            return folder
    what = f"no such file or folder, and no run of this name or number in {visible(str(root))}"
    raise RecordingError(name, what, "`labseq runs` lists the runs")


def newest_run(root: Path) -> Path:
    """The folder of the run that was started last: newest day, highest counter.

    Raises:
        RecordingError: There is none.
    """
    folders = [folder for folder in runs_in(root) if (folder / RUN_FILE).exists()]
    if not folders:
        raise RecordingError(root, "holds no runs", "give a run's folder, or set LABSEQ_DATA")
    return folders[-1]
