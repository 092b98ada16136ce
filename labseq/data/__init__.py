"""Reads recorded runs, in progress or finished: shots, quantities, tables, exports.

Names are resolved when they are first used, so that a list of runs loads neither numpy nor h5py.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from labseq.data.reader import Run, open_run
    from labseq.data.shot import Shot

__all__ = ["Run", "Shot", "open_run"]

_MODULES: Final = {"Run": "reader", "Shot": "shot", "open_run": "reader"}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'labseq.data' has no attribute '{name}'")
    value = getattr(import_module(f"labseq.data.{_MODULES[name]}"), name)
    globals()[name] = value
    return value
