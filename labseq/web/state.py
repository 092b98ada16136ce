"""The state of a run for its page: figures, trend, stages, losses, last shot, alarms and scan."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final, cast

from labseq.analysis.timing import StageTotals
from labseq.calibration_store import read_entry
from labseq.console.events import event_text, point_of_shot
from labseq.console.text import age_text, plural
from labseq.data.follower import Event
from labseq.data.shot import Shot
from labseq.errors import ConfigError, LabseqError, RecordingError
from labseq.files import free_bytes
from labseq.model import StageTiming
from labseq.model.records import OVERSHOOT_S, STEP
from labseq.plain import now
from labseq.recording.folders import INDEX_FILE, STOP_FILE
from labseq.recording.run_file import read_state
from labseq.session.notices import FREE_GB
from labseq.units import size_text
from labseq.web.history import Columns, judged_values
from labseq.web.runs import OpenRun, notes_of, profile_of, text_of
from labseq.web.scan import ScanView
from labseq.web.series import finite
from labseq.web.shots import rows_of, shot_values

N_BINS: Final = 40
"""Maximum number of points of a trend."""
_OPEN_S: Final = 0.5
"""Minimum time between opening shots, in seconds, as reading a shot's file takes 10 to 20 ms of CPU."""


@dataclass(frozen=True, slots=True)
class Limits:
    """When the page raises an alarm.

    Attributes:
        calibration_s: Maximum age of a calibration in use, in seconds.
        free_gb: Free space in GB below which the disk counts as nearly full.
    """

    calibration_s: float = 7 * 86_400.0
    free_gb: float = FREE_GB


class RunState:
    """The state of a run, updated by :meth:`update`.

    Args:
        limits: When an alarm is raised.
    """

    def __init__(self, run: OpenRun, limits: Limits) -> None:
        self.run = run
        self._limits = limits
        self._stages: OrderedDict[tuple[int, int], tuple[StageTiming, ...]] = OrderedDict()
        self._last: dict[str, Any] | None = None
        self._n_opened = 0
        self._opened_s = -math.inf
        self._shot_error = ""
        self._rows: list[dict[str, Any]] = []
        self._scans: OrderedDict[str, ScanView] = OrderedDict()

    def update(self, quantity: str = "") -> dict[str, Any]:
        """The state as the files are now, JSON-ready.

        Args:
            quantity: The only quantity at the points of the scan. "" for all that the run measures.

        Raises:
            RecordingError: run.json is damaged, or a file cannot be read.
        """
        with self.run.lock:
            record, (status, error) = self.run.record, read_state(self.run.folder)
            self.run.history.update()
            self.run.read_events()
            columns = self.run.history.columns()
            self._open_shots(record, status, columns)
            return {
                "run": self._head(record, status, error),
                "figures": figures_of(columns),
                "measured": columns.shown(N_BINS),
                "losses": losses_of(columns),
                "stages": self._rows,
                "shot": self._last,
                "scan": self._scan_now(quantity, status),
                "alarms": self._alarms(record, status, error, columns),
                "log": [log_line(event) for event in self.run.events[-12:]],
            }

    def _head(self, record: Mapping[str, Any], status: str, error: str) -> dict[str, Any]:
        head = head_of(self.run, record, status, error)
        return head | {"time_left_s": self._time_left_s(head)}

    def _time_left_s(self, head: Mapping[str, Any]) -> float | None:
        n_new = head["n_done"] - self.run.shots_before
        taken_s = self.run.last_event_s - self.run.first_shot_s
        if head["status"] != "running" or n_new <= 0 or math.isnan(taken_s):
            return None
        return taken_s / n_new * max(0, head["n_shots"] - head["n_done"])

    def _open_shots(self, record: Mapping[str, Any], status: str, columns: Columns) -> None:
        """Read the newest shots, but not too often during a run. A later update reads the rest."""
        lines = len(columns.shot)
        is_too_soon = status == "running" and time.monotonic() - self._opened_s < _OPEN_S
        if lines == self._n_opened or is_too_soon:
            return
        self._opened_s, self._shot_error = time.monotonic(), ""
        n_newest = 1 if self._n_opened else 20  # enough for the stages, so older files are not read
        # the last shot that counts is shown, even if attempts at the next one have failed since
        good = int(columns.counts.nonzero()[0].max(initial=-1))
        newest = {*range(max(self._n_opened, lines - n_newest), lines), max(good, self._n_opened)}
        for line in sorted(newest & {*range(lines)}):
            try:
                shot = self.run.shot(line)
                self._stages[shot.index, shot.attempt] = shot.timing
                if line == good or good < 0:
                    self._last = self._shot(shot, record)
            except RecordingError as error:
                self._shot_error = text_of(error, 400)
        self._n_opened = lines
        while len(self._stages) > 50:  # stages are summed over these
            self._stages.popitem(last=False)
        self._rows = self._stage_rows(record)

    def _shot(self, shot: Shot, record: Mapping[str, Any]) -> dict[str, Any]:
        values = shot_values(shot, str(record.get("record_frames")))
        del values["stages"]
        return values | {"point": point_of_shot(record.get("scan") or {}, shot.index, shot.parameters)}

    def _stage_rows(self, record: Mapping[str, Any]) -> list[dict[str, Any]]:
        totals = StageTotals()
        for timing in self._stages.values():
            totals.add_timing(timing)
        return stage_rows(totals, simulated=bool(record["simulated"]))

    def scan(self, quantity: str, most_s: float) -> dict[str, Any] | None:
        """The scan of the run with one quantity or with all that the run measures. None without a scan.

        Args:
            quantity: Name of the quantity. "" for all that the run measures.
            most_s: Maximum time to wait for fits and for files of shots, in seconds.

        Raises:
            ConfigError: The run has no such quantity.
            RecordingError: A file cannot be read.
        """
        end_s = time.monotonic() + most_s
        while True:
            with self.run.lock:  # not for the whole time, as pages need it
                self.run.history.update()
                self.run.read_events()
                if not self.run.record.get("scan"):
                    return None
                view = self._scan(quantity)
                values = view.values(read_s=0.2)
                if not view.is_busy or time.monotonic() > end_s:
                    return values
            time.sleep(0.1)

    def _scan(self, quantity: str) -> ScanView:
        view = self._scans.pop(quantity, None) or ScanView(self.run, quantity)
        self._scans[quantity] = view
        while len(self._scans) > 8:
            self._scans.popitem(last=False)
        return view

    def _scan_now(self, quantity: str, status: str) -> dict[str, Any] | None:
        if not self.run.record.get("scan"):
            return None
        try:
            view = self._scan(quantity)
        except ConfigError as error:  # no such quantity
            return {"error": text_of(error, 600)}
        # a run in progress needs the processor more
        return {**view.recent(read_s=0.03 if status == "running" else 0.3), "is_busy": view.is_busy}

    def _alarms(
        self, record: Mapping[str, Any], status: str, error: str, columns: Columns
    ) -> list[dict[str, str]]:
        alarms = [
            *_run_alarms(self.run, status, error, columns),
            *self._budget_alarms(),
            *calibration_alarms(self.run.folder, record, self._limits.calibration_s),
            *disk_alarms(self.run.folder, self._limits.free_gb),
        ]
        if self._shot_error:
            alarms.append(alarm("warning", "The last shot cannot be read", self._shot_error))
        return alarms

    def _budget_alarms(self) -> list[dict[str, str]]:
        over: dict[str, int] = {}
        for timing in self._stages.values():
            for stage in timing:
                over[stage.stage] = over.get(stage.stage, 0) + stage.over_budget
        n_shots = plural(len(self._stages), "shot")
        return [
            alarm(
                "warning", f"'{text_of(stage, 60)}' exceeded its budget", f"{n} times in the last {n_shots}"
            )
            for stage, n in over.items()
            if n
        ]


