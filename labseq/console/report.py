"""Reports of commands. A report is a dataclass with fields for ``--json`` and a text for people.

Tables are laid out here rather than by rich, which cuts columns off and breaks paths in a terminal that is
too narrow for them.
"""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Final, Generic, Protocol, TypeAlias, TypeVar

from labseq.console.errors import json_errors
from labseq.console.output import as_line, say, stdout_to_stderr

Row = TypeVar("Row")
Facts: TypeAlias = Sequence[tuple[str, str]]
"""Names and texts, for a table of two columns without a heading."""


class Report(Protocol):
    """The result of a command: a dataclass whose fields are the keys of the JSON."""

    def as_text(self) -> Iterable[str]:
        """The result as lines for people."""
        ...


def print_report(report: Report, *, as_json: bool) -> None:
    """Print a report as text, or as one line of JSON."""
    say(*([as_line(report)] if as_json else report.as_text()))


@contextmanager
def reporting(
    *, as_json: bool, failed: Callable[[BaseException], Any] = json_errors
) -> Generator[Callable[[Report], None]]:
    """Provide the function that prints a command's report.

    Args:
        as_json: Whether to print JSON. Everything else, including output of plugins, then goes to stderr.
        failed: Gives the JSON to print if the command fails.
    """
    if not as_json:
        yield lambda report: say(*report.as_text())
        return
    answer = stdout_to_stderr()
    try:
        yield lambda report: answer(as_line(report))
    except BaseException as error:
        answer(as_line(failed(error)))
        raise


@dataclass(frozen=True)
class Column(Generic[Row]):
    """A column of a table.

    Attributes:
        heading: Text above the column.
        text: Row -> text of the cell.
        right: Whether it is aligned on the right, as numbers are.
    """

    heading: str
    text: Callable[[Row], object]
    right: bool = False


def table(rows: Iterable[Row], columns: Sequence[Column[Row]], most: int = 0) -> list[str]:
    """A table with a row for each value, see :func:`aligned`.

    Example:
        >>> table([0.5, 0.25], [Column("share", lambda x: f"{100 * x:g} %", right=True)])
        ['share', ' 50 %', ' 25 %']
    """
    cells = [[str(column.text(row)) for column in columns] for row in rows]
    right = [i for i, column in enumerate(columns) if column.right]
    return aligned([[column.heading for column in columns], *cells], right, most)


def aligned(
    rows: Sequence[Sequence[str]], right: Sequence[int] = (), most: int = 0, keys: int = 1
) -> list[str]:
    """Lay out rows of text in columns two spaces apart.

    If stdout is a terminal that is too narrow for the table, texts are wrapped between words. Columns
    that still do not fit follow in a second table, after the first ``keys`` columns. A word that is wider
    than the terminal, such as a path, stays whole. In a pipe or a file every row stays on one line.

    Args:
        rows: The cells. All rows have the same number of cells.
        right: Indices of the columns that are aligned on the right. Below the header they are not wrapped.
        most: Maximum number of rows below the header, 0 for all. The middle rows are left out.
        keys: Number of columns that tell the rows apart.

    Example:
        >>> aligned([["image", "45 ms"], ["load", "500 ms"]], right=[1])
        ['image   45 ms', 'load   500 ms']
    """
    if 0 < most < len(rows) - 1:
        gap = ["...", *[""] * (len(rows[0]) - 1)]
        rows = [*rows[: most // 2 + 1], gap, *rows[-(most // 2) :]]
    table = [list(column) for column in zip(*rows, strict=True)]
    widths = [max(map(len, column)) for column in table]
    room = shutil.get_terminal_size().columns if sys.stdout.isatty() else 0
    if not room or _total(widths) <= room:
        return _lines(table, right, widths)
    least = [_least(column, i in right) for i, column in enumerate(table)]
    while keys > 1 and _total([*least[:keys], _MIN_WIDTH]) > room:
        keys -= 1
    n_fit = len(least)
    while n_fit > keys + 1 and _total(least[:n_fit]) > room:
        n_fit -= 1
    least[n_fit - 1] = min(least[n_fit - 1], max(_MIN_WIDTH, room - _total([*least[: n_fit - 1], 0])))
    widths = widths[:n_fit]
    while _total(widths) > room and widths != least[:n_fit]:
        widest = max(range(n_fit), key=lambda i: (widths[i] > least[i], widths[i]))
        widths[widest] -= 1
    lines = _lines(table[:n_fit], right, widths)
    if n_fit == len(table):
        return lines
    rest = [*range(keys), *range(n_fit, len(table))]
    others = aligned(
        [[row[i] for i in rest] for row in rows], [k for k, i in enumerate(rest) if i in right], keys=keys
    )
    return [*lines, "", *others]


def filled_columns(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Rows of text, the header first, without columns that are empty below the header.

    Example:
        >>> filled_columns([["run", "note"], ["7", ""], ["8", "-"]])
        [['run'], ['7'], ['8']]
    """
    kept = [i for i, column in enumerate(zip(*rows, strict=True)) if {*column[1:]} - {"", "-"}]
    return [[row[i] for i in kept] for row in rows]


_MIN_WIDTH: Final = 10
_UNIT: Final = re.compile(r"(?<=[\d)]) (?=(?:%|[munk]?s|[munk]?m|[kMG]?Hz|[munk]?[VW]|[kMGT]B|px|degC)\b|%)")


def _words(cell: str) -> str:
    """A cell in which a number and its unit are one word."""
    return _UNIT.sub("\xa0", cell)


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * (len(widths) - 1)


def _least(column: Sequence[str], is_number: bool) -> int:
    """The width of a column below which a word or a number would be broken. A drawing counts as one word."""
    whole = [cell for cell in column[1:] if is_number or cell.startswith(" ")]
    words = [word for cell in column for word in _words(cell).split(" ")]
    return max(map(len, [*whole, *words]))


def _lines(table: Sequence[Sequence[str]], right: Sequence[int], widths: Sequence[int]) -> list[str]:
    lines: list[str] = []
    for row in zip(*table, strict=True):
        cells = [
            [cell]
            if len(cell) <= width
            else textwrap.wrap(_words(cell), width, break_long_words=False, break_on_hyphens=False)
            for cell, width in zip(row, widths, strict=True)
        ]
        for parts in zip_longest(*cells, fillvalue=""):
            padded = (
                part.rjust(width) if i in right else part.ljust(width)
                for i, (part, width) in enumerate(zip(parts, widths, strict=True))
            )
            lines.append("  ".join(padded).replace("\xa0", " ").rstrip())
    return lines
