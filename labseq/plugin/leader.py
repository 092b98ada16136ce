"""What devices that receive the start signal of another control system share; see ``LeaderLink``."""

from __future__ import annotations

from labseq.drivers.leader import GO, LeaderLog, LeaderSettings, check_signal, load_atoms, load_until_go

__all__ = [
    "GO",
    "LeaderLog",
    "LeaderSettings",
    "check_signal",
    "load_atoms",
    "load_until_go",
]
