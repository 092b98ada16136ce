"""``labseq safe``: every device of a profile to its safe state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from labseq.cli.output import say
from labseq.errors import DeviceError
from labseq.session import make_profile_safe


def secure_profile(profile: str, overrides: Sequence[str]) -> int:
    """Make a profile's devices safe; prints a line per device as it is done.

    Args:
        profile: Name or path of the profile.
        overrides: ``"address=value"`` strings.

    Returns:
        The exit code: 0 if every device is safe.

    Raises:
        LabseqError: The profile is wrong; no device was touched.
    """
    outcome = make_profile_safe(profile, overrides, _Lines())
    return DeviceError.exit_code if any(outcome.values()) else 0


class _Lines:
    """Implements ``RunObserver`` with a line per device."""

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        if name == "safe_state":
            state = "safe" if values["ok"] else f"NOT SAFE: {values['error']}"
            say(f"{values['device']:<20} {state}")
        elif name == "closed" and not values["ok"]:
            say(f"{values['device']:<20} could not be closed: {values['error']}")
