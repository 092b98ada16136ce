"""Base class, quantities with units and common types of the settings of plugins, sequences and profiles."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    Literal,
    Self,
    TypeAlias,
    TypeGuard,
    TypeVar,
    cast,
    get_args,
    get_origin,
)

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationInfo,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from labseq.errors import Loc
from labseq.messages import clean, shown
from labseq.units import expected, parse_any, parse_quantity, unit_names

FOLDER: Final = "folder"
"""Key of pydantic's validation context for the folder of the file that holds the settings."""
NEEDS_UNITS: Final = "needs_units"
"""Key of pydantic's validation context, True if a quantity needs its unit, as in a file."""

MAX_DURATION_S: Final = 30 * 86_400.0
"""Longest duration of any setting, far longer than any run, and within the range of every clock."""


class Settings(BaseModel):
    """Base of every settings model, which is immutable, refuses unknown keys and holds SI values.

    Subclass it for your plugin. Give each field a description and, if possible, a default. Quantities accept
    text such as "45 ms", and in Python also a number in SI units.

    Example:
        >>> class Mine(Settings):
        ...     exposure: Duration = 45e-3
        >>> Mine(exposure="20 ms").exposure
        0.02
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=False,
        defer_build=True,
        serialize_by_alias=True,
    )

    def identities(self) -> Sequence[str] | None:
        """For drivers, names of resources that only one process can use, such as a port or a card.

        labseq locks them before opening, and recognises them after a crash, even with another profile. Empty
        if there is nothing to lock. If it is None (default), the profile's path is used instead.
        """
        return None

    def warnings(self) -> Iterable[tuple[Loc, str, str]]:
        """For drivers, values that are allowed but probably not intended, shown by ``labseq check``.

        Each warning is the keys from these settings to the value, the problem, and the expected value.
        """
        return ()

    def algorithm_text(self) -> str:
        """For planners, the algorithm that these settings select, for ``labseq check``, in 60 characters.

        Empty (default) if the planner's name is enough.
        """
        return ""


class NoSettings(Settings):
    """The settings of a plugin that takes none."""


def key_without_unit(name: str) -> str:
    """The key in a file for an attribute in SI, without the unit, which a file gives with the value.

    Example:
        >>> key_without_unit("speed_m_s"), key_without_unit("distance_per_m")
        ('speed', 'distance_per_m')
    """
    return re.sub(r"(?<!_per)_(m_s|s|m|k|hz|v|w|db)$", "", name)


IN_SI: Final = ConfigDict(
    extra="forbid",
    allow_inf_nan=False,
    defer_build=True,
    serialize_by_alias=True,
    alias_generator=key_without_unit,
    validate_by_name=True,
)
"""Configuration of a domain type that is also a mapping of settings, as a dataclass of pydantic.

