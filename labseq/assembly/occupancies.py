"""Reads an occupancy given on the command line: a file, standard input, a shot, or a random draw."""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np
from numpy.lib.format import read_array
from numpy.typing import NDArray

from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean, did_you_mean, shown, visible
from labseq.model import CycleRecord, ImageRecord, Occupancy, TargetPattern, as_occupancy
from labseq.text_files import YAML_SUFFIXES, decode, files_in, is_file, something_else
from labseq.units import parse_quantity

MAX_SITES: Final = 1000
"""Maximum number of rows and of columns, as in a hardware profile."""
MAX_BYTES: Final = 4 << 20
"""Maximum size of a text, in bytes."""
MAX_NPY_BYTES: Final = 32 << 20
"""Maximum size of a .npy file, in bytes."""
FORMS: Final = (
    "a .npy file, a text file of 0 and 1, '-' for standard input, a shot file such as "
    "shots/shot_000003.h5#2, or random:20x20@0.75"
)

_RANDOM: Final = re.compile(r"random:\s*(\d{1,9})\s*[xX]\s*(\d{1,9})\s*@(.+)")
_SHOT: Final = re.compile(r"(.+\.h5)(?:#(.*))?", re.IGNORECASE)
_LINE_BREAK: Final = re.compile(r"\r\n|\r|\n")
_CHARACTERS: Final = {"1": True, "#": True, "0": False, ".": False}
_SEPARATORS: Final = " \t,;"


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """An occupancy and where it comes from.

    Attributes:
        occupancy: bool (n_rows, n_cols).
        label: Its origin, for messages.
        seed: Seed of the random draw; None if it was not drawn.
        target: Target of the shot; None if it is not from a shot.
        machine: Resolved profile of the shot; None if it is not from a shot.
    """

    occupancy: Occupancy
    label: str
    seed: int | None = None
    target: TargetPattern | None = None
    machine: dict[str, Any] | None = None


def read_source(text: str, seed: int | None = None, stdin: BinaryIO | None = None) -> Source:
    """Read an occupancy in any of the forms that a user may give.

    ``random:ROWSxCOLS@P`` is ``numpy.random.default_rng(seed).random((rows, cols)) < P``.

    Args:
        text: See :data:`FORMS`.
        seed: Seed for ``random:``; a fresh one if None.
        stdin: The stream for "-"; standard input if None.

    Raises:
        ConfigError: The text has none of these forms, or cannot be read; names the forms.
    """
    if text == "-":
        data = (stdin or sys.stdin.buffer).read(MAX_BYTES + 1)
        return Source(parse_text(data, "standard input"), "standard input")
    if text.startswith("random:"):
        return _random(text, seed)
    if not text:
        raise ConfigError(Problem("the occupancy is an empty text", expected=FORMS))
    if text.lower().endswith(YAML_SUFFIXES):
        hint = "to plan for its target, write: labseq plan random:20x20@0.75 --target " + clean(text)
        raise ConfigError(Problem("a sequence holds no occupancy", clean(text), expected=FORMS, hint=hint))
    match = _SHOT.fullmatch(text)
    path = Path(match[1] if match else text)
    if not is_file(path):
        what = something_else(path) or "there is no such file"
        names = [name for name in files_in(path.parent, (".npy", ".txt", ".h5")) if name != path.name]
        hint = did_you_mean(path.name, names)
        raise ConfigError(Problem(what, clean(str(path)), expected=FORMS, hint=hint))
    if match:
        return _shot(path, match[2])
    label = visible(str(path))
    if path.suffix.lower() == ".npy":
        return Source(_npy(path), label)
    return Source(parse_text(_read(path), label), label)


def parse_text(data: bytes, name: str) -> Occupancy:
    r"""Read rows of 0 and 1 (or "." and "#"), with or without spaces or commas between them.

    Args:
        data: UTF-8.

    Raises:
        ConfigError: With line and column.

    Example:
        >>> parse_text(b"1 0 1\n#.#\n", "mine").astype(int).tolist()
        [[1, 0, 1], [1, 0, 1]]
    """
    if len(data) > MAX_BYTES:
        raise ConfigError(Problem("it is larger than 4 MiB", name, expected=_size_limit()))
    lines = _LINE_BREAK.split(decode(data, name))
    filled = [i for i, line in enumerate(lines) if line.strip(_SEPARATORS)]
    if not filled:
        raise ConfigError(Problem("it is empty", name, expected="rows of 0 and 1, one line each"))
    numbered = [(i, lines[i]) for i in range(filled[0], filled[-1] + 1)]
    rows = [_text_row(line, name, i + 1) for i, line in numbered]
    for (i, _), row in zip(numbered, rows, strict=True):
        if len(row) != len(rows[0]):
            what = f"this row has {len(row)} sites"
            expected = f"{len(rows[0])}, as in line {filled[0] + 1}"
            columns = [n for n, character in enumerate(lines[i], start=1) if character in _CHARACTERS]
            column = columns[len(rows[0])] if len(row) > len(rows[0]) else len(lines[i].rstrip()) + 1
            raise ConfigError(Problem(what, name, i + 1, column, expected))
    return _checked(np.array(rows, np.bool_), name)


