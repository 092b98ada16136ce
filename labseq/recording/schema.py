"""The schema of the shot file and of a run's index: every value with its type, unit and description.

The tree of a shot file, with n images, a grid of (row, col) sites and frames of (y, x) pixels::

    /entry                      the shot, as attributes (SHOT); JSON texts (SHOT_TEXTS)
      parameters/<address>      what was set for the run or scanned
      run                       what all shots of the run share: attributes (RUN) and texts (RUN_TEXTS)
      target                    fill, clear (row, col)
      camera/<name>             images (n, y, x), t_s (n,) and the table of frames
      images_view               NXdata: what viewers open by default
      detection                 occupancy (n, row, col), confidence, signal, t_s and the table of images;
                                threshold (row, col), sites_px (row, col, yx)
      rearrangement             tables of moves, batches and cycles, and of paths if tones have paths;
                                predicted (cycle, row, col)
      steps                     table of the steps: planned and achieved durations
      edges                     table of the changes of the lines, if there are any
      timing                    table of the stages
      atom_events               tables of the events of the atoms in a simulation

To record a new value, add an attribute to the record in :mod:`labseq.model.records` and a row here. The
writer, the reader, the index, the exports and the reference page follow. A table is one compound dataset
because a dataset costs 0.1 ms, however many columns it has.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.model import CycleRecord, Plan, PlanReport
from labseq.plain import plain_text

FORMAT: Final = "labseq-shot"
FORMAT_VERSION: Final = "4.2"
"""major.minor. A newer minor version only adds values. Files of another major version cannot be read."""

RUN_FORMAT: Final = "labseq-run"
RUN_FORMAT_VERSION: Final = "4.0"

LIBRARY_VERSIONS: Final = ("earliest", "v110")
"""Range of HDF5 versions whose features files may use, which most programs can read."""

_UNITS: Final = {
    **{unit: unit for unit in ("s", "m", "K", "Hz", "rad", "V", "W", "A", "px")},
    **{unit.lower(): unit for unit in ("K", "Hz", "V", "W", "A")},
}
"""Suffix of a name (after the last "_") -> unit."""


_getter: Final = cache(attrgetter)


def unit_of(name: str) -> str:
    """Unit of a value, from the suffix of its name. "" if the suffix is not a unit.

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
        description: What the value is.
        attribute: Attribute of the record from which it is read, dotted.
    """

    name: str
    dtype: str
    description: str
    attribute: str

    @property
    def units(self) -> str:
        """SI unit, "" for none."""
        return unit_of(self.name)

    def value(self, record: Any) -> Any:
        """The value in a record."""
        return _getter(self.attribute)(record)


def _fields(text: str, **attributes: str) -> tuple[Field, ...]:
    """Make fields from lines of name, type and description. An indented line continues the previous one.

    Args:
        **attributes: Name -> attribute of the record, if it has another name.
    """
    lines = re.sub(r"\n +", " ", textwrap.dedent(text).strip()).splitlines()
    rows = (line.split(None, 2) for line in lines)
    return tuple(
        Field(name, dtype, description, attributes.get(name, name)) for name, dtype, description in rows
    )


@dataclass(frozen=True, slots=True)
class Table:
    """A compound dataset: one row per record.

    Attributes:
        path: Its path below ``/entry``.
        row: What one row describes.
        description: What the table is.
        columns: Its columns.
        arrays: For several rows per record: record -> column -> array, or one number for all rows.
    """

    path: str
    row: str
    description: str
    columns: tuple[Field, ...]
    arrays: Callable[[Any], Mapping[str, Any]] | None = None

    def rows(self, records: Iterable[Any]) -> NDArray[Any]:
        """The rows of all records."""
        if self.arrays is not None:
            dtype = [(column.name, column.dtype) for column in self.columns]
            parts = [_together(dtype, self.arrays(record)) for record in records]
            return np.concatenate([np.empty(0, dtype), *parts])
        rows = list(map(attrgetter(*(column.attribute for column in self.columns)), records))
        columns = zip(*rows, strict=True) if rows else [()] * len(self.columns)
        arrays = {
            column.name: _column(column, list(values))
            for column, values in zip(self.columns, columns, strict=True)
        }
        return _together([(name, array.dtype) for name, array in arrays.items()], arrays)

    def arguments(self, kind: type, table: NDArray[Any]) -> list[dict[str, Any]]:
        """Convert rows that were read to arguments for the constructor of a record.

        Values that its constructor does not take are left out, and so are columns that an older file lacks.
        """
        parameters = {field.name for field in fields(kind)}
        columns = {
            column.attribute: _plain_values(table[column.name])
            for column in self.columns
            if column.attribute in parameters and column.name in (table.dtype.names or ())
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _together(dtype: list[tuple[str, Any]], columns: Mapping[str, Any]) -> NDArray[Any]:
    """Columns as one table. Single numbers are repeated."""
    table = np.empty(np.broadcast_shapes(*map(np.shape, columns.values())), dtype)
    for name, values in columns.items():
        table[name] = values
    return table


def _column(column: Field, values: list[Any]) -> NDArray[Any]:
    """The values of a column. A text column is as wide as its longest text, in bytes of UTF-8."""
    if column.dtype != "text":
        return np.array(values, column.dtype)
    import h5py  # takes 0.1 s to import

    texts = [plain_text(value).encode() for value in values]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=1) or 1))


def _plain_values(column: NDArray[Any]) -> list[Any]:
    return [value.decode() for value in column] if column.dtype.kind == "S" else column.tolist()


IN_INDEX: Final = _fields(
    """
    shot                    int64    index of the shot in the run, from 0
    attempt                 int64    index of the attempt at the shot, from 0
    status                  text     complete, interrupted or failed
    error                   text     why it did not complete, or empty
    t_start_utc             text     wall time of its start, ISO 8601, UTC
    t_end_utc               text     wall time of its end, ISO 8601, UTC
    success                 bool     whether the last image step met the target,
                                     false (in the index null) where it is not judged
    filling_fraction        float64  filling of the target on the last image step, nan without one
    seen_defect_free_cycle  int64    index of the first cycle whose image met the target, -1 if none
    n_images                int64    number of images
    n_cycles                int64    number of rearrangement cycles
    n_batches               int64    batches that were played
    n_atom_moves            int64    atom moves that were played
    n_missing_atoms         int64    number of atoms by which the loading fell short of the target
    """,
    shot="shot_index",
)
"""Attributes of ``/entry``, from a :class:`ShotRecord`, which are also in a shot's line of the index."""

