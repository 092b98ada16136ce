"""Measures, analyses, stores and compares a calibration, and uses it unless it is worse."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

import labseq
from labseq.assembly.calibrations import store_of, why_left_out
from labseq.assembly.options import DryRun
from labseq.assembly.profile import ResolvedProfile, resolve_profile
from labseq.assembly.recorded import recorded_machine
from labseq.calibration.compare import Difference, compare
from labseq.calibration.method import AnalysisResult, CalibrationData, Method
from labseq.calibration.methods import (
    analyse_frequencies,
    analyse_overlay,
    analyse_sites,
    analyse_timing,
    analyse_tweezers,
    read_site_file,
)
from labseq.calibration.quality import why_worse_than_in_use
from labseq.calibration.thresholds import analyse_thresholds
from labseq.calibration_store import Store, Stored, grid_text
from labseq.config.addresses import Override, split_overrides
from labseq.config.profile import OFF, ProfileSpec, load_profile
from labseq.console.runs import folder_of_run
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.messages import clean, install_hint
from labseq.model import CALIBRATION_KINDS, CalibrationEntry, SiteGrid, grid_facts, same_grid
from labseq.pictures.figures import can_draw, encode_figure
from labseq.plain import now_utc
from labseq.roles import RunObserver
from labseq.session.session import Session

METHODS: Final[Mapping[str, Method]] = {
    method.kind: method
    for method in (
        Method("sites", analyse_sites, read_site_file, ignored=("sites", "thresholds"), uses_detector=False),
        Method("thresholds", analyse_thresholds, ignored=("thresholds",), uses_detector=False),
        Method("tweezers", analyse_tweezers, uses_detector=False),
        Method("amplitudes", analyse_tweezers, uses_detector=False),
        Method("frequencies", analyse_frequencies),
        Method("overlay", analyse_overlay),
        Method("timing", analyse_timing, ignored=("timing",)),
    )
}
"""Kind of calibration -> its sequence and analysis."""


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """The profile, run and options of a calibration.

    Attributes:
        profile: Name or path of the profile.
        source: A run's folder, or a file of values, instead of a new run.
        shots: Number of shots, instead of the sequence's own.
        seed: Seed of the run.
        overrides: ``"address=value"`` strings, as given to ``--set``.
        output: Folder for the data of the run.
        dry_run: "off", "full" or "fast".
        force: Whether to use the result even if it is worse than the calibration in use.
        centre: "Y,X", middle of the grid of sites on the frames, in pixels. None if no other traps are lit.
    """

    profile: str
    source: Path | None = None
    shots: int | None = None
    seed: int | None = None
    overrides: Sequence[str] = ()
    output: Path | None = None
    dry_run: DryRun = "off"
    force: bool = False
    centre: str | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a calibration.

    Attributes:
        stored: The entry, which is stored even if it is not in use.
        summary_lines: Lines that summarise the result for the user.
        before: The entry that was in use. None if there was no comparable entry.
        changes: Change of each value from that entry.
        run: The run that was analysed. None for a file.
        refused: Why the result is not in use. "" if it is.
        warnings: Warnings for the user.
    """

    stored: Stored
    summary_lines: tuple[str, ...]
    before: CalibrationEntry | None
    changes: tuple[Difference, ...]
    run: Run | None
    refused: str
    warnings: tuple[str, ...]