def _text_row(line: str, name: str, number: int) -> list[bool]:
    for i, character in enumerate(line):
        if character not in _CHARACTERS and character not in _SEPARATORS:
            what = f"{shown(character)} is not a site"
            expected = "0 or '.' for an empty site, 1 or '#' for an atom"
            raise ConfigError(Problem(what, name, number, i + 1, expected))
    return [_CHARACTERS[character] for character in line if character in _CHARACTERS]


def _random(text: str, seed: int | None) -> Source:
    expected = "random:ROWSxCOLS@P, for example random:20x20@0.75"
    match = _RANDOM.fullmatch(text)
    if match is None:
        raise ConfigError(Problem("this is not an occupancy", clean(text), expected=expected))
    rows, cols = int(match[1]), int(match[2])
    try:
        probability = parse_quantity(match[3], "fraction")
    except ValueError:
        probability = np.nan
    if not 0.0 <= probability <= 1.0:
        what = f"the filling fraction is '{clean(match[3])}'"
        raise ConfigError(Problem(what, clean(text), expected="a number from 0 to 1, or 0 % to 100 %"))
    if not (1 <= rows <= MAX_SITES and 1 <= cols <= MAX_SITES):
        raise ConfigError(Problem(f"it has {rows} x {cols} sites", clean(text), expected=_size_limit()))
    if seed is None:
        seed = secrets.randbits(32)
    atoms = np.random.default_rng(seed).random((rows, cols)) < probability
    return Source(atoms, f"{text}, seed {seed}", seed)


def _npy(path: Path) -> Occupancy:
    name = visible(str(path))
    expected = "a two-dimensional array of bool, or of 0 and 1, saved by numpy.save"
    if path.stat().st_size > MAX_NPY_BYTES:
        raise ConfigError(Problem("it is larger than 32 MiB", name, expected=_size_limit()))
    try:
        with path.open("rb") as file:
            array = read_array(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError, OverflowError, TypeError) as error:
        reason = visible(str(error).partition(";")[0].partition("\n")[0])
        what = f"it cannot be read: {reason}" if reason else "it is damaged"
        raise ConfigError(Problem(what, name, expected=expected)) from error
    if array.ndim != 2 or array.dtype.kind not in "biuf":
        what = f"it holds an array of shape {array.shape} and type {array.dtype}"
        raise ConfigError(Problem(what, name, expected=expected))
    return _checked(array, name)


def _checked(array: NDArray[Any], name: str) -> Occupancy:
    if not 1 <= min(array.shape) <= max(array.shape) <= MAX_SITES:
        what = f"it has {array.shape[0]} x {array.shape[1]} sites"
        raise ConfigError(Problem(what, name, expected=_size_limit()))
    try:
        return as_occupancy(np.array(array))
    except ValueError as error:
        raise ConfigError(Problem(str(error), name, expected="0 and 1, or False and True")) from error


def _shot(path: Path, cycle: str | None) -> Source:
    from labseq.recording.shot_file import read_content

    name = visible(str(path))
    try:
        content = read_content(path)
    except RecordingError as error:
        raise ConfigError(Problem(error.text, name, expected="a shot's file")) from error
    cycles, images = content.record.cycles, content.record.images
    if not cycles:
        raise ConfigError(Problem("this shot has no cycles", name, expected="a shot that was rearranged"))
    index = 0 if cycle is None else int(cycle) if re.fullmatch(r"[0-9]{1,6}", cycle) else -1
    if not 0 <= index < len(cycles):
        there_are = "0, the only one" if len(cycles) == 1 else f"a cycle from 0 to {len(cycles) - 1}"
        raise ConfigError(Problem(f"there is no cycle '{clean(cycle or '')}'", name, expected=there_are))
    seen = image_before(cycles[index], images)
    if seen is None:
        raise ConfigError(Problem(f"there is no image before cycle {index}", name, expected="one"))
    label = f"{name}, before cycle {index}"
    machine = cast("dict[str, Any]", content.run["resolved"] or {}).get("profile")
    return Source(seen.occupancy, label, target=content.target, machine=machine)


def image_before(cycle: CycleRecord, images: Sequence[ImageRecord]) -> ImageRecord | None:
    """The image that a cycle was planned on: the last one before the cycle's own; None if there is none."""
    before = [image for image in images if (image.step, image.cycle) < (cycle.step, cycle.cycle)]
    return before[-1] if before else None


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)
    except OSError as error:
        what = f"it cannot be read: {error.strerror}"
        raise ConfigError(Problem(what, clean(str(path)), expected=FORMS)) from error


def _size_limit() -> str:
    return f"1 to {MAX_SITES} rows and columns"
