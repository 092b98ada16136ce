"""A shot in a few numbers: what its images and cycles came to.

They stand in the shot's line of the index, so that a run of many thousand shots is summed
up without opening their files.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from numbers import Real
from typing import Any, Final, cast

from labseq.model import ShotRecord, TargetPattern
from labseq.recording.plain import to_plain

SIMULATION: Final = "simulation."
"""What the names of readings begin with that only a simulation can know."""

_MAX_TEXT: Final = 80
_MAX_DEPTH: Final = 4


@dataclass(frozen=True, slots=True)
class Images:
    """The images of a shot, in the order they were taken.

    Attributes:
        cycle: The cycle that each ended, counted from 1 within its step; 0 for that of an ``image`` step.
        t_start_s: Start of each exposure, from the start of the shot.
        exposure_s: Exposure times.
        n_defects: Empty target sites on each.
        n_surplus: Atoms on each on sites that must be empty.
    """

    cycle: tuple[int, ...] = ()
    t_start_s: tuple[float, ...] = ()
    exposure_s: tuple[float, ...] = ()
    n_defects: tuple[int, ...] = ()
    n_surplus: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.cycle)


@dataclass(frozen=True, slots=True)
class Cycles:
    """The rearrangement cycles of a shot, in the order they were made.

    Attributes:
        n_batches: Batches of each plan.
        n_batches_played: How many of them fitted into the window.
        n_atom_moves: Atom moves in those that were played.
    """

    n_batches: tuple[int, ...] = ()
    n_batches_played: tuple[int, ...] = ()
    n_atom_moves: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.n_batches)


@dataclass(frozen=True, slots=True)
class ShotSummary:
    """A shot in a few numbers.

    Attributes:
        images: Its images.
        cycles: Its cycles.
        simulation: Truths that a simulation told, such as "lost.vacuum"; empty on real hardware.
    """

    images: Images
    cycles: Cycles
    simulation: Mapping[str, float]

    @property
    def is_judged(self) -> bool:
        """Whether no cycle ended with the last image: that one may have been chosen for being good."""
        return not any(self.images.cycle[-1:])

    def as_row(self) -> dict[str, Any]:
        """What goes into the index, JSON-ready; :func:`summary_in` reads it."""
        return asdict(self)


def summarise(shot: ShotRecord, target: TargetPattern) -> ShotSummary:
    """Sum up a shot.

    Args:
        shot: Its record.
        target: The target of the run.
    """
    occupancies = [image.occupancy.reshape(target.shape) for image in shot.images]
    images = Images(
        cycle=tuple(image.cycle for image in shot.images),
        t_start_s=tuple(round(float(image.t_start_s), 9) for image in shot.images),
        exposure_s=tuple(float(image.exposure_s) for image in shot.images),
        n_defects=tuple(map(target.n_defects, occupancies)),
        n_surplus=tuple(map(target.n_surplus, occupancies)),
    )
    cycles = Cycles(
        n_batches=tuple(cycle.plan.n_batches for cycle in shot.cycles),
        n_batches_played=tuple(cycle.n_batches_played for cycle in shot.cycles),
        n_atom_moves=tuple(int(cycle.plan.batch_offsets[cycle.n_batches_played]) for cycle in shot.cycles),
    )
    told = {
        name.removeprefix(SIMULATION): float(value)
        for name, value in shot.readings.items()
        if name.startswith(SIMULATION) and isinstance(value, Real)
    }
    return ShotSummary(images, cycles, told)


def flat_readings(readings: Mapping[str, Any]) -> dict[str, Any]:
    """The readings that are single values, by dotted names; those of a simulation stand in its summary.

    Example:
        >>> flat_readings({"laser": {"power_w": 0.1, "trace": [1, 2]}, "simulation.lost.vacuum": 2.0})
        {'laser.power_w': 0.1}
    """
    told = {name: value for name, value in readings.items() if not name.startswith(SIMULATION)}
    return dict(_flat("", to_plain(told), _MAX_DEPTH))


def _flat(prefix: str, values: Mapping[str, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict) and depth:
            yield from _flat(f"{prefix}{name}.", cast("dict[str, Any]", value), depth - 1)
        elif isinstance(value, bool | int | float) or (isinstance(value, str) and len(value) <= _MAX_TEXT):
            yield f"{prefix}{name}", value


def summary_in(row: Mapping[str, Any]) -> ShotSummary | None:
    """The summary in a line of the index; None if there is none, as before version 1.1, or it is damaged."""
    try:
        images, cycles = (
            _columns(kind, row[name]) for kind, name in ((Images, "images"), (Cycles, "cycles"))
        )
        told = {str(name): float(value) for name, value in row["simulation"].items() if _is_number(value)}
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    return ShotSummary(cast("Images", images), cast("Cycles", cycles), told)


def _columns(kind: type[Images | Cycles], table: Mapping[str, Any]) -> Images | Cycles:
    """A table of numbers.

    Raises:
        ValueError: Its columns differ in length, or hold something else.
    """
    columns = [tuple(table[field.name]) for field in fields(kind)]
    if len({*map(len, columns)}) > 1 or not all(_is_number(value) for one in columns for value in one):
        raise ValueError(kind.__name__)
    return kind(*columns)


def _is_number(value: object) -> bool:
    return type(value) in (int, float)