Python code uses attribute names, which include the unit. A file uses :func:`key_without_unit`.
"""


def setting_error(
    what: str, expected: str = "", hint: str = "", *, at: Loc = (), key: bool = False
) -> PydanticCustomError:
    """An error for a validator to raise, with its own wording and its place within the value.

    Args:
        what: The problem.
        expected: The expected value.
        hint: The remedy.
        at: Keys and indices from the validated value to the wrong part of it.
        key: Whether the key at that place is wrong, not its value.
    """
    context: dict[str, Any] = {"what": what, "expected": expected, "hint": hint, "at": at, "key": key}
    return PydanticCustomError("setting_error", "{what}; expected {expected}", context)


@dataclass(frozen=True, slots=True)
class Quantity:
    """Converts text with a unit to SI. A number comes from Python and is in SI already.

    Attributes:
        dimension: A key of :data:`labseq.units.UNITS`.
    """

    dimension: str

    def __call__(self, value: Any, info: ValidationInfo) -> Any:
        """The value in SI. In a file only 0 needs no unit, unless the zero depends on the unit."""
        if isinstance(value, str):
            return parse_quantity(value, self.dimension)
        if value is None or isinstance(value, bool | list | tuple | dict):
            raise ValueError(f"expected {expected(self.dimension)}")
        is_zero = value == 0 and self.dimension != "temperature"
        needs_none = is_zero or self.dimension == "fraction" or not math.isfinite(value)
        if not needs_none and (info.context or {}).get(NEEDS_UNITS):
            raise PydanticCustomError("unit_missing", "{dimension}", {"dimension": self.dimension})
        return value


@dataclass(frozen=True, slots=True, eq=False)  # a default may be a dict, which has no hash
class DefaultIfEmpty:
    """Replaces an empty value by a default.

    Attributes:
        default: The default.
    """

    default: Any

    def __call__(self, value: Any) -> Any:
        """The default for None, any other value unchanged."""
        return self.default if value is None else value


def empty_is(default: Any) -> BeforeValidator:
    """Let a key without a value mean ``default``."""
    return BeforeValidator(DefaultIfEmpty(default))


def _quantity(dimension: str) -> BeforeValidator:
    return BeforeValidator(Quantity(dimension))


SettingsType: TypeAlias = type[Any]
"""A type with settings, see :func:`has_settings`."""


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """One key of a settings model, described for messages, reference pages, units and addresses.

    Attributes:
        key: The key in a file.
        name: The attribute in Python.
        annotation: Its annotated type.
        default: The default, or None for a key that must be given.
        is_required: Whether the key must be given.
        description: Its description.
        dimension: The dimension of its quantity, or of all quantities in its list. "" for none or several.
        models: The models of the mapping that it holds, of the items of its list or of its named entries.
        is_by_name: Whether it holds a mapping of names that the user chooses.
    """

    key: str
    name: str
    annotation: Any
    default: Any
    is_required: bool
    description: str
    dimension: str
    models: tuple[SettingsType, ...]
    is_by_name: bool

    @property
    def si_unit(self) -> str:
        """The SI unit of its quantity, or "" if it has none."""
        return "" if self.dimension in ("", "fraction") else unit_names(self.dimension)[0]


@cache
def settings_of(model: SettingsType | None) -> tuple[Setting, ...]:
    """The settings of a model, in the order of declaration. Empty for a plugin without settings."""
    fields: Mapping[str, FieldInfo] = getattr(model, "__pydantic_fields__", {})
    settings = [_setting(name, field) for name, field in fields.items()]
    return tuple(setting for setting in settings if setting.key != _OWN_NAME)


def _setting(name: str, field: FieldInfo) -> Setting:
    annotation = Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
    parts = list(_parts(annotation))
    dimensions = set(filter(None, map(dimension_read_by, parts)))
    return Setting(
        key=field.validation_alias if isinstance(field.validation_alias, str) else name,
        name=name,
        annotation=annotation,
        default=None if field.is_required() else field.get_default(call_default_factory=True),
        is_required=field.is_required(),
        description=field.description or "",
        dimension=dimensions.pop() if len(dimensions) == 1 else "",
        models=tuple(dict.fromkeys(filter(has_settings, parts))),
        is_by_name=any(get_origin(part) is dict for part in parts),
    )


def _parts(kind: Any) -> Iterator[Any]:
    """The types, limits and validators that an annotation is made of, at any depth."""
    yield kind
    for part in (*getattr(kind, "__metadata__", ()), *get_args(kind)):
        yield from _parts(part)


def dimension_read_by(part: Any) -> str:
    """The dimension of the quantity that a part of an annotation reads, or "" for any other part."""
    function = part.func if isinstance(part, BeforeValidator) else None
    return function.dimension if isinstance(function, Quantity) else ""


def has_settings(kind: Any) -> TypeGuard[SettingsType]:
    """Whether a type is a settings model, or a domain type with the configuration IN_SI."""
    return isinstance(kind, type) and hasattr(kind, "__pydantic_fields__")


def settings_at(model: SettingsType | None, loc: Loc) -> Sequence[Setting]:
    """The setting at a location below a model. There are several in a union, and none at the top.

    An index or a user's name leads to the setting that holds the list or mapping.
    """
    settings: Sequence[Setting] = ()
    models: Sequence[SettingsType | None] = [model]
    for step in loc:
        named = [setting for inner in models for setting in settings_of(inner) if setting.key == step]
        if named:
            settings, models = named, [inner for setting in named for inner in setting.models]
    return settings


def models_at(model: SettingsType, loc: Loc) -> list[SettingsType]:
    """The settings models at a location below a model. There are several in a union."""
    settings = settings_at(model, loc)
    return [inner for setting in settings for inner in setting.models] if settings else [model]


def si_unit_at(model: SettingsType | None, loc: Loc) -> str:
    """SI unit of the setting at a location in a settings model, or "" if there is no setting or no unit.

    Example:
        >>> class Mine(Settings):
        ...     windows: Duration | tuple[Duration, ...] = 60e-3
        >>> si_unit_at(Mine, ("windows", 2))
        's'
    """
    return next((setting.si_unit for setting in settings_at(model, loc) if setting.si_unit), "")


def _not_too_long(duration_s: float) -> float:
    if duration_s > MAX_DURATION_S:
        raise ValueError("expected at most 720 h, which is 30 days")
    return duration_s


def path_beside(folder: Path, path: str) -> Path:
    """A path in a file in ``folder``, relative to that folder. ``~`` is the user's home."""
    try:
        return folder / Path(path).expanduser()
    except RuntimeError:  # "~nobody"
        return folder / path


