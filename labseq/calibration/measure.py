"""From a request to an entry in the store: measure, analyse, keep, compare, use."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

import labseq
from labseq.calibration.compare import Difference, compare
from labseq.calibration.frequencies import FrequenciesMethod
from labseq.calibration.method import AnalysisResult, CalibrationData, Method
from labseq.calibration.overlay import OverlayMethod
from labseq.calibration.sites import SitesMethod
from labseq.calibration.store import Store, Stored, grid_text
from labseq.calibration.thresholds import ThresholdsMethod
from labseq.calibration.tweezers import TweezersMethod
from labseq.config import Override, ProfileSpec, load_profile, split_overrides
from labseq.config.messages import clean
from labseq.config.profile import OFF
from labseq.errors import ConfigError, LabseqError, Problem, RecordingError
from labseq.model import CALIBRATION_KINDS, CalibrationEntry, grid_facts, same_grid
from labseq.pictures.figures import can_draw, encode_figure
from labseq.recording import Run, open_run
from labseq.roles import RunObserver
from labseq.session.calibrations import store_of, why_left_out
from labseq.session.planning import recorded_machine
from labseq.session.profile import DryRun, ResolvedProfile, resolve_profile
from labseq.session.session import Session

PICTURE_DPI: Final = 110
VALUE_FILES: Final = (".npy", ".csv")
"""Endings of files with values; anything else that is named is a run."""

_BLIND: Final = "profile.detector={use: blind}"
_DETECTOR: Final = "profile.detector."


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """What is to be calibrated.

    Attributes:
        profile: Name or path of the profile.
        source: A run's folder, or a file with values, in place of a new run.
        shots: Number of shots, instead of the sequence's own.
        seed: Seed of the run.
        overrides: ``"address=value"`` strings, as given to ``--set``.
        output: Folder for the data of the run.
        dry_run: "off", "full" or "fast".
        force: Whether it is put to use even if it is worse than what is in use.
    """

    profile: str
    source: Path | None = None
    shots: int | None = None
    seed: int | None = None
    overrides: Sequence[str] = ()
    output: Path | None = None
    dry_run: DryRun = "off"
    force: bool = False


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a calibration.

    Attributes:
        stored: The entry; kept, whether it is in use or not.
        told: What was found, in lines.
        before: The entry that was in use; None for none, or one that cannot be compared.
        changes: How far the values have moved since then.
        run: The run that it was made of; None for a file.
        refused: Why it is not in use; "" if it is.
        warnings: What the user should know although it is no error.
    """

    stored: Stored
    summary_lines: tuple[str, ...]
    before: CalibrationEntry | None
    changes: tuple[Difference, ...]
    run: Run | None
    refused: str
    warnings: tuple[str, ...]


def calibrate(method: Method, request: CalibrationRequest, observer: RunObserver | None = None) -> Outcome:
    """Calibrate.

    Args:
        method: How calibrations of the kind are made.
        request: For what, and of what.
        observer: Told everything that happens in the run.

    Raises:
        ConfigError: Something in the request is wrong, or the folder cannot be written to.
        DeviceError: A device failed, or the frames do not show what is looked for; what is in use stays.
        LabseqError: Whatever ended the run.
    """
    overrides = _of_profile(request.overrides)
    document, spec = load_profile(request.profile, beside=Path(), overrides=overrides)
    aside = _aside(store_of(document, spec).folder, spec, method)
    bench = resolve_profile(
        request.profile, Path(), _of_profile([*request.overrides, aside]), request.dry_run
    )
    run, finding = _find(method, request, bench, aside, observer)
    entry = CalibrationEntry(
        kind=method.kind,
        values={name: np.asarray(value) for name, value in finding.values.items()},
        quality=finding.quality,
        grid=grid_facts(bench.grid),
        origin={**_origin(method, request, bench, run), **finding.origin},
        taken_utc=_now() if run is None else str(run.record["t_start_utc"]),
    )
    store = store_of(document, spec, request.dry_run)
    before, (picture, warnings) = _in_use(store, entry), _picture(finding)
    stored = store.add(entry, picture)
    refused = "" if request.force else why_left_out(entry, bench.calibrations) or store.why_worse(entry)
    if not refused:
        store.use(stored, bench.grid, force=True)
        warnings += _deactivate_overlay(store, entry)
    if pin := spec.calibrations.use.of(method.kind):
        warnings += (f"the profile says 'calibrations.use.{method.kind}: {clean(pin)}', and that counts",)
    changes = () if before is None else tuple(compare(before, entry)[0])
    return Outcome(stored, finding.summary_lines, before, changes, run, refused, warnings)


