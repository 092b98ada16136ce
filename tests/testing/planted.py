"""Plugins with a fault each, and which tests of a suite must fail on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import pytest

from labseq.testing import ContractViolation

Factory = Callable[..., Any]


@dataclass(frozen=True)
class Planted:
    """A suite, a plugin that keeps all its promises, and plugins that break one each.

    Attributes:
        suite: The suite, inherited as a plugin's test does.
        right: Factory of the right plugin.
        faults: Factory of a plugin, and the test whose promise it breaks; or several, of which the first one
            is for that promise, and the others cannot do without it either.
    """

    suite: object
    right: Factory
    faults: Sequence[tuple[Factory, str | tuple[str, ...]]]

    def each(self) -> Iterator[tuple[Factory, tuple[str, ...]]]:
        """Each plugin and the tests that fail on it."""
        for plugin, tests in self.faults:
            yield plugin, (tests,) if isinstance(tests, str) else tests


def failed_tests(suite: object, factory: Factory) -> dict[str, ContractViolation]:
    """Run a suite against a plugin, without pytest around it: test that fails -> what it said."""
    failed: dict[str, ContractViolation] = {}
    for name in promised_by(suite):
        try:
            getattr(suite, name)(factory)
        except pytest.skip.Exception:  # a promise that it cannot do without has a test that fails
            pass
        except ContractViolation as error:
            failed[name] = error
    return failed


def promised_by(suite: object) -> list[str]:
    """Names of the tests of a suite."""
    return [name for name in dir(suite) if name.startswith("test_")]


def name_of(factory: Any) -> str:
    """Name of a plugin's class, for messages."""
    return getattr(getattr(factory, "func", factory), "__name__", str(factory))
