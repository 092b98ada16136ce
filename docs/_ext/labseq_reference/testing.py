"""What ``labseq.testing`` has for the tests of plugins, as Markdown."""

from __future__ import annotations

import inspect
from inspect import signature
from typing import Any

from labseq.testing import SUITES, fakes, strategies
from labseq.testing.contracts import HardwareContract
from labseq_reference import prose
from labseq_reference.python import definition
from labseq_reference.tables import table

HARDWARE = "hardware"
_FIXTURE = "factory"
_GIVEN = {"self", "device", "shape", "seed", "kind", "duration_s"}
"""Arguments of what a plugin's test may override; methods with others serve the suite itself."""


def contract(kind: str) -> list[str]:
    """A suite: what it is told by a plugin's test, and a row for each promise of its own.

    Raises:
        LookupError: There is no such kind.
    """
    suites = {**SUITES, HARDWARE: HardwareContract}
    if kind not in suites:
        raise LookupError(f"'{kind}' is not one of {', '.join(suites)}")
    suite = suites[kind]
    lines = [f"`{suite.__name__}`", "", *prose.markdown(suite).splitlines(), ""]
    own = [one for one in _members(suite) if one.__name__ not in _inherited(suite)]
    hooks = [one for one in own if not hasattr(one, "promise") and {*signature(one).parameters} <= _GIVEN]
    if hooks:
        lines += ["May be overridden:", ""]
        lines += [line for hook in hooks for line in definition(hook)]
    promises: list[tuple[Any, ...]] = [
        (one.promise, f"`{one.__name__}`", prose.summary(one)) for one in own if hasattr(one, "promise")
    ]
    return [*lines, *table(("promise", "test", "tried"), promises)]


def strategy_list() -> list[str]:
    """A definition per hypothesis strategy."""
    return _definitions(strategies)


def fake_list() -> list[str]:
    """A row per fake."""
    return table(
        ("name", "what it is"), [(f"`{name}`", prose.summary(getattr(fakes, name))) for name in fakes.__all__]
    )


def _definitions(module: Any) -> list[str]:
    functions = [one for one in vars(module).values() if inspect.isfunction(one)]
    own = [one for one in functions if one.__module__ == module.__name__ and not one.__name__.startswith("_")]
    return [line for one in own for line in definition(one)]


def _members(suite: type[Any]) -> list[Any]:
    """Public methods in the order of the source, those of its own first."""
    found: dict[str, Any] = {}
    for of in suite.__mro__:
        for name, one in vars(of).items():
            if inspect.isfunction(one) and not name.startswith("_") and name != _FIXTURE:
                found.setdefault(name, one)
    return list(found.values())


def _inherited(suite: type[Any]) -> set[str]:
    """What another suite is documented with: the promises of all hardware."""
    if suite is HardwareContract or not issubclass(suite, HardwareContract):
        return set()
    return {one.__name__ for one in _members(HardwareContract)}
