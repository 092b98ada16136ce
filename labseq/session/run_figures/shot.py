"""The pictures of one shot."""

from __future__ import annotations

import numpy as np

from labseq.config.wording import clean
from labseq.drawing.shot import ShotDrawing, ShotPanel
from labseq.errors import ConfigError, Problem
from labseq.model import CycleRecord, ImageRecord, ShotRecord, TargetPattern
from labseq.recording import Run, Shot
from labseq.session.run_figures.words import note_of, unfit
from labseq.session.shot_grid import grid_of, sites_of

MAX_SITES = 128
"""Most rows, and most columns, of an array that can be made out in a picture."""


def shot_picture(run: Run, number: int, cycle: int | None = None) -> ShotDrawing:
    """The images of a shot with what was seen on them and the moves that followed.

    Args:
        run: The run.
        number: The shot, counted from 1 as ``labseq show`` does. Of one that did not complete, the last
            attempt.
        cycle: Only this cycle, counted from 1 over all rearrangements of the shot: the image that it was
            planned on, and the one that ended it.

    Raises:
        ConfigError: There is no such shot or cycle, it has no images, or the array is too large.
        RecordingError: The shot's file is damaged.
    """
    shot = _shot(run, number)
    record, target = shot.record(), run.target
    if max(target.shape) > MAX_SITES:
        what = f"{target.shape[0]} x {target.shape[1]} sites are too many to be made out"
        raise unfit(run, what, f"at most {MAX_SITES} rows and columns", "picture")
    if not record.images:
        raise unfit(run, f"shot {number} has no images", "a shot with an 'image' step", "picture")
    panels = _panels(record, target)
    if cycle is not None:
        panels = _of_cycle(run, number, record, panels, cycle)
    sites = sites_of(run)
    frames = [panel.image for panel in panels if panel.image is not None]
    fits = sites is not None and all(image.shape == sites.frame for image in frames)
    kept = (
        "" if frames and fits else "; no frames: " + ("not kept" if not frames else "not of the sites' size")
    )
    ended = "" if shot.status == "complete" else f", {shot.status}: {clean(record.error)}"
    return ShotDrawing(
        title=f"shot {number}{ended}",
        note=note_of(run) + kept,
        grid=grid_of(run),
        target=target,
        sites_px=sites.positions_px if sites is not None and fits else None,
        panels=tuple(panels),
    )


def _shot(run: Run, number: int) -> Shot:
    of_number = [shot for shot in (*run.attempts, *run.shots) if shot.index == number - 1]
    if not of_number:
        known = sorted({shot.index + 1 for shot in (*run.shots, *run.attempts)})
        expected = f"one from {known[0]} to {known[-1]}" if known else "a run that has shots"
        raise ConfigError(Problem(f"the run has no shot {number}", "--shot", expected=expected))
    return of_number[-1]


def _panels(record: ShotRecord, target: TargetPattern) -> list[ShotPanel]:
    """A panel for each image, with the moves of the cycle that was planned on it."""
    made = iter(record.cycles)
    ended_by = [next(made, None) if image.cycle else None for image in record.images]
    after = [*ended_by[1:], next(made, None)]  # a shot that was interrupted may lack the last image
    numbers = iter(range(1, len(record.cycles) + 1))
    titles = [f"after cycle {next(numbers, 0)}" if cycle else "image" for cycle in ended_by]
    return [
        _panel(image, f"{title}: {_seen(image, target)}", cycle)
        for image, title, cycle in zip(record.images, titles, after, strict=True)
    ]


def _seen(image: ImageRecord, target: TargetPattern) -> str:
    n_defects, n_surplus = target.n_defects(image.occupancy), target.n_surplus(image.occupancy)
    seen = f"{int(image.occupancy.sum())} atoms, {n_defects or 'no'} defect{'s' * (n_defects != 1)}"
    return seen + (f", {n_surplus} surplus" if n_surplus else "")


def _panel(image: ImageRecord, title: str, cycle: CycleRecord | None) -> ShotPanel:
    pixels = None if image.frame is None else image.frame.image
    if cycle is None:
        return ShotPanel(title, image.occupancy, pixels, np.empty((0, 4), np.int16), np.empty(0, np.int64))
    offsets = cycle.plan.batch_offsets[: cycle.n_batches_played + 1]
    batch = np.repeat(np.arange(cycle.n_batches_played), np.diff(offsets))
    played, planned = cycle.n_batches_played, cycle.plan.n_batches
    moves = cycle.plan.moves[: int(offsets[-1])]
    batches = (
        f"{played} of {planned} batches" if played < planned else f"{played} batch{'es' * (played != 1)}"
    )
    told = f"{title}; then {len(moves)} move{'s' * (len(moves) != 1)} in {batches}"
    return ShotPanel(told, image.occupancy, pixels, moves, batch)


def _of_cycle(
    run: Run, number: int, record: ShotRecord, panels: list[ShotPanel], cycle: int
) -> list[ShotPanel]:
    ends = [i for i, image in enumerate(record.images) if image.cycle]
    if not 1 <= cycle <= len(ends):
        made = f"one from 1 to {len(ends)}" if ends else "a shot that rearranges"
        text = f"shot {number} of {clean(run.path.name)} has no cycle {cycle}"
        raise ConfigError(Problem(text, "--cycle", expected=made))
    after = ends[cycle - 1]
    return panels[max(0, after - 1) : after + 1]
