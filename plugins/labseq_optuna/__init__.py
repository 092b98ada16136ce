"""A scanner that lets Optuna, a library of optimisers, choose the points."""

from labseq.plugin import Registry, hookimpl

LABSEQ_API = 1


@hookimpl
def labseq_register(registry: Registry) -> None:
    """Offer the scanner ``optuna``."""
    scanner, settings = "labseq_optuna.scanner:OptunaScanner", "labseq_optuna.scanner:OptunaSettings"
    registry.scanner("optuna", scanner, settings)
