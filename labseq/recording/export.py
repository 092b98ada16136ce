"""A run as CSV, Parquet, netCDF or HDF5, and as xarray.

The tree::

    /                        what is true of the whole run, as attributes
      table                  NXdata: a column for each value of the shots, as in ``Run.to_dataframe``
      run/<file>             the files of the run's folder: run.json, sequence.yaml, calibrations, ...
      shots/shot_000000      what the shot's file has under /entry; attempts that failed, likewise

Settings, devices and target are the same in all shots and stand in the file once: the shots have hard
links to them.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import h5py
import numpy as np
from numpy.typing import NDArray

import labseq
from labseq.errors import ConfigError, Problem, RecordingError, one_of
from labseq.files import whole_file
from labseq.plain import dumps, plain_text
from labseq.recording import folders, schema as layout
from labseq.recording.columns import Column, columns_of
from labseq.recording.folders import RUN_FILE
from labseq.recording.hdf5 import link_name, load_filter, set_attributes
from labseq.recording.reader import Run
from labseq.recording.shot import Shot

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


@dataclass(frozen=True, slots=True, eq=False)
class Axes:
    """The axes that the shots of a run make a grid on.

    Attributes:
        dims: Names of the axes: "shot"; or the scanned addresses and "repeat"; or "point" and
            "repeat" where the scan is no product of its addresses.
        shape: Length of each.
        places: int64 (n_shots,), place of each shot that counts in the flattened grid.
        coords: Name -> the axes that it runs along, and its values.
    """

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    places: NDArray[np.int64]
    coords: Mapping[str, tuple[tuple[str, ...], NDArray[Any]]]

    def spread(self, values: NDArray[Any]) -> NDArray[Any]:
        """Put one value of each shot on the grid; nan, or "" for texts, where there is no shot."""
        n_places = math.prod(self.shape)
        if values.dtype == object:
            flat: NDArray[Any] = np.full(n_places, "", object)
        elif len(values) == n_places:
            flat = np.empty(n_places, values.dtype)
        else:
            flat = np.full(n_places, np.nan)
        flat[self.places] = values
        return flat.reshape(self.shape)


def axes_of(run: Run) -> Axes:
    """The axes of a run's scan, or that of its shots without one.

    Raises:
        RecordingError: What run.json says of the scan is damaged.
    """
    scan: Mapping[str, Any] = run.scan
    indices = np.array([shot.index for shot in run.shots], np.int64)
    if not scan:
        n = len(indices)
        return Axes(("shot",), (n,), np.arange(n), {"shot": (("shot",), indices)})
    try:
        points = [int(scan["point_of_shot"][index]) for index in indices]
        return _of_scan(list(scan["addresses"]), [list(values) for values in scan["points"]], points)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        reason = f"has a damaged scan: {error!r}; take it from a backup"
        raise RecordingError(run.path / RUN_FILE, reason) from error


def _of_scan(addresses: list[str], points: list[list[Any]], point_of_shot: list[int]) -> Axes:
    counts: Counter[int] = Counter()
    repeats: list[int] = []
    for point in point_of_shot:
        repeats.append(counts[point])
        counts[point] += 1
    n_repeats = max(counts.values(), default=0)
    grid = _grid(points, len(addresses))
    if grid is None:
        dims, shape = ("point",), (len(points),)
        place_of_point = np.arange(len(points))
        columns = list(zip(*points, strict=True))
        coords = {name: (dims, _values(column)) for name, column in zip(addresses, columns, strict=True)}
    else:
        values, place_of_point = grid
        dims, shape = tuple(addresses), tuple(map(len, values))
        coords = {name: ((name,), _values(axis)) for name, axis in zip(addresses, values, strict=True)}
    places = np.array([place_of_point[point] for point in point_of_shot], np.int64) * n_repeats
    return Axes((*dims, "repeat"), (*shape, n_repeats), places + np.array(repeats, np.int64), coords)


def _grid(points: list[list[Any]], n_axes: int) -> tuple[list[list[Any]], NDArray[np.int64]] | None:
    """The values of each axis and the place of each point, if the points are the product of the axes."""
    keys = [[dumps(value) for value in point] for point in points]
    axes = [list(dict.fromkeys(point[axis] for point in keys)) for axis in range(n_axes)]
    shape = tuple(map(len, axes))
    if math.prod(shape) != len(points) or len({*map(tuple, keys)}) != len(points):
        return None
    found = {
        key: value
        for point, names in zip(points, keys, strict=True)
        for key, value in zip(names, point, strict=True)
    }
    indices = [[axis.index(key) for axis, key in zip(axes, point, strict=True)] for point in keys]
    places = np.array([np.ravel_multi_index(index, shape) for index in indices], np.int64)
    return [[found[key] for key in axis] for axis in axes], places


def _values(values: Sequence[Any]) -> NDArray[Any]:
    """The values along an axis: numbers, else text."""
    if all(type(value) in (int, float) for value in values):
        return np.array(values)
    return np.array([value if isinstance(value, str) else dumps(value) for value in values], object)


NO_IMAGE: Final = -1
"""What stands in occupancies where a shot has no such image, or no such shot was taken."""


def check_installed(*packages: str) -> None:
    """Refuse to go on without packages of the extra ``analysis``.

    Raises:
        ConfigError: One is missing; tells how to install it.
    """
    for package in packages:
        if find_spec(package) is None:
            what = f"this needs {package}, which is not installed"
            raise ConfigError(Problem(what, hint="pip install 'labseq[analysis]'"))


def dataframe_of(run: Run, *, attempts: bool = False) -> pd.DataFrame:
    """See :meth:`labseq.recording.Run.to_dataframe`."""
    check_installed("pandas")
    import pandas as pd

    shots = sorted((*run.shots, *run.attempts), key=lambda s: (s.index, s.attempt)) if attempts else run.shots
    columns = columns_of(run, shots)
    frame = pd.DataFrame({column.name: column.values for column in columns}).set_index("shot")
    frame.attrs.update(facts_of(run))
    frame.attrs["units"] = {column.name: column.units for column in columns}
    frame.attrs["descriptions"] = {column.name: column.description for column in columns}
    return frame


def facts_of(run: Run) -> dict[str, Any]:
    """What is true of the whole run, as plain values."""
    return {
        "run_id": str(run.record.get("run_id") or run.path.name),
        "name": run.name,
        "status": run.status,
        "error": run.error,
        "seed": str(run.seed),
        "simulated": int(run.simulated),
        "n_shots": run.n_shots,
        "t_start_utc": str(run.record.get("t_start_utc") or ""),
        "creator": str(run.record.get("creator") or ""),
    }


def dataset_of(run: Run, *, occupancies: bool = True) -> xr.Dataset:
    """See :meth:`labseq.recording.Run.to_xarray`."""
    check_installed("xarray")
    import xarray as xr

    axes, columns = axes_of(run), columns_of(run)
    about = {column.name: {"units": column.units, "description": column.description} for column in columns}
    data: dict[str, Any] = {
        column.name: (axes.dims, axes.spread(column.values), about[column.name])
        for column in columns
        if column.name not in axes.coords
    }
    if occupancies:
        meaning = f"1 where the detector saw an atom, 0 where not, {NO_IMAGE} where there is no such image"
        dims = (*axes.dims, "image", "row", "col")
        data["occupancy"] = (dims, _occupancies(run, axes), {"units": "", "description": meaning})
    for name, sites in (("fill", run.target.fill), ("clear", run.target.clear)):
        meaning = f"1 where the target must {'hold an atom' if name == 'fill' else 'be empty'}"
        data[f"target_{name}"] = (
            ("row", "col"),
            sites.astype(np.int8),
            {"units": "", "description": meaning},
        )
    coords = {name: (dims, values, about.get(name, {})) for name, (dims, values) in axes.coords.items()}
    return xr.Dataset(data, coords, facts_of(run))


def _occupancies(run: Run, axes: Axes) -> NDArray[np.int8]:
    from labseq.recording.shot_file import read_occupancies

    found = [read_occupancies(shot.file) for shot in run.shots]
    n_images = max(map(len, found), default=0)
    flat = np.full((math.prod(axes.shape), n_images, *run.target.shape), NO_IMAGE, np.int8)
    for place, occupancies in zip(axes.places, found, strict=True):
        flat[place, : len(occupancies)] = occupancies
    return flat.reshape(*axes.shape, *flat.shape[1:])


ENDINGS: Final = {"csv": ".csv", "parquet": ".parquet", "netcdf": ".nc", "archive": ".h5"}
"""Kind of export -> how its file's name ends."""


