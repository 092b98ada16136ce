"""A run as an entry in the list of runs, without its shots."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from labseq.data.numbers import Result
from labseq.recording.listing import counter_of

if TYPE_CHECKING:
    from labseq.data.reader import Run


@dataclass(frozen=True, slots=True)
class RunEntry:
    """A run in a data folder. If it is damaged, only its folder, its notes and the error are known.

    Attributes:
        path: The run's folder.
        t_start_utc: When it began, ISO 8601, UTC. "" if unknown.
        name: Name of the sequence.
        sequence: Name of the sequence's file, without folder and ending.
        profile: Name of the hardware profile.
        target: Name of the target.
        status: "running", "complete", "stopped", "failed" or "damaged".
        error: Why it failed or cannot be read.
        simulated: Whether all hardware was simulated.
        seed: Seed of the run.
        shots: Number of shots that count.
        n_shots: Number of shots that were asked for.
        bytes: Size of the shots' files.
        scanned: Scanned address -> its values in words, such as "1 ms to 20 ms, 8 values".
        changes: Address -> value, as typed, of settings changed by ``--set`` and other options.
        settings: The same values in SI units.
        calibrations: Kind -> id of the calibrations in use.
        results: Its results, the most important first.
        note: The note about the run.
        tags: Tags of the run.
    """

    path: Path
    t_start_utc: str = ""
    name: str = ""
    sequence: str = ""
    profile: str = ""
    target: str = ""
    status: str = "damaged"
    error: str = ""
    simulated: bool | None = None
    seed: int | None = None
    shots: int | None = None
    n_shots: int | None = None
    bytes: int | None = None
    scanned: Mapping[str, str] = field(default_factory=dict[str, str])
    changes: Mapping[str, str] = field(default_factory=dict[str, str])
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    calibrations: Mapping[str, str] = field(default_factory=dict[str, str])
    results: Sequence[Result] = ()
    note: str = ""
    tags: Sequence[str] = ()

    @property
    def id(self) -> str:
        """The whole name of the run, such as "2026-11-20/0075_lifetime"."""
        return f"{self.path.parent.name}/{self.path.name}"

    @property
    def number(self) -> str:
        """The shortest name that identifies the run, such as "2026-11-20/75"."""
        return f"{self.path.parent.name}/{counter_of(self.path.name)}"

    @property
    def scanned_text(self) -> str:
        """The scanned values in one line, such as "hold.duration 1 ms to 20 ms, 8 values"."""
        short = (re.sub(r"^(shot|profile)\.", "", address) for address in self.scanned)
        return "; ".join(map(" ".join, zip(short, self.scanned.values(), strict=True)))

    @property
    def values(self) -> dict[str, Any]:
        """Every value that a condition can name: results, settings, "shots" and "n_shots", in SI."""
        # reversed: of two results with one name the first counts because it is more important
        results = {result.name: result.value.value for result in reversed(self.results)}
        counts = {"shots": self.shots, "n_shots": self.n_shots}
        return {
            name: one for name, one in (counts | dict(self.settings) | results).items() if one is not None
        }

    @property
    def text(self) -> str:
        """The text that a search looks through: names, notes, settings and results, in lower case."""
        settings = (f"{address}={value}" for address, value in self.changes.items())
        words = (
            self.id,
            self.name,
            self.sequence,
            self.profile,
            self.target,
            self.status,
            self.error,
            self.note,
        )
        kind = ["simulated"] if self.simulated else []
        results = map(str, self.results)
        return " ".join([*words, *kind, *self.tags, *self.scanned, *settings, *results]).lower()

    def open(self) -> Run:
        """Open the run.

        Raises:
            RecordingError: The run is damaged.
        """
        from labseq.data.reader import open_run  # takes longer than a list of 10,000 runs

        return open_run(self.path)
