"""``labseq plot``: a run, or one of its shots, as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from labseq.cli.output import say
from labseq.cli.show import chosen_run
from labseq.drawing import check_place, save_cycles, save_parallelism
from labseq.drawing.charts import save_run
from labseq.drawing.shot import save_shot
from labseq.errors import ConfigError, Problem, one_of
from labseq.session.run_figures import CHOICES, figure_4, figure_5, overview, picture_of, shot_picture

FIGURES: Final = ("4", "5")
"""Figures of the paper that a run can be drawn as."""


@dataclass(frozen=True, slots=True)
class PlotRequest:
    """What is to be drawn of a run; at most one of ``figure``, ``what`` and ``shot`` is given.

    Attributes:
        what: A part of the overview; None for all of it.
        figure: One of :data:`FIGURES`, a figure of the paper.
        compare: Another run for that figure.
        shot: A shot, counted from 1.
        cycle: A cycle of it.
    """

    what: str | None = None
    figure: str | None = None
    compare: Path | None = None
    shot: int | None = None
    cycle: int | None = None

    def check(self) -> None:
        """Find out whether the options go together.

        Raises:
            ConfigError: They do not, or there is no such picture.
        """
        given = [
            option
            for option, value in (("--what", self.what), ("--figure", self.figure), ("--shot", self.shot))
            if value is not None
        ]
        if len(given) > 1:
            raise ConfigError(
                Problem("these are different pictures", " and ".join(given), expected="one of them")
            )
        if self.cycle is not None and self.shot is None:
            raise ConfigError(Problem("a cycle is one of a shot", "--cycle", expected="--shot as well"))
        if self.compare is not None and self.figure is None:
            expected = "--figure 4 or --figure 5 as well"
            raise ConfigError(
                Problem("only figures of the paper compare runs", "--compare", expected=expected)
            )
        for option, value, known in (
            ("--figure", self.figure, FIGURES),
            ("--what", self.what, sorted(CHOICES)),
        ):
            if value is not None and value not in known:
                problem = Problem(f"there is no figure '{value}' of a run", option, expected=one_of(known))
                raise ConfigError(problem)

    @property
    def name(self) -> str:
        """What the file is called if nothing is said, without its ending.

        Example:
            >>> PlotRequest(shot=3, cycle=1).name, PlotRequest(figure="5").name, PlotRequest().name
            ('shot-3-cycle-1', 'figure-5', 'overview')
        """
        if self.shot is not None:
            return f"shot-{self.shot}" + (f"-cycle-{self.cycle}" if self.cycle is not None else "")
        return f"figure-{self.figure}" if self.figure is not None else self.what or "overview"


def plot_run(run: Path | None, request: PlotRequest, output: Path | None) -> None:
    """Draw a run.

    Args:
        run: The run's folder or any file in it; None for the newest run.
        request: What is to be drawn.
        output: The picture; None for a name of its own in the current folder.

    Raises:
        ConfigError: There is no such run or picture, the run has nothing to show in it, or the
            picture cannot be written.
        RecordingError: A run is damaged.
    """
    request.check()
    path = Path(f"{request.name}.png") if output is None else output
    check_place(path)
    chosen = chosen_run(run)
    other = None if request.compare is None else chosen_run(request.compare)
    if request.shot is not None:
        save_shot(path, shot_picture(chosen, request.shot, request.cycle))
    elif request.figure == "4":
        save_parallelism(path, figure_4(chosen, other))
    elif request.figure == "5":
        save_cycles(path, figure_5(chosen, other))
    else:
        save_run(path, overview(chosen) if request.what is None else picture_of(chosen, request.what))
    say(f"written: {path}")
