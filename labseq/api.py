"""Makes planners, targets and tone programs by name, without a sequence, for notebooks and scripts."""

from __future__ import annotations

from collections.abc import Sequence
from operator import index
from pathlib import Path
from typing import Any, Final, TypeAlias

from labseq import motion as _motion
from labseq.assembly.calibrations import calibrated_machine
from labseq.assembly.planning import construct_planner
from labseq.assembly.plugin_choice import ChosenPlugin, construct_target, load_plugins
from labseq.config.profile import load_profile
from labseq.config.validation import validate_values
from labseq.errors import ConfigError, Problem
from labseq.model import MotionSpec, Plan, SiteGrid, TargetPattern, ToneProgram
from labseq.registry import Entry
from labseq.roles import Context, Planner

Folders: TypeAlias = str | Path | Sequence[str | Path]
"""A folder, or several."""

MAX_SITES: Final = 1000
"""Maximum number of rows or columns of a grid, as in a profile."""


def make_planner(
    name: str,
    *,
    grid: SiteGrid | tuple[int, int] | None = None,
    motion: MotionSpec | None = None,
    plugin_folders: Folders = (),
    **settings: Any,
) -> Planner:
    """Make a planner by the name that a sequence would use.

    Args:
        name: For example "psca".
        grid: The grid of sites, or its (n_rows, n_cols). Default is the paper's grid.
        motion: How the mobile tweezers move. Default is the paper's motion.
        plugin_folders: Folders with further plugins.
        **settings: The planner's own settings.

    Raises:
        UnknownPluginError: No installed plugin offers it.
        PluginLoadError: Its plugin failed to load, or has a defect.
        ConfigError: A setting is wrong.

    Example:
        >>> planner = make_planner("psca", degree_of_parallelism=7)
    """
    entry = _find("planner", name, plugin_folders)
    values = validate_values(entry.settings_model, settings, f"planner '{name}'")
    if not isinstance(motion, MotionSpec | None):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigError(Problem(f"motion is {motion!r}", expected="a labseq.MotionSpec"))
    return construct_planner(
        ChosenPlugin(entry, values), Context(grid=_grid(grid), motion=motion or MotionSpec())
    )[0]


def make_target(
    pattern: str,
    *,
    grid: SiteGrid | tuple[int, int] = (20, 20),
    plugin_folders: Folders = (),
    **settings: Any,
) -> TargetPattern:
    """Make a target by the name that a sequence would use.

    Args:
        pattern: For example "compact".
        grid: The grid, or its (n_rows, n_cols).
        plugin_folders: Folders with further plugins.
        **settings: The pattern's own settings.

    Raises:
        UnknownPluginError: No installed plugin offers it.
        PluginLoadError: Its plugin failed to load, or has a defect.
        ConfigError: A setting is wrong.
        LimitError: The target does not fit on the grid.

    Example:
        >>> make_target("compact", rows=15, cols=15, grid=(20, 20)).n_atoms
        225
    """
    entry = _find("pattern", pattern, plugin_folders)
    values = validate_values(entry.settings_model, settings, f"pattern '{pattern}'")
    return construct_target(ChosenPlugin(entry, values), _grid(grid))


def tone_program(
    plan: Plan,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    n_batches: int | None = None,
    *,
    profile: str | Path | None = None,
) -> ToneProgram:
    """Turn a checked plan into a tone program. See :func:`labseq.motion.tone_program`.

    Args:
        plan: A plan that :func:`check_plan` accepted.
        grid: The grid of sites. Default is the profile's grid, without a profile that of the paper.
        motion: How the tweezers move. Default is the profile's motion, without a profile that of the paper.
        n_batches: Number of batches to play, from the first. Default is all.
        profile: Name or path of a hardware profile.

    Returns:
        The tones of both axes. ``program.tones_at(t_s)`` gives the intended tones at a time.

    Raises:
        ConfigError: The profile does not exist, or has an error.
        PlanError: The plan does not fit onto the grid, or has fewer batches than asked for.
        LimitError: The tones exceed a limit of AOD or amplifier.

    Example:
        >>> plan = Plan.from_batches([([(0, 0)], [(0, 3)])])
        >>> program = tone_program(plan, profile="virtual")
        >>> program.tones_at(560e-6).column.frequency_hz.tolist()
        [84800000.0]
    """
    if profile is not None:
        document, spec = load_profile(profile)
        profile_grid, profile_motion = calibrated_machine(document, spec)
        grid, motion = grid or profile_grid, motion or profile_motion
    return _motion.tone_program(plan, grid, motion, n_batches)


def _find(kind: str, name: str, folders: Folders) -> Entry:
    if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigError(Problem(f"the name of the {kind} is {name!r}", expected="text"))
    paths = (folders,) if isinstance(folders, str | Path) else folders
    return load_plugins([Path(path) for path in paths]).get(kind, name)


def _grid(grid: SiteGrid | tuple[int, int] | None) -> SiteGrid:
    """The grid for a size.

    Raises:
        ConfigError: It is not the size of a grid.
    """
    if grid is None or isinstance(grid, SiteGrid):
        return grid or SiteGrid()
    try:
        n_rows, n_cols = map(index, grid)
    except (TypeError, ValueError):
        n_rows = n_cols = 0
    if not (1 <= n_rows <= MAX_SITES and 1 <= n_cols <= MAX_SITES):
        expected = f"a labseq.SiteGrid or (n_rows, n_cols), each from 1 to {MAX_SITES}"
        raise ConfigError(Problem(f"grid is {grid!r}", expected=expected))
    return SiteGrid(n_rows, n_cols)
