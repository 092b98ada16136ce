"""Settings types that several parts of sequence and profile share."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, TypeAlias, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticCustomError

from labseq.config.document import Document
from labseq.config.messages import clean, shown, visible
from labseq.config.settings import Settings
from labseq.config.yaml_nodes import Loc, beside, is_folder
from labseq.errors import ConfigError, Problem
from labseq.units import parse_any

C = TypeVar("C", bound="Choice")

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

Text: TypeAlias = Annotated[str, Field(min_length=1)]
"""Any text but the empty one."""


def setting_error(
    what: str, expected: str = "", hint: str = "", *, at: Loc = (), key: bool = False
) -> PydanticCustomError:
    """An error for a validator to raise that keeps its words, and its place within the value.

    Args:
        what: What is wrong.
        expected: What would have been right.
        hint: What to do.
        at: Where, below the value that is validated.
        key: Whether the key there is meant.
    """
    context: dict[str, Any] = {"what": what, "expected": expected, "hint": hint, "at": at, "key": key}
    return PydanticCustomError("setting_error", "{what}; expected {expected}", context)


class Choice(Settings):
    """A plugin chosen by name; its settings stand beside the name.

    Attributes:
        use: Name of what is used.
        key: The key that holds the name, to be dropped before the settings are validated.
    """

    model_config = ConfigDict(extra="ignore")  # the plugin's settings, validated later

    key: ClassVar[str] = "use"
    use: Text = Field(description="the name of a plugin")
    _loc: Loc = PrivateAttr(())

    @property
    def loc(self) -> Loc:
        """Where its mapping is in the document."""
        return self._loc

    def placed(self, *loc: str | int) -> Self:
        """A copy that says where its mapping is."""
        copy = self.model_copy()
        copy._loc = loc  # noqa: SLF001 - its own
        return copy

    @model_validator(mode="before")
    @classmethod
    def _is_no_bare_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            name = clean(value)
            raise setting_error(f"just '{name}' stands here", "a mapping", f"write '{{{cls.key}: {name}}}'")
        return value


class PatternChoice(Choice):
    """A target pattern: ``{pattern: compact, rows: 15, cols: 15}``."""

    key: ClassVar[str] = "pattern"
    use: Text = Field(alias="pattern", description="the name of a target pattern")


def _placed_by_field(choice: C, info: ValidationInfo) -> C:
    return choice.placed(info.field_name or "")


placed_by_field: Final = AfterValidator(_placed_by_field)
"""For a field that is a :class:`Choice`: its location is the field's name."""


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


@dataclass(frozen=True, slots=True, eq=False)  # a default may be a dict, which has no hash
class DefaultIfEmpty:
    """Puts a default in the place of an empty value.

    Attributes:
        default: The default.
    """

    default: Any

    def __call__(self, value: Any) -> Any:
        """The default for None; any other value as it is."""
        return self.default if value is None else value


def empty_is(default: Any) -> BeforeValidator:
    """Let a key that is there without a value count as ``default``."""
    return BeforeValidator(DefaultIfEmpty(default))


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
