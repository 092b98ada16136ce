"""Where the mobile tweezers take the atoms: a tone program, taken at its word.

The tweezers are the crossings of the row tones and the column tones that are on.
What a segment is *meant* for (its kind, its batch) is not looked at: only tones
count, so that a wrong program does here what it would do in the lab.

Rules, in the order in which they act on a segment:

1. A crossing that was on at the end of the segment before, within the site
   tolerance on both axes, is the same tweezer and keeps its atom. An atom whose
   tweezer has no such successor is lost: its tone jumped or went out.
2. A crossing that comes on takes the atom of the site that it stands on. Between
   sites it takes nothing.
3. Tones of one axis that come nearer than half a site, or pass one another, mix
   the atoms on both: they are lost.
4. A crossing that moves over a standing atom, or ends on one, throws it out. The
   first to arrive loses its own atom too.
5. A crossing that goes out within the tolerance of a site sets its atom down
   there, less the transport loss, which is drawn then; two atoms on one site are
   both lost; outside of the grid the atom is gone (ejected), between sites it is lost.

Atoms still held when the program ends are lost. The course of the speed within a
segment changes nothing here: all tones follow the same one, so what meets, and in which
order, is the same.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from labseq.errors import LimitError
from labseq.model import AxisTones, SiteGrid, ToneProgram
from labseq_virtual.settings import WorldSettings

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

BEYOND: Final = 1000
"""Sites beyond the grid to which the frequency map is extended on each side."""
MIXING: Final = 0.5
"""Distance of two tones, in sites, below which their tweezers are one."""
AT_REST: Final = 1e-6
"""Motion in a segment, in sites, below which a tweezer stands still."""


class FrequencyMap:
    """Frequency -> place along an axis, in sites; beyond the grid at the outermost step.

    Args:
        frequency_hz: float64 (n_sites,), rising or falling.
        lone_step_hz: Step to assume where there is one site only.
        axis: "row" or "column", for the error message.

    Raises:
        LimitError: The frequencies neither rise nor fall all along.
    """

    def __init__(self, frequency_hz: Floats, lone_step_hz: float, axis: str) -> None:
        steps = np.diff(frequency_hz)
        if not (np.all(steps > 0) or np.all(steps < 0)):
            raise LimitError(
                f"the {axis} frequencies of the grid", "out of order", "frequencies that all rise or all fall"
            )
        first, last = (steps[0], steps[-1]) if len(steps) else (lone_step_hz, lone_step_hz)
        ends = frequency_hz[0] - BEYOND * first, frequency_hz[-1] + BEYOND * last
        hz = np.concatenate([ends[:1], frequency_hz, ends[1:]])
        n_sites = len(frequency_hz)
        sites = np.concatenate([[-BEYOND], np.arange(n_sites), [n_sites - 1 + BEYOND]])
        rising = hz[-1] > hz[0]
        self._hz, self._sites = (hz, sites) if rising else (hz[::-1], sites[::-1])

    def sites(self, frequency_hz: Floats) -> Floats:
        """Places of some tones, in sites from the first row or column."""
        return np.interp(frequency_hz, self._hz, self._sites)


def frequency_maps(grid: SiteGrid) -> tuple[FrequencyMap, FrequencyMap]:
    """The maps of the row and the column axis."""
    all_steps = np.concatenate([np.diff(grid.row_frequency_hz), np.diff(grid.column_frequency_hz)])
    lone_step_hz = float(all_steps.mean()) if len(all_steps) else 1.6e6
    return (
        FrequencyMap(grid.row_frequency_hz, lone_step_hz, "row"),
        FrequencyMap(grid.column_frequency_hz, lone_step_hz, "column"),
    )


@dataclass(slots=True)
class _Tones:
    """Tones of an axis: places in sites, and whether they are on, at start and end.

    ``moving`` says whether any moves, ``crowded`` whether some may come too near to one another.
    """

    start: Floats
    end: Floats
    on_start: Mask
    on_end: Mask
    moving: bool
    crowded: bool

    @property
    def n_on(self) -> int:
        """How many are on."""
        return int(np.count_nonzero(self.on_start | self.on_end))


@dataclass(slots=True)
class _Tweezers:
    """The crossings at the end of a segment; ``lit`` and ``loaded`` are (n_row_tones, n_column_tones)."""

    rows: Floats
    cols: Floats
    lit: Mask
    loaded: Mask


class Transport:
    """Carries atoms by tone programs.

    Args:
        grid: The grid of sites, with its frequencies.
        settings: Tolerances and losses.
    """

    def __init__(self, grid: SiteGrid, settings: WorldSettings) -> None:
        self._row_map, self._column_map = frequency_maps(grid)
        self._tolerance = settings.site_tolerance
        self._on_amplitude = settings.on_amplitude
        self._loss = settings.transport_loss
        self._loss_per_tone = settings.transport_loss_per_tone

    def carry(
        self,
        occupied: Mask,
        program: ToneProgram,
        n_segments: int,
        rng: np.random.Generator,
        loss_factor: float,
    ) -> None:
        """Carry out the first segments of a program.

        Args:
            occupied: bool (n_rows, n_cols), sites that hold an atom; changed in place.
            program: What the tweezers play.
            n_segments: How many segments are played; atoms held after them are lost.
            rng: Random numbers of the shot.
            loss_factor: The shot's factor on the transport loss.
        """
        rows = self._tones(program.row, self._row_map, n_segments)
        cols = self._tones(program.column, self._column_map, n_segments)
        before: _Tweezers | None = None
        for row, col in zip(rows, cols, strict=True):
            before = self._segment(occupied, before, row, col, rng, loss_factor)

    def _tones(self, axis: AxisTones, places: FrequencyMap, n_segments: int) -> Iterator[_Tones]:
        """The tones of each segment."""
        start, end = places.sites(axis.start_hz), places.sites(axis.end_hz)
        on_start, on_end = axis.start_amplitude > self._on_amplitude, axis.end_amplitude > self._on_amplitude
        moves = np.abs(end - start) > AT_REST
        close = (np.diff(start) < MIXING) | (np.diff(end) < MIXING)  # each tone and the next in the list
        n_moves, n_close = ([0, *np.cumsum(each).tolist()] for each in (moves, close))
        for first, last in itertools.pairwise(axis.offsets[: n_segments + 1].tolist()):
            part = slice(first, last)
            moving = n_moves[last] > n_moves[first]
            crowded = last > first and n_close[last - 1] > n_close[first]
            yield _Tones(start[part], end[part], on_start[part], on_end[part], moving, crowded)

    def _segment(
        self,
        occupied: Mask,
        before: _Tweezers | None,
        row: _Tones,
        col: _Tones,
        rng: np.random.Generator,
        loss_factor: float,
    ) -> _Tweezers | None:
        lit_start = row.on_start[:, None] & col.on_start
        lit_end = row.on_end[:, None] & col.on_end
        lit = lit_start | lit_end
        if not lit.any():
            return None
        known, loaded = self._continued(before, row.start, col.start)
        loaded &= lit_start
        new = lit & ~(known & lit_start)
        if new.any():
            loaded |= self._picked_up(occupied, new, row.start, col.start)
        if row.crowded:
            loaded[_mixed(row), :] = False
        if col.crowded:
            loaded[:, _mixed(col)] = False
        if row.moving or col.moving:
            self._sweep(occupied, lit, loaded, row, col)
        let_go = loaded & ~lit_end
        if let_go.any():
            further = row.n_on + col.n_on - 2
            loss = min(1.0, loss_factor * (self._loss + self._loss_per_tone * further))
            self._set_down(occupied, let_go, row.end, col.end, loss, rng)
        return _Tweezers(row.end, col.end, lit_end, loaded & lit_end)

    def _continued(self, before: _Tweezers | None, rows: Floats, cols: Floats) -> tuple[Mask, Mask]:
        """Which crossings go on from the segment before, and which of them hold an atom."""
        if before is None:
            nothing = np.zeros((len(rows), len(cols)), np.bool_)
            return nothing, nothing.copy()
        if self._unchanged(before.rows, rows) and self._unchanged(before.cols, cols):
            return before.lit, before.loaded
        row, same_row = self._same(before.rows, rows)
        col, same_col = self._same(before.cols, cols)
        same = same_row[:, None] & same_col
        pairs = row[:, None], col
        return before.lit[pairs] & same, before.loaded[pairs] & same

    def _unchanged(self, before: Floats, now: Floats) -> bool:
        """Whether the tones are the same in the same order: nearly always so."""
        return len(before) == len(now) and bool((np.abs(now - before) <= self._tolerance).all())

    def _same(self, before: Floats, now: Floats) -> tuple[NDArray[np.intp], Mask]:
        """For each tone now the nearest before, and whether it is near enough to be the same."""
        distance = np.abs(now[:, None] - before)
        nearest = distance.argmin(axis=1)
        return nearest, distance.min(axis=1) <= self._tolerance

    def _picked_up(self, occupied: Mask, new: Mask, rows: Floats, cols: Floats) -> Mask:
        """Which crossings that come on take an atom; the atoms leave their sites."""
        row, on_row = self._on_site(rows, occupied.shape[0])
        col, on_col = self._on_site(cols, occupied.shape[1])
        taken = new & on_row[:, None] & on_col & occupied[row[:, None], col]
        i, j = np.nonzero(taken)
        occupied[row[i], col[j]] = False
        return taken

    def _on_site(self, places: Floats, n_sites: int) -> tuple[NDArray[np.intp], Mask]:
        """The nearest site of the grid, and whether it is within the tolerance."""
        nearest = np.clip(np.rint(places), 0, n_sites - 1)
        return nearest.astype(np.intp), np.abs(places - nearest) <= self._tolerance

    def _sweep(self, occupied: Mask, lit: Mask, loaded: Mask, row: _Tones, col: _Tones) -> None:
        """Collide moving crossings with standing atoms; changes ``occupied`` and ``loaded``."""
        row_step, col_step = row.end - row.start, col.end - col.start
        moving = lit & ((np.abs(row_step) > AT_REST)[:, None] | (np.abs(col_step) > AT_REST))
        i, j = np.nonzero(moving)
        if len(i) == 0:
            return
        row_range, col_range = self._reach(row, i, occupied.shape[0]), self._reach(col, j, occupied.shape[1])
        r, c = np.nonzero(occupied[row_range, col_range])
        if len(r) == 0:
            return
        r, c = r + row_range.start, c + col_range.start
        down, right = row_step[i, None], col_step[j, None]  # (n_crossings, 1), against (n_atoms,)
        to_r, to_c = r - row.start[i, None], c - col.start[j, None]
        when = np.clip((to_r * down + to_c * right) / (down**2 + right**2), 0.0, 1.0)
        miss = (to_r - when * down) ** 2 + (to_c - when * right) ** 2
        hit = miss <= self._tolerance**2
        struck = hit.any(axis=0)
        if not struck.any():
            return
        first = np.where(hit, when, np.inf).argmin(axis=0)[struck]
        loaded[i[first], j[first]] = False
        occupied[r[struck], c[struck]] = False

    def _reach(self, tones: _Tones, chosen: NDArray[np.intp], n_sites: int) -> slice:
        """Rows or columns of the grid that some tones come near to."""
        start, end = tones.start[chosen], tones.end[chosen]
        low = math.ceil(min(start.min(), end.min()) - self._tolerance)
        high = math.floor(max(start.max(), end.max()) + self._tolerance) + 1
        return slice(min(max(low, 0), n_sites), min(max(high, 0), n_sites))

    def _set_down(
        self, occupied: Mask, let_go: Mask, rows: Floats, cols: Floats, loss: float, rng: np.random.Generator
    ) -> None:
        """Set atoms down where their tweezers went out; those that are not on a site are gone."""
        row, on_row = self._on_site(rows, occupied.shape[0])
        col, on_col = self._on_site(cols, occupied.shape[1])
        i, j = np.nonzero(let_go & on_row[:, None] & on_col)
        alive = rng.random(len(i)) >= loss
        sites = np.ravel_multi_index((row[i[alive]], col[j[alive]]), occupied.shape)
        arrived = np.bincount(sites, minlength=occupied.size).reshape(occupied.shape)
        occupied[...] = occupied + arrived == 1


def _mixed(tones: _Tones) -> Mask:
    """Which tones of an axis come too near to another, or pass it."""
    start, end = tones.start, tones.end
    on = tones.on_start | tones.on_end
    before, after = start[:, None] - start, end[:, None] - end
    near = (np.abs(before) < MIXING) | (np.abs(after) < MIXING) | (before * after < 0)
    near &= on[:, None] & on
    return np.count_nonzero(near, axis=1) > 1  # each is near to itself
