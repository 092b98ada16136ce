"""The schema of the shot file.

The tree, with n images, a grid of (row, col) sites and frames of (y, x) pixels::

    /entry                      what came of the shot, as attributes
      camera/<name>             images (n, y, x) and, per frame, t_s, exposure_s, number, step, cycle, ...
      images_view               NXdata: what viewers open by default
      detection                 occupancy (n, row, col), confidence, and the table of all images
      target                    fill, clear (row, col)
      rearrangement             tables moves, batches, cycles; predicted (cycle, row, col)
      timing                    table of the stages
      calibrations              id of each one in use, by kind, as attributes
      story                     tables of what a simulation did to the atoms, where it tells
      parameters, readings      JSON
      devices/<name>            JSON
      provenance                attributes, texts and JSON

Tables are compound datasets: one dataset costs 0.1 ms, whatever it holds.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import h5py
import numpy as np
from h5py import h5a, h5s, h5t  # pyright: ignore[reportAttributeAccessIssue] - h5py ships no types
from numpy.typing import NDArray

from labseq.model import CycleRecord, Plan, PlanReport, StageTiming
from labseq.plain import dumps, plain_text, to_plain

FORMAT: Final = "labseq-shot"
FORMAT_VERSION: Final = "1.4"
"""major.minor; a newer minor version only adds things, a newer major version cannot be read."""

RUN_FORMAT: Final = "labseq-run"
RUN_FORMAT_VERSION: Final = "1.3"

LIBRARY_VERSIONS: Final = ("earliest", "v110")
"""File features that HDF5 may use: the widest reader support."""

MOVE_SITES: Final = ("from_row", "from_col", "to_row", "to_col")
"""Columns of ``MOVES`` in the order of ``Plan.moves``."""

_PLACE: Final = [("step", "i4"), ("cycle", "i4")]

MOVES: Final = np.dtype(
    [
        *_PLACE,
        ("batch", "i4"),
        *((name, "i2") for name in MOVE_SITES),
        ("linked", "?"),
        ("played", "?"),
    ]
)
"""One row per atom move, over all cycles; ``batch`` counts from 0 in each cycle."""

BATCHES: Final = np.dtype(
    [
        *_PLACE,
        ("batch", "i4"),
        ("n_atom_moves", "i4"),
        ("n_tweezers", "i4"),
        ("end_s", "f8"),
        ("linked", "?"),
        ("played", "?"),
    ]
)
"""One row per batch, over all cycles; ``end_s`` counts from the start of the cycle."""

CYCLES: Final = np.dtype(
    [
        *_PLACE,
        ("n_batches", "i4"),
        ("n_batches_played", "i4"),
        ("n_atom_moves", "i4"),
        ("n_defects_predicted", "i4"),
        ("n_surplus_predicted", "i4"),
        ("t_start_s", "f8"),
        ("window_s", "f8"),
        ("planned_duration_s", "f8"),
        ("moves_s", "f8"),
    ]
)
"""One row per rearrangement cycle."""

EVENT: Final = "S16"
"""What an image is: "image", or "cycle_3" for the one that ended cycle 3."""

IMAGES: Final = np.dtype([*_PLACE, ("t_start_s", "f8"), ("exposure_s", "f8"), ("event", EVENT)])
"""One row per image, whether its frame was kept or not."""


def timing_dtype(stage: Any) -> np.dtype[Any]:
    """The table of stages; ``stage`` is the text dtype of its first column."""
    return np.dtype(
        [
            ("stage", stage),
            *_PLACE,
            ("t_start_s", "f8"),
            ("duration_s", "f8"),
            ("host_s", "f8"),
            ("budget_s", "f8"),
            ("over_budget", "?"),
        ]
    )


def units_of(table: np.dtype[Any]) -> list[str]:
    """Unit of each column of a table, as its name ends, "" where there is none.

    Example:
        >>> units_of(IMAGES)
        ['', '', 's', 's', '']
    """
    return [unit_of(name) for name in table.names or ()]


def unit_of(name: str) -> str:
    """Unit of a value, as its name ends, "" where that tells none.

    Example:
        >>> unit_of("laser.power_w"), unit_of("spacing_m"), unit_of("seen"), unit_of("beat_hz")
        ('W', 'm', '', 'Hz')
    """
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


_UNITS: Final = {
    **{unit: unit for unit in ("s", "m", "K", "Hz", "rad", "V", "W", "A", "px")},
    **{unit.lower(): unit for unit in ("K", "Hz", "V", "W", "A")},
}
"""What names end in -> unit."""


_JSON: Final = "JSON text"
_GRID: Final = "row, col"


@dataclass(frozen=True, slots=True)
class DatasetDescription:
    """A dataset of a shot's file.

    Attributes:
        dtype: As h5py names it; "table" for one of :data:`COLUMNS`.
        shape: Its axes; "" for a single value.
        meaning: What it is, one sentence without a full stop.
        units: SI unit of its numbers; "" where there is none.
        since: Format version that first had it.
    """

    dtype: str
    shape: str
    meaning: str
    units: str = ""
    since_version: str = "1.0"


DATASETS: Final[Mapping[str, DatasetDescription]] = {
    "target/fill": DatasetDescription("uint8", _GRID, "1 where the target must hold an atom"),
    "target/clear": DatasetDescription("uint8", _GRID, "1 where the target must be empty"),
    "camera/<name>/images": DatasetDescription(
        "uint16", "frame, y, x", "frames as the camera delivered them", "adu"
    ),
    "camera/<name>/t_s": DatasetDescription(
        "float64", "frame", "start of the exposure, from the start of the shot", "s"
    ),
    "camera/<name>/t_clock_s": DatasetDescription(
        "float64", "frame", "start of the exposure on the session's clock", "s"
    ),
    "camera/<name>/t_device_s": DatasetDescription(
        "float64",
        "frame",
        "the camera's own time stamp, from a zero of its own; nan if it gives none",
        "s",
        "1.3",
    ),
    "camera/<name>/number": DatasetDescription(
        "int32", "frame", "place in the camera's series as the camera counted it, from 0", "", "1.3"
    ),
    "camera/<name>/exposure_s": DatasetDescription(
        "float64", "frame", "exposure time that the camera reports", "s"
    ),
    "camera/<name>/image": DatasetDescription(
        "int32", "frame", "index of the image in detection that the frame belongs to"
    ),
    "camera/<name>/step": DatasetDescription("int32", "frame", "index of the step that took it, from 0"),
    "camera/<name>/cycle": DatasetDescription(
        "int32", "frame", "rearrangement cycle that it ended, from 1; 0 for that of an image step"
    ),
    "camera/<name>/event": DatasetDescription(
        "ascii, 16 bytes", "frame", "what it is: image, or cycle_3 for the one that ended cycle 3"
    ),
    "detection/occupancy": DatasetDescription("uint8", "image, row, col", "1 where the detector saw an atom"),
    "detection/confidence": DatasetDescription(
        "float32", "image, row, col", "the detector's confidence in each site"
    ),
    "detection/t_s": DatasetDescription(
        "float64", "image", "start of the exposure, from the start of the shot", "s"
    ),
    "detection/images": DatasetDescription(
        "table", "image", "all images, whether their frames were kept or not"
    ),
    "rearrangement/moves": DatasetDescription("table", "atom move", "the atom moves of all plans"),
    "rearrangement/batches": DatasetDescription(
        "table", "batch", "the batches of all plans: moves made at the same time"
    ),
    "rearrangement/cycles": DatasetDescription(
        "table", "cycle", "the rearrangement cycles: plan, check, move, image"
    ),
    "rearrangement/predicted": DatasetDescription(
        "uint8", "cycle, row, col", "1 where the whole plan leaves an atom if none is lost"
    ),
    "timing": DatasetDescription("table", "stage", "how long each stage took, against its budget"),
    "story/<name>": DatasetDescription(
        "table", "row", "what a simulation tells of the atoms; see its plugin", "", "1.1"
    ),
    "parameters": DatasetDescription(
        _JSON, "", "what differs from the files in this shot: address -> value, SI"
    ),
    "readings": DatasetDescription(_JSON, "", "values read from devices during the shot, SI: name -> value"),
    "devices/<name>": DatasetDescription(_JSON, "", "what the device says of itself, SI"),
    "provenance/sequence": DatasetDescription("text", "", "the sequence file"),
    "provenance/profile": DatasetDescription("text", "", "the hardware profile"),
    "provenance/resolved": DatasetDescription(_JSON, "", "every setting after defaults and overrides, SI"),
    "provenance/overrides": DatasetDescription(
        _JSON, "", "what --set and other options changed: address -> value"
    ),
    "provenance/plugins": DatasetDescription(
        _JSON, "", "name, version and origin of each plugin that was used"
    ),
    "provenance/<name>": DatasetDescription(
        "JSON or plain text", "", "where the run comes from: versions, host, user"
    ),
}
"""Path below ``/entry`` -> the dataset. Short values of devices and provenance are attributes instead."""

_STEP: Final = "index of the step in the shot, from 0"
_CYCLE: Final = "rearrangement cycle, from 1"
_BATCH: Final = "index of the batch in its cycle, from 0"
_LINKED: Final = "whether the batch goes on with the tweezers of the one before still on"
_PLAYED: Final = "whether it fitted into the window and was played"

COLUMNS: Final[Mapping[str, Mapping[str, str]]] = {
    "detection/images": {
        "step": _STEP,
        "cycle": "rearrangement cycle that it ended, from 1; 0 for that of an image step",
        "t_start_s": "start of the exposure, from the start of the shot",
        "exposure_s": "exposure time",
        "event": "what it is: image, or cycle_3 for the one that ended cycle 3",
    },
    "rearrangement/moves": {
        "step": _STEP,
        "cycle": _CYCLE,
        "batch": _BATCH,
        "from_row": "row that the atom is taken from",
        "from_col": "column that the atom is taken from",
        "to_row": "row that it is brought to; beyond the grid where it is ejected",
        "to_col": "column that it is brought to; beyond the grid where it is ejected",
        "linked": _LINKED,
        "played": _PLAYED,
    },
    "rearrangement/batches": {
        "step": _STEP,
        "cycle": _CYCLE,
        "batch": _BATCH,
        "n_atom_moves": "atom moves in it",
        "n_tweezers": "mobile tweezers on in it, crossings without an atom included",
        "end_s": "when it ends, from the start of the cycle, overheads included",
        "linked": _LINKED,
        "played": _PLAYED,
    },
    "rearrangement/cycles": {
        "step": _STEP,
        "cycle": _CYCLE,
        "n_batches": "batches of the plan",
        "n_batches_played": "batches that fitted into the window and were played",
        "n_atom_moves": "atom moves of the plan",
        "n_defects_predicted": "empty target sites after the whole plan if no atom is lost",
        "n_surplus_predicted": "atoms after the whole plan on sites that must be empty",
        "t_start_s": "start of the cycle, from the start of the shot",
        "window_s": "time that the cycle had for its moves",
        "planned_duration_s": "from the start of the cycle to the end of the plan's last batch",
        "moves_s": "modelled duration of what was played, overheads included",
    },
    "timing": {
        "stage": "name of the stage: load, expose, detect, plan, check, prepare, play, ...",
        "step": _STEP,
        "cycle": "rearrangement cycle, from 1; 0 outside of one",
        "t_start_s": "start on the session's clock, from the start of the shot",
        "duration_s": "duration on the session's clock; in a dry run the modelled time",
        "host_s": "duration on the computer's clock",
        "budget_s": "what it may take; nan without a budget",
        "over_budget": "whether it took longer than its budget",
    },
}
"""Path of a table below ``/entry`` -> its columns."""

TABLES: Final[Mapping[str, np.dtype[Any]]] = {
    "detection/images": IMAGES,
    "rearrangement/moves": MOVES,
    "rearrangement/batches": BATCHES,
    "rearrangement/cycles": CYCLES,
    "timing": timing_dtype("O"),
}
"""Path of a table below ``/entry`` -> its dtype; the stage of ``timing`` is UTF-8 text as long as needed."""

_NEXUS: Final = "for viewers: class, signal, axes or default plot after NeXus"

ATTRIBUTES: Final[Mapping[str, Mapping[str, tuple[str, str]]]] = {
    "/": {
        "format": ("text", FORMAT),
        "format_version": ("text", "major.minor; a newer minor version only adds things"),
        "creator": ("text", "labseq and its version"),
        "NX_class": ("text", _NEXUS),
        "default": ("text", _NEXUS),
    },
    "/entry": {
        "NX_class": ("text", _NEXUS),
        "default": ("text", _NEXUS),
        "run_id": ("text", "the run's folder below the data root: date/counter_name"),
        "simulated": ("bool", "whether all hardware was simulated"),
        "record_frames": ("text", "which frames are kept: all, last or none"),
        "shot_index": ("int64", "index of the shot in the run, from 0"),
        "attempt": ("int64", "0 for the first try"),
        "status": ("text", "complete, interrupted or failed"),
        "error": ("text", "why it did not complete, or empty"),
        "t_start_utc": ("text", "wall time of its start, ISO 8601, UTC"),
        "t_end_utc": ("text", "wall time of its end"),
        "success": ("bool", "whether the last image step met the target"),
        "filling_fraction": ("float64", "filling of the target on the last image step; nan without one"),
        "seen_defect_free_cycle": ("int64", "first cycle whose image met the target; 0 if none"),
        "n_missing_atoms": ("int64", "atoms that the loading fell short of the target"),
        "n_images": ("int64", "number of images"),
        "n_cycles": ("int64", "number of rearrangement cycles"),
        "seed": ("int64 or text", "seed of the run; text where it does not fit into 64 bits"),
    },
    "/entry/target": {
        "name": ("text", "name of the target pattern"),
        "lattice": ("text", "lattice of the grid"),
        "grid_spacing_m": ("float64", "spacing of the sites, in m"),
    },
    "/entry/camera/<name>": {
        "NX_class": ("text", _NEXUS),
        "name": ("text", "name of the camera"),
    },
    "/entry/camera/<name>/images": {
        "interpretation": ("text", _NEXUS),
        "long_name": ("text", "title for viewers"),
    },
    "/entry/images_view": {
        "NX_class": ("text", _NEXUS),
        "signal": ("text", _NEXUS),
        "axes": ("text list", _NEXUS),
    },
    "/entry/detection": {
        "NX_class": ("text", _NEXUS),
        "signal": ("text", _NEXUS),
        "auxiliary_signals": ("text list", _NEXUS),
        "axes": ("text list", _NEXUS),
    },
    "/entry/detection/occupancy": {"interpretation": ("text", _NEXUS)},
    "/entry/detection/confidence": {"interpretation": ("text", _NEXUS)},
    "/entry/calibrations": {"<kind>": ("text", "id of the calibration of this kind in use, since 1.2")},
    "/entry/provenance": {
        "seed": ("int64", "seed of the run"),
        "sequence_sha256": ("text", "SHA-256 of the sequence file"),
        "profile_sha256": ("text", "SHA-256 of the profile"),
        "<name>": ("any", "short values: versions, host, user"),
    },
    "/entry/devices": {"<name>": ("any", "short values that a device says of itself")},
}
"""Path -> its attributes: type and meaning. Those that every dataset has are left out."""

EVERYWHERE: Final[Mapping[str, str]] = {
    "units": "unit of the numbers, SI or adu, empty where there is none; of a table that of each column",
    "description": "what the dataset is, since 1.4",
    "descriptions": "tables only: what each column is, since 1.4",
    "content_type": "texts only: application/json or text/plain",
}
"""Attributes of every dataset."""

UNDOCUMENTED: Final = "as the simulation that told it means it"
"""What a column of a story is whose simulation does not describe it."""


def column_meanings(path: str, table: np.dtype[Any]) -> list[str]:
    """What each column of a table is.

    Args:
        path: A key of :data:`COLUMNS`, or "story/<name>".
        table: Its dtype. That of a story may carry ``metadata={"descriptions": {column: text}}``.

    Example:
        >>> described = np.dtype([("t_s", "f8")], metadata={"descriptions": {"t_s": "when"}})
        >>> column_meanings("story/<name>", described)
        ['when']
    """
    known = COLUMNS.get(path)
    if known is None:
        known = (table.metadata or {}).get("descriptions") or {}
    return [str(known.get(name, UNDOCUMENTED)) for name in table.names or ()]


_MAX_ATTRIBUTE: Final = 256
_NODES_JSON: Final = "application/json"
_TEXT: Final = "text/plain"


_STRING: Final = h5py.string_dtype()
_STRING_TYPE: Final = h5t.py_create(_STRING, logical=True)
_SCALAR: Final = h5s.create(h5s.SCALAR)


def set_attributes(node: Any, /, **values: Any) -> None:
    """Add attributes to a group or dataset that has none of these names; text is made fit for HDF5."""
    for name, value in values.items():
        if isinstance(value, str):
            _add_text(node, name, np.array(plain_text(value), _STRING), _SCALAR)
        else:
            node.attrs[name] = value


def describe(dataset: Any, what: DatasetDescription) -> None:
    """Say in its attributes what a dataset is, and in what unit."""
    set_attributes(dataset, units=what.units, description=what.meaning)


def describe_columns(dataset: Any, units: Sequence[str], descriptions: Sequence[str]) -> None:
    """Say in the attributes of a table what each column is, and in what unit."""
    space = h5s.create_simple((len(units),))
    for name, texts in (("units", units), ("descriptions", descriptions)):
        _add_text(dataset, name, np.array(list(map(plain_text, texts)), _STRING), space)


def _add_text(node: Any, name: str, text: Any, space: Any) -> None:
    h5a.create(node.id, name.encode(), _STRING_TYPE, space).write(text)  # attrs[...] takes twice the time


def write_json(group: h5py.Group, name: str, value: object, what: DatasetDescription) -> None:
    """Add a dataset that holds a value as JSON."""
    _write_text(group, name, dumps(value), _NODES_JSON, what)


def _write_text(group: h5py.Group, name: str, text: str, content_type: str, what: DatasetDescription) -> None:
    dataset = group.create_dataset(name, data=text, dtype=_STRING)
    set_attributes(dataset, content_type=content_type)
    describe(dataset, what)


def read_json(group: Any, name: str) -> Any:
    """Read what :func:`write_json` wrote."""
    return json.loads(group[name][()])


def write_values(group: h5py.Group, values: Mapping[str, Any], kind: str) -> None:
    """Add values of any kind: short ones as attributes, the rest as datasets of text or JSON.

    Args:
        group: Where to.
        values: Name -> value.
        kind: What the group is called in :data:`labseq.recording.schema.DATASETS`.
    """
    taken: set[str] = set()
    for key, value in values.items():
        plain = to_plain(value)
        name = link_name(key, taken)
        taken.add(name)
        if _fits_attribute(plain):
            set_attributes(group, **{name: plain})
            continue
        what = DATASETS.get(f"{kind}/{key}") or DATASETS[f"{kind}/<name>"]
        if isinstance(plain, str):
            _write_text(group, name, plain_text(plain), _TEXT, what)
        else:
            write_json(group, name, plain, what)


def read_values(group: Any) -> dict[str, Any]:
    """Read what :func:`write_values` wrote."""
    values = {name: plain_attribute(value) for name, value in group.attrs.items()}
    for name, dataset in group.items():
        text = dataset[()].decode()
        values[name] = json.loads(text) if dataset.attrs["content_type"] == _NODES_JSON else text
    return values


def plain_attribute(value: Any) -> Any:
    """An attribute as a plain Python value."""
    return value.item() if isinstance(value, np.generic) else value


def _fits_attribute(value: object) -> bool:
    if isinstance(value, str):
        return len(value) < _MAX_ATTRIBUTE and "\n" not in value
    return isinstance(value, (bool, float)) or (isinstance(value, int) and -(2**63) <= value < 2**63)


def link_name(name: str, taken: Container[str]) -> str:
    """A name that HDF5 takes, unlike those that are taken.

    Example:
        >>> link_name("laser/780", ()), link_name(".", {"_"})
        ('laser_780', '__2')
    """
    clean = plain_text(name).replace("/", "_")
    if not clean.strip("."):
        clean = "_"
    free, n = clean, 1
    while free in taken:
        n += 1
        free = f"{clean}_{n}"
    return free


def moves_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per atom move, over all cycles (:data:`MOVES`)."""
    tables = [_moves_of(cycle) for cycle in cycles]
    return np.concatenate(tables) if tables else np.empty(0, MOVES)


