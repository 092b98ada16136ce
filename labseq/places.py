"""Where profiles and runs are, found without importing what reads them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

PROFILES: Final = "hardware_profiles"
"""Name of the folders of hardware profiles."""
SEQUENCES: Final = "sequences"
"""Name of the folders of sequences."""


def packaged_dir(folder: str) -> Path:
    """The folder of the profiles or the sequences that come with labseq.

    In a wheel it lies in ``labseq/config``, in a checkout at the top.
    """
    here = Path(__file__).resolve().parent
    packaged = here / "config" / folder
    return packaged if packaged.is_dir() else here.parent / folder


def packaged_profiles_dir() -> Path:
    """The folder of the profiles that come with labseq."""
    return packaged_dir(PROFILES)


def packaged_sequences_dir() -> Path:
    """The folder of the sequences that come with labseq."""
    return packaged_dir(SEQUENCES)


def profile_dir(profile: Path) -> Path:
    """The folder in which what belongs to a profile is kept: its own.

    Of an installed profile it is ./hardware_profiles, where a copy of it would stand: what is installed
    is everybody's, may be read-only, and goes with the next version.
    """
    folder = profile.resolve().parent
    is_installed = folder == Path(__file__).resolve().parent / "config" / PROFILES
    return Path(PROFILES).absolute() if is_installed else profile.parent


def data_root() -> Path:
    """Where runs are kept if nothing else is said: LABSEQ_DATA, else ``./data``."""
    return Path(os.environ.get("LABSEQ_DATA") or "data").expanduser()
