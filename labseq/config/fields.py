"""Settings types that several parts of sequence and profile share."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
)

from labseq.config.document import Document
from labseq.errors import ConfigError, Problem
from labseq.messages import clean, shown, visible
from labseq.settings import Text, empty_is, setting_error
from labseq.text_files import beside, is_folder
from labseq.units import parse_any

FORMAT: Final = 1
"""Version of the file format that this labseq reads."""

_KINDS: Final = {"sequence": "shot", "hardware profile": "grid"}  # kind of file: a key that only it has

ROLES: Final = ("camera", "static_tweezers", "mobile_tweezers", "detector", "lines", "simulation")
"""The roles of a profile that are one plugin each."""
MAY_ADD: Final = (
    "timeouts",
    "budgets",
    "grid.row_frequency",
    "grid.column_frequency",
    "mobile_tweezers.rf",
    "calibrations",
    "calibrations.use",
)
"""Addresses of mappings that an option may set something in although the profile has none."""


def _is_version(value: Any) -> Any:
    if type(value) is not int or value != FORMAT:  # neither true nor 1.0 is a version
        raise setting_error(f"labseq is {shown(value)}", "1, the version of the file format")
    return FORMAT


def _is_name(name: str) -> str:
    name = unicodedata.normalize("NFC", name)
    # Letters, marks on letters, and digits of any script.
    odd = next((c for c in name if unicodedata.category(c)[0] not in "LMN" and c not in " -_."), None)
    expected = "letters, digits, spaces, '-', '_' and '.'"
    if odd is not None:
        raise setting_error(f"name is '{clean(name)}', with '{clean(odd)}' in it", expected)
    if not any(char.isalnum() for char in name):
        raise setting_error(f"name is '{clean(name)}'", "at least one letter or digit")
    if name != name.strip():
        raise setting_error(f"name is '{clean(name)}'", "no space at either end")
    return name


FormatVersion: TypeAlias = Annotated[Literal[1], BeforeValidator(_is_version)]
"""1."""
Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=80), AfterValidator(_is_name)]
"""A name that can be part of the name of a folder."""
Folders: TypeAlias = Annotated[list[Text], empty_is([])]
"""Folders, relative to the file that names them."""


def check_kind(document: Document, kind: Literal["sequence", "hardware profile"]) -> None:
    """Refuse a file of another kind, or of a newer format, before anything else is said of it.

    Raises:
        ConfigError: It is for a newer labseq, or it is not a sequence or a profile.
    """
    version = document.data.get("labseq")
    if isinstance(version, int) and version > FORMAT:
        what = f"this file is written for a newer labseq: its format is {version}, this labseq reads {FORMAT}"
        raise document.error(("labseq",), what, "", "update labseq")
    for other, key in _KINDS.items():
        if other != kind and key in document.data and _KINDS[kind] not in document.data:
            what = f"this is a {other} (it has the key '{key}')"
            raise document.error((key,), what, f"a {kind}", key=True)


def plugin_paths(document: Document, folders: Sequence[str]) -> list[Path]:
    """The folders of ``plugin_folders``, from the file that names them.

    Raises:
        ConfigError: One does not exist.
    """
    paths: list[Path] = []
    problems: list[Problem] = []
    for i, folder in enumerate(folders):
        path = beside(document.path.parent, folder)
        if not is_folder(path):
            what = f"there is no plugin folder '{clean(folder)}'"
            problems.append(
                document.problem(("plugin_folders", i), what, f"a folder at {visible(str(path))}")
            )
        paths.append(path)
    if problems:
        raise ConfigError(problems)
    return paths


VARIABLES: Final = "variables"
"""The key."""

_NAME: Final = re.compile(r"[^\W\d]\w*")


def si_of(value: Any) -> Any:
    """The value of a variable, SI, from what is written."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    try:
        return parse_any(value if isinstance(value, str) else "")[0]
    except ValueError:
        what = f"a variable is {shown(value)}"
        raise setting_error(what, "a number, or a number with a unit such as '20 ms'") from None


def _named(variables: dict[str, int | float]) -> dict[str, int | float]:
    for name in variables:
        if not _NAME.fullmatch(name):
            what = f"a variable is called '{clean(name)}'"
            raise setting_error(what, "letters, digits and '_', a letter first", at=(name,), key=True)
    return variables


Variables: TypeAlias = Annotated[
    dict[str, Annotated[int | float, BeforeValidator(si_of)]], AfterValidator(_named), empty_is({})
]
"""Name -> value, SI."""
