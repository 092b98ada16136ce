"""The schema of the shot file and of a run's index: every value, with its type, unit and description.

The tree of a shot file, with n images, a grid of (row, col) sites and frames of (y, x) pixels::

    /entry                      the shot, as attributes (SHOT); JSON texts (SHOT_TEXTS)
      parameters/<address>      what was set for the run or scanned
      run                       what all shots of the run share: attributes (RUN) and texts (RUN_TEXTS)
      target                    fill, clear (row, col)
      camera/<name>             images (n, y, x), t_s (n,) and the table of frames
      images_view               NXdata: what viewers open by default
      detection                 occupancy (n, row, col), confidence, signal, t_s and the table of images;
                                threshold (row, col), sites_px (row, col, yx)
      rearrangement             tables of moves, batches and cycles, and of paths where tones have some;
                                predicted (cycle, row, col)
      steps                     table of the steps: planned and achieved durations
      timing                    table of the stages
      atom_events               tables of the events of the atoms in a simulation

To record a new value, add an attribute to the record in :mod:`labseq.model.records` and a row here. The
writer, the reader, the index, the exports and the reference page follow. A table is one compound dataset:
a dataset costs 0.1 ms, however many columns it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import CycleRecord, Plan, PlanReport
from labseq.plain import plain_text

FORMAT: Final = "labseq-shot"
FORMAT_VERSION: Final = "4.1"
"""major.minor; a newer minor version only adds things, another major version cannot be read."""

RUN_FORMAT: Final = "labseq-run"
RUN_FORMAT_VERSION: Final = "4.0"

LIBRARY_VERSIONS: Final = ("earliest", "v110")
"""HDF5 features that files may use; these are read by the most programs."""

_UNITS: Final = {
    **{unit: unit for unit in ("s", "m", "K", "Hz", "rad", "V", "W", "A", "px")},
    **{unit.lower(): unit for unit in ("K", "Hz", "V", "W", "A")},
}
"""Suffix of a name (after the last "_") -> unit."""


_getter: Final = cache(attrgetter)


def unit_of(name: str) -> str:
    """Unit of a value, from the suffix of its name; "" if that is no unit.

    Example:
        >>> unit_of("laser.power_w"), unit_of("spacing_m"), unit_of("seen"), unit_of("beat_hz")
        ('W', 'm', '', 'Hz')
    """
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a record.

    Attributes:
        name: Name of the attribute, dataset or column in the file.
        dtype: numpy's name of its type, "text" (UTF-8), "json", or "integer" (text beyond 64 bits).
        description: What it is.
        source: Attribute of the record that it is read from, dotted, if it is not ``name``; or a
            function of the record.
        in_index: Whether the value is also in a shot's line of the index, and so a column of the exports.
    """

    name: str
    dtype: str
    description: str
    source: str | Callable[[Any], Any] = ""
    in_index: bool = True

    @property
    def units(self) -> str:
        """SI unit, "" for none."""
        return unit_of(self.name)

    @property
    def attribute(self) -> str:
        """Name of the record's attribute; "" where a function of the record gives the value."""
        return (self.source or self.name) if isinstance(self.source, str) else ""

    def value(self, record: Any) -> Any:
        """The value in a record."""
        return self.source(record) if callable(self.source) else _getter(self.attribute)(record)