def files_of(kind: str, path: Path) -> tuple[Path, ...]:
    """The files that an export writes: the table of units stands beside a CSV file.

    Example:
        >>> [file.name for file in files_of("csv", Path("run.csv"))]
        ['run.csv', 'run.units.csv']
    """
    return (path, path.with_suffix(".units.csv")) if kind == "csv" else (path,)


def check_export(kind: str, path: Path, *, frames: bool = False, replace: bool = False) -> None:
    """Find out whether a run can be exported, before anything is read.

    Args:
        kind: One of :data:`ENDINGS`.
        path: The file.
        frames: Whether frames are asked for; only the archive has them.
        replace: Whether files that are there may be replaced.

    Raises:
        ConfigError: It cannot; tells what would have been right.
    """
    if kind not in ENDINGS:
        raise ConfigError(
            Problem(f"a run cannot be exported as '{kind}'", "--to", expected=one_of([*ENDINGS]))
        )
    if frames and kind != "archive":
        raise ConfigError(Problem(f"a {kind} file holds no frames", "--frames", hint="use --to archive"))
    if path.suffix.lower() != ENDINGS[kind]:
        wanted = f"a file that ends in {ENDINGS[kind]}"
        raise ConfigError(Problem(f"this is no name of a {kind} file", str(path), expected=wanted))
    try:
        has_folder, there = path.parent.is_dir(), [one for one in files_of(kind, path) if one.exists()]
    except OSError as error:  # a name that is too long
        raise ConfigError(Problem(f"this is no name of a file: {error.strerror}", str(path))) from error
    if not has_folder:
        raise ConfigError(Problem("there is no such folder", str(path.parent), expected="one that exists"))
    odd = [one for one in there if not one.is_file()]
    if odd:
        raise ConfigError(Problem("this is not an ordinary file", str(odd[0]), hint="choose another name"))
    if there and not replace:
        hint = "choose another name, or replace it with --force"
        raise ConfigError(Problem("this file is there already", str(there[0]), hint=hint))
    packages = {"parquet": ("pandas", "pyarrow"), "netcdf": ("xarray", "h5netcdf")}
    check_installed(*packages.get(kind, ()))


