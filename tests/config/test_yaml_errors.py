"""Text that is no strict YAML, and what is said of it: the first message, exactly."""

# ruff: noqa: E501 - messages are quoted as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.config.document import Document
from labseq.errors import ConfigError

GOOD = (Path(__file__).parent / "data" / "sequence.yaml").read_text(encoding="utf-8")

CASES = [
    ("no colon", "shots: 20", "shots 20", "s.yaml:5:1: this line has no ':'; expected 'key: value'"),
    (
        "no space after a colon",
        "shots: 20",
        "shots:20",
        "s.yaml:5:1: there is no space after the ':' of this line; expected 'key: value'",
    ),
    (
        "tab for indentation",
        "  - image: {",
        "\t- image: {",
        "s.yaml:16:1: a tab is used for indentation; expected spaces",
    ),
    ("tab after a colon", "shots: 20", "shots:\t20", "s.yaml:5:7: a tab stands here; expected a space"),
    (
        "bracket never closed",
        "target: {pattern: compact, rows: 15, cols: 15}\n",
        "target: {pattern: compact, rows: 15\n",
        "s.yaml:7:9: the '{' that opens here is not closed by line 8; expected ',' or '}'",
    ),
    (
        "comma missing",
        "rows: 15, cols",
        "rows: 15 cols",
        "s.yaml:7:41: the {...} that opens in column 9 goes wrong here; expected ',' or '}'",
    ),
    (
        "wrong bracket",
        "cols: 15}",
        "cols: 15]",
        "s.yaml:7:46: the {...} that opens in column 9 goes wrong here; expected ',' or '}'",
    ),
    (
        "bracket open to the end",
        "- wait: {duration: 1 ms}\n  - image:\n",
        "- wait: {duration: 1 ms\n",
        "s.yaml:26:11: the '{' that opens here is never closed; expected ',' or '}'",
    ),
    (
        "key twice in braces",
        "rows: 15, cols: 15",
        "rows: 15, rows: 15",
        "s.yaml:7:38: 'rows' is given twice (first in line 7, column 28); remove one of them",
    ),
    (
        "key twice",
        "attempts: 2",
        "shots: 2",
        "s.yaml:12:1: 'shots' is given twice (first in line 5, column 1); remove one of them",
    ),
    (
        "item indented too far",
        "  - image: {",
        "   - image: {",
        "s.yaml:16:4: the indentation of this line fits no line above; expected that of the other items of the list",
    ),
    (
        "item indented too little",
        "  - image: {",
        " - image: {",
        "s.yaml:16:2: the indentation of this line fits no line above; expected that of the other items of the list",
    ),
    (
        "key indented too far",
        "shots: 20",
        "  shots: 20",
        "s.yaml:5:8: this line is indented further than line 4, which has a value already; expected 0 spaces as there",
    ),
    (
        "key indented too little",
        "      cycles",
        "     cycles",
        "s.yaml:20:13: this line is indented further than line 19, which has a value already; expected 5 spaces as there",
    ),
    (
        "setting indented too far",
        "      cycles",
        "       cycles",
        "s.yaml:20:7: the indentation of this line fits no line above; expected 7 spaces as in line 19 or 4 as in line 17",
    ),
    (
        "quotation mark open",
        "name: compact-225",
        "name: 'compact-225",
        "s.yaml:3:7: the quotation mark that opens here is closed only in line 24; expected a quotation mark at the end of the text",
    ),
    (
        "text after quotes",
        "name: compact-225",
        "name: 'compact'-225",
        "s.yaml:3:16: this does not belong here; expected the end of the line; put text with special characters in quotes",
    ),
    (
        "double quotes open",
        "name: compact-225\nprofile: virtual",
        'name: "compact-225\nprofile: "virtual"',
        "s.yaml:3:7: the quotation mark that opens here is closed only in line 4; expected a quotation mark at the end of the text",
    ),
    (
        "quotes never closed",
        "- image:\n",
        "- image: {a: 'b}\n",
        "s.yaml:27:16: the quotation mark that opens here is never closed",
    ),
    (
        "colon in text",
        "name: compact-225",
        "name: compact: 225",
        "s.yaml:3:14: a ':' cannot stand here; expected one 'key: value' on a line; put text that holds ': ' in quotes",
    ),
    (
        "backslash",
        "name: compact-225",
        'name: "C:\\data"',
        "s.yaml:3:11: a backslash and 'd' mean nothing in double quotes; use single quotes, or write '\\\\' for a backslash",
    ),
    (
        "at sign",
        "name: compact-225",
        "name: @home",
        "s.yaml:3:7: a value cannot begin with '@'; put text with special characters in quotes",
    ),
    (
        "unknown alias",
        "name: compact-225",
        "name: *best*",
        "s.yaml:3:7: '&' and '*' begin anchors and aliases, and a name must follow; put text with special characters in quotes",
    ),
    (
        "recursive alias",
        '[plugins, "more plugins"]',
        "&a [*a]",
        "s.yaml:13:21: '*a' stands inside of '&a' itself",
    ),
    (
        "anchor twice",
        "name: compact-225\nprofile: virtual",
        "name: &a x\nprofile: &a x",
        "s.yaml:4:10: the anchor '&a' is given twice",
    ),
    (
        "tag",
        "name: compact-225",
        "name: !mine x",
        "s.yaml:3:7: '!mine' is a YAML tag, which is not allowed; expected a plain value; put text that begins with '!' in quotes",
    ),
    (
        "python tag",
        "name: compact-225",
        "name: !!python/object/apply:os.system [exit 1]",
        "s.yaml:3:7: '!!python/object/apply:os.system' is a YAML tag, which is not allowed; expected a plain value; put text that begins with '!' in quotes",
    ),
    (
        "standard tag",
        "shots: 20",
        "shots: !!int '20'",
        "s.yaml:5:8: '!!int' is a YAML tag, which is not allowed; expected a plain value; put text that begins with '!' in quotes",
    ),
    (
        "merge key",
        "name: compact-225",
        "<<: {name: x}",
        "s.yaml:3:1: merge keys ('<<') are not allowed; expected every setting written out",
    ),
    (
        "number for a key",
        "name: compact-225",
        "225: compact",
        "s.yaml:3:1: a key is 225; expected text; write '225' in quotes",
    ),
    ("list for a key", "name: compact-225", "[a, b]: compact", "s.yaml:3:1: a key is a list; expected text"),
    (
        "key empty",
        "name: compact-225",
        ": compact",
        "s.yaml:3:1: a key is missing before this ':'; expected 'key: value'",
    ),
    (
        "key that is a switch",
        "name: compact-225",
        "true: compact",
        "s.yaml:3:1: a key is true; expected text; write 'true' in quotes",
    ),
    (
        "list among keys",
        "seed: 7",
        "- seed: 7",
        "s.yaml:6:1: a list item ('- ') stands among the keys of a mapping; expected 'key: value'",
    ),
    (
        "second document",
        "shot:\n",
        "---\nshot:\n",
        "s.yaml:14:1: a second document begins here; expected one document in a file; remove '---'",
    ),
    (
        "text after the document",
        "shot:\n",
        "...\nshot:\n",
        "s.yaml:15:1: this follows after the end of the file's mapping; expected one mapping and nothing after it",
    ),
    (
        "control character",
        "shots: 20",
        "shots: 2\x070",
        "s.yaml:5:9: an invisible character (U+0007, control character); expected plain text; delete it",
    ),
    (
        "nul",
        "shots: 20",
        "shots: 2\x000",
        "s.yaml:5:9: a NUL character (U+0000); expected plain text; is this a YAML file, saved as UTF-8?",
    ),
    (
        "line separator",
        "shots: 20",
        "shots: 2\u20280",
        "s.yaml:5:9: an invisible character (U+2028, line separator); expected plain text; delete it",
    ),
    (
        "byte order mark inside",
        "shots: 20",
        "shots: \ufeff20",
        "s.yaml:5:8: an invisible character (U+FEFF, zero width no-break space); expected plain text; delete it",
    ),
    (
        "no-break space for indentation",
        "  - image: {",
        "\u00a0 - image: {",
        "s.yaml:16:1: a no-break space (U+00A0) is used for indentation; expected plain spaces",
    ),
    (
        "wide space behind the dash",
        "  - image: {",
        "  -\u3000image: {",
        "s.yaml:16:4: an ideographic space (U+3000) is used for indentation; expected plain spaces",
    ),
    (
        "list without brackets",
        "cols: 15}",
        "cols: 15, origin: 1,2}",
        "s.yaml:7:58: a key is 2; expected text; a ',' begins another key: write 4.5 for 4,5 and [4, 5] for a list",
    ),
    (
        "surrogate",
        "name: compact-225",
        'name: "\\ud800"',
        "s.yaml:3:7: an escape in this text is half of a character; expected the character itself",
    ),
    (
        "character out of range",
        "name: compact-225",
        'name: "\\U00110000"',
        "s.yaml:3:10: this number or escape is out of range",
    ),
    (
        "block text with more",
        "name: compact-225",
        "name: | x",
        "s.yaml:3:9: '|' and '>' begin a block of text on the lines below; expected nothing else on their line",
    ),
    (
        "directive",
        "# A sequence with everything in it.",
        "%YAML 2.0\n---",
        "s.yaml:1:1: this is not a version of YAML that labseq reads; expected YAML 1.2",
    ),
    (
        "deep nesting",
        "shots: 20",
        "shots: [[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]",
        "s.yaml:5:39: lists and mappings are nested more than 32 deep",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), [pytest.param(*case[1:], id=case[0]) for case in CASES])
def test_first_message(old: str, new: str, message: str) -> None:
    assert old in GOOD

    with pytest.raises(ConfigError) as caught:
        Document.parse(GOOD.replace(old, new, 1), "s.yaml")

    assert str(caught.value.problems[0]) == message
