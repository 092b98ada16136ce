"""``labseq plot``: a run as a figure of the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from labseq.cli.output import say
from labseq.cli.show import chosen_run
from labseq.drawing import check_place, save_cycles, save_parallelism
from labseq.errors import ConfigError, Problem, one_of
from labseq.session.run_figures import figure_4, figure_5

FIGURES: Final = ("4", "5")
"""Figures of the paper that a run can be drawn as."""


def plot_run(run: Path | None, figure: str, output: Path | None, compare: Path | None) -> None:
    """Draw a run.

    Args:
        run: The run's folder or any file in it; None for the newest run.
        figure: One of :data:`FIGURES`.
        output: The picture; None for ``figure-5.png`` in the current folder.
        compare: Another run for the same picture.

    Raises:
        ConfigError: There is no such run or figure, the run is not of the kind that the figure
            needs, or the picture cannot be written.
        RecordingError: A run is damaged.
    """
    if figure not in FIGURES:
        raise ConfigError(
            Problem(f"there is no figure '{figure}' of a run", "--figure", expected=one_of(FIGURES))
        )
    path = Path(f"figure-{figure}.png") if output is None else output
    check_place(path)
    first, other = chosen_run(run), None if compare is None else chosen_run(compare)
    if figure == "4":
        save_parallelism(path, figure_4(first, other))
    else:
        save_cycles(path, figure_5(first, other))
    say(f"written: {path}")
