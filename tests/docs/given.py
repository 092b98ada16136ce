"""What a page takes for granted: a copy of the repository's files, runs that were taken, a lab."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from filelock import FileLock
from labseq_virtual.settings import SimulationSettings
from labseq_virtual.simulation import VirtualSimulation

import labseq as api
from labseq.plugin import Context

from .blocks import ROOT, Block, blocks_of
from .running import RUN, labseq

LOOK: Final = ROOT / "docs" / "how-to" / "replay-frames.md"
"""The page with the files ``look.yaml`` and ``replay.yaml``."""
OWN_RUNS: Final = ("docs/explanation/played-waveforms.md", "docs/tutorials")
"""Pages that speak of the runs that they have taken themselves."""
REAL_LAB: Final = ("docs/how-to/first-day.md",)
"""Pages that mean the profile ``lab`` as it is; on all others it is the virtual lab, to be run."""

NEEDED: Final = {"docs/how-to/calibrate.md": "libaravis", "docs/how-to/cameras-genicam.md": "libaravis"}
"""Page -> what its simulators need that is not on every machine."""
SHOTS: Final = {
    "compact-225": ("sequences/compact_225.yaml", 4),
    "scan-dop": ("sequences/scan_dop.yaml", 8),
    "look": ("look.yaml", 3),
    "figure5-multicycle": ("sequences/figure5_multicycle.yaml", 2),
}
"""Name of a run on a page -> its sequence and number of shots."""


class Store:
    """Runs that pages speak of, each taken once and copied to the place at which a page looks for it.

    Several processes may share its folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)

    def give(self, text: str, to: Path) -> None:
        """Put a run at each folder of a run that stands in a text."""
        for place, name in set(RUN.findall(text)):
            there = to / "data" / f"{place}_{name}"
            if not there.exists() and name in (*SHOTS, "calibrate-sites"):
                shutil.copytree(self.taken(name), there)

    def taken(self, name: str) -> Path:
        """The folder of a run."""
        with FileLock(self.folder / f"{name}.lock"):
            if not (self.folder / name).exists():
                self._take(name)
        (run,) = (self.folder / name).glob(f"*/*_{name}")
        return run

    def _take(self, name: str) -> None:
        data = self.folder / name
        if name == "calibrate-sites":
            copy_repository(data)
            profile = str(data / "hardware_profiles" / "virtual.yaml")
            code, _, errors = labseq(
                ["calibrate", "sites", "-p", profile, "--shots", "8", "--seed", "1", "--output", str(data)]
            )
            assert code == 0, errors
            return
        file, shots = SHOTS[name]
        sequence = ROOT / file
        if file == "look.yaml":
            sequence = self.folder / file
            save_files(LOOK, self.folder)
        every = ["record_frames=all"]
        with api.Session.open(sequence, shots=shots, seed=1, output=data, overrides=every) as session:
            session.run()


def save_files(page: Path, to: Path) -> None:
    """What another page tells to put into files."""
    for block in blocks_of(page):
        if "file" in block.comments:
            (to / block.comments["file"]).write_text(block.text, "utf-8")


@dataclass
class Given:
    """What a page takes for granted beside files.

    Attributes:
        replaced: What stands on the page -> what it is here, for example ids of calibrations.
        names: Python names that its code uses and does not make.
    """

    replaced: dict[str, str] = field(default_factory=dict)
    names: dict[str, Any] = field(default_factory=dict)


def copy_repository(to: Path) -> None:
    """What readers have: sequences and profiles."""
    shutil.copytree(ROOT / "sequences", to / "sequences")
    shutil.copytree(
        ROOT / "hardware_profiles", to / "hardware_profiles", ignore=shutil.ignore_patterns("calibrations")
    )


def virtual_lab(to: Path) -> None:
    """A profile ``lab`` whose devices are virtual."""
    text = (to / "hardware_profiles" / "virtual.yaml").read_text("utf-8")
    lab = to / "hardware_profiles" / "lab.yaml"
    lab.write_text(text.replace("\nname: virtual\n", "\nname: lab\n"), "utf-8")


def prepare(page: str, blocks: list[Block], to: Path, store: Store) -> Given:
    """All that a page takes for granted, in a folder."""
    copy_repository(to)
    if page not in REAL_LAB:
        virtual_lab(to)
    for block in blocks if not page.startswith(OWN_RUNS) else []:
        store.give(block.text, to)
    return GIVEN[page](to) if page in GIVEN else Given()


def _andor(to: Path) -> Given:
    world = VirtualSimulation(SimulationSettings(), Context("simulation"))
    return Given(names={"context": Context("camera", simulation=world)})


def _calibrations(to: Path) -> Given:
    """Two calibrations of the sites of ``lab``, and a table of sites."""
    ids: list[str] = []
    for offset in (21, 20):
        rows = [f"{i},{j},{offset + 20 * i},{20 + 20 * j}" for i in range(20) for j in range(20)]
        (to / "sites.csv").write_text("\n".join(["row,col,y,x", *rows]))
        command = f"calibrate sites -p {to}/hardware_profiles/lab.yaml --from {to}/sites.csv --force --json"
        code, said, errors = labseq(command.split())
        assert code == 0, errors
        ids.append(json.loads(said)["id"])
    return Given({"f102b3": ids[0], "a18d16": ids[1]})


def _loading(to: Path) -> Given:
    np.save(to / "loading.npy", np.random.default_rng(1).random((20, 20)) < 0.75)
    return Given()


def _look(to: Path) -> Given:
    """Its sequence, and its profile on the run that the page names."""
    save_files(LOOK, to)
    replay = (to / "replay.yaml").read_text("utf-8")
    (to / "replay.yaml").write_text(replay.replace("0001_look", "0001_compact-225"), "utf-8")
    return Given()


def _serial(to: Path) -> Given:
    shutil.copy(to / "sequences" / "compact_225.yaml", to / "sequence.yaml")
    return Given()


def _stopped(to: Path) -> Given:
    """The runs of the page, but without the end."""
    for run in to.glob("data/*/*_scan-dop"):
        index = (run / "index.jsonl").read_text("utf-8").splitlines(keepends=True)
        (run / "index.jsonl").write_text("".join(index[:-1]), "utf-8")
        (run / "STATE").write_text("stopped\n")
        max((run / "shots").iterdir()).unlink()
    return Given()


def _survival(to: Path) -> Given:
    """The run of the page, of a sequence with the analysis ``survival``."""
    (shown,) = to.glob("data/*/*_compact-225")
    sequence = to / "sequences" / "survival.yaml"
    text = (to / "sequences" / "compact_225.yaml").read_text("utf-8")
    sequence.write_text(f"{text}\nanalysis: [{{use: survival, finish_within: 60 s}}]\n", "utf-8")
    with api.Session.open(sequence, shots=2, seed=1, output=to / "own") as session:
        run = session.run()
    shutil.rmtree(shown)
    run.path.rename(shown)
    return Given()


GIVEN: Final[dict[str, Callable[[Path], Given]]] = {
    "docs/how-to/analyse-shots.md": _survival,
    "docs/how-to/calibrate.md": _calibrations,
    "docs/how-to/look-at-a-waveform.md": _loading,
    "docs/how-to/replay-frames.md": _look,
    "docs/how-to/resume-a-run.md": _stopped,
    "docs/how-to/serial-devices.md": _serial,
    "docs/how-to/cameras-andor.md": _andor,
}
"""Page -> prepares its folder."""
