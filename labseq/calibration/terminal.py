"""Does the work of `labseq calibrate` and `labseq calibration`, and prints the results."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.calibrations import open_store
from labseq.assembly.options import DryRun
from labseq.calibration.compare import Difference, compare, quality_text, quantity
from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration.quality import use_if_not_worse
from labseq.calibration_store import Damaged, Store, Stored, age_s, grid_text
from labseq.config.profile import OFF, CalibrationChoices
from labseq.console.errors import lines_of
from labseq.console.events import LASTING, LogLines
from labseq.console.output import say
from labseq.console.report import Column, aligned, print_report, reporting, table
from labseq.console.text import age_text
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, did_you_mean, listing
from labseq.model import CALIBRATION_KINDS, CalibrationKind

MAX_LISTED: Final = 4
"""Maximum number of printed numbers of a value. For more, lowest, highest and mean are printed."""


@dataclass(frozen=True, slots=True)
class CalibrationRow:
    """A calibration. For a damaged file only its kind, its id and the error are known."""

    kind: str
    id: str
    file: Path
    in_use: bool
    error: str | None = None
    taken_utc: str | None = None
    age_s: float | None = None
    quality: Mapping[str, float] = field(default_factory=dict[str, float])
    grid: Mapping[str, Any] = field(default_factory=dict[str, Any])
    origin: Mapping[str, Any] = field(default_factory=dict[str, Any])
    picture: Path | None = None

    @classmethod
    def of(cls, calibration: Stored | Damaged, files_in_use: Mapping[str, str]) -> CalibrationRow:
        """An entry of a store. ``files_in_use`` is from :func:`in_use`."""
        path = calibration.path
        if isinstance(calibration, Damaged):
            is_used = files_in_use.get(calibration.kind) == path.name
            return cls(calibration.kind, calibration.id, path, is_used, str(calibration.error))
        entry = calibration.entry
        return cls(
            kind=entry.kind,
            id=entry.id,
            file=path,
            in_use=files_in_use.get(entry.kind) == path.name,
            taken_utc=entry.taken_utc,
            age_s=age_s(entry),
            quality=entry.quality,
            grid=entry.grid,
            origin=entry.origin,
            picture=calibration.picture,
        )

    @property
    def quality_text(self) -> str:
        """The deciding figure."""
        return "damaged" if self.error else quality_text(cast("CalibrationKind", self.kind), self.quality)


CALIBRATIONS: Final[Sequence[Column[CalibrationRow]]] = (
    Column("kind", lambda row: row.kind),
    Column("id", lambda row: row.id),
    Column("taken", lambda row: _time_text(row.taken_utc)),
    Column("age", lambda row: "-" if row.error else age_text(row.age_s)),
    Column("quality", lambda row: row.quality_text),
    Column("", lambda row: "in use" if row.in_use else ""),
    Column("from", lambda row: clean(str(row.origin.get("run") or row.origin.get("command") or "-"))),
)


@dataclass(frozen=True, slots=True)
class CalibrationList:
    """The calibrations of a profile, oldest first.

    Attributes:
        problems: Why it is unknown which calibrations are in use.
    """

    folder: Path
    calibrations: Sequence[CalibrationRow]
    problems: Sequence[str]

    def as_text(self) -> list[str]:
        """A row per calibration, and the damaged files."""
        if not self.calibrations:
            return [f"there are no calibrations in {self.folder}", *_below(self.problems)]
        problems = [*self.problems, *(row.error for row in self.calibrations if row.error)]
        return [*table(self.calibrations, CALIBRATIONS), *_below(problems)]


def _below(lines: Sequence[str]) -> list[str]:
    """Lines below an empty line, or nothing."""
    return ["", *lines] if lines else []


def list_calibrations(profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print a row per calibration, oldest first.

    Raises:
        ConfigError: The profile has an error, or the folder of its calibrations cannot be read.
    """
    store, spec = open_store(profile, dry_run)
    problems = list[str]()
    try:
        files_in_use = in_use(store, spec.calibrations.use)
    except ConfigError as error:
        files_in_use, problems = {}, [str(error)]
    rows = [CalibrationRow.of(calibration, files_in_use) for calibration in store.entries()]
    print_report(CalibrationList(store.folder, rows, problems), as_json=as_json)


