"""The folder that a profile's calibrations are kept in."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from itertools import count
from pathlib import Path
from typing import IO, Final, TypeAlias

from labseq.calibrations.active import (
    ACTIVE_FILE,
    Activation,
    encode_history,
    in_use,
    read_history,
)
from labseq.calibrations.entry_file import (
    PICTURE_SUFFIX,
    SUFFIX,
    damaged,
    encode_entry,
    read_entry,
    stem_of,
)
from labseq.calibrations.fitting import check_grid
from labseq.calibrations.quality import why_worse
from labseq.errors import ConfigError, Problem
from labseq.files import whole_file
from labseq.model import CalibrationEntry, CalibrationKind, SiteGrid

MAX_WAIT_S: Final = 2.0
"""How long another process may take to note what is in use."""

Picture: TypeAlias = bytes | Callable[[IO[bytes]], object]
"""A PNG, or what writes one."""

_NAME: Final = re.compile(r"([a-z]+)-(\d{8}T\d{6}Z)-([0-9a-f]{12})(?:-(\d+))?")
_MAX_LISTED: Final = 8


@dataclass(frozen=True, slots=True)
class Stored:
    """An entry of a store.

    Attributes:
        entry: What it says.
        path: Its file.
    """

    entry: CalibrationEntry
    path: Path

    @property
    def picture(self) -> Path | None:
        """The picture to look at, if there is one."""
        path = self.path.with_suffix(PICTURE_SUFFIX)
        return path if path.is_file() else None


@dataclass(frozen=True, slots=True)
class Damaged:
    """A file of a store that cannot be read.

    Attributes:
        path: The file.
        kind: What its name says.
        id: Likewise.
        error: Why it cannot be read.
    """

    path: Path
    kind: str
    id: str
    error: ConfigError


class Store:
    """A folder of calibrations; it need not exist before the first one is added.

    An entry is one JSON file, and a picture of the same name; neither is ever changed. The same
    values measured again are another entry with the same id: what the machine would use is the same,
    and the newest of them is meant by the id. Several processes may use a store at the same time.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def entries(self) -> list[Stored | Damaged]:
        """All entries, those that cannot be read among them, by the time in their names.

        Raises:
            ConfigError: The folder cannot be read.
        """
        return [self._read(path, name) for path, name in self._files()]

    def find(self, wanted: str, kind: CalibrationKind | None = None) -> Stored:
        """Find an entry by its id.

        Args:
            wanted: Its id, or so much of its beginning that no other one is meant; or its file's name.
            kind: Only entries of this kind.

        Raises:
            ConfigError: There is none, there are several, or it is damaged.
        """
        files = [(path, name) for path, name in self._files() if kind in (None, name[1])]
        stem = wanted.removesuffix(SUFFIX)
        found = [(p, n) for p, n in files if wanted and (n[3].startswith(wanted.lower()) or p.stem == stem)]
        ids = sorted({name[3] for _, name in found})
        if len(ids) > 1:
            what = f"several calibrations begin with '{wanted}': {', '.join(ids[:_MAX_LISTED])}"
            raise ConfigError(Problem(what, expected="more of its id"))
        if not ids:
            raise self._unknown(wanted, kind, [name for _, name in files])
        path, name = found[-1]
        read = self._read(path, name)
        if isinstance(read, Damaged):
            raise read.error
        return read

    def add(self, entry: CalibrationEntry, picture: Picture | None = None) -> Stored:
        """Keep an entry; it is not in use by that.

        Args:
            entry: The entry.
            picture: A PNG of it.

        Raises:
            ConfigError: The folder cannot be written to.
        """
        stem = stem_of(entry)
        with self._explained():
            self.folder.mkdir(parents=True, exist_ok=True)
            for n in count(1):
                path = self.folder / (f"{stem}{SUFFIX}" if n == 1 else f"{stem}-{n}{SUFFIX}")
                try:
                    self._write(path, entry, picture)
                except FileExistsError:
                    continue
                return Stored(entry, path)
        raise AssertionError  # count() does not end

    def active(self) -> dict[str, Activation]:
        """What is in use: kind -> from when on.

        Raises:
            ConfigError: The note of it is damaged.
        """
        return in_use(read_history(self.folder))

    def history(self) -> list[Activation]:
        """Everything that was in use, in order.

        Raises:
            ConfigError: The note of it is damaged.
        """
        return read_history(self.folder)

    def entry_in_use(self, kind: str) -> Stored | None:
        """The entry of a kind that is in use; None for none.

        Raises:
            ConfigError: It is missing or damaged, or the note of it is.
        """
        active = self.active().get(kind)
        if active is None:
            return None
        path = self.folder / active.file
        entry = read_entry(path)
        if (entry.kind, entry.id) != (kind, active.id):
            raise damaged(path, f"{active.id} was put to use as '{kind}', and this is another calibration")
        return Stored(entry, path)

    def use(self, stored: Stored, grid: SiteGrid, *, force: bool = False) -> None:
        """Put an entry to use from now on.

        Args:
            stored: The entry.
            grid: The grid of the profile.
            force: Whether also one that is worse than the one in use.

        Raises:
            ConfigError: It is of another grid, it is worse, or the folder cannot be written to.
        """
        entry = stored.entry
        check_grid(entry, grid, str(stored.path))
        if not force and (reason := self.why_worse(entry)):
            what = f"{entry.kind} {entry.id} is worse than what is in use: {reason}"
            raise ConfigError(Problem(what, hint="use it nevertheless with --force"))
        self._note(Activation(entry.kind, entry.id, stored.path.name, _utc_now()))

    def use_none(self, kind: CalibrationKind) -> None:
        """Use no calibration of a kind from now on.

        Raises:
            ConfigError: The folder cannot be written to.
        """
        self._note(Activation(kind, "", "", _utc_now()))

    def why_worse(self, entry: CalibrationEntry) -> str:
        """Why an entry must not take the place of the one in use; "" if it may.

        Where the one in use is damaged, anything is better.
        """
        try:
            stored = self.entry_in_use(entry.kind)
        except ConfigError:
            return ""
        return why_worse(entry, None if stored is None else stored.entry)

    def _note(self, activation: Activation) -> None:
        """Add to the history, unless it changes nothing."""
        path, deadline = self.folder / ACTIVE_FILE, time.monotonic() + MAX_WAIT_S
        with self._explained():
            self.folder.mkdir(parents=True, exist_ok=True)
            while True:
                try:
                    with whole_file(path, alone=True) as file:
                        history = read_history(self.folder)
                        file.write(encode_history([*history, *_news(history, activation)]))
                except FileExistsError as error:
                    if time.monotonic() < deadline:
                        time.sleep(0.01)
                        continue
                    what = "another labseq is writing this file, or was killed while it did"
                    hint = "if none is running, delete it"
                    raise ConfigError(Problem(what, str(error.filename), hint=hint)) from error
                return

    def _write(self, path: Path, entry: CalibrationEntry, picture: Picture | None) -> None:
        with whole_file(path, alone=True) as file:
            if path.exists():
                raise FileExistsError
            file.write(encode_entry(entry))
            if picture is None:
                return
            with whole_file(path.with_suffix(PICTURE_SUFFIX)) as png:  # first: an entry has its picture
                if isinstance(picture, bytes):
                    png.write(picture)
                else:
                    picture(png)

    def _files(self) -> list[tuple[Path, re.Match[str]]]:
        """The files of entries and what their names say, by the time in them."""
        try:
            paths = [*self.folder.iterdir()] if self.folder.is_dir() else []
        except OSError as error:
            what = f"the calibrations cannot be read: {error.strerror}"
            raise ConfigError(Problem(what, str(self.folder))) from error
        named = [(p, match) for p in paths if p.suffix == SUFFIX and (match := _NAME.fullmatch(p.stem))]
        return sorted(named, key=lambda one: (one[1][2], int(one[1][4] or 1), one[1][1], one[1][3]))

    def _read(self, path: Path, name: re.Match[str]) -> Stored | Damaged:
        try:
            entry = read_entry(path)
            if (entry.kind, entry.id) != (name[1], name[3]):
                raise damaged(path, f"it holds {entry.kind} {entry.id}: somebody renamed it")
        except ConfigError as error:
            return Damaged(path, name[1], name[3], error)
        return Stored(entry, path)

    def _unknown(self, wanted: str, kind: str | None, names: list[re.Match[str]]) -> ConfigError:
        ids = list(dict.fromkeys(name[3] for name in reversed(names)))
        near = get_close_matches(wanted.lower(), ids, _MAX_LISTED, 0.4) or ids[:_MAX_LISTED]
        called = f"calibration of {kind}" if kind else "calibration"
        what = f"there is no {called} '{wanted}' in {self.folder}"
        return ConfigError(Problem(what, expected=", ".join(near) if near else "one that was made before"))

    @contextmanager
    def _explained(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            what = f"a calibration cannot be kept there: {error.strerror or error}"
            hint = "name another folder with the profile's key 'calibrations'"
            raise ConfigError(Problem(what, str(self.folder), hint=hint)) from error


def _news(history: list[Activation], activation: Activation) -> list[Activation]:
    now = in_use(history).get(activation.kind)
    same = (now.id, now.file) == (activation.id, activation.file) if now else not activation.id
    return [] if same else [activation]


def _utc_now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
