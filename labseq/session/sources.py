"""The code that makes a run's data, with the used plugins, their sources, and their repositories."""

from __future__ import annotations

import functools
import hashlib
import io
import os
import subprocess
import zipfile
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import labseq
from labseq.plugins.host import PluginHost
from labseq.recording.folders import SOURCES_FILE

LABSEQ_DIFF: Final = "labseq.diff"
"""Name in the archive of the differences between labseq's own code and its commit."""
_SUFFIXES: Final = (".py", ".c", ".cpp", ".h", ".pyx")
_GIT_TIMEOUT_S: Final = 5.0

Sources = Mapping[str, bytes]
"""The files of a plugin, path in its folder -> content."""


class ReadSources(NamedTuple):
    """The sources of a plugin, and their digest."""

    files: Sources
    sha256: str


@dataclass(frozen=True, slots=True)
class RunCode:
    """The code of a run.

    Attributes:
        plugins: Entry of each used plugin in the run's record, with "name", "origin", "version", "path",
            "sha256" of its sources, "git" from :meth:`Repository.plain` or None, and "used", the kinds and
            names that are used of it.
        git: The repositories of labseq's own code ("code") and of the sequence ("sequence"), likewise.
        archive: The sources of the plugins, as a zip file.
    """

    plugins: tuple[Mapping[str, Any], ...]
    git: Mapping[str, Any]
    archive: bytes

    def is_of(self, host: PluginHost) -> bool:
        """Whether exactly the same parts of the same plugins are used now."""
        return [[*plugin.offers] for plugin in host.used()] == [plugin["used"] for plugin in self.plugins]


class Repository(NamedTuple):
    """The state of a git repository.

    Attributes:
        commit: Its commit.
        dirty: Whether any tracked file differs from the commit.
        diff: The differences of its tracked Python files.
    """

    commit: str
    dirty: bool
    diff: str

    def plain(self) -> dict[str, Any]:
        """The state for a run's record, with the digest of the differences, "" if there are none."""
        digest = hashlib.sha256(self.diff.encode()).hexdigest() if self.diff else ""
        return {"commit": self.commit, "dirty": self.dirty, "code_sha256": digest}


def gather_code(host: PluginHost, sequence_folder: Path, also: Collection[str] = ()) -> RunCode:
    """Read the sources of all plugins that a run uses, and the states of their repositories.

    Args:
        also: Names of further plugins to include.
    """
    own, sequence_root, plugins = Path(labseq.__file__).parent, _root_of(sequence_folder), host.used(also)
    homes = {plugin.name: own if plugin.is_built_in else plugin.home for plugin in plugins}
    with ThreadPoolExecutor(1) as thread:  # git takes longer than everything else here
        paths = [path for path in {own, sequence_root, *homes.values()} if path is not None]
        states = thread.submit(repositories, paths)
        sources = {
            plugin.name: (_read if plugin.is_from_folder else _read_once)(homes[plugin.name])
            for plugin in plugins
        }
    repository_of = states.result()

    def git(path: Path | None) -> dict[str, Any] | None:
        return repository_of[path].plain() if path in repository_of else None

    archived = {
        f"{plugin.name}/{name}": data
        for plugin in plugins
        if not plugin.is_built_in  # 1 MB more for each run, although it is in the commit or the release
        for name, data in sources[plugin.name].files.items()
    }
    if own in repository_of and repository_of[own].diff:
        archived[LABSEQ_DIFF] = repository_of[own].diff.encode()
    records = tuple(
        {
            "name": plugin.name,
            "origin": plugin.origin,
            "version": plugin.version,
            "path": str(homes[plugin.name] or ""),
            "sha256": sources[plugin.name].sha256,
            "git": git(homes[plugin.name]),
            "used": [*plugin.offers],
        }
        for plugin in plugins
    )
    return RunCode(
        records, {"code": git(own), "sequence": git(sequence_root)}, _zipped(tuple(archived.items()))
    )


def read_sources(home: Path | None) -> Sources:
    """The sources of a plugin, its file or the files in its package's folder. Empty for an unknown place."""
    if home is None:
        return {}
    files = [home]
    if not home.is_file():
        files = [
            Path(folder, name)
            for folder, _, names in os.walk(home)
            for name in names
            if name.endswith(_SUFFIXES)
        ]
    sources: dict[str, bytes] = {}
    for path in files:
        with suppress(OSError):  # a link that leads nowhere, or removed meanwhile
            name = path.name if path == home else path.relative_to(home).as_posix()
            sources[name] = path.read_bytes()
    return dict(sorted(sources.items()))


def _read(home: Path | None) -> ReadSources:
    files = read_sources(home)
    return ReadSources(files, digest_of(files))


_read_once = functools.cache(_read)
"""The same for an installed package, which Python imports only once, so that later edits do not run."""


def digest_of(sources: Sources) -> str:
    """SHA-256 of a single file, or of the output of `sha256sum` for several files, or "" for none."""
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in sources.items()}
    if len(digests) <= 1:
        return next(iter(digests.values()), "")
    return hashlib.sha256(
        "".join(f"{digest}  {name}\n" for name, digest in digests.items()).encode()
    ).hexdigest()


@functools.lru_cache(maxsize=2)
def _zipped(files: tuple[tuple[str, bytes], ...]) -> bytes:
    """A zip file of names and contents, identical for identical files."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in files:
            archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def archived_sources(run_dir: Path, plugin: str) -> Sources:
    """The sources of a plugin that a run keeps. Empty if it has no such archive, or that is damaged."""
    with suppress(OSError, zipfile.BadZipFile), zipfile.ZipFile(run_dir / SOURCES_FILE) as archive:
        prefix = f"{plugin}/"
        names = [name for name in archive.namelist() if name.startswith(prefix)]
        return {name.removeprefix(prefix): archive.read(name) for name in names}
    return {}


def repositories(paths: Collection[Path]) -> dict[Path, Repository]:
    """The repository that each path belongs to, without paths outside of a repository, or without git.

    A package that is installed in an environment inside a repository is not part of that repository.
    """
    roots = {path: root for path in paths if (root := _root_of(path)) is not None}
    different = {*roots.values()}
    with ThreadPoolExecutor(8) as threads:
        listings = threads.map(_tracked, roots)
        states = dict(zip(different, threads.map(_state_of, different), strict=True))
        tracked = [path for path, listing in zip(roots, listings, strict=True) if listing]
    return {path: state for path in tracked if (state := states[roots[path]]) is not None}


def _root_of(path: Path) -> Path | None:
    """The folder of the repository around a path."""
    return next((folder for folder in (path, *path.parents) if (folder / ".git").exists()), None)


def _tracked(path: Path) -> str | None:
    """The files at a path that are part of its repository."""
    return _git(path if path.is_dir() else path.parent, "ls-files", "--", str(path))


def _state_of(root: Path) -> Repository | None:
    lines = (_git(root, "status", "--porcelain=v2", "--branch", "--untracked-files=no") or "").splitlines()
    commit = next((line.split()[-1] for line in lines if line.startswith("# branch.oid")), "(initial)")
    if commit == "(initial)":
        return None
    is_changed = any(not line.startswith("#") for line in lines)
    diff = _git(root, "diff", "--no-ext-diff", "--no-color", "HEAD", "--", ":(top)*.py") if is_changed else ""
    return Repository(commit, is_changed, diff or "")


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
    return done.stdout.decode(errors="replace")