def calibrate(method: Method, request: CalibrationRequest, observer: RunObserver | None = None) -> Outcome:
    """Measure, analyse and store a calibration, and use it unless it is worse than the previous one.

    Args:
        method: One of :data:`METHODS`.
        request: Profile, run and options.
        observer: Receives the events of the run.

    Raises:
        ConfigError: The request has an error, or the folder cannot be written to.
        DeviceError: A device failed, or the frames do not show the expected signal. The calibration
            in use stays in use.
        LabseqError: Another error ended the run.
    """
    _centre(method, request)  # reports a mistake before the run is taken
    document, spec = load_profile(request.profile, overrides=_of_profile(request.overrides))
    ignoring = _ignoring(store_of(document, spec).folder, spec, method)
    hardware = resolve_profile(request.profile, _of_profile([*request.overrides, ignoring]), request.dry_run)
    run, result = _analysed(method, request, hardware, ignoring, observer)
    entry = CalibrationEntry(
        kind=method.kind,
        values={name: np.asarray(value) for name, value in result.values.items()},
        quality=result.quality,
        grid=grid_facts(hardware.grid),
        origin={**_origin(method, request, hardware, run), **result.origin},
        # the time of the measurement, because an old run may be analysed again
        taken_utc=now_utc() if run is None else str(run.record["t_start_utc"]),
    )
    store = store_of(document, spec, request.dry_run)
    before, (picture, warnings) = _in_use(store, entry), _picture(result)
    stored = store.add(entry, picture)
    refused = why_left_out(entry, hardware.calibrations) or why_worse_than_in_use(store, entry)
    refused = "" if request.force else refused
    if not refused:
        store.use(stored, hardware.grid)
        overlay = store.active().get("overlay")
        if entry.kind == "frequencies" and overlay is not None:
            store.use_none("overlay")  # otherwise its correction would be made twice
            warnings += (f"overlay {overlay.id} is no longer used: these frequencies include its correction",)
    if pin := spec.calibrations.use.of(method.kind):
        text = f"the profile says 'calibrations.use.{method.kind}: {clean(pin)}', which takes precedence"
        warnings += (text,)
    changes = () if before is None else tuple(compare(before, entry)[0])
    return Outcome(stored, result.summary_lines, before, changes, run, refused, warnings)


def _analysed(
    method: Method,
    request: CalibrationRequest,
    hardware: ResolvedProfile,
    ignoring: str,
    observer: RunObserver | None,
) -> tuple[Run | None, AnalysisResult]:
    """Take or open a run and analyse it, or read a file of values."""
    source = request.source
    if source is not None and source.suffix.lower() in (".npy", ".csv"):
        if method.read is None:
            problem = f"a calibration of {method.kind} cannot be made from a file"
            raise ConfigError(Problem(problem, str(source), expected="a run's folder"))
        return None, method.read(source, hardware)
    run = (
        _measure(method, request, hardware, ignoring, observer)
        if source is None
        else _open(source, request, hardware)
    )
    try:
        return run, method.analyse(CalibrationData(run, hardware, _centre(method, request)))
    except LabseqError:
        if observer is not None:
            again = f"analyse the run again with --from {run.path}"
            text = f"the calibration failed, and the calibration in use is unchanged; {again}"
            observer.event("warning", {"text": text})
        raise


def _measure(
    method: Method,
    request: CalibrationRequest,
    hardware: ResolvedProfile,
    ignoring: str,
    observer: RunObserver | None,
) -> Run:
    grid = hardware.grid
    fitting = [*_meter(method, hardware.profile), *_target(method, grid), *_repeats(method, grid)]
    overrides = [*fitting, *request.overrides, ignoring]
    if not method.uses_detector:  # the detector's settings may be wrong before it is calibrated
        overrides = [text for text in overrides if not text.lstrip().startswith("profile.detector.")]
        overrides.append("profile.detector={use: blind}")
    with Session.open(
        method.sequence,
        profile=request.profile,
        shots=request.shots,
        seed=request.seed,
        overrides=overrides,
        output=request.output,
        dry_run=request.dry_run,
        observer=observer,
    ) as session:
        return session.run()


def _open(source: Path, request: CalibrationRequest, hardware: ResolvedProfile) -> Run:
    """Open a run with the profile's sites and devices.

    Raises:
        ConfigError: It is not a run, or has other sites or devices.
    """
    try:
        run = open_run(folder_of_run(source))
    except RecordingError as error:
        raise ConfigError(Problem(str(error), "--from")) from error
    if run.target.shape != hardware.grid.shape:
        run_sites = " x ".join(map(str, run.target.shape))
        expected = f"{hardware.grid.n_rows} x {hardware.grid.n_cols}, as in the profile"
        raise ConfigError(Problem(f"the run has a grid of {run_sites} sites", str(source), expected=expected))
    run_grid = grid_facts(recorded_machine(run.record["resolved"]["profile"], "the profile of the run").grid)
    if not same_grid(run_grid, own_grid := grid_facts(hardware.grid)):
        problem = f"the run has a grid of {grid_text(run_grid)}"
        raise ConfigError(Problem(problem, str(source), expected=f"{grid_text(own_grid)}, as in the profile"))
    if run.simulated != (request.dry_run != "off" or hardware.virtual_time):
        problem = f"the run was {'simulated' if run.simulated else 'taken with real devices'}"
        expected = (
            f"a {'run with real devices' if run.simulated else 'simulated run'}, like the profile's devices"
        )
        hint = "use --dry-run for calibrations of dry runs" if run.simulated else ""
        raise ConfigError(Problem(problem, str(source), expected=expected, hint=hint))
    return run


