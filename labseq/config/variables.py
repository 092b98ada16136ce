"""``variables:`` of a sequence or profile: what expressions refer to by ``variables.NAME``."""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, TypeAlias

from pydantic import AfterValidator, BeforeValidator

from labseq.config.fields import empty_is, setting_error
from labseq.config.wording import clean, shown
from labseq.units import parse_any

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
