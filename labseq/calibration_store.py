"""Stores calibrations on disk and records which are in use."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from itertools import count
from pathlib import Path
from typing import Any, Final, cast

import labseq
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.files import make_folder, read_file, whole_file
from labseq.messages import visible
from labseq.model import CalibrationEntry, CalibrationKind, SiteGrid, grid_facts
from labseq.plain import now, now_utc, parse_object
from labseq.units import format_quantity

FORMAT: Final = "labseq-calibration"
FORMAT_VERSION: Final = "2.0"
"""major.minor. This labseq reads files of the same major version."""

SUFFIX: Final = ".json"
PICTURE_SUFFIX: Final = ".png"


def stem_of(entry: CalibrationEntry) -> str:
    """Name of an entry's files without suffix: kind, UTC date and time, id.

    Example:
        >>> from labseq.model import SiteGrid, grid_facts
        >>> stem_of(CalibrationEntry("overlay", {"offset_m": [3e-8, 0.0]}, {}, grid_facts(SiteGrid()), {},
        ...                          "2026-11-20T09:05:00+01:00"))
        'overlay-20261120T080500Z-c317ed8fca10'
    """
    taken = datetime.fromisoformat(entry.taken_utc).astimezone(UTC)
    return f"{entry.kind}-{taken:%Y%m%dT%H%M%SZ}-{entry.id}"


def age_s(entry: CalibrationEntry) -> float | None:
    """Time since a calibration was made, in seconds. None if this computer's clock is behind that time."""
    age_s = (now() - datetime.fromisoformat(entry.taken_utc)).total_seconds()
    # the clocks of two computers may differ by a minute
    return None if age_s < -60.0 else max(0.0, age_s)


def encode_entry(entry: CalibrationEntry) -> bytes:
    """The content of an entry's file, with exact floats."""
    quality = {name: value if math.isfinite(value) else None for name, value in entry.quality.items()}
    content = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "creator": f"labseq {labseq.__version__}",
        "kind": entry.kind,
        "id": entry.id,
        "taken_utc": entry.taken_utc,
        "grid": entry.grid,
        "origin": entry.origin,
        "quality": quality,
    }
    text = json.dumps(content, indent=1, default=str)
    values = ",\n".join(f"  {json.dumps(k)}: {json.dumps(v.tolist())}" for k, v in entry.values.items())
    return f'{text[:-2]},\n "values": {{\n{values}\n }}\n}}\n'.encode()


def read_entry(path: Path) -> CalibrationEntry:
    """Read an entry's file.

    Raises:
        ConfigError: It is missing, damaged, changed by hand, or written by an older or newer labseq.
    """
    content = read_object(path, FORMAT)
    try:
        quality = cast("Mapping[str, Any]", content["quality"])
        entry = CalibrationEntry(
            kind=content["kind"],
            values=content["values"],
            quality={name: math.nan if value is None else value for name, value in quality.items()},
            grid=content["grid"],
            origin=content["origin"],
            taken_utc=content["taken_utc"],
        )
    except KeyError as error:
        raise damaged(path, f"it has no {error}") from error
    except (ValueError, TypeError, AttributeError, OverflowError) as error:
        raise damaged(path, str(error)) from error
    if entry.id != content.get("id"):
        fault = f"its id is {content.get('id')}, but the id of its content is {entry.id}"
        raise damaged(path, f"{fault}, so it was changed by hand")
    return entry


def read_object(path: Path, file_format: str) -> dict[str, Any]:
    """Read a JSON object with the keys ``format`` and ``format_version``.

    Raises:
        ConfigError: It is missing, damaged, of another format, or written by an older or newer labseq.
    """
    try:
        content = parse_object(read_file(path))
    except RecordingError as error:
        raise ConfigError(Problem(f"it {error.what}", str(path))) from error
    if content is None:
        raise damaged(path, "it is not a JSON object")
    if content.get("format") != file_format:
        raise damaged(path, f"its format is not '{file_format}'")
    version = str(content.get("format_version"))
    major = version.partition(".")[0]
    if not major.isdecimal():
        raise damaged(path, f"its format version is '{version}'")
    newer = int(major) - int(FORMAT_VERSION.partition(".")[0])
    if newer:
        hint = "update labseq" if newer > 0 else "calibrate again; an earlier labseq wrote it"
        fault = f"its format version is {version}"
        raise ConfigError(Problem(fault, str(path), expected=FORMAT_VERSION, hint=hint))
    return content


def damaged(path: Path, why: str) -> ConfigError:
    """The error for a damaged file."""
    hint = "restore it from a backup, or move it to another folder"
    return ConfigError(Problem(f"this file is damaged: {visible(why)}", str(path), hint=hint))


ACTIVE_FILE: Final = "active.json"
ACTIVE_FORMAT: Final = "labseq-active-calibrations"