@dataclass(frozen=True, slots=True)
class Table:
    """A compound dataset: one row per record.

    Attributes:
        path: Where it is, below ``/entry``.
        row: Meaning of a row.
        description: Meaning of the table.
        columns: Its columns.
    """

    path: str
    row: str
    description: str
    columns: tuple[Field, ...]

    def rows(self, records: Iterable[Any]) -> NDArray[Any]:
        """One row for each record; every column is read from an attribute."""
        found = list(map(attrgetter(*(column.attribute for column in self.columns)), records))
        values = zip(*found, strict=True) if found else [()] * len(self.columns)
        arrays = [_column(column, list(of)) for column, of in zip(self.columns, values, strict=True)]
        return self._table(len(found), arrays)

    def rows_of_arrays(self, records: Sequence[Any], length: Callable[[Any], int]) -> NDArray[Any]:
        """Several rows for each record; a column is read as an array, or as a number that is repeated.

        Args:
            length: Number of rows of a record.
        """
        ends = np.cumsum([0, *map(length, records)])
        table = self._table(int(ends[-1]), [np.empty(0, column.dtype) for column in self.columns])
        for record, start, stop in zip(records, ends, ends[1:], strict=False):
            rows = table[start:stop]
            for column in self.columns:
                rows[column.name] = column.value(record)
        return table

    def _table(self, n_rows: int, arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        kinds = [(column.name, array.dtype) for column, array in zip(self.columns, arrays, strict=True)]
        table = np.empty(n_rows, kinds)
        for column, array in zip(self.columns, arrays, strict=True):
            if len(array):
                table[column.name] = array
        return table

    def arguments(self, kind: type, table: NDArray[Any]) -> list[dict[str, Any]]:
        """Convert rows that were read to arguments for the constructor of a record.

        Values that its constructor does not take are left out, as are columns that an older file lacks.
        """
        taken = {field.name for field in fields(kind)}
        columns = {
            column.attribute: _plain_values(table[column.name])
            for column in self.columns
            if column.attribute in taken and column.name in (table.dtype.names or ())
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _column(column: Field, values: list[Any]) -> NDArray[Any]:
    """The values of a column; a text column is as wide as its longest text, in bytes of UTF-8."""
    if column.dtype != "text":
        return np.array(values, column.dtype)
    import h5py  # takes 0.1 s to import

    texts = [plain_text(value).encode() for value in values]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=1) or 1))


def _plain_values(column: NDArray[Any]) -> list[Any]:
    return [value.decode() for value in column] if column.dtype.kind == "S" else column.tolist()


SHOT: Final = (
    Field("shot", "int64", "index of the shot in the run, from 0", "shot_index"),
    Field("attempt", "int64", "index of the attempt at the shot, from 0"),
    Field("status", "text", "complete, interrupted or failed"),
    Field("error", "text", "why it did not complete, or empty"),
    Field("t_start_utc", "text", "wall time of its start, ISO 8601, UTC"),
    Field("t_end_utc", "text", "wall time of its end, ISO 8601, UTC"),
    Field(
        "success",
        "bool",
        "whether the last image step met the target; false (in the index null) where it is not judged",
    ),
    Field("filling_fraction", "float64", "filling of the target on the last image step; nan without one"),
    Field(
        "seen_defect_free_cycle", "int64", "index of the first cycle whose image met the target; -1 if none"
    ),
    Field("n_images", "int64", "number of images"),
    Field("n_cycles", "int64", "number of rearrangement cycles"),
    Field("n_batches", "int64", "batches that were played"),
    Field("n_atom_moves", "int64", "atom moves that were played"),
    Field("n_missing_atoms", "int64", "atoms that the loading fell short of the target"),
    Field("seed", "integer", "seed of the run; text where it does not fit into 64 bits", in_index=False),
)
"""Attributes of ``/entry``, of a :class:`ShotRecord`."""

SHOT_TEXTS: Final = (
    Field("readings", "json", "values read from devices during the shot, SI: name -> value"),
    Field("calibrations", "json", "the calibrations in use: kind -> id"),
)
"""Texts in ``/entry``, of a :class:`ShotRecord`."""

RUN: Final = (
    Field("run_id", "text", "the run's folder below the data root: date/counter_name"),
    Field("simulated", "bool", "whether all hardware was simulated"),
    Field("record_frames", "text", "which frames are kept: all, last or none"),
    Field("target", "text", "name of the target pattern", "target.name"),
    Field("lattice", "text", "lattice of the grid"),
    Field("grid_spacing_m", "float64", "spacing of the sites, in m"),
    Field("sequence_sha256", "text", "SHA-256 of the sequence file"),
    Field("profile_sha256", "text", "SHA-256 of the hardware profile"),
)
"""Attributes of ``/entry/run``, of a :class:`RunRecord`."""

RUN_TEXTS: Final = (
    Field("sequence", "text", "the sequence file", "sequence_text"),
    Field("profile", "text", "the hardware profile", "profile_text"),
    Field("steps", "json", "names of the steps of a shot, in order"),
    Field("resolved", "json", "every setting after defaults and overrides, SI"),
    Field(
        "overrides", "json", "what --set and other options changed: address -> value, SI; unit; as written"
    ),
    Field("units", "json", "SI units of what was set and scanned: address -> unit"),
    Field("plugins", "json", "name, version and origin of each plugin that was used"),
    Field("devices", "json", "what each device reports about itself, SI: role -> values"),
    Field("provenance", "json", "where the run comes from: versions, commits, host, user"),
)
"""Texts in ``/entry/run``, of a :class:`RunRecord`."""

