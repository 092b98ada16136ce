"""Files of every kind that labseq reads, damaged at random, and what the commands do with them."""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from labseq.assembly.assemble import assemble
from labseq.assembly.options import Options
from labseq.calibration_store import encode_entry, read_entry, stem_of
from labseq.data.reader import open_run
from labseq.errors import LabseqError
from labseq.model import SiteGrid
from labseq.plans.plan_file import parse_plan
from labseq.queue.listing import list_entries
from labseq.queue.queue import Entry, Queue
from labseq.recording.doctor import examine
from labseq.recording.shot_file import read_content, read_frames, read_occupancies
from labseq.testing.fakes import fake_calibration
from tests.config.mutations import PIECES
from tests.recording.damages import LOST, REPAIRABLE, lost_line, write_whole_run

ROOT: Final = Path(__file__).parents[2]
KINDS: Final = ("sequence", "profile", "calibration", "plan", "queue", "run.json", "index", "shot", "run")
ODD: Final[tuple[Any, ...]] = (
    None, True, -1, 0, 2**63, 10**400, -0.0, 1e999, float("nan"), "", "x" * 5000, "\0", "\ud800", "\x1b[2J",
    "../../..", "1e30000000", "1/0", "/dev/zero", [], {}, [[]], {"": None}, [1, "a", None],
)  # fmt: skip
"""Values that no field expects."""


@dataclass(frozen=True, slots=True)
class Case:
    """A damaged file, or a damaged run, and the call that reads it.

    Attributes:
        path: The file, or the run's folder.
        read: What the commands do with it.
    """

    path: Path
    read: Callable[[], object]


class Templates:
    """Files as labseq writes them, made once."""

    def __init__(self, folder: Path) -> None:
        self.run_dir = write_whole_run(folder / "template")
        self.sequence = (ROOT / "sequences" / "compact_225.yaml").read_bytes()
        self.profile = (ROOT / "hardware_profiles" / "virtual.yaml").read_bytes()
        self.calibration = fake_calibration(
            "overlay", SiteGrid(3, 4), values={"offset_m": [0.0, 0.0]}, quality={"error_m": 2e-8}
        )
        self.plan: dict[str, Any] = {
            "planner": "mine",
            "grid": {"n_rows": 2, "n_cols": 3, "spacing_m": 4.49e-6, "lattice": "square", "shear": 1},
            "degree_of_parallelism": 4, "seed": None, "occupancy": [[1, 0, 0], [0, 0, 1]],
            "target": {"fill": [[0, 1, 0], [0, 0, 0]], "clear": [[0, 0, 0], [0, 0, 1]]}, "n_batches": 1,
            "batches": [{"from": [[0, 0]], "to": [[0, 1]], "linked": False}],
        }  # fmt: skip


def make_case(kind: str, rng: random.Random, templates: Templates, folder: Path) -> Case:
    """Make a damaged file of a kind in an empty folder."""
    if kind in ("sequence", "profile"):
        return _yaml_case(kind, rng, templates, folder)
    if kind == "plan":
        path = folder / "plan.json"
        path.write_bytes(damaged_json(rng, json.dumps(templates.plan).encode()))
        return Case(path, lambda: parse_plan(path.read_bytes(), "plan.json"))
    if kind == "calibration":
        path = folder / f"{stem_of(templates.calibration)}.json"
        path.write_bytes(damaged_json(rng, encode_entry(templates.calibration)))
        return Case(path, lambda: read_entry(path))
    if kind == "queue":
        return _queue_case(rng, folder)
    return _run_case(kind, rng, templates, folder)


def _yaml_case(kind: str, rng: random.Random, templates: Templates, folder: Path) -> Case:
    texts = {"sequence": templates.sequence, "profile": templates.profile}
    texts[kind] = damaged_text(rng, texts[kind])
    sequence, profile = folder / "sequence.yaml", folder / "virtual.yaml"
    sequence.write_bytes(texts["sequence"])
    profile.write_bytes(texts["profile"])
    return Case(sequence if kind == "sequence" else profile, lambda: assemble(sequence, Options()))


