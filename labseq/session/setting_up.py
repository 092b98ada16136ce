"""From the name of a profile to a bench: its plugins found and chosen, nothing opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from labseq import builtins
from labseq.config import (
    ROLES,
    Choice,
    ProblemCollector,
    Document,
    StoredText,
    Override,
    ProfileSpec,
    Scan,
    load_profile,
    plugin_paths,
)
from labseq.errors import ConfigError
from labseq.plugins import PluginHost
from labseq.registry import LOAD_S, VIRTUAL_TWIN
from labseq.session.calibrating import ActiveCalibrations, calibrated
from labseq.session.choosing import ResolvedProfile, ChosenPlugin, DryRun, choose
from labseq.session.wiring import check_kinds


class RecordedSetup(NamedTuple):
    """What a run goes by that was begun before, whatever files and calibrations say today.

    Attributes:
        profile: The text of the profile.
        calibrations: The ids of the calibrations, by kind, and no others.
    """

    profile: StoredText
    calibrations: Mapping[str, str]


def resolve_profile(
    profile: str | Path,
    beside: Path = Path(),
    overrides: Sequence[Override] = (),
    dry_run: DryRun = "off",
    *,
    named_in: Document | None = None,
    plugin_folders: Sequence[Path] = (),
    scan: Scan | None = None,
    found: ProblemCollector | None = None,
    again: RecordedSetup | None = None,
) -> ResolvedProfile:
    """Read a profile, load the plugins and choose what plays each role.

    Args:
        profile: Name or path of the profile.
        beside: Folder of the file that names it.
        overrides: Values that replace those of the file.
        dry_run: "off", "full" or "fast".
        named_in: The sequence that names the profile, for messages.
        plugin_folders: Folders with plugins beside those that the profile names.
        scan: The sequence's scan; the profile's values are those of its first point.
        found: Where the problems of a profile that can be read go; without it they are raised.
        again: The profile's text and calibrations, if the run was begun before.

    Raises:
        ConfigError: The profile is wrong.
        PluginLoadError: A plugin that it names failed to load.
    """
    document, spec = load_profile(
        profile,
        beside=beside,
        overrides=overrides,
        named_in=named_in,
        scan=scan,
        found=found,
        kept=None if again is None else again.profile,
    )
    folders = [*plugin_paths(document, spec.plugin_folders), *plugin_folders]
    host = load_plugins(folders, max_wait_s=spec.timeouts.load)
    problems = ProblemCollector() if found is None else found
    pins = None if again is None else again.calibrations
    bench = choose_plugins(document, spec, host, dry_run, problems, pins)
    if found is None:
        problems.raise_any()
    return bench


def choose_plugins(
    document: Document,
    spec: ProfileSpec,
    host: PluginHost,
    dry_run: DryRun,
    found: ProblemCollector,
    calibrations: Mapping[str, str] | None = None,
) -> ResolvedProfile:
    """Choose what plays each role of a profile.

    Args:
        document: The profile's file.
        spec: What it says; stand-ins for what was wrong, if anything was found.
        host: The plugins.
        dry_run: "off", "full" or "fast".
        found: Where the problems go.
        calibrations: The ids of those that count, by kind; None for what profile and store say.
    """
    mended = bool(found.problems)
    chosen: dict[str, ChosenPlugin] = {}
    warnings: list[str] = []
    refused: dict[str, ConfigError] = {}
    for role, choice in {**spec.choices, **spec.devices}.items():
        kind = role if role in ROLES else "device"
        if mended and _is_stand_in(document, choice):
            refused[role] = ConfigError("what the profile says of it is wrong")
            continue
        try:
            chosen[role], warning = choose(host, document, kind, choice, dry_run)
            warnings += [f"{role}: {warning}"] if warning else []
        except ConfigError as error:
            refused[role] = error
            found.add(error)
    check_kinds(document, spec, host, found)
    detector = chosen["detector"].dump() if "detector" in chosen else {}
    made = (
        ActiveCalibrations({}, spec.grid_model())
        if mended
        else calibrated(document, spec, found, dry_run, detector, calibrations)
    )
    warnings += made.warnings
    return ResolvedProfile(document, spec, host, made.grid, chosen, tuple(warnings), refused, made.entries)


def _is_stand_in(document: Document, choice: Choice) -> bool:
    """Whether nobody wrote this, in a profile of which something was wrong: it has no place of its own."""
    here, around = document.locate(choice.loc), document.locate(choice.loc[:-1])
    return choice.use == VIRTUAL_TWIN and here == around


def load_plugins(
    folders: Sequence[Path] = (), found: ProblemCollector | None = None, max_wait_s: float = LOAD_S
) -> PluginHost:
    """Load labseq's own, the installed and the folders' plugins.

    Args:
        folders: Folders with plugins, beside those of LABSEQ_PLUGIN_PATH.
        found: Where the problem of a folder that cannot be read goes; without it it is raised.
        max_wait_s: How long a plugin may take to load, and a constructor to return.

    Raises:
        ConfigError: A folder does not exist, or cannot be read.
    """
    host = PluginHost(max_wait_s)
    host.load_builtin(builtins)
    host.load_entry_points()
    try:
        host.load_folders(folders)
    except ConfigError as error:
        if found is None:
            raise
        found.add(error)
    return host
