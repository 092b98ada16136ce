"""Finds, checks and applies the calibrations that a profile uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from labseq.calibration_store import Activation, Store, Stored, check_grid
from labseq.config.document import Document
from labseq.config.profile import OFF, ProfileSpec, load_profile
from labseq.errors import ConfigError, LimitError, ProblemCollector
from labseq.files import profile_dir
from labseq.model import CALIBRATION_KINDS, CalibrationEntry, CalibrationKind, MotionSpec, SiteGrid
from labseq.model.calibration import correct_overlay
from labseq.registry import VIRTUAL_TWIN

if TYPE_CHECKING:
    from labseq.assembly.options import DryRun

FOLDER: Final = "calibrations"


DRY_RUN_FOLDER: Final = "dry-run"
"""Folder of dry runs in a store, because calibrations of simulated atoms are not valid for real atoms."""


BASIS: Final[Mapping[CalibrationKind, CalibrationKind]] = {"overlay": "frequencies", "thresholds": "sites"}
"""Kind -> the kind of calibration with which it was measured, and without which it is invalid."""


PLACES: Final = frozenset({"threshold", "width", "sites", "frame", "centre_px", "angle"})
"""Detector settings that do not change the signals compared with thresholds if sites are calibrated."""


class ActiveCalibrations(NamedTuple):
    """A profile's calibrations by kind, the grid with calibrated tones, and warnings for the user."""

    entries: Mapping[str, CalibrationEntry]
    grid: SiteGrid
    warnings: tuple[str, ...] = ()


def store_of(document: Document, profile: ProfileSpec, dry_run: DryRun = "off") -> Store:
    """The folder of calibrations of a profile.

    Args:
        dry_run: "off", "full" or "fast". A profile with only virtual devices uses the same store in a dry
            run.
    """
    folder = profile.calibrations.folder or profile_dir(document.path) / FOLDER / document.path.stem
    choices = [profile.camera, profile.static_tweezers, profile.mobile_tweezers, *profile.devices.values()]
    is_other = dry_run != "off" and any(not choice.use.startswith(VIRTUAL_TWIN) for choice in choices)
    return Store(Path(folder) / DRY_RUN_FOLDER if is_other else Path(folder))


def open_store(profile: str, dry_run: DryRun = "off") -> tuple[Store, ProfileSpec]:
    """The folder of calibrations of a profile, and the content of the profile.

    Raises:
        ConfigError: The profile has an error, or does not exist.
    """
    document, spec = load_profile(profile)
    return store_of(document, spec, dry_run), spec


def calibrated(
    document: Document,
    profile: ProfileSpec,
    problems: ProblemCollector,
    dry_run: DryRun = "off",
    detector: Mapping[str, Any] | None = None,
    pins: Mapping[str, str] | None = None,
) -> ActiveCalibrations:
    """Read the calibrations that a profile uses, and apply the calibrations of the tones.

    Args:
        problems: Receives the problems. A calibration with a problem is not used.
        detector: Settings of the detector in use, for the record. None if they do not matter.
        pins: Kind -> id of the only calibrations to use. None for the calibrations of profile and store.
    """
    grid, store = profile.grid_model(), store_of(document, profile, dry_run)
    entries: dict[str, CalibrationEntry] = {}
    active: Mapping[str, Activation] = {}
    if pins is None and any(profile.calibrations.use.of(kind) is None for kind in CALIBRATION_KINDS):
        try:
            active = store.active()
        except ConfigError as error:  # reported once, not for each kind
            problems.add(error)
            return ActiveCalibrations(entries, grid)
    for kind in CALIBRATION_KINDS:
        with problems:  # a damaged calibration must not prevent the check of the others
            if pins is None:
                stored = _chosen(document, profile, store, kind, active.get(kind))
            else:
                stored = store.find(pins[kind], kind) if kind in pins else None
            if stored is not None:
                check_grid(stored.entry, grid, str(stored.path))
                entries[kind] = stored.entry
    # before the tones, because an overlay that is left out must not move them
    warnings = [*_dropped(entries), *_doubtful(entries, detector or {})]
    tones = grid
    with problems:
        tones = _with_tones(document, grid, entries)
    return ActiveCalibrations(entries, tones, tuple(warnings))


def calibrated_machine(document: Document, profile: ProfileSpec) -> tuple[SiteGrid, MotionSpec]:
    """The grid and the motion of a profile with calibrated tones.

    Raises:
        ConfigError: A calibration in use is missing or damaged.
    """
    problems = ProblemCollector()
    active = calibrated(document, profile, problems)
    problems.raise_any()
    return active.grid, with_calibrations(profile.motion, active.entries)


