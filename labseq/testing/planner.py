"""A planner that is plainly right and plainly slow: the yardstick of the contract suites."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Final, TypeAlias

import numpy as np

from labseq.model import Batch, Occupancy, Plan, TargetPattern, as_occupancy
from labseq.roles import Context

Site: TypeAlias = tuple[int, int]
_STEPS: Final = ((-1, 0), (0, -1), (0, 1), (1, 0))


class OneByOnePlanner:
    """Moves one atom at a time, along shortest paths; fills any target and clears it.

    Each defect, from the target's centre on, pulls the nearest atom that the target
    does not need: every atom on the path between them goes on to the next free
    place. What is left on clear sites is pushed to the nearest free reservoir site,
    or over the edge, in the same way.

    Args:
        settings: None; there is nothing to set.
        context: Not needed.
    """

    degree_of_parallelism: Final = 1

    def __init__(self, settings: None = None, context: Context | None = None) -> None:
        del settings, context  # the signature of every factory

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target, and what can be filled with too few atoms.

        Raises:
            ValueError: The occupancy is none, or not of the target's shape.
        """
        atoms = as_occupancy(occupancy, target.shape).copy()
        fill, clear = target.fill, target.clear
        batches: list[Batch] = []
        for hole in _from_the_centre(np.argwhere(fill & ~atoms)):
            path = _path(atoms.shape, hole, lambda site: bool(atoms[site] and not fill[site]))
            if path is not None:
                batches += _shift(atoms, path)
        for row, col in np.argwhere(clear & atoms):

            def is_sink(site: Site) -> bool:
                return not _inside(site, atoms.shape) or not (atoms[site] or fill[site] or clear[site])

            path = _path(atoms.shape, (int(row), int(col)), is_sink, may_leave=True)
            if path is not None:
                batches += _shift(atoms, path[::-1])
        return Plan.from_batches(batches)


def _from_the_centre(sites: np.ndarray) -> Iterator[Site]:
    if len(sites) == 0:
        return
    distances = np.hypot(*(sites - sites.mean(axis=0)).T)
    for index in np.argsort(distances, kind="stable"):
        yield int(sites[index, 0]), int(sites[index, 1])


def _path(
    shape: tuple[int, ...], start: Site, is_end: Callable[[Site], bool], *, may_leave: bool = False
) -> list[Site] | None:
    """The shortest path of neighbouring sites to the nearest end; None if there is none."""
    came_from: dict[Site, Site] = {start: start}
    queue = deque([start])
    while queue:
        site = queue.popleft()
        if site != start and is_end(site):
            path = [site]
            while path[-1] != start:
                path.append(came_from[path[-1]])
            return path[::-1]
        for d_row, d_col in _STEPS:
            neighbour = site[0] + d_row, site[1] + d_col
            may_go = _inside(neighbour, shape) or (may_leave and _inside(site, shape))
            if may_go and neighbour not in came_from:
                came_from[neighbour] = site
                queue.append(neighbour)
    return None


def _shift(atoms: Occupancy, path: Sequence[Site]) -> Iterator[Batch]:
    """Move every atom of a path on by one free place, towards its first site, which is free."""
    free = 0
    for place in range(1, len(path)):
        if not atoms[path[place]]:
            continue
        yield from _straight_moves(path[free : place + 1][::-1])
        atoms[path[place]] = False
        if _inside(path[free], atoms.shape):
            atoms[path[free]] = True
        free = place


def _straight_moves(path: Sequence[Site]) -> Iterator[Batch]:
    """One batch for each straight piece of a path."""
    corners = [path[0]]
    for before, site, after in zip(path, path[1:], path[2:], strict=False):
        if (site[0] - before[0], site[1] - before[1]) != (after[0] - site[0], after[1] - site[1]):
            corners.append(site)
    corners.append(path[-1])
    for start, end in pairwise(corners):
        yield Batch(np.array([start], np.int16), np.array([end], np.int16))


def _inside(site: Site, shape: tuple[int, ...]) -> bool:
    return 0 <= site[0] < shape[0] and 0 <= site[1] < shape[1]
