"""Explains PyYAML's syntax errors to the author of a sequence, with line and column."""

from __future__ import annotations

import re
from typing import Final, NamedTuple, cast

from yaml.error import Mark, MarkedYAMLError
from yaml.events import Event, ScalarEvent

from labseq.errors import Problem
from labseq.messages import clean

_QUOTE_IT: Final = "put text with special characters in quotes"
_NO_TAGS: Final = "YAML tags ('!') are not allowed"
_MISALIGNED: Final = "the indentation of this line fits no line above"
_CLOSER: Final = {"[": "]", "{": "}"}


class _Rule(NamedTuple):
    """The message if PyYAML's problem and context match; ``{0}`` is the first group of ``problem``."""

    problem: str
    what: str
    expected: str = ""
    hint: str = ""
    context: str = ""
    at_context: bool = False


_RULES: Final = (
    _Rule(
        r"found character (.+) that cannot start any token", "a value cannot begin with {0}", "", _QUOTE_IT
    ),
    _Rule(
        "sequence entries are not allowed",
        "a list item ('- ') cannot begin here",
        "it on a line of its own",
    ),
    _Rule("mapping keys are not allowed here", "a '?' cannot stand here", "", _QUOTE_IT),
    _Rule(
        "found unexpected (?:end of stream|document separator)",
        "the quotation mark that opens here is never closed",
        context="quoted scalar",
        at_context=True,
    ),
    _Rule(
        "found unknown escape character (.+)",
        "a backslash and {0} mean nothing in double quotes",
        hint=r"use single quotes, or write '\\' for a backslash",
    ),
    _Rule(
        "expected escape sequence of (.+) hexadecimal numbers",
        "this escape in double quotes needs {0} hexadecimal digits",
        hint="use single quotes",
    ),
    _Rule(
        "expected alphabetic or numeric character",
        "'&' and '*' begin anchors and aliases, and a name must follow",
        hint=_QUOTE_IT,
        context="while scanning an",
        at_context=True,
    ),
    _Rule("", _NO_TAGS, "plain values", _QUOTE_IT, context="a tag"),
    _Rule("tag handle", _NO_TAGS, "plain values", _QUOTE_IT),
    _Rule(
        "",
        "'|' and '>' begin a block of text on the lines below",
        "nothing else on their line",
        context="a block scalar",
    ),
    _Rule("expected the node content, but found (.+)", "a value is missing before {0}"),
    _Rule(
        "but found another document",
        "a second document begins here",
        "one document in a file",
        "remove '---'",
    ),
    _Rule(
        "expected '<document start>', but found",
        "this follows after the end of the file's mapping",
        "one mapping and nothing after it",
    ),
    _Rule("YAML d(?:irective|ocument)", "this is not a version of YAML that labseq reads", "YAML 1.2"),
    _Rule("", "this is no YAML directive", hint=_QUOTE_IT, context="a directive"),
)
_TOKENS: Final = {
    "'<stream end>'": "the end of the file",
    "'<document end>'": "the end of the document",
    "'<document start>'": "'---'",
    "'<block end>'": "the end of the block",
    "'<block mapping start>'": "the next key",
    "'<block sequence start>'": "'- '",
}


def explain(error: MarkedYAMLError, text: str, last: Event | None, opened: Mark | None) -> Problem:
    """Explain a syntax error, with its place.

    Args:
        error: The error.
        text: The text that was parsed.
        last: The event before the error.
        opened: The innermost bracket that is open at the error; None outside of brackets.

    Returns:
        The problem, with line and column but without a source.
    """
    problem, context = error.problem or "", error.context or ""
    at = cast("Mark", error.problem_mark or error.context_mark)
    since = error.context_mark or at
    if text[at.index : at.index + 1] == "\t":
        if text[at.index - at.column : at.index].strip():
            return _at(at, "a tab stands here", "a space")
        return _at(at, "a tab is used for indentation", "spaces")
    if "expected ':'" in problem:
        line = re.split(r"[\r\n]", text[since.index :], maxsplit=1)[0]
        has_colon = ":" in line.partition(" #")[0]
        what = "there is no space after the ':' of this line" if has_colon else "this line has no ':'"
        return _at(since, what, "'key: value'")
    if problem.startswith("mapping values"):
        return _stray_colon(text, at)
    if opened and problem.endswith("'<stream end>'"):
        bracket = text[opened.index]
        what = f"the '{bracket}' that opens here is never closed"
        return _at(opened, what, f"',' or '{_CLOSER[bracket]}'")
    if flow := re.match(r"expected ',' or '(.)', but got", problem):
        return _wrong_in_brackets(flow[1], since, at)
    if block := re.match(r"expected <block end>, but found '(.+)'", problem):
        return _late_quote(last, at) or _out_of_place(block[1], context, text, since, at)
    for rule in _RULES:
        match = re.search(rule.problem, problem)
        if match and rule.context in context:
            found = match[1] if match.re.groups else ""
            what = rule.what.format(_TOKENS.get(found, clean(found)))
            return _at(since if rule.at_context else at, what, rule.expected, rule.hint)
    return _at(at, f"this is not valid YAML: {clean(problem)}", "", _QUOTE_IT)


