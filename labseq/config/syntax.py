"""PyYAML's syntax errors in a physicist's words."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, cast

from yaml.error import Mark as YamlMark, MarkedYAMLError
from yaml.events import Event, ScalarEvent

from labseq.config.nodes import Mark
from labseq.config.wording import ErrorText, clean

_QUOTE_IT: Final = "put text with special characters in quotes"

_CLOSER: Final = {"[": "]", "{": "}"}
_MISALIGNED: Final = "the indentation of this line fits no line above"


@dataclass(frozen=True, slots=True)
class _Rule:
    """Words for the errors whose problem and context match; ``{0}`` is the problem's first group."""

    problem: str
    words: ErrorText
    context: str = ""
    at_context: bool = False


_RULES: Final = (
    _Rule(
        r"found character (.+) that cannot start any token",
        ErrorText("a value cannot begin with {0}", "", _QUOTE_IT),
    ),
    _Rule(
        "sequence entries are not allowed here",
        ErrorText("a list item ('- ') cannot begin here", "it on a line of its own"),
    ),
    _Rule("mapping keys are not allowed here", ErrorText("a '?' cannot stand here", "", _QUOTE_IT)),
    _Rule(
        "found unexpected (?:end of stream|document separator)",
        ErrorText("the quotation mark that opens here is never closed"),
        context="quoted scalar",
        at_context=True,
    ),
    _Rule(
        "found unknown escape character (.+)",
        ErrorText(
            "a backslash and {0} mean nothing in double quotes",
            "",
            r"use single quotes, or write '\\' for a backslash",
        ),
    ),
    _Rule(
        "expected escape sequence of (.+) hexadecimal numbers",
        ErrorText("this escape in double quotes needs {0} hexadecimal digits", "", "use single quotes"),
    ),
    _Rule(
        "expected alphabetic or numeric character",
        ErrorText("'&' and '*' begin anchors and aliases, and a name must follow", "", _QUOTE_IT),
        context="while scanning an",
        at_context=True,
    ),
    _Rule("", ErrorText("YAML tags ('!') are not allowed", "plain values", _QUOTE_IT), context="a tag"),
    _Rule("tag handle", ErrorText("YAML tags ('!') are not allowed", "plain values", _QUOTE_IT)),
    _Rule(
        "",
        ErrorText("'|' and '>' begin a block of text on the lines below", "nothing else on their line"),
        context="a block scalar",
    ),
    _Rule(
        "expected the node content, but found (.+)",
        ErrorText("a value is missing before {0}"),
    ),
    _Rule(
        "expected '<document start>', but found",
        ErrorText("this follows after the end of the file's mapping", "one mapping and nothing after it"),
    ),
    _Rule("YAML d(?:irective|ocument)", ErrorText("this is not a version of YAML that labseq reads", "YAML 1.2")),
    _Rule("", ErrorText("this is no YAML directive", "", _QUOTE_IT), context="a directive"),
)
_TOKENS: Final = {
    "'<stream end>'": "the end of the file",
    "'<document end>'": "the end of the document",
    "'<document start>'": "'---'",
    "'<block end>'": "the end of the block",
    "'<block mapping start>'": "the next key",
    "'<block sequence start>'": "'- '",
}


def explain(
    error: MarkedYAMLError, text: str, last: Event | None, opened: YamlMark | None
) -> tuple[Mark, ErrorText]:
    """Say where a syntax error is and what it is.

    Args:
        error: The error.
        text: The text that it is in.
        last: What was read before it.
        opened: The innermost bracket that is open, if it is in one.
    """
    problem, context = error.problem or "", error.context or ""
    at = cast("YamlMark", error.problem_mark or error.context_mark)
    since = error.context_mark or at
    if text[at.index : at.index + 1] == "\t":
        return _mark(at), _tab(text, at)
    if "expected ':'" in problem:
        return _mark(since), _no_colon(text, since)
    if problem.startswith("mapping values"):
        return _mark(at), _stray_colon(text, at)
    if opened and problem.endswith("'<stream end>'"):
        words = ErrorText(
            f"the '{text[opened.index]}' that opens here is never closed",
            f"',' or '{_CLOSER[text[opened.index]]}'",
        )
        return _mark(opened), words
    flow = re.match(r"expected ',' or '(.)', but got", problem)
    if flow:
        return _open_bracket(flow[1], since, at)
    block = re.match(r"expected <block end>, but found '(.+)'", problem)
    if block:
        return _late_quote(last, at) or (_mark(at), _out_of_place(block[1], context, text, since, at))
    return _by_rule(problem, context, since, at)