def _queue_case(rng: random.Random, folder: Path) -> Case:
    queue = Queue(folder)
    queue.folder.mkdir()
    sequence = folder / "s.yaml"
    queue.write(Entry(1, Fraction(1), "2026-01-02T03:04:05+00:00", sequence, "labseq: 1", Options()))
    path = queue.folder / "0001.json"
    path.write_bytes(damaged_json(rng, path.read_bytes()))

    def read() -> None:
        queue.entries()
        list_entries(as_json=False)
        list_entries(as_json=True)
        queue.remove([1])

    return Case(path, read)


def _run_case(kind: str, rng: random.Random, templates: Templates, folder: Path) -> Case:
    run_dir = folder / "data" / templates.run_dir.parent.name / templates.run_dir.name
    shutil.copytree(templates.run_dir, run_dir)
    if kind == "run":
        damage_run(rng, run_dir)
        return Case(run_dir, lambda: _read_run(run_dir, repair=True))
    path = {
        "run.json": run_dir / "run.json",
        "index": run_dir / "index.jsonl",
        "shot": run_dir / "shots" / "shot_000001.h5",
    }[kind]
    if kind == "shot":
        damage_shot(rng, path)
        lost_line(run_dir)  # so that the doctor reads the file
        return Case(path, lambda: _read_shot(path, run_dir))
    lines = path.read_bytes().split(b"\n") if kind == "index" else [path.read_bytes()]
    i = rng.randrange(len(lines))
    lines[i] = damaged_json(rng, lines[i] or b"{}")
    path.write_bytes(b"\n".join(lines))
    return Case(path, lambda: _read_run(run_dir))


def damage_run(rng: random.Random, run_dir: Path) -> None:
    """Damage a run in up to six places; one run of a hundred gets files of an absurd size."""
    for plant in rng.sample([*REPAIRABLE, *LOST], rng.randint(1, 3)) + [
        rng.choice([swollen, swollen_document])
    ] * (rng.random() < 0.01):
        with suppress(OSError, IndexError, KeyError, ValueError):  # nothing is left to damage
            plant(run_dir)
    files = sorted(path for path in run_dir.rglob("*") if path.is_file() and path.stat().st_size < 1 << 20)
    for path in rng.sample(files, rng.randint(0, 3)):
        path.write_bytes(damaged_bytes(rng, path.read_bytes()))


def swollen(run_dir: Path) -> None:
    """Files as large as a fault of a file system, or an ill will, can make them."""
    for name in ("shots/shot_000002.h5", "shots/shot_000008.h5", "STATE", "skipped.jsonl"):
        with (run_dir / name).open("ab") as file:
            file.truncate(1 << 40)
    index = run_dir / "index.jsonl"
    index.write_bytes(index.read_bytes() * 10_000)
    (run_dir / "events.jsonl").write_bytes(b"x\n" * 1_000_000)


def swollen_document(run_dir: Path) -> None:
    """A run.json with millions of values."""
    path = run_dir / "run.json"
    path.write_bytes(path.read_bytes().rstrip()[:-1] + b', "x": [' + b"[]," * 5_000_000 + b"[]]}")


def _read_run(run_dir: Path, *, repair: bool = False) -> None:
    examine(run_dir.parents[1], dry_run=True)
    if repair:
        examine(run_dir.parents[1])
    run = open_run(run_dir)
    _ = (
        run.summary(),
        run.scan,
        run.changes,
        run.units,
        run.name,
        run.seed,
        run.target,
        run.events,
        repr(run),
    )
    for shot in (*run.shots, *run.attempts):
        _ = (shot.parameters, shot.calibrations, repr(shot))
    run.to_dataframe(attempts=True)


def _read_shot(path: Path, run_dir: Path) -> None:
    examine(run_dir, dry_run=True)
    for read in (read_content, read_occupancies, read_frames):
        try:
            read(path)
        except LabseqError as error:
            last: LabseqError | None = error
        else:
            last = None
    if last is not None:
        raise last