_STEP: Final = Field("step", "i4", "index of the step in the shot, from 0")
_CYCLE: Final = Field("cycle", "i4", "index of the rearrangement cycle in its step, from 0")

IMAGES: Final = Table(
    "detection/images",
    "image",
    "all images, whether their frames were kept or not",
    (
        _STEP,
        Field(
            "cycle",
            "i4",
            "index of the rearrangement cycle that it ended, from 0; -1 for that of an image step",
        ),
        Field("t_start_s", "f8", "start of the exposure, from the start of the shot"),
        Field("exposure_s", "f8", "exposure time"),
        Field(
            "name", "text", "its name, the same in every shot: that of its step, with the cycle that it ended"
        ),
    ),
)
"""Of :class:`ImageRecord`."""

EXPOSURES: Final = Table(
    "camera/<name>/exposures",
    "frame",
    "when and how each frame was taken",
    (
        Field("number", "i4", "place in the camera's series as the camera counted it, from 0"),
        Field("t_clock_s", "f8", "start of the exposure on the session's clock", "t_start_s"),
        Field(
            "t_device_s",
            "f8",
            "the camera's own time stamp, from a zero of its own; nan if it gives none",
            "device_time_s",
        ),
        Field("exposure_s", "f8", "exposure time that the camera reports"),
    ),
)
"""Of :class:`Frame`."""

CYCLES: Final = Table(
    "rearrangement/cycles",
    "cycle",
    "the rearrangement cycles: plan, check, move, image",
    (
        _STEP,
        _CYCLE,
        Field("n_batches", "i4", "batches of the plan", "plan.n_batches"),
        Field("n_batches_played", "i4", "batches that fitted into the window and were played"),
        Field("n_atom_moves", "i4", "atom moves of the plan", "plan.n_atom_moves"),
        Field(
            "n_defects_predicted",
            "i4",
            "empty target sites after the whole plan if no atom is lost",
            "report.n_defects",
        ),
        Field(
            "n_surplus_predicted",
            "i4",
            "atoms after the whole plan on sites that must be empty",
            "report.n_surplus",
        ),
        Field("t_start_s", "f8", "start of the cycle, from the start of the shot"),
        Field("window_s", "f8", "time that the cycle had from its start to the end of the moves"),
        Field(
            "planned_duration_s",
            "f8",
            "from the start of the cycle to the end of the plan's last batch",
            "report.duration_s",
        ),
        Field("moves_s", "f8", "modelled duration of what was played, overheads included"),
        Field("late_s", "f8", "how long after the window the moves ended; 0 if they ended in time"),
    ),
)
"""Of :class:`CycleRecord`."""


def _batch_numbers(cycle: CycleRecord) -> NDArray[np.int_]:
    return np.arange(cycle.plan.n_batches)


def _moves_in_batch(cycle: CycleRecord) -> NDArray[np.int32]:
    return np.diff(cycle.plan.batch_offsets)


def _shapes(cycle: CycleRecord) -> NDArray[np.int32]:
    """Numbers of knots, row tones and column tones of each batch."""
    shapes = cycle.plan.path_shapes
    return shapes if len(shapes) else np.zeros((cycle.plan.n_batches, 3), np.int32)


def _path_places(cycle: CycleRecord) -> NDArray[np.int_]:
    """Batch, axis, knot, tone and last knot of each position of a plan's paths, (n_positions, 5)."""
    found: list[NDArray[Any]] = [np.empty((0, 5), np.int_)]
    off = cycle.plan.path_off
    for batch, (n_knots, *n_tones) in enumerate(_shapes(cycle).tolist()):
        for axis, n in enumerate(n_tones):
            knot, tone = (index.ravel() for index in np.indices((n_knots, n)))
            ends, off = np.tile(off[:n], n_knots), off[n:]
            of = np.full_like(knot, batch), np.full_like(knot, axis)
            found.append(np.stack([*of, knot, tone, ends], axis=1))
    return np.concatenate(found)


def _batch_of_move(cycle: CycleRecord) -> NDArray[np.int_]:
    return np.repeat(_batch_numbers(cycle), _moves_in_batch(cycle))


_LINKED: Final = "whether the tweezers of the batch before stay on for this one"
_PLAYED: Final = "whether it fitted into the window and was played"