def head_of(run: OpenRun, record: Mapping[str, Any], status: str, error: str) -> dict[str, Any]:
    """Name, state, progress and target of a run, for the head of its page."""
    grid: Any = {}
    with suppress(KeyError, TypeError):
        grid = record["resolved"]["profile"]["grid"]
    target = run.target
    return {
        "id": text_of(run.id, 300),
        "name": text_of(record["name"], 200),
        "profile": profile_of(record),
        "status": status,
        "error": text_of(error),
        "is_stopping": status == "running" and (run.folder / STOP_FILE).exists(),
        "simulated": bool(record["simulated"]),
        "seed": str(record["seed"]),
        "started_utc": text_of(record.get("t_start_utc") or "", 40),
        "n_shots": record["n_shots"],
        "n_done": run.history.n_shots,
        "n_attempts": len(run.history) - run.history.n_shots,
        "taken_s": finite(run.last_event_s),
        "lattice": {
            "rows": target.shape[0],
            "cols": target.shape[1],
            "kind": "square" if record.get("lattice") == "square" else "triangular",
            "shear": -1 if isinstance(grid, dict) and cast("Any", grid).get("shear") == -1 else 1,
        },
        "target": {
            "name": text_of(target.name, 100),
            "n_atoms": target.n_atoms,
            "fill": rows_of(target.fill),
        },
        **notes_of(run.folder),
    }


def figures_of(columns: Columns) -> dict[str, Any]:
    """The main figures of a run with their 68 % intervals."""
    rate, cycles = columns.defect_free, columns.of_shots("n_cycles")
    return {
        **judged_values(columns.filling, rate),
        "n_defect_free": rate.n,
        "n_judged": rate.n_trials,
        "n_seen": int((columns.of_shots("seen") >= 0).sum()),
        "cycles": finite(float(cycles.mean())) if len(cycles) else None,
        "shot_s": finite(float(columns.of_shots("duration_s").mean())) if len(cycles) else None,
    }


