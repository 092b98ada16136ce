"""Reads an occupancy given on the command line: a file, standard input, a shot, or a random draw."""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np
from numpy.typing import NDArray

from labseq.array_files import ARRAY_FILES, opened_array, split_name
from labseq.assembly.recorded import profile_of_shot
from labseq.errors import ConfigError, Problem, RecordingError
from labseq.messages import clean, did_you_mean, shown, visible
from labseq.model import CycleRecord, ImageRecord, Occupancy, TargetPattern, as_occupancy
from labseq.text_files import (
    YAML_SUFFIXES,
    decode,
    files_in,
    is_file,
    line_and_column,
    something_else,
)
from labseq.units import parse_quantity

MAX_SITES: Final = 1000
"""Maximum number of rows and of columns, as in a hardware profile."""
MAX_BYTES: Final = 32 << 20
"""Maximum size of a text, in bytes: 1000 x 1000 sites as numpy.savetxt writes them by default."""
FORMS: Final = (
    "a text file of 0 and 1, a .npy file, an array such as loadings.npz:loaded#3, '-' for standard input, "
    "a shot file such as shots/shot_000003.h5#2, or random:20x20@0.75"
)

_RANDOM: Final = re.compile(r"random:\s*(\d{1,9})\s*[xX]\s*(\d{1,9})\s*@(.+)")
_ARRAY: Final = re.compile(r"(.+\.(?:npy|npz|h5|hdf5)(?::[^#]*)?)(?:#(.*))?", re.IGNORECASE)
_SHOT: Final = re.compile(r".+\.h5", re.IGNORECASE)
_LINE_BREAK: Final = re.compile(r"\r\n|\r|\n|$")
_LIST_ROW: Final = re.compile(r"\[([^][]*)\]")
_WORD: Final = re.compile(r"[^\s,;]+")
_COMMENT: Final = re.compile(r"(?<![^\r\n])[ \t]*#[^\r\n]*(?:\r\n|\r|\n)?|#[^\r\n]*")
"""A line that is a comment, or a comment after a row."""
_COUNTED_ROW: Final = re.compile(r"(?<![^\r\n])[][ \t,;+-]*(?:\d|true|false)", re.IGNORECASE)
_DRAWN: Final = {"#": True, ".": False}
_COUNTED: Final = {"1": True, "0": False}
_SEPARATORS: Final = " \t\r\n,;"
_SITES: Final = "0 or '.' for an empty site, 1 or '#' for an atom"


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """An occupancy and where it comes from.

    Attributes:
        occupancy: bool (n_rows, n_cols).
        label: Its origin, for messages.
        seed: Seed of the random draw. None if it was not drawn.
        target: Target of the shot. None if it is not from a shot.
        machine: Resolved profile of the shot. None if it is not from a shot.
    """

    occupancy: Occupancy
    label: str
    seed: int | None = None
    target: TargetPattern | None = None
    machine: dict[str, Any] | None = None


def read_source(text: str, seed: int | None = None, stdin: BinaryIO | None = None) -> Source:
    """Read an occupancy in any of the forms that a user can type.

    ``random:ROWSxCOLS@P`` is ``numpy.random.default_rng(seed).random((rows, cols)) < P``.

    Args:
        text: See :data:`FORMS`.
        seed: Seed for ``random:``. None for a new seed.
        stdin: The stream for "-". None for standard input.

    Raises:
        ConfigError: The text has none of these forms, or cannot be read. The message names the forms.
    """
    if text == "-":
        data = (stdin or sys.stdin.buffer).read(MAX_BYTES + 1)
        return Source(parse_text(data, "standard input"), "standard input")
    if text.startswith("random:"):
        return _random(text, seed)
    if not text:
        raise ConfigError(Problem("the occupancy is empty", expected=FORMS))
    if text.lower().endswith(YAML_SUFFIXES):
        hint = "to plan for its target, write: labseq plan random:20x20@0.75 --target " + clean(text)
        raise ConfigError(Problem("a sequence contains no occupancy", clean(text), expected=FORMS, hint=hint))
    match = _ARRAY.fullmatch(text)
    address, index = match.groups() if match else (text, None)
    path, name = split_name(address)
    if not is_file(path):
        what = something_else(path) or "there is no such file"
        names = [name for name in files_in(path.parent, (".txt", *ARRAY_FILES)) if name != path.name]
        hint = did_you_mean(path.name, names)
        raise ConfigError(Problem(what, clean(str(path)), expected=FORMS, hint=hint))
    if _SHOT.fullmatch(address):
        return _shot(path, index)
    label = visible(text)
    if path.suffix.lower() in ARRAY_FILES:
        return Source(_array(path, name, index, label), label)
    return Source(parse_text(_read(path), label), label)


