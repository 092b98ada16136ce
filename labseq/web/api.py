"""The API under /api/v1, which answers requests of browsers and other programs."""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, cast

from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse

import labseq
from labseq.analysis.statistics import statistics_of
from labseq.analysis.timing import StageTotals
from labseq.console.events import scanned_names, scanned_values
from labseq.data.site_maps import site_map
from labseq.errors import RecordingError
from labseq.files import read_file
from labseq.pictures.playback import play_back_cycle
from labseq.plain import to_plain
from labseq.recording.folders import PROFILE_FILE, SEQUENCE_FILE
from labseq.recording.run_file import read_state
from labseq.web.endpoint import Endpoint, describe, in_thread
from labseq.web.history import Columns
from labseq.web.live import Live
from labseq.web.runs import Catalogue, NoSuchRun, OpenRun, text_of
from labseq.web.scan import map_choices
from labseq.web.series import finite
from labseq.web.shots import frame_png, readings_of, shot_values
from labseq.web.state import N_BINS, Limits, figures_of, head_of, losses_of, stage_rows
from labseq.web.store import calibration_picture, calibrations, queue_values

BASE: Final = "/api/v1"
MAX_LISTED: Final = 500
_RUN: Final = "/runs/{day}/{name}"
_TEXTS: Final = {"sequence": SEQUENCE_FILE, "profile": PROFILE_FILE}