def losses_of(columns: Columns) -> list[dict[str, Any]]:
    """Atoms lost per shot by cause, the largest first. Empty on real hardware."""
    losses = [
        {"cause": text_of(cause.replace("_", " "), 60), "mean": value.value, "error": finite(value.error)}
        for cause, value in columns.losses.items()
        if value.value > 0
    ]
    return sorted(losses, key=lambda loss: -cast("float", loss["mean"]))


def stage_rows(totals: StageTotals, *, simulated: bool) -> list[dict[str, Any]]:
    """Stages of the latest shots. In a simulated run with host times, as measured on real hardware."""
    rows = list[dict[str, Any]]()
    for stage in totals.stages():
        shown_s = stage.host_s if simulated else stage.session_s
        whole = stage.stage.startswith(STEP)
        rows.append(
            {
                "stage": text_of(stage.stage.removeprefix(STEP) if whole else stage.stage, 80).replace(
                    "_", " "
                ),
                "is_step": whole,
                "n": stage.n,
                "median_s": finite(shown_s.p50),
                "p99_s": finite(shown_s.p99),
                "modelled_s": finite(stage.session_s.p50) if simulated else None,
                "budget_s": finite(stage.budget_s),
                "n_over": stage.n_over,
                "margin_s": OVERSHOOT_S,
            }
        )
    return rows


def alarm(level: str, title: str, text: str = "") -> dict[str, str]:
    """An alarm: "error" if the run is in danger or over, "warning" otherwise."""
    return {"level": level, "title": title, "text": text}


def _run_alarms(run: OpenRun, status: str, error: str, columns: Columns) -> list[dict[str, str]]:
    alarms = list[dict[str, str]]()
    if status == "failed":
        title = "The run died" if "process" in error else "The run failed"
        alarms.append(alarm("error", title, text_of(error)))
    n_failed = len(columns.shot) - len(columns.counted)
    if n_failed:
        last = int((~columns.counts).nonzero()[0][-1])
        text = ""
        with suppress(RecordingError):
            row = run.history.row(last)
            text = f"the last: shot {row.shot}, {row.status}: {text_of(row.error, 300)}"
        alarms.append(alarm("warning", f"{plural(n_failed, 'attempt')} at a shot failed", text))
    if run.history.n_damaged:
        text = "these lines are left out here; repair them with `labseq doctor`"
        alarms.append(
            alarm("warning", f"{plural(run.history.n_damaged, 'line')} of the index cannot be read", text)
        )
    if status == "running" and (silent_s := _silent_s(run, columns)):
        alarms.append(
            alarm("warning", f"No shot for {age_text(silent_s)}", "the process of the run is still running")
        )
    return alarms


def _silent_s(run: OpenRun, columns: Columns) -> float:
    """Time without a new shot if it is much longer than a shot takes, or else 0."""
    try:
        silent_s = time.time() - (run.folder / INDEX_FILE).stat().st_mtime
    except OSError:
        return 0.0
    t_s = columns.of_shots("t_s")[-20:]
    usual_s = float(abs(t_s[1:] - t_s[:-1]).mean()) if len(t_s) > 1 else 0.0
    return silent_s if silent_s > max(120.0, 10 * usual_s) else 0.0


def calibration_alarms(folder: Path, record: Mapping[str, Any], limit_s: float) -> list[dict[str, str]]:
    """An alarm for each calibration of a run that is older than allowed."""
    alarms = list[dict[str, str]]()
    for kind in list(record.get("calibrations") or {})[:20]:
        with suppress(LabseqError, ValueError, OverflowError, OSError):
            taken = datetime.fromisoformat(read_entry(folder / f"calibration_{kind}.json").taken_utc)
            age_s = (now() - taken).total_seconds()
            if age_s > limit_s:
                title = f"The calibration '{text_of(kind, 40)}' is {age_text(age_s, ' old')}"
                alarms.append(alarm("warning", title, f"limit: {age_text(limit_s)}"))
    return alarms


def disk_alarms(folder: Path, free_gb: float) -> list[dict[str, str]]:
    """An alarm if the disk is nearly full."""
    try:
        free = free_bytes(folder)
    except OSError:
        return []
    if free >= free_gb * 1e9:
        return []
    text = f"{size_text(free)} are free, fewer than {free_gb:g} GB"
    return [alarm("warning" if free else "error", "The disk is nearly full", text)]


def log_line(event: Event) -> dict[str, str]:
    """An event of the log as a line of text."""
    name, values = event.name, event.values
    text = ""
    with suppress(KeyError, TypeError, ValueError, AttributeError):  # an event of another version of labseq
        if name == "shot_repeated":
            shot = values["shot"]
            text = f"shot {shot['shot_index']}: attempt {shot['attempt']} failed: {shot['error']}"
        elif name == "run_finished":
            text = f"run {values['status']}" + (f": {values['error']}" if values.get("error") else "")
        elif name == "run_starting":
            text = "run resumed" if values.get("n_before") else "run started"
        else:
            text = event_text(name, values, None)
    return {"t_utc": text_of(event.t_utc, 40), "event": text_of(name, 60), "text": text_of(text or name, 400)}
