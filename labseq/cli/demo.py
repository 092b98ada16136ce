"""``labseq demo``: a first look, without any file; and copies of the files that come with labseq."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from labseq.cli.output import columns, say
from labseq.cli.run import run_session
from labseq.cli.words import plural
from labseq.config import packaged_profiles_dir, packaged_sequences_dir
from labseq.config.wording import visible
from labseq.errors import ConfigError, Problem
from labseq.roles import RunObserver
from labseq.session import Options, Session

SEQUENCE: Final = "compact_225"
PROFILE: Final = "virtual"
SHOTS: Final = 10


def run_demo(shots: int | None, output: Path | None) -> None:
    """Run a packaged sequence on the packaged virtual lab; say before and after what that is.

    Args:
        shots: Number of shots; None for :data:`SHOTS`.
        output: Folder for the data; None for LABSEQ_DATA or ./data.

    Raises:
        LabseqError: Whatever ended the run.
    """
    opened: list[Session] = []
    profile = str(packaged_profiles_dir() / f"{PROFILE}.yaml")  # not one of that name in this folder
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
    """What is about to happen."""
    assembly = session.assembly
    target, grid = assembly.target.fill, assembly.bench.grid
    steps: list[Any] = [step for _, step in assembly.steps]
    cycles = max(getattr(getattr(step, "settings", None), "cycles", 0) for step in steps)
    rows, cols = (int(target.any(axis=axis).sum()) for axis in (1, 0))
    grid_is, shots = f"{grid.n_rows} x {grid.n_cols}", plural(assembly.sequence.shots, "shot")
    return [
        f"This is {SEQUENCE}, a sequence that comes with labseq, on its virtual lab: no hardware is touched.",
        f"Each of {shots} loads atoms at random into {grid_is} tweezers, takes an image, rearranges",
        f"the atoms into an array of {rows} x {cols} in up to {cycles} cycles of plan, check, move, image,",
        "and takes the image on which it is judged. The first time, labseq compiles its kernels.",
        "",
    ]


def ending(run_dir: Path) -> list[str]:
    """What to type next."""
    run = f'"{run_dir}"' if " " in str(run_dir) else str(run_dir)
    has_matplotlib = importlib.util.find_spec("matplotlib") is not None
    needs = "" if has_matplotlib else '; first: pip install "labseq[plot]"'
    rows = [
        (f"  labseq show {run}", "these numbers again; --shots and --timing tell more"),
        (f"  labseq plot {run}", f"the run as a picture{needs}"),
        (f"  labseq check {SEQUENCE}", "what a shot does, step by step"),
        (f"  labseq run {SEQUENCE} --set planner.degree_of_parallelism=15", "with one value changed"),
        ("  labseq demo --copy .", "copies of the sequences and profiles, for you to change"),
    ]
    return [f"The data are in {run_dir}, a file per shot. What next:", *columns(rows)]


def copy_files(folder: Path) -> None:
    """Copy the packaged sequences and profiles, to be changed; what is there is never replaced.

    Args:
        folder: Gets the folders ``sequences`` and ``hardware_profiles``.

    Raises:
        ConfigError: One of the files is there already, and none was copied; or it cannot be written to.
    """
    copies = list(_copies(folder))
    if taken := [new for _, new in copies if new.exists()]:
        more = f" (and {plural(len(taken) - 1, 'more file')})" if len(taken) > 1 else ""
        what = f"this is there already{more}; nothing was copied"
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
        f"{plural(len(copies), 'file')} copied to sequences and hardware_profiles in {visible(str(folder))}. "
        "There:",
        f"  labseq run sequences/{SEQUENCE}.yaml",
        "A sequence that says 'profile: virtual' takes the copy in ./hardware_profiles now.",
    )


def _copies(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Each packaged file, and where its copy goes."""
    for source in (packaged_sequences_dir(), packaged_profiles_dir()):
        for path in sorted(path for path in source.iterdir() if path.is_file()):
            yield path, folder / source.name / path.name