SHOT: Final = (
    *IN_INDEX,
    *_fields("seed integer seed of the run, as text if it does not fit into 64 bits"),
)
"""All attributes of ``/entry``."""

SHOT_TEXTS: Final = _fields(
    """
    readings      json  values read from devices during the shot, SI: name -> value
    calibrations  json  the calibrations in use: kind -> id
    """
)
"""Texts in ``/entry``, from a :class:`ShotRecord`."""

RUN: Final = _fields(
    """
    run_id           text     the run's folder below the data root: date/counter_name
    simulated        bool     whether all hardware was simulated
    record_frames    text     which frames are kept: all, last or none
    target           text     name of the target pattern
    lattice          text     lattice of the grid
    grid_spacing_m   float64  spacing of the sites, in m
    sequence_sha256  text     SHA-256 of the sequence file
    profile_sha256   text     SHA-256 of the hardware profile
    """,
    target="target.name",
)
"""Attributes of ``/entry/run``, from a :class:`RunRecord`."""

RUN_TEXTS: Final = _fields(
    """
    sequence    text  the sequence file
    profile     text  the hardware profile
    steps       json  names of the steps of a shot, in order
    resolved    json  every setting after defaults and overrides, SI
    overrides   json  changes by --set and other options: address -> value in SI, unit, value as typed
    units       json  SI units of settings and scanned values: address -> unit
    plugins     json  each plugin that was used: name, version, origin, digest and commit of its sources
    devices     json  what each device reports about itself, SI: role -> values
    provenance  json  origin of the run: versions, commits, host, user
    """,
    sequence="sequence_text",
    profile="profile_text",
)
"""Texts in ``/entry/run``, from a :class:`RunRecord`."""

IMAGES: Final = Table(
    "detection/images",
    "image",
    "all images, whether their frames were kept or not",
    _fields(
        """
        step        i4    index of the step in the shot, from 0
        cycle       i4    index of the rearrangement cycle that it ended, from 0, -1 for an image step
        t_start_s   f8    start of the exposure, from the start of the shot
        exposure_s  f8    exposure time
        name        text  its name, the same in every shot: its step's name, with the cycle that it ended
        """
    ),
)
"""The table of an :class:`ImageRecord` for each image."""

EXPOSURES: Final = Table(
    "camera/<name>/exposures",
    "frame",
    "when and how each frame was taken",
    _fields(
        """
        number      i4  index in the camera's series as counted by the camera, from 0
        t_clock_s   f8  start of the exposure on the session's clock
        t_device_s  f8  the camera's own time stamp, with its own zero, nan if it gives none
        exposure_s  f8  exposure time that the camera reports
        """,
        t_clock_s="t_start_s",
        t_device_s="device_time_s",
    ),
)
"""The table of a :class:`Frame` for each exposure, without its pixels."""

