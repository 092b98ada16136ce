"""The store of calibrations: entries on disk, which of them a profile uses, and whether they are good enough."""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from difflib import get_close_matches
from itertools import count
from pathlib import Path
from typing import IO, Any, Final, TypeAlias, cast

import labseq
from labseq.errors import ConfigError, Problem
from labseq.files import whole_file
from labseq.model import CalibrationEntry, CalibrationKind, SiteGrid, grid_facts, same_grid
from labseq.units import format_quantity

FORMAT: Final = "labseq-calibration"
FORMAT_VERSION: Final = "1.0"
"""major.minor; a newer minor version only adds things, a newer major version cannot be read."""

SUFFIX: Final = ".json"
PICTURE_SUFFIX: Final = ".png"


def stem_of(entry: CalibrationEntry) -> str:
    """The name of its files without suffix: kind, UTC date and time, id.

    Example:
        >>> from labseq.model import SiteGrid, grid_facts
        >>> stem_of(CalibrationEntry("overlay", {"offset_m": [3e-8, 0.0]}, {}, grid_facts(SiteGrid()), {},
        ...                          "2026-11-20T09:05:00+01:00"))
        'overlay-20261120T080500Z-f102b3cd999c'
    """
    taken = datetime.fromisoformat(entry.taken_utc).astimezone(UTC)
    return f"{entry.kind}-{taken:%Y%m%dT%H%M%SZ}-{entry.id}"