def with_calibrations(motion: MotionSpec, entries: Mapping[str, CalibrationEntry]) -> MotionSpec:
    """Apply the calibrated amplitudes of the mobile tweezers' tones, and the time before the first batch."""
    if (timing := entries.get("timing")) is not None:
        motion = replace(motion, overhead_per_cycle_s=float(timing.values["overhead_s"][0]))
    if (entry := entries.get("amplitudes")) is None:
        return motion
    rows, columns = (tuple(entry.values[f"{axis}_amplitudes"].tolist()) for axis in ("row", "column"))
    return replace(motion, rf=replace(motion.rf, row_amplitudes=rows, column_amplitudes=columns))


def _chosen(
    document: Document,
    profile: ProfileSpec,
    store: Store,
    kind: CalibrationKind,
    active: Activation | None,
) -> Stored | None:
    """The entry of a kind that the profile uses. ``active`` is the store's entry in use.

    Raises:
        ConfigError: The entry is missing or damaged.
    """
    pin = profile.calibrations.use.of(kind)
    if pin == OFF:
        return None
    try:
        if pin is not None:
            return store.find(pin, kind)
        return None if active is None else store.entry_of(active)
    except ConfigError as error:
        where = document.problem(("calibrations", "use", kind), "").source
        note = (
            f"it is the calibration '{kind}' in use; "
            f"'labseq calibration use {kind}=off --profile {quote(document.name)}' turns it off"
            if pin is None
            else f"it is chosen by the key 'calibrations.use.{kind}' of {where}"
        )
        raise ConfigError([replace(one, notes=(*one.notes, note)) for one in error.problems]) from error


def why_left_out(entry: CalibrationEntry, entries: Mapping[str, CalibrationEntry]) -> str:
    """The reason why runs ignore a calibration although it is in use, or "" if they use it.

    Args:
        entry: The calibration.
        entries: Kind -> the other calibrations in use.
    """
    if entry.kind != "overlay" or _has_basis(entry, entries):
        return ""
    return "it was measured with other frequencies of the mobile tweezers"


def _dropped(entries: dict[str, CalibrationEntry]) -> list[str]:
    """Leave out an overlay calibration that was measured with other tone frequencies."""
    overlay = entries.get("overlay")
    if overlay is None or not (reason := why_left_out(overlay, entries)):
        return []
    del entries["overlay"]
    return [f"calibration overlay {overlay.id} is not used: {reason}; measure it again"]


def _doubtful(entries: Mapping[str, CalibrationEntry], detector: Mapping[str, Any]) -> list[str]:
    """Warnings about calibrations in use that should be measured again."""
    thresholds = entries.get("thresholds")
    if thresholds is None:
        return []
    what = f"calibration thresholds {thresholds.id} was measured with"
    doubts = [] if _has_basis(thresholds, entries) else [f"{what} other sites; measure it again"]
    then = thresholds.origin.get("detector")
    if isinstance(then, dict) and then.get("use") == detector.get("use"):
        other = [
            key for key, value in detector.items() if key not in PLACES and then.get(key, value) != value
        ]
        if other:
            doubts.append(f"{what} another {', '.join(other)} of the detector; measure it again")
    return doubts


def _has_basis(entry: CalibrationEntry, entries: Mapping[str, CalibrationEntry]) -> bool:
    """Whether the calibration that an entry was measured with is in use."""
    basis = BASIS[entry.kind]
    now = entries[basis].id if basis in entries else None
    then = entry.origin.get("calibrations")
    return (then.get(basis) if isinstance(then, dict) else None) == now


def _with_tones(document: Document, grid: SiteGrid, entries: Mapping[str, CalibrationEntry]) -> SiteGrid:
    """Apply the frequencies to a grid, then the overlay.

    Raises:
        ConfigError: A tone is invalid.
    """
    if (frequencies := entries.get("frequencies")) is not None:
        row_hz, column_hz = frequencies.values["row_hz"], frequencies.values["column_hz"]
        grid = replace(grid, row_frequency_hz=row_hz, column_frequency_hz=column_hz)
    if (overlay := entries.get("overlay")) is not None:  # second, as it was measured with these frequencies
        try:
            grid = correct_overlay(grid, overlay.values["offset_m"])
        except LimitError as error:
            raise document.error(("calibrations",), f"calibration overlay {overlay.id}: {error}") from error
    return grid
