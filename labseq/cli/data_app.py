"""The commands on recorded data and their options; each body is imported only when its command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from labseq.cli.shared_options import Json, RunFolder

EXPORT_EXAMPLES: Final = """\b
Examples:
  labseq export --to csv
  labseq export data/2026-11-20/0001_compact-225 --to netcdf -o compact.nc
  labseq export data/2026-11-20/0001_compact-225 --to archive --frames
"""

DOCTOR_EXAMPLES: Final = """\b
Examples:
  labseq doctor --dry-run
  labseq doctor data/2026-11-20/0001_compact-225
"""


def export(
    run: RunFolder = None,
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="csv|parquet|netcdf|archive",
            help="Kind of file: a table of the shots (csv, parquet), a table with occupancies on the axes of "
            "the scan (netcdf), or everything in one HDF5 file (archive).",
        ),
    ] = "csv",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The file; by default one named after the run, here."
        ),
    ] = None,
    frames: Annotated[bool, typer.Option("--frames", help="Keep the frames, too; archive only.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
) -> None:
    """Export a run to one file that other programs read."""
    from labseq.cli.export import export_to

    raise typer.Exit(export_to(run, to, output, frames=frames, replace=force))


def doctor(
    data: Annotated[
        Path | None,
        typer.Argument(
            metavar="DATA",
            help="A data folder or one run; LABSEQ_DATA or ./data by default.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell; change nothing.")] = False,
    as_json: Json = False,
) -> None:
    """Find what crashes and faulty disks did to recorded data, and repair what can be repaired."""
    from labseq.cli.doctor import examine

    raise typer.Exit(examine(data, dry_run=dry_run, as_json=as_json))
