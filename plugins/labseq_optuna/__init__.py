"""A scanner that lets Optuna, a library of optimisers, choose the points."""

from __future__ import annotations

from labseq.plugin import Registry, hookimpl
from labseq_optuna.scanner import OptunaScanner, OptunaSettings

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the scanner ``optuna``."""
    registry.scanner("optuna", OptunaScanner, OptunaSettings)
