"""A campaign: a sequence run at each point of a grid of values, one run for each, in one folder."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

from pydantic import Field

from labseq.config.addresses import split_overrides
from labseq.config.document import Document
from labseq.errors import ConfigError, Problem
from labseq.files import explained, write_file
from labseq.messages import clean, visible
from labseq.recording import Run, open_run
from labseq.recording.folders import RUN_FILE
from labseq.roles import RunObserver
from labseq.session.options import Options
from labseq.settings import Settings

if TYPE_CHECKING:
    from labseq.session.session import Session

MAX_POINTS: Final = 10_000
CAMPAIGN_FILE: Final = "campaign.yaml"
"""The copy of the campaign file in the campaign's folder."""

RunSession: TypeAlias = "Callable[[Callable[[RunObserver | None], Session]], None]"


class CampaignSettings(Settings):
    """A campaign file."""

    labseq: Literal[1]
    sequence: str = Field(description="the sequence file, beside this file, or the name of one")
    profile: str | None = Field(default=None, description="hardware profile, instead of the sequence's own")
    axes: Annotated[dict[str, list[Any]], Field(min_length=1)] = Field(
        description="address, as for --set, and its values; every combination is a point"
    )
    repeats: int = Field(default=1, ge=1, description="shots at each point")
    seed: int | None = Field(default=None, ge=0, description="seed of all runs; by default each has its own")


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign file.

    Attributes:
        document: The file.
        settings: Its content.
        axes: Address -> its values, as they were typed.
    """

    document: Document
    settings: CampaignSettings
    axes: dict[str, list[str]]

    @classmethod
    def read(cls, path: Path) -> Campaign:
        """Read a campaign file.

        Raises:
            ConfigError: It has an error, with its place.
        """
        document = Document.read(path)
        settings = document.validate(CampaignSettings, ())
        axes: dict[str, list[str]] = {}
        for address, values in settings.axes.items():
            nodes = [document.root.at(("axes", address, i)) for i in range(len(values))]
            axes[address] = [str(node.raw or node.plain()) for node in nodes if node is not None]
            if not values or len({*axes[address]}) < len(values):
                what = "a value occurs twice" if values else "there are no values"
                raise document.error(("axes", address), what, "a list of different values")
        if (n_points := math.prod(map(len, axes.values()))) > MAX_POINTS:
            raise document.error(("axes",), f"there are {n_points} points", f"at most {MAX_POINTS}", key=True)
        return cls(document, settings, axes)

    @property
    def sequence(self) -> Path:
        """The sequence file, or the name of one."""
        beside = self.document.path.parent / self.settings.sequence
        return beside if beside.is_file() else Path(self.settings.sequence)

    def points(self) -> Iterator[tuple[int, ...]]:
        """The indices of the values of each point; the last axis changes fastest."""
        yield from itertools.product(*(range(len(values)) for values in self.axes.values()))

    def options(self, point: Sequence[int], output: Path | None = None) -> Options:
        """The options of the run at a point."""
        values = [(address, self.axes[address][i]) for address, i in zip(self.axes, point, strict=True)]
        profile = self.settings.profile
        if profile is not None and (beside := self.document.path.parent / profile).is_file():
            profile = str(beside)
        overrides = tuple(f"{address}={value}" for address, value in values)
        return Options(profile, self.settings.repeats, self.settings.seed, overrides, output)

    def check(self) -> None:
        """Check the sequence at every point, before the first run.

        Raises:
            ConfigError: It has an error; at the place of the value in the campaign file, if that is wrong.
        """
        from labseq.session.session import Session  # results of a campaign are read without it

        for point in self.points():
            try:
                Session.open(self.sequence, **asdict(self.options(point)))
            except ConfigError as error:
                raise ConfigError([self._placed(problem, point) for problem in error.problems]) from error

    def _placed(self, problem: Problem, point: Sequence[int]) -> Problem:
        for name in ("sequence", "profile"):  # one that does not exist
            if problem.source == getattr(self.settings, name) and not problem.line:
                line, column = self.document.locate((name,))
                what = f"{name} is '{clean(problem.source)}': {problem.what}"
                return replace(problem, what=what, source=self.document.name, line=line, column=column)
        for option, address, i in zip(self.options(point).overrides, self.axes, point, strict=True):
            if any(
                problem.source == override.source for override in itertools.chain(*split_overrides([option]))
            ):
                line, column = self.document.locate(("axes", address, i))
                return replace(problem, source=self.document.name, line=line, column=column)
        return problem


def run_campaign(run_session: RunSession, campaign: Campaign, folder: Path, workers: Options) -> list[Run]:
    """Take the runs of a campaign, or those that are missing.

    Args:
        run_session: Runs a session and shows it.
        campaign: The campaign.
        folder: Its folder, a data folder of its own.
        workers: Who takes the shots: ``workers``, ``scheduler`` and ``keys`` of these options.

    Returns:
        The run of each point, in order.

    Raises:
        ConfigError: The campaign has an error, or the runs in the folder are not its own.
        LabseqError: What ended a run; the campaign is continued by the same command.
    """
    from labseq.session.session import Session

    campaign.check()
    who: dict[str, Any] = {"workers": workers.workers, "scheduler": workers.scheduler, "keys": workers.keys}
    found = _runs_of(campaign, folder)
    _keep(campaign, folder, is_new=not found)
    for point in campaign.points():
        earlier = found.get(point)
        if earlier is not None and earlier.status == "complete":
            continue

        def start(observer: RunObserver | None, point: Any = point, earlier: Any = earlier) -> Session:
            if earlier is not None:
                return Session.resume(earlier.path, **who, observer=observer)
            options = asdict(campaign.options(point, folder)) | who
            return Session.open(campaign.sequence, **options, observer=observer)

        run_session(start)
    runs = _runs_of(campaign, folder)
    return [runs[point] for point in campaign.points() if point in runs]


def _keep(campaign: Campaign, folder: Path, *, is_new: bool) -> None:
    """Copy the campaign file to the folder, so that its results can be read without the original."""
    kept, text = folder / CAMPAIGN_FILE, campaign.document.text
    if kept.is_file() and Document.read(kept).text == text:
        return
    if is_new and kept.exists():
        what, hint = "this file is of another campaign", "delete it if that campaign has ended"
        raise ConfigError(Problem(what, visible(str(kept)), expected="another folder", hint=hint))
    with explained(kept):
        folder.mkdir(parents=True, exist_ok=True)
    write_file(kept, text.encode())


def _runs_of(campaign: Campaign, folder: Path) -> dict[tuple[int, ...], Run]:
    """The runs in a folder: point -> run.

    Raises:
        ConfigError: One of them belongs to no point.
    """
    points = {tuple(campaign.options(point).changes().items()): point for point in campaign.points()}
    found: dict[tuple[int, ...], Run] = {}
    for file in sorted(folder.glob(f"*/*/{RUN_FILE}")):
        run = open_run(file.parent)
        point = points.get(tuple(run.changes.items()))
        if point is None:
            what = "this run belongs to no point of the campaign, which may have been changed since"
            raise ConfigError(Problem(what, visible(str(run.path)), expected="another folder"))
        found[point] = run
    return found


def recorded_runs(folder: Path) -> tuple[Campaign, dict[tuple[int, ...], Run]]:
    """The campaign of a folder, and the runs that it has so far: point -> run.

    Raises:
        ConfigError: A run has values of no point, or there are no runs.
        RecordingError: A run is damaged.
    """
    campaign = Campaign.read(folder / CAMPAIGN_FILE)
    words = [*campaign.axes.values()]
    points = {tuple(of[i] for of, i in zip(words, at, strict=True)): at for at in campaign.points()}
    found: dict[tuple[int, ...], Run] = {}
    for file in sorted(folder.glob(f"*/*/{RUN_FILE}")):
        run = open_run(file.parent)
        point = points.get(tuple(run.changes.get(address, "") for address in campaign.axes))
        if point is None:
            what = f"this run belongs to no point of {CAMPAIGN_FILE}, which may have been changed since"
            raise ConfigError(Problem(what, visible(str(run.path))))
        found[point] = run
    if not found:
        raise ConfigError(Problem("the campaign has no runs yet", visible(str(folder))))
    return campaign, found
