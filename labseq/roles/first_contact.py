"""Steps of a driver for `labseq first-contact`, which measure its assumptions about its device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

from labseq.roles.hardware import Emergency

Instrument: TypeAlias = Literal["", "scope", "reference"]
"""Instrument that a step needs, none, an oscilloscope at the outputs or a 10 MHz reference."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A number that the user reads from an instrument after a step.

    Attributes:
        name: Its key in the result.
        about: Description of the number, for the question.
        dimension: A key of :data:`labseq.units.UNITS`, which is "fraction" for a plain number.
        low: Smallest value that makes sense, in SI.
        high: Largest value that makes sense, in SI.
    """

    name: str
    about: str
    dimension: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class ContactStep:
    """One step of a first contact. It may be run alone, and leaves the device in its safe state.

    Attributes:
        name: Its key in the result, and the value of ``--step``.
        does: Its effect on the device and its outputs, for the question before it.
        limit_s: Time after which it is abandoned and the device made safe, in seconds.
        run: Does the step and returns JSON values in SI. If there is nothing to measure, "skipped" says why.
        needs: The instrument that must be connected.
        prepare: Instruction to connect and set up the instrument first. "" for nothing.
        readings: Numbers that the user reads afterwards, with the outputs off.
    """

    name: str
    does: str
    limit_s: float
    run: Callable[[], Mapping[str, Any]]
    needs: Instrument = ""
    prepare: str = ""
    readings: tuple[Reading, ...] = ()


class FirstContact(ABC):
    """The first contact with one device. It opens the device itself, not through the driver's ``open()``.

    Attributes:
        is_simulated: Whether the device exists only in software.
        steps: The steps in their order.
        units: Result -> its unit, for the page, if its name does not end in the unit. A table has one unit
            per column. "bits" is for a number whose bits have meanings.
    """

    is_simulated: bool = False
    steps: Sequence[ContactStep] = ()
    units: Mapping[str, Sequence[str]] = MappingProxyType({})

    @abstractmethod
    def open(self) -> Mapping[str, Any]:
        """Open the device with its outputs off.

        Returns:
            "serial", "model", "driver" and "firmware" as text. "" if the device does not report it.

        Raises:
            DeviceError: There is no such device, it is another model, or another program uses it.
        """

    @abstractmethod
    def safe_state(self) -> None:
        """Switch the outputs off. Idempotent and legal in any state."""

    @abstractmethod
    def close(self) -> None:
        """Close the device. Legal in any state."""

    def emergency(self) -> Emergency | None:
        """As ``Hardware.emergency``."""
        return None

    @abstractmethod
    def judge(self, measured: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Any]:
        """Compare the measurements with the assumptions of the driver.

        Args:
            measured: Step -> its result, without the steps that were not taken.

        Returns:
            "reason", which names every difference, and conclusions such as "stream".
        """


@runtime_checkable
class OffersFirstContact(Protocol):
    """A driver that can check its assumptions. The method is called on a driver that is closed."""

    def first_contact(self) -> FirstContact:
        """The steps, which use the device instead of the driver."""
        ...