def encode_entry(entry: CalibrationEntry) -> bytes:
    """The content of an entry's file; floats come back bit by bit."""
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
        ConfigError: It is missing, damaged, changed by hand, or of a newer labseq.
    """
    content = read_object(path, FORMAT, FORMAT_VERSION)
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
        what = f"it says that its id is {content.get('id')}, but its content has the id {entry.id}"
        raise damaged(path, f"{what}: somebody changed it")
    return entry


def read_object(path: Path, file_format: str, version: str) -> dict[str, Any]:
    """Read a JSON object of a format of labseq's.

    Args:
        path: The file.
        file_format: Its key ``format``.
        version: The newest version that can be read.

    Raises:
        ConfigError: It is missing, no such object, or of a newer labseq.
    """
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise ConfigError(Problem(f"it cannot be read: {error.strerror}", str(path))) from error
    except (ValueError, RecursionError) as error:
        raise damaged(path, f"it is no JSON ({error})") from error
    if not isinstance(content, dict) or content.get("format") != file_format:
        raise damaged(path, f"it is not of the format '{file_format}'")
    came = str(content.get("format_version"))
    major = came.partition(".")[0]
    if not major.isdecimal():
        raise damaged(path, f"its format version is '{came}'")
    if int(major) > int(version.partition(".")[0]):
        what = f"its format version is {came}"
        raise ConfigError(Problem(what, str(path), expected=f"{version} or older", hint="update labseq"))
    return cast("dict[str, Any]", content)


def damaged(path: Path, why: str) -> ConfigError:
    """The error for a file that is not as it was written."""
    hint = "take it from a backup, or move it out of the way"
    return ConfigError(Problem(f"this file is damaged: {why}", str(path), hint=hint))


ACTIVE_FILE: Final = "active.json"
ACTIVE_FORMAT: Final = "labseq-active-calibrations"


@dataclass(frozen=True, slots=True)
class Activation:
    """From when on a calibration was in use.

    Attributes:
        kind: Its kind.
        id: Its id; "" for none: from then on, no calibration of this kind was in use.
        file: Name of its file in the store; "" for none.
        since_utc: ISO 8601, UTC.
    """

    kind: str
    id: str
    file: str
    since_utc: str


def read_history(folder: Path) -> list[Activation]:
    """Every activation, in order; of each kind the last one counts. None in a folder without a store.

    Raises:
        ConfigError: The file is damaged, or of a newer labseq.
    """
    path = folder / ACTIVE_FILE
    if not path.exists():
        return []
    content = read_object(path, ACTIVE_FORMAT, FORMAT_VERSION)
    try:
        rows = cast("list[Mapping[str, Any]]", content["history"])
        history = [Activation(*(str(row[key]) for key in Activation.__slots__)) for row in rows]
    except (KeyError, TypeError) as error:
        raise damaged(path, f"its history cannot be read ({error!r})") from error
    if any(Path(one.file).name != one.file for one in history):
        raise damaged(path, "it names files outside of its folder")
    return history


def encode_history(history: list[Activation]) -> bytes:
    """The content of the file, with a line for each activation."""
    head = json.dumps({"format": ACTIVE_FORMAT, "format_version": FORMAT_VERSION})
    rows = ",\n".join(f"  {json.dumps(asdict(one))}" for one in history)
    return f'{head[:-1]},\n "history": [\n{rows}\n ]\n}}\n'.encode()


def in_use(history: list[Activation]) -> dict[str, Activation]:
    """Kind -> its last activation, where that is not of none."""
    last = {one.kind: one for one in history}
    return {kind: one for kind, one in last.items() if one.id}


WORSE_FACTOR: Final = 1.5
"""How much larger the deciding figure may be: less is the chance of a measurement."""

_COUNT: Final = "n_sites_found"


@dataclass(frozen=True, slots=True)
class QualityFigure:
    """The figure by which calibrations of a kind are compared; the lower the better.

    Attributes:
        figure: Its name among the quality figures.
        matters: What it may be, however good another calibration was.
        words: What it is, for people.
    """

    figure: str
    matters: float
    words: str


DECIDING: Final[Mapping[str, QualityFigure]] = {
    # A tenth of a pixel is what sites must be known to: beyond it the region of interest loses light.
    "sites": QualityFigure("residual_px", 0.1, "residual"),
    # Twice the paper's mean detection infidelity of 0.054 %.
    "thresholds": QualityFigure("error", 1e-3, "expected error"),
    # The equalising's own goal.
    "tweezers": QualityFigure("separable_spread", 5e-3, "separable spread"),
    # A twentieth of the mobile tweezers' waist: what is lost by it cannot be seen.
    "frequencies": QualityFigure("error_m", 50e-9, "error"),
    "overlay": QualityFigure("error_m", 50e-9, "error"),
}
"""Kind -> what decides."""


def figure_of(entry: CalibrationEntry) -> float:
    """The deciding figure of an entry; nan if it has none."""
    return entry.quality.get(DECIDING[entry.kind].figure, math.nan)


def why_worse(new: CalibrationEntry, old: CalibrationEntry | None) -> str:
    """Why a calibration must not take the place of another one of its kind; "" if it may.

    It is worse if its deciding figure is more than :data:`WORSE_FACTOR` times the other's and more
    than what matters, if it has no such figure and the other has, or if it found fewer sites.

    One that has a figure is never worse than one that has none, unless it found fewer sites.

    Args:
        new: The one that is to be used.
        old: The one in use; None for none. One of another grid counts for nothing.
    """
    if old is None or not same_grid(new.grid, old.grid):
        return ""
    deciding, now, before = DECIDING[new.kind], figure_of(new), figure_of(old)
    if math.isnan(now) and not math.isnan(before):
        return f"it does not say how good it is (no {deciding.figure}), and the one in use does"
    if not math.isnan(before) and now > max(deciding.matters, WORSE_FACTOR * before):
        return f"its {deciding.figure} is {now:.3g}, that of the one in use {before:.3g}"
    found, found_before = (entry.quality.get(_COUNT, math.nan) for entry in (new, old))
    if found < found_before:
        return f"it found {found:.0f} sites, the one in use {found_before:.0f}"
    return ""


def check_grid(entry: CalibrationEntry, grid: SiteGrid, source: str) -> None:
    """Refuse an entry of another grid.

    Args:
        entry: The entry.
        grid: The grid of the profile.
        source: Where the entry comes from, for the message.

    Raises:
        ConfigError: Says both grids.
    """
    if not entry.is_for(grid):
        what = f"{entry.kind} {entry.id} was made for another grid: {grid_text(entry.grid)}"
        expected = f"{grid_text(grid_facts(grid))}, as in the profile"
        raise ConfigError(Problem(what, source, expected=expected))


def grid_text(grid: Mapping[str, Any]) -> str:
    """A grid in words.

    Example:
        >>> from labseq.model import SiteGrid
        >>> grid_text(grid_facts(SiteGrid()))
        '20 x 20 sites, triangular, 4.49 um, shear +1'
    """
    spacing = format_quantity(grid["spacing_m"], "length")
    shear = f", shear {grid['shear']:+d}" if grid["lattice"] == "triangular" else ""
    return f"{grid['rows']} x {grid['cols']} sites, {grid['lattice']}, {spacing}{shear}"


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
