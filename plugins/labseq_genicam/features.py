"""The features of a camera, by their names in the GenICam Standard Features Naming Convention (SFNC)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol, TypeVar

from labseq.plugin import DeviceError, LimitError
from labseq.plugin.camera import check_step
from labseq.plugin.messages import one_of

Value = TypeVar("Value", str, bool, int, float)
Number = TypeVar("Number", int, float)


class Nodes(Protocol):
    """A library's access to features. Texts and enumerations are str, others bool, int or float.

    Each method but the first two fails if the camera does not have the feature.
    """

    def is_available(self, feature: str) -> bool:
        """Whether the camera has a feature and offers it now."""
        ...

    def options(self, feature: str) -> tuple[str, ...]:
        """Values of an enumeration that can be chosen, none if the camera does not have it."""
        ...

    def get(self, feature: str, kind: type[Value]) -> Value:
        """Value of a feature."""
        ...

    def set(self, feature: str, value: str | float) -> None:
        """Set a feature."""
        ...

    def bounds(self, feature: str, kind: type[Number]) -> tuple[Number, Number]:
        """Smallest and largest value of a number."""
        ...

    def increment(self, feature: str) -> int:
        """Distance between two values of an integer."""
        ...


class Features:
    """Sets features, and names the camera's limits where the settings exceed them.

    Args:
        name: Name of the camera in the profile, for errors.
        nodes: The library's access to the camera.
        doing: Turns errors of the library within its block into errors of labseq. Its argument completes
            "cannot ...".
    """

    def __init__(
        self, name: str, nodes: Nodes, doing: Callable[[str], AbstractContextManager[object]]
    ) -> None:
        self.name = name
        self._nodes = nodes
        self._doing = doing

    def find(self, *features: str) -> str:
        """The first of these features that the camera offers now, empty if it offers none.

        The name in the standard comes first, then the names of older cameras.
        """
        with self._doing("read which features it has"):
            return next((feature for feature in features if self._nodes.is_available(feature)), "")

    def get(self, what: str, *features: str, hint: str) -> str:
        """The first of these features that the camera offers, which errors call ``what``."""
        if feature := self.find(*features):
            return feature
        raise DeviceError(self.name, f"the camera has no {what} (no feature {one_of(features)}); {hint}")

    def options(self, feature: str) -> tuple[str, ...]:
        """Values of an enumeration that can be chosen, none if the camera does not have it."""
        with self._doing(f"read what its {feature} can be"):
            return self._nodes.options(feature)

    def choose(self, what: str, feature: str, value: str) -> None:
        """Set an enumeration."""
        if value not in (options := self.options(feature)):
            text = f"its {what} cannot be {value}; the camera offers {', '.join(options) or 'none'}"
            raise DeviceError(self.name, text)
        self.choose_if_offered(feature, value)

    def choose_if_offered(self, feature: str, value: str) -> None:
        """Set an enumeration, unless the camera has only this value or does not offer it."""
        if value in self.options(feature):
            with self._doing(f"set its {feature} to {value}"):
                if self._nodes.get(feature, str) != value:  # some cannot be written, as they have one value
                    self._nodes.set(feature, value)

    def switch(self, feature: str, *, is_on: bool) -> None:
        """Switch something on or off, if the camera has it."""
        if self.find(feature):
            with self._doing(f"switch its {feature} {'on' if is_on else 'off'}"):
                self._nodes.set(feature, is_on)

    def read(self, kind: type[Value], *features: str) -> Value | None:
        """Value of the first of these features that the camera offers, None if it offers none."""
        feature = self.find(*features)
        with self._doing(f"read its {feature}"):
            return self._nodes.get(feature, kind) if feature else None

    def integer_bounds(self, feature: str) -> tuple[int, int, int]:
        """Smallest value, largest value and increment of an integer."""
        with self._doing(f"read the limits of its {feature}"):
            return *self._nodes.bounds(feature, int), self._nodes.increment(feature)

    def float_bounds(self, feature: str) -> tuple[float, float]:
        """Smallest and largest value of a float."""
        with self._doing(f"read the limits of its {feature}"):
            return self._nodes.bounds(feature, float)

    def set_integer(self, what: str, feature: str, value: int, unit: int = 1) -> None:
        """Set an integer. ``value`` and its limits in errors are in units of ``unit``, the binning."""
        check_step(f"{self.name}: {what}", value, self.integer_bounds(feature), unit)
        with self._doing(f"set its {what}"):
            self._nodes.set(feature, int(value) // unit)

    def set_float(
        self, what: str, feature: str, value: float, say: Callable[[float], str] = "{:g}".format
    ) -> float:
        """Set a float, and return the value that the camera accepted. ``say`` formats it in errors."""
        low, high = self.float_bounds(feature)
        if not low <= value <= high:
            limit = f"{say(low)} to {say(high)}, which the camera can do"
            raise LimitError(f"{self.name}: {what}", say(value), limit)
        with self._doing(f"set its {what}"):
            self._nodes.set(feature, value)
            return self._nodes.get(feature, float)
