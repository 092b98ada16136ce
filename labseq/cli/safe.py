"""``labseq safe``: every device of a profile to its safe state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from labseq.cli.failures import report
from labseq.cli.output import say
from labseq.errors import ConfigError, DeviceError
from labseq.session import make_profile_safe


def secure_profile(profile: str, overrides: Sequence[str]) -> int:
    """Make a profile's devices safe; prints a line per device as it is done.

    Args:
        profile: Name or path of the profile.
        overrides: ``"address=value"`` strings.

    Returns:
        The exit code: 0 if every device is safe and the profile right, 3 if a device
        failed, else 2.

    Raises:
        ConfigError: The profile cannot be read; no device was touched.
    """
    secured = make_profile_safe(profile, overrides, _Lines())
    if secured.problems is not None:
        report(secured.problems)
    if any(secured.attempted.values()):
        return DeviceError.exit_code
    return ConfigError.exit_code if secured.refused or secured.problems else 0


class _Lines:
    """Implements ``RunObserver`` with a line per device."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "safe_state":
            state = "safe" if values["ok"] else f"NOT SAFE: {values['error']}"
            say(f"{values['device']:<20} {state}")
        elif name == "closed" and not values["ok"]:
            say(f"{values['device']:<20} could not be closed: {values['error']}")
        elif name == "warning":
            say(f"warning: {values['text']}")
