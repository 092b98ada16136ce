"""Explains syntax errors of YAML. Rare mistakes keep PyYAML's message."""

from __future__ import annotations

import re
from typing import Final, cast

from yaml.error import Mark as YamlMark, MarkedYAMLError
from yaml.events import Event, ScalarEvent

from labseq.config.yaml_nodes import PATH_HINT
from labseq.errors import Problem
from labseq.messages import clean

_QUOTE_IT: Final = "put text with special characters in single quotes"


def explain_syntax_error(
    error: MarkedYAMLError, text: str, last: Event | None, opened: YamlMark | None
) -> Problem:
    """Explain a syntax error, with its place.

    Args:
        last: The event before the error.
        opened: The innermost bracket that is open at the error. None outside of brackets.

    Returns:
        The problem, with line and column but without a source.
    """
    problem = error.problem or ""
    at = cast("YamlMark", error.problem_mark or error.context_mark)
    since = error.context_mark or at
    if text[at.index : at.index + 1] == "\t":
        return _at(at, "there is a tab here", "spaces")
    if "expected ':'" in problem:
        return _missing_colon(text, since)
    if problem.startswith("mapping values"):
        return _stray_colon(text, at)
    if opened and (problem.startswith("expected ',' or") or problem.endswith("'<stream end>'")):
        return _wrong_in_brackets(text, opened, at)
    if problem.startswith("expected <block end>"):
        return _late_quote(last, at) or _out_of_place(text, since, at)
    if "escape character" in problem or "expected escape sequence" in problem:
        return _wrong_escape(text, at)
    if "quoted scalar" in (error.context or "") and "unexpected" in problem:
        return _at(since, "the quotation mark that opens here is never closed")
    return _at(at, f"this is not valid YAML: {clean(problem.removeprefix('but '))}", "", _QUOTE_IT)


def _at(mark: YamlMark, what: str, expected: str = "", hint: str = "") -> Problem:
    return Problem(what, "", mark.line + 1, mark.column + 1, expected, hint)


def _wrong_escape(text: str, at: YamlMark) -> Problem:
    """Explain a backslash in double quotes, usually in a Windows path."""
    start = text.rindex("\\", 0, at.index + 1)
    escape = clean(text[start : start + 2])
    what = f"in double quotes a backslash begins an escape, and '{escape}' is not a complete one"
    return Problem(what, "", at.line + 1, at.column + 1 - (at.index - start), "", PATH_HINT)


def _missing_colon(text: str, since: YamlMark) -> Problem:
    line = re.split(r"[\r\n]", text[since.index :], maxsplit=1)[0]
    has_colon = ":" in line.partition(" #")[0]
    what = "there is no space after the ':' of this line" if has_colon else "this line has no ':'"
    return _at(since, what, "'key: value'")


def _stray_colon(text: str, at: YamlMark) -> Problem:
    """Explain a second colon on a line, or a line that is indented so that it continues the text above."""
    before = text[at.index - at.column : at.index]
    spaces = len(before) - len(before.lstrip())
    above, line = _line_above(text, at)
    if ": " not in before and line and spaces > above:
        what = f"this line is indented further than line {line}, which already has a value"
        return _at(at, what, f"{above} spaces as in line {line}")
    hint = "put text that contains ': ' in quotes"
    return _at(at, "a ':' is not allowed here", "one 'key: value' on a line", hint)


def _line_above(text: str, at: YamlMark) -> tuple[int, int]:
    """Column of the first key on the nearest non-empty line above, and the line's number, from 1."""
    lines = re.split(r"\r\n|\r|\n", text[: at.index])[:-1]
    for number in range(len(lines), 0, -1):
        if match := re.match(r" *(?:- +)*(?=[^ #])", lines[number - 1]):
            return match.end(), number
    return 0, 0


def _wrong_in_brackets(text: str, opened: YamlMark, at: YamlMark) -> Problem:
    """Explain an error in a list or mapping in brackets, on its first line or a later one."""
    bracket = text[opened.index]
    closer = "]" if bracket == "[" else "}"
    expected = f"',' or '{closer}'"
    if at.line == opened.line and at.index < len(text):
        what = f"the {bracket}...{closer} that opens in column {opened.column + 1} has an error here"
        return _at(at, what, expected)
    return _at(opened, f"the '{bracket}' that opens here is not closed", expected)


def _late_quote(last: Event | None, at: YamlMark) -> Problem | None:
    """Explain a quoted text that ends lines too late, at the next quotation mark. None for other errors."""
    if not isinstance(last, ScalarEvent) or last.style not in ("'", '"'):
        return None
    start, end = cast("YamlMark", last.start_mark), cast("YamlMark", last.end_mark)
    if start.line == end.line or end.line != at.line:
        return None
    what = f"the quotation mark that opens here is closed only in line {end.line + 1}"
    return _at(start, what, "a quotation mark at the end of the text")


def _out_of_place(text: str, since: YamlMark, at: YamlMark) -> Problem:
    """Explain a line that continues no block above it, or text after a complete value on its line."""
    if text[at.index - at.column : at.index].strip():
        return _at(at, "this does not belong here", "the end of the line", _QUOTE_IT)
    if at.column == since.column:
        return _at(
            at, "this line does not continue the block above", "'- ' in a list, 'key: value' otherwise"
        )
    what = "the indentation of this line matches no line above"
    if text[at.index] == "-":
        return _at(at, what, "the indentation of the other list items")
    above, line = _line_above(text, at)
    other = f" or {since.column} as in line {since.line + 1}" if since.column != above else ""
    return _at(at, what, f"{above} spaces as in line {line}{other}")
