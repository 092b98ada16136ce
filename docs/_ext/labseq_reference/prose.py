"""Docstrings as Markdown."""

from __future__ import annotations

import inspect
import re
import textwrap
from typing import Final

_TITLES: Final = {
    "Args": "Arguments",
    "Attributes": "Fields",
    "Example": "Example",
    "Raises": "Raises",
    "Returns": "Returns",
}
_SECTION: Final = re.compile(rf"^({'|'.join(_TITLES)}):$", re.MULTILINE)
_ITEM: Final = re.compile(r"^(\*{0,2}\w+): ", re.MULTILINE)


def summary(documented: object) -> str:
    """The first paragraph of a docstring, on one line."""
    return parts(documented)[""].partition("\n\n")[0].replace("\n", " ")


def markdown(documented: object) -> str:
    """A docstring without its examples: its text, then a list for each section."""
    blocks: list[str] = []
    for title, text in parts(documented).items():
        if not title:
            blocks.append(text)
        elif title != "Example":
            blocks.append(f"{_TITLES[title]}:\n\n{_items(text)}")
    return "\n\n".join(blocks)


def parts(documented: object) -> dict[str, str]:
    """The text of a Google-style docstring by section, in Markdown; the text before them is ""."""
    text = _plain_code(inspect.getdoc(documented) or "")
    before, *sections = _SECTION.split(text)
    bodies = [textwrap.dedent(body.strip("\n")) for body in sections[1::2]]
    return {"": before.strip(), **dict(zip(sections[::2], bodies, strict=True))}


def _items(text: str) -> str:
    """``name: text`` per item as a list; what is no item as it is."""
    items = [" ".join(item.split()) for item in re.split(r"\n(?=\S)", text.strip())]
    if not all(_ITEM.match(item) for item in items):
        return text
    return "\n".join(_ITEM.sub(r"- `\1`: ", item, count=1) for item in items)


def _plain_code(text: str) -> str:
    """reST's roles and literals to Markdown's code."""
    text = re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text)
    return text.replace("``", "`")