def export_run(run: Run, kind: str, path: Path, *, frames: bool = False) -> list[str]:
    """Write a run to a file, whole or not at all; :func:`check_export` comes first.

    Args:
        run: The run; of one that goes on, the shots that it had when it was opened.
        kind: One of :data:`ENDINGS`.
        path: The file; an older one is replaced.
        frames: Whether an archive holds the frames.

    Returns:
        What had to be left out of an archive, because files are damaged: one line for each shot.

    Raises:
        ConfigError: The file cannot be written.
        RecordingError: The run is damaged.
    """
    left_out: list[str] = []
    writers: dict[str, Callable[[], None]] = {
        "csv": lambda: _write_csv(run, path),
        "parquet": lambda: _write_parquet(run, path),
        "netcdf": lambda: _write_netcdf(run, path),
        "archive": lambda: left_out.extend(write_archive(run, path, frames=frames)),
    }
    try:
        writers[kind]()
    except (OSError, RuntimeError) as error:  # HDF5 tells of a full disk by either
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ConfigError(Problem(f"it cannot be written: {reason}", str(path))) from error
    return left_out


def _write_csv(run: Run, path: Path) -> None:
    columns = columns_of(run)
    rows = zip(*(map(_cell, column.values.tolist()) for column in columns), strict=True)
    about = [(column.name, column.units, column.description) for column in columns]
    table, units = files_of("csv", path)
    _write_rows(units, [("column", "units", "description"), *about])
    _write_rows(table, [[column.name for column in columns], *rows])