BATCHES: Final = Table(
    "rearrangement/batches",
    "batch",
    "the batches of all plans: moves made at the same time",
    (
        _STEP,
        _CYCLE,
        Field("batch", "i4", "index of the batch in its cycle, from 0", _batch_numbers),
        Field("n_atom_moves", "i4", "atom moves in it", _moves_in_batch),
        Field(
            "n_tweezers",
            "i4",
            "mobile tweezers on in it, crossings without an atom included",
            "report.n_tweezers",
        ),
        Field(
            "end_s",
            "f8",
            "when it ends, from the start of the cycle, overheads included",
            "report.batch_end_s",
        ),
        Field("linked", "?", _LINKED, "plan.linked"),
        Field(
            "n_knots",
            "i4",
            "knots of the tones' paths; 0 for a line batch",
            lambda cycle: _shapes(cycle)[:, 0],
        ),
        Field("n_row_tones", "i4", "row tones with a path", lambda cycle: _shapes(cycle)[:, 1]),
        Field("n_column_tones", "i4", "column tones with a path", lambda cycle: _shapes(cycle)[:, 2]),
        Field("played", "?", _PLAYED, lambda cycle: _batch_numbers(cycle) < cycle.n_batches_played),
    ),
)
"""The batches of each :class:`CycleRecord`."""

MOVES: Final = Table(
    "rearrangement/moves",
    "atom move",
    "the atom moves of all plans",
    (
        _STEP,
        _CYCLE,
        Field("batch", "i4", "index of the batch in its cycle, from 0", _batch_of_move),
        Field("from_row", "i2", "row that the atom is taken from", lambda cycle: cycle.plan.moves[:, 0]),
        Field("from_col", "i2", "column that the atom is taken from", lambda cycle: cycle.plan.moves[:, 1]),
        Field(
            "to_row",
            "i2",
            "row that it is brought to; beyond the grid where it is ejected",
            lambda cycle: cycle.plan.moves[:, 2],
        ),
        Field(
            "to_col",
            "i2",
            "column that it is brought to; beyond the grid where it is ejected",
            lambda cycle: cycle.plan.moves[:, 3],
        ),
        Field("linked", "?", _LINKED, lambda cycle: cycle.plan.linked[_batch_of_move(cycle)]),
        Field("played", "?", _PLAYED, lambda cycle: _batch_of_move(cycle) < cycle.n_batches_played),
    ),
)
"""The moves of each :class:`CycleRecord`."""

PATHS: Final = Table(
    "rearrangement/paths",
    "position",
    "the paths of the tones, where rows and columns move at once; left out if no plan has any",
    (
        _STEP,
        _CYCLE,
        Field(
            "batch", "i4", "index of the batch in its cycle, from 0", lambda cycle: _path_places(cycle)[:, 0]
        ),
        Field("axis", "i1", "0 for a row tone, 1 for a column tone", lambda cycle: _path_places(cycle)[:, 1]),
        Field("knot", "i4", "index of the knot, from 0", lambda cycle: _path_places(cycle)[:, 2]),
        Field("tone", "i4", "index of the tone on its axis, from 0", lambda cycle: _path_places(cycle)[:, 3]),
        Field("position", "f8", "row or column of the tone at the knot, in sites", "plan.path_positions"),
        Field("off_knot", "i4", "knot at which the tone goes off", lambda cycle: _path_places(cycle)[:, 4]),
    ),
)
"""The paths of the tones of each :class:`CycleRecord`, by batch, axis, knot and tone."""

TIMING: Final = Table(
    "timing",
    "stage",
    "how long each stage took, against its budget",
    (
        Field("stage", "text", "name of the stage: load, expose, detect, plan, check, prepare, play, ..."),
        _STEP,
        Field("cycle", "i4", "index of the rearrangement cycle, from 0; -1 outside of one"),
        Field("t_start_s", "f8", "start on the session's clock, from the start of the shot"),
        Field("duration_s", "f8", "duration on the session's clock; in a dry run the modelled time"),
        Field("host_s", "f8", "duration on the computer's clock"),
        Field("budget_s", "f8", "what it may take; nan without a budget"),
        Field("over_budget", "?", "whether it took longer than its budget"),
    ),
)
"""Of :class:`StageTiming`."""

STEPS: Final = Table(
    "steps",
    "step",
    "how long each step should have taken, and how long it took",
    (
        _STEP,
        Field("name", "text", "name of the step"),
        Field(
            "timed_by", "text", "what timed it: computer, or hardware: camera, lines, static_tweezers, ..."
        ),
        Field("t_start_s", "f8", "start on the session's clock, from the start of the shot"),
        Field("planned_s", "f8", "planned duration; at most, where the step may end earlier"),
        Field(
            "achieved_s",
            "f8",
            "duration as the hardware reports it, otherwise of the step on the session's clock",
        ),
        Field("host_s", "f8", "duration on the computer's clock with all calls; in a dry run the computing"),
    ),
)
"""Of :class:`StepTiming`."""

