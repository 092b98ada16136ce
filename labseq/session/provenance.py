"""The initial record of a run, with settings, code versions, host and installed packages."""

from __future__ import annotations

import functools
import getpass
import os
import platform
import sys
from collections.abc import Collection, Mapping
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import labseq
from labseq.assembly.options import NOT_SET
from labseq.config.addresses import PROFILE, find
from labseq.errors import ConfigError, Loc
from labseq.model import RunRecord
from labseq.model.records import unique_names
from labseq.plain import now_utc
from labseq.plugins.host import name_and_version
from labseq.session.sources import RunCode, gather_code
from labseq.settings import si_unit_at
from labseq.units import si_unit_of

if TYPE_CHECKING:
    from labseq.assembly.assemble import Assembly
    from labseq.registry import Entry


class Setting(NamedTuple):
    """A value as it is recorded.

    Attributes:
        value: The value in SI, JSON-ready.
        unit: SI unit, or "" for none.
        written: The value as it was typed.
    """

    value: Any
    unit: str
    written: str


def gather_provenance(git: Mapping[str, Any]) -> dict[str, Any]:
    """Collect versions, git commits, host and packages, which identify the code that made the data.

    Args:
        git: States of the repositories of labseq's own code and of the sequence.

    Returns:
        JSON-ready values of labseq, python, platform, host, user, git and packages.
    """
    return {
        "labseq": labseq.__version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "host": platform.node(),
        "user": _user(),
        "pid": os.getpid(),
        "git": git,
        "packages": dict(_packages()),
    }


@functools.cache
def _packages() -> dict[str, str]:
    """Name -> version of each installed package. Read only once, because it takes as long as a short shot."""
    packages = [name_and_version(distribution) for distribution in distributions()]
    return {name: version for name, version in packages if name}


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""


def code_of(assembly: Assembly, folder: Path, also: Collection[str] = ()) -> RunCode:
    """The code of a run. ``folder`` is the working folder. For ``also`` see :func:`gather_code`."""
    return gather_code(assembly.hardware.host, (folder / assembly.document.path).parent, also)


def run_record(
    assembly: Assembly, seed: int, changes: Mapping[str, str], folder: Path, code: RunCode
) -> RunRecord:
    """The record of a run before anything is opened.

    Args:
        changes: Changes by options, as they were typed, address -> value.
        folder: The absolute working folder, to which relative paths in the settings refer.
        code: Its code.
    """
    spec, hardware = assembly.sequence, assembly.hardware
    changed = {address: _setting(assembly, address, text) for address, text in changes.items()}
    points = assembly.scanned or assembly.led
    scanned = () if points is None else points.at(0).parameters
    at_points = {address: _setting(assembly, address) for address in scanned}
    units = {address: one.unit for address, one in (changed | at_points).items() if one.unit}
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
        units=units,
        devices={},
        plugins=code.plugins,
        provenance=gather_provenance(code.git) | {"folder": str(folder)},
        record_frames=spec.record_frames,
        grid_spacing_m=hardware.grid.spacing_m,
        lattice=hardware.grid.lattice,
        scan=assembly.scan_record(seed) if assembly.led is None else assembly.led.record(units),
        steps=unique_names([name for name, _ in assembly.steps]),
        calibrations={kind: entry.id for kind, entry in hardware.calibrations.items()},
    )


def _setting(assembly: Assembly, address: str, written: str = "") -> Setting:
    """A setting of the run, after defaults and overrides, at the first point of a scan.

    Args:
        assembly: The run.
        address: Its address, which begins with "profile." for a setting of the profile.
        written: Its value as typed, used if the record has no such setting.
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
    except (ConfigError, LookupError, TypeError):  # a setting that is written but not used
        return Setting(written, "", written)
    return Setting(value, _unit(assembly, loc, of_profile=of_profile) or si_unit_of(written), written)


def _unit(assembly: Assembly, loc: Loc, *, of_profile: bool) -> str:
    """SI unit of a setting of a plugin or of the core, or "" if it has none."""
    core = type(assembly.hardware.profile if of_profile else assembly.sequence)
    entry, n_keys = (_plugin_of_profile if of_profile else _plugin_of_sequence)(assembly, loc)
    # a mapping of a plugin may hold keys of the core, such as `lines.channels`
    return (entry and si_unit_at(entry.settings_model, loc[n_keys:])) or si_unit_at(core, loc)


def _plugin_of_profile(assembly: Assembly, loc: Loc) -> tuple[Entry | None, int]:
    """The plugin that a setting of the profile belongs to, and how many keys lead to its settings."""
    n_keys = 2 if loc[0] == "devices" else 1
    chosen = assembly.hardware.chosen.get(str(loc[:n_keys][-1]))
    return chosen and chosen.entry, n_keys


def _plugin_of_sequence(assembly: Assembly, loc: Loc) -> tuple[Entry | None, int]:
    """The plugin that a setting of the sequence belongs to, and how many keys lead to its settings."""
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