CYCLES: Final = Table(
    "rearrangement/cycles",
    "cycle",
    "the rearrangement cycles: plan, check, move, image",
    _fields(
        """
        step                 i4  index of the step in the shot, from 0
        cycle                i4  index of the rearrangement cycle in its step, from 0
        n_batches            i4  number of batches of the plan
        n_batches_played     i4  number of batches that fitted into the window and were played
        n_atom_moves         i4  number of atom moves of the plan
        n_defects_predicted  i4  empty target sites after the whole plan if no atom is lost
        n_surplus_predicted  i4  atoms after the whole plan on sites that must be empty
        t_start_s            f8  start of the cycle, from the start of the shot
        window_s             f8  time for the cycle from its start to the end of the moves
        planned_duration_s   f8  from the start of the cycle to the end of the plan's last batch
        moves_s              f8  modelled duration of what was played, including overheads
        late_s               f8  time by which the moves ended after the window, 0 if they ended in time
        """,
        n_batches="plan.n_batches",
        n_atom_moves="plan.n_atom_moves",
        n_defects_predicted="report.n_defects",
        n_surplus_predicted="report.n_surplus",
        planned_duration_s="report.duration_s",
    ),
)
"""The table of a :class:`CycleRecord` for each cycle."""


def _shapes(plan: Plan) -> NDArray[np.int32]:
    """Numbers of knots, row tones and column tones of each batch."""
    return plan.path_shapes if len(plan.path_shapes) else np.zeros((plan.n_batches, 3), np.int32)


def _batches(cycle: CycleRecord) -> dict[str, Any]:
    plan, batch = cycle.plan, np.arange(cycle.plan.n_batches)
    return {
        "step": cycle.step,
        "cycle": cycle.cycle,
        "batch": batch,
        "n_atom_moves": np.diff(plan.batch_offsets),
        "n_tweezers": cycle.report.n_tweezers,
        "end_s": cycle.report.batch_end_s,
        "linked": plan.linked,
        **dict(zip(_SHAPE, _shapes(plan).T, strict=True)),
        "played": batch < cycle.n_batches_played,
    }


def _moves(cycle: CycleRecord) -> dict[str, Any]:
    plan = cycle.plan
    batch = np.repeat(np.arange(plan.n_batches), np.diff(plan.batch_offsets))
    return {
        "step": cycle.step,
        "cycle": cycle.cycle,
        "batch": batch,
        **dict(zip(_SITES, plan.moves.T, strict=True)),
        "linked": plan.linked[batch],
        "played": batch < cycle.n_batches_played,
    }


def _paths(cycle: CycleRecord) -> dict[str, Any]:
    """The positions of a plan's paths, by batch, axis, knot and tone."""
    places: list[NDArray[Any]] = [np.empty((0, 5), np.int_)]
    off = cycle.plan.path_off
    for batch, (n_knots, *n_tones) in enumerate(_shapes(cycle.plan).tolist()):
        for axis, n in enumerate(n_tones):
            knot, tone = (index.ravel() for index in np.indices((n_knots, n)))
            ends, off = np.tile(off[:n], n_knots), off[n:]
            of = np.full_like(knot, batch), np.full_like(knot, axis)
            places.append(np.stack([*of, knot, tone, ends], axis=1))
    names = ("batch", "axis", "knot", "tone", "off_knot")
    return {
        "step": cycle.step,
        "cycle": cycle.cycle,
        "position": cycle.plan.path_positions,
        **dict(zip(names, np.concatenate(places).T, strict=True)),
    }


_SHAPE: Final = ("n_knots", "n_row_tones", "n_column_tones")
_SITES: Final = ("from_row", "from_col", "to_row", "to_col")

BATCHES: Final = Table(
    "rearrangement/batches",
    "batch",
    "the batches of all plans: moves made at the same time",
    _fields(
        """
        step            i4  index of the step in the shot, from 0
        cycle           i4  index of the rearrangement cycle in its step, from 0
        batch           i4  index of the batch in its cycle, from 0
        n_atom_moves    i4  number of atom moves in it
        n_tweezers      i4  number of mobile tweezers on in it, including crossings without an atom
        end_s           f8  its end, from the start of the cycle, including overheads
        linked          ?   whether the tweezers of the previous batch stay on for this one
        n_knots         i4  number of knots of the tones' paths, 0 for a line batch
        n_row_tones     i4  number of row tones with a path
        n_column_tones  i4  number of column tones with a path
        played          ?   whether it fitted into the window and was played
        """
    ),
    _batches,
)
"""The batches of each :class:`CycleRecord`."""

