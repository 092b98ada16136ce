"""Reads a recorded run from disk."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.data.shot import CachingLoader, Shot
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import read_lines
from labseq.messages import clean, visible
from labseq.model import TargetPattern
from labseq.model.records import RunStatus
from labseq.plain import to_plain
from labseq.recording import folders
from labseq.recording.index import read_index
from labseq.recording.run_file import (
    WRITTEN_UNITS,
    is_skip_row,
    read_run,
    read_state,
    read_state_file,
    target_of,
)

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from labseq.data.fits import Fit
    from labseq.data.quantities import Quantity
    from labseq.data.scanned import FitAt


def open_run(path: str | Path) -> Run:
    """Open a recorded run, which may be finished, still running or killed.

    Opening reads only the index. A shot's file is read when one of its values is needed.

    Args:
        path: The run's folder or any file in it, or its name or number as ``labseq runs`` prints it, such as
            "2026-11-20/0001_compact-225", "compact-225" or "75". The newest run with that name is opened.

    Raises:
        RecordingError: There is no such run, or it is damaged, or has another format.
    """
    try:
        path = Path(path)
    except TypeError:
        raise RecordingError(
            repr(path), "is not a path", "give a run's folder, name or number, as text"
        ) from None
    folder = folders.find_run(path)
    record = read_run(folder)
    # the state before the index, so that a run which is complete by now has all lines in the index
    status, error = read_state(folder)
    rows, n_damaged = read_index(folder)
    load = CachingLoader()
    # the last line of a shot that was written twice counts
    counted = {row.shot: row for row in rows if row.counts}
    return Run(
        path=folder,
        record=record,
        status=status,
        error=error,
        shots=tuple(Shot(folder, counted[shot], load) for shot in sorted(counted)),
        attempts=tuple(Shot(folder, row, load) for row in rows if not row.counts),
        n_damaged_lines=n_damaged,
        skipped=_skipped(folder, record["n_shots"]),
    )


def _skipped(folder: Path, n_shots: int) -> dict[int, str]:
    reasons = dict[int, str]()
    for line in read_lines(folder / folders.SKIPPED_FILE)[0]:
        if is_skip_row(line, n_shots):
            reasons |= dict.fromkeys(line["shots"], line["why"])
    return reasons


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run:
    """A run on disk, as it was when it was opened.

    Attributes:
        path: The run's folder.
        record: The content of run.json: settings, devices, versions, ...
        status: "running", "complete", "stopped" or "failed". A run whose process died has failed.
        error: The error that ended it, or "".
        shots: The shots that count, in order.
        attempts: Attempts at shots that failed or were interrupted, in the order they were made.
        n_damaged_lines: Lines of the index that cannot be read. 0 unless the file was damaged.
        skipped: Shots that were skipped: index -> reason.
    """

    path: Path
    record: dict[str, Any]
    status: RunStatus
    error: str
    shots: Sequence[Shot]
    attempts: Sequence[Shot]
    n_damaged_lines: int = 0
    skipped: Mapping[int, str] = field(default_factory=dict[int, str])

    def __repr__(self) -> str:
        return f"<Run {self.path}: {len(self.shots)} of {self.n_shots} shots, {self.status}>"

    # methods import what they need, because a run that is being taken is opened, too, and needs none of it

    @property
    def name(self) -> str:
        """Name of the sequence."""
        return str(self.record["name"])

    @property
    def n_shots(self) -> int:
        """Number of shots that the sequence asks for."""
        return int(self.record["n_shots"])

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return int(self.record["seed"])

    @property
    def simulated(self) -> bool:
        """Whether all hardware was simulated."""
        return bool(self.record["simulated"])

    @property
    def target(self) -> TargetPattern:
        """Target of the run."""
        return target_of(self.path / folders.RUN_FILE, self.record)

    @property
    def units(self) -> Mapping[str, str]:
        """SI units of settings and scanned values: address -> unit. Addresses without a unit are left out."""
        return dict(self.record.get("units") or {})

    @property
    def reading_units(self) -> Mapping[str, str]:
        """Units that devices give for their readings: "laser.power" -> "W"."""
        devices: Mapping[str, Any] = self.record.get("devices") or {}
        units = {name: about.get("units") for name, about in devices.items() if isinstance(about, dict)}
        return {
            f"{name}.{value}": str(unit)
            for name, of_device in units.items()
            if isinstance(of_device, dict)
            for value, unit in of_device.items()
        }

    @property
    def changes(self) -> Mapping[str, str]:
        """Settings changed by ``--set`` and other options: address -> value, as it was typed."""
        overrides = dict(self.record.get("overrides") or {})
        return {address: str(change["written"]) for address, change in overrides.items()}

    @property
    def note(self) -> str:
        """The note about the run from the web page or ``labseq note``. Read from its file each time."""
        from labseq.recording.notes import read_notes

        return read_notes(self.path).comment

    @property
    def tags(self) -> tuple[str, ...]:
        """The tags of the run. Read from their file each time."""
        from labseq.recording.notes import read_notes

        return read_notes(self.path).tags

    @property
    def scan(self) -> Mapping[str, Any]:
        """The scan: addresses, points and the point of each shot. Empty without a scan.

        For an adaptive scan, these are the points chosen so far, computed at each call.

        Raises:
            RecordingError: The scan's record in run.json or the index is damaged.
        """
        scan: Mapping[str, Any] = self.record.get("scan") or {}
        if WRITTEN_UNITS not in scan:
            return scan
        from labseq.data.points import completed, reporting_damage

        with reporting_damage(self.path):
            return completed(scan, [shot.row for shot in (*self.shots, *self.attempts)])

    @property
    def ended_early(self) -> str:
        """Why the run ended before its last shot, because ``stop_when`` was met. "" if it did not."""
        return str(read_state_file(self.path).get("ended_early") or "")

    @property
    def defect_free(self) -> float:
        """Fraction of the judged shots that met the target. nan if none was judged."""
        from labseq.model.estimate import mean

        return mean([shot.success for shot in self.shots if not math.isnan(shot.filling_fraction)]).value

    @property
    def filling_fraction(self) -> float:
        """Mean filling of the target over the shots that have one. nan if none has."""
        from labseq.model.estimate import mean

        return mean([f for shot in self.shots if not math.isnan(f := shot.filling_fraction)]).value

    @property
    def events(self) -> tuple[dict[str, Any], ...]:
        """The event log, read from the file each time: dicts with ``t_utc``, ``t_s``, ``event``, ``values``.

        ``t_s`` is the time in seconds since the process began or resumed the run. It does not change if the
        computer's clock is set.

        Raises:
            RecordingError: The file cannot be read.
        """
        return tuple(read_lines(self.path / folders.EVENTS_FILE)[0])

    def analysis(self, name: str) -> list[dict[str, Any]]:
        """The results of an analysis: a row per shot, with its index as "shot" and the results.

        A row with "error" gives the reason why the shot has no result.

        Raises:
            RecordingError: There are no results of that name, or they cannot be read.
        """
        from labseq.recording.results import rows_of

        return rows_of(self.path, name)

    def quantity(self, name: str) -> Quantity:
        """A quantity of the run's shots, by name.

        Args:
            name: "survival:before,after", "filling:before", a numerical column of :meth:`to_dataframe`, or
                "analysis.NAME.KEY".

        Raises:
            ConfigError: The run has no such quantity. The message lists the quantities that it has.

        Example:
            ``run.quantity("survival:before,after").over(run.shots)`` is its mean, with the error.
        """
        from labseq.data.quantities import find_quantity

        return find_quantity(self, name)

    def select(self, *conditions: str) -> Run:
        """The run with only the shots that count and meet all conditions.

        Args:
            conditions: Comparisons of a quantity or a column of :meth:`to_dataframe` with a value, such as
                "filling:before == 1" or "shot.hold.duration > 5 ms".

        Raises:
            ConfigError: A condition cannot be read, or no shot meets all of them.
        """
        from labseq.data.conditions import select_shots

        if not conditions:
            return self
        shots = select_shots(self, conditions)
        if not shots:
            what = f"no shot meets {visible(' and '.join(conditions))}"
            raise ConfigError(Problem(what, clean(self.path.name)))
        scan = self.record.get("scan") or {}
        if scan and WRITTEN_UNITS not in scan:
            from labseq.data.points import reporting_damage, restricted

            with reporting_damage(self.path):
                scan = restricted(scan, {shot.index for shot in shots})
        return replace(self, record={**self.record, "scan": scan}, shots=shots, attempts=())

    def fit(
        self,
        quantity: str,
        model: str,
        *,
        where: Sequence[str] = (),
        fixed: Mapping[str, str | float] | None = None,
        free: Sequence[str] = (),
        along: str | None = None,
    ) -> Fit:
        """Fit a quantity of the shots against the scanned value.

        Args:
            quantity: Its name, see :meth:`quantity`.
            model: Name of the model, as for ``labseq show --fit``.
            where: Conditions on the shots, see :meth:`select`. In a scan of several values they must select
                one value of each other axis. :meth:`fits` fits at all of them.
            fixed: Parameter -> the value at which it is fixed, a number in SI or text with a unit.
            free: Parameters to fit that the model would otherwise fix.
            along: Scanned address to fit along. Default: the first.

        Returns:
            A fit with ``parameters`` (name -> ``value``, ``error`` and ``unit``, SI, error 0 if fixed),
            ``reduced_chi_square``, ``at(x)``, ``residuals``, and the points ``x``, ``y``, ``errors``.

        Raises:
            ConfigError: There is no such quantity or model, or the points do not determine the parameters.

        Example:
            ``run.fit("survival:before,after", "exponential").parameters["decay"].value`` is in seconds.
        """
        fits = self.fits(quantity, model, where=where, fixed=fixed, free=free, along=along)
        if len(fits) > 1:
            others = " and ".join(fits[0].values)
            problem = f"there are {len(fits)} values of {others}, each with its own fit"
            expected = "one value, chosen by 'where', or fits()"
            raise ConfigError(Problem(problem, clean(self.path.name), expected=expected))
        assert fits[0].fit is not None  # otherwise it has raised
        return fits[0].fit

    def fits(
        self,
        quantity: str,
        model: str,
        *,
        where: Sequence[str] = (),
        fixed: Mapping[str, str | float] | None = None,
        free: Sequence[str] = (),
        along: str | None = None,
    ) -> list[FitAt]:
        """Fit a quantity along one axis of a scan, at each combination of values of the other axes.

        Arguments and errors are the same as for :meth:`fit`.

        Returns:
            For each combination its ``values`` by address and the ``fit``. If the fit failed, it is None
            and ``problem`` says why.
        """
        from labseq.data.scanned import FitRequest, Scanned, fits_along, scanned

        run = self.select(*where)
        given = {**(fixed or {}), **dict.fromkeys(free, "free")}
        scan = scanned(run) or Scanned((), (), ())
        found = run.quantity(quantity)
        return fits_along(run, scan, found, scan.over(found), FitRequest(model, given, along))

    def summary(self) -> dict[str, Any]:
        """The main results of the run as JSON-ready values. None for a missing number."""
        return {
            "run_dir": str(self.path),
            "shots": len(self.shots),
            "skipped": len(self.skipped),
            "defect_free": to_plain(self.defect_free),
            "filling_fraction": to_plain(self.filling_fraction),
            "status": self.status,
        }

    def to_dataframe(self, *, attempts: bool = False) -> pd.DataFrame:
        """The shots as a pandas table with one row per shot, read from the index alone.

        The columns are ``attempt``, ``status``, times, ``success``, ``filling_fraction``, counts of cycles,
        batches, atom moves and defects, and ``duration_s``. Scanned and set values follow by address, then
        ``stage.*``, how long each stage took, ``reading.*``, values read from devices, and ``calibration.*``,
        ids. Numbers are SI, and nan where they are missing. ``attrs`` has ``units`` and ``descriptions`` by
        column, and the values that hold for the whole run.

        Args:
            attempts: Whether to include failed and interrupted attempts.

        Raises:
            ConfigError: pandas is not installed.
        """
        from labseq.data.tables import dataframe_of

        return dataframe_of(self, attempts=attempts)

    def to_xarray(self, *, occupancies: bool = True) -> xr.Dataset:
        """The shots that count as an xarray dataset.

        Its axes are the axes of the scan and ``repeat``, or ``point`` and ``repeat`` if the scan is not a
        product of its addresses, or ``shot`` without a scan. Variables are the columns of
        :meth:`to_dataframe`, with nan for missing shots, and ``occupancy``, int8 (..., image, row, col).
        The occupancies are read from the shots' files and are -1 where there is no such image.

        Args:
            occupancies: Whether to read the occupancies.

        Raises:
            ConfigError: xarray is not installed.
            RecordingError: A shot's file is missing or damaged, or the scan is damaged.
        """
        from labseq.data.tables import dataset_of

        return dataset_of(self, occupancies=occupancies)
