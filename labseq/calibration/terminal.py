"""`labseq calibrate` and `labseq calibration`: do the work and print the result."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from shlex import quote
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.assembly.calibrations import open_store
from labseq.assembly.plugin_choice import DryRun
from labseq.calibration.compare import Difference, age_s, compare, quality_text, quantity
from labseq.calibration.measure import METHODS, CalibrationRequest, Outcome, calibrate
from labseq.calibration_store import Damaged, Store, Stored, grid_text
from labseq.config.profile import OFF, CalibrationChoices
from labseq.console.errors import lines_of
from labseq.console.events import LASTING, LogLines
from labseq.console.output import as_line, say, stdout_to_stderr
from labseq.console.text import age_text, columns
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, did_you_mean, listing
from labseq.model import CALIBRATION_KINDS, CalibrationKind

MAX_LISTED: Final = 4
"""Maximum number of numbers that are printed of a value; for more, lowest, highest and mean are printed."""


def list_calibrations(profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print a row per calibration, oldest first.

    Raises:
        ConfigError: The profile has an error, or the folder of its calibrations cannot be read.
    """
    store, spec = open_store(profile, dry_run)
    found, problems = store.entries(), list[str]()
    try:
        used = in_use(store, spec.calibrations.use)
    except ConfigError as error:
        used, problems = {}, [str(error)]
    if as_json:
        rows = [_values_of(one, used) for one in found]
        say(as_line({"folder": str(store.folder), "calibrations": rows, "problems": problems}))
        return
    if not found:
        say(f"there are no calibrations in {store.folder}")
    else:
        header = ("kind", "id", "taken", "age", "quality", "", "from")
        say(*columns([header, *(_row(one, used) for one in found)]))
    problems += [str(one.error) for one in found if isinstance(one, Damaged)]
    say(*([""] if problems else []), *problems)


