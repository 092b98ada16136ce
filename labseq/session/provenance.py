"""Which code made the data."""

from __future__ import annotations

import functools
import getpass
import hashlib
import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import labseq

_GIT_TIMEOUT_S: Final = 5.0


def gather_provenance(sequence_folder: Path) -> dict[str, Any]:
    """Collect what is needed to know, years later, which code made the data.

    Args:
        sequence_folder: Folder of the sequence; its repository is recorded beside
            that of labseq's own code.

    Returns:
        JSON-ready values: labseq, python, platform, host, user, git (of the code
        and of the sequence, with whether uncommitted changes were there), packages.
    """
    return {
        "labseq": labseq.__version__,
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "host": platform.node(),
        "user": _user(),
        "pid": os.getpid(),
        "git": {
            "code": git_state(Path(labseq.__file__).parent, of="__init__.py"),
            "sequence": git_state(sequence_folder),
        },
        "packages": dict(_packages()),
    }


def git_state(folder: Path, of: str = "") -> dict[str, Any] | None:
    """Commit of the repository that a folder is in, and how tracked files differ from it.

    Args:
        folder: The folder.
        of: A file in it that must be tracked: what is installed in an environment
            inside of somebody's repository does not come from that.

    Returns:
        ``{"commit": str, "dirty": bool, "code_sha256": str}``, or None outside of a repository or
        where git is not installed. ``dirty`` is whether any tracked file differs; ``code_sha256``
        stands for what differs in Python files, "" for nothing.
    """
    if of and _git(folder, "ls-files", "--error-unmatch", of) is None:
        return None
    commit = _git(folder, "rev-parse", "HEAD")
    if commit is None:
        return None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no")
    code = _git(folder, "diff", "--no-ext-diff", "--no-color", "HEAD", "--", ":(top)*.py") if changes else ""
    digest = hashlib.sha256(code.encode()).hexdigest() if code else ""
    return {"commit": commit, "dirty": bool(changes), "code_sha256": digest}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 - fixed arguments, no shell
            ["git", "--no-optional-locks", "-C", str(folder), *arguments],  # noqa: S607 - the user's own git
            capture_output=True,
            check=True,
            timeout=_GIT_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.decode(errors="replace").strip()


@functools.cache
def _packages() -> dict[str, str]:
    """Name -> version of all that is installed, read once: it takes as long as a quick shot."""
    about = [distribution.metadata for distribution in importlib.metadata.distributions()]
    return {name: one["Version"] for one in about if (name := one["Name"])}


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""
