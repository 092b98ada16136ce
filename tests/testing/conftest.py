"""Runs a contract suite against a plugin, without pytest around it, and tells what broke."""

from collections.abc import Callable
from typing import Any

import pytest

from labseq.testing import BrokenPromise

Factory = Callable[..., Any]


def broken_promises(suite: object, factory: Factory) -> dict[str, str]:
    """Test -> the promise that it found broken."""
    broken: dict[str, str] = {}
    for name in (name for name in dir(suite) if name.startswith("test_")):
        try:
            getattr(suite, name)(factory)
        except BrokenPromise as error:
            assert str(error).startswith(f"promise: {error.promise}; but ")
            broken[name] = error.promise
    return broken


@pytest.fixture
def keeps_all() -> Callable[[object, Factory], None]:
    """Asserts that a plugin keeps every promise of a suite."""

    def check(suite: object, factory: Factory) -> None:
        assert broken_promises(suite, factory) == {}

    return check


@pytest.fixture
def breaks_only() -> Callable[[object, Factory, str], None]:
    """Asserts that a plugin breaks the promise of one test of a suite, and no other."""

    def check(suite: object, factory: Factory, test: str) -> None:
        broken = broken_promises(suite, factory)
        promise = getattr(suite, test).promise
        assert broken.get(test) == promise
        assert set(broken.values()) == {promise}, broken

    return check
