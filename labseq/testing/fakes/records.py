"""Calibrations, shots and plans made for tests, without devices."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model import (
    Batch,
    CalibrationEntry,
    CalibrationKind,
    CycleRecord,
    ImageRecord,
    Occupancy,
    Plan,
    SiteGrid,
    StageTiming,
    TargetPattern,
    as_occupancy,
    grid_facts,
)
from labseq.motion import check_plan
from labseq.roles import Context

Site: TypeAlias = tuple[int, int]
_STEPS: Final = ((-1, 0), (0, -1), (0, 1), (1, 0))


class OneByOnePlanner:
    """Moves one atom at a time along shortest paths, fills any target and clears its other sites.

    It is slow and simple, a reference for tests. Each defect, starting at the target's centre, pulls the
    nearest atom that the target does not need. Every atom on the path between them moves to the next free
    site. Atoms on clear sites are then pushed to the nearest free reservoir site, or over the edge, in the
    same way.

    Args:
        settings: Not used.
        context: Not used.
    """

    degree_of_parallelism: Final = 1

    def __init__(self, settings: None = None, context: Context | None = None) -> None:
        del settings, context  # the signature of every factory

    def plan(self, occupancy: Occupancy, target: TargetPattern) -> Plan:
        """Plan the moves that fill the target, or as much of it as there are atoms for.

        Raises:
            ValueError: The array is not an occupancy of the target's shape.
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
    """The shortest path of neighbouring sites to the nearest end, or None."""
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
    """Move every atom of a path to the next free site, towards the first site of the path, which is free."""
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


_QUALITY = {
    "sites": {"residual_px": 0.02, "n_sites_found": 0.0},
    "thresholds": {"error": 5e-4},
    "tweezers": {"separable_spread": 3e-3},
    "amplitudes": {"separable_spread": 3e-3},
    "frequencies": {"error_m": 2e-8},
    "overlay": {"error_m": 2e-8},
    "timing": {"p99_s": 5e-3},
}


def fake_calibration(
    kind: CalibrationKind,
    grid: SiteGrid | None = None,
    *,
    values: Mapping[str, ArrayLike] | None = None,
    quality: Mapping[str, float] | None = None,
    origin: Mapping[str, Any] | None = None,
    taken_utc: str = "2026-11-20T08:00:00+00:00",
) -> CalibrationEntry:
    """Make a calibration of any kind, with sites 10 px apart and the tones of the grid.

    Args:
        kind: Kind of calibration.
        grid: The grid of sites. Default the paper's.
        values: Values that replace the default ones.
        quality: Figures of merit that replace the default ones.
        origin: Provenance of the calibration.
        taken_utc: Time when the calibration was made.

    Example:
        >>> fake_calibration("overlay", values={"offset_m": [1e-7, 0.0]}).values["offset_m"].tolist()
        [1e-07, 0.0]
    """
    grid = grid or SiteGrid()
    figures = _QUALITY[kind] | ({"n_sites_found": float(np.prod(grid.shape))} if kind == "sites" else {})
    merged: Any = {**_values(kind, grid), **(values or {})}  # may be invalid, for tests of error messages
    return CalibrationEntry(
        kind,
        merged,
        figures if quality is None else quality,
        grid_facts(grid),
        origin or {},
        taken_utc,
    )


def _values(kind: CalibrationKind, grid: SiteGrid) -> Mapping[str, ArrayLike]:
    n_rows, n_cols = grid.shape
    rows, cols = np.indices(grid.shape)
    values: Mapping[str, Mapping[str, ArrayLike]] = {
        "sites": {
            "positions_px": 10.0 * np.stack([rows + 1, cols + 1 + 0.5 * rows], axis=-1),
            "frame": [10 * n_rows + 20, 10 * n_cols + 5 * n_rows + 20],
        },
        "thresholds": {"thresholds": np.full(grid.shape, 1630.0)},
        "tweezers": {
            "row_amplitudes": np.full(n_rows, 1 / n_rows),
            "column_amplitudes": np.full(n_cols, 1 / n_cols),
        },
        "amplitudes": {
            "row_amplitudes": np.full(n_rows, 1 / n_rows),
            "column_amplitudes": np.full(n_cols, 1 / n_cols),
        },
        "frequencies": {"row_hz": grid.row_frequency_hz, "column_hz": grid.column_frequency_hz},
        "overlay": {"offset_m": [0.0, 0.0]},
        "timing": {"overhead_s": [3e-3]},
    }
    return values[kind]


@dataclass(frozen=True)
class FakeShot:
    """A recorded shot as passed to an analysis. Implements ``RecordedShot``."""

    index: int
    target: TargetPattern
    images: Sequence[ImageRecord]
    cycles: Sequence[CycleRecord]
    frames: NDArray[np.uint16]
    timing: Sequence[StageTiming] = ()
    readings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    parameters: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def success(self) -> bool:
        """Whether the last image meets the target."""
        return bool(self.images) and self.target.is_met_by(self.images[-1].occupancy)

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on the last image. nan without an image."""
        return self.target.filling_fraction(self.images[-1].occupancy) if self.images else float("nan")

    @property
    def occupancies(self) -> NDArray[np.bool_]:
        """As detected, bool (n_images, n_rows, n_cols)."""
        return np.array([image.occupancy for image in self.images], np.bool_).reshape(-1, *self.target.shape)

    @property
    def confidences(self) -> NDArray[np.float32]:
        """The detector's confidence, float32 (n_images, n_rows, n_cols)."""
        return np.array([i.confidence for i in self.images], np.float32).reshape(-1, *self.target.shape)


def fake_shot(
    shape: tuple[int, int] = (6, 6),
    *,
    index: int = 0,
    n_images: int = 2,
    n_cycles: int = 0,
    filling: float = 0.75,
    frame_shape: tuple[int, int] | None = (32, 32),
) -> FakeShot:
    """Make a reproducible shot, in which each cycle moves some atoms and each image loses some.

    Args:
        shape: (n_rows, n_cols).
        index: Index of the shot in the run.
        n_images: Number of images.
        n_cycles: Number of images that end a cycle. They come after the first image.
        filling: Fraction of loaded sites.
        frame_shape: (height, width) of the frames. None if no frames were kept.

    Example:
        >>> shot = fake_shot((3, 4), n_images=3, n_cycles=1)
        >>> shot.occupancies.shape, [image.cycle for image in shot.images]
        ((3, 3, 4), [-1, 0, -1])
    """
    rng = np.random.default_rng((index, 87))
    fill = np.zeros(shape, np.bool_)
    fill[1:-1, 1:-1] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    atoms = rng.random(shape) < filling
    images: list[ImageRecord] = []
    cycles: list[CycleRecord] = []
    for number in range(n_images):
        cycle = number - 1 if 0 < number <= n_cycles else -1
        step = 2 if cycle >= 0 else 1 if number == 0 else 3
        if cycle >= 0:
            plan = OneByOnePlanner().plan(atoms, target)
            report = check_plan(plan, atoms, target, degree_of_parallelism=1)
            cycles.append(CycleRecord(step, cycle, plan, report, plan.n_batches, 0.06, 0.06 * number, 0.05))
            atoms = report.predicted.copy()
        atoms = atoms & (rng.random(shape) < 0.98)
        confidence = rng.random(shape, np.float32)
        images.append(ImageRecord(None, atoms.copy(), confidence, step, cycle, 0.06 * number, 0.045))
    kept = (0, 0, 0) if frame_shape is None else (n_images, *frame_shape)
    frames = rng.integers(0, 2000, kept, np.uint16)
    return FakeShot(index, target, images, cycles, frames)