def _centre(method: Method, request: CalibrationRequest) -> tuple[float, float] | None:
    if request.centre is None:
        return None
    if method.kind != "sites":
        raise ConfigError(
            Problem(f"a calibration of {method.kind} takes no --centre", "--centre", expected="sites")
        )
    try:
        y, x = (float(part) for part in request.centre.split(","))
    except ValueError:
        y = x = math.nan
    if not math.isfinite(y + x):
        expected = "two numbers of pixels Y,X such as 250,261.5"
        raise ConfigError(Problem(f"'{clean(request.centre)}'", "--centre", expected=expected))
    return y, x


def _ignoring(folder: Path, spec: ProfileSpec, method: Method) -> str:
    """The override that makes runs ignore calibrations of the method's own kinds, which may be damaged."""
    use = {
        kind: OFF if kind in method.ignored else pin
        for kind in CALIBRATION_KINDS
        if (pin := spec.calibrations.use.of(kind)) is not None or kind in method.ignored
    }
    text = json.dumps({"folder": str(folder.resolve()), "use": use}, ensure_ascii=False)
    return f"profile.calibrations={text}"


def _meter(method: Method, spec: ProfileSpec) -> list[str]:
    """The overrides that make the step `equalise` use the meter of the profile's `equalise`."""
    if method.kind not in ("tweezers", "amplitudes"):
        return []
    meter = spec.equalise
    values = {key: getattr(meter, key) for key in sorted(meter.model_fields_set)}
    texts = {key: value if isinstance(value, str) else f"{value!r} s" for key, value in values.items()}
    return [f"shot.0.equalise.{key}={json.dumps(text)}" for key, text in texts.items()]


def _target(method: Method, grid: SiteGrid) -> list[str]:
    """The overrides for a target as large as the reservoir allows, and without the measured time."""
    if method.kind != "timing":
        return []
    if grid.shape == (1, 1):
        problem = "the grid has a single site, so no atom can be moved"
        raise ConfigError(
            Problem(problem, "labseq calibrate timing", expected="a grid of at least two sites")
        )
    sizes = zip(("rows", "cols"), grid.shape, strict=True)
    # 9/16 of the sites, of which random loading fills three quarters
    block = [f"target.{axis}={max(1, 3 * n // 4)}" for axis, n in sizes]
    return [*block, "profile.mobile_tweezers.overhead_per_cycle=0 s"]


def _repeats(method: Method, grid: SiteGrid) -> list[str]:
    """The override for more repeats on a small grid, so that enough atoms are probed."""
    # with these numbers of sites at each point, 75 % loaded, the centre is known to about 35 nm
    n_sites = {"overlay": 50, "frequencies": 100}.get(method.kind, 0)
    n_repeats = math.ceil(n_sites / (grid.n_rows * grid.n_cols))
    return [f"repeats={n_repeats}"] if n_repeats > 4 else []  # their sequences have up to 4


def _of_profile(overrides: Sequence[str]) -> list[Override]:
    return split_overrides(overrides)[1]


def _origin(
    method: Method, request: CalibrationRequest, hardware: ResolvedProfile, run: Run | None
) -> dict[str, Any]:
    origin: dict[str, Any] = {
        "command": f"labseq calibrate {method.kind}",
        "profile": hardware.profile.name,
        "labseq": labseq.__version__,
        "simulated": request.dry_run != "off" or hardware.virtual_time,
        "calibrations": {kind: entry.id for kind, entry in hardware.calibrations.items()},
    }
    if run is None:
        return {**origin, "file": str(request.source)}
    return {**origin, "run": str(run.path), "n_shots": len(run.shots)}


def _in_use(store: Store, entry: CalibrationEntry) -> CalibrationEntry | None:
    """The entry that the new entry would replace, if the two can be compared."""
    try:
        stored = store.entry_in_use(entry.kind)
    except ConfigError:
        return None
    return stored.entry if stored is not None and same_grid(stored.entry.grid, entry.grid) else None


def _picture(result: AnalysisResult) -> tuple[bytes | None, tuple[str, ...]]:
    """The picture as PNG, or a warning if it cannot be drawn."""
    if result.draw is None:
        return None, ()
    if not can_draw():
        return None, (f"there is no picture because matplotlib is not installed ({install_hint('plot')})",)
    return encode_figure(result.draw, dpi=110), ()
