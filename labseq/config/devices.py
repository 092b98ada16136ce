"""Further instruments of a profile: what the core must know of them."""

from __future__ import annotations

import re
from typing import Annotated, Final

from pydantic import Field

from labseq.config.fields import ROLES, Choice, Text, setting_error
from labseq.config.settings import Settings
from labseq.config.wording import clean

_DEVICE_NAME: Final = re.compile(r"[^\W\d][\w-]*")


class BlindingSettings(Settings):
    """When a device's light would blind a camera with EM gain."""

    value: Text = Field(default="state", description="the value of the device that tells")
    when: Annotated[tuple[bool | int | float | str, ...], Field(min_length=1)] = Field(
        default=("on",), description="what the value is while the light is on"
    )


class DeviceChoice(Choice):
    """The plugin of an instrument, and what the core must know of it."""

    blinding: BlindingSettings | None = Field(
        default=None,
        description="no exposure with EM gain while its light is on: `{value: state, when: [on]}`",
    )


DEVICE_KEYS: Final = ("blinding",)
"""Keys of a device that belong to the core, not to the plugin."""


def device_name(name: str, what: str) -> None:
    """Refuse what cannot be a name in an address or a file."""
    if not _DEVICE_NAME.fullmatch(name):
        expected = "a word of letters, digits, '_' and '-' that begins with a letter"
        raise setting_error(f"{what} is called '{clean(name)}'", expected, at=(name,), key=True)


def named(devices: dict[str, DeviceChoice]) -> dict[str, DeviceChoice]:
    """Refuse names that a device cannot have, and tell each choice its place."""
    for name in devices:
        if name in (*ROLES, "planner"):
            raise setting_error(f"a device is called '{name}', like a role", "another name", at=(name,), key=True)
        device_name(name, "a device")
    return {name: choice.placed("devices", name) for name, choice in devices.items()}
