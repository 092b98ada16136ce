"""What a comparison of planners is made of, in words, so that every process can read it for itself."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem
from labseq.session.occupancies import MAX_SITES
from labseq.units import parse_quantity

Words = tuple[tuple[str, str], ...]
"""Key and value, as typed, of some settings."""

BARE_MOTION: Final[Words] = (("overhead_per_batch", "0"), ("overhead_per_cycle", "0"))
"""What is compared is the motion itself: ramps and transport."""

_BETWEEN_ENTRANTS: Final = re.compile(r",(?=\s*[^\W\d][\w.-]*\s*(?:,|\Z|:\s*[^\W\d]\w*\s*=))")
_BETWEEN_SETTINGS: Final = re.compile(r",(?=\s*[^\W\d]\w*\s*=)")
_NAME: Final = re.compile(r"[^\W\d][\w.-]*")
_GRID: Final = re.compile(r"\s*(\d{1,6})\s*[xX]\s*(\d{1,6})\s*")


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """A planner as it enters a comparison.

    Attributes:
        planner: Its name.
        settings: Its settings, as typed; all others have their defaults.
    """

    planner: str
    settings: Words = ()

    @property
    def label(self) -> str:
        """What tables call it.

        Example:
            >>> Entrant("psca", (("variant", "paper"),)).label
            'psca variant=paper'
        """
        return " ".join([self.planner, *(f"{key}={value}" for key, value in self.settings)])


@dataclass(frozen=True, slots=True)
class Condition:
    """What the planners are given: random loadings of a grid, and what to make of them.

    Attributes:
        shape: Rows and columns of the grid.
        target: A pattern, as after ``--target``.
        loading: Probability that a site is loaded.
        degree_of_parallelism: For every planner that has such a setting; None for its own.
        motion: Settings of the motion that differ from the defaults, as typed.
    """

    shape: tuple[int, int]
    target: str
    loading: float
    degree_of_parallelism: int | None = None
    motion: Words = BARE_MOTION


@dataclass(frozen=True, slots=True)
class Comparison:
    """Planners on the same loadings.

    Attributes:
        entrants: The planners.
        conditions: What they are given.
        n_loadings: How many loadings of each condition.
        seed: What all loadings are drawn from.
        settings: What ``--set`` changes in every planner, as typed.
        called: What messages name as the place of anything wrong: an option or a figure.
    """

    planner_entries: tuple[PlannerEntry, ...]
    conditions: tuple[Condition, ...]
    n_loadings: int
    seed: int
    settings: Words = ()
    called: str = "--planners"


def parse_entrants(text: str) -> tuple[PlannerEntry, ...]:
    """Read a list of planners, each with the settings that only it has.

    Raises:
        ConfigError: It is no such list, or names something twice.

    Example:
        >>> [entrant.label for entrant in parse_entrants("psca,psca:variant=paper,lsap")]
        ['psca', 'psca variant=paper', 'lsap']
    """
    option = clean(f"--planners {text}")
    planner_entries: list[PlannerEntry] = []
    for part in _BETWEEN_ENTRANTS.split(text):
        name, _, rest = part.partition(":")
        settings = [setting.partition("=") for setting in _BETWEEN_SETTINGS.split(rest)] if rest else []
        if not _NAME.fullmatch(name.strip()) or not all(key.strip() and value for key, _, value in settings):
            expected = "names with commas between them, each perhaps with settings: psca,psca:variant=paper"
            raise ConfigError(Problem("this is no list of planners", option, expected=expected))
        words = tuple((key.strip(), value.strip()) for key, _, value in settings)
        planner_entry = PlannerEntry(name.strip(), words)
        if planner_entry in planner_entries:
            raise ConfigError(Problem(f"'{clean(planner_entry.label)}' is named twice", option, expected="once"))
        planner_entries.append(planner_entry)
    return tuple(planner_entries)


def parse_grid(text: str) -> tuple[int, int]:
    """Read the size of a grid.

    Raises:
        ConfigError: It is none.

    Example:
        >>> parse_grid("20x24")
        (20, 24)
    """
    match = _GRID.fullmatch(text)
    shape = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= n <= MAX_SITES for n in shape):
        expected = f"ROWSxCOLS, 1 to {MAX_SITES} each, for example 20x20"
        raise ConfigError(Problem("this is no size of a grid", clean(f"--grid {text}"), expected=expected))
    return shape


def parse_loading(text: str) -> float:
    """Read the probability that a site is loaded.

    Raises:
        ConfigError: It is none.

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
        raise ConfigError(Problem("this is no probability", clean(f"--loading {text}"), expected=expected))
    return probability


def parse_overrides(texts: Sequence[str]) -> tuple[Words, Words]:
    """Part what ``--set`` changes in every planner from what it changes in the motion.

    Returns:
        Settings of the planners, and settings of ``profile.mobile_tweezers``.

    Raises:
        ConfigError: One is not of the form ``address=value``, or its address leads elsewhere.

    Example:
        >>> parse_overrides(["planner.row_order=fullest", "profile.mobile_tweezers.speed=75 um/ms"])
        ((('row_order', 'fullest'),), (('speed', '75 um/ms'),))
    """
    planner: list[tuple[str, str]] = []
    motion: list[tuple[str, str]] = []
    for text in texts:
        address, equals, value = text.partition("=")
        where, _, key = address.strip().rpartition(".")
        settings = {"": planner, "planner": planner, "profile.mobile_tweezers": motion}.get(where)
        if not equals or not key or settings is None:
            example = "planner.KEY=VALUE or profile.mobile_tweezers.KEY=VALUE"
            raise ConfigError(
                Problem("there is nothing to set here", clean(f"--set {text}"), expected=example)
            )
        settings.append((key, value))
    return tuple(planner), tuple(motion)
