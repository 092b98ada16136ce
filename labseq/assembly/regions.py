"""Named regions of a sequence, which are sets of sites for its quantities."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from labseq.assembly.plugin_choice import construct_target, resolve
from labseq.assembly.profile import ResolvedProfile
from labseq.config.document import Document
from labseq.errors import LabseqError, Loc, PluginLoadError
from labseq.messages import clean
from labseq.model import Occupancy, TargetPattern
from labseq.model.image_quantities import mask_of
from labseq.settings import PatternChoice


def with_regions(
    target: TargetPattern, hardware: ResolvedProfile, document: Document, regions: dict[str, Any]
) -> TargetPattern:
    """A copy of a target with the regions of its sequence.

    Args:
        target: The target.
        hardware: The profile, with the grid and the plugins.
        document: The sequence's file.
        regions: Name -> rows and columns as text, a list of sites, or a pattern.

    Raises:
        ConfigError: A region has no sites, or has sites beyond the grid. The message names the first.
    """
    for name, written in regions.items():
        loc: Loc = ("regions", name)
        if isinstance(written, dict):
            mask = _pattern(hardware, document, loc)
        elif isinstance(written, str):
            mask = _rows_and_columns(document, loc, written, target)
        else:
            mask = _listed(document, loc, written, target.shape)
        if not mask.any():
            raise document.error(loc, f"the region '{clean(name)}' has no sites", "at least one site")
        target = replace(target, regions={**target.regions, name: mask})
    return target


def _pattern(hardware: ResolvedProfile, document: Document, loc: Loc) -> Occupancy:
    choice = document.validate(PatternChoice, loc).placed(*loc)
    chosen = resolve(hardware.host, document, "pattern", choice)
    try:
        return construct_target(chosen, hardware.grid).fill
    except PluginLoadError:  # names the plugin at fault, as the file is right
        raise
    except LabseqError as error:
        raise document.error(loc, str(error)) from error


def _rows_and_columns(document: Document, loc: Loc, text: str, target: TargetPattern) -> Occupancy:
    try:
        return mask_of(text, target)
    except ValueError as error:
        expected = "rows and columns such as '2:8,3', a list of sites, or a pattern"
        raise document.error(loc, clean(str(error)), expected) from None


def _listed(document: Document, loc: Loc, sites: list[list[int]], shape: tuple[int, int]) -> Occupancy:
    mask = np.zeros(shape, np.bool_)
    for number, (row, column) in enumerate(sites):
        if row >= shape[0] or column >= shape[1]:
            what = f"[{row}, {column}] is not a site of the grid of {shape[0]} x {shape[1]}"
            raise document.error((*loc, number), what, "[row, column], counted from 0")
        mask[row, column] = True
    return mask
