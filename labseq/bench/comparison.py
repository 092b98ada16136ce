"""The planners and conditions of a comparison, read from the command line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labseq.assembly.occupancies import MAX_SITES
from labseq.errors import ConfigError, Problem
from labseq.messages import clean
from labseq.units import parse_quantity

SettingTexts = tuple[tuple[str, str], ...]
"""Settings as key and value, as typed."""

BARE_MOTION: Final[SettingTexts] = (("overhead_per_batch", "0"), ("overhead_per_cycle", "0"))
"""Overheads that are set to 0, because only ramps and transport are compared."""

_NAME: Final = r"[^\W\d][\w.-]*"
"""Pattern of a planner's name."""
_KEY_AND_EQUALS: Final = r"[^\W\d]\w*\s*="
"""Pattern of a setting up to its value, which may contain commas."""


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """A planner in a comparison. Settings that are not given have their defaults."""

    planner: str
    settings: SettingTexts = ()

    @property
    def label(self) -> str:
        """Name of the planner in tables.

        Example:
            >>> PlannerEntry("psca", (("variant", "paper"),)).label
            'psca variant=paper'
        """
        return " ".join([self.planner, *(f"{key}={value}" for key, value in self.settings)])


@dataclass(frozen=True, slots=True)
class Condition:
    """A grid, its loading probability, target and motion, for which all planners plan.

    Attributes:
        shape: Rows and columns of the grid.
        target: A pattern or a sequence, as after ``--target``.
        loading: Probability that a site is loaded.
        degree_of_parallelism: Value for every planner with such a setting. None for the planner's default.
        motion: Settings of the motion that differ from the defaults, as typed.
    """

    shape: tuple[int, int]
    target: str
    loading: float
    degree_of_parallelism: int | None = None
    motion: SettingTexts = BARE_MOTION


@dataclass(frozen=True, slots=True)
class Comparison:
    """Planners on the same loadings.

    Attributes:
        planner_entries: The planners.
        conditions: Each has ``n_loadings`` loadings.
        n_loadings: Number of loadings of each condition.
        seed: Seed of all loadings.
        settings: Settings from ``--set`` for every planner, as typed.
        called: How messages name the planners, by an option or a figure.
    """

    planner_entries: tuple[PlannerEntry, ...]
    conditions: tuple[Condition, ...]
    n_loadings: int
    seed: int
    settings: SettingTexts = ()
    called: str = "--planners"


def parse_planners(text: str) -> tuple[PlannerEntry, ...]:
    """Read a list of planners, each with its individual settings.

    Raises:
        ConfigError: The text is not such a list, or names a planner or setting twice.

    Example:
        >>> [entry.label for entry in parse_planners("psca,psca:variant=paper,lsap")]
        ['psca', 'psca variant=paper', 'lsap']
    """
    option = clean(f"--planners {text}")
    planner_entries: list[PlannerEntry] = []
    for part in re.split(rf",(?=\s*{_NAME}\s*(?:,|\Z|:\s*{_KEY_AND_EQUALS}))", text):
        name, _, settings_text = part.partition(":")
        items = re.split(rf",(?=\s*{_KEY_AND_EQUALS})", settings_text) if settings_text else []
        settings = [item.partition("=") for item in items]
        if not re.fullmatch(_NAME, name.strip()) or not all(
            key.strip() and value for key, _, value in settings
        ):
            expected = "names with commas between them, if need be with settings: psca,psca:variant=paper"
            raise ConfigError(Problem("this is not a list of planners", option, expected=expected))
        texts = tuple((key.strip(), value.strip()) for key, _, value in settings)
        planner_entry = PlannerEntry(name.strip(), texts)
        if planner_entry in planner_entries:
            raise ConfigError(
                Problem(f"'{clean(planner_entry.label)}' is named twice", option, expected="once")
            )
        planner_entries.append(planner_entry)
    return tuple(planner_entries)


def parse_grid(text: str) -> tuple[int, int]:
    """Read the size of a grid.

    Example:
        >>> parse_grid("20x24")
        (20, 24)
    """
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX]\s*(\d{1,6})\s*", text)
    shape = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= n <= MAX_SITES for n in shape):
        expected = f"ROWSxCOLS, 1 to {MAX_SITES} each, for example 20x20"
        raise ConfigError(Problem("this is not a grid size", clean(f"--grid {text}"), expected=expected))
    return shape


def parse_loading(text: str) -> float:
    """Read the probability that a site is loaded.

    Example:
        >>> parse_loading("75 %"), parse_loading("0.55")
        (0.75, 0.55)
    """
    try:
        probability = parse_quantity(text, "fraction")
    except ValueError:
        probability = -1.0
    if not 0.0 <= probability <= 1.0:
        expected = "a number from 0 to 1, or 0 % to 100 %"
        raise ConfigError(Problem("this is not a probability", clean(f"--loading {text}"), expected=expected))
    return probability


def parse_parallelism(text: str | None) -> tuple[int | None, ...]:
    """Read degrees of parallelism. (None,) keeps each planner's own value.

    Example:
        >>> parse_parallelism("7,15"), parse_parallelism(None)
        ((7, 15), (None,))
    """
    if text is None:
        return (None,)
    try:
        return tuple(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError as error:
        expected = "whole numbers with commas between them, for example 7,15,20"
        raise ConfigError(
            Problem("this is not a degree of parallelism", clean(f"--dop {text}"), expected=expected)
        ) from error


def parse_overrides(texts: Sequence[str]) -> tuple[SettingTexts, SettingTexts]:
    """Separate the settings of planners from settings of the motion in the values of ``--set``.

    Returns:
        Settings of the planners, and settings of ``profile.mobile_tweezers``.

    Raises:
        ConfigError: A value is not of the form ``address=value``, or has another address.

    Example:
        >>> parse_overrides(["planner.row_order=fullest", "profile.mobile_tweezers.speed=75 um/ms"])
        ((('row_order', 'fullest'),), (('speed', '75 um/ms'),))
    """
    planner: list[tuple[str, str]] = []
    motion: list[tuple[str, str]] = []
    for text in texts:
        address, equals, value = text.partition("=")
        key = address.strip().removeprefix("profile.mobile_tweezers.")
        settings = motion
        if key == address.strip():
            key, settings = key.removeprefix("planner."), planner
        if not equals or not key or (settings is planner and "." in key):
            example = "planner.KEY=VALUE or profile.mobile_tweezers.KEY=VALUE"
            raise ConfigError(
                Problem("there is nothing to set here", clean(f"--set {text}"), expected=example)
            )
        settings.append((key, value))
    return tuple(planner), tuple(motion)


def read_comparison(
    planners: str = "psca",
    grid: str = "20x20",
    target: str = "{pattern: compact, rows: 15, cols: 15}",
    loading: str = "75 %",
    dop: str | None = None,
    loadings: int = 1000,
    seed: int = 1,
    overrides: Sequence[str] = (),
) -> Comparison:
    """Read the options of ``labseq bench planners``. Raises ``ConfigError`` if one has an error."""
    settings, motion = parse_overrides(overrides)
    condition = parse_grid(grid), target, parse_loading(loading)
    conditions = tuple(Condition(*condition, n, (*BARE_MOTION, *motion)) for n in parse_parallelism(dop))
    return Comparison(
        parse_planners(planners), conditions, loadings, seed, settings, f"--planners {planners}"
    )