def _by_rule(problem: str, context: str, since: YamlMark, at: YamlMark) -> tuple[Mark, ErrorText]:
    for rule in _RULES:
        match = re.search(rule.problem, problem)
        if match and rule.context in context:
            found = match[1] if match.re.groups else ""
            what = rule.words.what.format(_TOKENS.get(found, clean(found)))
            mark = since if rule.at_context else at
            return _mark(mark), ErrorText(what, rule.words.expected, rule.words.hint)
    return _mark(at), ErrorText(f"this is not valid YAML: {clean(problem)}", "", _QUOTE_IT)


def _tab(text: str, at: YamlMark) -> ErrorText:
    if not text[at.index - at.column : at.index].strip():
        return ErrorText("a tab is used for indentation", "spaces")
    return ErrorText("a tab stands here", "a space")


def _no_colon(text: str, at: YamlMark) -> ErrorText:
    line = re.split(r"[\r\n]", text[at.index :], maxsplit=1)[0]
    if ":" in line.partition(" #")[0]:
        return ErrorText("there is no space after the ':' of this line", "'key: value'")
    return ErrorText("this line has no ':'", "'key: value'")


def _stray_colon(text: str, at: YamlMark) -> ErrorText:
    """A second colon on a line, or on a line that is indented so that it continues the text above."""
    before = text[at.index - at.column : at.index]
    spaces = len(before) - len(before.lstrip())
    above, line = _line_above(text, at)
    if ": " not in before and line and spaces > above:
        what = f"this line is indented further than line {line}, which has a value already"
        return ErrorText(what, f"{above} spaces as there")
    return ErrorText(
        "a ':' cannot stand here", "one 'key: value' on a line", "put text that holds ': ' in quotes"
    )


def _line_above(text: str, at: YamlMark) -> tuple[int, int]:
    """Column of the first key on the nearest line above that says anything, and its number, from 1."""
    lines = re.split(r"\r\n|\r|\n", text[: at.index])[:-1]
    for number in range(len(lines), 0, -1):
        match = re.match(r" *(?:- +)*(?=[^ #])", lines[number - 1])
        if match:
            return match.end(), number
    return 0, 0


def _open_bracket(closer: str, since: YamlMark, at: YamlMark) -> tuple[Mark, ErrorText]:
    """A list or mapping in brackets that goes wrong: on its first line, or only later."""
    pair = "[...]" if closer == "]" else "{...}"
    if at.line == since.line:
        words = ErrorText(
            f"the {pair} that opens in column {since.column + 1} goes wrong here", f"',' or '{closer}'"
        )
        return _mark(at), words
    what = f"the '{pair[0]}' that opens here is not closed by line {at.line + 1}"
    return _mark(since), ErrorText(what, f"',' or '{closer}'")


def _late_quote(last: Event | None, at: YamlMark) -> tuple[Mark, ErrorText] | None:
    """A quoted text that ends lines later than it should, at the next quotation mark."""
    if not isinstance(last, ScalarEvent) or last.style not in ("'", '"'):
        return None
    start, end = cast("YamlMark", last.start_mark), cast("YamlMark", last.end_mark)
    if start.line == end.line or end.line != at.line:
        return None
    what = f"the quotation mark that opens here is closed only in line {end.line + 1}"
    return _mark(start), ErrorText(what, "a quotation mark at the end of the text")


def _out_of_place(found: str, context: str, text: str, since: YamlMark, at: YamlMark) -> ErrorText:
    """Something that fits neither the block that is open nor one around it."""
    is_item = found in ("-", "<block sequence start>")
    is_aligned = at.column == since.column
    if is_item and is_aligned:
        return ErrorText("a list item ('- ') stands among the keys of a mapping", "'key: value'")
    if is_item:
        return ErrorText(_MISALIGNED, "that of the other items of the list")
    if is_aligned and "collection" in context:
        return ErrorText("this line does not continue the list above", "'- '", "check the indentation")
    if is_aligned and found == ":":
        return ErrorText("a key is missing before this ':'", "'key: value'")
    if not is_aligned and found in ("<block mapping start>", "?"):
        above, line = _line_above(text, at)
        other = f" or {since.column} as in line {since.line + 1}" if since.column != above else ""
        return ErrorText(_MISALIGNED, f"{above} spaces as in line {line}{other}")
    return ErrorText("this does not belong here", "the end of the line", _QUOTE_IT)


def _mark(mark: YamlMark) -> Mark:
    return Mark(mark.line + 1, mark.column + 1)