TABLES: Final = (IMAGES, EXPOSURES, MOVES, BATCHES, PATHS, CYCLES, STEPS, TIMING)


def cycles_of(tables: Mapping[str, NDArray[Any]], predicted: NDArray[Any]) -> list[CycleRecord]:
    """The cycles from their tables.

    Args:
        tables: "cycles", "batches" and "moves" -> rows, and "paths", which files without paths lack.
        predicted: (n_cycles, n_rows, n_cols), occupancy after each plan.
    """
    batches, moves = tables["batches"], tables["moves"]
    paths = tables.get("paths", np.empty(0, [("position", "f8"), ("knot", "i4"), ("off_knot", "i4")]))
    sites = np.stack([moves[name] for name in ("from_row", "from_col", "to_row", "to_col")], axis=1)
    found: list[CycleRecord] = []
    for row, known, occupancy in zip(
        tables["cycles"], CYCLES.arguments(CycleRecord, tables["cycles"]), predicted, strict=True
    ):
        if not 0 <= row["n_batches_played"] <= row["n_batches"]:
            raise ValueError(f"{row['n_batches_played']} of {row['n_batches']} batches were played")
        own, batches = batches[: row["n_batches"]], batches[row["n_batches"] :]
        own_sites, sites = sites[: row["n_atom_moves"]], sites[row["n_atom_moves"] :]
        offsets = np.concatenate([[0], np.cumsum(own["n_atom_moves"])])
        report = PlanReport(
            predicted=occupancy.astype(np.bool_),
            batch_end_s=own["end_s"].copy(),
            n_tweezers=own["n_tweezers"].copy(),
            n_defects=int(row["n_defects_predicted"]),
            n_surplus=int(row["n_surplus_predicted"]),
        )
        shapes = _shapes_of(own)
        n_positions = int((shapes[:, 0] * shapes[:, 1:].sum(axis=1)).sum())
        own_paths, paths = paths[:n_positions], paths[n_positions:]
        off = own_paths["off_knot"][own_paths["knot"] == 0]
        plan = Plan(own_sites, offsets, own["linked"], shapes, own_paths["position"], off)
        found.append(CycleRecord(plan=plan, report=report, **known))
    return found


def _shapes_of(batches: NDArray[Any]) -> NDArray[np.int32]:
    """Shapes of the paths of batches that were read; files before version 4.1 have none."""
    names = ("n_knots", "n_row_tones", "n_column_tones")
    if names[0] not in (batches.dtype.names or ()):
        return np.zeros((len(batches), 3), np.int32)
    return np.stack([batches[name] for name in names], axis=1)


@dataclass(frozen=True, slots=True)
class Dataset:
    """A plain array in a shot's file.

    Attributes:
        path: Where it is, below ``/entry``.
        dtype: numpy's name of its type.
        axes: Its axes.
        description: What it is.
        units: Unit of its numbers; "" for none.
    """

    path: str
    dtype: str
    axes: str
    description: str
    units: str = ""


OF_DETECTOR: Final = "of the detector"
"""Units that the detector gives: counts, log-odds."""

ARRAYS: Final[Mapping[str, Dataset]] = {
    array.path: array
    for array in (
        Dataset("target/fill", "uint8", "row, col", "1 where the target must hold an atom"),
        Dataset("target/clear", "uint8", "row, col", "1 where the target must be empty"),
        Dataset(
            "camera/<name>/frames", "uint16", "frame, y, x", "frames as the camera delivered them", "adu"
        ),
        Dataset(
            "camera/<name>/t_s", "float64", "frame", "start of the exposure, from the start of the shot", "s"
        ),
        Dataset("camera/<name>/image", "int32", "frame", "row of detection/images that the frame belongs to"),
        Dataset("detection/occupancy", "uint8", "image, row, col", "1 where the detector saw an atom"),
        Dataset(
            "detection/confidence", "float32", "image, row, col", "the detector's confidence in each site"
        ),
        Dataset(
            "detection/signal",
            "float64",
            "image, row, col",
            "what the detector compared with the threshold; there is an atom where it is larger",
            OF_DETECTOR,
        ),
        Dataset("detection/threshold", "float64", "row, col", "threshold of the signal", OF_DETECTOR),
        Dataset(
            "detection/sites_px", "float64", "row, col, yx", "place of each site on the frames: y, x", "px"
        ),
        Dataset(
            "detection/t_s", "float64", "image", "start of the exposure, from the start of the shot", "s"
        ),
        Dataset(
            "rearrangement/predicted",
            "uint8",
            "cycle, row, col",
            "1 where the whole plan leaves an atom if none is lost",
        ),
    )
}
"""Path below ``/entry`` -> the array."""

