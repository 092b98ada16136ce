"""The record that a run starts with: settings, code versions, host and installed packages."""

from __future__ import annotations

import functools
import getpass
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import labseq
from labseq.assembly.options import NOT_SET
from labseq.calibration_store import encode_entry
from labseq.config.addresses import PROFILE, find
from labseq.errors import ConfigError, Loc, StopRequested
from labseq.messages import format_error
from labseq.model import CalibrationEntry, RunRecord
from labseq.model.records import RunStatus, unique_names
from labseq.plain import now_utc
from labseq.plugins.host import name_and_version
from labseq.recording.folders import NOTES_FILE
from labseq.settings import si_unit_at
from labseq.units import si_unit_of

if TYPE_CHECKING:
    from labseq.assembly.assemble import Assembly
    from labseq.registry import Entry

_GIT_TIMEOUT_S: Final = 5.0


class Setting(NamedTuple):
    """A value as it is recorded.

    Attributes:
        value: SI, JSON-ready.
        unit: SI unit; "" for none.
        written: As it was typed.
    """

    value: Any
    unit: str
    written: str


def gather_provenance(sequence_folder: Path) -> dict[str, Any]:
    """Collect versions, git commits, host and packages, which identify the code that made the data.

    Args:
        sequence_folder: Folder of the sequence; its repository is recorded in addition to
            that of labseq's own code.

    Returns:
        JSON-ready values: labseq, python, platform, host, user, git (of the code
        and of the sequence, with whether uncommitted changes were there), packages.
    """
    with ThreadPoolExecutor(2) as threads:  # git takes longer than the rest of this function
        code = threads.submit(git_state, Path(labseq.__file__).parent, of="__init__.py")
        sequence = threads.submit(git_state, sequence_folder)
        packages = dict(_packages())
    return {
        "labseq": labseq.__version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "host": platform.node(),
        "user": _user(),
        "pid": os.getpid(),
        "git": {"code": code.result(), "sequence": sequence.result()},
        "packages": packages,
    }


def git_state(folder: Path, of: str = "") -> dict[str, Any] | None:
    """Commit of the repository that a folder is in, and how tracked files differ from it.

    Args:
        of: A file in it that must be tracked by the repository. A package installed in an
            environment inside a repository is not part of that repository.

    Returns:
        ``{"commit": str, "dirty": bool, "code_sha256": str}``, or None outside of a repository or
        where git is not installed. ``dirty`` is whether any tracked file differs; ``code_sha256``
        is the digest of the changes to Python files, "" if there are none.
    """
    if of and _git(folder, "ls-files", "--error-unmatch", of) is None:
        return None
    lines = (_git(folder, "status", "--porcelain=v2", "--branch", "--untracked-files=no") or "").splitlines()
    commit = next((line.split()[-1] for line in lines if line.startswith("# branch.oid")), "(initial)")
    if commit == "(initial)":
        return None
    changes = [line for line in lines if not line.startswith("#")]
    code = _git(folder, "diff", "--no-ext-diff", "--no-color", "HEAD", "--", ":(top)*.py") if changes else ""
    digest = hashlib.sha256(code.encode()).hexdigest() if code else ""
    return {"commit": commit, "dirty": bool(changes), "code_sha256": digest}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, no shell
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],  # noqa: S607 - the user's own git
            capture_output=True,
            check=True,
            timeout=_GIT_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode(errors="replace").strip()


@functools.cache
def _packages() -> dict[str, str]:
    """Name -> version of each installed package; read only once, because it takes as long as a short shot."""
    packages = [name_and_version(distribution) for distribution in distributions()]
    return {name: version for name, version in packages if name}


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""


def run_record(assembly: Assembly, seed: int, changes: Mapping[str, str], folder: Path) -> RunRecord:
    """The record of a run before anything is opened.

    Args:
        changes: Changes by options, as they were typed: address -> value.
        folder: The working folder, absolute: relative paths in the settings are relative to it.
    """
    spec, hardware = assembly.sequence, assembly.hardware
    changed = {address: _setting(assembly, address, text) for address, text in changes.items()}
    scanned = () if assembly.scanned is None else assembly.scanned.at(0).parameters
    at_points = {address: _setting(assembly, address) for address in scanned}
    return RunRecord(
        name=spec.name,
        n_shots=spec.shots,
        seed=seed,
        simulated=assembly.virtual_time,
        t_start_utc=now_utc(),
        target=assembly.target,
        sequence_text=assembly.document.text,
        profile_text=hardware.document.text,
        sequence_path=str(folder / assembly.document.path),
        profile_path=str(folder / hardware.document.path),
        resolved=assembly.resolved,
        overrides={address: setting._asdict() for address, setting in changed.items()},
        units={address: one.unit for address, one in (changed | at_points).items() if one.unit},
        devices={},
        plugins=plugins_of(assembly),
        provenance=gather_provenance((folder / assembly.document.path).parent) | {"folder": str(folder)},
        record_frames=spec.record_frames,
        grid_spacing_m=hardware.grid.spacing_m,
        lattice=hardware.grid.lattice,
        scan=assembly.scan_record(seed),
        steps=unique_names([name for name, _ in assembly.steps]),
        calibrations={kind: entry.id for kind, entry in hardware.calibrations.items()},
    )


