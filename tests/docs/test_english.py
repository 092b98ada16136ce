"""Sentences of pages and docstrings state one fact each: few are joined by a semicolon or a colon."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from .blocks import PAGES

CODE = re.compile(r"^( *)(`{3,}).*?^\1\2 *$|<!--.*?-->|^---\n.*?\n---$", re.DOTALL | re.MULTILINE)
TABLE_OR_HEADING = re.compile(r"^\s*[|#].*$", re.MULTILINE)
LEAD = re.compile(r"^\s*(?:-|\d+\.) .{,70}?:(?= )", re.MULTILINE)
"""The term that an item of a list explains, with its colon."""
LINK = re.compile(r"!?\[([^\]]*)\]\([^)]*\)")


def prose(text: str) -> str:
    """The sentences of a page, with x for what is code or a formula."""
    text = TABLE_OR_HEADING.sub("", CODE.sub("", text))
    return LEAD.sub("", re.sub(r"`[^`\n]*`|\$[^$\n]*\$", "x", LINK.sub(r"\1", text)))


def test_few_sentences_are_joined() -> None:
    text = "\n".join(prose(page.read_text("utf-8")) for page in PAGES)
    n_words = len(re.findall(r"[\w'-]+", text))
    assert n_words > 30_000
    assert 1000 * len(re.findall(r";", text)) / n_words < 1.5
    assert 1000 * len(re.findall(r"\w\)?: +[a-z0-9]", text)) / n_words < 2.5


def test_few_sentences_of_docstrings_are_joined() -> None:
    root = Path(__file__).parents[2]
    text = ""
    for file in (*root.glob("labseq/**/*.py"), *root.glob("plugins/**/*.py")):
        nodes = ast.walk(ast.parse(file.read_text("utf-8")))
        values = [node.value for node in nodes if isinstance(node, ast.Expr)]
        text += "\n".join(
            one.value for one in values if isinstance(one, ast.Constant) and isinstance(one.value, str)
        )
    n_words = len(text.split())
    assert n_words > 100_000
    assert 1000 * len(re.findall(r"[a-z]; ", text)) / n_words < 1.0