PARAMETER: Final = Dataset(
    "parameters/<address>",
    "number, array, text or JSON text",
    "",
    "set for the run or scanned, SI",
    "of the setting",
)
"""A dataset for each setting that differs from the files in the shot."""

ATOM_EVENTS: Final = Table(
    "atom_events/<name>", "row", "what a simulation reports about the atoms; see its plugin", ()
)
"""A simulation names the columns of its tables itself."""

UNDESCRIBED: Final = "as the simulation's plugin describes it"


def describe_columns(table: np.dtype[Any], known: Table) -> tuple[list[str], list[str]]:
    """Units and descriptions of the columns of a table.

    Args:
        table: Its dtype; a simulation describes columns by ``metadata={"descriptions": {column: text}}``.
        known: The columns in the schema.

    Example:
        >>> jumps = np.dtype([("t_s", "f8")], metadata={"descriptions": {"t_s": "when"}})
        >>> describe_columns(jumps, ATOM_EVENTS)
        (['s'], ['when'])
    """
    texts = {column.name: column.description for column in known.columns}
    if not texts:
        texts = (table.metadata or {}).get("descriptions") or {}
    names = table.names or ()
    return [unit_of(name) for name in names], [str(texts.get(name, UNDESCRIBED)) for name in names]


def datasets() -> list[Dataset]:
    """Every dataset of a shot's file, in the order of the reference."""
    texts = [Dataset(text.name, _kind(text), "", text.description) for text in SHOT_TEXTS]
    texts += [Dataset(f"run/{text.name}", _kind(text), "", text.description) for text in RUN_TEXTS]
    tables = [Dataset(table.path, "table", table.row, table.description) for table in (*TABLES, ATOM_EVENTS)]
    return sorted((PARAMETER, *ARRAYS.values(), *tables, *texts), key=lambda dataset: dataset.path)


def _kind(field: Field) -> str:
    return {"json": "JSON text", "integer": "int64 or text"}.get(field.dtype, field.dtype)


_VIEWER: Final = ("text", "for viewers: class, signal, axes or default plot after NeXus")


def attributes() -> dict[str, dict[str, tuple[str, str]]]:
    """Every attribute of a shot's file but those of every dataset: path -> name -> type, description."""
    nexus = {
        "/entry": ("NX_class", "default"),
        "/entry/camera/<name>": ("NX_class",),
        "/entry/camera/<name>/frames": ("interpretation", "long_name"),
        "/entry/images_view": ("NX_class", "signal", "axes"),
        "/entry/detection": ("NX_class", "signal", "auxiliary_signals", "axes"),
        "/entry/detection/occupancy": ("interpretation",),
        "/entry/detection/confidence": ("interpretation",),
        "/entry/detection/signal": ("interpretation",),
    }
    root = {
        "format": ("text", FORMAT),
        "format_version": ("text", "major.minor; a newer minor version only adds things"),
        "creator": ("text", "labseq and its version"),
    }
    found = {"/": root | dict.fromkeys(("NX_class", "default"), _VIEWER)}
    found |= {path: dict.fromkeys(names, _VIEWER) for path, names in nexus.items()}
    for path, own in (("/entry", SHOT), ("/entry/run", RUN)):
        found[path] = found.get(path, {}) | {field.name: (_kind(field), field.description) for field in own}
    found[f"/entry/{PARAMETER.path}"] = {"address": ("text", "address of the setting")}
    found["/entry/camera/<name>"]["name"] = ("text", "name of the camera")
    return found


EVERYWHERE: Final[Mapping[str, str]] = {
    "units": "unit of the numbers, SI, px, adu or the detector's, empty for none; of a table that of each "
    "column",
    "dimensions": "arrays only: names of the axes",
    "description": "what the dataset is",
    "descriptions": "tables only: what each column is",
    "content_type": "texts only: application/json or text/plain",
}
"""Attributes of every dataset."""