def _write_rows(path: Path, rows: Sequence[Sequence[str]]) -> None:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    with whole_file(path) as file:
        file.write(text.getvalue().encode("utf-8", "backslashreplace"))


def _cell(value: Any) -> str:
    """A value as text that every program reads; nothing for nan."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value != value else str(value)


def _write_parquet(run: Run, path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    table: Any = pa.Table.from_pandas(dataframe_of(run))
    about = {column.name: column for column in columns_of(run)}
    fields = [field.with_metadata(_metadata(about[field.name])) for field in table.schema]
    facts = {b"labseq": json.dumps(facts_of(run)).encode()}
    schema = pa.schema(fields, {**(table.schema.metadata or {}), **facts})
    with whole_file(path) as file:
        parquet.write_table(table.cast(schema), file)


def _metadata(column: Column) -> dict[str, str]:
    return {"units": column.units, "description": column.description}


def _write_netcdf(run: Run, path: Path) -> None:
    dataset = dataset_of(run)
    names = [str(name) for name in (*dataset.variables, *dataset.dims) if "/" in str(name)]
    dataset = dataset.rename({name: name.replace("/", "_") for name in dict.fromkeys(names)})
    packed = {"zlib": True, "shuffle": True} if dataset["occupancy"].size else {}
    with whole_file(path) as file:
        encoding = {"occupancy": {**packed, "_FillValue": None}}
        dataset.to_netcdf(Path(file.name), engine="h5netcdf", format="NETCDF4", encoding=encoding)


FORMAT: Final = "labseq-archive"
FORMAT_VERSION: Final = "2.0"

_COMMON: Final = ("target", "run")
_WORTH_PACKING: Final = 1024
"""Bytes from which compressing an array makes it smaller."""
_PACKED: Final = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def write_archive(run: Run, path: Path, *, frames: bool) -> list[str]:
    """Write the archive of a run, whole or not at all.

    Args:
        run: The run.
        path: The file; an older one is replaced.
        frames: Whether it holds the frames.

    Returns:
        Why shots were left out: files that are missing or damaged. Empty if all are in it.

    Raises:
        OSError: It cannot be written.
        RuntimeError: Likewise, as HDF5 tells it.
    """
    left_out: list[str] = []
    with whole_file(path) as part, h5py.File(Path(part.name), "w", libver=layout.LIBRARY_VERSIONS) as file:
        formats = {"format": FORMAT, "format_version": FORMAT_VERSION}
        set_attributes(file, {**facts_of(run), **formats, "NX_class": "NXroot", "default": "table"})
        file.attrs["archived_by"] = f"labseq {labseq.__version__}"
        _write_table(file.create_group("table"), run)
        _write_files(file.create_group("run"), run.path)
        shots = _Shots(file.create_group("shots"), frames=frames)
        for shot in (*run.shots, *run.attempts):
            try:
                shot.verify()
                shots.add(shot)
            except RecordingError as error:
                left_out.append(str(error))
    return left_out


def _write_table(group: h5py.Group, run: Run) -> None:
    set_attributes(group, {"NX_class": "NXdata", "signal": "filling_fraction"})
    group.attrs["axes"] = ["shot"]
    names: list[str] = []
    for column in columns_of(run):
        names.append(link_name(column.name, names))
        values, dtype = column.values, column.values.dtype
        if dtype.kind == "O":
            values, dtype = list(map(plain_text, values)), h5py.string_dtype()
        dataset = group.create_dataset(names[-1], data=values, dtype=dtype)
        set_attributes(dataset, {"units": column.units, "description": column.description})


def _write_files(group: h5py.Group, run_dir: Path) -> None:
    """The files of the run's folder as they are: texts as text, others as bytes."""
    results = group.create_group(folders.RESULTS_FOLDER)
    for goal, folder in ((group, run_dir), (results, run_dir / folders.RESULTS_FOLDER)):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.is_file() and path.suffix != ".part" and not path.name.startswith("."):
                _write_file(goal, plain_text(path.name), path.read_bytes())


