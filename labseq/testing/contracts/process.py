"""What all code of a process shares, and a plugin must leave as it is."""

from __future__ import annotations

import os
import random
import warnings
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Final

import numpy as np

from labseq.testing.contracts.watch import watch_io


def _numpy_state() -> tuple[object, ...]:
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 - the global one is what is watched
    return (name, np.asarray(keys).tobytes(), *rest)


_STATES: Final[Mapping[str, Callable[[], object]]] = {
    "it drew from random; make a numpy Generator of your own": random.getstate,
    "it drew from numpy.random; make a Generator of your own": _numpy_state,
    "it changed numpy's error state; use `with numpy.errstate(...)`": np.geterr,
    "it changed the warnings' filters; use `with warnings.catch_warnings()`": lambda: tuple(warnings.filters),
    "it changed the working folder": os.getcwd,
    "it changed the environment's variables": lambda: dict(os.environ),
}


def process_state() -> list[object]:
    """What all code of this process shares."""
    return [state() for state in _STATES.values()]


def changes_since(before: list[object]) -> list[str]:
    """What was changed, as sentences; ``before`` is an earlier :func:`process_state`."""
    return [what for what, was, now in zip(_STATES, before, process_state(), strict=True) if was != now]


@contextmanager
def quietly(advice: str = "") -> Generator[None]:
    """What is done inside does no I/O and leaves the process as it is.

    Args:
        advice: Said to who does otherwise.

    Raises:
        AssertionError: It does not; says what it did.
    """
    __tracebackhide__ = True
    random.random()  # so that the state is not what a fixed seed leaves behind
    np.random.random()  # noqa: NPY002 - the global one is what is watched
    before = process_state()
    with watch_io() as seen:
        yield
    did = [f"it did {', '.join(seen)}"] if seen else []
    did += changes_since(before)
    assert not did, "; ".join([*did, advice] if advice else did)
