"""Small runs that are interrupted and resumed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import labseq
from labseq.errors import StopRequested
from labseq.testing.fakes import RecordingObserver

PROFILE = """labseq: 1
name: bench
grid: {rows: 6, cols: 6, spacing: 4.49 um}
camera: {use: virtual}
static_tweezers: {use: virtual}
mobile_tweezers: {use: virtual}
detector: {use: threshold, frame: [128, 160], centre_px: [63.5, 79.5]}
simulation: {use: virtual, image: {frame: [128, 160], centre_px: [63.5, 79.5]}}
"""
"""A virtual lab of 6 x 6 sites, and of frames as small as they allow."""
SEQUENCE = """
labseq: 1
name: small µ
profile: ./p.yaml
target: {pattern: compact, rows: 3, cols: 3}
planner: {use: psca}
SCAN
shot:
  - load: {duration: 500 ms}
  - image: {exposure: 45 ms}
  - rearrange: {cycles: 2, window: 60 ms, exposure: 45 ms}
  - image: {exposure: 45 ms}
"""
OWN_DEVICE = """
import labseq

LABSEQ_API = 1


class Mine(labseq.plugin.Device):
    def __init__(self, settings, context): pass
    def open(self): pass
    def close(self): pass
    def safe_state(self): pass
    def describe(self): return {}
    def command(self, name, **arguments): pass
    def read(self, name): pass


@labseq.plugin.hookimpl
def labseq_register(registry):
    registry.device("mine", Mine)
"""
"""A plugin with a device that is not virtual."""
SCANS = {
    "no scan": "shots: 6",
    "planner": "scan: {planner.degree_of_parallelism: [1, 4]}\nrepeats: 3\norder: shuffled",
    "steps": "scan: {shot.2.rearrange.window: [10 ms, 60 ms]}\nrepeats: 3\norder: shuffled",
    "profile": "scan: {profile.simulation.loading: [60 %, 80 %]}\nrepeats: 3\norder: shuffled",
    "adaptive": """scan:
  use: climb
  over: {planner.degree_of_parallelism: {from: 1, to: 9}, shot.2.rearrange.window: {from: 1 ms, to: 60 ms}}
  maximise: filling_fraction
  points: 3
repeats: 2""",
    "all": """scan:
  planner.degree_of_parallelism: [2, 4]
  profile.mobile_tweezers.speed: [100 um/ms, 130 um/ms]
order: shuffled""",
}


def write(folder: Path, scan: str = "no scan") -> Path:
    (folder / "p.yaml").write_text(PROFILE, encoding="utf-8")
    path = folder / f"{scan.replace(' ', '_')}.yaml"
    path.write_text(SEQUENCE.replace("SCAN", SCANS[scan]), encoding="utf-8")
    return path


class Interrupting(RecordingObserver):
    """Asks the session to stop at the n-th of some events; the folder of the run is known afterwards."""

    def __init__(self, name: str, n: int) -> None:
        super().__init__()
        self.name, self.n = name, n
        self.session: labseq.Session | None = None

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        super().event(name, values)
        if name == self.name:
            self.n -= 1
            if self.n == 0:
                assert self.session is not None
                self.session.stop_flag.request()


def interrupted(
    sequence: Path, event: str, n: int, seed: int = 5, kind: type[Interrupting] = Interrupting, **options: Any
) -> Path:
    """The folder of a run that was stopped at the n-th event, or came to its end before."""
    observer = kind(event, n)
    output = sequence.parent / "data"
    with labseq.Session.open(sequence, seed=seed, output=output, observer=observer, **options) as session:
        observer.session = session
        try:
            session.run()
        except StopRequested:
            assert session.run_dir is not None
            assert labseq.open_run(session.run_dir).status == "stopped"
        assert session.run_dir is not None
        return session.run_dir


def resumed(run_dir: Path, observer: Any = None, **options: Any) -> labseq.Run:
    with labseq.Session.resume(run_dir, observer=observer, **options) as session:
        return session.run()


def table(run: labseq.Run) -> list[Any]:
    """What must not depend on how often a run was interrupted."""
    return [
        (
            shot.index,
            shot.attempt,
            shot.parameters,
            shot.success,
            shot.filling_fraction,
            shot.row.n_atom_moves,
            shot.occupancies.tobytes(),
            shot.frames.tobytes(),
            [plan.moves.tobytes() for plan in shot.plans],
        )
        for shot in run.shots
    ]


class Wholes:
    """Tables of runs that were never interrupted, by the name of their scan."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.tables: dict[str, list[Any]] = {}

    def __call__(self, scan: str) -> list[Any]:
        if scan not in self.tables:
            self.tables[scan] = table(labseq.open_run(interrupted(write(self.folder, scan), "never", 1)))
        return self.tables[scan]


@pytest.fixture(scope="session")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> Wholes:
    return Wholes(tmp_path_factory.mktemp("whole"))


def lines(run_dir: Path) -> list[str]:
    return (run_dir / "index.jsonl").read_text(encoding="utf-8").splitlines()


def changed(run_dir: Path, change: Any) -> None:
    record = json.loads((run_dir / "run.json").read_text(encoding="utf-8"))
    change(record)
    (run_dir / "run.json").write_text(json.dumps(record), encoding="utf-8")


@pytest.fixture(scope="session")
def stopped_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a profile, a sequence, and a run of six shots: three are done, the fourth was begun."""
    folder = tmp_path_factory.mktemp("stopped")
    interrupted(write(folder), "shot_started", 4)
    return folder


@pytest.fixture
def stopped(stopped_home: Path, tmp_path: Path) -> Path:
    """The run in a copy of that folder."""
    shutil.copytree(stopped_home, tmp_path, dirs_exist_ok=True)
    (file,) = tmp_path.glob("data/*/*/run.json")
    text = file.read_text(encoding="utf-8").replace(str(stopped_home), str(tmp_path))
    file.write_text(text, encoding="utf-8")
    return file.parent