@dataclass(frozen=True, slots=True)
class Activation:
    """A change of the active calibration of a kind.

    Attributes:
        kind: Its kind.
        id: Id of the new calibration. "" for none from then on.
        file: Name of its file in the store. "" for none.
        since_utc: ISO 8601, UTC.
    """

    kind: str
    id: str
    file: str
    since_utc: str


def encode_history(history: list[Activation]) -> bytes:
    """The content of ``active.json``, one line for each activation."""
    head = json.dumps({"format": ACTIVE_FORMAT, "format_version": FORMAT_VERSION})
    rows = ",\n".join(f"  {json.dumps(asdict(activation))}" for activation in history)
    return f'{head[:-1]},\n "history": [\n{rows}\n ]\n}}\n'.encode()


def check_grid(entry: CalibrationEntry, grid: SiteGrid, source: str) -> None:
    """Check that an entry, which came from ``source``, is for this grid.

    Raises:
        ConfigError: It is for another grid. The message names both.
    """
    if not entry.is_for(grid):
        message = f"{entry.kind} {entry.id} is for another grid: {grid_text(entry.grid)}"
        expected = f"{grid_text(grid_facts(grid))}, as in the profile"
        raise ConfigError(Problem(message, source, expected=expected))


def grid_text(grid: Mapping[str, Any]) -> str:
    """A grid as text.

    Example:
        >>> from labseq.model import SiteGrid
        >>> grid_text(grid_facts(SiteGrid()))
        '20 x 20 sites, triangular, 4.49 um, shear +1'
    """
    spacing = format_quantity(grid["spacing_m"], "length")
    shear = f", shear {grid['shear']:+d}" if grid["lattice"] == "triangular" else ""
    return f"{grid['rows']} x {grid['cols']} sites, {grid['lattice']}, {spacing}{shear}"


MAX_WAIT_S: Final = 2.0
"""Maximum time to wait for another process that writes ``active.json``, in seconds."""

MAX_LISTED: Final = 8

_NAME: Final = re.compile(r"([a-z]+)-(\d{8}T\d{6}Z)-([0-9a-f]{12})(?:-(\d+))?")


@dataclass(frozen=True, slots=True)
class Stored:
    """An entry of a store, and its file."""

    entry: CalibrationEntry
    path: Path

    @property
    def picture(self) -> Path | None:
        """Path of its picture, or None if there is none."""
        path = self.path.with_suffix(PICTURE_SUFFIX)
        return path if path.is_file() else None


@dataclass(frozen=True, slots=True)
class Damaged:
    """A file of a store that cannot be read, with kind and id from its name, and the error."""

    path: Path
    kind: str
    id: str
    error: ConfigError