def _at(mark: Mark, what: str, expected: str = "", hint: str = "") -> Problem:
    return Problem(what, "", mark.line + 1, mark.column + 1, expected, hint)


def _stray_colon(text: str, at: Mark) -> Problem:
    """Explain a second colon on a line, or a line that is indented so that it continues the text above."""
    before = text[at.index - at.column : at.index]
    spaces = len(before) - len(before.lstrip())
    above, line = _line_above(text, at)
    if ": " not in before and line and spaces > above:
        what = f"this line is indented further than line {line}, which has a value already"
        return _at(at, what, f"{above} spaces as there")
    hint = "put text that holds ': ' in quotes"
    return _at(at, "a ':' cannot stand here", "one 'key: value' on a line", hint)


def _line_above(text: str, at: Mark) -> tuple[int, int]:
    """Column of the first key on the nearest line above that is not empty, and its number, from 1."""
    lines = re.split(r"\r\n|\r|\n", text[: at.index])[:-1]
    for number in range(len(lines), 0, -1):
        if match := re.match(r" *(?:- +)*(?=[^ #])", lines[number - 1]):
            return match.end(), number
    return 0, 0


def _wrong_in_brackets(closer: str, since: Mark, at: Mark) -> Problem:
    """Explain an error in a list or mapping in brackets, on its first line or a later one."""
    pair = "[...]" if closer == "]" else "{...}"
    if at.line == since.line:
        what = f"the {pair} that opens in column {since.column + 1} goes wrong here"
        return _at(at, what, f"',' or '{closer}'")
    what = f"the '{pair[0]}' that opens here is not closed by line {at.line + 1}"
    return _at(since, what, f"',' or '{closer}'")


def _late_quote(last: Event | None, at: Mark) -> Problem | None:
    """Explain a quoted text that ends lines too late, at the next quotation mark; None for other errors."""
    if not isinstance(last, ScalarEvent) or last.style not in ("'", '"'):
        return None
    start, end = cast("Mark", last.start_mark), cast("Mark", last.end_mark)
    if start.line == end.line or end.line != at.line:
        return None
    what = f"the quotation mark that opens here is closed only in line {end.line + 1}"
    return _at(start, what, "a quotation mark at the end of the text")


def _out_of_place(found: str, context: str, text: str, since: Mark, at: Mark) -> Problem:
    """Explain a line whose indentation matches neither the current block nor one around it."""
    is_item = found in ("-", "<block sequence start>")
    is_aligned = at.column == since.column
    if is_item and is_aligned:
        return _at(at, "a list item ('- ') stands among the keys of a mapping", "'key: value'")
    if is_item:
        return _at(at, _MISALIGNED, "that of the other items of the list")
    if is_aligned and "collection" in context:
        return _at(at, "this line does not continue the list above", "'- '", "check the indentation")
    if is_aligned and found == ":":
        return _at(at, "a key is missing before this ':'", "'key: value'")
    if not is_aligned and found in ("<block mapping start>", "?"):
        above, line = _line_above(text, at)
        other = f" or {since.column} as in line {since.line + 1}" if since.column != above else ""
        return _at(at, _MISALIGNED, f"{above} spaces as in line {line}{other}")
    return _at(at, "this does not belong here", "the end of the line", _QUOTE_IT)