def _write_file(group: h5py.Group, name: str, data: bytes) -> None:
    if _is_text(data):
        dataset = group.create_dataset(name, data=data.decode(), dtype=h5py.string_dtype())
    else:
        dataset = group.create_dataset(name, data=np.frombuffer(data, np.uint8))
    set_attributes(dataset, {"units": "", "description": "this file of the run's folder"})


def _is_text(data: bytes) -> bool:
    try:
        return "\0" not in data.decode()
    except ValueError:
        return False


class _Shots:
    """Copies shots into a group."""

    def __init__(self, group: h5py.Group, *, frames: bool) -> None:
        self._group = group
        self._frames = frames
        self._common: dict[str, tuple[Any, Any]] = {}  # name -> content, group

    def add(self, shot: Shot) -> None:
        """Copy a shot whose file is whole.

        Raises:
            RecordingError: Its frames are compressed and the package for it is missing.
        """
        with h5py.File(shot.file, "r", locking=False) as source:
            entry: Any = source["entry"]
            if self._frames:
                for camera in entry["camera"].values() if "camera" in entry else ():
                    load_filter(shot.file, camera["images"])
            made = self._group.create_group(shot.file.stem)
            _copy_attributes(entry, made)
            for name in entry:
                if name in _COMMON:
                    self._link(entry[name], made, name)
                elif self._frames or name != "images_view":
                    _copy(entry, made, name, () if self._frames else ("images",) if name == "camera" else ())
            if "images_view" not in made:
                made.attrs["default"] = "detection"

    def _link(self, source: Any, made: Any, name: str) -> None:
        """What a shot before had, too, is linked to."""
        content = _content(source)
        if self._common.get(name, (None,))[0] != content:
            source.file.copy(source, made, name)
            self._common[name] = content, made[name]
        else:
            made[name] = self._common[name][1]


def _copy(source: Any, made: Any, name: str, left_out: Sequence[str]) -> None:
    """Copy what a group has under a name, without the datasets that are left out."""
    link = source.get(name, getlink=True)
    if isinstance(link, h5py.SoftLink):
        made[name] = h5py.SoftLink(link.path.replace("/entry", _shot_of(made), 1))
        return
    node = source[name]
    if isinstance(node, h5py.Group):
        group = made.create_group(name)
        _copy_attributes(node, group)
        for inner in node.keys():  # noqa: SIM118 - names of the group's own, all text
            _copy(node, group, inner, left_out)
    elif name in left_out:
        return
    elif node.dtype.kind != "O" and (node.nbytes >= _WORTH_PACKING or _is_packed(node)):
        chunks = (1, *node.shape[1:]) if name == "images" and node.ndim == 3 else True
        _copy_attributes(node, made.create_dataset(name, data=node[()], chunks=chunks, **_PACKED))
    else:
        source.file.copy(node, made, name)


def _is_packed(dataset: Any) -> bool:
    return dataset.id.get_create_plist().get_nfilters() > 0


def _shot_of(node: Any) -> str:
    """Path of the group of the shot that a node belongs to."""
    return "/".join(node.name.split("/")[:3])


def _copy_attributes(source: Any, made: Any) -> None:
    for name, value in source.attrs.items():
        made.attrs[name] = value


def _content(group: Any) -> Any:
    """Everything in a group without groups, to be compared."""
    datasets = {name: dataset[()] for name, dataset in group.items()}
    plain = {
        name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in datasets.items()
    }
    return plain, {name: str(value) for name, value in group.attrs.items()}