def show_calibration(wanted: str, profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print one calibration.

    Raises:
        ConfigError: There is no such calibration, there are several, or it is damaged.
    """
    store, spec = open_store(profile, dry_run)
    stored, used = store.find(wanted), in_use(store, spec.calibrations.use)
    if as_json:
        say(as_line(_values_of(stored, used)))
        return
    entry = stored.entry
    quality = [(name, quantity(value, name)) for name, value in entry.quality.items()]
    say(
        *columns(
            [
                ("calibration", f"{entry.kind} {entry.id}"),
                ("taken", f"{_time_text(entry.taken_utc)}, {age_text(age_s(entry), ' ago')}"),
                ("in use", "yes" if _is_used(stored, used) else "no"),
                ("grid", grid_text(entry.grid)),
                ("file", str(stored.path)),
                ("picture", str(stored.picture or "-")),
                *((f"origin.{name}", _origin_text(value)) for name, value in entry.origin.items()),
                *((f"quality.{name}", text) for name, text in quality),
                *((name, _summary(name, value)) for name, value in entry.values.items()),
            ]
        )
    )


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
        store.use(stored, spec.grid_model(), force=force)
        say(f"{kind} {stored.entry.id} is in use from the next run on")
    if pin := spec.calibrations.use.of(kind):
        say(f"warning: the profile has 'calibrations.use.{kind}: {clean(pin)}', which takes precedence")


def compare_calibrations(before: str, after: str, profile: str, dry_run: DryRun, *, as_json: bool) -> None:
    """Print what changed from one calibration to another.

    Raises:
        ConfigError: They are of different kinds, or one cannot be read.
    """
    store, _ = open_store(profile, dry_run)
    one, other = store.find(before).entry, store.find(after).entry
    values, figures = compare(one, other)
    if as_json:
        changes = {"values": [*map(asdict, values)], "quality": [*map(asdict, figures)]}
        say(as_line({"kind": one.kind, "before": one.id, "after": other.id, **changes}))
        return
    ends = (f"{entry.id} ({_time_text(entry.taken_utc)})" for entry in (one, other))
    say(f"{one.kind}: {' to '.join(ends)}", "", *difference_table(values))
    rows = [(d.name, quantity(d.before, d.name), quantity(d.after, d.name)) for d in figures]
    say(*(["", *columns([("figure", "before", "after"), *rows])] if rows else []))


def difference_table(differences: Sequence[Difference]) -> list[str]:
    """A row per value: greatest change, root mean square, mean."""
    rows = [
        (
            one.name,
            quantity(one.greatest, one.name),
            quantity(one.rms, one.name),
            ", ".join(quantity(mean, one.name) for mean in one.mean) or "-",
        )
        for one in differences
    ]
    return columns([("value", "greatest change", "rms", "mean"), *rows])


def in_use(store: Store, choices: CalibrationChoices) -> dict[str, str]:
    """Kind -> file name of the calibration in use."""
    used = {kind: one.file for kind, one in store.active().items()}
    for kind in CALIBRATION_KINDS:
        pin = choices.of(kind)
        if pin == OFF:
            used.pop(kind, None)
        elif pin is not None:
            used[kind] = store.find(pin, kind).path.name
    return used


def _row(one: Stored | Damaged, used: Mapping[str, str]) -> tuple[str, ...]:
    mark = "in use" if _is_used(one, used) else ""
    if isinstance(one, Damaged):
        return (one.kind, one.id, "-", "-", "damaged", mark, "-")
    entry = one.entry
    origin = entry.origin.get("run") or entry.origin.get("command") or "-"
    taken, age = _time_text(entry.taken_utc), age_text(age_s(entry))
    return (entry.kind, entry.id, taken, age, quality_text(entry), mark, clean(str(origin)))


def _values_of(one: Stored | Damaged, used: Mapping[str, str]) -> dict[str, Any]:
    head = {"file": one.path, "in_use": _is_used(one, used)}
    if isinstance(one, Damaged):
        return {"kind": one.kind, "id": one.id, **head, "error": str(one.error)}
    entry = one.entry
    return {
        "kind": entry.kind,
        "id": entry.id,
        **head,
        "taken_utc": entry.taken_utc,
        "age_s": age_s(entry),
        "quality": entry.quality,
        "grid": entry.grid,
        "origin": entry.origin,
        "picture": one.picture,
        "error": None,
    }


def _is_used(one: Stored | Damaged, used: Mapping[str, str]) -> bool:
    kind = one.kind if isinstance(one, Damaged) else one.entry.kind
    return used.get(kind) == one.path.name


def _kind(name: str, value: str) -> CalibrationKind:
    for kind in CALIBRATION_KINDS:
        if (kind, value) == (name, OFF):
            return kind
    if name in CALIBRATION_KINDS:
        raise ConfigError(Problem(f"{name} is '{clean(value)}'", expected=f"'{OFF}', or just an id"))
    what, hint = f"'{clean(name)}' is not a kind of calibration", did_you_mean(name, CALIBRATION_KINDS)
    raise ConfigError(Problem(what, expected=listing(CALIBRATION_KINDS), hint=hint))


def _summary(name: str, value: NDArray[np.float64]) -> str:
    if value.size <= MAX_LISTED:
        return ", ".join(quantity(float(number), name) for number in value.flat)
    shape = " x ".join(map(str, value.shape))
    low, high, mean = (quantity(float(f(value)), name) for f in (np.min, np.max, np.mean))
    return f"{shape} numbers, {low} to {high}, mean {mean}"


def _origin_text(value: Any) -> str:
    if isinstance(value, Mapping):
        items = cast("Mapping[str, Any]", value).items()
        return ", ".join(f"{name} {each}" for name, each in items) or "-"
    return clean(str(value))


def _time_text(taken_utc: str) -> str:
    return f"{datetime.fromisoformat(taken_utc).astimezone(UTC):%Y-%m-%d\xa0%H:%M}\xa0UTC"  # in one piece


N_MARKS: Final = 10
"""Number of progress lines of a run."""


def calibrate_kind(kind: str, request: CalibrationRequest, *, as_json: bool) -> None:
    """Make a calibration, store it, and use it unless it is worse.

    Raises:
        ConfigError: The request has an error; or the calibration is worse than the one in use, and was
            only stored.
        LabseqError: The calibration failed.
    """
    answer = stdout_to_stderr() if as_json else None
    try:
        method = METHODS.get(kind)
        if method is None:
            what, hint = f"'{clean(kind)}' cannot be calibrated", did_you_mean(kind, METHODS)
            raise ConfigError(Problem(what, expected=listing(METHODS), hint=hint))
        outcome = calibrate(method, request, _Progress())
    except BaseException as error:
        if answer is not None:
            answer(as_line({"kind": kind, "id": None, "in_use": False, "error": "\n".join(lines_of(error))}))
        raise
    if answer is None:
        say(*summary_lines(outcome))
    else:
        answer(as_line(_outcome_values(outcome)))
    if outcome.refused:
        entry = outcome.stored.entry
        what = f"{entry.kind} {entry.id} is stored but not in use: {outcome.refused}"
        options = f"--force --profile {quote(request.profile)}"
        options += "" if request.dry_run == "off" else " --dry-run"
        hint = f"look at it, then 'labseq calibration use {entry.id} {options}'"
        raise ConfigError(Problem(what, hint=hint))


def summary_lines(outcome: Outcome) -> list[str]:
    """The result, the change from the calibration in use, and where it is stored."""
    entry, picture = outcome.stored.entry, outcome.stored.picture
    state = "in use from the next run on" if not outcome.refused else "not in use"
    figures = [(name, quantity(value, name)) for name, value in entry.quality.items()]
    lines = [f"{entry.kind} {entry.id}: {state}", *outcome.summary_lines]
    lines += ["", *columns(figures)] if figures else []
    if outcome.before is not None:
        lines += [
            "",
            f"compared with {outcome.before.id}, which was in use:",
            *difference_table(outcome.changes),
        ]
    lines += ["", f"stored as {outcome.stored.path}", *([f"look at {picture}"] if picture else [])]
    return [*lines, *(f"warning: {text}" for text in outcome.warnings)]


def _outcome_values(outcome: Outcome) -> dict[str, Any]:
    entry = outcome.stored.entry
    return {
        "kind": entry.kind,
        "id": entry.id,
        "in_use": not outcome.refused,
        "refused": outcome.refused or None,
        "quality": entry.quality,
        "before": None if outcome.before is None else outcome.before.id,
        "file": outcome.stored.path,
        "picture": outcome.stored.picture,
        "run_dir": None if outcome.run is None else outcome.run.path,
        "warnings": outcome.warnings,
    }


class _Progress(LogLines):
    """Implements ``RunObserver`` with a line for every tenth of the shots, and one for each lasting event."""

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
            n, before = (k * N_MARKS // self._n_shots for k in (self._n_done, self._n_done - 1))
            if n > before:
                say(f"{self._n_done} of {self._n_shots} shots", stream=sys.stderr)
