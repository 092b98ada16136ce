"""The flat public namespace and the registry as Markdown."""

from __future__ import annotations

import inspect
from typing import Any, Final

import labseq
from labseq.registry import Registry
from labseq_reference import prose
from labseq_reference.python import definition
from labseq_reference.tables import table

_SCRIPTS: Final = (
    "open_run",
    "Session.open",
    "Session.resume",
    "make_planner",
    "make_target",
    "check_plan",
    "tone_program",
    "render",
    "as_occupancy",
)
"""What a script or a notebook calls."""
_ALIASES: Final = {
    "FilePath": "a path in a settings model, relative to the file that holds it",
    "LABSEQ_API": "version of the interface that plugins are written for",
    "Occupancy": "a boolean array (rows, columns): which sites hold an atom",
    "RfSpan": "`RfSamples` or `RfTones`",
    "Trigger": "how an exposure starts: `internal`, `software` or `external`",
    "hookimpl": "marks a function as the implementation of a hook",
    **dict.fromkeys(
        ("Angle", "Duration", "Fraction", "Frequency", "Length", "Speed", "Temperature", "Voltage"),
        "a quantity in a settings model: with a unit in the file, SI inside",
    ),
}
"""Names whose docstring is not their own."""


def scripts() -> list[str]:
    """A definition for each function that scripts call."""
    return [line for name in _SCRIPTS for line in definition(_find(name), name=f"labseq.{name}")]


def names() -> list[str]:
    """All public names in a table."""
    rows = [(f"`{name}`", _summary(name)) for name in public_names()]
    return table(("`labseq.`", "what it is"), rows, ("namespace",))


def registry() -> list[str]:
    """A definition for each method by which a plugin offers something."""
    methods = [one for name, one in vars(Registry).items() if inspect.isfunction(one) and _offers(name, one)]
    return [line for one in methods for line in definition(one, name=f"registry.{one.__name__}")]


def public_names() -> list[str]:
    """What ``labseq`` offers to scripts and plugins."""
    return sorted(name for names in vars(labseq)["_HOMES"].values() for name in names)


def _offers(name: str, function: Any) -> bool:
    return not name.startswith("_") and "factory" in inspect.signature(function).parameters


def _find(name: str) -> Any:
    found: Any = labseq
    for part in name.split("."):
        found = getattr(found, part)
    return found


def _summary(name: str) -> str:
    return _ALIASES.get(name) or prose.summary(_find(name)).removesuffix(".")
