"""Make again the pictures that commands on the pages make: runs, plans, waveforms, calibrations.

    python docs/make_pictures.py [NAME ...]

Each is made in an empty folder by the commands that its page shows. Other scripts make the rest:
``make_gallery.py`` the patterns, ``make_planner_tables.py`` the planners' figures, ``make_paper_figures.py``
the paper's, ``make_run_picture.py`` the README's, ``make_off_picture.py`` that of the safety page.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from PIL import Image

DOCS: Final = Path(__file__).parent
STATIC: Final = DOCS / "_static"
WIDTH_PX: Final = 1400
N_COLOURS: Final = 128


@dataclass(frozen=True)
class Picture:
    """A picture and how it comes about.

    Attributes:
        page: The page that shows its commands, relative to the docs.
        commands: The commands, as the page shows them.
        made: Pattern of the file that they make.
    """

    page: str
    commands: tuple[str, ...]
    made: str


_KAGOME = 'labseq plan random:10x10@0.75 --seed 4 --target "{pattern: kagome, rows: 7, cols: 7}"'
_COMPACT = 'labseq plan random:20x20@0.75 --seed 1 --target "{pattern: compact, rows: 15, cols: 15}"'
_SCAN = "labseq run scan_dop --seed 1 --set repeats=50 --set record_frames=all"
_KINDS = ("tweezers", "sites", "thresholds", "frequencies", "overlay")
_MORNING = tuple(f"labseq calibrate {kind} --profile practice --seed 1" for kind in _KINDS)

_SURVIVAL = "survival:before,after"
_FIRST_WEEK = {
    "lifetime": f"{_SURVIVAL} --fit exponential",
    "loading_time": "loading --fit saturation",
    "imaging_exposure": f"{_SURVIVAL} --fit exponential",
    "trap_depth": f"{_SURVIVAL} --fit lowering",
    "release_recapture": f"{_SURVIVAL} --fit release_recapture",
    "transport_speed": "analysis.survival.survival --fit step",
    "hand_over_ramp": f"{_SURVIVAL} --fit gaussian --fit-set centre=0",
    "parking": f"{_SURVIVAL} --fit plateau --fit-set offset=free",
}

PICTURES: Final = {
    "plan_kagome.png": Picture(
        "how-to/look-at-a-plan.md", (f"{_KAGOME} --png plan_kagome.png",), "plan_kagome.png"
    ),
    "waveform.png": Picture(
        "how-to/look-at-a-waveform.md",
        (f"{_KAGOME} --json plan.json", "labseq waveform plan.json --batches 1-3 --png waveform.png"),
        "waveform.png",
    ),
    "grid_waveform.png": Picture(
        "explanation/grid-planner.md",
        (
            f"{_COMPACT} --planner grid --json plan.json",
            "labseq waveform plan.json --batches 1 --png grid_waveform.png",
        ),
        "grid_waveform.png",
    ),
    "grid_plan.png": Picture(
        "explanation/grid-planner.md", (f"{_COMPACT} --planner grid --png plan.png",), "plan.png"
    ),
    "scan_window.png": Picture(
        "tutorials/scan.md",
        ("labseq run window.yaml --seed 1", "labseq plot --what scan -o window.png"),
        "window.png",
    ),
    "pulses/ramsey.png": Picture(
        "how-to/pulses.md",
        ("labseq run ramsey --seed 2", "labseq plot --what scan -o ramsey.png"),
        "ramsey.png",
    ),
    "plot/overview.png": Picture("how-to/plot.md", (_SCAN, "labseq plot"), "*.png"),
    "plot/cycle.png": Picture("how-to/plot.md", (_SCAN, "labseq plot --shot 3 --cycle 1"), "*.png"),
    **{
        f"first_week/{name}.png": Picture(
            "how-to/first-week.md",
            (f"labseq run {name} --seed 1", f"labseq plot --scan {shown} -o {name}.png"),
            f"{name}.png",
        )
        for name, shown in _FIRST_WEEK.items()
    },
    **{
        f"calibration/{kind}.png": Picture(
            "tutorials/calibrating.md",
            _MORNING[: _KINDS.index(kind) + 1],
            f"hardware_profiles/calibrations/practice/{kind}-*.png",
        )
        for kind in ("tweezers", "sites", "overlay")
    },
}
"""Picture -> how it is made."""


def make(name: str, static: Path = STATIC) -> None:
    """Make one picture.

    Args:
        name: Its path below the static files.
        static: The folder of the static files.
    """
    picture = PICTURES[name]
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        for source in ("sequences", "hardware_profiles"):
            leave = shutil.ignore_patterns("calibrations")
            shutil.copytree(DOCS.parent / source, here / source, ignore=leave)
        for path, text in files_of(DOCS / picture.page).items():
            (here / path).write_text(text, "utf-8")
        for command in picture.commands:
            program = [sys.executable, "-m", *shlex.split(command)]
            subprocess.run(program, cwd=here, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - labseq
        (made,) = here.glob(picture.made)
        (static / name).parent.mkdir(parents=True, exist_ok=True)
        save_small(made, static / name)


def save_small(made: Path, path: Path) -> None:
    """Save a picture with few colours and no more pixels than a page shows."""
    with Image.open(made) as picture:
        small = picture.convert("RGB")
    small.thumbnail((WIDTH_PX, 10 * WIDTH_PX))
    # the default method would turn the few pixels of a colour map to grey
    method = Image.Quantize.MAXCOVERAGE
    small.quantize(N_COLOURS, method, dither=Image.Dither.NONE).save(path, optimize=True)


def files_of(page: Path) -> dict[str, str]:
    """The files that a page tells its reader to write, in the page's own folder."""
    fence = re.compile(r"^<!-- file: ([\w.]+) -->\n```\w+\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    return dict(fence.findall(page.read_text("utf-8")))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "names", nargs="*", choices=[*PICTURES, []], metavar="NAME", help="all if none is named"
    )
    for one in parser.parse_args().names or PICTURES:
        make(one)