class Store:
    """A folder of calibrations, which is created with the first entry.

    An entry is a JSON file with a picture of the same name. Neither ever changes. The same values measured
    again get another id. Several processes may use a store at the same time.

    Args:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def entries(self) -> list[Stored | Damaged]:
        """All entries, including damaged ones, by the time in their names.

        Raises:
            ConfigError: The folder cannot be read.
        """
        return [self._read(path, name) for path, name in self._files()]

    def find(self, id_or_file: str, kind: CalibrationKind | None = None) -> Stored:
        """Find an entry.

        Args:
            id_or_file: Its id, a unique beginning of the id, or the name of its file.
            kind: Only entries of this kind.

        Raises:
            ConfigError: There is none, there are several, or it is damaged.
        """
        files = [(path, name) for path, name in self._files() if kind in (None, name[1])]
        stem = id_or_file.removesuffix(SUFFIX)
        matches = [
            (p, n) for p, n in files if id_or_file and (n[3].startswith(id_or_file.lower()) or p.stem == stem)
        ]
        ids = sorted({name[3] for _, name in matches})
        if len(ids) > 1:
            message = f"several calibrations begin with '{id_or_file}': {', '.join(ids[:MAX_LISTED])}"
            raise ConfigError(Problem(message, expected="more of its id"))
        if not ids:
            others = list(dict.fromkeys(name[3] for _, name in reversed(files)))
            near = get_close_matches(id_or_file.lower(), others, MAX_LISTED, 0.4) or others[:MAX_LISTED]
            message = (
                f"there is no calibration{f' of {kind}' if kind else ''} '{id_or_file}' in {self.folder}"
            )
            raise ConfigError(Problem(message, expected=", ".join(near) or "an existing calibration"))
        read = self._read(*matches[-1])
        if isinstance(read, Damaged):
            raise read.error
        return read

    def add(self, entry: CalibrationEntry, picture: bytes | None = None) -> Stored:
        """Store an entry and a PNG of it, without putting it to use.

        Raises:
            ConfigError: The folder cannot be written to.
        """
        stem = stem_of(entry)
        with self._write_errors():
            make_folder(self.folder)
            for n in count(1):
                path = self.folder / (f"{stem}{SUFFIX}" if n == 1 else f"{stem}-{n}{SUFFIX}")
                try:
                    self._write(path, entry, picture)
                except FileExistsError:
                    continue
                return Stored(entry, path)
        raise AssertionError  # count() does not end

    def history(self) -> list[Activation]:
        """Every activation, in order. The last of each kind is active. Empty without a store.

        Raises:
            ConfigError: ``active.json`` is damaged, or written by a newer labseq.
        """
        path = self.folder / ACTIVE_FILE
        if not path.exists():
            return []
        content = read_object(path, ACTIVE_FORMAT)
        try:
            rows = cast("list[Mapping[str, Any]]", content["history"])
            history = [Activation(*(str(row[key]) for key in Activation.__slots__)) for row in rows]
        except (KeyError, TypeError) as error:
            raise damaged(path, f"its history cannot be read ({error!r})") from error
        if any(Path(activation.file).name != activation.file for activation in history):
            raise damaged(path, "it names files outside of its folder")
        return history

    def active(self) -> dict[str, Activation]:
        """Kind -> the activation of the calibration in use, for kinds that have one.

        Raises:
            ConfigError: ``active.json`` is damaged, or written by a newer labseq.
        """
        last = {activation.kind: activation for activation in self.history()}
        return {kind: activation for kind, activation in last.items() if activation.id}

    def entry_in_use(self, kind: str) -> Stored | None:
        """The entry of a kind that is in use, or None if there is none.

        Raises:
            ConfigError: It is missing or damaged, or ``active.json`` is damaged.
        """
        active = self.active().get(kind)
        return None if active is None else self.entry_of(active)

    def entry_of(self, active: Activation) -> Stored:
        """The entry that was put to use.

        Raises:
            ConfigError: It is missing, damaged or no longer the same calibration.
        """
        path = self.folder / active.file
        entry = read_entry(path)
        if (entry.kind, entry.id) != (active.kind, active.id):
            fault = f"{active.id} was put to use as '{active.kind}', but this is another calibration"
            raise damaged(path, fault)
        return Stored(entry, path)

    def use(self, stored: Stored, grid: SiteGrid) -> None:
        """Put an entry to use from now on.

        Raises:
            ConfigError: It is for another grid, or the folder cannot be written to.
        """
        entry = stored.entry
        check_grid(entry, grid, str(stored.path))
        self._activate(Activation(entry.kind, entry.id, stored.path.name, now_utc("seconds")))

    def use_none(self, kind: CalibrationKind) -> None:
        """Use no calibration of a kind from now on.

        Raises:
            ConfigError: The folder cannot be written to.
        """
        self._activate(Activation(kind, "", "", now_utc("seconds")))

    def _activate(self, activation: Activation) -> None:
        """Add an activation to the history, unless nothing changes."""
        path, deadline = self.folder / ACTIVE_FILE, time.monotonic() + MAX_WAIT_S
        with self._write_errors():
            make_folder(self.folder)
            while True:
                try:
                    with whole_file(path, alone=True) as file:
                        history, now = self.history(), self.active().get(activation.kind)
                        used = (now.id, now.file) if now else ("", "")
                        is_new = used != (activation.id, activation.file)
                        file.write(encode_history([*history, *([activation] if is_new else [])]))
                    return
                except FileExistsError as error:
                    if time.monotonic() >= deadline:
                        message = "another labseq is writing this file, or was killed while it did"
                        hint = "if none is running, delete it"
                        raise ConfigError(Problem(message, str(error.filename), hint=hint)) from error
                    time.sleep(0.01)

    def _write(self, path: Path, entry: CalibrationEntry, picture: bytes | None) -> None:
        with whole_file(path, alone=True) as file:
            if path.exists():
                raise FileExistsError
            file.write(encode_entry(entry))
            if picture is not None:  # written before the entry gets its name, so that no entry lacks it
                with whole_file(path.with_suffix(PICTURE_SUFFIX)) as png:
                    png.write(picture)

    def _files(self) -> list[tuple[Path, re.Match[str]]]:
        """The files of entries and what their names contain, by the time in them."""
        try:
            paths = [*self.folder.iterdir()] if self.folder.is_dir() else []
        except OSError as error:
            message = f"the calibrations cannot be read: {error.strerror}"
            raise ConfigError(Problem(message, str(self.folder))) from error
        named = [(p, match) for p in paths if p.suffix == SUFFIX and (match := _NAME.fullmatch(p.stem))]
        return sorted(named, key=lambda one: (one[1][2], int(one[1][4] or 1), one[1][1], one[1][3]))

    def _read(self, path: Path, name: re.Match[str]) -> Stored | Damaged:
        try:
            entry = read_entry(path)
            if (entry.kind, entry.id) != (name[1], name[3]):
                raise damaged(path, f"it was renamed, because it contains {entry.kind} {entry.id}")
        except ConfigError as error:
            return Damaged(path, name[1], name[3], error)
        return Stored(entry, path)

    @contextmanager
    def _write_errors(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            message = f"calibrations cannot be stored there: {error.strerror or error}"
            hint = "set another folder in the profile's key 'calibrations'"
            raise ConfigError(Problem(message, str(self.folder), hint=hint)) from error
