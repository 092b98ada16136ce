"""Planners and targets by name, without a sequence: for notebooks and scripts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from labseq.config.values import validate_values
from labseq.model import MotionSpec, SiteGrid, TargetPattern
from labseq.roles import Context, Planner
from labseq.session import load_plugins


def make_planner(
    name: str,
    *,
    grid: SiteGrid | None = None,
    motion: MotionSpec | None = None,
    plugin_folders: tuple[str | Path, ...] = (),
    **settings: Any,
) -> Planner:
    """Make a planner by the name that a sequence would use.

    Args:
        name: For example "psca".
        grid: The grid of sites; the paper's by default.
        motion: How the mobile tweezers move; the paper's by default.
        plugin_folders: Folders with further plugins.
        **settings: The planner's own settings.

    Raises:
        UnknownPluginError: No installed plugin offers it.
        ConfigError: A setting is wrong.

    Example:
        >>> planner = make_planner("psca", degree_of_parallelism=7)
    """
    entry = load_plugins([Path(folder) for folder in plugin_folders]).get("planner", name)
    made = validate_values(entry.settings_model, settings, f"planner '{name}'")
    return entry.factory(made, Context("planner", grid or SiteGrid(), motion or MotionSpec()))


def make_target(
    pattern: str,
    *,
    grid: SiteGrid | tuple[int, int] = (20, 20),
    plugin_folders: tuple[str | Path, ...] = (),
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
        ConfigError: A setting is wrong.
        LimitError: The target does not fit on the grid.

    Example:
        >>> make_target("compact", rows=15, cols=15, grid=(20, 20)).n_atoms
        225
    """
    entry = load_plugins([Path(folder) for folder in plugin_folders]).get("pattern", pattern)
    made = validate_values(entry.settings_model, settings, f"pattern '{pattern}'")
    return entry.factory(made, grid if isinstance(grid, SiteGrid) else SiteGrid(*grid))
