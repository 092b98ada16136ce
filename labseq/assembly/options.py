"""The options of a session."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Self, get_args

from labseq.config.addresses import Override
from labseq.errors import ConfigError, Problem
from labseq.messages import clean

DryRun = Literal["off", "full", "fast"]

NOT_SET: Final = ("profile", "dry_run")
"""Options that do not replace a value of the sequence."""


def path_of(value: Any, name: str) -> Path:
    """Convert a caller's argument to a path.

    Raises:
        ConfigError: The argument is not a path.
    """
    try:
        return Path(value)
    except TypeError:
        raise ConfigError(Problem(f"{name} is {clean(repr(value))}", expected="a path")) from None


def check_dry_run(dry_run: object) -> None:
    """Raise for an unknown kind of dry run, so that a typing error cannot open hardware.

    Raises:
        ConfigError: The kind is unknown.
    """
    if dry_run not in get_args(DryRun):
        raise ConfigError(
            Problem(f"dry_run is {dry_run!r}", expected=f"one of {', '.join(map(repr, get_args(DryRun)))}")
        )


@dataclass(frozen=True, slots=True)
class Options:
    """The options of a session, which replace values of its files.

    Attributes:
        profile: Name or path of the profile, instead of the sequence's own.
        shots: Number of shots, instead of the sequence's own.
        seed: Seed, instead of the sequence's own or a new one.
        overrides: ``"address=value"`` strings, as given to ``--set``. They take precedence.
        output: Folder for the data, instead of LABSEQ_DATA or ``./data``.
        dry_run: With "full", a device is replaced by its plugin's simulator, or else by its virtual twin.
            "fast" uses virtual twins only. "off" uses the devices.
        realtime: Let virtual time pass at the speed of real time.
        note: A note about the run, for people.
        tags: Words for finding the run.
    """

    profile: str | Path | None = None
    shots: int | None = None
    seed: int | None = None
    overrides: Sequence[str] = ()
    output: Path | None = None
    dry_run: DryRun = "off"
    realtime: bool = False
    note: str = ""
    tags: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.profile, str | Path | None):  # pyright: ignore[reportUnnecessaryIsInstance]
            what = f"profile is {clean(repr(self.profile))}"
            raise ConfigError(Problem(what, expected="the name or the path of a hardware profile"))
        check_dry_run(self.dry_run)

    @classmethod
    def of(cls, changes: Mapping[str, Any], *, realtime: bool = False) -> Self:
        """Options from their changes, the inverse of :meth:`changes`."""
        own = {key: int(changes[key]) for key in ("shots", "seed") if str(changes.get(key)).isdecimal()}
        return cls(
            profile=changes.get("profile"),
            shots=own.get("shots"),
            seed=own.get("seed"),
            overrides=tuple(f"{a}={v}" for a, v in changes.items() if a not in {*own, *NOT_SET}),
            dry_run=changes.get("dry_run", "off"),
            realtime=realtime,
        )

    def own(self) -> list[Override]:
        """``shots`` and ``seed`` as overrides that carry the name of their option."""
        given = {"shots": self.shots, "seed": self.seed}
        return [
            Override(key, str(value), f"--{key} {value}") for key, value in given.items() if value is not None
        ]

    def changes(self) -> dict[str, str]:
        """Everything that differs from the files: address -> value, as typed."""
        changed: dict[str, str] = {override.address: override.value for override in self.own()}
        changed |= dict(item.split("=", 1) for item in self.overrides)
        if self.profile is not None:
            changed["profile"] = str(self.profile)
        if self.dry_run != "off":
            changed["dry_run"] = self.dry_run
        return changed
