"""Calibrations and shots made up for tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from labseq.model import (
    CalibrationEntry,
    CalibrationKind,
    CycleRecord,
    ImageRecord,
    SiteGrid,
    StageTiming,
    TargetPattern,
    grid_facts,
)
from labseq.motion import check_plan
from labseq.testing.planner import OneByOnePlanner

_FIGURES = {
    "sites": {"residual_px": 0.02, "n_sites_found": 0.0},
    "thresholds": {"error": 5e-4},
    "tweezers": {"separable_spread": 3e-3},
    "frequencies": {"error_m": 2e-8},
    "overlay": {"error_m": 2e-8},
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
    """Make a calibration of any kind, with sites 10 px apart and tones as the grid has them.

    Args:
        kind: Its kind.
        grid: The grid of sites; by default the paper's.
        values: Values in place of its own.
        quality: Figures of merit in place of its own.
        origin: Where it comes from.
        taken_utc: When it was made.

    Example:
        >>> fake_calibration("overlay", values={"offset_m": [1e-7, 0.0]}).values["offset_m"].tolist()
        [1e-07, 0.0]
    """
    grid = grid or SiteGrid()
    figures = _FIGURES[kind] | ({"n_sites_found": float(np.prod(grid.shape))} if kind == "sites" else {})
    merged: Any = {**_values(kind, grid), **(values or {})}  # whatever a test wants to see refused
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
        "frequencies": {"row_hz": grid.row_frequency_hz, "column_hz": grid.column_frequency_hz},
        "overlay": {"offset_m": [0.0, 0.0]},
    }
    return values[kind]


@dataclass(frozen=True)
class FakeShot:
    """What an analysis is given of a shot; implements ``RecordedShot``."""

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
        """Whether its last image meets the target."""
        return bool(self.images) and self.target.is_met_by(self.images[-1].occupancy)

    @property
    def filling_fraction(self) -> float:
        """Filling of the target on its last image; nan without one."""
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
    """Make a shot, always the same one: atoms load, each cycle moves some, each image loses some.

    Args:
        shape: (n_rows, n_cols).
        index: Index of the shot in the run.
        n_images: How many images were taken.
        n_cycles: How many of them ended a cycle; they come after the first.
        filling: Fraction of sites that are loaded.
        frame_shape: (height, width) of the frames; None if none were kept.

    Example:
        >>> shot = fake_shot((3, 4), n_images=3, n_cycles=1)
        >>> shot.occupancies.shape, [image.cycle for image in shot.images]
        ((3, 3, 4), [0, 1, 0])
    """
    rng = np.random.default_rng((index, 87))
    fill = np.zeros(shape, np.bool_)
    fill[1:-1, 1:-1] = True
    target = TargetPattern(fill, np.zeros_like(fill))
    atoms = rng.random(shape) < filling
    images: list[ImageRecord] = []
    cycles: list[CycleRecord] = []
    for number in range(n_images):
        cycle = number if 0 < number <= n_cycles else 0
        step = 2 if cycle else 1 if number == 0 else 3
        if cycle:
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