def parse_text(data: bytes, name: str) -> Occupancy:
    r"""Read rows of 0 and 1, rows drawn with "." and "#", or a list of rows.

    Numbers may be written as by numpy.savetxt and spreadsheets (1.0, 1e+00, True), with spaces, commas, tabs
    or semicolons between them. Among numbers, "#" begins a comment.

    Args:
        data: UTF-8.
        name: Its origin, for messages.

    Raises:
        ConfigError: The text has an error. The message gives line and column.

    Example:
        >>> parse_text(b"1 0 1\n0 1 0\n", "mine").astype(int).tolist()
        [[1, 0, 1], [0, 1, 0]]
        >>> parse_text(b"# a loading\n1.0,0.0\n0.0,1.0\n", "mine").astype(int).tolist()
        [[1, 0], [0, 1]]
        >>> parse_text(b"#.#", "mine").astype(int).tolist()
        [[1, 0, 1]]
    """
    if len(data) > MAX_BYTES:
        raise ConfigError(Problem(f"this is larger than {MAX_BYTES >> 20} MiB", name, expected=_size_limit()))
    text = _Text(decode(data, name), name)
    rows = [(start, text.sites(start, row)) for start, row in text.rows()]
    if not rows:
        raise ConfigError(Problem("it is empty", name, expected="rows of 0 and 1, one line each"))
    first_line, n_cols = text.place(rows[0][0])[0], len(rows[0][1])
    for start, sites in rows:
        if len(sites) != n_cols:
            what, expected = f"this row has {len(sites)} sites", f"{n_cols}, as in line {first_line}"
            end = sites[-1][0] + 1 if sites else start
            raise text.error(what, sites[n_cols][0] if len(sites) > n_cols else end, expected)
    return _checked(np.array([[atom for _, atom in sites] for _, sites in rows], np.bool_), name)


class _Text:
    """The text of an occupancy, with its rows and the places of errors."""

    def __init__(self, text: str, name: str) -> None:
        self._text, self._name = text, name
        # among numbers "#" begins a comment, as in numpy, but in a drawing it is an atom
        self._is_drawn = _COUNTED_ROW.search(text) is None

    def place(self, index: int) -> tuple[int, int]:
        """Line and column of a character."""
        return line_and_column(self._text, index)

    def error(self, what: str, index: int, expected: str, hint: str = "") -> ConfigError:
        """An error at a character."""
        return ConfigError(Problem(what, self._name, *self.place(index), expected, hint))

    def rows(self) -> Iterator[tuple[int, str]]:
        """The start and the text of each row, without comments and the empty lines around all rows."""
        # comments become spaces, so that everything else keeps its place
        text = self._text if self._is_drawn else _COMMENT.sub(self._blank, self._text)
        if "[" in text:
            yield from self._listed(text)
            return
        start, begin, end = 0, len(text) - len(text.lstrip(_SEPARATORS)), len(text.rstrip(_SEPARATORS))
        for line_break in _LINE_BREAK.finditer(text):
            if line_break.start() > begin and start < end:
                yield start, text[start : line_break.start()]
            start = line_break.end()

    def _blank(self, comment: re.Match[str]) -> str:
        if re.fullmatch(r"\s*#[ \t]*[#.][#. \t]*\s*", comment[0]):
            what, expected = "a row of '#' and '.' among rows of numbers", "one kind of rows"
            raise self.error(what, comment.start(), expected, "begin a comment with '# ' and a word")
        return " " * len(comment[0])

    def _listed(self, text: str) -> Iterator[tuple[int, str]]:
        """The rows of ``[[1, 0], [0, 1]]``, as Python and numpy write them. A row may take several lines."""
        between = _LIST_ROW.sub(lambda row: " " * len(row[0]), text)
        if stray := re.search(r"[^][\s,;]", between):
            raise self.error(f"{shown(stray[0])} is not within a row", stray.start(), "[[1, 0], [0, 1]]")
        for row in _LIST_ROW.finditer(text):
            yield row.start(1), row[1]

    def sites(self, start: int, row: str) -> list[tuple[int, bool]]:
        """The sites of a row: index in the text, and whether there is an atom.

        Raises:
            ConfigError: A part of the row is not a site, or different separators are used.
        """
        words = list(_WORD.finditer(row))
        separators = [row[a.end() : b.start()].strip() for a, b in pairwise(words)]
        for word, separator in zip(words, separators, strict=False):
            # "1,0 0,0" is two numbers with decimal commas, and "1,,0" lacks a value
            if separator != separators[0] or len(separator) > 1:
                what = f"the separator after '{clean(word[0])}' differs from the others in the row"
                expected = "one comma, semicolon, or space after each value"
                hint = "write numbers with a decimal point"
                raise self.error(what, start + word.end(), expected, hint)
        return [site for word in words for site in self._word(start + word.start(), word[0])]

    def _word(self, start: int, word: str) -> list[tuple[int, bool]]:
        """The sites of a word: one per character of "0110" and "#..#", or a single number or truth value."""
        characters = _DRAWN if self._is_drawn else _COUNTED
        wrong = next((i for i, character in enumerate(word) if character not in characters), None)
        if wrong is None:
            return [(start + i, characters[character]) for i, character in enumerate(word)]
        value = None if self._is_drawn else _number(word)
        if value in (0.0, 1.0):
            return [(start, bool(value))]
        if value is not None and not word.isdigit():
            raise self.error(f"'{clean(word)}' is not a site", start, _SITES)
        hint = (
            ""
            if self._is_drawn or word[wrong].isdigit()
            else "begin a line with a title or a comment with '#'"
        )
        raise self.error(f"{shown(word[wrong])} is not a site", start + wrong, _SITES, hint)