@dataclass(frozen=True, slots=True)
class CalibrationDetails(CalibrationRow):
    """A calibration with its values."""

    values: Mapping[str, NDArray[np.float64]] = field(default_factory=dict[str, Any])

    def as_text(self) -> list[str]:
        """A line per figure and value. Values of many numbers are summarised."""
        return aligned(
            [
                ("calibration", f"{self.kind} {self.id}"),
                ("taken", f"{_time_text(self.taken_utc)}, {age_text(self.age_s, ' ago')}"),
                ("in use", "yes" if self.in_use else "no"),
                ("grid", grid_text(self.grid)),
                ("file", str(self.file)),
                ("picture", str(self.picture or "-")),
                *((f"origin.{name}", _origin_text(value)) for name, value in self.origin.items()),
                *((f"quality.{name}", quantity(value, name)) for name, value in self.quality.items()),
                *((name, _summary(name, value)) for name, value in self.values.items()),
            ]
        )


def show_calibration(calibration_id: str, profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print one calibration.

    Raises:
        ConfigError: There is no such calibration, there are several, or it is damaged.
    """
    store, spec = open_store(profile, dry_run)
    stored = store.find(calibration_id)
    row = CalibrationRow.of(stored, in_use(store, spec.calibrations.use))
    values = {field.name: getattr(row, field.name) for field in fields(row)}
    print_report(CalibrationDetails(**values, values=stored.entry.values), as_json=as_json)


def use_calibration(choice: str, profile: str, dry_run: DryRun, *, force: bool) -> None:
    """Use a calibration, or with "KIND=off" none of that kind.

    Raises:
        ConfigError: There is no such calibration, it belongs to another grid, or it is worse.
    """
    store, spec = open_store(profile, dry_run)
    name, equals, value = choice.partition("=")
    if equals:
        kind = _kind(name, value)
        store.use_none(kind)
        say(f"no calibration of {kind} is in use from the next run on")
    else:
        stored = store.find(choice)
        kind = stored.entry.kind
        if force:
            store.use(stored, spec.grid_model())
        else:
            use_if_not_worse(store, stored, spec.grid_model())
        say(f"{kind} {stored.entry.id} is in use from the next run on")
    if pin := spec.calibrations.use.of(kind):
        say(f"warning: the profile has 'calibrations.use.{kind}: {clean(pin)}', which takes precedence")


def compare_calibrations(before: str, after: str, profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print the changes from one calibration to another.

    Raises:
        ConfigError: They are of different kinds, or cannot be read.
    """
    store, _ = open_store(profile, dry_run)
    earlier, later = store.find(before).entry, store.find(after).entry
    ends = f"{earlier.id} ({_time_text(earlier.taken_utc)}) to {later.id} ({_time_text(later.taken_utc)})"
    change = Change(earlier.kind, earlier.id, later.id, ends, *compare(earlier, later))
    print_report(change, as_json=as_json)


@dataclass(frozen=True, slots=True)
class Change:
    """The changes from one calibration to another.

    Attributes:
        before: Id of the earlier calibration.
        after: Id of the later calibration.
        ends: Both with their times.
        values: The changes of their values.
        quality: The changes of their figures of merit.
    """

    kind: str
    before: str
    after: str
    ends: str
    values: Sequence[Difference]
    quality: Sequence[Difference]

    def as_text(self) -> list[str]:
        """A table of the values, and a table of the figures of merit."""
        figures = _below(table(self.quality, FIGURES) if self.quality else [])
        return [f"{self.kind}: {self.ends}", "", *table(self.values, DIFFERENCES), *figures]


DIFFERENCES: Final[Sequence[Column[Difference]]] = (
    Column("value", lambda value: value.name),
    Column("greatest change", lambda value: quantity(value.greatest, value.name)),
    Column("rms", lambda value: quantity(value.rms, value.name)),
    Column("mean", lambda value: ", ".join(quantity(mean, value.name) for mean in value.mean) or "-"),
)
FIGURES: Final[Sequence[Column[Difference]]] = (
    Column("figure", lambda figure: figure.name),
    Column("before", lambda figure: quantity(figure.before, figure.name)),
    Column("after", lambda figure: quantity(figure.after, figure.name)),
)


def in_use(store: Store, choices: CalibrationChoices) -> dict[str, str]:
    """Kind -> file name of the calibration in use."""
    files = {kind: active.file for kind, active in store.active().items()}
    for kind in CALIBRATION_KINDS:
        pin = choices.of(kind)
        if pin == OFF:
            files.pop(kind, None)
        elif pin is not None:
            files[kind] = store.find(pin, kind).path.name
    return files


def _kind(name: str, value: str) -> CalibrationKind:
    for kind in CALIBRATION_KINDS:
        if (kind, value) == (name, OFF):
            return kind
    if name in CALIBRATION_KINDS:
        raise ConfigError(Problem(f"{name} is '{clean(value)}'", expected=f"'{OFF}', or just an id"))
    problem, hint = f"'{clean(name)}' is not a kind of calibration", did_you_mean(name, CALIBRATION_KINDS)
    raise ConfigError(Problem(problem, expected=listing(CALIBRATION_KINDS), hint=hint))


def _summary(name: str, value: NDArray[np.float64]) -> str:
    if value.size <= MAX_LISTED:
        return ", ".join(quantity(float(number), name) for number in value.flat)
    shape = " x ".join(map(str, value.shape))
    low, high, mean = (quantity(float(f(value)), name) for f in (np.min, np.max, np.mean))
    return f"{shape} numbers, {low} to {high}, mean {mean}"


def _origin_text(value: Any) -> str:
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
        return ", ".join(f"{name} {item}" for name, item in items) or "-"
    return clean(str(value))


def _time_text(taken_utc: str | None) -> str:
    if taken_utc is None:
        return "-"
    return f"{datetime.fromisoformat(taken_utc).astimezone(UTC):%Y-%m-%d\xa0%H:%M}\xa0UTC"  # never broken


def calibrate_kind(kind: str, request: CalibrationRequest, *, as_json: bool) -> None:
    """Make a calibration, store it, and use it unless it is worse.

    Raises:
        ConfigError: The request has an error, or the calibration is worse than the one in use and was only
            stored.
        LabseqError: The calibration failed.
    """

    def failed(error: BaseException) -> dict[str, Any]:
        return {"kind": kind, "id": None, "in_use": False, "error": "\n".join(lines_of(error))}

    with reporting(as_json=as_json, failed=failed) as show:
        method = METHODS.get(kind)
        if method is None:
            problem, hint = f"'{clean(kind)}' cannot be calibrated", did_you_mean(kind, METHODS)
            raise ConfigError(Problem(problem, expected=listing(METHODS), hint=hint))
        outcome = calibrate(method, request, _Progress())
        show(Calibrated.of(outcome))
    if outcome.refused:
        entry = outcome.stored.entry
        problem = f"{entry.kind} {entry.id} is stored but not in use: {outcome.refused}"
        options = f"--force --profile {quote(request.profile)}"
        options += "" if request.dry_run == "off" else " --dry-run"
        hint = f"look at it, then 'labseq calibration use {entry.id} {options}'"
        raise ConfigError(Problem(problem, hint=hint))


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A calibration that was made.

    Attributes:
        refused: Why it is not in use. None if it is.
        summary: Lines about the measurement.
        before: Id of the calibration that was in use.
        changes: The changes from that calibration.
    """

    kind: str
    id: str
    in_use: bool
    refused: str | None
    summary: Sequence[str]
    quality: Mapping[str, float]
    before: str | None
    changes: Sequence[Difference]
    file: Path
    picture: Path | None
    run_dir: Path | None
    warnings: Sequence[str]

    @classmethod
    def of(cls, outcome: Outcome) -> Calibrated:
        """The outcome of a measurement."""
        entry = outcome.stored.entry
        return cls(
            kind=entry.kind,
            id=entry.id,
            in_use=not outcome.refused,
            refused=outcome.refused or None,
            summary=outcome.summary_lines,
            quality=entry.quality,
            before=None if outcome.before is None else outcome.before.id,
            changes=outcome.changes,
            file=outcome.stored.path,
            picture=outcome.stored.picture,
            run_dir=None if outcome.run is None else outcome.run.path,
            warnings=outcome.warnings,
        )

    def as_text(self) -> list[str]:
        """The result, the change from the calibration in use, and where it is stored."""
        state = "in use from the next run on" if self.in_use else "not in use"
        lines = [f"{self.kind} {self.id}: {state}", *self.summary]
        lines += _below(aligned([(name, quantity(value, name)) for name, value in self.quality.items()]))
        if self.before is not None:
            lines += [
                "",
                f"compared with {self.before}, which was in use:",
                *table(self.changes, DIFFERENCES),
            ]
        lines += ["", f"stored as {self.file}", *([f"look at {self.picture}"] if self.picture else [])]
        return [*lines, *(f"warning: {text}" for text in self.warnings)]


class _Progress(LogLines):
    """Implements ``RunObserver`` with a line for every tenth of the shots, and for each lasting event."""

    def __init__(self) -> None:
        super().__init__(sys.stderr, LASTING)
        self._n_shots = 1
        self._n_done = 0

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Print the line of an event, if it has one."""
        super().event(name, values)
        if name == "run_starting":
            self._n_shots = values["record"].n_shots
        elif name == "shot_finished":
            self._n_done += 1
            n, before = (k * 10 // self._n_shots for k in (self._n_done, self._n_done - 1))
            if n > before:
                say(f"{self._n_done} of {self._n_shots} shots", stream=sys.stderr)