def _beside_its_file(path: Path, info: ValidationInfo) -> Path:
    context = cast("Mapping[str, Path]", info.context or {})
    return path_beside(context.get(FOLDER, Path()), str(path))


Text: TypeAlias = Annotated[str, Field(min_length=1)]
"""Text that is not empty."""
FilePath: TypeAlias = Annotated[Path, AfterValidator(_beside_its_file)]
"""A file, relative to the sequence or profile that names it, or in Python to the working folder."""
Duration: TypeAlias = Annotated[float, _quantity("time"), Field(ge=0), AfterValidator(_not_too_long)]
"""Seconds, from 0 to :data:`MAX_DURATION_S`, for example "45 ms"."""
PositiveDuration: TypeAlias = Annotated[
    float, _quantity("time"), Field(gt=0), AfterValidator(_not_too_long)
]  # not built on Duration, whose limit would be named for values below 0
"""Seconds, more than 0, at most :data:`MAX_DURATION_S`, for example "45 ms"."""
Length: TypeAlias = Annotated[float, _quantity("length")]
"""Metres, for example "4.49 um"."""
Frequency: TypeAlias = Annotated[float, _quantity("frequency")]
"""Hertz, for example "80 MHz"."""
Speed: TypeAlias = Annotated[float, _quantity("speed"), Field(gt=0)]
"""Metres per second, more than 0, for example "130 um/ms"."""
Voltage: TypeAlias = Annotated[float, _quantity("voltage")]
"""Volts, for example "200 mV"."""
Power: TypeAlias = Annotated[float, _quantity("power")]
"""Watts, for example "10 mW"."""
Temperature: TypeAlias = Annotated[float, _quantity("temperature")]
"""Kelvins, for example "300 uK"."""
Angle: TypeAlias = Annotated[float, _quantity("angle")]
"""Radians, for example "60 deg"."""
Fraction: TypeAlias = Annotated[float, _quantity("fraction"), Field(ge=0, le=1)]
"""0 to 1, for example "75 %"."""


