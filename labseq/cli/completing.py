"""What the shell completes: kinds, names of profiles and plugins, folders of runs.

A shell asks at every press of the tab key: nothing heavy is imported here, no plugin is loaded, and
nothing that goes wrong is told.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

from labseq.places import PROFILES, data_root, packaged_profiles_dir
from labseq.registry import KINDS

_FILES: Final = ("sequence", "profile")
_YAML: Final = (".yaml", ".yml")
MAX_RUNS: Final = 20
"""Most runs that are offered, the newest first."""


def new_kinds(incomplete: str) -> list[str]:
    """What ``labseq new`` can make.

    Example:
        >>> new_kinds("st")
        ['static_tweezers', 'step']
    """
    return [kind for kind in (*_FILES, *KINDS) if kind.startswith(incomplete)]


def file_kinds(incomplete: str) -> list[str]:
    """Kinds of file."""
    return [kind for kind in _FILES if kind.startswith(incomplete)]


def profile_names(incomplete: str) -> list[str]:
    """Profiles in ./hardware_profiles and those that come with labseq, by name."""
    found: set[str] = set()
    for folder in (Path(PROFILES), packaged_profiles_dir()):
        with suppress(OSError):
            found |= {path.stem for path in folder.iterdir() if path.suffix.lower() in _YAML}
    return sorted(name for name in found if name.startswith(incomplete))


def run_folders(incomplete: str) -> list[str]:
    """Folders of runs, the newest first."""
    with suppress(OSError):
        runs = sorted(data_root().glob("????-??-??/[0-9]*/run.json"), reverse=True)
        found = (str(path.parent) for path in runs)
        return [run for run in found if run.startswith(incomplete)][:MAX_RUNS]
    return []