MOVES: Final = Table(
    "rearrangement/moves",
    "atom move",
    "the atom moves of all plans",
    _fields(
        """
        step      i4  index of the step in the shot, from 0
        cycle     i4  index of the rearrangement cycle in its step, from 0
        batch     i4  index of the batch in its cycle, from 0
        from_row  i2  row from which the atom is taken
        from_col  i2  column from which the atom is taken
        to_row    i2  row to which it is brought, beyond the grid if it is ejected
        to_col    i2  column to which it is brought, beyond the grid if it is ejected
        linked    ?   whether the tweezers of the previous batch stay on for this one
        played    ?   whether it fitted into the window and was played
        """
    ),
    _moves,
)
"""The moves of each :class:`CycleRecord`."""

PATHS: Final = Table(
    "rearrangement/paths",
    "position",
    "the paths of tones, if rows and columns move at once, left out if no plan has paths",
    _fields(
        """
        step      i4  index of the step in the shot, from 0
        cycle     i4  index of the rearrangement cycle in its step, from 0
        batch     i4  index of the batch in its cycle, from 0
        axis      i1  0 for a row tone, 1 for a column tone
        knot      i4  index of the knot, from 0
        tone      i4  index of the tone on its axis, from 0
        position  f8  row or column of the tone at the knot, in sites
        off_knot  i4  knot at which the tone goes off
        """
    ),
    _paths,
)
"""The paths of the tones of each :class:`CycleRecord`, by batch, axis, knot and tone."""

TIMING: Final = Table(
    "timing",
    "stage",
    "how long each stage took, against its budget",
    _fields(
        """
        stage        text  name of the stage: load, expose, detect, plan, check, prepare, play, ...
        step         i4    index of the step in the shot, from 0
        cycle        i4    index of the rearrangement cycle, from 0, -1 outside a cycle
        t_start_s    f8    start on the session's clock, from the start of the shot
        duration_s   f8    duration on the session's clock, which in a dry run is the modelled time
        host_s       f8    duration on the computer's clock
        budget_s     f8    time that it may take, nan without a budget
        over_budget  ?     whether it took longer than its budget
        """
    ),
)
"""The table of a :class:`StageTiming` for each stage."""

STEPS: Final = Table(
    "steps",
    "step",
    "how long each step should have taken, and how long it took",
    _fields(
        """
        step        i4    index of the step in the shot, from 0
        name        text  name of the step
        timed_by    text  what timed it: computer, or a piece of hardware: camera, lines, static_tweezers, ...
        t_start_s   f8    start on the session's clock, from the start of the shot
        planned_s   f8    planned duration, or its maximum if the step may end earlier
        achieved_s  f8    duration reported by the hardware, or else of the step on the session's clock
        host_s      f8    duration on the computer's clock with all calls, in a dry run the computing time
        """
    ),
)
"""The table of a :class:`StepTiming` for each step."""

EDGES: Final = Table(
    "edges",
    "edge",
    "the changes of the lines, as the timing box played them, left out if there are none",
    _fields(
        """
        step       i4    index of the step in the shot, from 0
        line       text  name of the line
        on         ?     whether it is on from then on
        t_s        f8    time from the start of its step's program, a multiple of the box's resolution
        t_start_s  f8    start of this program on the session's clock, from the start of the shot
        """
    ),
)
"""The table of a :class:`LineEdge` for each edge."""

TABLES: Final = (IMAGES, EXPOSURES, MOVES, BATCHES, PATHS, CYCLES, STEPS, EDGES, TIMING)