class Api:
    """The endpoints that read data, together with the endpoints of actions.

    Args:
        limits: When alarms are raised.
        actions: Endpoints for changes. Empty if the server is read-only.
    """

    def __init__(self, catalogue: Catalogue, limits: Limits, actions: Sequence[Endpoint] = ()) -> None:
        self._runs = catalogue
        self._live = Live(catalogue, limits)
        self._actions = actions
        self._started_s = time.monotonic()
        self._frames: OrderedDict[str, tuple[float, asyncio.Future[tuple[bytes, int]]]] = OrderedDict()

    def endpoints(self) -> list[Endpoint]:
        """All endpoints of this server."""
        reading = [
            Endpoint("/server", self.server),
            Endpoint("/now", self.now),
            Endpoint("/events", self.events, ("day", "name", "quantity"), "text/event-stream"),
            Endpoint("/runs", self.runs, ("q", "status", "first", "n")),
            Endpoint(_RUN, self.run),
            Endpoint(f"{_RUN}/state", self.state),
            Endpoint(f"{_RUN}/statistics", self.statistics),
            Endpoint(f"{_RUN}/scan", self.scan, ("quantity",)),
            Endpoint(f"{_RUN}/map", self.map, ("quantity",)),
            Endpoint(f"{_RUN}/shots", self.shots, ("first", "n")),
            Endpoint(f"{_RUN}/shots/{{shot}}", self.shot, ("attempt",)),
            Endpoint(f"{_RUN}/shots/{{shot}}/motion/{{cycle}}", self.motion, ("attempt",)),
            Endpoint(
                f"{_RUN}/shots/{{shot}}/frames/{{image}}.png", self.frame, ("attempt", "width"), "image/png"
            ),
            Endpoint(f"{_RUN}/files/{{kind}}", self.file, content="text/plain"),
            Endpoint("/queue", self.queue),
            Endpoint("/calibrations", self.calibrations),
            Endpoint("/calibrations/{store}/{file}.png", self.calibration_picture, content="image/png"),
        ]
        return [*reading, *self._actions]

    def server(self, _: Request) -> Any:
        """About this server: version, data folder, and whether visitors may make changes."""
        return {
            "labseq": labseq.__version__,
            "data": text_of(self._runs.root),
            "may_act": bool(self._actions),
            "up_s": round(time.monotonic() - self._started_s, 1),
            "viewers": self._live.n_viewers,
        }

    def now(self, _: Request) -> Any:
        """The state of the run in progress, or else of the newest run, as the page "Now" shows it."""
        return self._live.state()

    async def events(self, request: Request) -> Response:
        """The state of the newest run or of one run, as a server-sent event each time it changes.

        After `Last-Event-ID` the current state is sent, unless it is still the same.
        """
        address = request.client.host if request.client else ""
        if not self._live.has_room(address):
            return JSONResponse({"error": f"{self._live.n_viewers} pages are already open"}, 503)
        query = request.query_params
        channel = self._live.channel(query.get("day", ""), query.get("name", ""), _quantity(request))
        states = self._live.states(channel, request.headers.get("last-event-id", ""), address)
        headers = {"cache-control": "no-store", "x-accel-buffering": "no"}
        return StreamingResponse(states, media_type="text/event-stream", headers=headers)

    def runs(self, request: Request) -> Any:
        """The runs, the newest first.

        A search answers within a few seconds. Runs that it has not read by then are counted as `n_unread`.
        Ask again to include them.
        """
        query = request.query_params
        first, most = _number(query, "first", 0), min(MAX_LISTED, _number(query, "n", 50))
        return self._runs.search(query.get("q", "")[:200], query.get("status", "")[:20], first, most)

    def run(self, request: Request) -> Any:
        """A run: head, figures, measured quantities with trends, losses, changes and files."""
        run = self._opened(request)
        record, (status, error) = run.record, read_state(run.folder)
        run.history.update()
        columns = run.history.columns()
        changes: dict[str, Any] = record.get("overrides") or {}
        return {
            "run": head_of(run, record, status, error),
            "figures": figures_of(columns),
            "measured": columns.shown(N_BINS),
            "losses": losses_of(columns),
            "changes": readings_of({address: change["written"] for address, change in changes.items()}),
            "calibrations": readings_of(record.get("calibrations") or {}),
            "devices": {
                text_of(name, 80): readings_of(device) if isinstance(device, dict) else text_of(device, 200)
                for name, device in (record.get("devices") or {}).items()
            },
            "plugins": [
                readings_of(plugin) for plugin in record.get("plugins") or () if isinstance(plugin, dict)
            ],
            "provenance": readings_of(_flattened(record.get("provenance") or {})),
            "n_damaged_lines": run.history.n_damaged,
            "has_scan": bool(record.get("scan")),
            "files": [kind for kind, name in _TEXTS.items() if (run.folder / name).is_file()],
        }

    def state(self, request: Request) -> Any:
        """The state of a run, as in `/now`."""
        self._opened(request)
        return self._live.state(request.path_params["day"], request.path_params["name"])

    def statistics(self, request: Request) -> Any:
        """Statistics of each cycle, defects and stages, from at most 500 evenly chosen shots."""
        run = self._opened(request)
        run.history.update()
        counted = run.history.columns().counted.tolist()
        shots = run.with_rows(_evenly(counted, 500))
        totals = StageTotals()
        for shot in _evenly(
            shots, 50
        ):  # the times of stages are in the files of shots, which are slow to read
            with suppress(RecordingError):
                totals.add_timing(shot.timing)
        return {
            "n_read": len(shots),
            "n_shots": len(counted),
            "statistics": to_plain(statistics_of(shots, run.target)),
            "stages": stage_rows(totals, simulated=bool(run.record["simulated"])),
        }

    def scan(self, request: Request) -> Any:
        """The points of a run's scan, with measured values or `quantity`, and fits. null without a scan.

        Shots whose files have not been read yet are counted as `n_unread`. Ask again to include them.
        """
        run = self._opened(request)
        return self._live.state_of(run).scan(_quantity(request), most_s=8.0)

    def map(self, request: Request) -> Any:
        """A measured quantity or `quantity` at each site, from at most 500 evenly chosen shots.

        `values` and `n_trials` have a row for each row of sites. A value from fewer than 5 trials is null.
        """
        run = self._opened(request)
        run.history.update()
        choices = map_choices(run)
        name = _quantity(request) or next(iter(choices), "")
        counted = run.history.columns().counted.tolist()
        some = run.some(_evenly(counted, 500))
        found = site_map(some, name)
        return {
            "quantity": text_of(name, 200),
            "choices": [text_of(choice, 200) for choice in choices],
            "values": [[finite(value) for value in row] for row in found.values.tolist()],
            "n_trials": found.n_trials.tolist(),
            "mean": finite(found.mean),
            "n_read": found.n_shots,
            "n_shots": len(counted),
        }

    def shots(self, request: Request) -> Any:
        """The shots of a run, the newest first, including attempts that do not count."""
        run = self._opened(request)
        run.history.update()
        first = _number(request.query_params, "first", 0)
        most = min(MAX_LISTED, _number(request.query_params, "n", 50))
        columns = run.history.columns()
        lines = range(len(columns.shot))[::-1][first : first + most]
        scan: dict[str, Any] = run.record.get("scan") or {}
        return {
            "n_lines": len(columns.shot),
            "scanned": [text_of(name, 60) for name in scanned_names(scan)],
            "measured": columns.means(),
            "shots": [self._row(run, columns, line, scan) for line in lines],
        }

    @staticmethod
    def _row(run: OpenRun, columns: Columns, line: int, scan: Mapping[str, Any]) -> dict[str, Any]:
        names = ("success", "filling", "seen", "n_cycles", "n_batches", "n_atom_moves", "duration_s")
        row = run.history.row(line)
        return {
            "shot": row.shot,
            "attempt": row.attempt,
            "counts": row.counts,
            **{name: finite(float(columns.numbers[name][line])) for name in names},
            "n_defects": row.images.n_defects[-1] if len(row.images) and not run.target.is_none else None,
            "scanned": [text_of(word, 60) for word in scanned_values(scan, row.shot, row.parameters)],
            "measured": [finite(series.value(line)) for series in columns.series],
        }

    def shot(self, request: Request) -> Any:
        """A shot: images with occupancies, moves of each cycle, stages and readings."""
        run = self._opened(request)
        line = self._line(run, request)
        record = run.record
        values = shot_values(run.shot(line), str(record.get("record_frames")))
        status, error = read_state(run.folder)
        return {"run": head_of(run, record, status, error), "shot": values}

    def motion(self, request: Request) -> Any:
        """Tones and atoms of a cycle over time, and the atoms that were lost. Places in sites, times in ms.

        A tone is a list of [time, place, depth] and an atom a list of [time, row, column], linear in between.
        There is a tweezer at each crossing of tones that are on. `fates` is null for an atom that is kept, or
        tells how and when it goes: ejected, lost, or missing on the next image. `cycle` counts all cycles.
        """
        run = self._opened(request)
        shot, cycle = run.shot(self._line(run, request)), _number(request.path_params, "cycle", 0)
        if not 0 <= cycle < len(shot.cycles):
            raise NoSuchRun(f"the shot has no cycle {cycle}")
        return play_back_cycle(shot, cycle).as_json()

    async def frame(self, request: Request) -> Response:
        """A frame of a shot in 8 bit, its darkest pixels black and its brightest white."""
        key, now_s = str(request.url), time.monotonic()
        cached = self._frames.get(key)
        if cached is None or now_s - cached[0] > 2.0:  # many pages ask for the same frame at once
            cached = self._frames[key] = (
                now_s,
                asyncio.ensure_future(in_thread(partial(self._frame, request))),
            )
            while len(self._frames) > 8:
                self._frames.popitem(last=False)
        png, factor = await asyncio.shield(cached[1])  # a page that leaves must not cancel it for the others
        headers = {"cache-control": "private, max-age=600", "x-reduced": str(factor)}
        return Response(png, media_type="image/png", headers=headers)

    def _frame(self, request: Request) -> tuple[bytes, int]:
        run = self._opened(request)
        shot = run.shot(self._line(run, request))
        width = max(16, _number(request.query_params, "width", 512))
        return frame_png(shot, _number(request.path_params, "image", 0), width)

    def file(self, request: Request) -> Response:
        """The sequence or the profile as it was when the run began. `kind` is "sequence" or "profile"."""
        run = self._opened(request)
        name = _TEXTS.get(request.path_params["kind"])
        if name is None:
            raise NoSuchRun("a run has the files 'sequence' and 'profile'")
        text = read_file(run.folder / name).decode("utf-8", "replace")
        return PlainTextResponse(text_of(text, most=1 << 20))

    def queue(self, _: Request) -> Any:
        """The queue: its entries in order, and the process that takes them."""
        return queue_values(self._runs.root)

    def calibrations(self, _: Request) -> Any:
        """All calibrations by folder and kind with their quality, and the ones in use."""
        return calibrations(self._runs)

    def calibration_picture(self, request: Request) -> Response:
        """The picture of a calibration."""
        store, file = request.path_params["store"], request.path_params["file"]
        png = calibration_picture(self._runs, store, file)
        if png is None:
            raise NoSuchRun("there is no such picture")
        return Response(png, media_type="image/png", headers={"cache-control": "private, max-age=600"})

    def _opened(self, request: Request) -> OpenRun:
        return self._runs.open(request.path_params["day"], request.path_params["name"])

    @staticmethod
    def _line(run: OpenRun, request: Request) -> int:
        run.history.update()
        shot = _number(request.path_params, "shot", 0)
        attempt = _number(request.query_params, "attempt", -1)
        line = run.history.line_of(shot, None if attempt < 0 else attempt)
        if line is None:
            raise NoSuchRun(f"the run has no shot {shot} yet")
        return line

    def openapi(self) -> dict[str, Any]:
        """Describe the API as an OpenAPI document."""
        paths: dict[str, dict[str, Any]] = {}
        for endpoint in self.endpoints():
            paths.setdefault(BASE + endpoint.path, {})[endpoint.method.lower()] = describe(endpoint)
        description = (
            "Runs, shots, scans, queue and calibrations of a labseq data folder. Times are in seconds, "
            "fractions from 0 to 1, intervals of 68 %. Shots, images, cycles and sites are counted from 0. "
            'Unknown numbers are null. An error has the form {"error": "..."}. With a token, send '
            '"Authorization: Bearer TOKEN".'
        )
        info = {"title": "labseq", "version": labseq.__version__, "description": description}
        return {"openapi": "3.1.0", "info": info, "paths": paths}

    def metrics(self) -> str:
        """The state of the newest run in the format of Prometheus."""
        state = self._live.state()
        run, label = state["run"], ""
        rows: list[tuple[str, str, float | None]] = [
            ("labseq_up", "Whether the data folder can be read.", not state["error"]),
            ("labseq_runs_in_progress", "Runs in progress.", len(state.get("running") or ())),
            ("labseq_alarms", "Alarms of the newest run.", len(state["alarms"])),
            ("labseq_viewers", "Pages that are open.", self._live.n_viewers),
        ]
        if run is not None:
            figures, label = state["figures"], f'{{run="{_label(run["id"])}",name="{_label(run["name"])}"}}'
            rows += [
                ("labseq_run_in_progress", "Whether this run is in progress.", run["status"] == "running"),
                ("labseq_run_shots", "Shots of the run so far.", run["n_done"]),
                ("labseq_run_shots_planned", "Shots that the run will have.", run["n_shots"]),
                ("labseq_run_failed_attempts", "Attempts that do not count.", run["n_attempts"]),
                ("labseq_run_filling", "Mean filling of the target.", figures["filling"]),
                ("labseq_run_defect_free", "Fraction of defect-free shots.", figures["defect_free"]),
            ]
        lines: list[str] = []
        for name, about, value in rows:
            shown = "NaN" if value is None or not math.isfinite(value) else f"{value:.12g}"
            labels = label if name.startswith("labseq_run_") else ""
            lines += [f"# HELP {name} {about}", f"# TYPE {name} gauge", f"{name}{labels} {shown}"]
        return "\n".join(lines) + "\n"


def _flattened(values: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values under dotted names, such as "git.commit"."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{key}": inner for key, inner in cast("dict[str, Any]", value).items()}
        else:
            flat[name] = value
    return flat


def _label(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number(values: Mapping[str, Any], name: str, default: int) -> int:
    """A whole number from the address. Negative numbers give -1.

    Raises:
        NoSuchRun: The text is not a whole number.
    """
    text = str(values.get(name, default))
    if not (text.removeprefix("-").isdecimal() and len(text) < 12):
        raise NoSuchRun(f"'{name}' is not a whole number")
    return max(int(text), -1)


def _quantity(request: Request) -> str:
    return request.query_params.get("quantity", "")[:200]


def _evenly(items: Any, n_most: int) -> list[Any]:
    """At most ``n_most`` of the items, evenly spaced."""
    step = max(1, math.ceil(len(items) / n_most))
    return list(items[::step])
