"""Exports a run to CSV, Parquet, netCDF or one HDF5 file."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from labseq.data.columns import Column, columns_of
from labseq.data.reader import Run
from labseq.data.tables import check_installed, dataframe_of, dataset_of, facts_of
from labseq.errors import ConfigError, Problem, one_of
from labseq.files import whole_file
from labseq.text_files import check_output, is_file

ENDINGS: Final = {"csv": ".csv", "parquet": ".parquet", "netcdf": ".nc", "archive": ".h5"}
"""Kind of export -> suffix of its file."""


def files_of(kind: str, path: Path) -> tuple[Path, ...]:
    """The files that an export writes. A table of units is written next to a CSV file.

    Example:
        >>> [file.name for file in files_of("csv", Path("run.csv"))]
        ['run.csv', 'run.units.csv']
    """
    return (path, path.with_suffix(".units.csv")) if kind == "csv" else (path,)


def check_export(kind: str, path: Path, *, frames: bool = False, replace: bool = False) -> None:
    """Check that a run can be exported, before anything is read.

    Raises:
        ConfigError: It cannot be exported. The message says what to change.
    """
    if kind not in ENDINGS:
        raise ConfigError(
            Problem(f"a run cannot be exported as '{kind}'", "--to", expected=one_of([*ENDINGS]))
        )
    if frames and kind != "archive":
        raise ConfigError(Problem(f"a {kind} file holds no frames", "--frames", hint="use --to archive"))
    check_output(path, f"a {kind} file", ENDINGS[kind])
    existing = [file for file in files_of(kind, path) if is_file(file)]
    if existing and not replace:
        hint = "choose another name, or replace it with --force"
        raise ConfigError(Problem("this file already exists", str(existing[0]), hint=hint))
    packages = {"parquet": ("pandas", "pyarrow"), "netcdf": ("xarray", "h5netcdf")}
    check_installed(*packages.get(kind, ()))


def export_run(run: Run, kind: str, path: Path, *, frames: bool = False) -> list[str]:
    """Write a run to a file, which appears only when it is complete. Call :func:`check_export` first.

    Returns:
        One line for each shot that the archive lacks because its file is damaged.

    Raises:
        ConfigError: The file cannot be written.
        RecordingError: The run is damaged.
    """
    try:
        if kind == "archive":
            from labseq.data.archive import write_archive  # h5py takes 0.1 s to import

            return write_archive(run, path, frames=frames)
        writers = {"csv": _write_csv, "parquet": _write_parquet, "netcdf": _write_netcdf}
        writers[kind](run, path)
    except (OSError, RuntimeError) as error:  # HDF5 raises either when the disk is full
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ConfigError(Problem(f"it cannot be written: {reason}", str(path))) from error
    return []


def _write_csv(run: Run, path: Path) -> None:
    write_columns(path, columns_of(run))


def write_columns(path: Path, columns: Sequence[Column]) -> None:
    """Write columns to a CSV file, and their units and descriptions to the file next to it."""
    rows = zip(*(map(_cell, column.values.tolist()) for column in columns), strict=True)
    descriptions = [(column.name, column.units, column.description) for column in columns]
    table, units = files_of("csv", path)
    write_rows(units, [("column", "units", "description"), *descriptions])
    write_rows(table, [[column.name for column in columns], *rows])


def write_rows(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV file, which appears only when it is complete."""
    buffer = io.StringIO(newline="")
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    with whole_file(path) as file:
        file.write(buffer.getvalue().encode("utf-8", "backslashreplace"))


def _cell(value: Any) -> str:
    """A value as text that every program can read. Empty for nan."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value != value else str(value)  # only nan differs from itself


def _write_parquet(run: Run, path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    table: Any = pa.Table.from_pandas(dataframe_of(run))
    metadata = {
        column.name: {"units": column.units, "description": column.description} for column in columns_of(run)
    }
    # Parquet keeps metadata for each field, and for the whole table
    fields = [field.with_metadata(metadata[field.name]) for field in table.schema]
    run_metadata = {b"labseq": json.dumps(facts_of(run)).encode()}
    schema = pa.schema(fields, {**(table.schema.metadata or {}), **run_metadata})
    with whole_file(path) as file:
        parquet.write_table(table.cast(schema), file)


def _write_netcdf(run: Run, path: Path) -> None:
    dataset = dataset_of(run)
    # in netCDF a "/" separates groups
    names = [str(name) for name in (*dataset.variables, *dataset.dims) if "/" in str(name)]
    dataset = dataset.rename({name: name.replace("/", "_") for name in dict.fromkeys(names)})
    packing = {"zlib": True, "shuffle": True} if dataset["occupancy"].size else {}
    with whole_file(path) as file:
        encoding = {"occupancy": {**packing, "_FillValue": None}}
        dataset.to_netcdf(Path(file.name), engine="h5netcdf", format="NETCDF4", encoding=encoding)