def cycles_of(tables: Mapping[str, NDArray[Any]], predicted: NDArray[Any]) -> list[CycleRecord]:
    """Build the cycles from their tables.

    Args:
        tables: "cycles", "batches" and "moves" -> rows, and "paths", which files without paths lack.
        predicted: (n_cycles, n_rows, n_cols), occupancy after each plan.
    """
    batches, moves = tables["batches"], tables["moves"]
    paths = tables.get("paths", np.empty(0, [("position", "f8"), ("knot", "i4"), ("off_knot", "i4")]))
    sites = np.stack([moves[name] for name in _SITES], axis=1)
    cycles: list[CycleRecord] = []
    for row, values, occupancy in zip(
        tables["cycles"], CYCLES.arguments(CycleRecord, tables["cycles"]), predicted, strict=True
    ):
        if not 0 <= row["n_batches_played"] <= row["n_batches"]:
            raise ValueError(f"{row['n_batches_played']} of {row['n_batches']} batches were played")
        # the tables hold the rows of all cycles in order, and each cycle takes its own from the front
        own_batches, batches = batches[: row["n_batches"]], batches[row["n_batches"] :]
        own_sites, sites = sites[: row["n_atom_moves"]], sites[row["n_atom_moves"] :]
        offsets = np.concatenate([[0], np.cumsum(own_batches["n_atom_moves"])])
        report = PlanReport(
            predicted=occupancy.astype(np.bool_),
            batch_end_s=own_batches["end_s"].copy(),
            n_tweezers=own_batches["n_tweezers"].copy(),
            n_defects=int(row["n_defects_predicted"]),
            n_surplus=int(row["n_surplus_predicted"]),
        )
        shapes = _shapes_of(own_batches)
        n_positions = int((shapes[:, 0] * shapes[:, 1:].sum(axis=1)).sum())
        own_paths, paths = paths[:n_positions], paths[n_positions:]
        off = own_paths["off_knot"][own_paths["knot"] == 0]
        plan = Plan(own_sites, offsets, own_batches["linked"], shapes, own_paths["position"], off)
        cycles.append(CycleRecord(plan=plan, report=report, **values))
    return cycles


def _shapes_of(batches: NDArray[Any]) -> NDArray[np.int32]:
    """Shapes of the paths of batches that were read. Files before version 4.1 have none."""
    if _SHAPE[0] not in (batches.dtype.names or ()):
        return np.zeros((len(batches), 3), np.int32)
    return np.stack([batches[name] for name in _SHAPE], axis=1)


@dataclass(frozen=True, slots=True)
class Dataset:
    """A plain array in a shot's file.

    Attributes:
        path: Its path below ``/entry``.
        dtype: numpy's name of its type.
        axes: Names of its axes.
        description: What the dataset is.
        units: Unit of its numbers. "" for none.
    """

    path: str
    dtype: str
    axes: str
    description: str
    units: str = ""


OF_DETECTOR: Final = "of the detector"
"""Units that the detector gives, such as counts or log-odds."""

_ARRAYS: Final = """\
target/fill              uint8    row, col         -    1 where the target must hold an atom
target/clear             uint8    row, col         -    1 where the target must be empty
camera/<name>/frames     uint16   frame, y, x      adu  frames as the camera delivered them
camera/<name>/t_s        float64  frame            s    start of the exposure, from the start of the shot
camera/<name>/image      int32    frame            -    row of detection/images to which the frame belongs
detection/occupancy      uint8    image, row, col  -    1 where the detector saw an atom
detection/confidence     float32  image, row, col  -    the detector's confidence in each site
detection/sites_px       float64  row, col, yx     px   position (y, x) of each site on the frames
detection/t_s            float64  image            s    start of the exposure, from the start of the shot
rearrangement/predicted  uint8    cycle, row, col  -    1 where the whole plan leaves an atom if none is lost
"""

ARRAYS: Final[Mapping[str, Dataset]] = {
    path: Dataset(path, dtype, axes, about, units.replace("-", ""))
    for path, dtype, axes, units, about in (re.split(r"\s{2,}", line) for line in _ARRAYS.splitlines())
} | {
    "detection/signal": Dataset(
        "detection/signal",
        "float64",
        "image, row, col",
        "value that the detector compares with the threshold, above which there is an atom",
        OF_DETECTOR,
    ),
    "detection/threshold": Dataset(
        "detection/threshold", "float64", "row, col", "threshold of the signal", OF_DETECTOR
    ),
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
    "atom_events/<name>", "row", "what a simulation reports about the atoms, see its plugin", ()
)
"""The columns of these tables are named by the simulation."""


def describe_columns(table: np.dtype[Any], schema_table: Table) -> tuple[list[str], list[str]]:
    """Units and descriptions of the columns of a table.

    Args:
        table: Its dtype. A simulation describes columns by ``metadata={"descriptions": {column: text}}``.
        schema_table: The columns in the schema.

    Example:
        >>> jumps = np.dtype([("t_s", "f8")], metadata={"descriptions": {"t_s": "when"}})
        >>> describe_columns(jumps, ATOM_EVENTS)
        (['s'], ['when'])
    """
    texts = {column.name: column.description for column in schema_table.columns}
    if not texts:
        texts = (table.metadata or {}).get("descriptions") or {}
    names = table.names or ()
    default = "as the simulation's plugin describes it"
    return [unit_of(name) for name in names], [str(texts.get(name, default)) for name in names]