class Choice(Settings):
    """A plugin chosen by name, with the plugin's settings as further keys of the same mapping.

    Attributes:
        use: Name of the plugin.
        key: The key that holds the name, to be dropped before the plugin's settings are validated.
    """

    model_config = ConfigDict(extra="ignore")  # the plugin's settings, validated later

    key: ClassVar[str] = "use"
    use: Text = Field(description="the name of a plugin")
    _loc: Loc = PrivateAttr(())

    @property
    def loc(self) -> Loc:
        """Location of its mapping in the document."""
        return self._loc

    @property
    def core_keys(self) -> frozenset[str]:
        """Keys of the mapping that labseq reads itself. All others are the plugin's settings."""
        return frozenset(setting.key for setting in settings_of(type(self)))

    def placed(self, *loc: str | int) -> Self:
        """A copy with the location of its mapping."""
        copy = self.model_copy()
        copy._loc = loc  # noqa: SLF001 - of the same class
        return copy

    @model_validator(mode="before")
    @classmethod
    def _refuse_bare_name(cls, value: Any) -> Any:
        if isinstance(value, str):
            name = clean(value)
            raise setting_error(f"there is only '{name}' here", "a mapping", f"write '{{{cls.key}: {name}}}'")
        return value


class PatternChoice(Choice):
    """A target pattern, as ``{pattern: compact, rows: 15, cols: 15}``."""

    key: ClassVar[str] = "pattern"
    use: Text = Field(alias="pattern", description="the name of a target pattern")


_C = TypeVar("_C", bound=Choice)


def with_settings_of(spec: SettingsType) -> Callable[[type[_C]], type[_C]]:
    """Let the mapping that names a plugin hold the settings of a domain type too."""

    def extend(choice: type[_C]) -> type[_C]:
        fields: Any = {name: (field.annotation, field) for name, field in spec.__pydantic_fields__.items()}
        name, module = choice.__name__, choice.__module__
        return create_model(name, __base__=choice, __module__=module, __doc__=choice.__doc__, **fields)

    return extend


_OWN_NAME: Final = ""
"""The key that :data:`named_by_key` adds. No file contains it."""
OwnName: TypeAlias = Annotated[SkipJsonSchema[str], Field(validation_alias=_OWN_NAME, exclude=True)]
"""The name that a user gives to one of several mappings, which in a file is the key of the mapping."""


def _named_by_key(mappings: Any) -> Any:
    if not isinstance(mappings, dict):
        return mappings
    by_name = cast("dict[str, Any]", mappings)
    return {
        name: {**value, _OWN_NAME: name} if isinstance(value, dict) else value
        for name, value in by_name.items()
    }


named_by_key: Final = BeforeValidator(_named_by_key)
"""Validator for a mapping of names to settings, which puts each name into the settings' :data:`OwnName`."""


def _placed_by_field(choice: _C, info: ValidationInfo) -> _C:
    return choice.placed(info.field_name or "")


placed_by_field: Final = AfterValidator(_placed_by_field)
"""Validator for a field that is a :class:`Choice`, whose location is the field's name."""


FORMAT: Final = 1
"""Version of the file format that this labseq reads."""


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


def si_of(value: Any) -> Any:
    """The value of a variable in SI, from a number or a quantity as text."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    try:
        return parse_any(value if isinstance(value, str) else "")[0]
    except ValueError:
        what = f"a variable is {shown(value)}"
        raise setting_error(what, "a number, or a number with a unit such as '20 ms'") from None


def _check_names(variables: dict[str, int | float]) -> dict[str, int | float]:
    for name in variables:
        if not re.fullmatch(r"[^\W\d]\w*", name):
            what = f"a variable is called '{clean(name)}'"
            raise setting_error(what, "letters, digits and '_', a letter first", at=(name,), key=True)
    return variables


FormatVersion: TypeAlias = Annotated[Literal[1], BeforeValidator(_is_version)]
"""Version of the file format, which must be 1."""
Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=80), AfterValidator(_is_name)]
"""A name that can be part of the name of a folder."""
Folders: TypeAlias = Annotated[list[Text], empty_is([])]
"""Folders, relative to the file that names them."""
Variables: TypeAlias = Annotated[
    dict[str, Annotated[int | float, BeforeValidator(si_of)]], AfterValidator(_check_names), empty_is({})
]
"""Name -> value, SI."""
