"""Reads settings, plugins, calibrations and grid of a recorded run from its folder."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

from labseq.assembly.plugin_choice import load_plugins
from labseq.calibration_store import read_entry
from labseq.config.document import StoredText
from labseq.config.profile import GridSettings
from labseq.config.validation import validate_values
from labseq.data.lab_models import plugin_folders_of
from labseq.data.reader import Run
from labseq.data.shot import Shot
from labseq.errors import RecordingError
from labseq.files import read_file
from labseq.model import CalibrationEntry, MotionSpec, RandomStream, SiteGrid
from labseq.plugins.host import PluginHost
from labseq.recording.folders import PROFILE_FILE, RUN_FILE, SEQUENCE_FILE
from labseq.recording.run_file import sha256_of_text
from labseq.roles import Context
from labseq.settings import settings_of


def resolved_of(run: Run) -> dict[str, Any]:
    """Every setting of a run, SI. For a scan, at its first point.

    Raises:
        RecordingError: run.json lacks them.
    """
    resolved: Any = run.record.get("resolved")
    if not (isinstance(resolved, dict) and isinstance(resolved.get("profile"), dict)):
        raise RecordingError(run.path / RUN_FILE, "does not contain the settings of the run")
    return cast("dict[str, Any]", resolved)


def stored_text(path: Path, sha256: str) -> StoredText:
    """The text of a file in a run's folder.

    Args:
        sha256: SHA-256 of the file when the run began.

    Raises:
        RecordingError: The file is missing or has been changed.
    """
    # as encode_text wrote it, because comments in the file may contain bytes that are not UTF-8
    text = read_file(path).decode("utf-8", "surrogateescape")
    if sha256_of_text(text) != sha256:
        raise RecordingError(path, f"is not the file described in {RUN_FILE}", "restore it from a backup")
    return StoredText(text, str(path))


class RecordedFiles(NamedTuple):
    """The files and calibrations with which a run began, to assemble it again.

    Attributes:
        sequence_path: Original path of the sequence. Paths in it are relative to this.
        sequence: Its text.
        profile_path: Original path of the profile.
        profile: Its text.
        calibrations: Kind -> id of the only active calibrations. None for the calibrations in use today.
    """

    sequence_path: Path
    sequence: StoredText
    profile_path: Path
    profile: StoredText
    calibrations: Mapping[str, str] | None


def files_of(run: Run) -> RecordedFiles:
    """The files and calibrations with which a run began, from the copies in its folder.

    Raises:
        RecordingError: A copy is missing or has been changed.
    """
    record = run.record
    sequence = stored_text(run.path / SEQUENCE_FILE, record["sequence_sha256"])
    profile = stored_text(run.path / PROFILE_FILE, record["profile_sha256"])
    paths = Path(record["sequence_path"]), Path(record["profile_path"])
    return RecordedFiles(paths[0], sequence, paths[1], profile, record.get("calibrations", {}))


def plugins_of(run: Run) -> PluginHost:
    """The installed plugins, and the plugins from a run's own folders.

    Raises:
        ConfigError: A folder no longer exists.
        RecordingError: run.json lacks the plugin folders.
    """
    resolved_of(run)  # raises if run.json lacks the settings
    return load_plugins(plugin_folders_of(run))


def calibrations_of(run: Run) -> dict[str, CalibrationEntry]:
    """The calibrations of a run, from the copies in its folder: kind -> entry.

    Raises:
        ConfigError: A copy is missing or damaged.
        RecordingError: A copy is not the calibration with which the run was taken.
    """
    entries: dict[str, CalibrationEntry] = {}
    for kind, own in cast("Mapping[str, str]", run.record.get("calibrations") or {}).items():
        path = run.path / f"calibration_{kind}.json"
        entries[kind] = read_entry(path)
        if entries[kind].id != own:
            text = f"is calibration {entries[kind].id}, but the run was taken with {own}"
            raise RecordingError(path, text, "restore that calibration from a backup")
    return entries


@dataclass(frozen=True, slots=True)
class Machine:
    """The grid of sites and the motion of the mobile tweezers."""

    grid: SiteGrid
    motion: MotionSpec


def recorded_machine(machine: Mapping[str, Any], called: str) -> Machine:
    """Grid and motion of a recorded run, with calibrated tones.

    Raises:
        ConfigError: The recorded profile is invalid.
    """
    tweezers = machine.get("mobile_tweezers", {})
    keys = [setting.key for setting in settings_of(MotionSpec)]
    motion = {key: tweezers[key] for key in keys if key in tweezers}
    return Machine(
        validate_values(GridSettings, machine.get("grid", {}), called).model(),
        validate_values(MotionSpec, motion, called),
    )


def profile_of_shot(resolved: Mapping[str, Any], parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The profile of a shot, which is the run's profile at the shot's own point of a scan.

    Args:
        resolved: Every setting of the run, SI. For a scan, at its first point.
        parameters: Settings of the shot: address -> value, SI.

    Example:
        >>> resolved = {"profile": {"mobile_tweezers": {"speed": 0.08}}}
        >>> profile_of_shot(resolved, {"shots": 3, "profile.mobile_tweezers.speed": 0.13})
        {'mobile_tweezers': {'speed': 0.13}}
    """
    settings = deepcopy(dict(resolved))
    for address, value in parameters.items():
        *parts, name = address.split(".")
        part: Any = settings
        for key in parts:
            part = part.get(key) if isinstance(part, dict) else None
        if parts[:1] == ["profile"] and isinstance(part, dict) and name in part:
            part[name] = value
    return settings["profile"]


def machine_of_shot(shot: Shot) -> Machine:
    """Grid and motion of a recorded shot, with calibrated tones.

    Raises:
        ConfigError: The recorded settings are invalid.
        RecordingError: The shot's file is damaged, or has no settings.
    """
    resolved: Any = shot.provenance["resolved"]
    if not (isinstance(resolved, dict) and isinstance(cast("Any", resolved).get("profile"), dict)):
        raise RecordingError(shot.file, "does not contain the settings of the shot")
    profile = profile_of_shot(cast("dict[str, Any]", resolved), shot.parameters)
    return recorded_machine(profile, "the profile in the shot's file")


def machine_of(run: Run) -> Machine:
    """Grid and motion of a run, with calibrated tones. For a scan, at its first point.

    Raises:
        ConfigError: The recorded settings are invalid.
        RecordingError: run.json lacks the settings.
    """
    return recorded_machine(resolved_of(run)["profile"], str(run.path / RUN_FILE))


def context_of(run: Run, name: str) -> Context:
    """The context of a plugin that evaluates a recorded run.

    Raises:
        ConfigError: The recorded settings are invalid, or a calibration is missing.
        RecordingError: run.json lacks settings.
    """
    machine, stream = machine_of(run), RandomStream(run.seed, name)
    return Context(name, machine.grid, machine.motion, random=stream, calibrations=calibrations_of(run))