def _number(word: str) -> float | None:
    """The number or truth value of a word, or None for other words."""
    try:
        return float({"true": "1", "false": "0"}.get(word.lower(), word))
    except ValueError:
        return None


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
        raise ConfigError(Problem(f"the grid has {rows} x {cols} sites", clean(text), expected=_size_limit()))
    if seed is None:
        seed = secrets.randbits(32)
    atoms = np.random.default_rng(seed).random((rows, cols)) < probability
    return Source(atoms, f"{text}, seed {seed}", seed)


def _array(path: Path, name: str, index: str | None, label: str) -> Occupancy:
    """Read an array (n_rows, n_cols), or one item of an array (n, n_rows, n_cols)."""
    with opened_array(path, name) as array:
        if array.ndim == 3:
            array = array[_index(index, array.shape[0], label)]
        elif array.ndim != 2 or index is not None:
            what = f"the array has shape {array.shape}"
            expected = "(rows, columns), or (occupancies, rows, columns) with '#' and an index"
            raise ConfigError(Problem(what, label, expected=expected))
        return _checked(array, label)


def _index(text: str | None, n: int, label: str) -> int:
    if text is None:
        raise ConfigError(Problem(f"there are {n} occupancies", label, expected=f"{label}#0 for the first"))
    if re.fullmatch(r"[0-9]{1,9}", text) and int(text) < n:
        return int(text)
    raise ConfigError(Problem(f"there is no occupancy '{clean(text)}'", label, expected=f"0 to {n - 1}"))


def _checked(array: NDArray[Any], name: str) -> Occupancy:
    if not 1 <= min(array.shape) <= max(array.shape) <= MAX_SITES:
        what = f"the array has {array.shape[0]} x {array.shape[1]} sites"
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
        hint = f"for another program's file, name the array as in {clean(path.name)}:DATASET"
        raise ConfigError(Problem(error.text, name, expected="a shot's file", hint=hint)) from error
    cycles, images = content.record.cycles, content.record.images
    if not cycles:
        raise ConfigError(Problem("this shot has no cycles", name, expected="a shot with a rearrangement"))
    index = 0 if cycle is None else int(cycle) if re.fullmatch(r"[0-9]{1,6}", cycle) else -1
    if not 0 <= index < len(cycles):
        there_are = "0, the only one" if len(cycles) == 1 else f"a cycle from 0 to {len(cycles) - 1}"
        raise ConfigError(Problem(f"there is no cycle '{clean(cycle or '')}'", name, expected=there_are))
    seen = image_before(cycles[index], images)
    if seen is None:
        raise ConfigError(Problem(f"there is no image before cycle {index}", name, expected="an image"))
    label = f"{name}, before cycle {index}"
    resolved = cast("dict[str, Any]", content.run["resolved"] or {})
    machine = profile_of_shot(resolved, content.record.parameters) if resolved.get("profile") else None
    return Source(seen.occupancy, label, target=content.target, machine=machine)


def image_before(cycle: CycleRecord, images: Sequence[ImageRecord]) -> ImageRecord | None:
    """The image for which a cycle was planned, which is the last before the cycle's own, or None."""
    before = [image for image in images if (image.step, image.cycle) < (cycle.step, cycle.cycle)]
    return before[-1] if before else None


def _read(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)
    except OSError as error:
        what = f"this cannot be read ({error.strerror})"
        raise ConfigError(Problem(what, clean(str(path)), expected=FORMS)) from error


def _size_limit() -> str:
    return f"1 to {MAX_SITES} rows and columns"