def damaged_bytes(rng: random.Random, data: bytes) -> bytes:
    """Data after flips, a cut, or a doubled or zeroed part."""
    changed = bytearray(data)
    match rng.randrange(5):
        case 0:
            return bytes(changed[: rng.randint(0, len(changed))])
        case 1 if changed:
            start = rng.randrange(len(changed))
            stop = min(len(changed), start + rng.randint(1, 4096))
            changed[start:stop] = bytes(stop - start)
        case 2:
            start = rng.randint(0, len(changed))
            changed[start:start] = changed[start : start + rng.randint(1, 512)]
        case _:
            for _ in range(rng.randint(1, 30) if changed else 0):
                changed[rng.randrange(len(changed))] = rng.choice([0, 255, rng.randrange(256)])
    return bytes(changed)


def damaged_text(rng: random.Random, data: bytes) -> bytes:
    """YAML after some accidents to its values, lines and bytes."""
    for _ in range(rng.randint(1, 4)):
        lines = data.splitlines(keepends=True) or [b""]
        i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
        head, colon, _ = lines[i].partition(b": ")
        piece = rng.choice(
            [*PIECES, *(str(one).encode("utf-8", "replace") for one in ODD), b"= 2 ** 900", b"[" * 60]
        )
        match rng.randrange(6):
            case 0:
                lines[i] = head + colon + piece + b"\n"
            case 1:
                lines[i], lines[j] = lines[j], lines[i]
            case 2:
                del lines[i]
            case 3:
                lines.insert(i, lines[j])
            case 4:
                lines[i] = b" " * rng.randint(0, 6) + lines[i].lstrip(b" ")
            case _:
                lines = [damaged_bytes(rng, data)]
        data = b"".join(lines)
    return data


def damaged_json(rng: random.Random, data: bytes) -> bytes:
    """JSON with odd values at random places, or with damaged bytes."""
    if rng.random() < 0.2:
        return damaged_bytes(rng, data)
    if rng.random() < 0.05:
        return b"[" * 100_000
    value = json.loads(data)
    for _ in range(rng.randint(1, 3)):
        places = [*_places(value)]
        if not places:
            break
        parent, key = rng.choice(places)
        if rng.random() < 0.2:
            del parent[key]
        else:
            # A copy: an odd value that is damaged in its turn must not come to hold itself.
            parent[key] = copy.deepcopy(rng.choice([*ODD, [rng.choice(ODD)], {"a": rng.choice(ODD)}]))
    return json.dumps(value).encode()


def _places(value: Any) -> list[tuple[Any, Any]]:
    items = (
        value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
    )
    own = [(value, key) for key, _ in items]
    inner = value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ()
    return own + [place for one in inner for place in _places(one)]


def damage_shot(rng: random.Random, path: Path) -> None:
    """Damage a shot's file: its bytes, or an object in it."""
    if rng.random() < 0.5:
        path.write_bytes(damaged_bytes(rng, path.read_bytes()))
        return
    names: list[str] = []
    with h5py.File(path, "r+", libver=("earliest", "v110")) as file:
        file.visit(names.append)
        for name in rng.sample(names, min(len(names), rng.randint(1, 3))):
            with suppress(KeyError, RuntimeError):  # it is gone, or behind a link that leads to itself
                _damage_object(rng, file, name)


def _damage_object(rng: random.Random, file: Any, name: str) -> None:
    node, odd = (
        file[name],
        rng.choice([0, -1, 1e300, "\x1b[2J", "[" * 200, 2**62, np.nan, np.zeros((0, 3)), np.ones(5)]),
    )
    match rng.randrange(5):
        case 0 if node.attrs:
            node.attrs[rng.choice([*node.attrs])] = odd
        case 1:
            del file[name]
        case 2:
            del file[name]
            file[name] = odd
        case 3:
            del file[name]
            file[name] = rng.choice(
                [h5py.SoftLink("/entry"), h5py.SoftLink("/no"), h5py.ExternalLink("/dev/zero", "/x")]
            )
        case _:
            del file[name]
            file.create_dataset(name, (rng.choice([2**20, 2**40]), 4, 4), np.uint8, chunks=(1, 4, 4))