def _setting(assembly: Assembly, address: str, written: str = "") -> Setting:
    """A setting of the run, after defaults and overrides; the scan is at its first point.

    Args:
        assembly: The run.
        address: Its address; "profile." for one in the profile.
        written: What was typed for it: taken if the record has no such setting.
    """
    if address in NOT_SET:
        return Setting(written, "", written)
    of_profile = address.startswith(PROFILE)
    document = assembly.hardware.document if of_profile else assembly.document
    try:
        loc = find(document.root, address.removeprefix(PROFILE))
        value: Any = assembly.resolved["profile"] if of_profile else assembly.resolved
        for key in loc:
            value = value[key]
    except (ConfigError, LookupError, TypeError):  # a setting that is written and not used
        return Setting(written, "", written)
    return Setting(value, _unit(assembly, loc, of_profile=of_profile) or si_unit_of(written), written)


def _unit(assembly: Assembly, loc: Loc, *, of_profile: bool) -> str:
    """SI unit of a setting of a plugin or of the core; "" if it has none."""
    core = type(assembly.hardware.profile if of_profile else assembly.sequence)
    entry, n_keys = (_plugin_of_profile if of_profile else _plugin_of_sequence)(assembly, loc)
    return (entry and si_unit_at(entry.settings_model, loc[n_keys:])) or si_unit_at(core, loc)


def _plugin_of_profile(assembly: Assembly, loc: Loc) -> tuple[Entry | None, int]:
    """The plugin that a setting of the profile belongs to, and how many keys lead to its settings."""
    n_keys = 2 if loc[0] == "devices" else 1
    chosen = assembly.hardware.chosen.get(str(loc[:n_keys][-1]))
    return chosen and chosen.entry, n_keys


def _plugin_of_sequence(assembly: Assembly, loc: Loc) -> tuple[Entry | None, int]:
    """The same of a setting of the sequence."""
    registry, target = assembly.hardware.host.registry, assembly.sequence.target
    match loc:
        case ("planner", *_):
            return assembly.planner.entry, 1
        case ("target", *_) if target is not None:
            return registry.find("pattern", target.use), 1
        case ("shot", _, kind, *_):
            return registry.find("step", str(kind)), 3
        case _:
            return None, 0


def copies(calibrations: Mapping[str, CalibrationEntry]) -> dict[str, bytes | str]:
    """The active calibrations as files for the run's folder: file name -> content."""
    return {f"calibration_{kind}.json": encode_entry(entry) for kind, entry in calibrations.items()}


def notes_file(note: str, tags: Sequence[str]) -> dict[str, bytes | str]:
    """The note about a run and its tags as a file for the run's folder; {} without any.

    Raises:
        ConfigError: One is too long.
    """
    if not (note or tags):
        return {}
    from labseq.recording.notes import Notes

    return {NOTES_FILE: Notes.of(note, tags).encoded()}


def ending(error: BaseException | None) -> tuple[RunStatus, str]:
    """The status in which a run ended, and the reason."""
    if error is None:
        return "complete", ""
    if isinstance(error, StopRequested):
        return "stopped", str(error)
    status: RunStatus = "stopped" if isinstance(error, KeyboardInterrupt) else "failed"
    return status, format_error(error)


def plugins_of(assembly: Assembly) -> tuple[dict[str, str], ...]:
    """Name, origin and version of each plugin that a run uses."""
    used = [*assembly.hardware.chosen.values(), assembly.planner]
    used += [] if assembly.search is None else [assembly.search.chosen]
    origins = {item.entry.origin for item in used}
    return tuple(
        {"name": info.name, "origin": info.origin, "version": info.version}
        for info in assembly.hardware.host.infos
        if info.name in origins
    )