def batches_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per batch, over all cycles (:data:`BATCHES`)."""
    tables = [_batches_of(cycle) for cycle in cycles]
    return np.concatenate(tables) if tables else np.empty(0, BATCHES)


def cycles_table(cycles: Sequence[CycleRecord]) -> NDArray[Any]:
    """One row per cycle (:data:`CYCLES`)."""
    rows = [
        (
            c.step,
            c.cycle,
            c.plan.n_batches,
            c.n_batches_played,
            c.plan.n_atom_moves,
            c.report.n_defects,
            c.report.n_surplus,
            c.t_start_s,
            c.window_s,
            c.report.duration_s,
            c.moves_s,
        )
        for c in cycles
    ]
    return np.array(rows, CYCLES)


def _moves_of(cycle: CycleRecord) -> NDArray[Any]:
    plan = cycle.plan
    table = np.empty(plan.n_atom_moves, MOVES)
    batch = np.repeat(np.arange(plan.n_batches, dtype=np.int32), np.diff(plan.batch_offsets))
    table["step"], table["cycle"], table["batch"] = cycle.step, cycle.cycle, batch
    for column, name in enumerate(MOVE_SITES):
        table[name] = plan.moves[:, column]
    table["linked"] = plan.linked[batch]
    table["played"] = batch < cycle.n_batches_played
    return table


def _batches_of(cycle: CycleRecord) -> NDArray[Any]:
    plan = cycle.plan
    table = np.empty(plan.n_batches, BATCHES)
    table["step"], table["cycle"], table["batch"] = cycle.step, cycle.cycle, np.arange(plan.n_batches)
    table["n_atom_moves"] = np.diff(plan.batch_offsets)
    table["n_tweezers"] = cycle.report.n_tweezers
    table["end_s"] = cycle.report.batch_end_s
    table["linked"] = plan.linked
    table["played"] = table["batch"] < cycle.n_batches_played
    return table


def cycles_of(
    cycles: NDArray[Any], batches: NDArray[Any], moves: NDArray[Any], predicted: NDArray[Any]
) -> list[CycleRecord]:
    """Take the tables apart again; ``predicted`` is (n_cycles, n_rows, n_cols)."""
    batch_ends = np.cumsum(cycles["n_batches"])
    move_ends = np.cumsum(cycles["n_atom_moves"])
    return [
        _cycle_of(
            row,
            batches[batch_end - row["n_batches"] : batch_end],
            moves[move_end - row["n_atom_moves"] : move_end],
            occupancy,
        )
        for row, batch_end, move_end, occupancy in zip(cycles, batch_ends, move_ends, predicted, strict=True)
    ]


def _cycle_of(row: Any, batches: NDArray[Any], moves: NDArray[Any], predicted: NDArray[Any]) -> CycleRecord:
    sites = np.stack([moves[name] for name in MOVE_SITES], axis=1)
    offsets = np.concatenate([[0], np.cumsum(batches["n_atom_moves"])])
    report = PlanReport(
        predicted=predicted.astype(np.bool_),
        batch_end_s=batches["end_s"].copy(),
        n_tweezers=batches["n_tweezers"].copy(),
        n_defects=int(row["n_defects_predicted"]),
        n_surplus=int(row["n_surplus_predicted"]),
    )
    return CycleRecord(
        step=int(row["step"]),
        cycle=int(row["cycle"]),
        plan=Plan(sites, offsets, batches["linked"]),
        report=report,
        n_batches_played=int(row["n_batches_played"]),
        window_s=float(row["window_s"]),
        t_start_s=float(row["t_start_s"]),
        moves_s=float(row["moves_s"]),
    )


def timing_table(timing: Sequence[StageTiming]) -> NDArray[Any]:
    """One row per stage (:func:`timing_dtype`)."""
    stages = [plain_text(t.stage).encode() for t in timing]
    width = max(map(len, stages), default=0) or 1
    rows = [
        (stage, t.step, t.cycle, t.t_start_s, t.duration_s, t.host_s, t.budget_s, t.over_budget)
        for stage, t in zip(stages, timing, strict=True)
    ]
    return np.array(rows, timing_dtype(h5py.string_dtype("utf-8", width)))


def timing_of(table: NDArray[Any]) -> list[StageTiming]:
    """Take the table of stages apart again."""
    return [
        StageTiming(
            stage=row["stage"].decode(),
            step=int(row["step"]),
            cycle=int(row["cycle"]),
            t_start_s=float(row["t_start_s"]),
            duration_s=float(row["duration_s"]),
            host_s=float(row["host_s"]),
            budget_s=float(row["budget_s"]),
        )
        for row in table
    ]