def _find(
    method: Method,
    request: CalibrationRequest,
    bench: ResolvedProfile,
    aside: str,
    observer: RunObserver | None,
) -> tuple[Run | None, AnalysisResult]:
    """Measure, or read what was measured, and analyse it."""
    source = request.source
    if source is not None and source.suffix.lower() in VALUE_FILES:
        return None, method.read(source, bench)
    run = _measure(method, request, aside, observer) if source is None else _open(source, request, bench)
    try:
        return run, method.analyse(CalibrationData(run, bench))
    except LabseqError:
        if observer is not None:
            text = f"no calibration came of it, and what is in use stays; the run is kept: --from {run.path}"
            observer.event("warning", {"text": text})
        raise


def _measure(method: Method, request: CalibrationRequest, aside: str, observer: RunObserver | None) -> Run:
    overrides = [*request.overrides, aside]
    if method.is_blind:
        overrides = [one for one in overrides if not one.lstrip().startswith(_DETECTOR)] + [_BLIND]
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


def _open(source: Path, request: CalibrationRequest, bench: ResolvedProfile) -> Run:
    """Open the run that is to be analysed.

    Raises:
        ConfigError: It is no run, or not one of this profile's sites and devices.
    """
    try:
        run = open_run(source)
    except RecordingError as error:
        raise ConfigError(Problem(str(error), "--from")) from error
    if run.target.shape != bench.grid.shape:
        came = " x ".join(map(str, run.target.shape))
        expected = f"{bench.grid.n_rows} x {bench.grid.n_cols}, as in the profile"
        raise ConfigError(Problem(f"the run has a grid of {came} sites", str(source), expected=expected))
    taken_on = grid_facts(recorded_machine(run.record["resolved"]["profile"], "the profile of the run").grid)
    if not same_grid(taken_on, own := grid_facts(bench.grid)):
        what = f"the run has a grid of {grid_text(taken_on)}"
        raise ConfigError(Problem(what, str(source), expected=f"{grid_text(own)}, as in the profile"))
    if run.simulated != (request.dry_run != "off" or bench.virtual_time):
        what = f"the run was {'simulated' if run.simulated else 'taken with real devices'}"
        expected = (
            f"one {'with real devices' if run.simulated else 'that was simulated'}, as the profile's are"
        )
        hint = "calibrations of dry runs are made with --dry-run" if run.simulated else ""
        raise ConfigError(Problem(what, str(source), expected=expected, hint=hint))
    return run


def _aside(folder: Path, spec: ProfileSpec, method: Method) -> str:
    """The override that lets the method's own kinds, damaged ones perhaps, not count."""
    pins = {kind: spec.calibrations.use.of(kind) for kind in CALIBRATION_KINDS}
    use = {kind: OFF if kind in method.aside else pin for kind, pin in pins.items()}
    chosen = {kind: pin for kind, pin in use.items() if pin is not None}
    text = json.dumps({"folder": str(folder.resolve()), "use": chosen}, ensure_ascii=False)
    return f"profile.calibrations={text}"


def _of_profile(overrides: Sequence[str]) -> list[Override]:
    return split_overrides(overrides)[1]


def _origin(
    method: Method, request: CalibrationRequest, bench: ResolvedProfile, run: Run | None
) -> dict[str, Any]:
    origin: dict[str, Any] = {
        "command": f"labseq calibrate {method.kind}",
        "profile": bench.profile.name,
        "labseq": labseq.__version__,
        "simulated": request.dry_run != "off" or bench.virtual_time,
        "calibrations": {kind: entry.id for kind, entry in bench.calibrations.items()},
    }
    if run is None:
        return {**origin, "file": str(request.source)}
    return {**origin, "run": str(run.path), "n_shots": len(run.shots)}


def _in_use(store: Store, entry: CalibrationEntry) -> CalibrationEntry | None:
    """The entry that it would replace, where the two can be compared."""
    try:
        stored = store.entry_in_use(entry.kind)
    except ConfigError:
        return None
    return stored.entry if stored is not None and same_grid(stored.entry.grid, entry.grid) else None


def _deactivate_overlay(store: Store, entry: CalibrationEntry) -> tuple[str, ...]:
    """Put the overlay aside that new frequencies hold already; what was put aside, in words."""
    overlay = store.active().get("overlay")
    if entry.kind != "frequencies" or overlay is None:
        return ()
    store.use_none("overlay")
    return (f"overlay {overlay.id} is put aside: these frequencies hold what it makes up for",)


def _picture(finding: AnalysisResult) -> tuple[bytes | None, tuple[str, ...]]:
    """The picture as PNG, and why there is none."""
    if finding.draw is None:
        return None, ()
    if not can_draw():
        return None, ("there is no picture: matplotlib is not installed (pip install 'labseq[plot]')",)
    return encode_figure(finding.draw, dpi=PICTURE_DPI), ()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


_ALL: Final[tuple[Method, ...]] = (
    SitesMethod(),
    ThresholdsMethod(),
    TweezersMethod(),
    FrequenciesMethod(),
    OverlayMethod(),
)

METHODS: Final[Mapping[str, Method]] = {method.kind: method for method in _ALL}
"""Kind of calibration -> how it is made."""
