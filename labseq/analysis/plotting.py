"""`labseq plot`: draws a run, a campaign or a shot."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

from labseq.analysis.campaigns import campaign_in, campaign_picture
from labseq.analysis.overview import map_picture, overview, picture_of, scan_picture
from labseq.analysis.scanned import ScanRequest
from labseq.analysis.shot import save_shot, shot_animation, shot_picture
from labseq.console.output import say
from labseq.console.runs import chosen_run
from labseq.errors import ConfigError, Problem
from labseq.kernels.kernel import interpret
from labseq.messages import visible
from labseq.pictures.animations import ENDINGS as ANIMATIONS, save_animation
from labseq.pictures.figures import ENDINGS, check_place


@dataclass(frozen=True, slots=True)
class PlotRequest:
    """The part of a run to draw. At most one of ``what``, ``scan``, ``sites`` and ``shot`` is given.

    Attributes:
        what: A part of the overview. None for the whole overview.
        shot: A shot, counted from 0.
        cycle: A cycle of the shot, counted from 0.
        scan: Quantities at the points of the scan.
        sites: Quantities at each site. "" for the quantities that the run measures.
        where: Conditions on the shots that are drawn.
    """

    what: str | None = None
    shot: int | None = None
    cycle: int | None = None
    scan: ScanRequest | None = None
    sites: tuple[str, ...] = ()
    where: tuple[str, ...] = ()

    def check(self) -> None:
        """Check that the options are compatible.

        Raises:
            ConfigError: Options conflict, or there is no such picture.
        """
        maps = self.sites or None
        pictures = {"--what": self.what, "--shot": self.shot, "--scan": self.scan, "--map": maps}
        options = [option for option, value in pictures.items() if value is not None]
        if len(options) > 1:
            problem = "these are different pictures"
            raise ConfigError(Problem(problem, " and ".join(options), expected="one of them"))
        if self.cycle is not None and self.shot is None:
            raise ConfigError(Problem("a cycle needs a shot", "--cycle", expected="--shot as well"))

    @property
    def name(self) -> str:
        """Default name of the file, without suffix.

        Example:
            >>> PlotRequest(shot=3, cycle=1).name, PlotRequest(what="scan").name, PlotRequest().name
            ('shot-3-cycle-1', 'scan', 'overview')
        """
        if self.shot is not None:
            return f"shot-{self.shot}" + (f"-cycle-{self.cycle}" if self.cycle is not None else "")
        return "scan" if self.scan is not None else "map" if self.sites else self.what or "overview"


def plot_run(run: Path | None, request: PlotRequest, output: Path | None, *, replace: bool = False) -> None:
    """Draw a run or a campaign. An existing file is replaced only on request."""
    request.check()
    folder = campaign_in(run)
    if folder is not None and request != PlotRequest():
        problem = "these options are for a single run, and a campaign has only one picture"
        raise ConfigError(
            Problem(problem, visible(str(folder)), expected="no option but --output and --force")
        )
    path = _free_name(request.name if folder is None else "campaign") if output is None else output
    ending = path.suffix.lower()
    if ending in ANIMATIONS and request.shot is None:
        what = "an animation shows one cycle of a shot"
        raise ConfigError(Problem(what, visible(str(path)), expected="--shot N and --cycle K as well"))
    check_place(path, ENDINGS if request.shot is None else (*ENDINGS, *ANIMATIONS), drawn=ending != ".html")
    if path.exists() and not replace:
        hint = "--force replaces it"
        raise ConfigError(
            Problem("this file already exists", visible(str(path)), expected="a new name", hint=hint)
        )
    if folder is not None:
        campaign_picture(folder).save(path)
        say(f"written: {path}")
        return
    opened_run = chosen_run(run, request.where)
    if request.shot is not None and ending in ANIMATIONS:
        interpret()  # plain Python is faster than loading the compiler for one cycle
        save_animation(path, shot_animation(opened_run, request.shot, request.cycle))
    elif request.shot is not None:
        save_shot(path, shot_picture(opened_run, request.shot, request.cycle))
    elif request.scan is not None:
        scan_picture(opened_run, request.scan).save(path)
    elif request.sites:
        map_picture(opened_run, [*filter(None, request.sites)]).save(path)
    else:
        (overview(opened_run) if request.what is None else picture_of(opened_run, request.what)).save(path)
    say(f"written: {path}")


def _free_name(name: str) -> Path:
    """A PNG file of this name in the current folder, with a number if the file exists."""
    names = (Path(f"{name}_{i}.png" if i else f"{name}.png") for i in itertools.count())
    return next(path for path in names if not path.exists())
