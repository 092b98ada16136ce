"""A campaign file: a sequence that is run at each point of a grid of values, in one folder."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from labseq.assembly.options import Options
from labseq.config.addresses import split_overrides
from labseq.config.document import Document, StoredText
from labseq.config.find import find_profile, find_sequence
from labseq.data.reader import Run, open_run
from labseq.errors import ConfigError, Problem
from labseq.messages import visible
from labseq.recording.folders import RUN_FILE
from labseq.recording.listing import runs_in
from labseq.settings import Settings
from labseq.text_files import read_bytes

MAX_POINTS: Final = 10_000
CAMPAIGN_FILE: Final = "campaign.yaml"
"""The copy of the campaign file in the campaign's folder."""

Point = tuple[int, ...]
"""The index of a value on each axis."""


class CampaignSettings(Settings):
    """The content of a campaign file."""

    labseq: Literal[1]
    sequence: str = Field(
        description="the sequence file, in the folder of this file, or the name of a sequence"
    )
    profile: str | None = Field(default=None, description="hardware profile, instead of the sequence's own")
    axes: dict[str, list[Any]] = Field(
        default={}, description="address, as for --set, and its values, of which every combination is a point"
    )
    repeats: int = Field(default=1, ge=1, description="shots at each point")
    runs: int = Field(
        default=1,
        ge=1,
        description="runs that share the shots of a point, each with a seed made from the campaign's seed",
    )
    seed: int | None = Field(default=None, ge=0, description="seed of all runs (default: each has its own)")


class PlannedRun(NamedTuple):
    """One run of a campaign.

    Attributes:
        point: Its point.
        options: The options with which it is opened.
    """

    point: Point
    options: Options


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
    def read(cls, path: Path, text: str | None = None) -> Campaign:
        """Read a campaign file.

        Args:
            text: Its text, if it is already known.

        Raises:
            ConfigError: The file has an error. The message gives its place.
        """
        document = Document.read(path, None if text is None else StoredText(text, str(path)))
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
        if settings.runs > settings.repeats:
            what = f"{settings.runs} runs cannot share {settings.repeats} shots"
            raise document.error(("runs",), what, "at most 'repeats'")
        if settings.runs > 1 and settings.seed is None:
            what = "'seed' is missing, from which the seeds of the runs are made"
            raise document.error(("runs",), what, "'seed: 1', or another whole number")
        return cls(document, settings, axes)

    @property
    def sequence(self) -> Path:
        """The sequence file, or the name of one."""
        path = self.document.path.parent / self.settings.sequence
        return path if path.is_file() else Path(self.settings.sequence)

    def points(self) -> Iterator[Point]:
        """The indices of the values of each point. The last axis changes fastest."""
        yield from itertools.product(*(range(len(values)) for values in self.axes.values()))

    def values(self, point: Point) -> list[str]:
        """The value on each axis, as it was typed."""
        return [values[i] for values, i in zip(self.axes.values(), point, strict=True)]

    def runs(self) -> Iterator[PlannedRun]:
        """The runs of all points, in order."""
        for point in self.points():
            for part in range(self.settings.runs):
                yield PlannedRun(point, self._options(point, part))

    def _options(self, point: Point, part: int) -> Options:
        profile = self.settings.profile
        if profile is not None and (path := self.document.path.parent / profile).is_file():
            profile = str(path)
        n_shots, more = divmod(self.settings.repeats, self.settings.runs)
        overrides = tuple(f"{a}={v}" for a, v in zip(self.axes, self.values(point), strict=True))
        return Options(profile, n_shots + (part < more), self._seed(part), overrides)

    def _seed(self, part: int) -> int | None:
        """The seed of one of the runs of each point: 63 random bits, so that the runs are independent."""
        seed = self.settings.seed
        if seed is None or self.settings.runs == 1:
            return seed
        return int(np.random.SeedSequence(seed, spawn_key=(part,)).generate_state(1, np.uint64)[0] >> 1)

    def find_files(self) -> None:
        """Check that the sequence and the profile exist.

        Raises:
            ConfigError: A file does not exist. The message gives its place in this file.
        """
        finds = {
            "sequence": lambda: read_bytes(find_sequence(self.sequence)),
            "profile": lambda: find_profile(self.settings.profile or "", self.document.path.parent),
        }
        for name, find in finds.items():
            try:
                if getattr(self.settings, name) is not None:
                    find()
            except ConfigError as error:
                [problem] = error.problems
                raise self.document.error((name,), problem.what, problem.expected, problem.hint) from error

    def placed(self, error: ConfigError, run: PlannedRun) -> ConfigError:
        """An error of a run, with its place in the campaign file if a value there causes it."""
        return ConfigError([self._placed(problem, run) for problem in error.problems])

    def _placed(self, problem: Problem, run: PlannedRun) -> Problem:
        for option, address, i in zip(run.options.overrides, self.axes, run.point, strict=True):
            overrides = itertools.chain(*split_overrides([option]))
            if any(problem.source == override.source for override in overrides):
                line, column = self.document.locate(("axes", address, i))
                return replace(problem, source=self.document.name, line=line, column=column)
        return problem


def run_folders(folder: Path) -> list[Path]:
    """The folders of a campaign's runs, without those that are still being created."""
    return [path for path in runs_in(folder) if (path / RUN_FILE).is_file()]


def recorded_runs(folder: Path) -> tuple[Campaign, dict[Point, list[Run]]]:
    """The campaign of a folder, and its runs so far: point -> its runs.

    Of two runs with the same shots, the run with more shots counts. A cluster takes a run again if the
    computer that started it has disappeared.

    Raises:
        ConfigError: A run has values of no point, or there are no runs.
        RecordingError: A run is damaged.
    """
    campaign = Campaign.read(folder / CAMPAIGN_FILE)
    planned = {
        _shots_of(campaign.values(run.point), run.options.changes()): run.point for run in campaign.runs()
    }
    best: dict[Any, Run] = {}
    for path in run_folders(folder):
        run = open_run(path)
        key = _shots_of([run.changes.get(address, "") for address in campaign.axes], run.changes)
        if key not in planned:
            what = f"this run belongs to no point of {CAMPAIGN_FILE}, which may have been changed"
            raise ConfigError(Problem(what, visible(str(run.path))))
        if key not in best or len(run.shots) > len(best[key].shots):
            best[key] = run
    if not best:
        raise ConfigError(Problem("the campaign has no runs yet", visible(str(folder))))
    runs: dict[Point, list[Run]] = {point: [] for point in campaign.points()}
    for key, point in planned.items():  # in the order of their seeds, whichever was begun first
        runs[point] += [best[key]] if key in best else []
    return campaign, runs


def _shots_of(values: Sequence[str], changes: Mapping[str, str]) -> tuple[tuple[str, ...], str | None]:
    """The values that determine the shots of a run in a campaign: those of its axes, and its seed."""
    return tuple(values), changes.get("seed")
