"""The roles that plugins play, each with its base class and its place among the devices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from labseq.model import TargetPattern
from labseq.roles.deciding import Analysis, Detector, Planner, Scanner
from labseq.roles.hardware import Camera, Device, Hardware, Lines, MobileTweezers, StaticTweezers
from labseq.roles.shot import Step
from labseq.roles.simulation import Simulation

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Role:
    """A role that a plugin can play.

    Attributes:
        name: Its name in the registry, and in a profile or sequence.
        base: Class of the objects from the plugin's factory. For a Protocol any class with the methods will
            do.
        opens: Place in the order in which devices are opened.
        safe: Place in the order in which devices are made safe and closed.
        has_twin: Whether a dry run replaces it by the plugin called "virtual".
    """

    name: str
    base: type
    opens: int = 0
    safe: int = 0
    has_twin: bool = False

    @property
    def is_hardware(self) -> bool:
        """Whether it is a device, which is opened, made safe and closed."""
        return issubclass(self.base, Hardware)


ROLES: Final[Mapping[str, Role]] = {
    role.name: role
    for role in (
        Role("planner", Planner),
        # The static tweezers open first and close last, because they hold the atoms. The mobile tweezers are
        # switched off before anything else, because they could carry atoms away.
        Role("camera", Camera, opens=1, safe=3, has_twin=True),
        Role("static_tweezers", StaticTweezers, opens=0, safe=4, has_twin=True),
        Role("mobile_tweezers", MobileTweezers, opens=4, safe=0, has_twin=True),
        Role("detector", Detector),
        Role("device", Device, opens=2, safe=1, has_twin=True),
        Role("lines", Lines, opens=3, safe=2, has_twin=True),
        Role("step", Step),
        Role("pattern", TargetPattern),
        Role("simulation", Simulation, has_twin=True),
        Role("scanner", Scanner),
        Role("analysis", Analysis),
    )
}
"""Name -> role, in the order in which the reference lists them."""


def in_opening_order(devices: Mapping[str, T]) -> list[tuple[str, T]]:
    """Name and device, in the order of opening, with static tweezers first and mobile tweezers last.

    Args:
        devices: Role, or the user's name of a device -> device.
    """
    return sorted(devices.items(), key=lambda item: _role_of(item[0]).opens)


def in_safe_order(devices: Mapping[str, T]) -> list[tuple[str, T]]:
    """Name and device, in the order of the safe state, mobile tweezers first and static tweezers last."""
    return sorted(devices.items(), key=lambda item: _role_of(item[0]).safe)


def _role_of(name: str) -> Role:
    """The role of a device of the profile. A camera among its ``devices`` counts as a device."""
    role = ROLES.get(name)
    return role if role is not None and role.is_hardware else ROLES["device"]


def overrides(part: object, ability: Callable[..., Any]) -> bool:
    """Whether a driver implements an optional ability.

    Used for abilities whose default would cost a thread's wake-up in every shot, and for reports.

    Args:
        part: The driver.
        ability: The method of the base class, for example ``Hardware.poll``.
    """
    return getattr(type(part), ability.__name__) is not ability
