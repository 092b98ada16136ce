"""The templates: one file for each kind of plugin, and what all plugins have in common.

A template of a plugin consists of sections, each begun by a line ``==> name <==``: ``about`` (what the
plugin does, in a sentence), the files, and ``use`` (the command that runs a sequence with it).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files
from string import Template
from typing import Final

_FOLDER: Final = "templates"
_SECTION: Final = re.compile(r"^==> (.+) <==\n", re.MULTILINE)


def read_template(name: str) -> str:
    """The text of a template.

    Args:
        name: Name of its file.
    """
    return (files("labseq.scaffolds") / _FOLDER / name).read_text(encoding="utf-8")


def filled(text: str, values: Mapping[str, str]) -> str:
    """A template with its words put in; a word that is missing is an error of ours.

    Example:
        >>> filled("class ${Name}Planner:", {"Name": "Spiral"})
        'class SpiralPlanner:'
    """
    return Template(text).substitute(values)


def plugin_sections(kind: str) -> dict[str, str]:
    """The sections of a plugin's template, not filled in, by their names."""
    _, *parts = _SECTION.split(read_template(f"{kind}.txt"))
    return dict(zip(parts[::2], parts[1::2], strict=True))


def class_prefix(name: str) -> str:
    """What the names of a plugin's classes begin with.

    Example:
        >>> class_prefix("my_spiral_2")
        'MySpiral2'
    """
    return "".join(word.capitalize() for word in name.split("_"))
